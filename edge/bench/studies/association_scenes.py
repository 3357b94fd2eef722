# SPDX-License-Identifier: Apache-2.0
"""Scenes with known truth for the association study: point reflectors as detections or raw frames, drives past objects.

Levels follow what signal chains see: reflectors of 6 dB spread in strength, range law of the fourth power, element
pattern, fading and mounting that differ between the boards, detections that only one radar has, multipath copies.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import edge
from edge.config import AntennaSettings
from edge.dsp.antenna import across_loss_db
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.frames import RADARS, Detections, Float64, RadarId
from edge.reference.drive_by import DriveBy, DriveByScene, antenna_amplitude, place, sample_surface
from edge.reference.point_targets import make_frame
from edge.rig import Rig

MIDDLE_M, NEAREST_M, REFERENCE_M = 6.0, 2.0, 5.0
DOPPLER_M_S = 0.1
"""Standard deviation of a radial speed."""
STRENGTH_DB, SPREAD_DB = 30.0, 6.0
"""SNR of a mean reflector on boresight at the reference range; standard deviation of reflectors."""
RESOLUTION = (1.5, 0.03)
"""Of two detections of a radar nearer than this many range bins and this much cosine the weaker one is not seen."""


@dataclass(frozen=True, slots=True)
class Level:
    """How hard a detection-level scene is.

    Args:
        name: of the row in the table.
        targets: reflectors in view.
        depth_m: they lie within this stretch of range.
        fading_db: standard deviation of each board's own fading of a reflector (aspect, polarisation).
        offset_db: power offset of the vertical board that no calibration removed.
        ghosts: detections without counterpart and multipath copies per reflector and radar.
        jitter_bins: standard deviation of a detection's range, in range bins.
        pattern: true loss across the arrays over the modelled one.
        speed_m_s: the rig drives sideways; its radars measure radial speeds; 0: they do not.
    """

    name: str
    targets: int = 20
    depth_m: float = 10.0
    fading_db: float = 3.0
    offset_db: float = 0.0
    ghosts: float = 0.3
    jitter_bins: float = 0.05
    pattern: float = 1.0
    speed_m_s: float = 0.0


LEVELS = (
    Level("5 reflectors", targets=5),
    Level("20 reflectors"),
    Level("60 reflectors", targets=60),
    Level("20 within 2 m", depth_m=2.0),
    Level("60 within 4 m, ghosts 0.6", targets=60, depth_m=4.0, ghosts=0.6),
    Level("no ghosts", ghosts=0.0),
    Level("no fading", fading_db=0.0),
    Level("fading 6 dB", fading_db=6.0),
    Level("boards 3 dB apart", offset_db=3.0),
    Level("boards 6 dB apart", offset_db=6.0),
    Level("range jitter 0.15 bin", jitter_bins=0.15),
    Level("half the modelled pattern", pattern=0.5),
    Level("60 within 4 m, Doppler at 1 m/s", targets=60, depth_m=4.0, ghosts=0.6, speed_m_s=1.0),
    Level("60 within 4 m, Doppler at 5 m/s", targets=60, depth_m=4.0, ghosts=0.6, speed_m_s=5.0),
)


@dataclass(frozen=True, slots=True)
class Scene:
    """One frame pair and the truth.

    Args:
        horizontal, vertical: detections.
        velocity_rig_m_s: float64 [3].
        truth_m: float64 [k, 3], reflectors or surface samples in the rig frame of the horizontal burst.
        sought: bool [k], those that an association can find: both radars detect them.
    """

    horizontal: Detections
    vertical: Detections
    velocity_rig_m_s: Float64
    truth_m: Float64
    sought: NDArray[np.bool_]


def _reflectors(rng: np.random.Generator, targets: int, depth_m: float, height_m: float) -> Float64:
    """Positions [targets, 3] from the ground to 2.3 m above it, within +-37 degrees of boresight."""
    range_m = rng.uniform(max(NEAREST_M, MIDDLE_M - 0.5 * depth_m), MIDDLE_M + 0.5 * depth_m, targets)
    u, z = rng.uniform(-0.6, 0.6, targets), rng.uniform(-height_m, 2.3 - height_m, targets)
    x = np.sqrt(np.maximum(range_m**2 * (1.0 - u**2) - z**2, 0.1))
    return np.stack([x, range_m * u, z], axis=1)


def _measured(
    points_m: Float64, strength_db: Float64, board_m: Float64, axis: int, antenna: AntennaSettings
) -> Float64:
    """Range, direction cosine, SNR and lateral cosine [n, 4] of points for a board whose array lies along ``axis``."""
    away = points_m - board_m
    range_m = np.linalg.norm(away, axis=1)
    cosine, across = away[:, axis] / range_m, away[:, 3 - axis] / range_m
    loss_db = 2.0 * across_loss_db(antenna, across) + 40.0 * np.log10(range_m / REFERENCE_M)
    return np.stack([range_m, cosine, strength_db - loss_db, away[:, 1] / range_m], axis=1)


def _resolved(rows: Float64, bin_m: float) -> NDArray[np.int64]:
    """Indices of the detectable rows (SNR above 0 dB) without a stronger neighbour, strongest first."""
    kept: list[int] = []
    for n in np.argsort(-rows[:, 2], kind="stable").tolist():
        near = [abs(rows[m, 0] - rows[n, 0]) < RESOLUTION[0] * bin_m for m in kept]
        beside = [abs(rows[m, 1] - rows[n, 1]) < RESOLUTION[1] for m in kept]
        if rows[n, 2] > 0.0 and not any(a and b for a, b in zip(near, beside, strict=True)):
            kept.append(n)
    return np.array(kept, dtype=np.int64)


def detections(radar: RadarId, rows: Float64, speed_m_s: Float64 | None = None) -> Detections:
    """Columns from rows of range, direction cosine and power; radial speeds when they were measured."""
    columns = [np.ascontiguousarray(column) for column in rows.astype(np.float32).T]
    nothing = np.full(len(rows), np.nan, dtype=np.float32)
    speed = nothing if speed_m_s is None else speed_m_s.astype(np.float32)
    return Detections(radar, 0, 0, columns[0], columns[1], columns[2], speed, columns[2])


def detection_scene(rng: np.random.Generator, level: Level, rig: Rig) -> Scene:
    """One scene of point reflectors at the level of detections; half of the ghosts are multipath, half are anything."""
    count, height_m = level.targets, rig.geometry.height_m
    loss_db = level.pattern * rig.settings.antenna.across_loss_db
    antenna = replace(rig.settings.antenna, across_loss_db=loss_db)
    truth_m = _reflectors(rng, count, level.depth_m, height_m)
    strength_db = STRENGTH_DB + rng.normal(0.0, SPREAD_DB, count)
    mirrored = rng.random(count) < 0.5 * level.ghosts
    below_m = truth_m[mirrored] * [1.0, 1.0, -1.0] - [0.0, 0.0, 2.0 * height_m]
    mirrored_db = strength_db[mirrored] - rng.normal(8.0, 3.0, len(below_m))
    found, seen = [], np.ones(count, dtype=np.bool_)
    for axis, radar in enumerate(RADARS, start=1):
        board, bin_m = rig.radars[radar], rig.radars[radar].schedule.profile.range_bin_m
        board_m = np.array(board.mounting.position_m)
        direct = _measured(truth_m, strength_db + rng.normal(0.0, level.fading_db, count), board_m, axis, antenna)
        mirror = _measured(
            below_m, mirrored_db + rng.normal(0.0, level.fading_db, len(below_m)), board_m, axis, antenna
        )
        late = direct[rng.random(count) < 0.25 * level.ghosts]
        late[:, 0] += rng.uniform(0.15, 1.0, len(late))
        late[:, 2] -= rng.uniform(4.0, 15.0, len(late))
        alone = rng.poisson(0.5 * level.ghosts * count)
        span = (direct[:, 0].min(), direct[:, 0].max())
        noise = np.stack([rng.uniform(*span, alone), *rng.uniform(-0.7, 0.7, (3, alone))], axis=1)
        noise[:, 2] = rng.exponential(6.0, alone)
        rows = np.concatenate([direct, mirror, late, noise])
        rows[:, 0] += rng.normal(0.0, level.jitter_bins * bin_m, len(rows))
        rows[:, 1] += rng.normal(0.0, 0.002, len(rows))
        rows[:, 2] += level.offset_db * (radar == "vertical")
        kept = _resolved(rows, bin_m)
        seen &= np.isin(np.arange(count), kept)
        speed = rng.normal(-level.speed_m_s * rows[kept, 3], DOPPLER_M_S) if level.speed_m_s else None
        found.append(detections(radar, rows[kept, :3], speed))
    return Scene(found[0], found[1], np.zeros(3), truth_m, seen)


@dataclass(frozen=True, slots=True)
class Raw:
    """A set of scenes that go through imager and detector.

    Args:
        name: of the row in the table.
        targets, depth_m: as in Level.
        power_db: of a mean reflector at 1 m, dB over 1 LSB^2.
        phase_deg: standard deviation of the channels' phases that calibration left.
        speed_m_s: the rig drives sideways.
    """

    name: str
    targets: int
    depth_m: float
    power_db: float
    phase_deg: float
    speed_m_s: float = 0.0


RAWS = (
    Raw("10 weak", 10, 8.0, 62.0, 3.0),
    Raw("10 strong", 10, 8.0, 75.0, 3.0),
    Raw("30 strong", 30, 8.0, 75.0, 3.0),
    Raw("30 strong within 3 m", 30, 3.0, 75.0, 3.0),
    Raw("10 strong, perfect calibration", 10, 8.0, 75.0, 0.0),
)
MOVING = (
    Raw("30 within 3 m, 1 m/s", 30, 3.0, 70.0, 3.0, 1.0),
    Raw("30 within 3 m, 5 m/s", 30, 3.0, 70.0, 3.0, 5.0),
    Raw("30 within 8 m, 5 m/s", 30, 8.0, 70.0, 3.0, 5.0),
)


def raw_scenes(rng: np.random.Generator, raw: Raw, rig: Rig, count: int) -> Iterator[Scene]:
    """Scenes of point reflectors as raw frames of both radars with noise, mismatch and fading of 3 dB a board."""
    imagers = {r: Imager(rig.radars[r], rig.settings.heatmap, rig.settings.antenna) for r in RADARS}
    detectors = {r: Detector(rig.radars[r], rig.settings.cfar) for r in RADARS}
    for number in range(count):
        truth_m = _reflectors(rng, raw.targets, raw.depth_m, rig.geometry.height_m)
        strength_db = raw.power_db + rng.normal(0.0, SPREAD_DB, raw.targets)
        velocity, found = np.array([0.0, raw.speed_m_s, 0.0]), []
        for radar in RADARS:
            board = rig.radars[radar]
            delay_s = 0.5 * board.schedule.frame_period_s * (radar == "vertical")
            points_m = truth_m - velocity * delay_s
            direction = points_m / np.linalg.norm(points_m, axis=1, keepdims=True)
            faded = 10.0 ** ((strength_db + rng.normal(0.0, 3.0, raw.targets)) / 20.0)
            faded = faded * np.exp(2j * np.pi * rng.random(raw.targets)) / np.sum(points_m**2, axis=1)
            amplitude = faded * antenna_amplitude(radar, direction, rig.settings.antenna)
            channels = (board.schedule.layout.slots, board.schedule.layout.devices * board.schedule.layout.rx)
            frame = make_frame(
                *(board, points_m, amplitude, number, round(delay_s * 1e9), velocity, 25.0, rng),
                channel_gain=np.exp(1j * np.radians(raw.phase_deg) * rng.standard_normal(channels)),
            )
            found.append(detectors[radar].process(imagers[radar].process(frame, velocity)))
        yield Scene(found[0], found[1], velocity, truth_m, np.ones(raw.targets, dtype=np.bool_))


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive past one object.

    Args:
        name: of the row in the table.
        scenes: a frame pair each; truth and sought are empty.
        period_s: between frames.
        axes, shift_m: points [n, 3] of frame k lie at p @ axes + shift_m[k] in the odometry frame.
        surface_m: float64 [n, 3], dense samples of the true surface, odometry frame.
    """

    name: str
    scenes: list[Scene]
    period_s: float
    axes: Float64
    shift_m: Float64
    surface_m: Float64


