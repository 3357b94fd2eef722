# SPDX-License-Identifier: Apache-2.0
"""The layout of ROS 2's sensor_msgs/msg/PointCloud2 from shapes and clouds, without ROS; with ROS, a publishing node.

``python examples/ros2_pointcloud2.py [tcp://127.0.0.1:5600]`` publishes on ``rfconstruct/shape`` and
``rfconstruct/cloud`` where rclpy is installed, and prints the layouts where it is not.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge import connect
from edge.odometry.transforms import transform_points
from edge.stream.client import DEFAULT_ENDPOINT, Client
from edge.stream.messages import CloudMessage, Header, ShapeMessage

DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""numpy's names of the types of sensor_msgs/msg/PointField."""


@dataclass(frozen=True, slots=True)
class Time:
    """builtin_interfaces/msg/Time."""

    sec: int
    nanosec: int


@dataclass(frozen=True, slots=True)
class RosHeader:
    """std_msgs/msg/Header."""

    stamp: Time
    frame_id: str


@dataclass(frozen=True, slots=True)
class PointField:
    """sensor_msgs/msg/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


@dataclass(frozen=True, slots=True)
class PointCloud2:
    """sensor_msgs/msg/PointCloud2, fields in the order of its definition."""

    header: RosHeader
    height: int
    width: int
    fields: list[PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: bytes
    is_dense: bool


def stamp(header: Header) -> Time:
    """UTC of the measurement: that of the publication less the time in between; a recording's: the publication."""
    age_ns = header.t_pub_ns - header.t_ns if header.source == "live" else 0
    sec, nanosec = divmod(header.utc_ns - age_ns, 10**9)
    return Time(sec, nanosec)


def layout(header: RosHeader, columns: Mapping[str, NDArray[Any]]) -> PointCloud2:
    """An unorganised cloud (height 1) with one field for every column of equal length."""
    kinds = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    records = np.empty(len(next(iter(columns.values()))), np.dtype(kinds))
    for name, column in columns.items():
        records[name] = column
    offsets = [records.dtype.fields[name][1] for name in columns]  # type: ignore[index]
    codes = [DATATYPES[column.dtype.str[1:]] for column in columns.values()]
    fields = [PointField(*entry, 1) for entry in zip(columns, offsets, codes, strict=True)]
    step = records.dtype.itemsize
    dense = all(bool(np.isfinite(column).all()) for column in columns.values())
    return PointCloud2(header, 1, len(records), fields, False, step, step * len(records), records.tobytes(), dense)


def pointcloud2(message: ShapeMessage | CloudMessage, frame_id: str = "odom") -> PointCloud2:
    """Points of a message in the odometry frame: x, y, z of a shape; x, y, z, intensity (dB) of a cloud.

    Coordinates are float32: more than some kilometres from the origin of the odometry they lose millimetres.
    """
    if isinstance(message, ShapeMessage):
        placed_m, more = transform_points(message.pose, message.fine_m), {}
    else:
        cloud = message.cloud
        placed_m, more = transform_points(cloud.reference, cloud.xyz_m), {"intensity": cloud.power_db}
    columns = {axis: placed_m[:, k].astype(np.float32) for k, axis in enumerate("xyz")} | more
    return layout(RosHeader(stamp(message.header), frame_id), columns)


def main() -> int:
    """Publish in ROS 2 where there is one, else print."""
    endpoint = sys.argv[1] if len(sys.argv) > 1 else DEFAULT_ENDPOINT
    with connect(endpoint, topics=("shape", "cloud"), timeout_s=60.0) as client:
        try:
            import rclpy
        except ImportError:
            print("no rclpy here: source a ROS 2 installation to publish; layouts:", file=sys.stderr)
            for message in client:
                if isinstance(message, ShapeMessage | CloudMessage):
                    cloud = pointcloud2(message)
                    names = [field.name for field in cloud.fields]
                    print(
                        f"{message.header.topic} width {cloud.width} point_step {cloud.point_step} {names}", flush=True
                    )
            return 0
        publish(rclpy, client)
    return 0


def publish(rclpy: Any, client: Client) -> None:
    """Until the stream is silent for a minute or ROS shuts down."""
    from rosidl_runtime_py.set_message import set_message_fields
    from sensor_msgs.msg import PointCloud2 as RosPointCloud2

    rclpy.init()
    node = rclpy.create_node("rfconstruct")
    topics = {kind: node.create_publisher(RosPointCloud2, f"rfconstruct/{kind}", 10) for kind in ("shape", "cloud")}
    for message in client:
        if not rclpy.ok():
            break
        if isinstance(message, ShapeMessage | CloudMessage):
            content = asdict(pointcloud2(message))
            ros = RosPointCloud2()
            ros.data = content.pop("data")  # taken as a whole: element by element is slow
            set_message_fields(ros, content)
            topics["shape" if isinstance(message, ShapeMessage) else "cloud"].publish(ros)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
