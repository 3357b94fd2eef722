# SPDX-License-Identifier: Apache-2.0
"""A drive past objects as a source of frames and poses, exactly as a recording gives them, made while it is read."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from edge.errors import CaptureError
from edge.frames import RADARS, Float64, Pose, RadarFrame, RadarId
from edge.odometry.track import PoseTrack
from edge.odometry.transforms import multiply, rotation_matrix
from edge.odometry.vehicle import rig_in_vehicle
from edge.rig import Radar, Rig
from edge.sources.base import Loss
from edge.timing import StageTimes
from train.simulate.front_end import FrontEnd
from train.simulate.odometry_error import reported_poses
from train.simulate.optics import SceneOptics
from train.simulate.scatterers import GroundPlane, Scatterers
from train.simulate.settings import SimulationSettings
from train.simulate.settings import TrackSettings as TrackSettings
from train.simulate.surface import Placed
from train.simulate.synthesis import Synthesizer

EPOCH_NS = 1_000_000_000
"""Instant of the first frame; any will do."""
POSES_BEFORE, POSES_AFTER = 3, 4
"""Poses before the first and after the last frame, so that every frame has a velocity."""
NS_PER_S = 1_000_000_000


class DriveBy:
    """The rig drives along a straight line; any frame of any radar can be asked for, always with the same samples.

    World is the frame of reference of ``placed``: z up, ground z = 0. The track's middle lies above (travel / 2, 0);
    without ``heading_deg`` it runs along +x and begins above the origin.

    Args:
        rig: radars and how they are processed; its height above the ground becomes that of the track (plus the
            mounting error), its calibrations those of this drive-by's front ends.
        placed: objects.
        settings: of everything; the link's bandwidth is the rig's sampling rate.
        seed: of everything random that the settings do not say.
        synthesizers: radar id -> one made for the same board and schedule before; None: made here.
    Attributes:
        rig: as the pipeline must know it.
        frames: of each radar.
        times: of the stages "optics" and "synthesis", one measurement for every frame made.
    """

    def __init__(
        self,
        rig: Rig,
        placed: Sequence[Placed],
        settings: SimulationSettings,
        seed: int,
        synthesizers: Mapping[RadarId, Synthesizer] | None = None,
    ) -> None:
        track = settings.track
        self.settings, self.seed, self.placed = settings, seed, tuple(placed)
        self.times = StageTimes()
        self.frames = -(-track.frames // track.every)
        schedules = {radar: board.schedule for radar, board in rig.radars.items()}
        self._period_s = track.frame_period_s or max(s.frame_period_s for s in schedules.values())
        self._late_s = 0.5 * self._period_s if len(rig.radars) == len(RADARS) else 0.0
        self._front_ends = {radar: FrontEnd(board, settings.front_end, seed) for radar, board in rig.radars.items()}
        self.rig = self._calibrated(rig)
        self._attitude = _attitude(rig, track.heading_deg)
        self._rotation = rotation_matrix(self._attitude)
        self._velocity_m_s = track.speed_m_s * _direction(track.heading_deg)
        middle_m = 0.5 * track.speed_m_s * track.frames * self._period_s
        self._start_m = np.array([middle_m, 0.0, track.height_m]) - middle_m * _direction(track.heading_deg)
        self._synthesizers = synthesizers or {radar: Synthesizer(board) for radar, board in rig.radars.items()}
        profile = next(iter(schedules.values())).profile
        link = replace(settings.link, bandwidth_hz=float(profile.highest_beat_hz))
        self._optics = SceneOptics(
            *(self.placed, settings.optics, link, settings.antenna, float(profile.wavelength_m)),
            *(settings.front_end.noise_lsb, np.random.default_rng((seed, 1))),
        )
        self._poses = self._report()
        self._track = PoseTrack(1.0, keep_s=1e6, capacity=len(self._poses) + 1)
        for pose in self._poses:
            self._track.add(pose)

    @property
    def total_frames(self) -> int:
        """Frames of all radars."""
        return self.frames * len(self.rig.radars)

    @property
    def poses(self) -> list[Pose]:
        """Every reported pose of the rig."""
        return self._poses

    def __iter__(self) -> Iterator[RadarFrame | Pose | Loss]:
        """Frames and reported poses in time order; of equal instants the pose first."""
        instants = [(pose.t_ns, 0, -1, index) for index, pose in enumerate(self._poses)]
        for number in range(self.frames):
            instants += [(self.t_first_chirp_ns(r, number), 1, RADARS.index(r), number) for r in self.rig.radars]
        for _, kind, radar, index in sorted(instants):
            yield self._poses[index] if kind == 0 else self.frame(RADARS[radar], index)

    def close(self) -> None:
        """Nothing to release."""

    @property
    def span_ns(self) -> tuple[int, int]:
        """Instants of the first and the last frame of the radar that fires first."""
        radar = next(iter(self.rig.radars))
        return self.t_first_chirp_ns(radar, 0), self.t_first_chirp_ns(radar, self.frames - 1)

    @staticmethod
    def seconds(t_ns: int) -> float:
        """Time since the first frame."""
        return (t_ns - EPOCH_NS) / NS_PER_S

    def t_first_chirp_ns(self, radar: RadarId, number: int) -> int:
        """Instant of a frame: the vertical radar fires half a period after the horizontal one."""
        late_s = self._late_s if radar == "vertical" else 0.0
        return EPOCH_NS + round((number * self.settings.track.every * self._period_s + late_s) * NS_PER_S)

    def frame(self, radar: RadarId, number: int) -> RadarFrame:
        """Raw frame ``number`` of one radar; its samples are the caller's to keep.

        Raises:
            CaptureError: no such radar or frame.
        """
        scatterers, ground = self.scatterers(radar, number)
        t_ns = self.t_first_chirp_ns(radar, number)
        with self.times.measure("synthesis"):
            return self._synthesizers[radar].frame(scatterers, self._front_ends[radar], number, t_ns, ground)

    def scatterers(self, radar: RadarId, number: int) -> tuple[Scatterers, GroundPlane]:
        """What a frame is made of.

        Raises:
            CaptureError: no such radar or frame.
        """
        if radar not in self.rig.radars or not 0 <= number < self.frames:
            raise CaptureError(
                "this drive-by has no such frame", value=f"{radar} {number}", allowed=f"0..{self.frames - 1}"
            )
        t_ns, mounting = self.t_first_chirp_ns(radar, number), self.rig.radars[radar].mounting
        reach_m = self._synthesizers[radar].reach_m + min(mounting.range_offset_m, 0.0)
        with self.times.measure("optics"):
            return self._optics.scatterers(
                *(radar, self.seconds(t_ns), self._position_m(t_ns), self._rotation, self._velocity_m_s),
                *(reach_m, np.asarray(mounting.position_m)),
            )

    def true_pose(self, t_ns: int) -> Pose:
        """Where the rig is."""
        return Pose(t_ns, self._position_m(t_ns), self._attitude.copy())

    def reported_pose(self, t_ns: int) -> Pose:
        """Where the poses say that the rig is, interpolated as the pipeline does.

        Raises:
            CaptureError: outside the drive-by.
        """
        pose = self._track.at(t_ns)
        if pose is None:
            raise CaptureError("no pose at this instant", value=t_ns, allowed=self._track.why_none(t_ns))
        return pose

    def _position_m(self, t_ns: int) -> Float64:
        return self._start_m + self._velocity_m_s * self.seconds(t_ns)

    def _calibrated(self, rig: Rig) -> Rig:
        height_m = self.settings.track.height_m + self.settings.odometry.mounting_m[2]
        boards: dict[RadarId, Radar] = {
            radar: replace(board, calibration=self._front_ends[radar].calibration())
            for radar, board in rig.radars.items()
        }
        return replace(rig, radars=boards, geometry=replace(rig.geometry, height_m=height_m))

    def _report(self) -> list[Pose]:
        """Reported poses from just before the first frame to just after the last one."""
        track, odometry = self.settings.track, self.settings.odometry
        last_s = (self.frames - 1) * track.every * self._period_s + self._late_s
        count = math.ceil(last_s * track.pose_rate_hz) + POSES_BEFORE + POSES_AFTER
        time_s = (np.arange(count) - POSES_BEFORE) / track.pose_rate_hz
        position_m = self._start_m + (time_s + odometry.time_offset_s)[:, None] * self._velocity_m_s
        stamps = EPOCH_NS + np.rint(time_s * NS_PER_S).astype(np.int64)
        attitude = np.tile(self._attitude, (count, 1))
        return reported_poses(stamps, position_m, attitude, odometry, np.random.default_rng((self.seed, 2)))


def _direction(heading_deg: float) -> Float64:
    heading_rad = math.radians(heading_deg)
    return np.array([math.cos(heading_rad), math.sin(heading_rad), 0.0])


def _attitude(rig: Rig, heading_deg: float) -> Float64:
    """True attitude of the rig in the world, quaternion [4]."""
    half = math.radians(heading_deg) / 2.0
    return multiply(np.array([0.0, 0.0, math.sin(half), math.cos(half)]), rig_in_vehicle(rig.geometry)[1])
