# SPDX-License-Identifier: Apache-2.0
"""Check sums of the capture board's packets and of the radar chips' headers."""

from __future__ import annotations

from collections.abc import Sequence

_POLYNOMIAL = 0x1021


def _table() -> tuple[int, ...]:
    values = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = crc << 1 ^ (_POLYNOMIAL if crc & 0x8000 else 0)
        values.append(crc & 0xFFFF)
    return tuple(values)


_TABLE = _table()


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF, not reflected; "123456789" gives 0x29B1."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _TABLE[crc >> 8 ^ byte]
    return crc


def ones_complement(words: Sequence[int]) -> int:
    """One's complement of the one's complement sum of 16-bit words (ICD: 0281 0800 040C 0000 0001 gives F171)."""
    total = sum(words)
    while total > 0xFFFF:
        total = (total & 0xFFFF) + (total >> 16)
    return total ^ 0xFFFF
