# SPDX-License-Identifier: Apache-2.0
"""Writes recordings so that a crash, ``kill -9`` or a full disk costs at most the last second."""

from __future__ import annotations

import json
import math
import platform
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from edge.calibration import Calibration, Waveform, save_calibration
from edge.errors import RecordingError
from edge.frames import Pose, RadarFrame
from edge.recording import schema
from edge.recording.head import LIBRARY, write_head
from edge.recording.mcap_writing import AppendFile, McapWriter
from edge.rig import Radar, Rig
from edge.stream.wire import join

FLUSH_PERIOD_S = 0.5
"""What waits in memory is written and the file is synchronised this often."""
LARGEST_ATTACHMENTS = 64 << 20
TEXT_SUFFIXES = (".toml", ".cfg", ".json", ".txt")


class RecordingWriter:
    """Appends frames, poses and results to a new MCAP file; any thread may call.

    Messages are kept in the order of the calls; callers write in time order. A frame, and everything before it, is in
    the file when ``frame`` returns; poses and results wait for the next frame, at most half a second.

    Args:
        path: must not exist; the folder must.
        rig: its folder and calibrations are stored with the data; None: results only, no frames.
        notes: what a reader of the data should know, in sentences; stored, and shown by a replay.
    Raises:
        RecordingError: the file exists or cannot be written; the disk is full, now or in any later call. What was
            written before stays readable.
    """

    def __init__(self, path: Path | str, rig: Rig | None, notes: Sequence[str] = ()) -> None:
        self.path, self.rig, self._notes = Path(path), rig, list(notes)
        self._layouts = {} if rig is None else {radar: one.schedule.layout for radar, one in rig.radars.items()}
        self._lock = threading.Lock()
        self._failure = ""
        self._dirty, self._stop = False, threading.Event()
        try:
            self._file = AppendFile(self.path)
        except OSError as error:
            exists = isinstance(error, FileExistsError)
            raise RecordingError(
                f"{self.path}: cannot be created",
                value=error.strerror,
                action="choose another name: recordings are never overwritten" if exists else "check the folder",
            ) from error
        try:
            self._writer = McapWriter(self._file, schema.PROFILE, LIBRARY)
            self._channels = write_head(self._writer, self._metadata(), _attachments(rig), list(self._layouts))
        except (OSError, RecordingError) as error:
            self._file.close()
            self.path.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise self._stopped(error) from error
            raise
        self._flusher = threading.Thread(target=self._flush_periodically, name="recording-flush", daemon=True)
        self._flusher.start()

    def frame(self, frame: RadarFrame) -> None:
        """Append a raw frame; RecordingError when the rig has no such radar or layout."""
        if self._layouts.get(frame.radar) != frame.layout:
            raise RecordingError(
                f"{frame.radar} frame {frame.number} contradicts rig {self.rig.name if self.rig else '(none)'}",
                value=frame.layout,
                allowed=str(self._layouts.get(frame.radar, "no such radar")),
                action="record with the rig that the frames come from",
            )
        parts = (schema.frame_header(frame), frame.adc.reshape(-1).data.cast("B"))
        channel, sequence = self._channels[schema.FRAME_TOPICS[frame.radar]], frame.number & 0xFFFFFFFF
        t_ns = _recordable(frame.t_first_chirp_ns)
        self._append(lambda: self._writer.write_message(channel, t_ns, parts, sequence))

    def pose(self, pose: Pose) -> None:
        """Append a pose."""
        t_ns, payload = _recordable(pose.t_ns), schema.encode_pose(pose)
        self._append(lambda: self._writer.add_message(self._channels[schema.POSE_TOPIC], t_ns, payload))

    def message(self, topic: str, payload: bytes, t_ns: int) -> None:
        """Append a result as the stream encodes it; RecordingError for a topic that is not in RESULT_TOPICS."""
        if topic not in schema.RESULT_TOPICS:
            raise RecordingError("topic of no result", value=topic, allowed=", ".join(schema.RESULT_TOPICS))
        channel = self._channels[topic]
        t_ns = _recordable(t_ns)
        self._append(lambda: self._writer.add_message(channel, t_ns, payload))

    def published(self, frames: Sequence[bytes], t_ns: int) -> None:
        """Append a message of the stream as it came (topic, header, payloads), under the topic of its kind.

        Args:
            frames: as received or as ``Publisher`` returned them; no frames, no message.
            t_ns: when it came.
        """
        if frames:
            self.message(schema.result_topic(frames[0]), join(frames), t_ns)

    def flush(self) -> None:
        """Write what waits in memory: what was appended so far survives the death of this process."""
        with self._lock:
            self._require_open()
            self._guarded(self._writer.flush)

    def close(self) -> None:
        """Write the summary and close; RecordingError when that fails, the data before stay readable."""
        self._stop.set()
        self._flusher.join()
        with self._lock:
            if self._file.closed:
                return
            try:
                if not self._failure:
                    self._guarded(self._writer.finish)
                    self._guarded(self._file.sync)
            finally:
                self._file.close()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _metadata(self) -> dict[str, str]:
        rig = self.rig
        return {
            "format_version": str(schema.FORMAT_VERSION),
            "rig": rig.name if rig is not None else "",
            "config_hash": rig.config_hash.hex() if rig is not None else "",
            "host": platform.node(),
            "utc_minus_monotonic_ns": str(time.time_ns() - time.monotonic_ns()),
            "notes": json.dumps(self._notes),
        }

    def _append(self, action: Callable[[], None]) -> None:
        with self._lock:
            self._require_open()
            self._dirty = True
            self._guarded(action)

    def _require_open(self) -> None:
        if self._failure:
            raise self._stopped()
        if self._file.closed:
            raise RecordingError(f"{self.path} is closed", action="open a new recording")

    def _guarded(self, action: Callable[[], None]) -> None:
        try:
            action()
        except OSError as error:
            raise self._stopped(error) from error

    def _flush_periodically(self) -> None:
        """Of the background thread; its failure is raised by the next call of anybody."""
        while not self._stop.wait(FLUSH_PERIOD_S):
            try:
                with self._lock:
                    if self._failure:
                        return
                    dirty, self._dirty = self._dirty, False
                    self._guarded(self._writer.flush)
                if dirty:
                    self._file.sync()
            except RecordingError:
                return
            except OSError as error:
                with self._lock:
                    self._stopped(error)
                return

    def _stopped(self, error: OSError | None = None) -> RecordingError:
        """Remember the first failure: nothing is written after it."""
        if error is not None and not self._failure:
            self._failure = error.strerror or str(error)
        return RecordingError(
            f"{self.path}: recording stopped",
            value=self._failure,
            action="free space or mend the disk, then start a new recording; what is in the file stays readable",
        )


