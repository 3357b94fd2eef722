# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures: where the optional real data lie, a visible skip when they do not; tests can be interrupted."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.resources import data_dir


@pytest.fixture(scope="session", autouse=True)
def interruptible() -> Iterator[None]:
    """A run started in the background ignores SIGINT, and so would every process that a test starts and interrupts."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def radar_data() -> Path:
    """Folder with the real radar recordings; the test is skipped when it is absent."""
    folder = data_dir()
    if folder is None or not (folder / "radar").is_dir():
        pytest.skip("no real recordings here: set RFCONSTRUCT_DATA to the folder that holds radar/")
    return folder / "radar"


@pytest.fixture(scope="session")
def object_data() -> Path:
    """Folder with the collected 3-D objects; the test is skipped when it is absent."""
    folder = data_dir()
    if folder is None or not (folder / "objects").is_dir():
        pytest.skip("no 3-D objects here: set RFCONSTRUCT_DATA to the folder that holds objects/")
    return folder / "objects"
