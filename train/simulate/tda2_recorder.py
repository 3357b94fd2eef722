# SPDX-License-Identifier: Apache-2.0
"""The recorder of the cascade's capture board: its settings, the order they must come in, and the files."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from edge.frames import RadarFrame
from train.simulate.capture_writer import CaptureWriter
from train.simulate.tda2_protocol import NackError

SSD = "/mnt/ssd/"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
SETTINGS = ("period_ms", "session", "files", "packing", "frames")


@dataclass(slots=True)
class RecorderSettings:
    """What the host has set; None: not yet.

    Args:
        size: chip -> (int16 values of a chirp, chirps of a frame).
        period_ms: frame periodicity, whole milliseconds.
        session: directory name below /mnt/ssd.
        files: files that are made in advance.
        packing: 0: 16 bit.
        frames: to record; 0: until it is stopped.
    """

    size: dict[int, tuple[int, int]] = field(default_factory=dict)
    period_ms: int | None = None
    session: str | None = None
    files: int | None = None
    packing: int | None = None
    frames: int | None = None


class Recorder:
    """Takes frames of four chips and writes what the host ordered.

    Args:
        root: stands for /mnt/ssd.
        roll_over_bytes: largest data file.
        capacity_bytes: of the disk; frames beyond it are not written.
        complain: takes breaches of the protocol.
    Attributes:
        folder: of the last recording that was started; None: none.
        refused: frames that could not be written: other size than configured, or disk full.
    """

    def __init__(
        self, root: Path, roll_over_bytes: int, capacity_bytes: int, complain: Callable[[str], None]
    ) -> None:
        self.root, self.settings = root, RecorderSettings()
        self.folder: Path | None = None
        self.refused = 0
        self._roll_over, self._left, self._complain = roll_over_bytes, capacity_bytes, complain
        self._created = False
        self._written: tuple[int, ...] = (0, 0, 0, 0)
        self._writer: CaptureWriter | None = None
        self._recording = False

    @property
    def recording(self) -> bool:
        """Between start and stop."""
        return self._recording

    @property
    def written(self) -> list[int]:
        """Frames of each chip in the present recording, or the last one."""
        return list(self._written) if self._writer is None else list(self._writer.frames)

    def set_size(self, chip: int, width: int, height: int) -> None:
        """Capture configuration of one chip. NackError: not possible."""
        self._idle("capture configuration")
        if not (0 < width <= 2**16 and width % 8 == 0 and 0 < height <= 2**16):
            raise NackError(f"capture size {width} x {height}")
        self.settings.size[chip] = (width, height)
        self._created = False

    def set_session(self, data: bytes) -> None:
        """Directory name. NackError: not below /mnt/ssd, or with a NUL."""
        self._idle("session directory")
        text = data.decode("ascii", "replace")
        name = text.removeprefix(SSD)
        if not text.startswith(SSD) or not _NAME.fullmatch(name):
            raise NackError(f"session directory {text!r} instead of {SSD}NAME")
        self.settings.session = name

    def set_number(self, name: str, value: int) -> None:
        """One of period_ms, files, packing, frames. NackError: not possible."""
        self._idle(name)
        if name == "packing" and value != 0:
            raise NackError(f"packing {value}: the order of 12-bit values is not known, only 0 is emulated")
        if name == "period_ms" and value == 0:
            raise NackError("frame period of 0 ms")
        if name == "files" and value > 64:
            raise NackError(f"{value} files in advance")
        setattr(self.settings, name, value)

    def create(self, chips: set[int]) -> None:
        """Build the capture chain. NackError: something was not set."""
        self._idle("application")
        missing = [name for name in SETTINGS if getattr(self.settings, name) is None]
        missing += [f"capture size of chip {chip}" for chip in sorted(chips - set(self.settings.size))]
        if missing:
            raise NackError(f"application without {', '.join(missing)}")
        if len({self.settings.size[chip] for chip in chips}) > 1:
            raise NackError("chips with different capture sizes")
        self._created = True

    def start(self) -> None:
        """Open the files. NackError: no application, or it records already."""
        self._idle("record start")
        settings = self.settings
        if not self._created or settings.session is None:
            raise NackError("record start without application")
        self.folder = self.root / settings.session
        width, height = next(iter(settings.size.values()))
        self._writer = CaptureWriter(self.folder, width, height, self._roll_over, settings.files or 0)
        self._recording = True

    def stop(self) -> None:
        """Close the files; another recording needs another application. NackError: it does not record."""
        if not self._recording:
            raise NackError("record stop without record start")
        self.abandon()

    def abandon(self, cut: bool = False) -> None:
        """The same without an order: the board is stopped, or (``cut``) loses power in the middle of a frame."""
        if self._writer is not None:
            self._written = tuple(self._writer.frames)
            if cut:
                self._writer.cut()
            else:
                self._writer.close()
        self._writer, self._recording, self._created = None, False, False

    def take(self, frame: RadarFrame, t_us: int, chips: list[int]) -> None:
        """One frame of the chips that run."""
        writer = self._writer
        if writer is None or (self.settings.frames and max(writer.frames) >= self.settings.frames):
            return
        for chip in chips:
            samples = frame.adc[chip]
            width, height = self.settings.size.get(chip, (0, 0))
            if samples.size != width * height or samples.nbytes > self._left:
                self.refused += 1
                full = samples.size == width * height
                what = "the disk is full" if full else f"{width} x {height} configured, {samples.size} values came"
                self._complain(f"frame {frame.number} of chip {chip} is not written: {what}")
                continue
            self._left -= samples.nbytes
            writer.write(chip, samples, t_us)

    def _idle(self, what: str) -> None:
        if self._recording:
            raise NackError(f"{what} while it records")
