# SPDX-License-Identifier: Apache-2.0
"""The plan of all orders: the golden trace of a whole capture, recommended settings, dry run, firmware image."""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import pytest

from edge.board_settings import CascadeBoard
from edge.drivers.tda2.cascade import CascadeDriver
from edge.drivers.tda2.firmware import chunks, load_image
from edge.drivers.tda2.packets import BOARD, HOST_SYNC, MASTER, Opcode, PacketReader
from edge.drivers.tda2.plan import Plan, numbered
from edge.drivers.tda2.rhcp import parse_header, parse_message
from edge.drivers.tda2.steps import FILE, Command, Step
from edge.errors import ConfigError, FirmwareError
from edge.rig import load_rig
from edge.waveform import ChirpProfile, Schedule

IMAGE = b"MSTR".ljust(7936, b"\x5a")
_LINE = re.compile(r"#\d+ dev=(\d+) (?:at=0x\d\d )?(\w+)")
_SPI = re.compile(
    r"opcode=0x(\w{4})\(.*msg=0x(\w{3})\) len=(\d+) flags=0x(\w{4}) rem=(\d+) nsbc=(\d+) chk=0x(\w{4}) "
    r"sb=0x(\w{4}) sblen=(\d+) data=(\w*) rest=(\w{8})"
)


@pytest.fixture(scope="session")
def trace(radar_data: Path) -> list[str]:
    path = radar_data.parent / "golden_tda_trace.txt"
    if not path.is_file():
        pytest.skip("golden_tda_trace.txt does not lie beside the real recordings")
    return [line for line in path.read_text(encoding="ascii").splitlines() if line.startswith("#")]


def golden_schedule() -> Schedule:
    """TI's script with the slope of its Linux port: 16 loops every 100 ms."""
    profile = ChirpProfile("AWR2243", 77e9, 15.0148e12, 5e-6, 6e-6, 40e-6, 256, 8e6)
    return Schedule(profile, 16, 0.1)


def recommended() -> Schedule:
    schedule = load_rig("cascade_pair").radars["horizontal"].schedule
    return replace(schedule, frame_period_s=16.666665e-3)


def plan_of(schedule: Schedule, frames: int = 0, trace: bool = True) -> Plan:
    return Plan(schedule, CascadeBoard(trace=trace), chunks(IMAGE), frames)


def all_steps(plan: Plan) -> list[Step]:
    return [
        *plan.connect(1795299798),
        *plan.master(),
        *plan.slaves(),
        *plan.common(),
        *plan.record("/mnt/ssd/testdir", 0),
        *plan.start(),
        *plan.stop(),
        plan.stop_record(),
    ]


def spi_bytes(line: str) -> bytes:
    """The SPI message of a line, put together from its fields."""
    match = _SPI.search(line)
    assert match, line
    opcode, _, length, flags, remaining, count, check, block, size, data, crc = match.groups()
    words = int(opcode, 16), int(length), int(flags, 16), int(remaining), int(count), int(check, 16)
    body = struct.pack("<6H2H", *words, int(block, 16), int(size)) + bytes.fromhex(data + crc)
    return bytes.fromhex("34122143") + body


def test_whole_golden_trace(trace: list[str]) -> None:
    """Step by step the same bytes to the same devices; devices of one step come in any order, as TI's threads do."""
    lines = [line for line in trace if "FW chunk" not in line]
    by_step: list[tuple[Step, dict[int, bytes]]] = []
    for step, device, packet in numbered(all_steps(plan_of(golden_schedule()))):
        if not by_step or by_step[-1][0] is not step:
            by_step.append((step, {}))
        by_step[-1][1][device] = packet.data if packet.opcode == Opcode.SPI_WRITE else packet.to_bytes()[4:]
    compared = 0
    for step, sent in by_step:
        if isinstance(step.action, Command) and step.action.block == FILE:
            continue  # the trace has no bytes of the image
        taken, lines = lines[: len(sent)], lines[len(sent) :]
        expected = {}
        for line in taken:
            match = _LINE.match(line)
            assert match, line
            full = bytes.fromhex(line.split("full=")[1]) if "full=" in line else spi_bytes(line)
            expected[int(match[1])] = full
        assert sent == expected, step.text
        compared += len(sent)
    assert lines == []
    assert compared == 169


