# SPDX-License-Identifier: Apache-2.0
"""Opens whatever a command line names as a recording: MCAP file, TI capture folder, published sum over loops."""

from __future__ import annotations

import argparse
from pathlib import Path

from edge.errors import CaptureError, ConfigError
from edge.frames import RADARS, RadarId
from edge.recording.importing import open_captures
from edge.rig import Rig, load_rig
from edge.sources.base import FrameSource


def add_rig_arguments(parser: argparse.ArgumentParser) -> None:
    """``--rig`` and ``--calibration``."""
    parser.add_argument("--rig", help="name or folder; a recording brings its own")
    parser.add_argument(
        "--calibration",
        action="append",
        default=[],
        metavar="FILE",
        help="[RADAR=]FILE (.npz, TI's .mat) instead of the rig's",
    )


def rig_of(args: argparse.Namespace) -> Rig:
    """The rig that ``--rig`` names, with the calibrations that ``--calibration`` names."""
    if args.rig is None:
        raise ConfigError("a capture folder does not say with which rig it was made", action="give it with --rig")
    return calibrated(load_rig(args.rig), args.calibration)


def calibrated(rig: Rig, calibrations: list[str]) -> Rig:
    """The rig with other calibrations.

    Args:
        rig: to start from.
        calibrations: ``FILE`` for the only radar of a rig, or ``RADAR=FILE``.
    """
    for text in calibrations:
        radar, path = named_path(text, rig)
        rig = rig.with_calibration(radar, path)
    return rig


def open_capture(path: Path, rig: Rig) -> tuple[FrameSource, list[str]]:
    """A folder of one radar's raw data.

    Args:
        path: the folder.
        rig: of one radar; two radars' captures are joined by ``rfconstruct import``.
    Returns:
        The source and what a reader of its results should know.
    Raises:
        CaptureError: not a capture of this rig.
    """
    if len(rig.radars) != 1:
        raise CaptureError(
            f"{path} is a folder of one radar's files but rig {rig.name} has {len(rig.radars)}",
            action="join the captures with: rfconstruct import RADAR=FOLDER RADAR=FOLDER --rig NAME --out FILE.mcap",
        )
    source = next(iter(open_captures(path, rig).values()))
    return source, list(getattr(source, "notes", []))


def named_path(text: str, rig: Rig) -> tuple[RadarId, Path]:
    """``RADAR=PATH``, or ``PATH`` alone for the only radar of a rig.

    Raises:
        ConfigError: the radar is not named and the rig has two.
    """
    head, sign, tail = text.partition("=")
    for radar in RADARS:
        if sign and head == radar:
            return radar, Path(tail)
    if len(rig.radars) == 1:
        return next(iter(rig.radars)), Path(text)
    raise ConfigError("file of which radar?", value=text, allowed=" or ".join(f"{radar}=PATH" for radar in rig.radars))
