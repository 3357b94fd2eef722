# SPDX-License-Identifier: Apache-2.0
"""The drive-by as a source: order, instants, any frame alone, true and reported poses, flat memory."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from edge.dsp.imager import Imager
from edge.errors import CaptureError
from edge.frames import Pose, RadarFrame
from edge.rig import Rig, load_rig
from edge.sources.base import FrameSource
from train.objects.mesh import Mesh
from train.objects.primitives import join, superellipsoid
from train.simulate.drive_by import EPOCH_NS, DriveBy
from train.simulate.ground import GroundSettings
from train.simulate.odometry_error import OdometrySettings
from train.simulate.optics import OpticsSettings
from train.simulate.settings import SimulationSettings, TrackSettings
from train.simulate.stages import SharedStages
from train.simulate.surface import Placed, make_surface
from train.simulate.surface_settings import SurfaceSettings

PLACE_M = np.array([0.4, 4.0, 0.8])
RADIUS_M = 0.1
OPTICS = OpticsSettings(ground=GroundSettings(enabled=False, clutter_points=0))
TRUTH = SimulationSettings(track=TrackSettings(12, speed_m_s=2.0), optics=OPTICS, odometry=OdometrySettings.none())
STAGES = SharedStages()


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("cascade_demo")


@pytest.fixture(scope="module")
def ball(rig: Rig) -> Placed:
    """A sphere of 10 cm whose centre is at PLACE_M."""
    mesh = Mesh(*join([superellipsoid((0.0, 0.0, 0.0), (RADIUS_M,) * 3)]), 0, "car/ball")
    wavelength_m = float(rig.radars["horizontal"].schedule.profile.wavelength_m)
    smooth = SurfaceSettings(phong=1.0, points_db=-40.0, diffuse_db=-40.0)
    surface = make_surface(mesh, smooth, 3.0, wavelength_m, np.random.default_rng(0))
    return Placed(surface, PLACE_M)


def drive(rig: Rig, ball: Placed, settings: SimulationSettings = TRUTH, seed: int = 1) -> DriveBy:
    return DriveBy(rig, [ball], settings, seed, STAGES.synthesizers(rig))


def test_frames_and_poses_come_in_time_order_the_vertical_radar_half_a_period_later(rig: Rig, ball: Placed) -> None:
    settings = replace(TRUTH, track=TrackSettings(8, every=3, speed_m_s=2.0))
    source = drive(rig, ball, settings)
    assert isinstance(source, FrameSource)
    items = list(source)
    instants = [item.t_ns if isinstance(item, Pose) else item.t_first_chirp_ns for item in items]
    assert instants == sorted(instants)
    frames = [item for item in items if isinstance(item, RadarFrame)]
    assert [(f.radar, f.number) for f in frames] == [(r, n) for n in range(3) for r in ("horizontal", "vertical")]
    assert source.total_frames == len(frames) == 6
    period_ns = rig.radars["horizontal"].schedule.frame_period_s * 1e9
    first = [f.t_first_chirp_ns for f in frames]
    np.testing.assert_allclose(np.array(first[2::2]) - first[0], [3 * period_ns, 6 * period_ns], atol=1.0)
    np.testing.assert_allclose(np.array(first[1::2]) - first[::2], 0.5 * period_ns, atol=1.0)
    assert isinstance(items[0], Pose)
    assert isinstance(items[-1], Pose)


def test_any_frame_can_be_made_again_alone(rig: Rig, ball: Placed) -> None:
    frames = {(f.radar, f.number): f for f in drive(rig, ball) if isinstance(f, RadarFrame)}
    alone = drive(rig, ball)
    for key in (("vertical", 11), ("horizontal", 3)):
        again = alone.frame(*key)
        assert (again.adc == frames[key].adc).all()
        assert again.t_first_chirp_ns == frames[key].t_first_chirp_ns
    assert not (drive(rig, ball, seed=2).frame("horizontal", 3).adc == frames["horizontal", 3].adc).all()
    with pytest.raises(CaptureError, match="no such frame"):
        alone.frame("horizontal", 12)


def test_frames_are_made_only_when_they_are_asked_for(rig: Rig, ball: Placed, monkeypatch: pytest.MonkeyPatch) -> None:
    source, asked = drive(rig, ball), []
    monkeypatch.setattr(DriveBy, "frame", lambda self, radar, number: asked.append((radar, number)))
    list(islice(source, 5))
    assert len(asked) <= 2


def test_the_ball_is_where_the_true_pose_puts_it(rig: Rig, ball: Placed) -> None:
    """Both radars, first and last frame: nearest point of the sphere, within a third of a range and an angle bin."""
    source = drive(rig, ball)
    for radar, axis in (("horizontal", 1), ("vertical", 2)):
        board = source.rig.radars[radar]
        imager = Imager(board, rig.settings.heatmap, rig.settings.antenna)
        for number in (0, source.frames - 1):
            frame = source.frame(radar, number)
            pose = source.true_pose(frame.t_first_chirp_ns)
            heatmap = imager.process(frame, np.array([0.0, -2.0, 0.0]))
            beyond = (heatmap.range_m > 1.0) & (heatmap.range_m < 12.0)  # leakage wraps into the last bins
            angle, ranges = np.unravel_index(np.argmax(heatmap.power[:, beyond]), heatmap.power[:, beyond].shape)
            towards_m = PLACE_M - pose.position_m  # rig axes: x is world y, y is minus world x
            local_m = np.array([towards_m[1], -towards_m[0], towards_m[2]]) - board.mounting.position_m
            range_m = np.linalg.norm(local_m) - RADIUS_M
            bin_m = float(heatmap.range_m[1] - heatmap.range_m[0])
            assert heatmap.range_m[beyond][ranges] == pytest.approx(range_m, abs=0.75 * bin_m)
            cosine = local_m[axis] / np.linalg.norm(local_m)
            assert heatmap.direction_cosine[angle] == pytest.approx(cosine, abs=0.006)


def test_poses_report_the_truth_or_their_error(rig: Rig, ball: Placed) -> None:
    settings = replace(TRUTH, track=replace(TRUTH.track, heading_deg=5.0, height_m=1.1))
    exact = drive(rig, ball, settings)
    for t_ns in (EPOCH_NS, EPOCH_NS + 123_456_789):
        a, b = exact.true_pose(t_ns), exact.reported_pose(t_ns)
        np.testing.assert_allclose(a.position_m, b.position_m, atol=1e-7)
        np.testing.assert_allclose(a.quaternion_xyzw, b.quaternion_xyzw, atol=1e-9)
    travel_m = exact.true_pose(EPOCH_NS + 10**8).position_m - exact.true_pose(EPOCH_NS).position_m
    np.testing.assert_allclose(travel_m, 0.2 * np.array([np.cos(np.radians(5)), np.sin(np.radians(5)), 0]), atol=1e-9)
    assert exact.rig.geometry.height_m == 1.1
    late = OdometrySettings(0.0, 0.0, 0.0, 0.0, time_offset_s=0.01, mounting_m=(0.0, 0.0, 0.05))
    wrong = drive(rig, ball, replace(settings, odometry=late))
    expected_m = exact.true_pose(EPOCH_NS + 10**7).position_m + np.array([0.0, 0.0, 0.05])
    np.testing.assert_allclose(wrong.reported_pose(EPOCH_NS).position_m, expected_m, atol=1e-7)
    assert wrong.rig.geometry.height_m == pytest.approx(1.15)


def test_every_frame_has_a_velocity_and_errors_do_not_touch_the_samples(rig: Rig, ball: Placed) -> None:
    exact, wrong = drive(rig, ball), drive(rig, ball, replace(TRUTH, odometry=OdometrySettings()))
    assert exact.poses[0].t_ns < exact.span_ns[0]
    assert exact.poses[-1].t_ns > exact.t_first_chirp_ns("vertical", exact.frames - 1)
    assert (exact.frame("vertical", 5).adc == wrong.frame("vertical", 5).adc).all()
    assert (exact.poses[-1].position_m != wrong.poses[-1].position_m).any()


def test_memory_stays_flat_over_many_drive_bys(rig: Rig, ball: Placed) -> None:
    def resident_bytes() -> int:
        return 4096 * int(Path("/proc/self/statm").read_text().split()[1])

    if not Path("/proc/self/statm").is_file():
        pytest.skip("resident memory is read from /proc")

    def some(count: int, first: int) -> None:
        for seed in range(first, first + count):
            for _ in drive(rig, ball, seed=seed):
                pass

    some(4, 0)
    before = resident_bytes()
    some(20, 4)  # 480 frames of 196 kB: 94 MB if they were kept
    assert resident_bytes() - before < 16 << 20
