# SPDX-License-Identifier: Apache-2.0
"""Calibration of one radar: per-channel gain and beat-frequency offset, read, checked, repaired and written.

File format: an ``.npz`` without pickled objects holding ``gain`` complex64 and ``range_shift_bins`` float64, both
[slots, receivers] in capture order, and ``header``, a JSON text with board, temperature, date and the waveform.
"""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.calibration_fit import repair_outliers
from edge.errors import CalibrationError
from edge.frames import Complex64, Float64, Layout

if TYPE_CHECKING:
    from edge.waveform import Schedule

FORMAT = "rfconstruct-calibration-1"
DUMMY_VALUE = -1_000_000.0
WAVEFORM_TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True)
class Waveform:
    """What a calibration depends on: it holds for no other board layout and for no other chirp.

    Args:
        device: as in the chirp profile.
        transmitters: in firing order, one for each slot.
        receivers: in capture order.
        start_frequency_hz, slope_hz_per_s, sample_rate_hz, samples: of the chirp, as the registers realise them.
    """

    device: str
    transmitters: tuple[int, ...]
    receivers: int
    start_frequency_hz: float
    slope_hz_per_s: float
    sample_rate_hz: float
    samples: int

    @classmethod
    def of(cls, schedule: Schedule) -> Waveform:
        """The waveform of a schedule; loops and frame period do not matter."""
        profile = schedule.profile
        return cls(
            device=profile.device,
            transmitters=schedule.transmitters,
            receivers=profile.chip.chips * profile.chip.rx,
            start_frequency_hz=float(profile.start_frequency_hz),
            slope_hz_per_s=float(profile.slope_hz_per_s_actual),
            sample_rate_hz=float(profile.sample_rate_hz),
            samples=profile.samples,
        )

    def require_same(self, other: Waveform, path: Path) -> None:
        """Refuse a calibration in ``path`` that was made with ``self`` when ``other`` is in use.

        Raises:
            CalibrationError: naming every quantity that differs, and both values.
        """
        differing = [f.name for f in fields(self) if not _same(getattr(self, f.name), getattr(other, f.name))]
        if differing:
            raise CalibrationError(
                f"{path}: calibration is foreign to the rig's schedule",
                value=", ".join(f"{name} = {getattr(self, name)}" for name in differing),
                allowed=", ".join(f"{name} = {getattr(other, name)}" for name in differing),
                action="calibrate with this schedule, or use the schedule of the calibration",
            )