def drives(rig: Rig) -> Iterator[Drive]:
    """A car at three distances and headings, and a person."""
    with np.load(Path(edge.__file__).parent / "reference" / "demo_car.npz", allow_pickle=False) as mesh:
        car = mesh["vertices"].astype(np.float64), mesh["faces"].astype(np.int32)
    yield drive("car at 3 m", rig, car, DriveBy(), 0.0)
    yield drive("car at 6 m, turned 30 deg", rig, car, DriveBy(lateral_m=6.0, seed=2), 30.0)
    yield drive("car at 4 m, turned 70 deg", rig, car, DriveBy(lateral_m=4.0, seed=4), 70.0)
    yield drive("person at 4 m", rig, person(), DriveBy(lateral_m=4.0, scatterers=200, seed=3), 20.0)


def drive(name: str, rig: Rig, mesh: tuple[Float64, NDArray[np.int32]], settings: DriveBy, yaw_deg: float) -> Drive:
    """All frame pairs of a drive as detections."""
    vertices, faces = place(mesh[0], settings, yaw_deg), mesh[1]
    world = DriveByScene(rig.radars, rig.geometry, rig.settings.antenna, vertices, faces, settings)
    imagers: dict[RadarId, Any] = {r: Imager(rig.radars[r], rig.settings.heatmap, rig.settings.antenna) for r in RADARS}
    detectors = {r: Detector(rig.radars[r], rig.settings.cfar) for r in RADARS}
    velocity, nothing = world.velocity_rig_m_s, np.zeros((0, 3))
    scenes = []
    for number in range(settings.frames):
        found = [detectors[r].process(imagers[r].process(world.frame(r, number), velocity)) for r in RADARS]
        scenes.append(Scene(found[0], found[1], velocity, nothing, np.zeros(0, dtype=np.bool_)))
    along_m = np.arange(settings.frames) * settings.frame_period_s * settings.speed_m_s
    shift_m = np.stack([along_m, np.zeros_like(along_m), np.full_like(along_m, rig.geometry.height_m)], axis=1)
    yaw = np.radians(rig.geometry.yaw_deg)
    axes = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    surface = sample_surface(vertices, faces, 20_000, np.random.default_rng(0))
    return Drive(name, scenes, settings.frame_period_s, axes, shift_m, surface.points_m)


