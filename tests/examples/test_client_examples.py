# SPDX-License-Identifier: Apache-2.0
"""The Python examples of a subscriber: PLY files, ROS 2's PointCloud2 and Rerun, from messages as they come."""

from __future__ import annotations

import importlib.util
import re
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tests" / "stream"))

from stream_samples import STAMP, fused_cloud, heatmap, pose, shape, status  # noqa: E402

from edge.odometry.transforms import transform_points  # noqa: E402
from edge.stream import convert  # noqa: E402
from edge.stream.decode import decode  # noqa: E402
from edge.stream.messages import CloudMessage, Message, ShapeMessage  # noqa: E402
from edge.stream.wire import Draft, pack  # noqa: E402

POINT_CLOUD_2 = """
std_msgs/Header header
uint32 height
uint32 width
PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
"""
"""sensor_msgs/msg/PointCloud2 without its comments."""
POINT_FIELD_TYPES = {
    "INT8": 1,
    "UINT8": 2,
    "INT16": 3,
    "UINT16": 4,
    "INT32": 5,
    "UINT32": 6,
    "FLOAT32": 7,
    "FLOAT64": 8,
}
"""Constants of sensor_msgs/msg/PointField."""
NUMPY_TYPES = {7: "<f4", 8: "<f8"}


def example(name: str) -> ModuleType:
    """A module of examples/."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def received(draft: Draft, **stamp: Any) -> Message:
    message = decode(pack(draft, replace(STAMP, **stamp)))
    assert message is not None
    return message


def shape_message(**stamp: Any) -> ShapeMessage:
    message = received(convert.encode_shape(shape()), **stamp)
    assert isinstance(message, ShapeMessage)
    return message


def cloud_message() -> CloudMessage:
    message = received(convert.encode_cloud(fused_cloud()))
    assert isinstance(message, CloudMessage)
    return message


def test_the_layout_has_the_fields_of_the_message_definition() -> None:
    ros = example("ros2_pointcloud2")
    names = [line.split()[1] for line in POINT_CLOUD_2.strip().splitlines()]
    assert [field.name for field in fields(ros.PointCloud2)] == names
    assert [field.name for field in fields(ros.PointField)] == ["name", "offset", "datatype", "count"]
    assert list(ros.DATATYPES.values()) == list(POINT_FIELD_TYPES.values())


@pytest.mark.parametrize("kind", ["shape", "cloud"])
def test_a_reader_of_the_message_definition_finds_the_points(kind: str) -> None:
    message = shape_message() if kind == "shape" else cloud_message()
    cloud = example("ros2_pointcloud2").pointcloud2(message)
    assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data)
    assert (cloud.height, cloud.is_bigendian, cloud.is_dense, cloud.header.frame_id) == (1, False, True, "odom")
    read = {
        field.name: np.ndarray(cloud.width, NUMPY_TYPES[field.datatype], cloud.data, field.offset, cloud.point_step)
        for field in cloud.fields
    }
    points, where = (
        (message.fine_m, message.pose)
        if isinstance(message, ShapeMessage)
        else (message.cloud.xyz_m, message.cloud.reference)
    )
    np.testing.assert_allclose(np.stack([read[a] for a in "xyz"], axis=1), transform_points(where, points), atol=1e-5)
    assert ("intensity" in read) == (kind == "cloud")


def test_the_stamp_is_the_utc_of_the_measurement() -> None:
    ros = example("ros2_pointcloud2")
    utc_ns = 1_800_000_000_500_000_000
    live = shape_message(source="live", utc_ns=utc_ns, t_pub_ns=1_750_000_000)
    assert ros.stamp(live.header) == ros.Time(1_799_999_999, 750_000_000)
    assert ros.stamp(shape_message(source="replay", utc_ns=utc_ns).header) == ros.Time(1_800_000_000, 500_000_000)


def test_ply_files_are_in_the_odometry_frame(tmp_path: Path) -> None:
    save = example("save_ply").save
    message = shape_message()
    path = save(tmp_path, message)
    assert path is not None
    assert path.name == "car_5_000007.ply"
    points_m, facts = convert.read_ply(path)
    np.testing.assert_allclose(points_m, transform_points(message.pose, message.fine_m), atol=1e-5)
    assert facts["confidence"] == "0.500"
    cloud = save(tmp_path, cloud_message())
    assert cloud is not None
    assert len(convert.read_ply(cloud)[0]) == 50
    assert save(tmp_path, received(convert.encode_pose(pose()))) is None


class FakeRerun:
    """Takes the place of the 700 MB package: remembers what is logged where."""

    def __init__(self) -> None:
        self.logged: dict[str, tuple[str, tuple[Any, ...]]] = {}
        self.time_s = 0.0

    def set_time(self, timeline: str, *, duration: float) -> None:
        self.time_s = duration

    def log(self, path: str, entity: tuple[str, tuple[Any, ...]]) -> None:
        self.logged[path] = entity

    def __getattr__(self, name: str) -> Any:
        return lambda *values, **options: (name, values)


def test_rerun_gets_points_in_the_odometry_frame() -> None:
    fake, log = FakeRerun(), example("rerun_view").log
    message = shape_message()
    for one in (message, cloud_message(), received(convert.encode_pose(pose()))):
        log(fake, one)
    log(fake, received(convert.encode_heatmap(heatmap())))
    log(fake, received(convert.encode_status(status(), 2_000_000_000)))
    kind, (points_m,) = fake.logged["world/objects/5/shape"]
    assert kind == "Points3D"
    np.testing.assert_allclose(points_m, transform_points(message.pose, message.fine_m))
    assert set(fake.logged) >= {"world/cloud", "world/rig", "heatmap/horizontal", "latency_ms/heatmap"}
    assert fake.time_s == 2.0


def test_rerun_is_optional(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert example("rerun_view").main() == 2
    assert "pip install rerun-sdk" in capsys.readouterr().err


def test_examples_import_nothing_heavy_at_the_top() -> None:
    for path in (ROOT / "examples").glob("*.py"):
        top = re.findall(r"^(?:import|from) (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        assert set(top) <= {"__future__", "sys", "pathlib", "collections", "dataclasses", "typing", "numpy", "edge"}, (
            path
        )
