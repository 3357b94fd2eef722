# SPDX-License-Identifier: Apache-2.0
"""A drive past one object, as raw frames of both radars: point scatterers on the object's visible surface.

It is the smallest scene that exercises the whole road, not the physical simulator: no edges, ground paths, antenna
coupling or polarisation. Scatterers are isotropic except that they fade with the angle of incidence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.config import AntennaSettings, RigGeometry, require
from edge.frames import RADARS, Float64, Pose, RadarFrame, RadarId
from edge.reference.point_targets import make_frame

if TYPE_CHECKING:
    from edge.rig import Radar

OCCLUSION_DEPTH_M = 0.15
"""A point is hidden when the surface in its direction is nearer by more than this."""
DIRECTION_CELL_RAD = np.radians(1.5)
SURFACE_POINTS = 40_000


@dataclass(frozen=True, slots=True)
class DriveBy:
    """Parameters of the scene; the vehicle drives along +x of the odometry frame, its radars look to the left (+y).

    Args:
        frames: frames of each radar.
        frame_period_s: time between two kept frames of one radar; a multiple of the schedule's period.
        speed_m_s: of the vehicle.
        lateral_m: distance between the radars' track and the nearest point of the object.
        scatterers: point scatterers on the whole surface; about half of them are hidden at any time.
        reference_power_db: power of a unit scatterer at 1 m on boresight, dB over 1 LSB^2.
        noise_lsb: standard deviation of the receivers' noise per complex sample.
        seed: of everything random.
    """

    frames: int = 60
    frame_period_s: float = 0.1
    speed_m_s: float = 3.0 / 5.9
    lateral_m: float = 3.0
    scatterers: int = 500
    reference_power_db: float = 58.0
    noise_lsb: float = 25.0
    seed: int = 1

    def __post_init__(self) -> None:
        require(self.frames >= 2, "drive_by.frames", self.frames, ">= 2")
        require(self.frame_period_s > 0, "drive_by.frame_period_s", self.frame_period_s, "> 0 s")
        require(self.lateral_m > 0.5, "drive_by.lateral_m", self.lateral_m, "> 0.5 m")
        require(self.scatterers >= 1, "drive_by.scatterers", self.scatterers, ">= 1")


@dataclass(frozen=True, slots=True)
class Surface:
    """Points on an object's surface in the odometry frame.

    Args:
        points_m: float64 [n, 3].
        normals: float64 [n, 3], unit; the side is not trusted, a surface counts from both sides.
    """

    points_m: Float64
    normals: Float64


def sample_surface(vertices_m: Float64, faces: NDArray[np.int32], count: int, rng: np.random.Generator) -> Surface:
    """Points spread evenly over the area of a triangle mesh.

    Args:
        vertices_m: [v, 3] metres.
        faces: [f, 3] indices of vertices.
        count: points.
        rng: their generator.
    """
    corners = np.asarray(vertices_m, dtype=np.float64)[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    face = rng.choice(len(faces), size=count, p=double_area / double_area.sum())
    a, b = rng.random((2, count, 1))
    root = np.sqrt(a)
    points = (1 - root) * corners[face, 0] + root * (1 - b) * corners[face, 1] + root * b * corners[face, 2]
    return Surface(points, cross[face] / double_area[face, None])


def visible(points: Surface, surface: Surface, eye_m: Float64) -> NDArray[np.bool_]:
    """Which points are not hidden from ``eye_m`` by the surface, by the nearest sample of every direction cell.

    Args:
        points: the points asked about, [n].
        surface: dense samples that hide.
        eye_m: [3] view point.
    Returns:
        bool [n].
    """

    def cells(offset_m: Float64) -> tuple[NDArray[np.int64], Float64]:
        range_m = np.linalg.norm(offset_m, axis=1)
        azimuth = np.arctan2(offset_m[:, 1], offset_m[:, 0])
        elevation = np.arcsin(offset_m[:, 2] / range_m)
        columns = np.floor(azimuth / DIRECTION_CELL_RAD).astype(np.int64) + 512
        return columns * 1024 + np.floor(elevation / DIRECTION_CELL_RAD).astype(np.int64) + 512, range_m

    cell, range_m = cells(surface.points_m - eye_m)
    nearest_m = np.full(1024 * 1024, np.inf)
    np.minimum.at(nearest_m, cell, range_m)
    cell, range_m = cells(points.points_m - eye_m)
    return range_m <= nearest_m[cell] + OCCLUSION_DEPTH_M


def poses(scene: DriveBy, geometry: RigGeometry, rate_hz: float = 60.0) -> list[Pose]:
    """True poses of the rig, from just before the first frame to just after the last one.

    The odometry frame's origin lies on the ground below the rig's first position, z up.
    """
    half_turn_rad = np.radians(geometry.yaw_deg) / 2.0
    quaternion = np.array([0.0, 0.0, np.sin(half_turn_rad), np.cos(half_turn_rad)])
    duration_s = scene.frames * scene.frame_period_s
    count = int(np.ceil(duration_s * rate_hz)) + 2
    times_s = (np.arange(count) - 1) / rate_hz
    return [
        Pose(EPOCH_NS + round(t * 1e9), np.array([scene.speed_m_s * t, 0.0, geometry.height_m]), quaternion.copy())
        for t in times_s
    ]


EPOCH_NS = 1_000_000_000
"""Instant of the first frame; any will do."""


def place(vertices_m: Float64, scene: DriveBy, yaw_deg: float = 0.0) -> Float64:
    """The object beside the middle of the track: its nearest point at ``lateral_m`` to the left, standing on z = 0.

    Args:
        vertices_m: [v, 3], z up.
        scene: where the track is.
        yaw_deg: turn about z first.
    """
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    turned = np.asarray(vertices_m, dtype=np.float64) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    low, high = turned.min(axis=0), turned.max(axis=0)
    middle_m = 0.5 * scene.speed_m_s * (scene.frames - 1) * scene.frame_period_s
    shift_m = np.array([middle_m - 0.5 * (low[0] + high[0]), scene.lateral_m - low[1], -low[2]])
    return np.asarray(turned + shift_m)


class DriveByScene:
    """The rig drives past an object; any frame of any radar can be asked for, always with the same samples.

    Args:
        radars: radar id -> board; the vertical one fires half its schedule's period after the horizontal one.
        geometry: height and yaw of the rig.
        antenna: element pattern, applied to the direction of each scatterer from the rig.
        vertices_m, faces: the object in the odometry frame, see ``place``.
        settings: track, timing, levels.
    """

    def __init__(
        self,
        radars: Mapping[RadarId, Radar],
        geometry: RigGeometry,
        antenna: AntennaSettings,
        vertices_m: Float64,
        faces: NDArray[np.int32],
        settings: DriveBy,
    ) -> None:
        self.radars, self.settings, self._antenna, self._height_m = dict(radars), settings, antenna, geometry.height_m
        rng = np.random.default_rng(settings.seed)
        self._surface = sample_surface(vertices_m, faces, SURFACE_POINTS, rng)
        self._scatterers = sample_surface(vertices_m, faces, settings.scatterers, rng)
        phase = np.exp(2j * np.pi * rng.random(settings.scatterers))
        level_lsb = 10.0 ** (settings.reference_power_db / 20.0)
        self._strength = level_lsb * np.sqrt(rng.exponential(1.0, settings.scatterers)) * phase
        c, s = np.cos(np.radians(geometry.yaw_deg)), np.sin(np.radians(geometry.yaw_deg))
        self._axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        """Rows: the rig's x, y, z in the odometry frame."""
        self.velocity_rig_m_s = self._axes @ np.array([settings.speed_m_s, 0.0, 0.0])

    def frame(self, radar: RadarId, number: int) -> RadarFrame:
        """Raw frame ``number`` of one radar."""
        settings, points = self.settings, self._scatterers
        late = radar == "vertical" and len(self.radars) > 1
        delay_s = 0.5 * self.radars[radar].schedule.frame_period_s if late else 0.0
        time_s = number * settings.frame_period_s + delay_s
        eye_m = np.array([settings.speed_m_s * time_s, 0.0, self._height_m])
        seen = visible(points, self._surface, eye_m)
        offset_m = points.points_m[seen] - eye_m
        range_m = np.linalg.norm(offset_m, axis=1)
        towards = offset_m / range_m[:, None]
        incidence = np.abs(np.einsum("ij,ij->i", towards, points.normals[seen]))
        gain = antenna_amplitude(radar, towards @ self._axes.T, self._antenna)
        amplitude = self._strength[seen] * incidence * gain / range_m**2
        return make_frame(
            *(self.radars[radar], offset_m @ self._axes.T, amplitude, number, EPOCH_NS + round(time_s * 1e9)),
            *(self.velocity_rig_m_s, settings.noise_lsb),
            rng=np.random.default_rng((settings.seed, number, RADARS.index(radar))),
        )


def antenna_amplitude(radar: str, direction: Float64, antenna: AntennaSettings) -> Float64:
    """Two-way amplitude factor of the element pattern in both planes.

    Args:
        radar: "horizontal" or "vertical".
        direction: [n, 3] unit vectors in the rig frame.
        antenna: loss in dB = loss * (angle / edge)^2 in each plane, capped.
    """
    lateral_deg = np.degrees(np.arcsin(np.clip(direction[:, 1], -1.0, 1.0)))
    vertical_deg = np.degrees(np.arcsin(np.clip(direction[:, 2], -1.0, 1.0)))
    along, across = (lateral_deg, vertical_deg) if radar == "horizontal" else (vertical_deg, lateral_deg)
    along_db = np.minimum(antenna.along_loss_db * (along / antenna.along_edge_deg) ** 2, antenna.max_loss_db)
    across_db = np.minimum(antenna.across_loss_db * (across / antenna.across_edge_deg) ** 2, antenna.max_loss_db)
    return np.asarray(10.0 ** (-2.0 * (along_db + across_db) / 20.0))
