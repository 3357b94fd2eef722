# SPDX-License-Identifier: Apache-2.0
"""Radar cross-sections of surfaces: ``python -m train.simulate.rcs`` shows those of the object library over the yaw.

The amplitudes are the simulator's own, added in float64 with their exact two-way paths; no ground, no antenna pattern.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from edge.errors import ConfigError
from edge.frames import Float64
from train.objects.library import default_objects_dir, read_manifest
from train.objects.mesh import CLASSES
from train.simulate.ground import GroundSettings
from train.simulate.kernels_optics import SEEN
from train.simulate.optics_settings import OpticsSettings
from train.simulate.surface import Surface, SurfaceSettings, make_surface
from train.simulate.visibility import SceneVisibility, Sight, View
from train.simulate.weights import Entries, Weigher

WAVELENGTH_M = 0.003807
"""Of the shipped waveform at the middle of its ADC window."""
SECTORS = {"front, back": (0.0, 180.0), "sides": (90.0, 270.0)}
LITERATURE = {
    ("car", "front, back"): "0 to 10",
    ("car", "sides"): "10 to 20",
    ("pedestrian", "front, back"): "about -8",
    ("pedestrian", "sides"): "about -8",
}
"""Far-field figures in dBsm that are often quoted for 77 GHz; pedestrians: JRC report EUR 25762."""
SECTOR_DEG = 20.0
"""Half width of a sector of yaws."""


class CrossSection:
    """Monostatic cross-section of one surface alone in free space.

    Args:
        surface: the object.
        settings: limits; the ground is not used.
        hidden: leave out what the object hides of itself.
    """

    def __init__(self, surface: Surface, settings: OpticsSettings | None = None, hidden: bool = True) -> None:
        settings = settings or OpticsSettings(keep_db=60.0, max_scatterers=1_000_000)
        self._settings = replace(settings, ground=GroundSettings(enabled=False))
        self._weigher = Weigher([surface], self._settings, surface.wavelength_m)
        self._visibility = SceneVisibility([surface], *settings.picture) if hidden else None
        self._surface = surface

    def entries(self, eye_m: Float64) -> Entries:
        """Scattering amplitudes towards a radar at ``eye_m`` [3], frame of the object."""
        eye = np.append(np.asarray(eye_m, dtype=np.float64), -eye_m[2])
        candidates = self._weigher.candidates(0, eye, 0.0)
        none, every = np.empty((0, 3), np.float32), np.full(len(candidates), SEEN, np.uint8)
        sight = Sight(candidates, every, np.full(len(self._surface.points), SEEN, np.uint8), every[:0])
        if self._visibility is not None:
            view = View(eye[:3], float(eye[3]), np.eye(3))
            sight = self._visibility.look(0, [view], [], False, candidates, none)
        return self._weigher.weigh(0, eye, sight)

    def amplitude(self, eye_m: Float64, reference_m: Float64) -> complex:
        """Root of the cross-section with its phase, as a point at ``reference_m`` [3] would show it, m."""
        entries = self.entries(eye_m)
        distance_m = np.linalg.norm(entries.position.astype(np.float64) - eye_m, axis=1)
        nearest_m = float(np.linalg.norm(np.asarray(reference_m) - eye_m))
        phase = np.exp(4j * np.pi / self._surface.wavelength_m * (distance_m - nearest_m))
        return complex(np.sum(entries.weight.astype(np.complex128) * phase * (nearest_m / distance_m) ** 2))

    def dbsm(self, eye_m: Float64, reference_m: Float64) -> float:
        """Cross-section, dB over 1 m^2."""
        return 20.0 * float(np.log10(max(abs(self.amplitude(eye_m, reference_m)), 1e-12)))


def over_yaw(surface: Surface, distance_m: float, height_m: float, yaws_deg: Float64, per_yaw: int) -> Float64:
    """Cross-sections dBsm [yaws, per_yaw] of an object at a distance from its nearest side; a yaw's are 2 mm apart.

    Args:
        surface: the object.
        distance_m: from the radar to the bounding circle of the object, at least 0.5 m to the ground plan's middle.
        height_m: of the radar.
        yaws_deg: bearings of the radar from the object's x axis.
        per_yaw: places along a line across the line of sight: the spread of the speckle.
    """
    section = CrossSection(surface)
    half = 0.5 * (surface.high_m - surface.low_m)
    result = np.empty((len(yaws_deg), per_yaw))
    for i, yaw in enumerate(np.radians(yaws_deg)):
        sight = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        depth_m = abs(sight[0]) * half[0] + abs(sight[1]) * half[1]
        across = np.array([-sight[1], sight[0], 0.0])
        for j in range(per_yaw):
            eye = sight * (distance_m + depth_m) + across * 2e-3 * (j - per_yaw / 2) + [0.0, 0.0, height_m]
            result[i, j] = section.dbsm(eye, sight * depth_m + [0.0, 0.0, half[2]])
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Print medians and deciles of the cross-section by class and side."""
    parser = argparse.ArgumentParser(prog="python -m train.simulate.rcs", description=__doc__)
    parser.add_argument("--objects", type=Path, default=default_objects_dir(), help="library folder")
    parser.add_argument("--per-class", type=int, default=6, help="objects of a class (default 6)")
    parser.add_argument("--distance", type=float, nargs="+", default=[5.0, 10.0], metavar="METRES")
    parser.add_argument("--height", type=float, default=0.8, help="of the radar, metres (default 0.8)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.objects is None:
        raise ConfigError("no object library on this machine", action="set RFCONSTRUCT_DATA or give --objects")
    entries = read_manifest(options.objects)
    print(
        "| class | distance | side | objects | 10 % | median | 90 % | literature |\n|---|---|---|---|---|---|---|---|"
    )
    for label, name in enumerate(CLASSES):
        found = [entry for entry in entries if entry.label == label and entry.provenance != "P"] or [
            entry for entry in entries if entry.label == label
        ]
        chosen = found[:: max(1, len(found) // options.per_class)][: options.per_class]
        for distance_m in options.distance:
            rng = np.random.default_rng(options.seed)
            surfaces = [make_surface(e.load(), SurfaceSettings(), distance_m, WAVELENGTH_M, rng) for e in chosen]
            for side, centers in SECTORS.items():
                yaws = np.concatenate([c + np.linspace(-SECTOR_DEG, SECTOR_DEG, 9) for c in centers])
                values = np.concatenate([over_yaw(s, distance_m, options.height, yaws, 4).ravel() for s in surfaces])
                low, middle, high = np.percentile(values, [10, 50, 90])
                known = LITERATURE.get((name, side), "")
                figures = f"{low:.1f} | {middle:.1f} | {high:.1f} | {known}"
                print(f"| {name} | {distance_m:g} m | {side} | {len(chosen)} | {figures} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
