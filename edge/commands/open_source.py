# SPDX-License-Identifier: Apache-2.0
"""Opens whatever a command line names as a recording: MCAP file, TI capture folder, published sum over loops."""

from __future__ import annotations

import argparse
from pathlib import Path

from edge.errors import CaptureError, ConfigError
from edge.frames import RADARS, RadarId
from edge.rig import Rig, load_rig
from edge.sources import loop_sum
from edge.sources.base import FrameSource
from edge.sources.ti_capture import CaptureFolder


def add_rig_arguments(parser: argparse.ArgumentParser) -> None:
    """``--rig`` and ``--calibration``."""
    parser.add_argument("--rig", help="rig name or folder; a recording brings its own")
    parser.add_argument(
        "--calibration",
        action="append",
        default=[],
        metavar="[RADAR=]FILE",
        help="calibration (.npz, or TI's .mat) instead of the rig's; may be repeated",
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
        radar, path = _split(text, rig)
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
            action="join the captures with: rfconstruct import FOLDER FOLDER --rig NAME --out FILE.mcap",
        )
    radar = next(iter(rig.radars))
    if (path / loop_sum.FILE_NAME).is_file():
        return loop_sum.LoopSum(path, rig, radar), [loop_sum.NOTE]
    capture = CaptureFolder(path, rig, radar)
    return capture, capture.notes


def _split(text: str, rig: Rig) -> tuple[RadarId, Path]:
    head, sign, tail = text.partition("=")
    for radar in RADARS:
        if sign and head == radar:
            return radar, Path(tail)
    if len(rig.radars) == 1:
        return next(iter(rig.radars)), Path(text)
    raise ConfigError(
        "calibration of which radar?", value=text, allowed=" or ".join(f"{radar}=FILE" for radar in rig.radars)
    )
