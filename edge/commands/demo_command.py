# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct demo``: the whole road on a small simulated scene, with the truth to compare with."""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from edge.commands import session
from edge.commands.demo_scene import SCENE, DemoObject, demo_object, demo_recording
from edge.errors import ExitCode
from edge.frames import Float32, Shape
from edge.odometry.transforms import transform_points
from edge.recording.reader import RecordingReader
from edge.reference.chamfer import chamfer_l1_m
from edge.rig import load_rig

RIG = "cascade_demo"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    session.add_arguments(parser, speed="1")


def run(args: argparse.Namespace) -> int:
    """Make the recording unless it is cached, play it, compare the shape with the truth."""
    start_s = time.monotonic()
    rig, thing = load_rig(RIG), demo_object()
    if not args.json:
        print(f"simulated: {SCENE.scatterers} point scatterers on {thing.credit}; rig {RIG}", flush=True)
    path = demo_recording(rig, thing, SCENE)
    if not args.json:
        print(f"recording: {path}, {SCENE.frames} frames of each radar", flush=True)
    run = session.Session(
        *(rig, args, "sim", f"simulated drive-by of {thing.credit}", ["simulated radar data"]), thing.truth_odom_m()
    )
    with RecordingReader(path) as reader:
        run.run(reader, reader.total_frames)
    run.report(_closing(run, thing, time.monotonic() - start_s))
    return run.exit_code(ExitCode.OK if run.tally.shapes else ExitCode.DEGRADED)


def _closing(run: session.Session, thing: DemoObject, elapsed_s: float) -> dict[str, Any]:
    """How near the best shape comes to the truth, and how near the radar points alone would have been."""
    closing: dict[str, Any] = {"elapsed_s": round(elapsed_s, 1), "simulated": True}
    if run.tally.shapes:
        best = max(run.tally.shapes.values(), key=lambda shape: shape.confidence)
        truth_m = thing.truth_odom_m()
        closing["shape_to_truth_chamfer_cm"] = _distance_cm(best, best.fine_m, truth_m)
        closing["radar_points_to_truth_chamfer_cm"] = _distance_cm(best, best.input.xyz_m, truth_m)
    return closing


def _distance_cm(shape: Shape, points_m: Float32, truth_odom_m: Float32) -> float:
    placed_m = transform_points(shape.input.pose, np.asarray(points_m, dtype=np.float64))
    return round(100.0 * chamfer_l1_m(placed_m, truth_odom_m), 2)
