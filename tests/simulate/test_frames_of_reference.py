# SPDX-License-Identifier: Apache-2.0
"""From the world through both boards and the whole pipeline back into the world: points end where they stand.

Nothing stands straight: the rig looks 78 degrees to the left, 5 down and 3 over, the vehicle drives at 4 degrees off x,
the boards are half a metre apart and off in every axis, one is turned round, ranges and powers have offsets.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.config import Mounting, RigGeometry
from edge.dsp.antenna import across_loss_db
from edge.dsp.imager import Imager
from edge.frames import RADARS, Detections, Float64, PointCloud, RadarId
from edge.odometry.transforms import rotation_matrix, transform_points
from edge.pipeline import FrameResult, Pipeline, WindowResult
from edge.rig import Rig, load_rig
from tests.simulate.plain_surfaces import point_surface
from train.simulate.drive_by import DriveBy
from train.simulate.front_end import FrontEndSettings
from train.simulate.ground import GroundSettings
from train.simulate.link_budget import snr_db
from train.simulate.odometry_error import OdometrySettings
from train.simulate.optics import OpticsSettings
from train.simulate.settings import SimulationSettings, TrackSettings
from train.simulate.surface import Placed

SIGMA_M2 = 0.3
STANDING_M = np.array([0.9, 4.2, 0.7])
TURNED_M, IN_ITS_FRAME_M, YAW_RAD = np.array([0.0, 7.5, 0.0]), (0.8, -0.3, 1.3), 2.1
WALKING_M, WALK_M_S = np.array([0.2, 6.0, 0.9]), np.array([0.9, -0.3, 0.0])
SETTINGS = SimulationSettings(
    track=TrackSettings(90, speed_m_s=1.0, heading_deg=4.0, height_m=0.9),
    optics=OpticsSettings(ground=GroundSettings(enabled=False, clutter_points=0)),
    front_end=FrontEndSettings.ideal(25.0),
    odometry=OdometrySettings.none(),
)


@pytest.fixture(scope="module")
def rig() -> Rig:
    plain = load_rig("cascade_demo")
    geometry = replace(plain.geometry, yaw_deg=78.0, pitch_deg=5.0, roll_deg=3.0)
    mounting: dict[RadarId, Mounting] = {
        "horizontal": Mounting((0.05, 0.25, -0.06), range_offset_m=0.12),
        "vertical": Mounting((-0.04, -0.22, 0.2), power_offset_db=4.0, array_sign=-1),
    }
    boards = {radar: replace(board, mounting=mounting[radar]) for radar, board in plain.radars.items()}
    fusion = replace(plain.settings.fusion, travel_m=0.5, min_frames=10)
    return replace(plain, geometry=geometry, radars=boards, settings=replace(plain.settings, fusion=fusion))


class Kept:
    """A sink that keeps everything."""

    def __init__(self) -> None:
        self.clouds: list[PointCloud] = []
        self.detections: list[dict[RadarId, Detections]] = []
        self.windows: list[WindowResult] = []

    def frame(self, result: FrameResult) -> None:
        assert result.cloud is not None
        self.clouds.append(result.cloud)
        self.detections.append(dict(result.detections))

    def window(self, result: WindowResult) -> None:
        self.windows.append(result)


def drive(rig: Rig, placed: list[Placed]) -> tuple[DriveBy, Kept]:
    made, kept = DriveBy(rig, placed, SETTINGS, 1), Kept()
    pipeline = Pipeline(made.rig, None, [kept])
    for item in made:
        pipeline.feed(item)
    pipeline.finish()
    assert len(kept.clouds) == made.frames
    return made, kept


def test_standing_points_end_in_the_fused_cloud_where_they_are(rig: Rig) -> None:
    turned = Placed(point_surface(IN_ITS_FRAME_M, SIGMA_M2), TURNED_M, YAW_RAD)
    _, kept = drive(rig, [Placed(point_surface((0.0, 0.0, 0.0), SIGMA_M2), STANDING_M), turned])
    places_m = [STANDING_M, turned.rotation @ np.array(IN_ITS_FRAME_M) + TURNED_M]
    assert kept.windows
    for window in kept.windows:
        found_m = transform_points(window.cloud.reference, window.cloud.xyz_m)
        apart_m = np.linalg.norm(found_m[:, None] - np.array(places_m), axis=2)
        assert apart_m.min(axis=1).max() < 0.05
        assert ((apart_m < 0.05).sum(axis=0) >= 0.9 * window.cloud.frames).all()


def test_a_walking_point_is_seen_where_it_is_in_every_frame(rig: Rig) -> None:
    made, kept = drive(rig, [Placed(point_surface((0.0, 0.0, 0.0), SIGMA_M2), WALKING_M, 0.5, WALK_M_S)])
    off_m: list[Float64] = []
    for cloud in kept.clouds:
        found_m = transform_points(made.true_pose(cloud.t_ns), cloud.xyz_m)
        off_m.extend(found_m - (WALKING_M + WALK_M_S * made.seconds(cloud.t_ns)))
    away_m = np.linalg.norm(off_m, axis=1)
    assert np.count_nonzero(away_m < 0.05) >= 0.95 * made.frames
    assert np.count_nonzero(away_m >= 0.05) <= 0.02 * made.frames  # a chance pair of sidelobes
    assert np.abs(np.median(off_m, axis=0)).max() < 0.01


def test_both_boards_see_a_point_at_the_level_of_their_geometry(rig: Rig) -> None:
    """Own-array pattern taken out by the imager; range and pattern across it as seen from each board."""
    made, kept = drive(rig, [Placed(point_surface((0.0, 0.0, 0.0), SIGMA_M2), STANDING_M)])
    across: dict[RadarId, int] = {"horizontal": 2, "vertical": 1}
    constant_db: dict[RadarId, list[float]] = {radar: [] for radar in RADARS}
    for number, found in enumerate(kept.detections):
        for radar, seen in found.items():
            mounting = rig.radars[radar].mounting
            pose = made.true_pose(made.t_first_chirp_ns(radar, number))
            away_m = (STANDING_M - pose.position_m) @ rotation_matrix(pose.quaternion_xyzw) - mounting.position_m
            range_m = float(np.linalg.norm(away_m))
            loss_db = 2 * float(across_loss_db(SETTINGS.antenna, away_m[across[radar]] / range_m))
            level_db = float(seen.power_db.max()) + mounting.power_offset_db
            constant_db[radar].append(level_db + loss_db + 40 * np.log10(range_m))
    for values in constant_db.values():
        assert len(values) == made.frames
        assert np.std(values) < 0.3
    assert np.mean(constant_db["horizontal"]) == pytest.approx(np.mean(constant_db["vertical"]), abs=0.15)


@pytest.mark.parametrize("radar", RADARS)
def test_a_point_stands_over_the_heatmap_s_noise_as_the_link_budget_says(rig: Rig, radar: RadarId) -> None:
    """1 m2 ahead: sample's ratio, times 256 samples, times 86^2 / (28 + 58 / 2) elements of which 58 are averaged."""
    heatmap = replace(rig.settings.heatmap, range_window="rectangular", angle_window="rectangular")
    board = replace(rig.radars[radar], mounting=Mounting())
    profile = board.schedule.profile
    range_m = 84 * float(profile.range_bin_m)
    plain = replace(rig, radars={radar: board}, geometry=RigGeometry(yaw_deg=0.0))
    still = replace(SETTINGS, track=TrackSettings(2, speed_m_s=0.0), front_end=FrontEndSettings.ideal(20.0))
    ahead = Placed(point_surface((0.0, 0.0, 0.0), 1.0), np.array([range_m, 0.0, still.track.height_m]))
    power = []
    for placed in ([ahead], []):
        made = DriveBy(plain, placed, still, 3)
        imager = Imager(made.rig.radars[radar], heatmap, rig.settings.antenna)
        shown = imager.process(made.frame(radar, 0))
        power.append(shown.power[np.abs(shown.direction_cosine) < 0.1])  # elsewhere noise is lifted with the pattern
    peak, noise = float(power[0].max()), float(power[1].mean(dtype=np.float64))
    link = replace(still.link, bandwidth_hz=float(profile.sample_rate_hz))
    expected_db = snr_db(link, float(profile.wavelength_m), 1.0, range_m) + 10 * np.log10(256 * 86**2 / (28 + 58 / 2))
    assert 10 * np.log10(peak / noise) == pytest.approx(expected_db, abs=0.3)


def test_boards_far_from_the_rig_s_origin_never_see_beyond_their_reach(rig: Rig) -> None:
    boards = {
        radar: replace(board, mounting=Mounting((-0.9, 0.8, 0.1), range_offset_m=-0.2))
        for radar, board in rig.radars.items()
    }
    settings = replace(SETTINGS, optics=OpticsSettings(ground=GroundSettings(clutter_db=0.0)))
    made = DriveBy(replace(rig, radars=boards), [], settings, 1)
    for number in range(0, made.frames, 10):
        for radar in boards:
            made.frame(radar, number)
