# SPDX-License-Identifier: Apache-2.0
"""Where Numba keeps compiled kernels: one private folder per package version, processor and shared kernel sources.

``edge.dsp`` and ``edge.fusion`` call ``enable`` before any kernel imports Numba. Numba notices edits of a kernel's own
file, but not of another file that it calls into: those files' contents are part of the folder's name. The cache holds
pickles, so a folder that others may write to is refused.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

from edge.version import version

VARIABLE = "NUMBA_CACHE_DIR"
KEPT_FOLDERS = 4
"""Folders of other versions or processors that stay; the longest unused go first."""
TEMPORARY = "rfconstruct-"
"""Beginning of the name of the folder that is used when none can be kept."""
_NAME = re.compile(r"numba-[0-9a-f]{16}")
_SHARED = re.compile(r"^from edge\.(\w+)\.(kernels_\w+) import", re.MULTILINE)
_PACKAGE = Path(__file__).resolve().parent
_READ_BYTES = 8192
"""Of /proc/cpuinfo: enough for the first processor."""


def processor() -> str:
    """Name of the CPU as the kernel gives it."""
    try:
        with Path("/proc/cpuinfo").open("rb") as file:
            text = file.read(_READ_BYTES).decode("utf-8", "replace")
    except OSError:
        text = ""
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return found[1].strip() if found else platform.processor() or platform.machine()


def shared_sources(package: Path) -> list[Path]:
    """Kernel files that other kernel files of the package import, in order of their names."""
    named: set[Path] = set()
    for path in package.glob("*/kernels_*.py"):
        for folder, module in _SHARED.findall(path.read_text(encoding="utf-8")):
            named.add(package / folder / f"{module}.py")
    return sorted(named)


def key(package: Path = _PACKAGE) -> str:
    """16 hexadecimal digits that change with the package's version, the processor and every shared kernel file."""
    digest = hashlib.sha256(f"{version()}\n{processor()}\n".encode())
    for path in shared_sources(package):
        digest.update(f"{path.name}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def root() -> Path:
    """Folder of all our caches: ``rfconstruct`` under XDG_CACHE_HOME, else under ~/.cache.

    Raises:
        OSError: no home folder is known.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():
        try:
            base = Path.home() / ".cache"
        except RuntimeError as error:
            raise OSError(str(error)) from error
    return base / "rfconstruct"


def check_private(folder: Path) -> None:
    """Make the folder, readable and writable by its owner only, and write to it.

    Raises:
        OSError: it cannot be made or written to, or someone else owns it or may write to it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.stat()
    if status.st_uid != os.getuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f"{folder} is not private: others could plant code in it")
    tempfile.TemporaryFile(dir=folder).close()


def enable() -> Path:
    """Point Numba to its folder; a folder that the user chose in NUMBA_CACHE_DIR stays.

    Returns:
        The folder in use: the user's, ours, or a temporary one that is removed at exit when ours cannot be used, in
        which case a RuntimeWarning says what to do.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen and not _NAME.fullmatch(Path(chosen).name):
        return Path(chosen)
    try:
        folder = root() / f"numba-{key()}"
        check_private(folder)
        os.utime(folder)
        prune(folder)
    except OSError as error:
        folder = _temporary(error)
    os.environ[VARIABLE] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    return folder


def is_temporary(folder: Path) -> bool:
    """Whether ``enable`` had to fall back to a folder that is gone after this process."""
    return folder.name.startswith(TEMPORARY)


def prune(current: Path) -> list[Path]:
    """Remove our folders beside the current one but the ``KEPT_FOLDERS`` used last; returns those removed."""
    others = sorted(_others(current), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in others[KEPT_FOLDERS:]:
        shutil.rmtree(path, ignore_errors=True)
    return others[KEPT_FOLDERS:]


def _others(current: Path) -> Iterator[Path]:
    for path in current.parent.iterdir():
        if path != current and _NAME.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
            yield path


def _temporary(error: OSError) -> Path:
    """A folder for this process alone."""
    folder = Path(tempfile.mkdtemp(prefix=TEMPORARY))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    warnings.warn(
        f"kernels are compiled anew at every start, which takes up to 20 s: {error}; "
        f"set {VARIABLE} to a private folder that can be written to, then run rfconstruct doctor --warm",
        RuntimeWarning,
        stacklevel=3,
    )
    return folder
