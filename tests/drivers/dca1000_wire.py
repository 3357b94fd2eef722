# SPDX-License-Identifier: Apache-2.0
"""A capture card's bytes for tests: recorded ones, and packets cut from a stream independently of the driver."""

from __future__ import annotations

import struct
from pathlib import Path

PAYLOAD = 1456


def pcap_payloads(path: Path) -> list[bytes]:
    """UDP payloads of a capture of Ethernet frames."""
    content, place, found = path.read_bytes(), 24, []
    while place < len(content):
        (length,) = struct.unpack_from("<I", content, place + 8)
        frame = content[place + 16 : place + 16 + length]
        place += 16 + length
        found.append(frame[42 : 34 + struct.unpack_from(">H", frame, 38)[0]])
    return found


def packets_of(stream: bytes, start: int = 0) -> list[bytes]:
    """Packets of a recording; ``start``: number of packets before these."""
    found = []
    for place in range(0, len(stream), PAYLOAD):
        count = start * PAYLOAD + place
        head = struct.pack("<IIH", (count // PAYLOAD + 1) & 0xFFFFFFFF, count & 0xFFFFFFFF, count >> 32)
        found.append(head + stream[place : place + PAYLOAD])
    return found
