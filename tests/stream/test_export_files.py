# SPDX-License-Identifier: Apache-2.0
"""Exports read back by readers that share nothing with the writers; poses and frames against hand-made answers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_readers import cloud_rows, read_foxglove, read_pcd_rows, read_ply_rows
from google.protobuf import descriptor_pb2
from stream_samples import STAMP, detections, fused_cloud, point_cloud, pose, shape

from edge.cli import main
from edge.config import RigGeometry
from edge.errors import ConfigError, ExitCode, RecordingError
from edge.frames import Pose
from edge.recording import foxglove, protobuf
from edge.recording.exporting import export_points
from edge.recording.foxglove_export import export_foxglove
from edge.recording.placing import FrameName, Placed, Placer, require_frame
from edge.recording.point_files import write_points
from edge.recording.writer import RecordingWriter
from edge.stream import convert
from edge.stream.decode import decode
from edge.stream.messages import Message, PoseMessage
from edge.stream.wire import Draft, pack

QUARTER_TURN = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
MOUNTED = RigGeometry(offset_m=(2.0, 0.0, 0.5), yaw_deg=90.0)
"""The rig looks to the left; its origin is 2 m in front of base_link and 0.5 m above."""


def message(draft: Draft) -> Message:
    decoded = decode(pack(draft, STAMP))
    assert decoded is not None
    return decoded


def shape_message(identity: int = 5, confidence: float = 0.5) -> Message:
    return message(convert.encode_shape(replace(shape(), identity=identity, confidence=confidence)))


def detections_message() -> Message:
    return message(convert.encode_detections(detections("horizontal"), detections("vertical"), point_cloud()))


def placed(
    messages: Iterable[Message], frame: FrameName = "odometry", geometry: RigGeometry | None = None
) -> list[Placed | PoseMessage]:
    return list(Placer(frame, geometry).place(messages))


def turned(xyz: np.ndarray[Any, Any], pose_: Pose) -> np.ndarray[Any, Any]:
    """The pose's rotation about z by hand: (0, 0, 0.6, 0.8) turns by 2 asin 0.6, cosine 0.28, sine 0.96."""
    assert pose_.quaternion_xyzw.tolist() == [0.0, 0.0, 0.6, 0.8]
    x, y, z = xyz.T.astype(float)
    return np.stack([0.28 * x - 0.96 * y, 0.96 * x + 0.28 * y, z], axis=1) + pose_.position_m


