# SPDX-License-Identifier: Apache-2.0
"""Parts and repeated passes of recordings: whole pairs, poses around them, numbers and times that rise."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from recording_rigs import assert_same, content, frame, inputs, pose, results, small_rig, write

from edge.errors import ConfigError, RecordingError
from edge.frames import Pose, RadarFrame
from edge.recording import mcap_reading
from edge.recording.copying import copy_part
from edge.recording.playback import PASS_GAP_NS, POSE_MARGIN_NS, Part, Playback
from edge.recording.reader import RecordingReader
from edge.recording.survey import survey
from edge.recording.writer import RecordingWriter
from edge.sources.pairing import FramePairer

FRAMES = 100
"""Of each radar, 20 ms apart; the vertical one's come 10 ms later."""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("playback")
    with RecordingWriter(folder / "a.mcap", small_rig(folder / "rig")) as writer:
        write(writer, content(FRAMES))
    return folder / "a.mcap"


def played(path: Path, part: Part) -> tuple[list[RadarFrame], list[Pose]]:
    with RecordingReader(path) as reader:
        items = list(Playback(reader, part))
    return [i for i in items if isinstance(i, RadarFrame)], [i for i in items if isinstance(i, Pose)]


def numbers(frames: list[RadarFrame], radar: str) -> list[int]:
    return [one.number for one in frames if one.radar == radar]


def test_the_whole_recording_is_played_as_it_is(path: Path) -> None:
    with RecordingReader(path) as reader:
        playback = Playback(reader, Part())
        assert playback.total_frames == 2 * FRAMES
        assert_same(list(playback), inputs(content(FRAMES)))
        assert playback.passes == 1


def test_a_part_holds_whole_pairs_and_the_poses_around_them(path: Path) -> None:
    frames, poses = played(path, Part(0.6, 1.0))
    assert numbers(frames, "horizontal") == numbers(frames, "vertical") == list(range(30, 51))
    first_ns, last_ns = frames[0].t_first_chirp_ns, frames[-1].t_first_chirp_ns
    assert 0 < first_ns - poses[0].t_ns <= POSE_MARGIN_NS
    assert 0 < poses[-1].t_ns - last_ns <= POSE_MARGIN_NS
    assert all(any(one.t_ns == pose(n).t_ns for n in range(FRAMES)) for one in poses)
    pairs = FramePairer(("horizontal", "vertical"))
    assert sum(len(pairs.add(one)[0]) for one in frames) == 21
    assert not pairs.flush()


def test_what_lies_before_a_part_is_not_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = 0
    original = mcap_reading.McapFile._read_reused

    def counted(self: mcap_reading.McapFile, offset: int, length: int) -> memoryview:
        nonlocal read
        read += 1
        return original(self, offset, length)

    monkeypatch.setattr(mcap_reading.McapFile, "_read_reused", counted)
    frames, _ = played(path, Part(1.8))
    assert numbers(frames, "horizontal") == list(range(90, 100))
    assert 20 <= read < 100, "of two hundred chunks"


def test_passes_go_on_rising(path: Path) -> None:
    frames, poses = played(path, Part(loops=3))
    assert numbers(frames, "horizontal") == numbers(frames, "vertical") == list(range(3 * FRAMES))
    for radar in ("horizontal", "vertical"):
        times = [one.t_first_chirp_ns for one in frames if one.radar == radar]
        assert all(b > a for a, b in itertools.pairwise(times))
    times = [one.t_ns for one in poses]
    jumps = [b - a for a, b in itertools.pairwise(times)]
    assert min(jumps) > 0
    assert sum(jump >= PASS_GAP_NS for jump in jumps) == 2, "a gap that no window bridges"
    assert (frames[2 * FRAMES].adc == frames[0].adc).all()


def test_endless_passes_end_when_nobody_asks_for_more(path: Path) -> None:
    with RecordingReader(path) as reader:
        playback = Playback(reader, Part(loops=0))
        assert playback.total_frames is None
        for count, _ in enumerate(playback):
            if count > 1000:
                break
        assert playback.passes == 3


def test_a_part_without_frames_does_not_loop_for_ever(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", small_rig(tmp_path / "rig")) as writer:
        write(writer, [pose(1), pose(2), frame("horizontal", 5)])
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert [i for i in Playback(reader, Part(0.0, 0.01, loops=0)) if isinstance(i, RadarFrame)] == []


def test_impossible_parts_are_refused(path: Path) -> None:
    with pytest.raises(ConfigError, match="nothing lies between"):
        Part(2.0, 2.0)
    with pytest.raises(RecordingError, match="ends before the start"):
        played(path, Part(3.0))


def test_a_part_is_copied_with_results_and_rig(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RecordingReader, "read_rig", lambda self: small_rig(tmp_path / "rig"))
    report = copy_part(path, tmp_path / "b.mcap", Part(0.6, 1.0), ["for a test"])
    assert report.written["/radar/horizontal/raw"] == report.written["/radar/vertical/raw"] == 21
    assert not report.damaged
    with RecordingReader(tmp_path / "b.mcap") as reader:
        stored = list(reader.results())
        assert stored == [one for one in results(content(FRAMES)) if 1.6e9 <= one.t_ns <= 2.0e9]  # type: ignore[union-attr]
        assert reader.notes == ["for a test", "seconds 0.6 to 1 of a longer one"]


def test_the_survey_names_what_is_missing(tmp_path: Path) -> None:
    items = [item for item in content(50) if not (isinstance(item, RadarFrame) and item.number in (20, 21, 22))]
    with RecordingWriter(tmp_path / "a.mcap", small_rig(tmp_path / "rig")) as writer:
        write(writer, items)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        content_ = survey(reader)
    assert content_["whole"] is True
    radar = content_["streams"]["/radar/horizontal/raw"]
    assert (radar["messages"], radar["first_number"], radar["last_number"], radar["missing_numbers"]) == (47, 0, 49, 3)
    assert (radar["gaps"], radar["longest_gap"], radar["rate_hz"]) == (1, "0.080 s at 0.380 s", 50.0)
    assert "gaps" in content_["streams"]["/pose"]
    assert content_["streams"]["/pose"]["gaps"] == 0
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.mcap").write_bytes(data[:-1])
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert survey(reader)["whole"] is False
