# SPDX-License-Identifier: Apache-2.0
"""The Debian package, unpacked into a scratch root: files, modes, maintainer scripts; and the wheel inside."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "packaging" / "build_deb.sh"
FILES = {
    "opt/rfconstruct/bin/rfconstruct": 0o755,
    "usr/lib/systemd/system/rfconstruct.service": 0o644,
    "usr/lib/udev/rules.d/60-rfconstruct.rules": 0o644,
    "usr/lib/sysctl.d/60-rfconstruct.conf": 0o644,
    "usr/lib/tmpfiles.d/rfconstruct.conf": 0o644,
    "usr/lib/sysusers.d/rfconstruct.conf": 0o644,
    "usr/share/doc/rfconstruct/copyright": 0o644,
    "usr/share/doc/rfconstruct/service.md": 0o644,
    "usr/share/doc/rfconstruct/troubleshooting.md": 0o644,
    "usr/share/doc/rfconstruct/examples/cpp/subscriber.cpp": 0o644,
    "etc/rfconstruct/environment": 0o644,
}
SCRIPTS = ("postinst", "prerm", "postrm")
EDGE_LIMIT_MB = 300
"""With its compiled modules."""
ABSENT = ("torch", "pip", "train", "lz4", "zstandard", "google", "flatbuffers", "onnxruntime/tools", "numpy/f2py")


def build(folder: Path, *options: str, timeout_s: float = 60.0) -> tuple[Path, Path]:
    """Folders of the package's files and of its control files."""
    if shutil.which("dpkg-deb") is None:
        pytest.skip("no dpkg-deb here: the package is built on Debian")
    subprocess.run([BUILD, "--out", folder, *options], check=True, timeout=timeout_s, capture_output=True)
    (package,) = folder.glob("rfconstruct_*.deb")
    root, control = folder / "root", folder / "control"
    subprocess.run(["dpkg-deb", "--extract", package, root], check=True, timeout=timeout_s)
    subprocess.run(["dpkg-deb", "--control", package, control], check=True, timeout=timeout_s)
    return root, control


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return build(tmp_path_factory.mktemp("deb"), "--no-venv")


def test_files_and_their_modes(package: tuple[Path, Path]) -> None:
    root, _ = package
    for name, mode in FILES.items():
        assert stat.S_IMODE((root / name).stat().st_mode) == mode, name
    assert os.readlink(root / "usr/bin/rfconstruct") == "/opt/rfconstruct/bin/rfconstruct"
    for path in root.rglob("*"):
        assert path.is_symlink() or not path.stat().st_mode & 0o6022, f"{path}: set-id or writable by others"


def test_installed_files_are_those_of_the_project(package: tuple[Path, Path]) -> None:
    root, _ = package
    for name, source in (
        ("usr/lib/systemd/system/rfconstruct.service", "systemd/rfconstruct.service"),
        ("usr/lib/udev/rules.d/60-rfconstruct.rules", "systemd/udev/60-rfconstruct.rules"),
    ):
        assert (root / name).read_bytes() == (ROOT / source).read_bytes()


def test_the_pages_that_an_operator_needs_lie_beside_each_other(package: tuple[Path, Path]) -> None:
    folder = package[0] / "usr/share/doc/rfconstruct"
    pages = {path.name for path in folder.glob("*.md")}
    text = (folder / "service.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\]\((\w+\.md)", text)) <= pages
    shipped = {str(path.relative_to(folder / "examples")) for path in (folder / "examples").rglob("*.*")}
    examples = ROOT / "examples"
    assert shipped == {str(one.relative_to(examples)) for kind in ("*.py", "*.cpp") for one in examples.rglob(kind)}


def test_control_fields(package: tuple[Path, Path]) -> None:
    _, control = package
    fields = dict(re.findall(r"^([A-Z][\w-]*): (.*)$", (control / "control").read_text(), re.MULTILINE))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert (fields["Package"], fields["Version"]) == (project["name"], project["version"])
    assert re.search(r"python3 \(>= 3\.\d+\), python3 \(<< 3\.\d+\)", fields["Depends"])
    assert "libusb-1.0-0" in fields["Depends"]
    assert (control / "conffiles").read_text() == "/etc/rfconstruct/environment\n"


