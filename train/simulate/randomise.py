# SPDX-License-Identifier: Apache-2.0
"""Domain randomisation: the settings of a drive-by drawn from ranges and a seed."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, fields

import numpy as np

from edge.config import AntennaSettings, WindowName, require
from train.simulate.front_end import FrontEndSettings
from train.simulate.ground import GroundSettings
from train.simulate.link_budget import LinkSettings
from train.simulate.odometry_error import OdometrySettings
from train.simulate.optics import OpticsSettings
from train.simulate.settings import ProcessingSettings, SceneSettings, SimulationSettings, TrackSettings
from train.simulate.surface_settings import SurfaceSettings

Range = tuple[float, float]
FRAME_PERIOD_S = 1.0 / 60.0


@dataclass(frozen=True, slots=True)
class Ranges:
    """What a drive-by is drawn from; pairs are the ends of a uniform draw, shares are probabilities.

    Every value has its own generator, from the seed and its name: a range that changes moves no other value.

    Args:
        frames: of each radar over the whole track, before every n-th is taken.
        travel_m: length of the track; the speed follows, kept inside ``speed_m_s`` by fewer or more metres.
        speed_m_s: least and largest speed.
        heading_deg: of the track against the line that the objects were placed along.
        height_m: of the rig above the ground.
        side_m: from the track to the nearest point of the object.
        along_m: middle of the object beyond the middle of the track.
        yaw_deg: heading of the object.
        neighbours: fewest and most other objects. gap_m: least distance between boxes.
        wall_share: how often there is a wall. wall_m: distance behind the rearmost object.
        mover_share: how often someone passes. mover_m_s: speed.
        noise_lsb: of a complex sample, rms; only scales all amplitudes. noise_figure_db, gain_dbi: link budget.
        across_loss_db, across_edge_deg: true antenna pattern across the array; the pipeline believes the rig's.
        gain_spread_db, residual_deg, leakage: channel mismatch, calibration error, leakage over noise.
        start_jitter_share, second_harmonic_share, phase_noise_share, iq_image_share: how often a board has this fault;
            start_jitter_s, second_harmonic_dbc, phase_noise_dbc_hz, iq_image_db: how much of it, see
            ``FrontEndSettings``. Nobody has measured them on these boards: none by default.
        ground_share: how often there is ground. permittivity, ground_roughness_m, clutter_db: of it.
        reflection_db, diffuse_db, points_db, imbalance_scale, phong: surface.
        walk_m, yaw_walk_deg, tilt_deg, time_offset_s, mounting_deg, mounting_m: odometry; see ``OdometrySettings``.
        windows, p_fa, ground_margin_m: tapers, false-alarm probabilities and lowest heights of points to choose from.
            focus_share: how often the near field is focused.
    """

    frames: tuple[int, int] = (300, 400)
    travel_m: Range = (2.0, 4.0)
    speed_m_s: Range = (0.3, 1.5)
    heading_deg: Range = (-5.0, 5.0)
    height_m: Range = (0.4, 1.2)
    side_m: Range = (3.0, 10.0)
    along_m: Range = (-0.7, 0.7)
    yaw_deg: Range = (0.0, 360.0)
    neighbours: tuple[int, int] = (0, 2)
    gap_m: Range = (0.8, 2.5)
    wall_share: float = 0.3
    wall_m: Range = (0.5, 3.0)
    mover_share: float = 0.15
    mover_m_s: Range = (0.7, 4.0)
    noise_lsb: Range = (5.0, 30.0)
    noise_figure_db: Range = (12.0, 15.0)
    gain_dbi: Range = (9.0, 11.0)
    across_loss_db: Range = (4.0, 8.0)
    across_edge_deg: Range = (15.0, 25.0)
    gain_spread_db: Range = (1.2, 3.9)
    residual_deg: Range = (0.0, 6.0)
    leakage: Range = (25.0, 95.0)
    start_jitter_share: float = 0.0
    start_jitter_s: Range = (0.0, 1.1e-9)
    second_harmonic_share: float = 0.0
    second_harmonic_dbc: Range = (-80.0, -55.0)
    phase_noise_share: float = 0.0
    phase_noise_dbc_hz: Range = (-97.0, -91.0)
    iq_image_share: float = 0.0
    iq_image_db: Range = (-45.0, -30.0)
    ground_share: float = 1.0
    permittivity: Range = (3.0, 5.0)
    ground_roughness_m: Range = (0.3e-3, 2e-3)
    clutter_db: Range = (-36.0, -22.0)
    reflection_db: Range = (-3.0, 0.0)
    diffuse_db: Range = (-3.0, 3.0)
    points_db: Range = (-3.0, 3.0)
    imbalance_scale: Range = (0.5, 1.5)
    phong: Range = (0.0, 0.6)
    walk_m: Range = (0.003, 0.012)
    yaw_walk_deg: Range = (0.06, 0.3)
    tilt_deg: Range = (0.0, 0.3)
    time_offset_s: Range = (-0.02, 0.02)
    mounting_deg: Range = (-0.5, 0.5)
    mounting_m: Range = (-0.005, 0.005)
    windows: tuple[WindowName, ...] = ("taylor", "taylor", "hann")
    p_fa: tuple[float, ...] = (1e-5, 1e-5, 1e-6, 1e-8)
    ground_margin_m: tuple[float, ...] = (0.0, 0.1)
    focus_share: float = 1.0

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            value = getattr(self, name)
            if name in ("windows", "p_fa", "ground_margin_m"):
                require(len(value) > 0, f"ranges.{name}", value, "at least one")
            elif name.endswith("_share"):
                require(0 <= value <= 1, f"ranges.{name}", value, "0..1")
            else:
                require(value[0] <= value[1], f"ranges.{name}", value, "lowest <= highest")
        require(self.frames[0] >= 2, "ranges.frames", self.frames, ">= 2")
        require(self.travel_m[0] > 0, "ranges.travel_m", self.travel_m, "> 0 m")
        require(self.speed_m_s[0] > 0, "ranges.speed_m_s", self.speed_m_s, "> 0")


class _Draw:
    """Values of one seed, each independent of all others."""

    def __init__(self, ranges: Ranges, seed: int) -> None:
        self._ranges, self._seed = ranges, seed

    def _rng(self, name: str) -> np.random.Generator:
        return np.random.default_rng((self._seed, zlib.crc32(name.encode())))

    def uniform(self, name: str) -> float:
        return float(self._rng(name).uniform(*getattr(self._ranges, name)))

    def log_uniform(self, name: str) -> float:
        low, high = getattr(self._ranges, name)
        return float(math.exp(self._rng(name).uniform(math.log(low), math.log(high))))

    def three(self, name: str) -> tuple[float, float, float]:
        low, high = getattr(self._ranges, name)
        x, y, z = self._rng(name).uniform(low, high, 3).tolist()
        return x, y, z

    def whole(self, name: str) -> int:
        low, high = getattr(self._ranges, name)
        return int(self._rng(name).integers(low, high + 1))

    def happens(self, name: str) -> bool:
        return bool(self._rng(name).random() < getattr(self._ranges, name))

    def sometimes(self, name: str, share: str) -> float | None:
        return self.uniform(name) if self.happens(share) else None

    def index(self, name: str) -> int:
        return int(self._rng(name).integers(len(getattr(self._ranges, name))))


def draw(ranges: Ranges, seed: int, frame_period_s: float = FRAME_PERIOD_S) -> SimulationSettings:
    """Settings of the drive-by number ``seed``; the same on every machine.

    Args:
        ranges: what to draw from.
        seed: of every value.
        frame_period_s: of the rig's schedule; the speed follows from it.
    """
    take = _Draw(ranges, seed)
    return SimulationSettings(
        track=_track(take, ranges, frame_period_s),
        scene=SceneSettings(
            side_m=take.uniform("side_m"),
            along_m=take.uniform("along_m"),
            yaw_deg=take.uniform("yaw_deg"),
            neighbours=take.whole("neighbours"),
            gap_m=take.uniform("gap_m"),
            wall_m=take.sometimes("wall_m", "wall_share") or 0.0,
            mover_speed_m_s=take.sometimes("mover_m_s", "mover_share") or 0.0,
        ),
        surface=SurfaceSettings(
            reflection_db=take.uniform("reflection_db"),
            diffuse_db=take.uniform("diffuse_db"),
            points_db=take.uniform("points_db"),
            imbalance_scale=take.uniform("imbalance_scale"),
            phong=take.uniform("phong"),
        ),
        optics=OpticsSettings(
            ground=GroundSettings(
                enabled=take.happens("ground_share"),
                permittivity=take.uniform("permittivity"),
                roughness_m=take.log_uniform("ground_roughness_m"),
                clutter_db=take.uniform("clutter_db"),
            )
        ),
        link=LinkSettings(noise_figure_db=take.uniform("noise_figure_db"), gain_dbi=take.uniform("gain_dbi")),
        antenna=AntennaSettings(
            across_loss_db=take.uniform("across_loss_db"), across_edge_deg=take.uniform("across_edge_deg")
        ),
        front_end=_front_end(take),
        odometry=OdometrySettings(
            walk_m=take.uniform("walk_m"),
            yaw_walk_deg=take.uniform("yaw_walk_deg"),
            tilt_deg=take.uniform("tilt_deg"),
            time_offset_s=take.uniform("time_offset_s"),
            mounting_deg=take.three("mounting_deg"),
            mounting_m=take.three("mounting_m"),
        ),
        processing=ProcessingSettings(
            ranges.windows[take.index("windows")],
            ranges.p_fa[take.index("p_fa")],
            take.happens("focus_share"),
            ranges.ground_margin_m[take.index("ground_margin_m")],
        ),
    )


def _track(take: _Draw, ranges: Ranges, frame_period_s: float) -> TrackSettings:
    frames = take.whole("frames")
    speed_m_s = take.uniform("travel_m") / (frames * frame_period_s)
    return TrackSettings(
        frames=frames,
        speed_m_s=float(np.clip(speed_m_s, *ranges.speed_m_s)),
        heading_deg=take.uniform("heading_deg"),
        height_m=take.uniform("height_m"),
    )


def _front_end(take: _Draw) -> FrontEndSettings:
    return FrontEndSettings(
        noise_lsb=take.log_uniform("noise_lsb"),
        gain_spread_db=take.uniform("gain_spread_db"),
        residual_deg=take.uniform("residual_deg"),
        leakage=take.uniform("leakage"),
        start_jitter_s=take.sometimes("start_jitter_s", "start_jitter_share") or 0.0,
        second_harmonic_dbc=take.sometimes("second_harmonic_dbc", "second_harmonic_share"),
        phase_noise_dbc_hz=take.sometimes("phase_noise_dbc_hz", "phase_noise_share"),
        iq_image_db=take.sometimes("iq_image_db", "iq_image_share"),
    )
