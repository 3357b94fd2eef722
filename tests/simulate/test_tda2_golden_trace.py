# SPDX-License-Identifier: Apache-2.0
"""The golden trace of a complete configuration, capture and stop, replayed byte for byte: every step is answered ok."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest
import tda2_host as h
from tda2_captures import eventually, supply
from tda2_host import ACK, Host

from edge.frames import Layout
from train.simulate.tda2_board import Tda2Board, Tda2Settings

LAYOUT = Layout("cascade", 4, 16, 12, 256, 4)
_LINE = re.compile(r"#\d+ dev=(\d+) at=0x(\d\d) (\w+)")
_SPI = re.compile(
    r"opcode=0x(\w{4})\(.*msg=0x(\w{3})\) len=(\d+) flags=0x(\w{4}) rem=(\d+) nsbc=(\d+) chk=0x(\w{4}) "
    r"sb=0x(\w{4}) sblen=(\d+) data=(\w*) rest=(\w{8})"
)


@pytest.fixture(scope="session")
def trace(radar_data: Path) -> list[str]:
    path = radar_data.parent / "golden_tda_trace.txt"
    if not path.is_file():
        pytest.skip("golden_tda_trace.txt does not lie beside the real recordings")
    return path.read_text(encoding="ascii").splitlines()


def spi_message(line: str) -> tuple[bytes, int, int, int]:
    """The SPI bytes of a line put together from its fields, sub-block, message and order."""
    match = _SPI.search(line)
    assert match, line
    opcode, message, length, flags, remaining, count, check, block, size, data, crc = match.groups()
    words = int(opcode, 16), int(length), int(flags, 16), int(remaining), int(count), int(check, 16)
    header = struct.pack("<6H", *words)
    body = header + struct.pack("<2H", int(block, 16), int(size)) + bytes.fromhex(data) + bytes.fromhex(crc)
    assert len(body) == int(length)
    first = int(data[:2], 16) if data else -1
    return bytes.fromhex("34122143") + body, int(block, 16), int(message, 16), first


def replay_spi(host: Host, device: int, line: str) -> None:
    message, block, number, first = spi_message(line)
    host.spi(device, message)
    got = host.read_answer(device)
    assert got.refusal is None, f"{line}: refused {got.refusal}"
    assert (got.kind, got.message) == (1, number), line
    assert got.sequence == struct.unpack_from("<H", message, 8)[0] >> 12
    event = {0x4000: 0x5001, 0x00C0: 0x1004}.get(block)
    if block == 0x0140:
        event = 0x100B if first == 1 else 0x100F
    if event:
        host.event(device, event)


def test_golden_trace(trace: list[str], tmp_path: Path) -> None:
    board = Tda2Board("horizontal", supply(LAYOUT), tmp_path, Tda2Settings(pace=20.0)).start()
    steps = 0
    loaded: set[int] = set()
    try:
        with Host(board.address) as host:
            for line in trace:
                match = _LINE.match(line)
                if "FW chunk" in line or not match:
                    continue  # only their heads are in the trace: all 35 are sent before the CRC type
                device = int(match[1])
                if match[3] == "SPI_WRITE":
                    if device not in loaded:
                        loaded.add(device)
                        h.load_firmware(host, device)
                    if "sb=0x0140" in line and "data=00000000" in line and device == 8:
                        eventually(lambda: board.bursts >= 2)
                    replay_spi(host, device, line)
                else:
                    order = bytes.fromhex(line.split("full=")[1])
                    host.send(struct.pack("<I", len(order)) + order)
                    opcode, code, _, _ = host.answer()
                    assert code == struct.unpack_from("<H", order, 2)[0], line
                    assert opcode == (0x83 if match[3] == "VERSION_GET" else ACK), line
                    if match[3] == "DEV_RESET":
                        host.event(device, 0x5000)
                steps += 1
        assert board.violations == []
        assert (steps, len(loaded)) == (172 - 3, 4)
        written = board.recorder.written
        assert min(written) >= 2
        size = (tmp_path / "testdir" / "slave3_0000_data.bin").stat().st_size
        assert size == written[3] * 16 * 12 * 256 * 4 * 4
        frame = board.chips[0].frame
        assert frame is not None
        assert (frame.loops, frame.period * 5e-9) == (16, pytest.approx(0.1))
        assert board.chips[3].chirps[0].tx_enable == 4
    finally:
        assert board.stop()
