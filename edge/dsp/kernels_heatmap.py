# SPDX-License-Identifier: Apache-2.0
"""Kernels from raw int16 samples to range-angle power: loop sum, range FFT, channel gather, angle FFT, power.

Both FFTs are radix-4 decimation in frequency, vectorised across transforms: real and imaginary planes of one flat
float32 buffer, lanes innermost, literal strides (closure constants). The angle FFT's lanes are range bins. The range
FFT's are a device's four receivers, too few for the last stage, before which its rows change places: the last digit
comes first, with all other rows as lanes, and the digit reversal is undone on the way. Unsigned indices spare the inner
loops Numba's wrap-around of negative ones, which would keep them from vectorising; so would a slice of an array, which
counts references. Buffers begin on cache lines (edge/dsp/buffers.py).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import complex64, complex128, float32, float64, int32, int64, njit, types, uint64

from edge.kernels_arrays import Complex64, Complex128, Float32, Float64, Int32, Int64

RAIL = 32767
RECEIVERS = 4
"""Of one device, all there are: their float32 values are moved as one complex128."""
ANGLE_LANES = 64
"""Range bins that the angle FFT works on together."""
OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

RAW = types.Array(int32, 1, "C", readonly=True)
"""Raw samples, two int16 in one int32, lower address in the lower half."""


@njit(inline="always")
def _butterfly(work: Float32, x: int, q: int, im: int, w1r: np.float32, w1i: np.float32, w2r: np.float32,
               w2i: np.float32, w3r: np.float32, w3i: np.float32, sign: np.float32) -> None:  # fmt: skip
    """Radix-4 butterfly on work[x + {0, q, 2q, 3q}], then the twiddles; ``sign`` of the exponent is +1 or -1."""
    ar, ai = work[x], work[x + im]
    br, bi = work[x + q], work[x + q + im]
    cr, ci = work[x + 2 * q], work[x + 2 * q + im]
    dr, di = work[x + 3 * q], work[x + 3 * q + im]
    sr, si, tr, ti = ar + cr, ai + ci, ar - cr, ai - ci
    ur, ui, vr, vi = br + dr, bi + di, sign * (di - bi), sign * (br - dr)
    work[x], work[x + im] = sr + ur, si + ui
    yr, yi = tr + vr, ti + vi
    work[x + q], work[x + q + im] = yr * w1r - yi * w1i, yr * w1i + yi * w1r
    yr, yi = sr - ur, si - ui
    work[x + 2 * q], work[x + 2 * q + im] = yr * w2r - yi * w2i, yr * w2i + yi * w2r
    yr, yi = tr - vr, ti - vi
    work[x + 3 * q], work[x + 3 * q + im] = yr * w3r - yi * w3i, yr * w3i + yi * w3r


@njit(inline="always")
def _wide_stage(work: Float32, twiddle: Float32, first: int, groups: int, q: int, im: int) -> None:
    """Stage of the range FFT: ``q`` = quarter x receivers contiguous lanes, twiddles expanded to the lanes."""
    for g in range(groups):
        for l in range(q):  # noqa: E741
            t = first + l
            w1r, w1i, w2r = twiddle[t], twiddle[t + q], twiddle[t + 2 * q]
            w2i, w3r, w3i = twiddle[t + 3 * q], twiddle[t + 4 * q], twiddle[t + 5 * q]
            _butterfly(work, 4 * q * g + l, q, im, w1r, w1i, w2r, w2i, w3r, w3i, float32(-1))


@njit(inline="always")
def _narrow_stage(work: Float32, twiddle: Float32, first: int, groups: int, quarter: int, lanes: int, im: int) -> None:
    """Stage of the angle FFT: the inner loop runs over ``lanes`` range bins, twiddles are scalars."""
    for g in range(groups):
        for p in range(quarter):
            t = first + 6 * p
            w1r, w1i, w2r = twiddle[t], twiddle[t + 1], twiddle[t + 2]
            w2i, w3r, w3i = twiddle[t + 3], twiddle[t + 4], twiddle[t + 5]
            start = (4 * quarter * g + p) * lanes
            for l in range(lanes):  # noqa: E741
                _butterfly(work, start + l, quarter * lanes, im, w1r, w1i, w2r, w2i, w3r, w3i, float32(1))


@njit(inline="always")
def _last_stage(work: Float32, groups: int, lanes: int, im: int, sign: np.float32) -> None:
    """Radix-4 stage of quarter 1: no twiddles."""
    for g in range(groups):
        for l in range(lanes):  # noqa: E741
            x = 4 * g * lanes + l
            ar, ai = work[x], work[x + im]
            br, bi = work[x + lanes], work[x + lanes + im]
            cr, ci = work[x + 2 * lanes], work[x + 2 * lanes + im]
            dr, di = work[x + 3 * lanes], work[x + 3 * lanes + im]
            sr, si, tr, ti = ar + cr, ai + ci, ar - cr, ai - ci
            ur, ui, vr, vi = br + dr, bi + di, sign * (di - bi), sign * (br - dr)
            work[x], work[x + im] = sr + ur, si + ui
            work[x + lanes], work[x + lanes + im] = tr + vr, ti + vi
            work[x + 2 * lanes], work[x + 2 * lanes + im] = sr - ur, si - ui
            work[x + 3 * lanes], work[x + 3 * lanes + im] = tr - vr, ti - vi


@njit(inline="always")
def _pair_stage(work: Float32, groups: int, lanes: int, im: int) -> None:
    """Final radix-2 stage of lengths 2 * 4^k."""
    for g in range(groups):
        for l in range(lanes):  # noqa: E741
            x = 2 * g * lanes + l
            y = x + lanes
            ar, ai, br, bi = work[x], work[x + im], work[y], work[y + im]
            work[x], work[x + im] = ar + br, ai + bi
            work[y], work[y + im] = ar - br, ai - bi


@njit(inline="always")
def _at_rail(value: np.float32) -> np.float32:
    """1 when a code stands at the converter's rails, else 0; a float, which vectorises."""
    return float32(1) if abs(value) >= float32(RAIL) else float32(0)