def _same(a: object, b: object) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=WAVEFORM_TOLERANCE)
    return a == b


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What makes every virtual channel of one radar alike; arrays are copied and read-only.

    Args:
        gain: complex64 [slots, receivers], multiplies the samples of the channel.
        range_shift_bins: float64 [slots, receivers], beat-frequency offset in bins of an Ns-point FFT, removed by
            exp(-2j pi n shift / Ns).
        reference_range_m: range of the reflector whose spherical wavefront the phases contain: at another range the
            imager takes its curvature out again; infinite when they contain none.
        board: identity of the board, free text.
        temperature_c: of the board while it was calibrated; None when unknown.
        date: ISO 8601 date of the calibration, empty when unknown.
        made_with: waveform of the calibration; None for the identity.
        repaired: names of channels that were replaced by the separable fit, for example "TX2/RX13".
    Raises:
        CalibrationError: shapes differ, values that are not finite, a gain of zero, a reference range not above zero.
    """

    gain: Complex64
    range_shift_bins: Float64
    reference_range_m: float = math.inf
    board: str = ""
    temperature_c: float | None = None
    date: str = ""
    made_with: Waveform | None = None
    repaired: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        gain = np.array(self.gain, dtype=np.complex64)
        shift = np.array(self.range_shift_bins, dtype=np.float64)
        if gain.ndim != 2 or gain.shape != shift.shape:
            raise CalibrationError(
                "calibration arrays have no common shape",
                value=f"gain {list(gain.shape)}, range_shift_bins {list(shift.shape)}",
                allowed="both [slots, receivers]",
            )
        usable = np.isfinite(gain) & np.isfinite(shift) & (gain != 0)
        if not usable.all():
            slot, receiver = np.argwhere(~usable)[0]
            raise CalibrationError(
                f"calibration of slot {slot}, receiver {receiver} is no number or has no gain",
                value=(complex(gain[slot, receiver]), float(shift[slot, receiver])),
                allowed="finite values, gain not zero",
                action="calibrate again",
            )
        if not self.reference_range_m > 0:
            raise CalibrationError(
                "calibration has an impossible reflector range", value=self.reference_range_m, allowed="> 0 m"
            )
        gain.flags.writeable = shift.flags.writeable = False
        object.__setattr__(self, "gain", gain)
        object.__setattr__(self, "range_shift_bins", shift)

    @classmethod
    def identity(cls, layout: Layout) -> Calibration:
        """Calibration that changes nothing: an ideal radar, or one not calibrated yet."""
        shape = (layout.slots, layout.devices * layout.rx)
        return cls(np.ones(shape, dtype=np.complex64), np.zeros(shape))


def refuse_dummy(values: ArrayLike, path: Path, name: str) -> None:
    """Refuse a matrix that was never measured: one value everywhere, such as the tool's placeholder -1000000.

    Raises:
        CalibrationError: every element is equal, or any is the placeholder.
    """
    array = np.asarray(values).astype(np.complex128)
    if array.size == 0 or (array == array.flat[0]).all() or (array == DUMMY_VALUE).any():
        raise CalibrationError(
            f"{path}: {name} is a dummy that was never measured",
            value=complex(array.flat[0]) if array.size else "an empty matrix",
            allowed="measured values, which differ from channel to channel",
            action="calibrate the board with a corner reflector, or leave the rig's calibration out",
        )


def load_calibration(path: Path, schedule: Schedule) -> Calibration:
    """Read a calibration and check that it belongs to ``schedule``; outlier channels are repaired and named.

    Args:
        path: a file of ``save_calibration``.
        schedule: of the radar that will use it.
    Raises:
        CalibrationError: unreadable, of another format, a dummy, of another waveform, or too many outliers.
    """
    header, gain, shift = _read(path)
    refuse_dummy(gain, path, "gain")
    made_with = _waveform(header, path)
    made_with.require_same(Waveform.of(schedule), path)
    expected = (len(made_with.transmitters), made_with.receivers)
    if gain.shape != expected or shift.shape != expected:
        raise CalibrationError(
            f"{path}: arrays contradict the header",
            value=f"gain {list(gain.shape)}, range_shift_bins {list(shift.shape)}",
            allowed=str(list(expected)),
        )
    measured = _measured(header, gain, shift, made_with, path)
    gain, shift, found = repair_outliers(measured.gain, measured.range_shift_bins, schedule, path)
    return replace(measured, gain=gain, range_shift_bins=shift, repaired=(*measured.repaired, *found))


def _measured(
    header: dict[str, Any], gain: NDArray[Any], shift: NDArray[Any], made_with: Waveform, path: Path
) -> Calibration:
    try:
        reference_m, temperature_c = header["reference_range_m"], header["temperature_c"]
        return Calibration(
            gain,
            shift,
            reference_range_m=math.inf if reference_m is None else float(reference_m),
            board=str(header["board"]),
            temperature_c=None if temperature_c is None else float(temperature_c),
            date=str(header["date"]),
            made_with=made_with,
            repaired=tuple(str(name) for name in header["repaired"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(f"{path}: header cannot be used", value=str(error)) from error
    except CalibrationError as error:
        raise CalibrationError(
            f"{path}: {error.what}", value=error.value, allowed=error.allowed, action=error.action
        ) from error


def _read(path: Path) -> tuple[dict[str, Any], NDArray[Any], NDArray[Any]]:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            header = json.loads(str(stored["header"]))
            gain, shift = stored["gain"], stored["range_shift_bins"]
    except FileNotFoundError as error:
        raise CalibrationError(
            f"{path}: no such calibration file", action="give its path relative to the rig's folder, or leave it out"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise CalibrationError(
            f"{path}: not a calibration file",
            value=str(error),
            allowed="an .npz written by save_calibration",
        ) from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        found = header.get("format") if isinstance(header, dict) else header
        raise CalibrationError(f"{path}: unknown calibration format", value=found, allowed=FORMAT)
    if gain.dtype.kind not in "fc" or shift.dtype.kind not in "fiu":
        raise CalibrationError(f"{path}: arrays are not numbers", value=f"{gain.dtype}, {shift.dtype}")
    return header, gain, shift


def _waveform(header: dict[str, Any], path: Path) -> Waveform:
    try:
        made_with = dict(header["made_with"])
        return Waveform(**{**made_with, "transmitters": tuple(made_with["transmitters"])})
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path}: header does not say which waveform it was made with",
            value=header.get("made_with"),
            allowed=", ".join(f.name for f in fields(Waveform)),
        ) from error


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write ``calibration`` so that ``load_calibration`` gives it back.

    Raises:
        CalibrationError: ``made_with`` is missing: nobody could tell later where it belongs.
    """
    if calibration.made_with is None:
        raise CalibrationError(
            f"{path}: calibration without the waveform it was made with", action="set made_with=Waveform.of(schedule)"
        )
    reference_m = calibration.reference_range_m
    header = {
        "format": FORMAT,
        "board": calibration.board,
        "temperature_c": calibration.temperature_c,
        "date": calibration.date,
        "reference_range_m": reference_m if math.isfinite(reference_m) else None,
        "made_with": asdict(calibration.made_with),
        "repaired": list(calibration.repaired),
    }
    with path.open("wb") as file:
        np.savez(
            file,
            gain=calibration.gain,
            range_shift_bins=calibration.range_shift_bins,
            header=np.array(json.dumps(header)),
        )
