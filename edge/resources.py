# SPDX-License-Identifier: Apache-2.0
"""Where shipped files and optional data lie: a source checkout, an installed wheel, or RFCONSTRUCT_DATA."""

from __future__ import annotations

import os
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def shipped_dir(name: str) -> Path:
    """Folder ``firmware_cfg`` or ``models`` as it came with the software.

    Args:
        name: "firmware_cfg" or "models".
    Returns:
        The folder of a source checkout when there is one, else the copy inside the wheel.
    Raises:
        FileNotFoundError: neither exists.
    """
    for candidate in (_PACKAGE.parent / name, _PACKAGE / "_shipped" / name):
        if candidate.is_dir():
            return candidate
    raise FileNotFoundError(f"{name}: neither beside the package nor inside it; reinstall rfconstruct")


def data_dir() -> Path | None:
    """Folder that holds ``radar/`` and ``objects/``: RFCONSTRUCT_DATA, else ``../shared/data`` beside the project.

    Returns:
        The folder, or None when there is no such data on this machine.
    """
    configured = os.environ.get("RFCONSTRUCT_DATA")
    folder = Path(configured) if configured else _PACKAGE.parent.parent / "shared" / "data"
    return folder if (folder / "radar").is_dir() or (folder / "objects").is_dir() else None
