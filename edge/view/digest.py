# SPDX-License-Identifier: Apache-2.0
"""A recording into a message store: results as they are, raw frames through the pipeline as fast as it goes."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import cast

from edge.errors import RecordingError, RfconstructError, WireError
from edge.frames import Detections, FusedCloud, Heatmap, PointCloud, Pose, RadarFrame, Shape
from edge.pipeline import Pipeline
from edge.publish import PublishingSink
from edge.recording.reader import RecordingReader
from edge.stream import convert
from edge.stream.messages import State, Status
from edge.stream.publisher import Publisher
from edge.stream.wire import BOOT_BYTES, HEARTBEAT_HZ, HEATMAP_HZ, STATUS_HZ, Draft, Stamp, join, pack, split
from edge.version import version
from edge.view.store import MessageStore


def copy_results(reader: RecordingReader, store: MessageStore, stopped: Callable[[], bool]) -> None:
    """Every recorded result into the store, at its log time.

    Args:
        reader: of a recording with results.
        store: to fill; its ``progress`` advances.
        stopped: True ends the pass.
    Raises:
        RecordingError: the recording or the store fails.
    """
    first_ns, last_ns = reader.span_ns
    for message in reader.results():
        if stopped():
            return
        try:
            topic = split(message.payload)[0].decode("ascii")
        except (WireError, UnicodeDecodeError):
            continue  # damaged, and a message without a topic has no place in the scene
        store.add(topic, message.t_ns, message.payload)
        store.progress = (message.t_ns - first_ns) / max(last_ns - first_ns, 1)


def run_pipeline(reader: RecordingReader, pipeline: Pipeline, store: MessageStore, stopped: Callable[[], bool]) -> None:
    """Raw frames through the pipeline; what a replay would publish goes into the store.

    Args:
        reader: of a recording with raw frames.
        pipeline: of the recording's rig, warmed up.
        store: to fill; its ``progress`` advances.
        stopped: True ends the pass.
    Raises:
        RecordingError, CaptureError: the recording or the store fails.
    """
    writer = StoreWriter(store, pipeline.rig.config_hash, pipeline.rig.calibration_hash)
    sink = PublishingSink(cast(Publisher, writer), version())
    sink.watch(pipeline)
    pipeline.sinks.append(sink)
    first_ns, last_ns = reader.span_ns
    for item in reader:
        if stopped():
            return
        if isinstance(item, Pose | RadarFrame):
            t_ns = item.t_ns if isinstance(item, Pose) else item.t_first_chirp_ns
            writer.now_ns = max(writer.now_ns, t_ns)
        pipeline.feed(item)
        store.progress = (writer.now_ns - first_ns) / max(last_ns - first_ns, 1)
    pipeline.finish()
    writer.rush()
    sink.report()


class StoreWriter:
    """Takes what a publisher takes, at the rates of the stream in recorded time, and writes it into a store.

    Args:
        store: where the messages go.
        config_hash, calibration_hash: of the recording's rig.
    Attributes:
        now_ns: recorded time; of all messages, so that the player shows a result when the road had it.
    """

    def __init__(self, store: MessageStore, config_hash: bytes, calibration_hash: bytes) -> None:
        self.now_ns = 0
        self._store, self._hashes, self._boot = store, (config_hash[:8], calibration_hash[:8]), os.urandom(BOOT_BYTES)
        self._sequence: dict[str, int] = {}
        self._due_ns: dict[str, int] = {}

    def shape(self, shape: Shape) -> None:
        """A completed object."""
        self._write(convert.encode_shape(shape))

    def cloud(self, cloud: FusedCloud) -> None:
        """The fused cloud of a window."""
        self._write(convert.encode_cloud(cloud))

    def heatmap(self, heatmap: Heatmap) -> None:
        """A heatmap, at most ten a second."""
        if self._due(heatmap.radar, HEATMAP_HZ):
            self._write(convert.encode_heatmap(heatmap))

    def detections(self, horizontal: Detections | None, vertical: Detections | None, points: PointCloud | None) -> None:
        """Detections of one frame of each radar, and the points made of them."""
        self._write(convert.encode_detections(horizontal, vertical, points))

    def pose(self, pose: Pose) -> None:
        """A pose of the rig."""
        self._write(convert.encode_pose(pose))

    def status(self, status: Status) -> None:
        """The account, once a second."""
        if self._due("status", STATUS_HZ):
            self._write(convert.encode_status(status, self.now_ns))

    def heartbeat(self, state: State = "RUN") -> None:
        """A sign of life, ten a second."""
        if self._due("hb", HEARTBEAT_HZ):
            self._write(convert.encode_heartbeat(state, self.now_ns))

    def rush(self) -> None:
        """Whatever comes next is due: the last account."""
        self._due_ns.clear()

    def _due(self, key: str, rate_hz: float) -> bool:
        if self.now_ns < self._due_ns.get(key, self.now_ns):
            return False
        self._due_ns[key] = self.now_ns + round(0.9e9 / rate_hz)
        return True

    def _write(self, draft: Draft) -> None:
        sequence = self._sequence.get(draft.topic, -1) + 1
        self._sequence[draft.topic] = sequence
        stamp = Stamp(self._boot, sequence, self.now_ns, 0, False, "replay", *self._hashes)
        self._store.add(draft.topic, self.now_ns, join(pack(draft, stamp)))


class Digest:
    """Fills a store in a thread of its own.

    Args:
        store: to fill; ``ended`` and ``failure`` say how it went.
        fill: the work; given a function that says when to stop.
    """

    def __init__(self, store: MessageStore, fill: Callable[[Callable[[], bool]], None]) -> None:
        self._store, self._fill, self._stop = store, fill, threading.Event()
        self._thread = threading.Thread(target=self._run, name="digest", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the work and wait for it."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._fill(self._stop.is_set)
            self._store.progress = 1.0
        except RfconstructError as error:
            self._store.failure = str(error)
        except OSError as error:
            self._store.failure = str(RecordingError("the recording cannot be read", value=error.strerror))
        finally:
            self._store.ended = True
