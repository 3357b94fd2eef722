# SPDX-License-Identifier: Apache-2.0
"""Writes results as an MCAP file that Foxglove and Lichtblick show: clouds, shapes by class, boxes, the rig."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from edge.config import RigGeometry
from edge.errors import RecordingError
from edge.frames import Float32, Pose
from edge.odometry.transforms import compose, inverse, rotation_matrix, transform_points
from edge.odometry.vehicle import rig_in_vehicle
from edge.recording import foxglove
from edge.recording.exporting import ExportReport, What
from edge.recording.mcap_writing import AppendFile, McapWriter
from edge.recording.placing import Placed
from edge.recording.point_files import Columns
from edge.stream.messages import CloudMessage, DetectionsMessage, Header, PoseMessage, ShapeMessage
from edge.view.colours import class_colour

ODOMETRY, RIG, VEHICLE = "odometry", "rig", "base_link"
SHOWN_S = 5.0
"""A shape and its box are shown so long after the object was last seen."""
LARGE_BYTES = 64 * 1024
"""Messages from this size on are a chunk of their own."""
_SCHEMAS = {
    "/tf": foxglove.TRANSFORM,
    "/shapes": foxglove.POINT_CLOUD,
    "/objects": foxglove.POINT_CLOUD,
    "/clouds": foxglove.POINT_CLOUD,
    "/detections": foxglove.POINT_CLOUD,
    "/boxes": foxglove.SCENE,
}


def export_foxglove(
    placed: Iterable[Placed | PoseMessage], out: Path, whats: Iterable[What], geometry: RigGeometry | None
) -> ExportReport:
    """Write the topics ``/shapes``, ``/objects``, ``/clouds``, ``/detections``, ``/boxes`` and ``/tf``.

    Args:
        placed: results in order, of ``Placer``, in the odometry frame.
        out: must not exist.
        whats: which results.
        geometry: of the rig on the vehicle; None: the vehicle's frame is left out.
    Raises:
        RecordingError: nothing to write, or the file cannot be written; nothing is left of it then.
    """
    try:
        file = AppendFile(out)
    except OSError as error:
        action = "choose another name: nothing is overwritten" if isinstance(error, FileExistsError) else ""
        raise RecordingError(f"{out}: cannot be created", value=error.strerror, action=action) from error
    try:
        scene = _Scene(file, set(whats), geometry)
        for one in placed:
            scene.add(one)
        if not scene.report.items:
            raise RecordingError("nothing to export", value=out.name, action="see what it holds: rfconstruct info")
        scene.writer.finish()
        file.sync()
    except BaseException as error:
        file.close()
        out.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise RecordingError(f"{out}: cannot be written", value=error.strerror) from error
        raise
    file.close()
    scene.report.files.append(out)
    return scene.report


class _Scene:
    """Messages to the file as they come; remembers the newest shape of every object in sight."""

    def __init__(self, file: AppendFile, whats: set[What], geometry: RigGeometry | None) -> None:
        self.report = ExportReport()
        self.writer = McapWriter(file, "", "rfconstruct")
        self._whats = whats
        self._mounting = None if geometry is None else inverse(Pose(0, *rig_in_vehicle(geometry)))
        schemas = {name: self.writer.add_schema(name, "protobuf", foxglove.descriptors(name)) for name in
                   dict.fromkeys(_SCHEMAS.values())}  # fmt: skip
        self._channels = {
            topic: self.writer.add_channel(topic, "protobuf", schemas[name]) for topic, name in _SCHEMAS.items()
        }
        self._shapes: dict[int, ShapeMessage] = {}
        self._utc_ns: int | None = None
        self._tree_told = False

    def add(self, one: Placed | PoseMessage) -> None:
        """The next result or pose."""
        if isinstance(one, PoseMessage):
            self._pose(one)
            return
        if one.pose is None:
            self.report.unplaced += 1
            return
        match one.message:
            case ShapeMessage() as shape:
                self._shape(shape)
            case CloudMessage() as message:
                cloud = message.cloud
                columns = {**_xyz(cloud.xyz_m), "power": cloud.power_db}
                self._cloud("clouds", message.header, one.pose, columns)
            case DetectionsMessage(points=points) as message if points is not None:
                columns = {**_xyz(points.xyz_m), "power": points.power_db}
                self._cloud("detections", message.header, one.pose, columns)

    def _shape(self, shape: ShapeMessage) -> None:
        header = shape.header
        if shape.input_m is not None:
            columns = {**_xyz(shape.input_m), "object": np.full(len(shape.input_m), shape.identity, np.uint32)}
            self._cloud("objects", header, shape.pose, columns)
        if "shapes" not in self._whats:
            return
        self._shapes[shape.identity] = shape
        shown_ns = header.t_ns - round(1e9 * SHOWN_S)
        self._shapes = {key: old for key, old in self._shapes.items() if old.header.t_ns >= shown_ns}
        origin = Pose(header.t_ns, shape.pose.position_m, np.array([0.0, 0.0, 0.0, 1.0]))
        self._cloud("shapes", header, origin, _together(list(self._shapes.values()), origin))
        self._box(shape)

    def _box(self, shape: ShapeMessage) -> None:
        low, high = shape.fine_m.min(axis=0).astype(float), shape.fine_m.max(axis=0).astype(float)
        turned = rotation_matrix(shape.pose.quaternion_xyzw)
        centre = Pose(shape.pose.t_ns, shape.pose.position_m + turned @ ((low + high) / 2), shape.pose.quaternion_xyzw)
        red, green, blue = (value / 255 for value in class_colour(shape.class_name))
        facts = {"class": shape.class_name, "confidence": f"{shape.confidence:.3f}", "points": str(shape.input_points)}
        label = f"{shape.class_name} {shape.identity} ({shape.confidence:.2f})"
        t_ns = self._time(shape.header, shape.header.t_ns)
        content = foxglove.box(
            t_ns,
            ODOMETRY,
            str(shape.identity),
            centre,
            (high - low).tolist(),
            label,
            (red, green, blue),
            facts,
            SHOWN_S,
        )
        self._write("/boxes", t_ns, content)

    def _cloud(self, what: What, header: Header, pose: Pose, columns: Columns) -> None:
        if what not in self._whats:
            return
        t_ns = self._time(header, header.t_ns)
        self._write(f"/{what}", t_ns, foxglove.point_cloud(t_ns, ODOMETRY, pose, columns))
        self.report.items[what] += 1
        self.report.points += len(columns["x"])

    def _pose(self, message: PoseMessage) -> None:
        t_ns = self._time(message.header, message.pose.t_ns)
        if self._mounting is not None and not self._tree_told:
            self._tree_told = True
            self._write("/tf", t_ns, foxglove.transform(t_ns, RIG, VEHICLE, self._mounting))
        self._write("/tf", t_ns, foxglove.transform(t_ns, ODOMETRY, RIG, message.pose))

    def _time(self, header: Header, t_ns: int) -> int:
        """UTC of live results whose clock was synchronised; otherwise the clock of the recording."""
        if self._utc_ns is None:
            known = header.source == "live" and header.utc_ok
            self._utc_ns = header.utc_ns - header.t_pub_ns if known else 0
        return max(0, t_ns + self._utc_ns)

    def _write(self, topic: str, t_ns: int, content: bytes) -> None:
        if len(content) < LARGE_BYTES:
            self.writer.add_message(self._channels[topic], t_ns, content)
        else:
            self.writer.write_message(self._channels[topic], t_ns, (content,), 0)


def _together(shapes: list[ShapeMessage], origin: Pose) -> Columns:
    """Points of several shapes from one origin, since a panel shows the newest message of a topic only."""
    to_origin = inverse(origin)
    points = [transform_points(compose(to_origin, shape.pose), shape.fine_m).astype(np.float32) for shape in shapes]
    counts = [len(part) for part in points]
    colours = np.array([(*class_colour(shape.class_name), 255) for shape in shapes], np.uint8)
    colour = np.repeat(colours, counts, axis=0)
    return {
        **_xyz(np.concatenate(points)),
        "object": np.repeat(np.array([shape.identity for shape in shapes], np.uint32), counts),
        "confidence": np.repeat(np.array([shape.confidence for shape in shapes], np.float32), counts),
        **{name: colour[:, channel] for channel, name in enumerate(("red", "green", "blue", "alpha"))},
    }


def _xyz(points_m: Float32) -> dict[str, Float32]:
    return dict(zip("xyz", np.ascontiguousarray(points_m.T, np.float32), strict=True))
