# SPDX-License-Identifier: Apache-2.0
"""Copies a recording, or a part of it, with everything that belongs to it."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from edge.frames import Pose, RadarFrame
from edge.recording import schema
from edge.recording.playback import Part, Playback
from edge.recording.reader import RecordingReader
from edge.recording.schema import RecordedMessage
from edge.recording.writer import RecordingWriter


@dataclass(slots=True)
class CopyReport:
    """What was copied.

    Args:
        written: topic -> messages.
        damaged: something of the part could not be read.
        notes: what a reader should know.
    """

    written: Counter[str] = field(default_factory=Counter)
    damaged: bool = False
    notes: list[str] = field(default_factory=list)


def copy_part(source: Path, out: Path, part: Part, notes: Sequence[str] = ()) -> CopyReport:
    """Write frames, poses and results of a part to a new recording, in order of time.

    Args:
        source: recording.
        out: must not exist.
        part: what to copy; its loops are not.
        notes: added to those of the source.
    Raises:
        RecordingError: unreadable, or ``out`` cannot be written; nothing is left of it then.
    """
    report = CopyReport()
    with RecordingReader(source) as inputs, RecordingReader(source) as results:
        rig = inputs.read_rig() if inputs.rig_name else None
        playback = Playback(inputs, Part(part.start_s, part.end_s))
        told = [*inputs.notes, *notes]
        if not part.whole:
            told.append(
                f"seconds {part.start_s:g} to {'the end' if part.end_s is None else f'{part.end_s:g}'} of a longer one"
            )
        with RecordingWriter(out, rig, told) as writer:
            stored = results.results(None if part.whole else part.span_ns(inputs.span_ns))
            try:
                for item in heapq.merge(playback, stored, key=_instant):
                    report.written[_write(writer, item)] += 1
            except BaseException:
                out.unlink(missing_ok=True)  # half a copy would pass for a whole one
                raise
        lost = inputs.report.bytes_lost + inputs.report.missing
        report.damaged = inputs.truncated or lost > 0
        if report.damaged:
            report.notes.append(f"{source} is cut or damaged: what could be read was copied")
    return report


def _write(writer: RecordingWriter, item: RadarFrame | Pose | RecordedMessage) -> str:
    if isinstance(item, RadarFrame):
        writer.frame(item)
        return schema.FRAME_TOPICS[item.radar]
    if isinstance(item, Pose):
        writer.pose(item)
        return schema.POSE_TOPIC
    writer.message(item.topic, item.payload, item.t_ns)
    return item.topic


def _instant(item: RadarFrame | Pose | RecordedMessage) -> int:
    return item.t_first_chirp_ns if isinstance(item, RadarFrame) else item.t_ns