def test_golden_firmware_heads(trace: list[str]) -> None:
    heads = [line for line in trace if "FW chunk" in line]
    sent = [
        packet.data for step, device, packet in numbered(plan_of(golden_schedule()).master()) if "firm" in step.text
    ]
    assert len(sent) == 35
    assert len(heads) == 2
    for line, data in zip(heads, sent, strict=False):
        head = bytes.fromhex(line.split("rhcp_head=")[1].split()[0])
        assert data[:20] == head[:20]  # sync, header with its checksum, head of the sub-block
        assert len(data) == 256
    assert sent[0][:32] == bytes.fromhex(heads[0].split("rhcp_head=")[1].split()[0])
    assert len(sent[-1]) == 4 + 12 + 4 + 56 + 4


def test_golden_trace_decoded(trace: list[str]) -> None:
    """Every packet and message of the trace passes all checks and gives the fields written beside it."""
    packets = messages = 0
    for line in trace:
        if "full=" in line:
            body = bytes.fromhex(line.split("full=")[1])
            (packet,) = PacketReader(HOST_SYNC).feed(struct.pack("<I", len(body)) + body)
            match = re.match(r"#\d+ dev=(\d+) at=0x(\w\d) \w+\(0x(\w+)\) data=(\w*)", line)
            assert match
            device, ack_type, opcode, data = match.groups()
            assert (packet.device, packet.ack_type, packet.opcode) == (int(device), int(ack_type, 16), int(opcode, 16))
            assert packet.data.hex() == data
            packets += 1
        elif match := _SPI.search(line):
            raw = spi_bytes(line)[4:]
            header = parse_header(raw[:12])
            message = parse_message(header, raw[12:-4], raw[-4:])
            assert (header.message, header.sequence) == (int(match[2], 16), int(match[4], 16) >> 12)
            assert message.blocks == ((int(match[8], 16), bytes.fromhex(match[10])),)
            messages += 1
    assert (packets, messages) == (25, 144)


def test_recommended_settings() -> None:
    """Profile A with 8 loops at 60 frames/s: the published vectors of profile, frame, size, period."""
    sent = [
        (step.action.name, device, packet.data[20:-4] if packet.opcode == Opcode.SPI_WRITE else packet.data)
        for step, device, packet in numbered(all_steps(plan_of(recommended())))
    ]
    found = {(name, device): data.hex() for name, device, data in sent}
    assert found["profile", 8] == (
        "00000200e4388e55f401000058020000a00f00000000000000000000650600000001401f0000000030000000"
    )
    assert found["frame", 1] == "000000000b00080000000002d5dc32000100000000000000"
    assert found["frame", 2] == found["frame", 8] == "000000000b00080000000002d5dc32000200000000000000"
    assert found["apply the frame", 4] == "6000000000020000"
    assert found["size of a frame", 1] == "0008000060000000"
    assert found["frame period, whole ms", 32] == "10000000"


def test_one_transmitter_a_chirp() -> None:
    """Chirp i fires TX 12 - i: chirp table of the notes."""
    table = [(8, 4), (8, 2), (8, 1), (4, 4), (4, 2), (4, 1), (2, 4), (2, 2), (2, 1), (1, 4), (1, 2), (1, 1)]
    fired = {}
    for step, device, packet in numbered(plan_of(recommended()).common()):
        if step.phase == "chirps":
            first, last, profile, _, _, _, _, _, mask = struct.unpack("<4HI4H", packet.data[20:-4])
            assert (first, profile) == (last, 0)
            if mask:
                assert first not in fired
                fired[first] = (device, mask)
    assert [fired[index] for index in range(12)] == table


def test_numbers_of_frames_and_triggers() -> None:
    frames = {
        device: struct.unpack("<6HI2HI", packet.data[20:-4])
        for step, device, packet in numbered(plan_of(replace(recommended(), hardware_trigger=True)).reprogram(360))
        if step.action.name == "frame"
    }
    assert {fields[4] for fields in frames.values()} == {360}
    assert {fields[7] for fields in frames.values()} == {2}
    assert frames[1][6] == 0x324095
    orders = plan_of(replace(recommended(), packed_12_bit=True)).record("/mnt/ssd/x", 360)
    data = {packet.opcode: packet.data for _, _, packet in numbered(orders)}
    assert data[Opcode.NUM_FRAMES] == struct.pack("<I", 360)
    assert data[Opcode.PACKING] == struct.pack("<I", 1)


