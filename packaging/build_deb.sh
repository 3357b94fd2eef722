#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Builds the Debian package: its own Python environment under /opt/rfconstruct, unit, udev rules, sysctl, tmpfiles, users.
#
#   packaging/build_deb.sh [--out DIR] [--python PYTHON] [--no-venv]
#
# --out      where the .deb goes (default: dist)
# --python   interpreter with pip and hatchling; its minor version is that of the target (default: .venv/bin/python)
# --no-venv  everything but the software, which takes minutes: to check the rest of the package
set -eu

fail() { echo "build_deb.sh: $*" >&2; exit 1; }

top=$(cd "$(dirname "$0")/.." && pwd)
out=$top/dist python=$top/.venv/bin/python venv=yes
while [ $# -gt 0 ]; do
    case $1 in
        --out) out=$2; shift 2 ;;
        --python) python=$2; shift 2 ;;
        --no-venv) venv=no; shift ;;
        *) fail "unknown option $1" ;;
    esac
done
command -v dpkg-deb >/dev/null || fail "dpkg-deb is missing: apt-get install dpkg-dev"
command -v strip >/dev/null || fail "strip is missing: apt-get install binutils"
umask 022

version=$(sed -n 's/^version = "\(.*\)"$/\1/p' "$top/pyproject.toml" | head -n 1)
architecture=$(dpkg --print-architecture)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM
root=$work/tree home=$work/tree/opt/rfconstruct
mkdir -p "$root/DEBIAN" "$home/bin" "$root/usr/bin"

put() { # put MODE SOURCE TARGET
    mkdir -p "$(dirname "$root$3")"
    install -m "$1" "$top/$2" "$root$3"
}
put 0644 systemd/rfconstruct.service /usr/lib/systemd/system/rfconstruct.service
put 0644 systemd/udev/60-rfconstruct.rules /usr/lib/udev/rules.d/60-rfconstruct.rules
put 0644 systemd/sysctl/60-rfconstruct.conf /usr/lib/sysctl.d/60-rfconstruct.conf
put 0644 systemd/tmpfiles/rfconstruct.conf /usr/lib/tmpfiles.d/rfconstruct.conf
put 0644 systemd/sysusers/rfconstruct.conf /usr/lib/sysusers.d/rfconstruct.conf
put 0644 packaging/debian/environment /etc/rfconstruct/environment
put 0644 LICENSE /usr/share/doc/rfconstruct/copyright
for page in service hardware poses_and_usb calibration recordings client wire_format troubleshooting; do
    put 0644 "docs/$page.md" "/usr/share/doc/rfconstruct/$page.md"
done
for example in print_shapes.py save_ply.py ros2_pointcloud2.py rerun_view.py cpp/subscriber.cpp; do
    put 0644 "examples/$example" "/usr/share/doc/rfconstruct/examples/$example"
done
ln -s /opt/rfconstruct/bin/rfconstruct "$root/usr/bin/rfconstruct"

# Takes out what the appliance never loads. Licences of what stays lie in *.dist-info and beside the code; they stay.
# A package goes with its dist-info, so that nothing claims to be installed that is not.
slim() { # slim SITE
    find "$1" -type d -name tests -prune -exec rm -rf {} +
    # Recordings are written uncompressed and mcap does without both; onnxruntime runs models without the other three.
    for package in lz4 zstandard flatbuffers protobuf packaging; do rm -rf "$1/$package" "$1/$package"-*.dist-info; done
    rm -rf "$1/google" "$1/train"
    # A second build of the runtime for programs in C: Python's module has its own inside.
    rm -f "$1"/onnxruntime/capi/libonnxruntime.so*
    for part in onnxruntime/backend onnxruntime/datasets onnxruntime/quantization onnxruntime/tools \
        onnxruntime/transformers numpy/distutils numpy/f2py numpy/_pyinstaller numpy/_core/include numpy/_core/lib; do
        rm -rf "${1:?}/$part"
    done
    find "$1" -type f ! -path '*.dist-info/*' \( -name '*.pyi' -o -name '*.pxd' -o -name '*.pyx' -o -name '*.a' \
        -o -name '*.c' -o -name '*.cpp' -o -name '*.h' -o -name '*.hpp' \) -delete
    strip --strip-unneeded "$1/llvmlite/binding/libllvmlite.so" # 20 MB of names of its inner functions
}

python_minor=11
if [ "$venv" = yes ]; then
    python_minor=$("$python" -c 'import sys; print(sys.version_info.minor)')
    pip() { "$python" -m pip --quiet --disable-pip-version-check "$@"; }
    pip wheel --no-deps --no-build-isolation --wheel-dir "$work/wheel" "$top"
    "$python" -m venv --without-pip "$home"
    pip --python "$home/bin/python" install --no-compile --requirement "$top/requirements/edge.txt"
    pip --python "$home/bin/python" install --no-compile --no-deps "$work"/wheel/*.whl
    site=$("$home/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
    slim "$site"
    # What was built in $root will lie in /: its interpreter is the system's, its paths begin at the root.
    for link in python python3; do ln -sfn "/usr/bin/python3.$python_minor" "$home/bin/$link"; done
    rm -f "$home/bin/python3.$python_minor" "$home/bin/"[Aa]ctivate*
    sed -i "1s|^#!.*python.*|#!/opt/rfconstruct/bin/python|" "$home/bin/rfconstruct"
    find "$home/bin" -type f ! -name rfconstruct -delete
    rm -f "$site"/rfconstruct-*.dist-info/direct_url.json
    sed -i -e 's|^home = .*|home = /usr/bin|' -e "s|^version = .*|version = 3.$python_minor|" \
        -e '/^executable = /d' -e '/^command = /d' "$home/pyvenv.cfg"
    "$python" -m compileall -q -s "$root" -p / "$home" >/dev/null || fail "a module does not compile"
else
    printf '#!/bin/sh\necho "rfconstruct: this package was built with --no-venv" >&2\nexit 1\n' >"$home/bin/rfconstruct"
    chmod 0755 "$home/bin/rfconstruct"
fi
strays=$(grep -rIl -- "$work" "$root" || true)
[ -z "$strays" ] || fail "files that hold paths of this machine: $strays"

for script in postinst prerm postrm; do install -m 0755 "$top/packaging/debian/$script" "$root/DEBIAN/$script"; done
echo /etc/rfconstruct/environment >"$root/DEBIAN/conffiles"
(cd "$root" && find . -path ./DEBIAN -prune -o -type f -printf '%P\0' | sort -z | xargs -0 md5sum) >"$root/DEBIAN/md5sums"
cat >"$root/DEBIAN/control" <<CONTROL
Package: rfconstruct
Version: $version
Architecture: $architecture
Maintainer: RFconstruct maintainers <maintainers@rfconstruct.invalid>
Installed-Size: $(du -sk --exclude=DEBIAN "$root" | cut -f 1)
Depends: python3 (>= 3.$python_minor), python3 (<< 3.$((python_minor + 1))), systemd, udev, libusb-1.0-0
Recommends: openssh-client
Section: science
Priority: optional
Description: 3-D shapes of road users from two orthogonal 77 GHz radars
 Reads raw frames of two radar boards, detects, fuses and completes objects,
 and publishes their shapes over ZeroMQ. Runs as a hardened service.
CONTROL
mkdir -p "$out"
dpkg-deb --root-owner-group -Zzstd -z6 --build "$root" "$out/rfconstruct_${version}_$architecture.deb"