def test_a_shape_as_ply_pcd_and_npz(tmp_path: Path) -> None:
    truth = turned(shape().fine_m, pose())
    for suffix in (".ply", ".pcd", ".npz"):
        report = export_points(
            placed([shape_message()]), tmp_path / f"car{suffix}", suffix, "shapes", "odometry", False
        )
        assert (report.items["shapes"], report.points, report.unplaced) == (1, 2, 0)
    names, rows, comments = read_ply_rows(tmp_path / "car.ply")
    assert names == ["x", "y", "z", "object", "confidence"]
    np.testing.assert_allclose(np.array(rows)[:, :3], truth, atol=1e-6)
    assert [row[3:] for row in rows] == [(5, 0.5), (5, 0.5)]
    assert "comment class car" in comments
    assert read_pcd_rows(tmp_path / "car.pcd") == (names, rows)
    with np.load(tmp_path / "car.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["xyz_m"], np.array(rows, np.float32)[:, :3])
        assert arrays["item_class"].tolist() == ["car"]
        assert arrays["item_points"].tolist() == [2]
        assert str(arrays["about_class"]) == "car"


def test_columns_of_every_type_keep_their_values(tmp_path: Path) -> None:
    kinds = ("f4", "f8", "u1", "i1", "u2", "i2", "u4", "i4")
    columns = {name: np.arange(3, dtype="f4") - 1 for name in "xyz"}
    columns |= {f"c{kind}": np.array([0, 1, 100]).astype(kind) for kind in kinds}  # type: ignore[arg-type]
    truth = [tuple(float(column[i]) for column in columns.values()) for i in range(3)]
    for suffix in (".ply", ".pcd"):
        write_points(tmp_path / f"a{suffix}", columns, {"what": "two\nlines"})
    names, rows, comments = read_ply_rows(tmp_path / "a.ply")
    assert names == list(columns)
    assert rows == truth
    assert comments == ["comment what two lines"]
    assert read_pcd_rows(tmp_path / "a.pcd") == (names, truth)
    assert not list(tmp_path.glob(".*")), "no temporary file is left"


def test_only_the_most_trusted_shape_of_an_object_unless_all_are_wanted(tmp_path: Path) -> None:
    messages = [shape_message(5, 0.4), shape_message(6, 0.3), shape_message(5, 0.9), shape_message(5, 0.2)]
    best = export_points(placed(messages), tmp_path / "best.npz", ".npz", "shapes", "object", False)
    assert best.items["shapes"] == 2
    with np.load(tmp_path / "best.npz") as arrays:
        assert arrays["item_identity"].tolist() == [5, 6]
        assert arrays["item_confidence"].tolist() == [0.9, 0.3]
        assert arrays["item"].tolist() == [0, 0, 1, 1]
    every = export_points(placed(messages), tmp_path / "folder", ".ply", "shapes", "object", True)
    assert [path.name for path in every.files] == [
        f"shapes_{number:06d}_car_{identity}.ply" for number, identity in enumerate((5, 6, 5, 5))
    ]


def test_clouds_and_objects(tmp_path: Path) -> None:
    cloud = message(convert.encode_cloud(fused_cloud()))
    export_points(placed([cloud]), tmp_path / "cloud.ply", ".ply", "clouds", "odometry", False)
    names, rows, _ = read_ply_rows(tmp_path / "cloud.ply")
    assert names == ["x", "y", "z", "intensity", "frame_number"]
    np.testing.assert_allclose(np.array(rows)[:, :3], turned(fused_cloud().xyz_m, pose()), atol=1e-5)
    np.testing.assert_allclose(np.array(rows)[:, 3], fused_cloud().power_db)
    assert [row[4] for row in rows] == list(range(50))
    export_points(placed([shape_message()], "object"), tmp_path / "in.pcd", ".pcd", "objects", "object", False)
    assert read_pcd_rows(tmp_path / "in.pcd")[1] == [(0.0, 0.25, 0.5, 5, 0.5)]


def test_detections_stand_where_the_rig_was(tmp_path: Path) -> None:
    """Pose by interpolation between two that come later; the vehicle frame needs no pose, but the mounting."""
    before, after = (Pose(t, np.array([x, 0.0, 0.0]), QUARTER_TURN) for t, x in ((57, 1.0), (97, 3.0)))
    stream = [detections_message(), *(message(convert.encode_pose(one)) for one in (before, after))]
    x, y, z = point_cloud().xyz_m.T
    export_points(placed(stream), tmp_path / "a.ply", ".ply", "detections", "odometry", False)
    rows = np.array(read_ply_rows(tmp_path / "a.ply")[1])
    np.testing.assert_allclose(rows[:, :3], np.stack([2.0 - y, x, z], axis=1), atol=1e-5)
    export_points(placed(stream, "vehicle", MOUNTED), tmp_path / "b.ply", ".ply", "detections", "vehicle", False)
    rows = np.array(read_ply_rows(tmp_path / "b.ply")[1])
    np.testing.assert_allclose(rows[:, :3], np.stack([2.0 - y, x, z + 0.5], axis=1), atol=1e-5)


def test_a_shape_in_the_vehicle_frame(tmp_path: Path) -> None:
    """The rig at (9, 8, 0.5) looks along y, so base_link looks along x and stands 2 m behind it, at (7, 8, 0)."""
    t_ns = shape().input.pose.t_ns
    rig = message(convert.encode_pose(Pose(t_ns, np.array([9.0, 8.0, 0.5]), QUARTER_TURN)))
    result = placed([shape_message(), rig], "vehicle", MOUNTED)
    export_points(result, tmp_path / "a.ply", ".ply", "shapes", "vehicle", False)
    rows = np.array(read_ply_rows(tmp_path / "a.ply")[1])
    np.testing.assert_allclose(rows[:, :3], turned(shape().fine_m, pose()) - [7.0, 8.0, 0.0], atol=1e-5)


def test_what_cannot_be_placed_is_said(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="1 have no known pose"):
        export_points(placed([detections_message()]), tmp_path / "a.ply", ".ply", "detections", "odometry", False)
    with pytest.raises(ConfigError, match="give the rig with --rig NAME"):
        placed([detections_message()], "vehicle")
    with pytest.raises(ConfigError, match="no object frame"):
        require_frame("clouds", "object")
    with pytest.raises(RecordingError, match="the recording holds none"):
        export_points([], tmp_path / "a.ply", ".ply", "shapes", "odometry", False)
    assert list(tmp_path.iterdir()) == []


NUMBERS = {
    "foxglove.PointCloud": {"timestamp": 1, "frame_id": 2, "pose": 3, "point_stride": 4, "fields": 5, "data": 6},
    "foxglove.PackedElementField": {"name": 1, "offset": 2, "type": 3},
    "foxglove.FrameTransform": {
        "timestamp": 1, "parent_frame_id": 2, "child_frame_id": 3, "translation": 4, "rotation": 5,
    },
    "foxglove.SceneUpdate": {"deletions": 1, "entities": 2},
    "foxglove.SceneEntity": {
        "timestamp": 1, "frame_id": 2, "id": 3, "lifetime": 4, "frame_locked": 5, "metadata": 6, "cubes": 8,
        "texts": 13,
    },
    "foxglove.SceneEntityDeletion": {"timestamp": 1, "type": 2, "id": 3},
    "foxglove.CubePrimitive": {"pose": 1, "size": 2, "color": 3},
    "foxglove.TextPrimitive": {
        "pose": 1, "billboard": 2, "font_size": 3, "scale_invariant": 4, "color": 5, "text": 6,
    },
    "foxglove.KeyValuePair": {"key": 1, "value": 2},
    "foxglove.Color": {"r": 1, "g": 2, "b": 3, "a": 4},
    "foxglove.Pose": {"position": 1, "orientation": 2},
    "foxglove.Vector3": {"x": 1, "y": 2, "z": 3},
    "foxglove.Quaternion": {"x": 1, "y": 2, "z": 3, "w": 4},
    "google.protobuf.Timestamp": {"seconds": 1, "nanos": 2},
    "google.protobuf.Duration": {"seconds": 1, "nanos": 2},
}  # fmt: skip
"""Typed in from the .proto files of foxglove-sdk and of protobuf."""


def test_field_numbers_are_those_of_the_published_schemas() -> None:
    found = {}
    for root in (foxglove.POINT_CLOUD, foxglove.TRANSFORM, foxglove.SCENE):
        files = descriptor_pb2.FileDescriptorSet.FromString(foxglove.descriptors(root)).file
        for file in files:
            assert file.syntax == "proto3"
            for kind in file.message_type:
                found[f"{file.package}.{kind.name}"] = {field.name: field.number for field in kind.field}
        assert [f"{file.package}.{kind.name}" for file in files for kind in file.message_type][-1] == root
    assert found == NUMBERS
    kinds = {(field.name, field.type) for file in files for kind in file.message_type for field in kind.field}
    assert ("frame_locked", 8) in kinds
    points = descriptor_pb2.FileDescriptorSet.FromString(foxglove.descriptors(foxglove.POINT_CLOUD)).file[-1]
    types = {field.name: field.type for field in points.message_type[0].field}
    assert types == {"timestamp": 11, "frame_id": 9, "pose": 11, "point_stride": 7, "fields": 11, "data": 12}


def test_varints() -> None:
    """Examples of the encoding's documentation."""
    assert protobuf.varint(1) == b"\x01"
    assert protobuf.varint(150) == b"\x96\x01"
    assert protobuf.varint(-2) == b"\xfe" + b"\xff" * 8 + b"\x01"


def test_a_scene_for_foxglove(tmp_path: Path) -> None:
    rig = pose(1_000_000_000)
    stream = [message(convert.encode_pose(rig)), message(convert.encode_cloud(fused_cloud())), shape_message(5, 0.5),
              shape_message(6, 0.25), message(convert.encode_pose(pose(1_000_000_005)))]  # fmt: skip
    report = export_foxglove(placed(stream, "odometry", MOUNTED), tmp_path / "a.mcap", ("shapes", "clouds"), MOUNTED)
    assert dict(report.items) == {"shapes": 2, "clouds": 1}
    found = read_foxglove(tmp_path / "a.mcap")
    topics = [topic for topic, _, _ in found]
    assert sorted(topics) == sorted(["/tf", "/tf", "/clouds", "/shapes", "/boxes", "/shapes", "/boxes", "/tf"])
    static, first, _ = (m for topic, _, m in found if topic == "/tf")
    assert (static.parent_frame_id, static.child_frame_id) == ("rig", "base_link")
    assert (first.parent_frame_id, first.child_frame_id) == ("odometry", "rig")
    assert (first.translation.x, first.translation.y, first.rotation.z, first.rotation.w) == (1.0, 2.5, 0.6, 0.8)
    assert (first.timestamp.seconds, first.timestamp.nanos) == (1, 0)
    cloud = next(m for topic, _, m in found if topic == "/clouds")
    assert cloud.frame_id == "odometry"
    assert (cloud.pose.position.y, cloud.pose.orientation.w) == (2.5, 0.8)
    names, rows = cloud_rows(cloud)
    assert names == ["x", "y", "z", "power"]
    np.testing.assert_array_equal(np.array(rows, np.float32)[:, :3], fused_cloud().xyz_m)
    _, log_ns, both = [entry for entry in found if entry[0] == "/shapes"][-1]
    assert log_ns == 10**9
    names, rows = cloud_rows(both)
    assert names == ["x", "y", "z", "object", "confidence", "red", "green", "blue", "alpha"]
    assert [row[3] for row in rows] == [5, 5, 6, 6], "the newest shape of every object in sight"
    origin = np.array([both.pose.position.x, both.pose.position.y, both.pose.position.z])
    np.testing.assert_allclose(np.array(rows)[:2, :3] + origin, turned(shape().fine_m, pose()), atol=1e-6)
    box = next(m for topic, _, m in found if topic == "/boxes").entities[0]
    assert (box.id, box.frame_id, box.lifetime.seconds) == ("5", "odometry", 5)
    assert (box.cubes[0].size.x, box.cubes[0].size.y, box.cubes[0].size.z) == (1.5, 2.0, 1.5)
    centre = turned(np.array([[1.25, 0.0, 1.0]]), pose())[0]
    position = box.cubes[0].pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], centre, atol=1e-6)
    assert box.texts[0].text == "car 5 (0.50)"


