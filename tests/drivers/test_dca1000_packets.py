# SPDX-License-Identifier: Apache-2.0
"""Bytes of the capture card: the published vectors, the replies and packets captured from a real one."""

from __future__ import annotations

from pathlib import Path

import pytest
from dca1000_wire import pcap_payloads

from edge.drivers.dca1000.packets import (
    Answer,
    Code,
    Status,
    command,
    data_header,
    fpga_configuration,
    packet_delay,
    parse_answer,
    parse_data_header,
    parse_version,
)
from edge.errors import ConfigError, WireError


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (command(Code.SYSTEM_ALIVE), "5aa509000000aaee"),
        (command(Code.RECORD_START), "5aa505000000aaee"),
        (command(Code.RESET_RADAR), "5aa502000000aaee"),
        (command(Code.CONFIGURE_FPGA, fpga_configuration(2)), "5aa50300060001020102031eaaee"),
        (command(Code.PACKET_DELAY, packet_delay(25e-6)), "5aa50b000600be05350c0000aaee"),
    ],
)
def test_commands(packet: bytes, expected: str) -> None:
    assert packet.hex() == expected


def test_data_of_commands() -> None:
    assert packet_delay(5e-6).hex() == "be0571020000"
    assert packet_delay(500e-6).hex() == "be0524f40000"
    assert fpga_configuration(4).hex() == "01010102031e"
    with pytest.raises(ConfigError):
        packet_delay(4e-6)
    with pytest.raises(ConfigError):
        fpga_configuration(3)


def test_real_replies(radar_data: Path) -> None:
    """Ten replies of a real card; its version is 2.8."""
    answers = [parse_answer(p) for p in pcap_payloads(radar_data / "dca1000_pcap" / "test_cmd.pcap")]
    assert [a.code for a in answers] == [1, 2, 5, 6, 0x0B, 3, 4, 9, 0x0A, 0x0E]
    assert [a.status for a in answers[:9]] == [0] * 9
    version = parse_version(answers[9].status)
    assert (version.major, version.minor, version.playback, version.text()) == (2, 8, False, "2.8")
    assert parse_version(0x4402).text() == "2.8 (playback)"


def test_real_status_of_the_completed_recording(radar_data: Path) -> None:
    last = parse_answer(pcap_payloads(radar_data / "dca1000_pcap" / "test_one_frame.pcap")[-1])
    assert last == Answer(Code.ASYNC_STATUS, 0x0100)
    assert last.is_status
    assert Status(last.status) is Status.RECORD_COMPLETED
    assert Status(last.status).text() == "record completed"


def test_status_names() -> None:
    assert Status(0x0201).text() == "no lvds data, lvds buffer full"
    assert Status(0x8080).text() == "ddr full, unknown bits 0x8000"
    assert Status(0).text() == "none"


@pytest.mark.parametrize("packet", ["", "5aa5090000", "5aa509000000aaef", "5aa409000000aaee", "5aa509000000aaee00"])
def test_no_answers(packet: str) -> None:
    with pytest.raises(WireError):
        parse_answer(bytes.fromhex(packet))


def test_real_data_headers(radar_data: Path) -> None:
    packets = [p for p in pcap_payloads(radar_data / "dca1000_pcap" / "test_one_frame.pcap") if len(p) > 8]
    assert [parse_data_header(p) for p in packets] == [(k + 1, 1456 * k) for k in range(12)]
    assert [p[:10] for p in packets] == [data_header(k + 1, 1456 * k) for k in range(12)]


def test_48_bits() -> None:
    header = data_header(2**32 + 7, 2**47 + 3)
    assert parse_data_header(header + b"x") == (7, 2**47 + 3)
    for size in (0, 9, 10, 1467):
        with pytest.raises(WireError):
            parse_data_header(bytes(size))
