# SPDX-License-Identifier: Apache-2.0
"""Kernel of the ADC: noise that a counter alone decides, rounded to int16.

The generator is Philox 4x32 with 7 rounds (Salmon, Moraes, Dror, Shaw, Parallel random numbers: as easy as 1, 2, 3,
SC 2011), the transform Box and Muller's: every sample of every frame can be made again alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, int16, int32, njit, uint64

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

_LOW = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_ROUNDS = 7
_TO_24_BITS = np.uint64(8)
_MANTISSA, _ONE = np.int32(0x7FFFFF), np.int32(0x3F800000)
_EXPONENT, _BIAS = np.int32(23), np.int32(127)


@njit(inline="always")
def _philox(c0, c1, c2, c3, k0, k1):  # type: ignore[no-untyped-def]
    """Four random words of 32 bits, each in a uint64, from a counter of four words and a key of two."""
    for _ in range(_ROUNDS):
        a, b = c0 * _MULTIPLIER_0, c2 * _MULTIPLIER_1
        c0, c2 = (b >> _HALF) ^ c1 ^ k0, (a >> _HALF) ^ c3 ^ k1
        c1, c3 = b & _LOW, a & _LOW
        k0, k1 = (k0 + _WEYL_0) & _LOW, (k1 + _WEYL_1) & _LOW
    return c0, c1, c2, c3


@njit(inline="always")
def _two_normals(first, second):  # type: ignore[no-untyped-def]
    """Two independent standard normal numbers of two random words (24 bits of each; largest 5.9)."""
    u = float32(int32(first >> _TO_24_BITS) + int32(1)) * float32(2.0**-24)
    bits = np.float32(u).view(np.int32)
    power = float32((bits >> _EXPONENT) - _BIAS)
    t = np.int32((bits & _MANTISSA) | _ONE).view(np.float32) - float32(1.5)
    p = float32(0.034828155) - t * float32(0.0204876573)  # of -2 ln(1.5 + t), least squares, error 5e-7
    p = float32(0.0978580693) + t * (float32(-0.051934659) + t * p)
    p = float32(0.444490795) + t * (float32(-0.197583503) + t * p)
    p = float32(-0.810930583) + t * (float32(-1.33333233) + t * p)
    radius = np.sqrt(max(p - float32(2.0 * 0.6931471805599453) * power, float32(0.0)))
    r = float32(int32(second >> _TO_24_BITS)) * float32(2.0**-24) - float32(0.5)
    t = r * r
    sine = float32(0.0820504019) - float32(0.00702838654) * t
    sine = float32(2.55016332) + t * (float32(-0.599252198) + t * sine)
    sine = r * (float32(3.14159265) + t * (float32(-5.16771276) + t * sine))
    cosine = float32(0.234937314) - float32(0.0243963245) * t
    cosine = float32(4.05870916) + t * (float32(-1.335212) + t * cosine)
    cosine = float32(1.0) + t * (float32(-4.93480214) + t * cosine)
    return radius * (cosine * cosine - sine * sine), radius * float32(2.0) * sine * cosine


@njit(inline="always")
def _code(value):  # type: ignore[no-untyped-def]
    """Nearest int16, clipped."""
    return int16(np.floor(min(max(value, float32(-32768.0)), float32(32767.0)) + float32(0.5)))


@njit(**OPTIONS)
def digitise(signal, deviation, key_low, key_high, frame, loop, adc):  # type: ignore[no-untyped-def]
    """Signal plus noise as ADC codes, in the order of the capture.

    Args:
        signal: float32 [chips, slots, n], I and Q of every receiver and sample; n a multiple of 4.
        deviation: float32 [chips, n], standard deviation of each of them.
        key_low, key_high: uint64 below 2^32, of seed and radar.
        frame, loop: uint64, decide the noise with chip, slot and place.
        adc: int16 [chips, loops, slots, n], this loop is overwritten.
    """
    quarter = uint64(signal.shape[2] // 4)
    for chip in range(signal.shape[0]):
        sigma = deviation[chip]
        for slot in range(signal.shape[1]):
            line, codes = signal[chip, slot], adc[chip, loop, slot]
            chirp = uint64(loop * signal.shape[1] + slot)
            for i in range(quarter):
                w0, w1, w2, w3 = _philox(i, chirp, uint64(chip), frame, key_low, key_high)
                n0, n1 = _two_normals(w0, w1)
                n2, n3 = _two_normals(w2, w3)
                second, third, fourth = i + quarter, i + quarter + quarter, i + quarter + quarter + quarter
                codes[i] = _code(line[i] + sigma[i] * n0)
                codes[second] = _code(line[second] + sigma[second] * n1)
                codes[third] = _code(line[third] + sigma[third] * n2)
                codes[fourth] = _code(line[fourth] + sigma[fourth] * n3)
