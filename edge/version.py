# SPDX-License-Identifier: Apache-2.0
"""Version of the installed distribution."""

from __future__ import annotations

from importlib import metadata


def version() -> str:
    """As in pyproject.toml; "not installed" in a bare source tree."""
    try:
        return metadata.version("rfconstruct")
    except metadata.PackageNotFoundError:
        return "not installed"
