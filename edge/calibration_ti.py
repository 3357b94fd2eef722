# SPDX-License-Identifier: Apache-2.0
"""Import of TI's cascade calibration file, ``calibrateResults_high.mat``.

TI's MATLAB script points the board at a corner reflector on boresight and stores, for every transmitter and receiver,
the peak of a 5x zero-padded range FFT: ``RangeMat`` (its bin, counted from 1) and ``PeakValMat`` (its complex value).
Following TI's processing, every channel is moved and turned onto TX12/RX1; amplitudes stay as they are (phase only),
for equal gains would weigh the noise of weak channels up.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from edge.calibration import DUMMY_VALUE, Calibration, Waveform, refuse_dummy
from edge.calibration_fit import repair_outliers
from edge.errors import CalibrationError, DependencyError
from edge.frames import Float64
from edge.waveform import SPEED_OF_LIGHT_M_S, Schedule

INTERPOLATION = 5
DEFAULT_SLOPE_HZ_PER_S = 78.986e12
DEFAULT_SAMPLE_RATE_HZ = 8e6


def import_ti_calibration(mat_path: Path, schedule: Schedule) -> Calibration:
    """Calibration of a cascade board from TI's file, rows turned from TX1..TX12 into firing order.

    With b the bins of ``RangeMat`` and P ``PeakValMat``: range shift (b - b_ref) / 5 and gain exp(j arg(P_ref / P)),
    ref being the first slot and receiver. The reflector's range, whose wavefront the phases contain, is
    (median b - 1) / 5 range bins; the few centimetres that cables add to it change the curvature by a percent.

    Args:
        mat_path: MATLAB 5 file with ``calibResult`` and, if present, ``params``.
        schedule: of the radar that will use it.
    Raises:
        CalibrationError: unreadable, a dummy, made with another slope, sample rate, number of samples or of channels.
        DependencyError: SciPy (extra ``import``) is missing.
    """
    result, params = _read(mat_path)
    bins, peak = _matrix(result, "RangeMat", mat_path).real, _matrix(result, "PeakValMat", mat_path)
    wanted = Waveform.of(schedule)
    _made_with(result, params, bins, wanted).require_same(wanted, mat_path)
    refuse_dummy(peak, mat_path, "PeakValMat")
    if (bins == DUMMY_VALUE).any():
        refuse_dummy(bins, mat_path, "RangeMat")
    rows = np.array(schedule.transmitters) - 1
    bins, peak = bins[rows], peak[rows]
    if not np.isfinite(peak).all() or (peak == 0).any():
        raise CalibrationError(f"{mat_path}: PeakValMat has zeros or is not finite", action="calibrate the board again")
    shift = (bins - bins[0, 0]) / INTERPOLATION
    gain, shift, repaired = repair_outliers(peak[0, 0] / peak, shift, schedule, mat_path)
    bin_m = SPEED_OF_LIGHT_M_S * wanted.sample_rate_hz / (2.0 * wanted.slope_hz_per_s * wanted.samples)
    return Calibration(
        (gain / np.abs(gain)).astype(np.complex64),
        shift,
        reference_range_m=float(np.median(bins) - 1.0) / INTERPOLATION * bin_m,
        board=f"TI calibration {mat_path.name}",
        date=_date(mat_path),
        made_with=wanted,
        repaired=repaired,
    )


def _read(path: Path) -> tuple[Any, Any]:
    try:
        from scipy.io import loadmat
    except ImportError as error:
        raise DependencyError(
            f"{path}: reading MATLAB files needs SciPy", action="pip install 'rfconstruct[import]'"
        ) from error
    if not path.is_file():
        raise CalibrationError(f"{path}: no such calibration file", action="check the path")
    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except Exception as error:  # SciPy's parser raises whatever the damaged bytes provoke
        raise CalibrationError(f"{path}: not a MATLAB 5 file, or damaged", value=str(error)) from error
    if "calibResult" not in content:
        raise CalibrationError(
            f"{path}: not TI's cascade calibration",
            value=", ".join(name for name in content if not name.startswith("_")),
            allowed="a structure calibResult with RangeMat and PeakValMat",
        )
    return content["calibResult"], content.get("params")


def _matrix(result: Any, name: str, path: Path) -> np.ndarray[Any, np.dtype[np.complex128]]:
    """A [TX, RX] matrix as complex128: integer types differ from file to file and must not wrap when subtracted."""
    value = np.asarray(getattr(result, name, None))
    if value.ndim != 2 or value.dtype.kind not in "iufc":
        raise CalibrationError(
            f"{path}: calibResult.{name} is missing or no matrix", value=value.shape, allowed="numbers [TX, RX]"
        )
    return value.astype(np.complex128)


def _made_with(result: Any, params: Any, bins: Float64, wanted: Waveform) -> Waveform:
    """What the file says; device and start frequency are not in it and are taken from the rig."""
    spectrum = np.asarray(getattr(result, "Rx_fft", None))
    samples = spectrum.shape[0] // INTERPOLATION if spectrum.ndim == 3 else wanted.samples
    slope_mhz_per_us = float(getattr(params, "Slope_MHzperus", 0.0) or DEFAULT_SLOPE_HZ_PER_S / 1e12)
    rows = bins.shape[0]
    return Waveform(
        device=wanted.device,
        transmitters=wanted.transmitters if rows >= max(wanted.transmitters) else tuple(range(1, rows + 1)),
        receivers=bins.shape[1],
        start_frequency_hz=wanted.start_frequency_hz,
        slope_hz_per_s=slope_mhz_per_us * 1e12,
        sample_rate_hz=float(getattr(params, "Sampling_Rate_sps", 0.0) or DEFAULT_SAMPLE_RATE_HZ),
        samples=samples,
    )


def _date(path: Path) -> str:
    """Date from the text MATLAB puts into the first 116 bytes ("... Created on: Fri Nov 20 11:22:33 2020"), or ""."""
    with path.open("rb") as file:
        text = file.read(116).decode("ascii", errors="replace")
    created = text.partition("Created on: ")[2].strip()
    try:
        return datetime.strptime(created[:24].strip(), "%a %b %d %H:%M:%S %Y").date().isoformat()
    except ValueError:
        return ""
