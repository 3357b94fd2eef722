# SPDX-License-Identifier: Apache-2.0
"""Separable transmitter x receiver model of a calibration, and the repair of channels that do not follow it.

A channel's phase and delay are those of its transmitter plus those of its receiver, with a reflector at any distance:
the path is |p - A| + |p - B|. What does not follow that was measured on another echo or on a broken channel. Phases are
compared in the middle of the chirp: there a delay error of a fraction of a bin, such as the grid of the FFT that it was
read from, turns them least.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.errors import CalibrationError
from edge.frames import Complex64, Float64

if TYPE_CHECKING:
    from edge.waveform import Schedule

LARGEST_SHIFT_ERROR_BINS = 2.0
LARGEST_GAIN_ERROR_DB = 6.0
LARGEST_PHASE_ERROR_RAD = np.radians(30.0)
LARGEST_OUTLIER_SHARE = 0.1
ROUNDS = 20


def channel_name(schedule: Schedule, slot: int, receiver: int) -> str:
    """Name such as "TX2/RX13": the transmitter that fires in ``slot``, and the receiver in capture order from 1."""
    return f"TX{schedule.transmitters[slot]}/RX{receiver + 1}"


def additive_fit(values: Float64) -> Float64:
    """Robust model t[slot] + r[receiver] of ``values`` by median polish (Tukey, Exploratory Data Analysis, 1977)."""
    residual = values.copy()
    for _ in range(ROUNDS):
        residual -= np.median(residual, axis=1, keepdims=True)
        residual -= np.median(residual, axis=0, keepdims=True)
    return values - residual


def phasor_fit(phasor: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Robust unit-modulus model t[slot] r[receiver] of unit phasors: alternating medians of real and imaginary part."""
    receive = phasor[0].copy()
    transmit = np.ones(len(phasor), dtype=np.complex128)
    for _ in range(ROUNDS):
        transmit = _unit_median(phasor * receive.conj(), axis=1)
        receive = _unit_median(phasor * transmit.conj()[:, None], axis=0)
    return np.asarray(transmit[:, None] * receive)


def _unit_median(values: NDArray[np.complex128], axis: int) -> NDArray[np.complex128]:
    middle = np.median(values.real, axis=axis) + 1j * np.median(values.imag, axis=axis)
    return np.asarray(np.exp(1j * np.angle(middle)))


def repair_outliers(
    gain: NDArray[np.complexfloating], shift_bins: Float64, schedule: Schedule, path: Path
) -> tuple[Complex64, Float64, tuple[str, ...]]:
    """Replace channels far from the separable model by it.

    Args:
        gain: complex [slots, receivers], not zero.
        shift_bins: float64 [slots, receivers], bins of an Ns-point FFT.
        schedule: of the radar: samples of a chirp, and transmitters for the names.
        path: named in the error.
    Returns:
        Repaired gain and shift, and the names of the repaired channels in capture order.
    Raises:
        CalibrationError: more than a tenth of the channels (and more than one) are outliers: no calibration at all.
    """
    samples = schedule.profile.samples
    level_db = 20.0 * np.log10(np.abs(gain).astype(np.float64))
    turn = np.exp(-1j * np.pi * shift_bins * (samples - 1) / samples)
    phasor = np.exp(1j * np.angle(gain).astype(np.float64)) * turn
    level_fit, phase_fit, shift_fit = additive_fit(level_db), phasor_fit(phasor), additive_fit(shift_bins)
    bad = np.abs(shift_bins - shift_fit) > LARGEST_SHIFT_ERROR_BINS
    bad |= np.abs(level_db - level_fit) > LARGEST_GAIN_ERROR_DB
    bad |= np.abs(np.angle(phasor * phase_fit.conj())) > LARGEST_PHASE_ERROR_RAD
    names = tuple(channel_name(schedule, s, r) for s, r in np.argwhere(bad))
    if len(names) > max(1.0, LARGEST_OUTLIER_SHARE * bad.size):
        raise CalibrationError(
            f"{path}: {len(names)} of {bad.size} channels contradict any transmitter and receiver response",
            value=", ".join(names[:8]) + (", ..." if len(names) > 8 else ""),
            allowed=f"at most {100 * LARGEST_OUTLIER_SHARE:.0f} % outliers",
            action="calibrate again with one strong reflector on boresight, free of interference",
        )
    turn_fit = np.exp(-1j * np.pi * shift_fit * (samples - 1) / samples)
    fitted = 10.0 ** (level_fit / 20.0) * phase_fit * turn_fit.conj()
    repaired_gain = np.where(bad, fitted, gain).astype(np.complex64)
    return repaired_gain, np.where(bad, shift_fit, shift_bins), names
