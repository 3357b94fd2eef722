# SPDX-License-Identifier: Apache-2.0
"""``pytest tests/hil --device PATH``: the same tests on real boards; without it on the virtual rig."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.rig import FILE_NAME, Rig, load_rig


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", metavar="PATH", help="a rig's folder, or a file for `rfconstruct run --boards`")
    parser.addoption("--device-rig", metavar="NAME", default="awr1843_pair", help="rig of a boards file")


@pytest.fixture
def device_rig(request: pytest.FixtureRequest) -> Rig:
    """The rig of real boards; the test is skipped when there are none."""
    given = request.config.getoption("device", default=None)
    if given is None:
        pytest.skip("no boards: give them with --device")
    path = Path(given)
    if path.is_dir():
        boards = path / "boards.toml"
        return load_rig(
            path if (path / FILE_NAME).is_file() else name_of(request), boards if boards.is_file() else None
        )
    return load_rig(name_of(request), path)


def name_of(request: pytest.FixtureRequest) -> str:
    return str(request.config.getoption("device_rig", default="awr1843_pair"))
