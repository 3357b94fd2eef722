# SPDX-License-Identifier: Apache-2.0
"""Mean over loops and frames of a reflector capture, with what tells whether such a mean is allowed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.dsp.tables import window
from edge.errors import CalibrationError
from edge.frames import Float64, RadarFrame
from edge.reference.point_targets import unpack
from edge.waveform import Schedule

Complex128 = NDArray[np.complex128]
PADDING = 8
"""Points of a range profile for every bin of an Ns-point FFT."""
MOST_LOOPS = 8
LARGEST_SATURATED_SHARE = 1e-4
LOWEST_CODE, HIGHEST_CODE = -32768, 32767


@dataclass(frozen=True, slots=True, eq=False)
class CaptureMean:
    """A static scene, averaged coherently.

    Args:
        samples: complex128 [slots, receivers, sample], LSB, mean over loops and frames.
        frames, loops: how many frames of how many loops.
        saturated_share: share of all I and Q codes at the rails.
        dead: bool [slots, receivers], channels that gave one constant value in a whole frame.
        history: complex128 [frame, loop, slots, receivers], spectrum of every loop at the range that was watched.
        first_profile: float64 [PADDING * sample], range profile of the first frame, its loops added incoherently: it
            shows a reflector that moves.
    """

    samples: Complex128
    frames: int
    loops: int
    saturated_share: float
    dead: NDArray[np.bool_]
    history: Complex128
    first_profile: Float64


class CaptureAverager:
    """Adds up frames and watches one range in every loop.

    Args:
        schedule: of the radar.
        expected_bin: where the reflector is expected, bins of an Ns-point FFT.
        search_bins: it is looked for this far to either side; the strongest range of the first frame is watched.
    """

    def __init__(self, schedule: Schedule, expected_bin: float, search_bins: float) -> None:
        layout = schedule.layout
        self._layout = layout
        self._search = (expected_bin - search_bins, expected_bin + search_bins)
        self._taper = range_taper(layout.samples)
        self._sum = np.zeros((layout.slots, layout.devices * layout.rx, layout.samples), dtype=np.complex128)
        self._dead = np.zeros(self._sum.shape[:2], dtype=np.bool_)
        self._history: list[Complex128] = []
        self._rails = 0
        self._watch: Complex128 | None = None
        self._profile = np.zeros(0)

    @property
    def frames(self) -> int:
        """Frames added."""
        return len(self._history)

    def add(self, frame: RadarFrame) -> None:
        """Add one frame.

        Raises:
            CalibrationError: its layout is not the schedule's.
        """
        if frame.layout != self._layout:
            raise CalibrationError(
                f"{frame.radar} frame {frame.number} has another layout than the rig's schedule",
                value=frame.layout,
                allowed=str(self._layout),
                action="give the rig that the capture was made with (--rig)",
            )
        self._rails += int(np.count_nonzero((frame.adc == LOWEST_CODE) | (frame.adc == HIGHEST_CODE)))
        samples = unpack(frame.adc, self._layout)
        self._dead |= (samples == samples[..., :1]).all(axis=(0, 3))
        if self._watch is None:
            self._profile = range_profile(samples[:: -(-len(samples) // MOST_LOOPS)], self._taper)
            self._watch = self._phasor_of_strongest()
        self._history.append(samples @ self._watch)
        self._sum += samples.mean(axis=0)

    def mean(self) -> CaptureMean:
        """What was added so far.

        Raises:
            CalibrationError: nothing was.
        """
        if not self._history:
            raise CalibrationError("the capture holds no frame of this radar", action="check --radar and the capture")
        codes = self.frames * self._layout.int16_count
        return CaptureMean(
            *(self._sum / self.frames, self.frames, self._layout.loops, self._rails / codes, self._dead),
            np.stack(self._history),
            self._profile,
        )

    def _phasor_of_strongest(self) -> Complex128:
        """Windowed DFT phasor of the searched range with the most power."""
        first, last = (round(PADDING * edge) for edge in self._search)
        here = np.clip(np.arange(first, last + 1), 0, len(self._profile) - 1)
        return phasor(np.array(here[self._profile[here].argmax()] / PADDING), self._taper)


def range_taper(samples: int) -> Float64:
    """Hann window about the middle of the chirp, sum 1: a tone of amplitude a gives a peak of a."""
    taper = window("hann", samples, samples / 2)
    return np.asarray(taper / taper.sum())


def phasor(range_bin: Float64, taper: Float64) -> Complex128:
    """Windowed DFT phasors [..., sample] at fractional bins; phases count from the middle of the chirp."""
    n = np.arange(len(taper)) - len(taper) / 2
    return np.asarray(taper * np.exp(-2j * np.pi * np.asarray(range_bin)[..., None] * n / len(taper)))


def range_profile(samples: Complex128, taper: Float64) -> Float64:
    """Mean power [PADDING * Ns] over all leading axes of ``samples`` [..., sample]."""
    flat = samples.reshape(-1, samples.shape[-1])
    power = np.zeros(PADDING * len(taper))
    for start in range(0, len(flat), 256):
        spectrum = np.fft.fft(flat[start : start + 256] * taper, PADDING * len(taper))
        power += (spectrum.real**2 + spectrum.imag**2).sum(axis=0)
    return power / len(flat)
