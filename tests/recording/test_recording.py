# SPDX-License-Identifier: Apache-2.0
"""Recordings: exact round trip, readable by the MCAP project's own readers, replayable by themselves."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, Writer
from recording_rigs import BIG, LAYOUT, assert_same, content, frame, inputs, pose, results, small_rig, write

from edge.calibration import Calibration, Waveform
from edge.errors import RecordingError
from edge.frames import Layout, Pose, RadarFrame
from edge.recording import schema
from edge.recording.reader import RecordingReader
from edge.recording.writer import RecordingWriter
from edge.rig import load_rig
from edge.sources.base import FrameSource


@pytest.mark.parametrize("layout", [LAYOUT, BIG, Layout("dca1000_real", 1, 2, 4, 8, 4)])
def test_round_trip(tmp_path: Path, layout: Layout) -> None:
    rig, items, path = small_rig(tmp_path / "rig", layout), content(12, layout), tmp_path / "a.mcap"
    with RecordingWriter(path, rig) as writer:
        write(writer, items)
    with RecordingReader(path) as reader:
        assert isinstance(reader, FrameSource)
        for _ in range(2):
            assert_same(list(reader), inputs(items))
            assert_same(list(reader.results()), results(items))
        assert all(x.adc.flags.aligned and x.adc.flags.writeable for x in reader if isinstance(x, RadarFrame))
        assert (reader.total_frames, reader.recovered, reader.truncated) == (24, 48, False)
        assert (reader.rig_name, reader.config_hash) == ("rig", bytes(range(8)))
        info = reader.info()
        assert info["topics"] == {"/radar/horizontal/raw": 12, "/radar/vertical/raw": 12, "/pose": 12, "/shape": 12}
        assert info["duration_s"] == pytest.approx(11 * 0.02 + 0.015)
        assert json.loads(json.dumps(info))["rig"] == "rig"
        report = reader.verify()
        assert (report.messages, report.damaged_chunks, report.bytes_lost, report.missing) == (48, 0, 0, 0)


@pytest.mark.parametrize("layout", [LAYOUT, BIG])
@pytest.mark.parametrize("make", [make_reader, NonSeekingReader])
def test_the_mcap_projects_readers_agree(tmp_path: Path, layout: Layout, make: Any) -> None:
    rig, items, path = small_rig(tmp_path / "rig", layout), content(5, layout), tmp_path / "a.mcap"
    with RecordingWriter(path, rig) as writer:
        write(writer, items)

    def opened() -> Any:
        return make(BytesIO(path.read_bytes()), validate_crcs=True)

    messages = list(opened().iter_messages(log_time_order=False))
    assert [c.topic for _, c, _ in messages] == ["/radar/horizontal/raw", "/pose", "/radar/vertical/raw", "/shape"] * 5
    for (stored, _, message), item in zip(messages, items, strict=True):
        if isinstance(item, RadarFrame):
            assert stored.name == "rfconstruct.RawFrame.v1"
            assert message.data[64:] == item.adc.astype("<i2").tobytes()
            assert (message.sequence, message.log_time) == (item.number, item.t_first_chirp_ns)
        elif isinstance(item, Pose):
            assert stored.name == "foxglove.PoseInFrame"
            assert json.loads(message.data)["pose"]["position"]["y"] == 1 / 3
    statistics = opened().get_summary().statistics
    assert (statistics.message_count, statistics.schema_count, statistics.channel_count) == (20, 3, 11)
    assert statistics.message_start_time == 10**9
    assert [a.name for a in opened().iter_attachments()] == ["rig/rig.toml"]


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
@pytest.mark.parametrize("chunked", [True, False])
def test_files_of_the_mcap_projects_writer(tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
    path, items = tmp_path / "a.mcap", [frame("horizontal", n) for n in range(3)]
    writer = Writer(str(path), compression=compression, use_chunking=chunked)
    writer.start("rfconstruct", "test")
    channel = writer.register_channel("/radar/horizontal/raw", "x", writer.register_schema("x", "", b""))
    for item in items:
        writer.add_message(channel, 1, schema.frame_header(item) + item.adc.tobytes(), 1)
    writer.finish()
    with RecordingReader(path) as reader:
        if chunked and compression is not CompressionType.NONE:
            with pytest.raises(RecordingError, match="compressed chunk"):
                list(reader)
        else:
            assert_same(list(reader), items)
        with pytest.raises(RecordingError, match="holds no rig"):
            reader.read_rig()


def test_a_recording_replays_by_itself(tmp_path: Path) -> None:
    """Rig and calibration come back from the file, also when the rig names a calibration that is somewhere else."""
    rig = load_rig("awr1843_pair")
    folder = tmp_path / "car"
    folder.mkdir()
    text = (rig.directory / "rig.toml").read_text()
    (folder / "rig.toml").write_text(
        text.replace("[radars.vertical]\n", '[radars.vertical]\ncalibration = "../c.npz"\n')
    )
    schedule = rig.radars["vertical"].schedule
    shape = (schedule.layout.slots, schedule.layout.rx)
    phase = np.linspace(0, 1, shape[0])[:, None] + np.linspace(0, 2, shape[1])
    measured = Calibration(
        np.exp(1j * phase).astype(np.complex64), np.zeros(shape), 5.0, made_with=Waveform.of(schedule)
    )
    calibrated = replace(
        rig,
        name="car",
        directory=folder,
        radars={**rig.radars, "vertical": replace(rig.radars["vertical"], calibration=measured)},
    )
    RecordingWriter(tmp_path / "a.mcap", calibrated).close()
    (folder / "rig.toml").unlink()
    with RecordingReader(tmp_path / "a.mcap") as reader:
        back = reader.read_rig()
        assert (back.name, back.config_hash) == ("car", rig.config_hash)
        assert back.config_hash == reader.config_hash
        assert np.allclose(back.radars["vertical"].calibration.gain, measured.gain, atol=1e-6)
        assert back.radars["vertical"].calibration.reference_range_m == 5.0
        assert math.isinf(back.radars["horizontal"].calibration.reference_range_m)
        directory = back.directory
        assert directory.is_dir()
    assert not directory.exists()


def test_what_the_rig_does_not_have_is_refused(tmp_path: Path) -> None:
    rig = small_rig(tmp_path / "rig", radars=["horizontal"])
    with RecordingWriter(tmp_path / "a.mcap", rig) as writer:
        with pytest.raises(RecordingError, match="contradicts rig"):
            writer.frame(frame("vertical", 0))
        with pytest.raises(RecordingError, match="contradicts rig"):
            writer.frame(frame("horizontal", 0, BIG))
        with pytest.raises(RecordingError, match="topic of no result"):
            writer.message("/radar/horizontal/raw", b"", 0)
        with pytest.raises(RecordingError, match="time cannot be recorded"):
            writer.pose(Pose(-1, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
        with pytest.raises(RecordingError, match="cannot be recorded"):
            writer.frame(replace(frame("horizontal", 0), number=-1))
        writer.frame(frame("horizontal", 1))
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert_same(list(reader), [frame("horizontal", 1)])
    writer.close()
    with pytest.raises(RecordingError, match="is closed"):
        writer.pose(pose(0))
    with pytest.raises(RecordingError, match="never overwritten"):
        RecordingWriter(tmp_path / "a.mcap", rig)
    with pytest.raises(RecordingError, match="check the folder"):
        RecordingWriter(tmp_path / "none" / "a.mcap", rig)


def test_files_that_are_no_recordings(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(RecordingError, match="cannot be opened"):
        RecordingReader(path)
    with pytest.raises(RecordingError, match="cannot be read"):
        RecordingReader(tmp_path)
    for garbage in (b"", b"\x89MCAP", b"PK\x03\x04" * 100):
        path.write_bytes(garbage)
        with pytest.raises(RecordingError, match="no MCAP file"):
            RecordingReader(path)
    writer = Writer(str(path))
    writer.start("ros2", "test")
    writer.finish()
    with pytest.raises(RecordingError, match="not a recording of rfconstruct"):
        RecordingReader(path)


def _header(**change: Any) -> bytes:
    fields = {"magic": b"RFCF", "version": 1, "radar": 0, "kind": 1, "number": 3, "t_ns": 4}
    fields |= {"devices": 1, "loops": 1, "slots": 2, "samples": 4, "rx": 2, "iq": 1, **change}
    return schema.FRAME_HEADER.pack(*fields.values())


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        (b"", "without its header"),
        (_header(version=2) + bytes(64), "unknown version"),
        (_header(magic=b"XXXX") + bytes(64), "unknown version"),
        (_header(radar=2) + bytes(64), "impossible header"),
        (_header(rx=0) + bytes(64), "impossible header"),
        (_header(devices=4) + bytes(64), "impossible header"),
        (_header() + bytes(63), "wrong size"),
        (_header(samples=3) + bytes(48), "impossible header"),
    ],
)
def test_frames_that_contradict_themselves(payload: bytes, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        schema.decode_frame(memoryview(payload))
    decoded = schema.decode_frame(memoryview(_header() + bytes(64)))
    assert (decoded.number, decoded.t_first_chirp_ns, decoded.layout) == (3, 4, LAYOUT)


FINITE = st.floats(allow_nan=False, allow_infinity=False)


@given(st.integers(0, 2**63 - 1), st.tuples(FINITE, FINITE, FINITE), st.floats(0, 6.3))
def test_poses_come_back_exactly(t_ns: int, position: tuple[float, ...], angle: float) -> None:
    stored = Pose(t_ns, np.array(position), np.array([0.0, np.sin(angle), 0.0, np.cos(angle)]))
    read = schema.decode_pose(memoryview(schema.encode_pose(stored)))
    assert read.t_ns == t_ns
    assert np.array_equal(read.position_m, stored.position_m)
    assert np.array_equal(read.quaternion_xyzw, stored.quaternion_xyzw)


@pytest.mark.parametrize("payload", [b"", b"[]", b"{}", b'{"timestamp":1,"pose":2}', b"\xff", b"[" * 100_000])
def test_poses_that_are_none(payload: bytes) -> None:
    with pytest.raises(RecordingError, match="no pose"):
        schema.decode_pose(memoryview(payload))


def test_other_frames_under_a_topic_are_refused(tmp_path: Path) -> None:
    for first, second, message in (
        ("horizontal", "vertical", "under topic"),
        ("vertical", "vertical", "another layout"),
    ):
        path = tmp_path / f"{first}.mcap"
        writer = Writer(str(path), compression=CompressionType.NONE)
        writer.start("rfconstruct", "test")
        channel = writer.register_channel(f"/radar/{first}/raw", "x", writer.register_schema("x", "", b""))
        for item in (frame(first, 0), frame(second, 1, LAYOUT if first == "horizontal" else BIG)):  # type: ignore[arg-type]
            writer.add_message(channel, 1, schema.frame_header(item) + item.adc.tobytes(), 1)
        writer.finish()
        with RecordingReader(path) as reader, pytest.raises(RecordingError, match=message):
            list(reader)


@pytest.mark.parametrize("name", ["../outside", "..", "a/b", "nul\0", "x" * 300])
def test_names_in_a_recording_never_leave_its_folder(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.mcap"
    writer = Writer(str(path), compression=CompressionType.NONE)
    writer.start("rfconstruct", "test")
    writer.add_metadata("rfconstruct", {"rig": "car"})
    text = (load_rig("awr1843_pair").directory / "rig.toml").read_bytes()
    writer.add_attachment(0, 0, "rig/rig.toml", "", text)
    writer.add_attachment(0, 0, f"rig/{name}", "", b"hostile")
    writer.finish()
    with RecordingReader(path) as reader:
        assert [p.name for p in reader.read_rig().directory.iterdir()] == ["rig.toml"]
    writer = Writer(str(path), compression=CompressionType.NONE)
    writer.start("rfconstruct", "test")
    writer.add_metadata("rfconstruct", {"rig": name})
    writer.add_attachment(0, 0, "rig/rig.toml", "", text)
    writer.finish()
    with RecordingReader(path) as reader, pytest.raises(RecordingError, match="holds no rig"):
        reader.read_rig()