def test_live_results_are_exported_in_utc(tmp_path: Path) -> None:
    live = decode(pack(convert.encode_cloud(fused_cloud()), replace(STAMP, source="live")))
    assert live is not None
    export_foxglove(placed([live]), tmp_path / "a.mcap", ("clouds",), None)
    ((_, log_ns, cloud),) = read_foxglove(tmp_path / "a.mcap")
    assert log_ns == fused_cloud().t_end_ns + STAMP.utc_ns - STAMP.t_pub_ns
    assert cloud.timestamp.seconds * 10**9 + cloud.timestamp.nanos == log_ns


def test_nothing_is_left_of_a_failed_export(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nothing to export"):
        export_foxglove([], tmp_path / "a.mcap", ("shapes",), None)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "b.mcap").write_bytes(b"mine")
    with pytest.raises(RecordingError, match="nothing is overwritten"):
        export_foxglove(placed([shape_message()]), tmp_path / "b.mcap", ("shapes",), None)
    assert (tmp_path / "b.mcap").read_bytes() == b"mine"


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RecordingWriter(tmp_path / "results.mcap", None) as writer:
        for number, draft in enumerate((convert.encode_shape(shape()), convert.encode_cloud(fused_cloud()))):
            writer.published(pack(draft, STAMP), number)
    source, out = str(tmp_path / "results.mcap"), tmp_path / "car.ply"
    assert main(["export", source, str(out)]) == ExitCode.OK
    assert "shapes 1, 2 points" in capsys.readouterr().out
    assert len(read_ply_rows(out)[1]) == 2
    assert main(["export", source, str(tmp_path / "all.mcap")]) == ExitCode.OK
    assert {topic for topic, _, _ in read_foxglove(tmp_path / "all.mcap")} == {
        "/shapes",
        "/boxes",
        "/objects",
        "/clouds",
    }
    assert (
        main(["export", source, str(tmp_path / "x.pcd"), "--what", "clouds", "--frame", "object"])
        == ExitCode.BAD_CONFIG
    )
    assert main(["export", source, str(tmp_path / "x.ply"), "--format", "npz"]) == ExitCode.BAD_CONFIG
    assert main(["export", source, source]) == ExitCode.BAD_CONFIG
    assert main(["export", source, str(tmp_path / "x.ply"), "--what", "detections"]) == ExitCode.FAILURE
