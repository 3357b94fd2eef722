# SPDX-License-Identifier: Apache-2.0
"""Why a reflector capture cannot become a calibration: every reason is looked for and refused by its own name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.calibration_capture import LARGEST_SATURATED_SHARE, PADDING, CaptureMean
from edge.dsp.checks import dead_names
from edge.errors import CalibrationError
from edge.frames import Float64
from edge.waveform import Schedule

if TYPE_CHECKING:
    from edge.rig import Radar

LEAST_SNR_DB = 20.0
LEAST_MARGIN_DB = 6.0
MAIN_LOBE_BINS = 2.0
LEAKAGE_BINS = 6
LEAKAGE_ABOVE_FLOOR_DB = 20.0
LARGEST_TURN_RAD = np.radians(30.0)
LARGEST_TURN_PER_LOOP_RAD = np.radians(3.0)
LARGEST_FADE_DB = 1.0
NEAREST_BINS = 10.0
NEAREST_APERTURES = 10.0
POWER_ITERATIONS = 8
COMB_LEAST_TEETH = 6
COMB_LEAST_SHARE = 0.85
COMB_PROMINENCE_DB = 8.0
COMB_SHORTEST_BINS = 8.0
COMB_TOLERANCE_BINS = 0.25
COMB_STEP_BINS = 0.02
COMB_GRID = 32
ANCHORS = 8
REPAIRABLE_SHARE_OF_A_ROW = 0.5

Int64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Peak:
    """The reflector in the range profile.

    Args:
        range_bin: position, bins of an Ns-point FFT.
        power_db: over 1 LSB^2, mean over the channels.
        floor_db: median of the profile beyond the leakage.
        margin_db: above the next peak of the search window; infinite when it has none.
    """

    range_bin: float
    power_db: float
    floor_db: float
    margin_db: float

    @property
    def snr_db(self) -> float:
        """Above the floor."""
        return self.power_db - self.floor_db


def nearest_range_m(radar: Radar) -> float:
    """Nearest permitted reflector: beyond the leakage, and ten times the extent of the antennas away.

    Phases are corrected for the exact spherical wave at any range, but nearer the antennas see the reflector at
    different strengths and from different sides.
    """
    transmit_m, receive_m = radar.array.element_offsets_m()
    both = np.concatenate((transmit_m, receive_m))
    return max(NEAREST_BINS * radar.schedule.profile.range_bin_m, NEAREST_APERTURES * float(np.ptp(both)))


def require_possible_range(radar: Radar, range_m: float, search_m: float) -> None:
    """Refuse a reflector range that cannot be used, before any frame is read.

    Raises:
        CalibrationError: too near, or with its search window beyond the usable range.
    """
    nearest_m, farthest_m = nearest_range_m(radar), radar.schedule.profile.usable_range_m
    if not nearest_m + search_m <= range_m <= farthest_m - search_m:
        raise CalibrationError(
            "the reflector is too near or beyond the usable range",
            value=f"{range_m:g} m +- {search_m:g} m",
            allowed=f"{nearest_m:.2f}..{farthest_m:.2f} m, the search window included",
            action="move the reflector, or search less far (--search)",
        )


def require_samples(mean: CaptureMean, schedule: Schedule) -> None:
    """Refuse saturated samples and dead channels that the separable model cannot replace.

    Raises:
        CalibrationError: naming the share or the channels.
    """
    if mean.saturated_share > LARGEST_SATURATED_SHARE:
        raise CalibrationError(
            "the capture is saturated",
            value=f"{100 * mean.saturated_share:.3g} % of the codes at the rails",
            allowed=f"at most {100 * LARGEST_SATURATED_SHARE:g} %",
            action="lower the receiver gain of the profile, or use a smaller reflector or a longer range",
        )
    rows = max(float(mean.dead.mean(axis=axis).max()) for axis in (0, 1))
    if rows >= REPAIRABLE_SHARE_OF_A_ROW:
        names = dead_names(mean.dead.astype(np.uint8), schedule.transmitters)
        raise CalibrationError(
            "too many channels are dead: a transmitter or receiver without signal cannot be repaired",
            value=", ".join(names[:8]),
            allowed="single dead channels, fewer than half of any transmitter's and any receiver's",
            action="check the transmit and receive enables, the device files and the board",
        )


def require_still(mean: CaptureMean, wavelength_m: float) -> float:
    """Refuse a reflector that moved while it was captured.

    Every loop's echo is compared with the mean echo, all channels together; its phase turns by 4 pi / wavelength for
    every metre.

    Returns:
        Largest turn off the mean direction, radians; NaN for a single loop, which cannot show motion.
    Raises:
        CalibrationError: it turned more than 30 degrees, 3 degrees from loop to loop, or faded by more than 1 dB.
    """
    loops = mean.history.reshape(mean.frames * mean.loops, -1)
    if len(loops) == 1:
        return float("nan")
    reference = loops[0]
    for _ in range(POWER_ITERATIONS):
        reference = (loops @ reference.conj()).conj() @ loops
        reference = reference / max(float(np.linalg.norm(reference)), 1e-12)
    echo = (loops @ reference.conj()).reshape(mean.frames, mean.loops)
    turn = np.angle(echo * echo.mean().conj()) if abs(echo.mean()) > 0 else np.full(echo.shape, np.pi)
    largest = float(np.abs(turn).max())
    per_loop = float(np.abs(np.angle((echo[:, 1:] * echo[:, :-1].conj()).sum()))) if mean.loops > 1 else 0.0
    fade_db = 20.0 * np.log10(np.abs(echo).max() / max(float(np.abs(echo).min()), 1e-12))
    if largest > LARGEST_TURN_RAD or per_loop > LARGEST_TURN_PER_LOOP_RAD or fade_db > LARGEST_FADE_DB:
        shown_mm = 1e3 * wavelength_m / (4.0 * np.pi)
        raise CalibrationError(
            "the reflector moved, or something passed before it, while it was captured",
            value=f"turned {np.degrees(largest):.0f} deg ({largest * shown_mm:.2f} mm), {np.degrees(per_loop):.1f} deg "
            f"from loop to loop, faded {fade_db:.1f} dB",
            allowed=f"{np.degrees(LARGEST_TURN_RAD):.0f} deg ({LARGEST_TURN_RAD * shown_mm:.2f} mm), "
            f"{np.degrees(LARGEST_TURN_PER_LOOP_RAD):.0f} deg, {LARGEST_FADE_DB:.0f} dB",
            action="fix the reflector and the vehicle, engine off, and capture again",
        )
    return largest


def find_reflector(profile: Float64, expected_bin: float, search_bins: float) -> Peak:
    """The one strong echo within the search window.

    Args:
        profile: power [PADDING * Ns], mean over the channels.
        expected_bin, search_bins: where to look.
    Raises:
        CalibrationError: I and Q are swapped, no echo, a weak one, two of similar strength, or a comb of spurs.
    """
    level_db = 10.0 * np.log10(np.maximum(profile, 1e-12))
    bins = len(profile) // PADDING
    floor_db = float(np.median(level_db[PADDING * LEAKAGE_BINS : -PADDING * LEAKAGE_BINS]))
    found = _window_peaks(level_db, expected_bin, search_bins)
    _require_image(level_db, floor_db, found, _window_peaks(level_db, bins - expected_bin, search_bins))
    allowed = f"an echo at least {LEAST_SNR_DB:.0f} dB above the floor of {floor_db:.1f} dB"
    where = f"within bins {expected_bin - search_bins:.1f}..{expected_bin + search_bins:.1f}"
    action = "check the reflector's range and alignment; use a larger reflector or more frames"
    if not len(found) or level_db[found[0]] - floor_db < LEAST_SNR_DB:
        value = f"strongest {level_db[found[0]] - floor_db:.1f} dB above it" if len(found) else "no peak"
        raise CalibrationError(f"no reflector {where}", value=value, allowed=allowed, action=action)
    others = found[np.abs(found - found[0]) > PADDING * MAIN_LOBE_BINS]
    margin_db = float(level_db[found[0]] - level_db[others[0]]) if len(others) else np.inf
    if margin_db < LEAST_MARGIN_DB:
        raise CalibrationError(
            f"which echo is the reflector? Two {where} are alike",
            value=f"bins {found[0] / PADDING:.1f} and {others[0] / PADDING:.1f}, {margin_db:.1f} dB apart",
            allowed=f"at least {LEAST_MARGIN_DB:.0f} dB",
            action="measure the range and search less far (--search), or clear the place",
        )
    _require_no_comb(level_db, int(found[0]))
    return Peak(_vertex(level_db, int(found[0])), float(level_db[found[0]]), floor_db, margin_db)


def _window_peaks(level_db: Float64, centre_bin: float, half_bins: float) -> Int64:
    """Local maxima inside a window, strongest first."""
    first = max(1, round(PADDING * (centre_bin - half_bins)))
    last = min(len(level_db) - 2, round(PADDING * (centre_bin + half_bins)))
    here = np.arange(first, last + 1)
    here = here[(level_db[here] >= level_db[here - 1]) & (level_db[here] > level_db[here + 1])]
    return here[np.argsort(-level_db[here], kind="stable")]


def _vertex(level_db: Float64, peak: int) -> float:
    """Position in bins of the parabola through three points."""
    left, middle, right = level_db[peak - 1 : peak + 2]
    return float((peak + 0.5 * (left - right) / (left - 2.0 * middle + right)) / PADDING)


def _require_image(
    level_db: Float64,
    floor_db: float,
    found: Int64,
    mirrored: Int64,
) -> None:
    """Refuse swapped I and Q: the spectrum runs backwards, the leakage and the reflector stand at its end."""
    edge = PADDING * LEAKAGE_BINS
    leak_db, image_db = float(level_db[PADDING:edge].max()), float(level_db[-edge:-PADDING].max())
    here_db = float(level_db[found[0]]) if len(found) else -np.inf
    there_db = float(level_db[mirrored[0]]) if len(mirrored) else -np.inf
    leak_says = image_db - leak_db > LEAST_MARGIN_DB and image_db - floor_db > LEAKAGE_ABOVE_FLOOR_DB
    reflector_says = here_db - floor_db < LEAST_SNR_DB <= there_db - floor_db
    if leak_says or reflector_says:
        raise CalibrationError(
            "I and Q are swapped: the spectrum runs backwards",
            value=f"leakage {leak_db:.1f} dB at the near end and {image_db:.1f} dB at the far end of range",
            allowed="leakage and reflector at the near end",
            action="set the schedule's iq_order to the other value",
        )


def image_rejection_db(profile: Float64) -> float:
    """Power of the nearer half of range over the farther half, leakage left out; swapped I and Q turn its sign."""
    half, edge = len(profile) // 2, PADDING * LEAKAGE_BINS
    return float(10.0 * np.log10(profile[edge:half].sum() / profile[half:-edge].sum()))


def comb_period_bins(level_db: Float64, anchor_bin: float) -> float:
    """Period of a comb of peaks through ``anchor_bin``; 0 when there is none.

    Nearly every place of a comb must hold a peak within a quarter of a bin; echoes of a scene do not stand so.

    Args:
        level_db: range profile, PADDING points a bin.
        anchor_bin: position of a peak.
    Returns:
        The period with the largest share of its places filled, of equals the shortest.
    """
    first, last = float(LEAKAGE_BINS), len(level_db) / PADDING - LEAKAGE_BINS
    filled = np.zeros(round(COMB_GRID * (last + 1)), dtype=np.bool_)
    for peak in _prominent_bins(level_db):
        low, high = peak - COMB_TOLERANCE_BINS, peak + COMB_TOLERANCE_BINS
        filled[max(0, round(COMB_GRID * low)) : round(COMB_GRID * high) + 1] = True
    best, best_share = 0.0, 0.0
    for period in np.arange(COMB_SHORTEST_BINS, (last - first) / COMB_LEAST_TEETH, COMB_STEP_BINS):
        places = np.concatenate((np.arange(anchor_bin - period, first, -period), np.arange(anchor_bin, last, period)))
        hits = int(np.count_nonzero(filled[np.rint(COMB_GRID * places).astype(np.int64)]))
        share = hits / max(len(places), 1)
        if hits >= COMB_LEAST_TEETH and share >= COMB_LEAST_SHARE and share > best_share:
            best, best_share = float(period), share
    return best


def _prominent_bins(level_db: Float64) -> list[float]:
    """Positions of the peaks that stand out of the median of their surroundings."""
    reach, coarse = round(PADDING * COMB_SHORTEST_BINS), PADDING // 4
    padded = np.pad(level_db, reach, mode="reflect")[::coarse]
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach // coarse + 1)
    floor = np.repeat(np.median(around, axis=1), coarse)[: len(level_db)]
    inner = np.arange(1, len(level_db) - 1)
    peak = (level_db[inner] >= level_db[inner - 1]) & (level_db[inner] > level_db[inner + 1])
    peak &= level_db[inner] - floor[inner] >= COMB_PROMINENCE_DB
    return [_vertex(level_db, int(index)) for index in inner[peak]]


def _require_no_comb(level_db: Float64, reflector: int) -> None:
    bins = len(level_db) / PADDING
    strongest = _window_peaks(level_db, bins / 2, bins / 2 - LEAKAGE_BINS)[:ANCHORS]
    for anchor in (reflector, *strongest.tolist()):
        position = _vertex(level_db, anchor)
        period = comb_period_bins(level_db, position)
        if period:
            raise CalibrationError(
                "the capture is full of spurs: its range profile is a comb",
                value=f"a peak every {period:.1f} bins, one of them at bin {position:.1f}",
                allowed="echoes at irregular ranges",
                action="find what disturbs the board (supply, other radar, cables) and capture again",
            )