def test_trace_file_is_optional() -> None:
    orders = [packet.opcode for _, _, packet in numbered(plan_of(recommended(), trace=False).connect(1))]
    assert orders == [Opcode.PING, Opcode.VERSION_GET, Opcode.DEVICE_MAP, Opcode.CONNECT]
    assert len(plan_of(recommended(), trace=False).disconnect()) == 1


def driver(tmp_path: Path, firmware: str = "") -> CascadeDriver:
    board = CascadeBoard("10.255.255.1", firmware=firmware, segment_frames=60)
    return CascadeDriver("horizontal", recommended(), board, tmp_path)


def write_image(path: Path, data: bytes = IMAGE, crc: bytes | None = None) -> str:
    path.write_bytes(data + (zlib.crc32(data).to_bytes(4, "little") if crc is None else crc))
    return path.name


def test_dry_run_shows_every_packet(tmp_path: Path) -> None:
    """Nothing is opened: the address leads nowhere. Lines are whole packets, numbered without gaps."""
    lines = driver(tmp_path, write_image(tmp_path / "image.bin")).plan()
    shown = [line.split() for line in lines if re.match(r" +\d+  ", line)]
    assert [int(parts[0]) for parts in shown] == list(range(1, len(shown) + 1))
    stream = bytes.fromhex("".join(parts[-1] for parts in shown))
    packets = PacketReader(HOST_SYNC).feed(stream)
    assert len(packets) == len(shown)
    assert sum(packet.data[20:].startswith(b"\x5a" * 200) for packet in packets) == 4 * 33
    assert (packets[0].opcode, packets[-1].opcode) == (Opcode.PING, Opcode.TRACE_STOP)
    assert any("wait for event CALIBRATED" in line for line in lines)
    assert not any("image not at hand" in line for line in lines)
    assert {packet.device for packet in packets} == {MASTER, 2, 4, 8, BOARD}


def test_dry_run_without_the_image(tmp_path: Path) -> None:
    lines = driver(tmp_path).plan()
    assert any("image not at hand" in line and "MMWAVE-DFP" in line for line in lines)


@pytest.mark.parametrize(
    ("name", "data", "crc", "what"),
    [
        ("short.bin", IMAGE[:-1], None, "another size"),
        ("untrailed.bin", IMAGE, b"", "7936 bytes"),
        ("long.bin", IMAGE + b"\0", None, "7941 bytes"),
        ("empty.bin", b"", b"", "0 bytes"),
        ("other.bin", b"RPRC" + IMAGE[4:], None, "no firmware image"),
        ("altered.bin", IMAGE, b"\1\2\3\4", "damaged"),
    ],
)
def test_wrong_images(tmp_path: Path, name: str, data: bytes, crc: bytes | None, what: str) -> None:
    with pytest.raises(FirmwareError, match=what) as error:
        load_image(write_image(tmp_path / name, data, crc), tmp_path)
    assert "mmWave DFP" in str(error.value)


def test_absent_images(tmp_path: Path) -> None:
    for name, what in (("", "no firmware image"), ("absent.bin", "No such file"), (str(tmp_path), "directory")):
        with pytest.raises(FirmwareError, match=what):
            load_image(name, tmp_path)


def test_image_in_chunks(tmp_path: Path) -> None:
    parts = chunks(load_image(write_image(tmp_path / "image.bin"), tmp_path))
    assert [len(part) for part in parts] == [232] * 34 + [56]
    assert b"".join(parts) == struct.pack("<2I", 0, 7936) + IMAGE


def test_impossible_drivers(tmp_path: Path) -> None:
    single = load_rig("awr1843_pair").radars["horizontal"].schedule
    with pytest.raises(ConfigError, match="AWR2243"):
        CascadeDriver("horizontal", single, CascadeBoard(), tmp_path)
    with pytest.raises(ConfigError, match="storage"):
        CascadeDriver("horizontal", recommended(), CascadeBoard(storage="/mnt/s\u00fcd"), tmp_path)
    with pytest.raises(ConfigError, match="frames of a capture"):
        driver(tmp_path).arm(65536)
