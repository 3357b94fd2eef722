# SPDX-License-Identifier: Apache-2.0
"""CPU time of surfaces and optics on the object library: ``python -m train.simulate.optics_speed``."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edge.config import AntennaSettings
from edge.errors import ConfigError
from edge.frames import RADARS
from train.objects.library import default_objects_dir, read_manifest
from train.objects.mesh import CLASSES
from train.simulate.link_budget import LinkSettings
from train.simulate.optics import OpticsSettings, Placed, SceneOptics
from train.simulate.rcs import WAVELENGTH_M
from train.simulate.surface import SurfaceSettings, make_surface

LOOK_LEFT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
STEP_M, FRAMES = 0.027, 110
"""Every third frame of a drive-by of 3 m."""
YAWS_DEG = (15.0, 70.0, 140.0)
REPEATS = 3


def drive(placed: Sequence[Placed]) -> tuple[float, float]:
    """CPU milliseconds for a pair of bursts, and mean number of scatterers of one radar, over one drive-by."""
    optics = SceneOptics(
        placed, OpticsSettings(), LinkSettings(), AntennaSettings(), WAVELENGTH_M, 25.0, np.random.default_rng(0)
    )
    velocity, scatterers, spent_s = np.array([1.6, 0.0, 0.0]), 0, 0.0
    for frame in range(FRAMES):
        for late, radar in enumerate(RADARS):
            position = np.array([STEP_M * (frame + 0.5 * late), 0.0, 0.8])
            begin_s = time.process_time()
            found, _ = optics.scatterers(radar, 0.0, position, LOOK_LEFT, velocity, 14.0)
            spent_s += time.process_time() - begin_s
            scatterers += len(found)
    return 1e3 * spent_s / FRAMES, scatterers / (2 * FRAMES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table of times; the least of several runs, the mean over yaws."""
    parser = argparse.ArgumentParser(prog="python -m train.simulate.optics_speed", description=__doc__)
    parser.add_argument("--objects", type=Path, default=default_objects_dir(), help="library folder")
    parser.add_argument("--side", type=float, default=4.0, help="track to the nearest side, metres (default 4)")
    options = parser.parse_args(arguments)
    if options.objects is None:
        raise ConfigError("no object library on this machine", action="set RFCONSTRUCT_DATA or give --objects")
    entries = read_manifest(options.objects)
    print(
        "| object | triangles | patches | prepare, ms | scatterers | ms a pair of bursts |\n|---|---|---|---|---|---|"
    )
    for label in range(len(CLASSES)):
        of_class = [entry for entry in entries if entry.label == label and entry.provenance != "P"]
        of_class = of_class or [entry for entry in entries if entry.label == label]
        for entry in (of_class[0], of_class[len(of_class) // 2]):
            mesh = entry.load()
            make_surface(mesh, SurfaceSettings(), options.side, WAVELENGTH_M, np.random.default_rng(0))
            begin_s = time.process_time()
            surface = make_surface(mesh, SurfaceSettings(), options.side, WAVELENGTH_M, np.random.default_rng(0))
            prepare_ms = 1e3 * (time.process_time() - begin_s)
            runs = []
            for yaw in map(math.radians, YAWS_DEG):
                half = 0.5 * mesh.size_m
                depth_m = abs(math.sin(yaw)) * half[0] + abs(math.cos(yaw)) * half[1]
                placed = Placed(surface, np.array([1.5, options.side + depth_m, 0.0]), yaw)
                runs.append(min(drive([placed]) for _ in range(REPEATS)))
            pair_ms, scatterers = np.mean(runs, axis=0)
            figures = (
                f"{len(mesh.faces)} | {len(surface.patches)} | {prepare_ms:.0f} | {scatterers:.0f} | {pair_ms:.1f}"
            )
            print(f"| {entry.object_id} | {figures} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
