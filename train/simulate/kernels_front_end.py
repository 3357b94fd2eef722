# SPDX-License-Identifier: Apache-2.0
"""Kernel of the ADC: noise that a counter alone decides, rounded to int16.

Every chirp of every chip has a key of 64 bits from Philox 4x32 with 7 rounds (Salmon, Moraes, Dror, Shaw, Parallel
random numbers: as easy as 1, 2, 3, SC 2011); every word is the key and its place through the finaliser of MurmurHash3
(public domain); two normal numbers come from one word by Box and Muller's transform. So any sample of any frame can be
made again alone. The largest number is 4.9 standard deviations.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import float32, int16, int32, njit, uint32, uint64

from edge.kernels_arrays import Float32, Int16

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

_LOW = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_ROUNDS = 7
_GOLDEN, _FIRST, _SECOND = np.uint32(0x9E3779B9), np.uint32(0x85EBCA6B), np.uint32(0xC2B2AE35)
_16, _13, _LOW_16 = np.uint32(16), np.uint32(13), np.uint32(0xFFFF)
_MANTISSA, _ONE = np.int32(0x7FFFFF), np.int32(0x3F800000)
_EXPONENT, _BIAS = np.int32(23), np.int32(127)


@njit(inline="always")
def _philox(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Four random words of 32 bits, each in a uint64, from a counter of four words and a key of two."""
    for _ in range(_ROUNDS):
        a, b = c0 * _MULTIPLIER_0, c2 * _MULTIPLIER_1
        c0, c2 = (b >> _HALF) ^ c1 ^ k0, (a >> _HALF) ^ c3 ^ k1
        c1, c3 = b & _LOW, a & _LOW
        k0, k1 = (k0 + _WEYL_0) & _LOW, (k1 + _WEYL_1) & _LOW
    return c0, c1, c2, c3


@njit(inline="always")
def _word(place: int, first: np.uint32, second: np.uint32) -> np.uint32:
    """Random uint32 of a place and a key of two words."""
    x = uint32(uint32(place) * _GOLDEN + first)
    x = uint32((x ^ uint32(x >> _16)) * _FIRST) ^ second
    x = uint32(uint32(x ^ uint32(x >> _13)) * _SECOND)
    return uint32(x ^ uint32(x >> _16))


@njit(inline="always")
def _two_normals(word: np.uint32) -> tuple[np.float32, np.float32]:
    """Two independent standard normal numbers of a random word; least-squares polynomials, errors below 1e-3."""
    u = (float32(int32(word >> _16)) + float32(0.5)) * float32(2.0**-16)
    bits = np.float32(u).view(np.int32)
    power = float32((bits >> _EXPONENT) - _BIAS)
    t = np.int32((bits & _MANTISSA) | _ONE).view(np.float32) - float32(1.5)
    p = float32(-0.215493712) + t * float32(0.110918627)  # of -2 ln(1.5 + t)
    p = float32(-0.810913577) + t * (float32(-1.33217793) + t * (float32(0.443266367) + t * p))
    radius = np.sqrt(max(p - float32(2.0 * math.log(2.0)) * power, float32(0.0)))
    r = float32(int32(word & _LOW_16)) * float32(2.0**-16) - float32(0.5)
    t = r * r
    sine = float32(-5.16740673) + t * (float32(2.54401052) - t * float32(0.559462455))
    sine = r * (float32(3.14159027) + t * sine)
    cosine = float32(-4.93393467) + t * (float32(4.0412481) - t * float32(1.22203176))
    cosine = float32(0.999993249) + t * cosine
    return radius * (cosine * cosine - sine * sine), radius * float32(2.0) * sine * cosine


@njit(inline="always")
def _code(value: np.float32) -> np.int16:
    """Nearest int16, clipped."""
    return int16(np.floor(min(max(value, float32(-32768.0)), float32(32767.0)) + float32(0.5)))  # type: ignore[return-value]


@njit(**OPTIONS)
def digitise(
    signal: Float32,
    deviation: Float32,
    key_low: np.uint64,
    key_high: np.uint64,
    frame: np.uint64,
    loop: int,
    adc: Int16,
) -> None:
    """Signal plus noise as ADC codes, in the order of the capture.

    Args:
        signal: float32 [chips, slots, n], I and Q of every receiver and sample; n even.
        deviation: float32 [chips, n], standard deviation of each of them.
        key_low, key_high: uint64 below 2^32, of seed and radar.
        frame, loop: uint64, decide the noise with chip, slot and place.
        adc: int16 [chips, loops, slots, n], this loop is overwritten.
    """
    half = uint64(signal.shape[2] // 2)
    for chip in range(signal.shape[0]):
        sigma = deviation[chip]
        for slot in range(signal.shape[1]):
            line, codes = signal[chip, slot], adc[chip, loop, slot]
            chirp = uint64(loop * signal.shape[1] + slot)
            w0, w1, _, _ = _philox(uint64(0), chirp, uint64(chip), frame, key_low, key_high)
            first, second = uint32(w0), uint32(w1)
            for i in range(half):
                n0, n1 = _two_normals(_word(i, first, second))
                after = i + half
                codes[i] = _code(line[i] + sigma[i] * n0)
                codes[after] = _code(line[after] + sigma[after] * n1)