def test_check_sums_cover_every_file(package: tuple[Path, Path]) -> None:
    root, control = package
    sums = {line[34:]: line[:32] for line in (control / "md5sums").read_text().splitlines()}
    files = {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file() and not path.is_symlink()}
    assert set(sums) == files
    for name, value in sums.items():
        assert hashlib.md5((root / name).read_bytes(), usedforsecurity=False).hexdigest() == value


@pytest.mark.parametrize("name", SCRIPTS)
def test_maintainer_scripts_are_sound_shell(package: tuple[Path, Path], name: str) -> None:
    script = package[1] / name
    assert stat.S_IMODE(script.stat().st_mode) == 0o755
    text = script.read_text(encoding="utf-8")
    assert text.startswith("#!/bin/sh\n")
    assert "\nset -e\n" in text
    subprocess.run(["sh", "-n", script], check=True, timeout=10)


@pytest.mark.parametrize(
    ("name", "argument", "expected"),
    [
        ("postinst", "configure", ["systemd-sysusers", "systemd-tmpfiles", "timeout"]),
        ("postinst", "abort-upgrade", []),
        ("prerm", "upgrade", []),
        ("postrm", "remove", []),
    ],
)
def test_what_the_maintainer_scripts_call(
    package: tuple[Path, Path], tmp_path: Path, name: str, argument: str, expected: list[str]
) -> None:
    """With recorders in place of the tools, on a machine without running systemd."""
    tools, log = tmp_path / "bin", tmp_path / "log"
    tools.mkdir()
    log.touch()
    for tool in ("systemd-sysusers", "systemd-tmpfiles", "timeout", "systemctl", "udevadm", "rm", "setpriv"):
        (tools / tool).write_text(f'#!/bin/sh\necho "{tool} $*" >>{log}\n')
        (tools / tool).chmod(0o755)
    if Path("/run/systemd/system").is_dir():
        pytest.skip("systemd runs here: more would be called")
    subprocess.run(["sh", package[1] / name, argument], check=True, timeout=10, env={"PATH": f"{tools}:/usr/bin:/bin"})
    called = log.read_text().splitlines()
    assert [line.split(" ")[0] for line in called] == expected
    if expected:
        assert "--reuid=rfconstruct" in called[-1]
        assert called[-1].endswith("/opt/rfconstruct/bin/rfconstruct doctor --warm")


@pytest.mark.slow
def test_the_whole_package_runs_without_torch_and_keeps_its_size(tmp_path: Path) -> None:
    root, control = build(tmp_path, timeout_s=1500.0)
    home = root / "opt/rfconstruct"
    (site,) = (path.parent for path in home.glob("lib/python3.*/*/numpy"))
    assert [name for name in ABSENT if (site / name).exists()] == []
    for name in ("llvmlite", "numba", "numpy", "pyzmq", "msgpack", "tqdm", "pyusb", "rfconstruct"):
        texts = [path.name.upper() for path in site.glob(f"{name}-*.dist-info/**/*")]
        assert any(text.startswith(("LIC", "COPY")) for text in texts), f"{name}: no licence"
    assert (site / "onnxruntime/LICENSE").is_file()
    assert (home / "bin/rfconstruct").read_text().splitlines()[0] == "#!/opt/rfconstruct/bin/python"
    code = "import edge.pipeline, edge.stream.client; from edge.cli import main; main(['--help']); main(['doctor'])"
    command = [sys.executable, "-I", "-S", "-c", f"import sys; sys.path.insert(0, {str(site)!r}); {code}"]
    answer = subprocess.run(
        command, check=True, timeout=300, capture_output=True, text=True, env={"HOME": str(tmp_path)}
    )
    assert "usage: rfconstruct COMMAND" in answer.stdout
    for line in ("packages ", "rigs ", "model "):
        assert re.search(rf"^ok +{line}", answer.stdout, re.MULTILINE), answer.stdout
    assert "gives its known answer" in answer.stdout
    assert str(ROOT) not in (home / "pyvenv.cfg").read_text()
    size = int(re.search(r"Installed-Size: (\d+)", (control / "control").read_text())[1])  # type: ignore[index]
    assert size / 1024 < EDGE_LIMIT_MB
