# SPDX-License-Identifier: Apache-2.0
"""Writes capture folders as the cascade's recorder does: data and index files of four chips, new files at the limit.

Header and entries are those of four real index files (``edge/sources/ti_index.py`` describes them); the two buffer
addresses that a real entry carries are 0 here. Source: hardware notes 1.7.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import BinaryIO

from edge.frames import Int16

CHIP_NAMES = ("master", "slave1", "slave2", "slave3")
ROLL_OVER_BYTES = 2047 * 2**20
_HEADER = struct.Struct("<4sIIIQ")
_ENTRY = struct.Struct("<HHIHH4IIQQ")
_FRAME_TAG, _VERSION, _VALID = 0x6469, 1, 1


class CaptureWriter:
    """One recording of four chips.

    The header of an index file counts 0 frames until the file is closed, as an interrupted recording would leave it.

    Args:
        folder: made when it is absent; file numbers go on after those that it holds.
        width: int16 values of a chirp, all receivers.
        height: chirps of a frame.
        roll_over_bytes: a data file grows to this at most.
        preallocated: files of this size that are made in advance and keep it.
    """

    def __init__(
        self, folder: Path, width: int, height: int, roll_over_bytes: int = ROLL_OVER_BYTES, preallocated: int = 0
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.frames = folder, [0, 0, 0, 0]
        """Frames of each chip."""
        self._size, self._roll_over, self._first = (width, height), roll_over_bytes, _next_number(folder)
        self._chips = [_ChipFiles(self, chip) for chip in range(4)]
        for number in range(self._first, self._first + preallocated):
            for name in CHIP_NAMES:
                with (folder / f"{name}_{number:04d}_data.bin").open("wb") as file:
                    file.truncate(roll_over_bytes)

    def write(self, chip: int, samples: Int16, t_us: int) -> None:
        """Append one chip's frame.

        Args:
            chip: 0 master, 1..3 slaves.
            samples: int16 of ``width * height``, C-contiguous.
            t_us: the recorder's clock.
        """
        self._chips[chip].write(samples, t_us)
        self.frames[chip] += 1

    def close(self) -> None:
        """Close all files; the index headers get their counts."""
        for chip in self._chips:
            chip.close()

    def cut(self) -> None:
        """Power cut: the last frame's data are half written, the index headers still count 0 frames."""
        for chip in self._chips:
            chip.cut()


class _ChipFiles:
    """The open pair of files of one chip."""

    def __init__(self, writer: CaptureWriter, chip: int) -> None:
        self._writer, self._chip, self._number = writer, chip, writer._first
        self._data: BinaryIO | None = None
        self._index: BinaryIO | None = None
        self._count = self._bytes = 0

    def write(self, samples: Int16, t_us: int) -> None:
        if self._data is not None and self._bytes + samples.nbytes > self._writer._roll_over:
            self.close()
            self._number += 1
        if self._data is None or self._index is None:
            self._data, self._index = self._open("data"), self._open("idx")
            self._index.write(_HEADER.pack(b"bckt", _VERSION, 0, 0, 0))
            self._count = self._bytes = 0
        width, height = self._writer._size
        place = (width & 0xFFFF, height & 0xFFFF, 2 * width, 0, 0, 0, samples.nbytes, t_us, self._bytes)
        self._data.write(samples.data)
        self._index.write(_ENTRY.pack(_FRAME_TAG, _VERSION, _VALID | self._chip << 8, *place))
        self._index.flush()
        self._count += 1
        self._bytes += samples.nbytes

    def close(self) -> None:
        if self._index is not None and self._data is not None:
            self._data.close()
            self._index.seek(0)
            self._index.write(_HEADER.pack(b"bckt", _VERSION, 0, self._count, self._bytes))
            self._index.close()
        self._data = self._index = None

    def cut(self) -> None:
        if self._index is not None and self._data is not None:
            width, height = self._writer._size
            self._data.truncate(self._bytes - width * height)
            self._data.close()
            self._index.close()
        self._data = self._index = None

    def _open(self, kind: str) -> BinaryIO:
        path = self._writer.folder / f"{CHIP_NAMES[self._chip]}_{self._number:04d}_{kind}.bin"
        if kind == "data" and path.exists():  # pre-allocated: keeps its size
            return path.open("r+b", buffering=0)
        return path.open("wb", buffering=0 if kind == "data" else -1)


def _next_number(folder: Path) -> int:
    numbers = [int(m[1]) for m in (re.fullmatch(r"\w+_(\d{4})_data\.bin", p.name) for p in folder.iterdir()) if m]
    return max(numbers, default=-1) + 1
