# SPDX-License-Identifier: Apache-2.0
"""Every command of docs/recordings.md runs, in order, on the demo's recording."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from cli_run import RIG, rfconstruct

from edge.commands.demo_scene import SCENE, demo_object, demo_recording

PAGE = Path(__file__).parents[2] / "docs" / "recordings.md"


def commands(fence: str) -> list[list[str]]:
    """Arguments of the commands in the blocks of a kind."""
    blocks = re.findall(rf"^```{fence}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [shlex.split(line, comments=True)[1:] for block in blocks for line in block.splitlines()]


@pytest.mark.slow
def test_every_command_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(demo_recording(RIG, demo_object(), SCENE), tmp_path / "drive.mcap")
    monkeypatch.chdir(tmp_path)
    told = commands("sh")
    assert len(told) == 12
    for words in told:
        outcome = rfconstruct(*words)
        assert outcome.code == 0, (words, outcome.out, outcome.err)
    assert {"car.ply", "cars", "map.npz", "scene.mcap", "good.mcap"} <= {path.name for path in tmp_path.iterdir()}


def test_commands_that_need_radars_or_a_publisher_have_these_options() -> None:
    for words in commands("console"):
        options = rfconstruct(words[0], "--help").out
        assert all(word.split("=")[0] in options for word in words if word.startswith("--"))
