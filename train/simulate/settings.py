# SPDX-License-Identifier: Apache-2.0
"""Settings of a simulated drive-by, group by group; read from TOML as ``rig.toml`` is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from edge.config import AntennaSettings, WindowName, require
from edge.rig import Rig
from edge.rig_toml import Place, fill, read_toml
from train.simulate.front_end import FrontEndSettings
from train.simulate.link_budget import LinkSettings
from train.simulate.odometry_error import OdometrySettings
from train.simulate.optics import OpticsSettings
from train.simulate.surface_settings import SurfaceSettings


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """How the vehicle passes.

    Args:
        frames: of each radar over the whole track, at the schedule's rate.
        frame_period_s: time between two of them; None: the schedule's.
        every: only each n-th frame is made, numbered from 0 without gaps.
        speed_m_s: of the vehicle, constant.
        heading_deg: its heading off +x, about the middle of the track.
        height_m: of the rig's origin above the ground, true.
        pose_rate_hz: of the reported poses.
    """

    frames: int = 360
    frame_period_s: float | None = None
    every: int = 1
    speed_m_s: float = 0.5
    heading_deg: float = 0.0
    height_m: float = 0.8
    pose_rate_hz: float = 60.0

    def __post_init__(self) -> None:
        require(1 <= self.every <= self.frames, "track.every", self.every, f"1..frames ({self.frames})")
        require(
            self.frame_period_s is None or self.frame_period_s > 0, "track.frame_period_s", self.frame_period_s, ">0"
        )
        require(abs(self.speed_m_s) <= 40, "track.speed_m_s", self.speed_m_s, "-40..40")
        require(0.1 <= self.height_m <= 5, "track.height_m", self.height_m, "0.1..5 m")
        require(1 <= self.pose_rate_hz <= 1000, "track.pose_rate_hz", self.pose_rate_hz, "1..1000")


@dataclass(frozen=True, slots=True)
class SceneSettings:
    """What stands where; distances are between bounding boxes on the ground.

    Args:
        side_m: from the track to the nearest point of the object.
        along_m: middle of the object beyond the middle of the track, along the track.
        yaw_deg: heading of the object; 0 looks along the track.
        neighbours: other objects beside, before or behind it.
        gap_m: least distance of a neighbour from the object and from the others.
        wall_m: a wall this far behind the object; 0: none.
        mover_speed_m_s: speed of a pedestrian or bicycle that crosses the scene; 0: nothing moves.
    """

    side_m: float = 4.0
    along_m: float = 0.0
    yaw_deg: float = 0.0
    neighbours: int = 0
    gap_m: float = 1.0
    wall_m: float = 0.0
    mover_speed_m_s: float = 0.0

    def __post_init__(self) -> None:
        require(0.5 <= self.side_m <= 50, "scene.side_m", self.side_m, "0.5..50 m")
        require(0 <= self.neighbours <= 8, "scene.neighbours", self.neighbours, "0..8")
        require(self.gap_m > 0, "scene.gap_m", self.gap_m, "> 0 m")
        require(self.wall_m >= 0, "scene.wall_m", self.wall_m, ">= 0 m (0 = none)")


@dataclass(frozen=True, slots=True)
class ProcessingSettings:
    """What of the rig's own processing is set otherwise, so that a network meets more than one tuning.

    Args:
        window: taper of range and angle; None: the rig's.
        p_fa: designed false-alarm probability of the CFAR; 0: the rig's.
        focus: near-field focusing.
        ground_margin_m: points lower than this above the ground are removed; None: the rig's.
    """

    window: WindowName | None = None
    p_fa: float = 0.0
    focus: bool = True
    ground_margin_m: float | None = None

    def applied(self, rig: Rig) -> Rig:
        """The rig with these settings."""
        heatmap, cfar, association = rig.settings.heatmap, rig.settings.cfar, rig.settings.association
        if self.window is not None:
            heatmap = replace(heatmap, range_window=self.window, angle_window=self.window)
        heatmap = replace(heatmap, focus=heatmap.focus and self.focus)
        cfar = replace(cfar, p_fa=self.p_fa or cfar.p_fa)
        if self.ground_margin_m is not None:
            association = replace(association, ground_margin_m=self.ground_margin_m)
        return replace(rig, settings=replace(rig.settings, heatmap=heatmap, cfar=cfar, association=association))


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """Everything that decides a drive-by but its objects, its rig and its seed.

    Args:
        track, scene: where the vehicle and the objects are.
        surface: how the object reflects.
        optics: what of it is seen, ground and clutter.
        link: transmit power to amplitude.
        antenna: the true element pattern; the pipeline goes on believing the rig's own.
        front_end: noise, leakage, mismatch, calibration error.
        odometry: errors of the reported poses.
        processing: of the pipeline.
    """

    track: TrackSettings = field(default_factory=TrackSettings)
    scene: SceneSettings = field(default_factory=SceneSettings)
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    optics: OpticsSettings = field(default_factory=OpticsSettings)
    link: LinkSettings = field(default_factory=LinkSettings)
    antenna: AntennaSettings = field(default_factory=AntennaSettings)
    front_end: FrontEndSettings = field(default_factory=FrontEndSettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    processing: ProcessingSettings = field(default_factory=ProcessingSettings)


def read_settings(path: Path) -> SimulationSettings:
    """Settings from a TOML file with a table for every group; what it does not name keeps its default.

    Raises:
        ConfigError: unreadable, unknown key, wrong type or unit, or a value that cannot work; file and key are named.
    """
    return fill(SimulationSettings, read_toml(path), Place(path))