@njit(inline="always")
def _add_interleaved(adc: Int32, start: int, count: int, keep: np.float32, acc: Float32, to_i: int,
                     to_q: int) -> np.float32:  # fmt: skip
    """acc = keep acc + one chirp of one device, [sample, rx] of packed (I, Q); returns the codes at the rails."""
    rails, begin = float32(0), uint64(start)
    for x in range(count):
        packed = adc[begin + uint64(x)]
        i, q = float32(np.int16(packed)), float32(np.int16(packed >> 16))
        acc[x + to_i] = acc[x + to_i] * keep + i
        acc[x + to_q] = acc[x + to_q] * keep + q
        rails += _at_rail(i) + _at_rail(q)
    return rails


@njit(inline="always")
def _add_pairwise(adc: Int32, start: int, samples: int, rx: int, keep: np.float32, acc: Float32, to_first: int,
                  to_second: int) -> np.float32:  # fmt: skip
    """acc = keep acc + one chirp, [rx, sample pair, 2 of one part, 2 of the other]; returns the codes at the rails."""
    rails = float32(0)
    for r in range(rx):
        begin = uint64(start + r * samples)
        for h in range(samples // 2):
            first = adc[begin + uint64(2 * h)]
            second = adc[begin + uint64(2 * h + 1)]
            x = 2 * h * rx + r
            a, b = float32(np.int16(first)), float32(np.int16(first >> 16))
            c, d = float32(np.int16(second)), float32(np.int16(second >> 16))
            acc[x + to_first] = acc[x + to_first] * keep + a
            acc[x + rx + to_first] = acc[x + rx + to_first] * keep + b
            acc[x + to_second] = acc[x + to_second] * keep + c
            acc[x + rx + to_second] = acc[x + rx + to_second] * keep + d
            rails += _at_rail(a) + _at_rail(b) + _at_rail(c) + _at_rail(d)
    return rails


@njit(inline="always")
def _add_real(adc: Int32, start: int, samples: int, rx: int, keep: np.float32, acc: Float32) -> np.float32:
    """acc = keep acc + one chirp, [rx, sample], real; returns the codes at the rails."""
    rails, words = float32(0), samples // 2
    for r in range(rx):
        begin = uint64(start + r * words)
        for h in range(words):
            packed, x = adc[begin + uint64(h)], 2 * h * rx + r
            a, b = float32(np.int16(packed)), float32(np.int16(packed >> 16))
            acc[x] = acc[x] * keep + a
            acc[x + rx] = acc[x + rx] * keep + b
            rails += _at_rail(a) + _at_rail(b)
    return rails


@njit(inline="always")
def _window(acc: Float32, window: Float32, b: int, work: Float32, im: int) -> None:
    """Multiply the sums by the block's complex window: taper, channel gain, range shift, scale."""
    for x in range(im):
        re, wr = acc[x], window[b, 0, x]
        i, wi = acc[x + im], window[b, 1, x]
        work[x] = re * wr - i * wi
        work[x + im] = re * wi + i * wr


@njit(inline="always")
def _turn(work: Complex128, out: Complex128, order: Int64, groups: int, last: int, half: int) -> None:
    """Rows of all receivers: ``out[p, k] = work[order[k] + p]``, p the last digit; two planes of ``half`` rows."""
    for p in range(last):
        for k in range(groups):
            x, y = uint64(order[k] + p), uint64(p * groups + k)
            out[y] = work[x]
            out[y + uint64(half)] = work[x + uint64(half)]


@njit(inline="always")
def _focus(spectra: Float32, focus: Float32, b: int, pr: np.float32, pi: np.float32, points: int, rx: int, im: int,
           work: Float32) -> None:  # fmt: skip
    """A block's spectra times focusing phasor, taper and the slot's Doppler phasor into work [(re, im), rx, point]."""
    for k in range(points):
        for r in range(rx):
            x, y = uint64(k * rx + r), uint64(r * points + k)
            fr, fi = focus[b, 0, x], focus[b, 1, x]
            cr, ci = fr * pr - fi * pi, fr * pi + fi * pr
            re, i = spectra[b, x], spectra[b, x + uint64(im)]
            work[y] = re * cr - i * ci
            work[y + uint64(im)] = re * ci + i * cr


@cache
def range_kernel(kind: str, swapped: bool, points: int) -> Callable[..., Any]:
    """Compile the kernel from raw samples to the virtual row's range spectra.

    Args:
        kind: of the layout. Raw chirps are [sample, rx, 2] (cascade), [rx, sample / 2, 4] (dca1000) or [rx, sample]
            (dca1000_real).
        swapped: Q comes before I.
        points: length of the FFT, a power of two, 64..1024; shorter chirps are zero-padded.
    Returns:
        kernel(adc [values / 2], loops, loop_stride, start int64 [block], samples, window [block, 2, points * rx],
        twiddle, order int64 (``tables.last_stage_order``), acc [2 * points * rx], work as acc, work_rows (the same as
        complex128), spectra [block, 2 * points * rx], spectra_rows (the same as complex128)) -> components at the
        rails. ``spectra`` receives each block's [(re, im), range, rx]; ``acc`` must hold zeros beyond ``samples * rx``
        of each plane, and all over the second one for real samples.
    """
    rx, interleaved, real = RECEIVERS, kind == "cascade", kind == "dca1000_real"
    im, last = points * rx, 2 if points in (128, 512) else 4
    signature = int64(
        *(RAW, int64, int64, int64[::1], int64, float32[:, :, ::1], float32[::1], int64[::1], float32[::1]),
        *(float32[::1], complex128[::1], float32[:, ::1], complex128[:, ::1]),
    )

    @njit(signature, **OPTIONS)
    def kernel(adc: Int32, loops: int, loop_stride: int, start: Int64, samples: int, window: Float32, twiddle: Float32,
               order: Int64, acc: Float32, work: Float32, work_rows: Complex128, spectra: Float32,
               spectra_rows: Complex128) -> int:  # fmt: skip
        rails = 0
        to_i = im if swapped else 0
        for b in range(len(start)):
            for loop in range(loops):
                first = start[b] + loop * loop_stride
                keep = float32(loop > 0)
                if interleaved:
                    rails += int64(_add_interleaved(adc, first, samples * rx, keep, acc, to_i, im - to_i))  # type: ignore[call-overload]
                elif real:
                    rails += int64(_add_real(adc, first, samples, rx, keep, acc))  # type: ignore[call-overload]
                else:
                    rails += int64(_add_pairwise(adc, first, samples, rx, keep, acc, to_i, im - to_i))  # type: ignore[call-overload]
            _window(acc, window, b, work, im)
            _wide_stage(work, twiddle, 0, 1, im // 4, im)
            _wide_stage(work, twiddle, 2 * (im - im // 4), 4, im // 16, im)
            if points >= 128:
                _wide_stage(work, twiddle, 2 * (im - im // 16), 16, im // 64, im)
            if points >= 512:
                _wide_stage(work, twiddle, 2 * (im - im // 64), 64, im // 256, im)
            _turn(work_rows, spectra_rows[b], order, points // last, last, points)
            if last == 2:
                _pair_stage(spectra[b], 1, im // 2, im)
            else:
                _last_stage(spectra[b], 1, im // 4, im, float32(-1))
        return rails

    return kernel


@cache
def row_kernel(points: int) -> Callable[..., Any]:
    """Compile the kernel that focuses the blocks' spectra, undoes motion for one direction and fills the virtual row.

    Args:
        points: range bins.
    Returns:
        kernel(spectra [block, 2 * points * rx], slot int64 [block], element int64 [block, rx], focus [block, 2,
        points * rx], phasor complex64 [slot], work [2 * points * rx], row [2, element, points]); ``row`` is
        overwritten.
    """
    rx = RECEIVERS
    im = points * rx
    signature = types.void(
        *(float32[:, ::1], int64[::1], int64[:, ::1], float32[:, :, ::1], complex64[::1]),
        *(float32[::1], float32[:, :, ::1]),
    )

    @njit(signature, **OPTIONS)
    def kernel(
        spectra: Float32, slot: Int64, element: Int64, focus: Float32, phasor: Complex64, work: Float32, row: Float32
    ) -> None:
        row[:] = float32(0)
        for b in range(len(slot)):
            turn = phasor[slot[b]]
            _focus(spectra, focus, b, turn.real, turn.imag, points, rx, im, work)
            for r in range(rx):
                e = element[b, r]
                if e >= 0:
                    for k in range(points):
                        row[0, e, k] += work[uint64(r * points + k)]
                        row[1, e, k] += work[uint64(r * points + k + im)]

    return kernel


@njit(types.void(complex64[::1], float64, float64[::1], float64, float64), **{**OPTIONS, "nogil": False})
def set_phasors(phasor: Complex64, radial_m_s: float, time_s: Float64, wavelength_m: float, loops: float) -> None:
    """Factors that undo a radial speed between slots: exp(-j 4 pi v t_s / lambda) / loops.

    Args:
        phasor: complex64 [slots], receives the factors.
        radial_m_s: positive away.
        time_s: float64 [slots] after the first chirp.
        wavelength_m: at the middle of the ADC window.
        loops: loops that were summed.
    """
    for s in range(len(phasor)):
        angle = -4.0 * np.pi * radial_m_s * time_s[s] / wavelength_m
        phasor[s] = complex(np.cos(angle) / loops, np.sin(angle) / loops)


@njit(inline="always")
def _pruned_stage(
    row: Float32, column: int, elements: int, work: Float32, twiddle: Float32, quarter: int, lanes: int, im: int
) -> None:
    """Load a chunk of the row and do the first stage; rows from ``elements`` (at most half the length) on are zero."""
    for e in range(elements):
        for l in range(lanes):  # noqa: E741
            work[e * lanes + l] = row[0, e, column + l]
            work[e * lanes + l + im] = row[1, e, column + l]
    q = quarter * lanes
    for p in range(quarter):
        t = 6 * p
        w1r, w1i, w2r = twiddle[t], twiddle[t + 1], twiddle[t + 2]
        w2i, w3r, w3i = twiddle[t + 3], twiddle[t + 4], twiddle[t + 5]
        if p < elements - quarter:
            for x in range(p * lanes, (p + 1) * lanes):
                ar, ai, br, bi = work[x], work[x + im], work[x + q], work[x + q + im]
                work[x], work[x + im] = ar + br, ai + bi
                yr, yi = ar - bi, ai + br
                work[x + q], work[x + q + im] = yr * w1r - yi * w1i, yr * w1i + yi * w1r
                yr, yi = ar - br, ai - bi
                work[x + 2 * q], work[x + 2 * q + im] = yr * w2r - yi * w2i, yr * w2i + yi * w2r
                yr, yi = ar + bi, ai - br
                work[x + 3 * q], work[x + 3 * q + im] = yr * w3r - yi * w3i, yr * w3i + yi * w3r
        else:
            keep = float32(p < elements)
            for x in range(p * lanes, (p + 1) * lanes):
                yr, yi = work[x] * keep, work[x + im] * keep
                work[x], work[x + im] = yr, yi
                work[x + q], work[x + q + im] = yr * w1r - yi * w1i, yr * w1i + yi * w1r
                work[x + 2 * q], work[x + 2 * q + im] = yr * w2r - yi * w2i, yr * w2i + yi * w2r
                work[x + 3 * q], work[x + 3 * q + im] = yr * w3r - yi * w3i, yr * w3i + yi * w3r


@njit(inline="always")
def _whole_stage(
    row: Float32, column: int, elements: int, work: Float32, twiddle: Float32, quarter: int, lanes: int, im: int
) -> None:
    """Load a chunk of a row of any number of elements up to the FFT's length and do the first stage."""
    for e in range(4 * quarter):
        keep, source = float32(e < elements), min(e, elements - 1)
        for l in range(lanes):  # noqa: E741
            work[e * lanes + l] = row[0, source, column + l] * keep
            work[e * lanes + l + im] = row[1, source, column + l] * keep
    _narrow_stage(work, twiddle, 0, 1, quarter, lanes, im)


@cache
def angle_kernel(bins: int, points: int, lanes: int, whole: bool = False) -> Callable[..., Any]:
    """Compile the kernel from the virtual row's range spectra to power over direction cosine and range.

    Args:
        bins: length of the angle FFT, a power of two, 64..4096, at least twice the elements.
        points: range bins.
        lanes: range bins per vector.
        whole: the row may have as many elements as the FFT is long; costs a full first stage.
    Returns:
        kernel(row [2, element, points], twiddle, target int64 [bins], gain [bins], first, last, work [2 * bins *
        lanes], power [bins, points]); row ``target[i]`` of ``power`` receives FFT row i times ``gain[target[i]]`` when
        first <= target[i] < last.
    """
    im = bins * lanes
    radix2 = bins in (128, 512, 2048)
    signature = types.void(
        *(float32[:, :, ::1], float32[::1], int64[::1], float32[::1], int64, int64, float32[::1], float32[:, ::1])
    )

    @njit(signature, **OPTIONS)
    def kernel(row: Float32, twiddle: Float32, target: Int64, gain: Float32, first: int, last: int, work: Float32,
               power: Float32) -> None:  # fmt: skip
        for column in range(0, points, lanes):
            if whole:
                _whole_stage(row, column, row.shape[1], work, twiddle, bins // 4, lanes, im)
            else:
                _pruned_stage(row, column, row.shape[1], work, twiddle, bins // 4, lanes, im)
            _narrow_stage(work, twiddle, 2 * (bins - bins // 4), 4, bins // 16, lanes, im)
            if bins >= 128:
                _narrow_stage(work, twiddle, 2 * (bins - bins // 16), 16, bins // 64, lanes, im)
            if bins >= 512:
                _narrow_stage(work, twiddle, 2 * (bins - bins // 64), 64, bins // 256, lanes, im)
            if bins >= 2048:
                _narrow_stage(work, twiddle, 2 * (bins - bins // 256), 256, bins // 1024, lanes, im)
            if radix2:
                _pair_stage(work, bins // 2, lanes, im)
            else:
                _last_stage(work, bins // 4, lanes, im, float32(1))
            for i in range(bins):
                t = target[i]
                if t < first or t >= last:
                    continue
                for l in range(lanes):  # noqa: E741
                    re, imag = work[i * lanes + l], work[i * lanes + l + im]
                    power[t, column + l] = (re * re + imag * imag) * gain[t]

    return kernel
