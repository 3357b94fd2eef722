# SPDX-License-Identifier: Apache-2.0
"""The whole road on a scene whose answer is known: static points, moving rig."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pipeline_scenes import (
    NOISE_LSB,
    PERIOD_NS,
    RIG,
    T0_NS,
    TRUTH_ODOM_M,
    Item,
    Keep,
    columns,
    frames_of,
    in_time_order,
    lost,
    pose_at,
    run,
    scene_poses,
)

from edge.errors import ModelError
from edge.frames import FusedCloud, ObjectCloud
from edge.odometry.transforms import transform_points
from edge.pipeline import Pipeline

FRAMES = 12


@pytest.fixture(scope="module")
def items() -> list[Item]:
    frames = frames_of(FRAMES)
    return in_time_order(scene_poses(FRAMES), frames["horizontal"], frames["vertical"])


@pytest.fixture(scope="module")
def kept(items: list[Item]) -> Keep:
    pipeline, keep = run(items)
    assert lost(pipeline) == {}
    return keep


def results(keep: Keep) -> bytes:
    detections = b"".join(columns(list(result.detections.values())) for result in keep.frames)
    points = [r.cloud.xyz_m.tobytes() + r.cloud.power_db.tobytes() for r in keep.frames if r.cloud is not None]
    return detections + b"".join(points) + b"".join(window.cloud.xyz_m.tobytes() for window in keep.windows)


def distance_to_truth_m(cloud: FusedCloud) -> Any:
    odom_m = transform_points(cloud.reference, cloud.xyz_m.astype(np.float64))
    return np.linalg.norm(odom_m[:, None] - TRUTH_ODOM_M, axis=2)


def test_points_lie_where_the_scatterers_are(kept: Keep) -> None:
    (window,) = kept.windows
    cloud = window.cloud
    assert (cloud.frames, cloud.reference.t_ns, cloud.complete) == (FRAMES, T0_NS, False)
    assert cloud.travel_m == pytest.approx(3.0 * (FRAMES - 1) * PERIOD_NS / 1e9, abs=1e-3)
    distance_m = distance_to_truth_m(cloud)
    near = distance_m.min(axis=1) < 0.03
    assert np.count_nonzero(~near) <= 0.03 * len(cloud)
    assert np.bincount(distance_m.argmin(axis=1)[near], minlength=len(TRUTH_ODOM_M)).min() >= 0.6 * FRAMES


def test_frames_carry_numbers_instants_and_poses(kept: Keep) -> None:
    assert [result.number for result in kept.frames] == list(range(FRAMES))
    for result in kept.frames:
        assert result.pose is not None
        assert result.pose.position_m == pytest.approx(pose_at(result.t_ns).position_m, abs=1e-9)
        assert all(d.number == result.number for d in result.detections.values())


def test_the_same_input_twice_gives_the_same_bytes(items: list[Item], kept: Keep) -> None:
    assert results(run(items)[1]) == results(kept)


def test_poses_may_come_late_or_early(items: list[Item], kept: Keep) -> None:
    ahead = [item for item in items if not hasattr(item, "adc")] + [item for item in items if hasattr(item, "adc")]
    _, keep = run(ahead)
    for one, other in zip(kept.frames, keep.frames, strict=True):
        assert one.cloud is not None
        assert other.cloud is not None
        np.testing.assert_allclose(one.cloud.xyz_m, other.cloud.xyz_m, atol=1e-4)


class Withholding:
    """A completion that fails."""

    asked = 0

    def complete(self, cloud: ObjectCloud) -> None:
        self.asked += 1
        raise ModelError(f"object {cloud.identity}: no shape")


def test_nothing_before_the_completion_depends_on_it(items: list[Item], kept: Keep) -> None:
    settings = replace(RIG.settings, objects=replace(RIG.settings.objects, min_points=3, core_points=2))
    rig, model = replace(RIG, settings=settings), Withholding()
    pipeline, keep = run(items, Pipeline(rig, model))  # type: ignore[arg-type]
    assert model.asked == pipeline.faults.shapes_withheld >= 1
    assert "no shape" in pipeline.faults.last
    assert results(keep) == results(kept)


def test_a_stronger_scene_gives_the_same_places(kept: Keep) -> None:
    """Twice the signal and twice the noise: 6 dB more everywhere, nothing else."""
    assert NOISE_LSB > 10  # rounding of the ADC does not count
    frames = frames_of(3)
    doubled = {radar: [replace(f, adc=(2 * f.adc).astype(np.int16)) for f in frames[radar]] for radar in frames}
    _, keep = run(in_time_order(scene_poses(3), *doubled.values()))
    for once, twice in zip(kept.frames[:2], keep.frames[:2], strict=True):
        for radar, found in once.detections.items():
            np.testing.assert_allclose(twice.detections[radar].range_m, found.range_m, rtol=1e-5)
            np.testing.assert_allclose(twice.detections[radar].power_db, found.power_db + 6.0206, atol=1e-3)


def test_one_radar_gives_heatmaps_and_detections_without_poses(items: list[Item], kept: Keep) -> None:
    rig = replace(RIG, radars={"vertical": RIG.radars["vertical"]})
    frames = [item for item in items if getattr(item, "radar", None) == "vertical"]
    pipeline, keep = run(frames, Pipeline(rig, None))
    assert lost(pipeline) == {}
    assert [result.number for result in keep.frames] == list(range(FRAMES))
    assert keep.windows == []
    assert all(result.cloud is None and result.pose is None for result in keep.frames)


def test_one_radar_uses_poses_that_come(items: list[Item], kept: Keep) -> None:
    """The motion's phases are undone in both rigs alike: the heatmaps are the same."""
    rig = replace(RIG, radars={"horizontal": RIG.radars["horizontal"]})
    alone = [item for item in items if getattr(item, "radar", "horizontal") == "horizontal"]
    _, keep = run(alone, Pipeline(rig, None))
    assert [result.number for result in keep.frames] == list(range(FRAMES))
    for one, other in zip(kept.frames, keep.frames, strict=True):
        reference = one.heatmaps["horizontal"].power
        np.testing.assert_allclose(other.heatmaps["horizontal"].power, reference, atol=1e-4 * float(reference.max()))
