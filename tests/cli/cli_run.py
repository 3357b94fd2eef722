# SPDX-License-Identifier: Apache-2.0
"""Calls ``rfconstruct`` in this process and takes its output; a small recording to play."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from edge.cli import main
from edge.commands.demo_scene import SHIPPED_CAR
from edge.frames import RADARS, Pose, RadarFrame
from edge.recording.writer import RecordingWriter
from edge.reference.drive_by import DriveBy, DriveByScene, place, poses
from edge.rig import load_rig

RIG = load_rig("cascade_demo")
SCENE = DriveBy(frames=10, scatterers=150)


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """Stdout as the one JSON document it must be."""
        content = json.loads(self.out, parse_constant=lambda name: 1 / 0)
        assert isinstance(content, dict)
        return content


def rfconstruct(*argv: object) -> Outcome:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(argument) for argument in argv])
        except SystemExit as exit_:
            code = int(exit_.code or 0)
    return Outcome(int(code), out.getvalue(), err.getvalue())


@cache
def drive_by() -> tuple[RadarFrame | Pose, ...]:
    """Frames and poses of a short drive past the shipped car, in time order."""
    with np.load(SHIPPED_CAR) as mesh:
        vertices, faces = place(mesh["vertices"].astype(np.float64), SCENE), mesh["faces"].astype(np.int32)
    scene = DriveByScene(RIG.radars, RIG.geometry, RIG.settings.antenna, vertices, faces, SCENE)
    frames = [scene.frame(radar, number) for number in range(SCENE.frames) for radar in RADARS]
    items: list[RadarFrame | Pose] = [*frames, *poses(SCENE, RIG.geometry)]
    return tuple(sorted(items, key=lambda item: item.t_ns if isinstance(item, Pose) else item.t_first_chirp_ns))


def write_recording(path: Path) -> Path:
    with RecordingWriter(path, RIG) as writer:
        for item in drive_by():
            if isinstance(item, Pose):
                writer.pose(item)
            else:
                writer.frame(item)
    return path