def _recordable(t_ns: int) -> int:
    if not 0 <= t_ns < 2**63:
        raise RecordingError("time cannot be recorded", value=t_ns, allowed="0..2^63-1 ns of CLOCK_MONOTONIC")
    return t_ns


def _attachments(rig: Rig | None) -> dict[str, bytes]:
    """The rig's texts and the calibrations in use, by name in the recording."""
    found: dict[str, bytes] = {}
    if rig is None:
        return found
    try:
        for path in sorted(rig.directory.iterdir()):
            if path.is_file() and path.suffix in TEXT_SUFFIXES:
                found[schema.RIG_PREFIX + path.name] = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{rig.directory}: the rig's folder cannot be read", value=error.strerror) from error
    for radar, one in rig.radars.items():
        if not _is_identity(one.calibration):
            found[f"{schema.CALIBRATION_PREFIX}{radar}.npz"] = _calibration_bytes(one)
    total = sum(map(len, found.values()))
    if total > LARGEST_ATTACHMENTS:
        raise RecordingError(
            f"{rig.directory}: too much to store with every recording",
            value=f"{total} bytes",
            allowed=f"at most {LARGEST_ATTACHMENTS} bytes",
            action="keep other files out of the rig's folder",
        )
    return found


def _is_identity(calibration: Calibration) -> bool:
    plain = bool((calibration.gain == 1).all() and (calibration.range_shift_bins == 0).all())
    return plain and math.isinf(calibration.reference_range_m)


def _calibration_bytes(radar: Radar) -> bytes:
    calibration = radar.calibration
    if calibration.made_with is None:
        calibration = replace(calibration, made_with=Waveform.of(radar.schedule))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "calibration.npz"
        save_calibration(path, calibration)
        return path.read_bytes()
