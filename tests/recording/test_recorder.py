# SPDX-License-Identifier: Apache-2.0
"""Recording beside a pipeline: never waits, bounded, every message is written or counted as dropped."""

from __future__ import annotations

import resource
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from recording_rigs import BIG, assert_same, content, frame, inputs, pose, small_rig

from edge.errors import RecordingError
from edge.frames import LossCause, RadarFrame
from edge.recording.reader import RecordingReader
from edge.recording.recorder import Recorder, tee
from edge.recording.writer import RecordingWriter
from edge.sources.base import Loss


class Held:
    """A writer whose disk stands still until it is released."""

    def __init__(self, writer: RecordingWriter) -> None:
        self.path, self._writer = writer.path, writer
        self.released, self.entered = threading.Event(), threading.Event()

    def frame(self, one: RadarFrame) -> None:
        self.entered.set()
        assert self.released.wait(60)
        self._writer.frame(one)

    def __getattr__(self, name: str) -> object:
        return getattr(self._writer, name)


@pytest.fixture
def held(tmp_path: Path) -> Iterator[Held]:
    writer = Held(RecordingWriter(tmp_path / "a.mcap", small_rig(tmp_path / "rig", BIG)))
    yield writer
    writer.released.set()


def test_everything_that_passes_is_recorded(tmp_path: Path) -> None:
    items = inputs(content(8, BIG))
    loss = Loss("horizontal", 99, LossCause.GAP, "never came", 5)
    with Recorder(RecordingWriter(tmp_path / "a.mcap", small_rig(tmp_path / "rig", BIG))) as recorder:
        passed = list(tee([*items, loss], recorder))  # type: ignore[list-item]
    assert passed == [*items, loss]
    assert recorder.written == {"/radar/horizontal/raw": 8, "/radar/vertical/raw": 8, "/pose": 8}
    assert not recorder.dropped
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert_same(list(reader), items)
        assert not reader.truncated


def test_a_buffer_may_be_used_again_at_once(held: Held) -> None:
    recorder, adc = Recorder(held), np.empty(BIG.shape, np.int16)  # type: ignore[arg-type]
    truth = [frame("horizontal", number, BIG) for number in range(6)]
    for one in truth:
        np.copyto(adc, one.adc)
        assert recorder.put(RadarFrame("horizontal", one.number, one.t_first_chirp_ns, adc, BIG))
        adc[:] = -1
    held.released.set()
    recorder.close()
    with RecordingReader(held.path) as reader:
        assert_same(list(reader), truth)


def test_a_slow_disk_drops_what_does_not_fit_and_counts_it(held: Held) -> None:
    recorder = Recorder(held, queue_bytes=4 * BIG.nbytes)  # type: ignore[arg-type]
    assert recorder.put(frame("horizontal", 0, BIG))
    assert held.entered.wait(60)
    accepted = [recorder.put(frame("horizontal", number, BIG)) for number in range(1, 11)]
    assert accepted == [True] * 3 + [False] * 7, "one is being written, three wait"
    assert recorder.waiting_bytes == 4 * BIG.nbytes
    assert recorder.dropped == {"/radar/horizontal/raw": 7}
    held.released.set()
    recorder.close()
    assert recorder.written == {"/radar/horizontal/raw": 4}
    assert recorder.bytes_written == 4 * BIG.nbytes
    with RecordingReader(held.path) as reader:
        assert [one.number for one in reader if isinstance(one, RadarFrame)] == [0, 1, 2, 3]


def test_a_full_disk_ends_the_recording_and_nothing_else(tmp_path: Path) -> None:
    """A file size limit acts as a disk that becomes full; the source is played to its end."""
    items = [frame("horizontal", number, BIG) for number in range(40)]
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    recorder = Recorder(RecordingWriter(tmp_path / "a.mcap", small_rig(tmp_path / "rig", BIG)))
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20 * BIG.nbytes, before[1]))
        assert len(list(tee(items, recorder))) == 40
        with pytest.raises(RecordingError, match=r"recording stopped.*free space"):
            recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    written, dropped = sum(recorder.written.values()), sum(recorder.dropped.values())
    assert (written + dropped, 15 <= written < 20) == (40, True)
    assert recorder.failure is not None
    assert not recorder.put(pose(1)), "the recording has ended"
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert_same(list(reader), items[:written])


def test_a_frame_of_another_rig_ends_the_recording_with_a_reason(tmp_path: Path) -> None:
    recorder = Recorder(RecordingWriter(tmp_path / "a.mcap", small_rig(tmp_path / "rig", BIG)))
    recorder.put(frame("horizontal", 0))
    with pytest.raises(RecordingError, match="contradicts rig"):
        recorder.close()
