# SPDX-License-Identifier: Apache-2.0
"""Pictures are real PNGs of plausible size, whatever little there is to draw."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import LOOKING_LEFT, RIG, T0_NS, Keep, frames_of, in_time_order, pose_at, run, scene_poses

from edge.best_shapes import MAX_SHAPES, keep_best
from edge.frames import Detections, Float32, FusedCloud, ObjectCloud, Pose, RadarId, Shape
from edge.pipeline import FrameResult, Pipeline, WindowResult
from edge.plot.collector import PictureCollector, single_radar_points, to_object_frame
from edge.plot.figure import drawable, new_figure, write

FRAMES = 3


@pytest.fixture(scope="module")
def kept() -> Keep:
    frames = frames_of(FRAMES)
    return run(in_time_order(scene_poses(FRAMES), frames["horizontal"], frames["vertical"]))[1]


def size(path: Path) -> tuple[int, int]:
    """Width and height of a PNG that is whole."""
    data = path.read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    assert data.endswith(b"IEND\xaeB`\x82")
    width, height = struct.unpack(">II", data[16:24])
    return int(width), int(height)


def cut(found: Detections, count: int) -> Detections:
    names = ("range_m", "direction_cosine", "power_db", "doppler_m_s", "snr_db")
    return replace(found, **{name: getattr(found, name)[:count] for name in names})


def with_detections(result: FrameResult, count: int) -> FrameResult:
    return replace(result, detections={radar: cut(found, count) for radar, found in result.detections.items()})


def with_points(cloud: FusedCloud, count: int) -> FusedCloud:
    columns = (cloud.xyz_m[:count], cloud.power_db[:count], cloud.frame_number[:count])
    return replace(cloud, xyz_m=columns[0], power_db=columns[1], frame_number=columns[2])


@pytest.mark.parametrize("detections", [0, 1])
def test_heatmaps_with_any_number_of_detections(kept: Keep, tmp_path: Path, detections: int) -> None:
    collector = PictureCollector(tmp_path, "scene")
    collector.frame(with_detections(kept.frames[0], detections))
    (path,) = collector.write()
    width, height = size(path)
    assert path.name == "heatmaps.png"
    assert 1200 < width < 2400
    assert 600 < height < 1600


def test_a_heatmap_of_silence(kept: Keep, tmp_path: Path) -> None:
    result = with_detections(kept.frames[0], 0)
    silent = {radar: replace(h, power=np.zeros_like(h.power)) for radar, h in result.heatmaps.items()}
    collector = PictureCollector(tmp_path, "silence")
    collector.frame(replace(result, heatmaps=silent))
    assert size(collector.write()[0])[0] > 1000


def test_one_radar(kept: Keep, tmp_path: Path) -> None:
    result = kept.frames[0]
    collector = PictureCollector(tmp_path, "one radar")
    one: RadarId = "vertical"
    alone = replace(result, heatmaps={one: result.heatmaps[one]}, detections={one: result.detections[one]})
    collector.frame(replace(alone, cloud=None, pose=None))
    assert [path.name for path in collector.write()] == ["heatmaps.png"]


@pytest.mark.parametrize("points", [1, 1000])
def test_clouds_of_any_size(kept: Keep, tmp_path: Path, points: int) -> None:
    collector = PictureCollector(tmp_path, "cloud")
    for result in kept.frames:
        collector.frame(with_detections(result, points))
    collector.window(WindowResult(with_points(kept.windows[0].cloud, points), [], []))
    paths = collector.write()
    assert [path.name for path in paths] == ["heatmaps.png", "fused_cloud.png"]
    width, height = size(paths[1])
    assert width == pytest.approx(1690, abs=2)
    assert 400 < height < 2000


def test_a_window_without_points_has_no_picture(kept: Keep, tmp_path: Path) -> None:
    collector = PictureCollector(tmp_path, "nothing")
    collector.window(WindowResult(with_points(kept.windows[0].cloud, 0), [], []))
    assert collector.write() == []


@pytest.mark.parametrize("truth", [True, False])
def test_shapes_even_flat_ones(kept: Keep, tmp_path: Path, truth: bool) -> None:
    cloud = kept.windows[0].cloud
    flat = np.zeros((64, 3), dtype=np.float32)
    pose = Pose(cloud.t_end_ns, np.zeros(3), LOOKING_LEFT)
    source = ObjectCloud(4, flat[:1], np.zeros(1, np.float32), pose, cloud.t_start_ns, cloud.t_end_ns,
                         cloud.travel_m, cloud.frames, False, np.full(3, np.nan))  # fmt: skip
    shape = Shape(4, "unknown", {"unknown": 1.0}, 0.0, flat, flat[:16], source, "0" * 16)
    collector = PictureCollector(tmp_path, "flat", flat if truth else None)
    collector.window(WindowResult(with_points(cloud, 0), [source], [shape]))
    (path,) = collector.write()
    assert path.name == "shape_4.png"
    assert size(path)[0] == pytest.approx(130 * 4.1 * (4 if truth else 3), abs=3)


def test_a_long_run_keeps_the_most_trusted_shapes_only() -> None:
    nothing = np.zeros((1, 3), np.float32)
    shapes: dict[int, Shape] = {}
    for n in range(3 * MAX_SHAPES):
        trust = (n * 37 % 101) / 101
        keep_best(shapes, Shape(n, "car", {"car": 1.0}, trust, nothing, nothing, None, ""))  # type: ignore[arg-type]
    best = sorted(((n * 37 % 101) / 101 for n in range(3 * MAX_SHAPES)), reverse=True)[:MAX_SHAPES]
    assert sorted((shape.confidence for shape in shapes.values()), reverse=True) == best
    keep_best(shapes, Shape(0, "car", {"car": 1.0}, 2.0, nothing, nothing, None, ""))  # type: ignore[arg-type]
    assert shapes[0].confidence == 2.0


def test_single_radar_points_stand_still_while_the_rig_drives(kept: Keep) -> None:
    """A target straight ahead and one 30 degrees to the left, seen from two places, seen from the first."""
    empty = np.zeros(0, np.float32)

    def found(r: Float32, u: Float32) -> Detections:
        nothing = np.zeros_like(r)
        return Detections("horizontal", 0, T0_NS, r, u, nothing, nothing, nothing)

    here, there = pose_at(T0_NS), pose_at(T0_NS + 10**9)
    moved_m = there.position_m[0] - here.position_m[0]
    ahead_m = np.array([4.0, 4.0 + moved_m])  # a target that is straight ahead later is to the right now: y = -moved
    first = found(np.hypot(ahead_m, [0.0, moved_m])[1:].astype(np.float32),
                  (-moved_m / np.hypot(ahead_m, [0.0, moved_m]))[1:].astype(np.float32))  # fmt: skip
    second = found(ahead_m[1:].astype(np.float32), np.zeros(1, np.float32))
    vertical = Detections("vertical", 0, T0_NS, empty, empty, empty, empty, empty)
    frames = [
        (here, {"horizontal": first, "vertical": vertical}),
        (there, {"horizontal": second, "vertical": vertical}),
    ]
    points = single_radar_points("horizontal", frames, here)  # type: ignore[arg-type]
    np.testing.assert_allclose(points[:, :3], np.tile([ahead_m[1], -moved_m, 0.0], (2, 1)), atol=1e-5)
    assert single_radar_points("vertical", frames, here).shape == (0, 4)  # type: ignore[arg-type]


@pytest.mark.parametrize(("fov_deg", "count"), [(45.0, 2), (20.0, 1)])
def test_the_field_of_view_is_the_rigs(fov_deg: float, count: int) -> None:
    u = np.sin(np.radians(np.array([0.0, -30.0, 60.0]))).astype(np.float32)
    found = Detections("vertical", 0, T0_NS, np.ones_like(u), u, *[np.zeros_like(u)] * 3)
    here = pose_at(T0_NS)
    points = single_radar_points("vertical", [(here, {"vertical": found})], here, fov_deg)
    np.testing.assert_allclose(points[:, 2], u[:count], atol=1e-6)


@pytest.mark.parametrize("fov_deg", [10.0, 80.0])
def test_heatmaps_with_another_field_of_view(kept: Keep, tmp_path: Path, fov_deg: float) -> None:
    collector = PictureCollector(tmp_path, "scene", fov_deg=fov_deg)
    collector.frame(kept.frames[0])
    assert size(collector.write()[0])[0] > 1000


@pytest.mark.parametrize(
    ("name", "drawn"),
    [
        ("caf\udce9.mcap", "caf\\udce9.mcap"),
        ("a\tb\nc\x1b[31m", "a?b?c?[31m"),
        ("$x_{1$ \\frac", "$x_{1$ \\frac"),
        ("漢字 é", "漢字 é"),
    ],
)
def test_any_file_name_is_a_line_of_a_picture(kept: Keep, tmp_path: Path, name: str, drawn: str) -> None:
    assert drawable(name) == drawn
    figure = new_figure(5.0, 3.0, name, name)
    assert [text.get_text() for text in figure.texts] == [drawn] * 2
    assert size(write(figure, tmp_path / "a.png"))[0] == 650


def test_the_truth_in_the_object_frame() -> None:
    pose = Pose(0, np.array([1.0, 2.0, 0.5]), LOOKING_LEFT)
    odom_m = np.array([[1.0, 5.0, 0.5], [-1.0, 2.0, 1.5]], dtype=np.float32)
    np.testing.assert_allclose(to_object_frame(odom_m, pose), [[3.0, 0.0, 0.0], [0.0, 2.0, 1.0]], atol=1e-6)


def test_the_best_frame_is_kept_not_the_buffer(kept: Keep, tmp_path: Path) -> None:
    collector = PictureCollector(tmp_path, "copy")
    pipeline = Pipeline(RIG, None, [collector])
    frames = frames_of(FRAMES)
    for item in in_time_order(scene_poses(FRAMES), frames["horizontal"], frames["vertical"]):
        pipeline.feed(item)
    assert collector._best is not None
    number = next(iter(collector._best[1].values())).number
    for radar, heatmap in collector._best[1].items():
        np.testing.assert_array_equal(heatmap.power, kept.frames[number].heatmaps[radar].power)
