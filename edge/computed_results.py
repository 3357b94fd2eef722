# SPDX-License-Identifier: Apache-2.0
"""The results of a recording as messages of the stream: as they were recorded, or computed from its raw frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from edge.errors import WireError
from edge.frames import Pose, RadarFrame
from edge.pipeline import FrameResult, Pipeline, WindowResult
from edge.recording.reader import RecordingReader
from edge.sources.base import Loss
from edge.stream import convert
from edge.stream.decode import decode
from edge.stream.messages import Message
from edge.stream.wire import BOOT_BYTES, HASH_BYTES, Draft, Stamp, pack, split


def recorded_messages(
    reader: RecordingReader, span_ns: tuple[int, int] | None = None, refused: Callable[[WireError], None] | None = None
) -> Iterator[Message]:
    """Messages as they were recorded; types that this version does not know are left out.

    Args:
        reader: open recording of results.
        span_ns: log times; None: all.
        refused: told of every message that does not follow the wire format.
    """
    for stored in reader.results(span_ns):
        try:
            message = decode(split(stored.payload))
        except WireError as error:
            if refused is not None:
                refused(error)
            continue
        if message is not None:
            yield message


def computed_messages(
    items: Iterable[RadarFrame | Pose | Loss], pipeline: Pipeline, refused: Callable[[WireError], None] | None = None
) -> Iterator[Message]:
    """What the pipeline would publish of raw frames, heatmaps aside.

    Args:
        items: frames, poses and losses in time order.
        pipeline: of their rig.
        refused: told of every result that the wire format cannot express.
    """
    sink = _Drafts(refused)
    pipeline.sinks.append(sink)
    for item in items:
        pipeline.feed(item)
        yield from sink.take()
    pipeline.finish()
    yield from sink.take()


class _Drafts:
    """A sink that keeps messages until they are taken."""

    def __init__(self, refused: Callable[[WireError], None] | None) -> None:
        self._messages: list[Message] = []
        self._refused = refused

    def frame(self, result: FrameResult) -> None:
        found = result.detections
        self._add(lambda: convert.encode_detections(found.get("horizontal"), found.get("vertical"), result.cloud))
        pose = result.pose
        if pose is not None:
            self._add(lambda: convert.encode_pose(pose))

    def window(self, result: WindowResult) -> None:
        self._add(lambda: convert.encode_cloud(result.cloud))
        for shape in result.shapes:
            self._add(lambda shape=shape: convert.encode_shape(shape))  # type: ignore[misc]

    def take(self) -> list[Message]:
        taken, self._messages = self._messages, []
        return taken

    def _add(self, make: Callable[[], Draft]) -> None:
        try:
            draft = make()
            stamp = Stamp(bytes(BOOT_BYTES), 0, draft.t_ns, 0, False, "replay", bytes(HASH_BYTES), bytes(HASH_BYTES))
            message = decode(pack(draft, stamp))
        except WireError as error:
            if self._refused is not None:
                self._refused(error)
            return
        if message is not None:
            self._messages.append(message)