def person() -> tuple[Float64, NDArray[np.int32]]:
    """A standing person of ellipsoids: head, trunk, arms, legs; vertices [v, 3] in metres and faces [f, 3]."""
    parts = [((0.0, 0.0, 1.62), (0.09, 0.08, 0.12)), ((0.0, 0.0, 1.15), (0.12, 0.2, 0.36))]
    parts += [((0.0, side * 0.27, 1.1), (0.06, 0.06, 0.34)) for side in (-1, 1)]
    parts += [((0.0, side * 0.1, 0.42), (0.09, 0.09, 0.43)) for side in (-1, 1)]
    lon, lat = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 17), np.linspace(-0.5 * np.pi, 0.5 * np.pi, 9))
    ball = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1).reshape(-1, 3)
    corner = (np.arange(8)[:, None] * 17 + np.arange(16)).ravel()
    lower = np.stack([corner, corner + 1, corner + 18], axis=1)
    upper = np.stack([corner, corner + 18, corner + 17], axis=1)
    faces = np.concatenate([lower[16:], upper[:-16]])  # without the triangles that a pole squeezes to nothing
    vertices = [ball * np.array(size) + np.array(centre) for centre, size in parts]
    indices = [faces + n * len(ball) for n in range(len(parts))]
    return np.concatenate(vertices), np.concatenate(indices).astype(np.int32)
