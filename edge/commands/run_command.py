# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct run``: sets up the boards of a rig, starts them in turn, plays their frames through the pipeline."""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Generator
from contextlib import ExitStack, suppress
from pathlib import Path

from edge.commands import arguments, run_recording, session
from edge.commands.hardware import make_boards
from edge.commands.live_road import CardRoad, Limits, Road, SegmentRoad
from edge.commands.open_source import calibrated
from edge.drivers.single_chip import SingleChipDriver
from edge.drivers.tda2.cascade import CascadeDriver
from edge.errors import DeviceError, ExitCode, PoseError, RfconstructError
from edge.frames import RADARS, LossCause, Pose, RadarFrame
from edge.odometry.source import PoseEvent, make_pose_source
from edge.rig import Rig, load_rig
from edge.sources.base import Loss
from edge.sources.pose_feed import PoseFeed

EDGE_S = 1.0
"""Frames before the first pose and after the last partner may be lost without a fault, of this time in all."""
AT_THE_EDGES = (LossCause.NO_POSE, LossCause.UNPAIRED)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.usage = "%(prog)s --rig RIG [options]"
    parser.add_argument("--rig", required=True, help="name or folder")
    parser.add_argument("--boards", type=Path, metavar="FILE", help="where the boards and the pose sensor are reached")
    parser.add_argument("--calibration", action="append", default=[], metavar="FILE", help="[RADAR=]FILE (.npz, .mat)")
    parser.add_argument("--dry-run", action="store_true", help="print every byte and line that would be sent, and end")
    parser.add_argument("--seconds", type=arguments.seconds, help="end after this time of frames")
    parser.add_argument("--frames", type=arguments.count, help="end after so many frames of each radar")
    parser.add_argument("--segments", type=arguments.count, help="cascades: end after so many segments")
    parser.add_argument("--folder", type=Path, help="cascades: for copies of segments (default: a temporary one)")
    parser.add_argument("--keep", action="store_true", help="cascades: keep segments on the boards and their copies")
    parser.add_argument("--metrics", type=Path, metavar="SOCKET", help="Prometheus text by HTTP on this Unix socket")
    parser.add_argument("--metrics-port", type=arguments.count, metavar="PORT", help="the same on 127.0.0.1")
    run_recording.add_arguments(parser)
    session.add_arguments(parser, speed=None)


def run(args: argparse.Namespace) -> int:
    """Configure, start, play, report.

    Exit code 3 when frames were lost by the hardware, bursts met, nothing came, or the recording is incomplete; 4 when
    a board cannot be used, or not any more: then what came before is processed and reported.
    Ctrl-C and SIGTERM end the run in order: boards stopped, account printed, exit code 130 or 143.
    """
    rig = calibrated(load_rig(args.rig, args.boards), args.calibration)
    boards = make_boards(rig)
    if args.dry_run:
        return _dry_run({radar: board.plan() for radar, board in boards.items()}, args.json)
    limits = _limits(args, rig)
    with ExitStack() as stack:
        segments = any(isinstance(board, CascadeDriver) for board in boards.values())
        live = session.Session(rig, args, "live", f"rig {rig.name}", live=True, patient=segments)
        for board in boards.values():
            stack.callback(board.close)
        poses = _poses(rig, live, stack)
        cascades = {radar: board for radar, board in boards.items() if isinstance(board, CascadeDriver)}
        singles = {radar: board for radar, board in boards.items() if isinstance(board, SingleChipDriver)}
        road: Road
        if cascades:
            folder = args.folder or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rfconstruct-")))
            road = SegmentRoad(rig, cascades, limits, folder, args.keep, poses, live)
        else:
            road = CardRoad(rig, singles, limits, poses, live)
        broken: list[RfconstructError] = []
        items = _items(road, live, broken)
        live.run(items, road.total_frames, road.prepare)
        with suppress(ValueError):  # left behind in a call to a board that does not return
            items.close()
        live.notes += [*road.finish(), *(str(error) for error in broken)]
    code = _report(live, road)
    return code if not broken or code > ExitCode.BAD_MODEL else broken[0].exit_code


def _items(
    road: Road, live: session.Session, broken: list[RfconstructError]
) -> Generator[RadarFrame | Pose | Loss, None, None]:
    """What the pipeline takes; a new odometry frame closes its window.

    A board or pose sensor that ends the run goes to ``broken``: what came before it is still processed and reported.
    """
    try:
        for item in road.items():
            if not isinstance(item, PoseEvent):
                yield item
                continue
            live.say(f"poses: {item.detail}")
            if item.new_frame:
                live.pipeline.new_pose_frame()
            if item.kind in ("silent", "died", "doubtful"):
                live.notes.append(f"poses {item.kind}: {item.detail}")
    except (DeviceError, PoseError) as error:
        live.say(f"the run ends: {error}")
        broken.append(error)


def _poses(rig: Rig, live: session.Session, stack: ExitStack) -> PoseFeed | None:
    source = make_pose_source(rig)
    if source is None:
        if len(rig.radars) == len(RADARS):
            live.notes.append('no poses (pose.kind = "none"): nothing can be fused, frames are lost by no_pose')
        return None
    feed = PoseFeed(source)
    stack.callback(feed.close)
    live.say(f"poses from {feed.name}")
    return feed


def _limits(args: argparse.Namespace, rig: Rig) -> Limits:
    """The least of what was asked for."""
    period_s = max(radar.schedule.frame_period_s_actual for radar in rig.radars.values())
    asked = [args.frames] if args.frames else []
    if args.seconds:
        asked.append(max(1, math.ceil(args.seconds / period_s)))
    return Limits(min(asked) if asked else None, args.segments)


def _dry_run(plans: dict[str, list[str]], as_json: bool) -> int:
    if as_json:
        print(json.dumps({"plan": plans}, indent=2))
    else:
        print("\n".join(line for lines in plans.values() for line in lines))
    return ExitCode.OK


def _report(live: session.Session, road: Road) -> int:
    """Account, boards, exit code."""
    accounts = {radar: ledger.snapshot() for radar, ledger in live.pipeline.ledgers.items()}
    if not any(account.frames_in for account in accounts.values()):
        live.notes.append("there was not a single radar frame")
    live.report(road.figures())
    degraded = bool(road.faults)
    for radar, account in accounts.items():
        edge_frames = EDGE_S / live.rig.radars[radar].schedule.frame_period_s_actual
        edges = sum(account.lost.get(cause, 0) for cause in AT_THE_EDGES)
        degraded |= not account.frames_in or account.frames_lost > edges or edges > edge_frames
    return live.exit_code(ExitCode.DEGRADED if degraded else ExitCode.OK)
