# SPDX-License-Identifier: Apache-2.0
"""Kernels of physical optics: what patches and points send back to an eye, and which of it is worth keeping."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge.frames import Complex64, Float32, Float64
from train.objects.sampling import Int32

UInt8 = NDArray[np.uint8]
Int8 = NDArray[np.int8]

DIRECT, MIXED, GROUND = 0, 1, 2
"""Path classes: both legs direct; one of them by way of the ground (two channels of equal weight); both."""
SEEN, SEEN_IN_GROUND = 1, 2
"""Bits of the visibility of a point: from the radar, from its image below the ground."""
PatchColumns = tuple[Float32, Float32, Float32, Float32, Float32]

LEAST_AREA_M2 = 1e-12
"""Triangles of less are a line."""
SERIES_BELOW = 0.02
"""q^2 A below which the triangle's integral is its series to second order (error below 1e-5)."""
CURVED_FROM = 0.02
"""Variance of the normal over the lobe's own width^2 from which a patch counts as curved."""
LOBE = 0.038
"""w^2 = LOBE lambda^2 / A: variance of the Gaussian with the curvature of a square facet's lobe at its peak."""
MOST_EXPONENT = 10.0
"""Exponent of a curved patch's lobe beyond which it sends nothing (-87 dB)."""


@njit(cache=True, nogil=True, error_model="numpy")
def triangle_integral(qx: float, qy: float, qz: float, shape: Float32) -> complex:  # pragma: no cover - compiled
    """Integral of exp(j q . r) over a flat triangle, r from its centre; m^2.

    Args:
        qx, qy, qz: wave vector, rad/m; only its part in the triangle's plane matters.
        shape: [4, 3], centre and normal (not used) and the two sides from the first corner, metres.
    Source: Gordon, "Far-field approximations to the Kirchhoff-Helmholtz representations of scattered fields", IEEE
        Trans. Antennas Propag. 23(4), 1975: the theorem of Green turns the area into a sum over the three sides.
    """
    ux, uy, uz = np.float64(shape[2, 0]), np.float64(shape[2, 1]), np.float64(shape[2, 2])
    vx, vy, vz = np.float64(shape[3, 0]), np.float64(shape[3, 1]), np.float64(shape[3, 2])
    # The normal anew in float64: a rounded one would let q's large normal part leak into the plane.
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    double = math.sqrt(nx * nx + ny * ny + nz * nz)
    if double < LEAST_AREA_M2:
        return complex(0.0, 0.0)
    nx, ny, nz = nx / double, ny / double, nz / double
    area = 0.5 * double
    tx, ty, tz = ny * qz - nz * qy, nz * qx - nx * qz, nx * qy - ny * qx
    plane = tx * tx + ty * ty + tz * tz
    a, b = qx * ux + qy * uy + qz * uz, qx * vx + qy * vy + qz * vz
    first = -(a + b) / 3.0
    second, third = first + a, first + b
    if plane * area < SERIES_BELOW:
        return complex(area * (1.0 - (first * first + second * second + third * third) / 24.0), 0.0)
    # Sides i -> j in the sense of the normal, weight q . (l x n); the corners' phases add up to nothing.
    g_first = ux * tx + uy * ty + uz * tz
    g_third = -(vx * tx + vy * ty + vz * tz)
    e_first, e_second = complex(math.cos(first), math.sin(first)), complex(math.cos(second), math.sin(second))
    e_third = (e_first * e_second).conjugate()
    total = g_first * _side(e_first, e_second, a) - (g_first + g_third) * _side(e_second, e_third, b - a)
    total += g_third * _side(e_third, e_first, -b)
    return complex(total.imag / plane, -total.real / plane)


@njit(cache=True, nogil=True, error_model="numpy")
def _side(start: complex, end: complex, turn: float) -> complex:  # pragma: no cover - compiled
    """Mean of exp(j phase) along a side on which the phase grows by ``turn``, from its values at both ends."""
    if abs(turn) < 1e-4:
        return start * complex(1.0 - turn * turn / 6.0, 0.5 * turn)
    return complex((end.imag - start.imag) / turn, (start.real - end.real) / turn)


@njit(cache=True, nogil=True, error_model="numpy")
def _sinc(x: float) -> float:  # pragma: no cover - compiled
    """sin(x) / x."""
    return 1.0 - x * x / 6.0 if abs(x) < 1e-3 else math.sin(x) / x


@njit(cache=True, nogil=True, error_model="numpy")
def _fade(x: float) -> float:  # pragma: no cover - compiled
    """1 up to x = 0.5, smoothly to 0 at x = 1."""
    t = 2.0 * (1.0 - x)
    return 1.0 if t >= 1.0 else t * t * (3.0 - 2.0 * t)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"})
def lobe_candidates(
    facing: Float32, eye: Float64, slack_rad: float, mark: UInt8, index: Int32
) -> int:  # pragma: no cover - compiled
    """Patches whose lobes may reach the radar from anywhere near a place; returns how many.

    Args:
        facing: float32 [7, p], centre, unit normal, least cosine between the normal and the half vector.
        eye: float64 [4], see ``patch_weights``.
        slack_rad: how far the half vector may turn until the next call.
        mark: uint8 [p], scratch.
        index: int32 [p], out: their numbers, ascending.
    """
    ex, ey, ez, gz = np.float32(eye[0]), np.float32(eye[1]), np.float32(eye[2]), np.float32(eye[3])
    turn_cosine, turn_sine = np.float32(math.cos(slack_rad)), np.float32(math.sin(slack_rad))
    one = np.float32(1.0)
    cx, cy, cz, nx, ny, nz, lc = facing[0], facing[1], facing[2], facing[3], facing[4], facing[5], facing[6]
    for p in range(len(mark)):
        dx, dy = ex - cx[p], ey - cy[p]
        za, zb = ez - cz[p], gz - cz[p]
        flat = dx * dx + dy * dy
        ra, rb = one / np.sqrt(flat + za * za), one / np.sqrt(flat + zb * zb)
        side = nx[p] * dx + ny[p] * dy
        ca, cb = (side + nz[p] * za) * ra, (side + nz[p] * zb) * rb
        cosine = lc[p]
        least = max(cosine * turn_cosine - np.sqrt(max(one - cosine * cosine, np.float32(0.0))) * turn_sine, 0)
        half2 = np.float32(2.0) * (one + (flat + za * zb) * ra * rb)
        both = (ca + cb) * (ca + cb) >= least * least * half2
        mark[p] = np.uint8((abs(ca) >= least) | (abs(cb) >= least) | both)
    count = 0
    for p in range(len(mark)):
        index[count] = p
        count += mark[p]
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _lobe(
    shape: Float32, area: float, spread: float, eye: Float64, z_tx: float, z_rx: float, k: float, limits: Float64
) -> tuple[float, float, bool, float, float, float, float]:  # pragma: no cover - compiled
    """What one patch can send at most, and towards where.

    Returns:
        Size of its integral without the flat lobe (0: nothing), m^2; |cos| of the incidence; whether it is curved;
        q, rad/m; 1 / (R_t R_r).
    """
    dx, dy = eye[0] - shape[0, 0], eye[1] - shape[0, 1]
    za, zb = z_tx - shape[0, 2], z_rx - shape[0, 2]
    flat = dx * dx + dy * dy
    ra, rb = 1.0 / math.sqrt(flat + za * za), 1.0 / math.sqrt(flat + zb * zb)
    nx, ny, nz = np.float64(shape[1, 0]), np.float64(shape[1, 1]), np.float64(shape[1, 2])
    side = nx * dx + ny * dy
    ca, cb = (side + nz * za) * ra, (side + nz * zb) * rb
    qx, qy, qz = -k * dx * (ra + rb), -k * dy * (ra + rb), -k * (za * ra + zb * rb)
    incidence = 0.5 * abs(ca + cb)
    if ca * cb <= 0.0:
        return 0.0, incidence, False, qx, qy, qz, ra * rb
    whole, normal = qx * qx + qy * qy + qz * qz, k * (ca + cb)
    plane = max(whole - normal * normal, 0.0)
    away, size = plane / (whole * limits[1]), area
    lobe = LOBE * (2.0 * math.pi / k) ** 2 / area
    curved = spread > CURVED_FROM * lobe
    if curved:
        exponent = plane / (normal * normal) / (4.0 * (lobe + spread))
        if exponent > MOST_EXPONENT:
            return 0.0, incidence, True, qx, qy, qz, ra * rb
        size *= math.sqrt(lobe / (lobe + spread)) * math.exp(-exponent)
    else:
        away = max(away, plane * area / limits[0])
    return size * _fade(away) if away < 1.0 else 0.0, incidence, curved, qx, qy, qz, ra * rb


@njit(cache=True, nogil=True, error_model="numpy")
def _patch_weight(
    p: int,
    columns: PatchColumns,
    legs: tuple[Float64, float, float, float, Float64],
) -> tuple[complex, float]:  # pragma: no cover - compiled
    """sqrt(sigma) exp(j phase) of one patch, m, and 1 / (R_t R_r); ``legs``: eye, z of both ends, k, limits."""
    eye, z_tx, z_rx, k, limits = legs
    shape, area, spread, reflection, roughness = columns
    size, incidence, curved, qx, qy, qz, spreading = _lobe(shape[p], area[p], spread[p], eye, z_tx, z_rx, k, limits)
    scale = k / math.sqrt(math.pi) * incidence * reflection[p] * math.exp(-roughness[p] * incidence * incidence)
    if curved:
        return complex(scale * size, 0.0), spreading
    return triangle_integral(qx, qy, qz, shape[p]) * (scale * size / area[p]), spreading


@njit(cache=True, nogil=True, error_model="numpy")
def patch_weights(
    candidate: Int32,
    columns: PatchColumns,
    seen: UInt8,
    eye: Float64,
    path: int,
    wavelength: float,
    limits: Float64,
    keep: float,
    bound: Float32,
    index: Int32,
    weight: Complex64,
    level: Float32,
) -> int:  # pragma: no cover - compiled
    """Scattering amplitudes of the patches over one class of paths; returns how many entries were written.

    sqrt(sigma) = sqrt(4 pi) / lambda |Gamma| c I(q), q = -2 pi / lambda (u_t + u_r) with u the unit vectors from the
    patch to the ends of the two legs (phases grow with the path's length), c = |N . (u_t + u_r)| / 2.
    Args:
        candidate: int32 [c], numbers of the patches that may matter.
        columns: shape, area, spread, reflection and roughness of the patches (``points.Patches``).
        seen: uint8 [c], bits SEEN and SEEN_IN_GROUND of the candidates.
        eye: float64 [4], the radar in the object's frame, x, y, z, and the z of its image below the ground.
        path, wavelength: DIRECT, MIXED or GROUND; metres.
        limits: float64 [2], q_t^2 A beyond which a flat patch, and sin^2 of the angle off its normal beyond which any
            patch sends nothing; both fade from half of it on.
        keep: share of the greatest |level|^2 below which an entry is not wanted. bound: float32 [c], scratch.
        index, weight, level: out: patch, sqrt(sigma) exp(j phase) in m, and |weight| / (R_t R_r).
    """
    if len(candidate) == 0:
        return 0
    k = 2.0 * math.pi / wavelength
    shape, area, spread, reflection, _ = columns
    need = SEEN if path == DIRECT else SEEN_IN_GROUND if path == GROUND else SEEN | SEEN_IN_GROUND
    z_tx, z_rx = eye[3] if path == GROUND else eye[2], eye[2] if path == DIRECT else eye[3]
    legs = (eye, z_tx, z_rx, k, limits)
    for i in range(len(candidate)):
        bound[i] = 0.0
        if seen[i] & need == need:
            p = candidate[i]
            size, incidence, _, _, _, _, spreading = _lobe(shape[p], area[p], spread[p], eye, z_tx, z_rx, k, limits)
            bound[i] = k / math.sqrt(math.pi) * incidence * size * reflection[p] * spreading
    best = np.argmax(bound[: len(candidate)])
    if bound[best] == 0.0:
        return 0
    # The patch that may be the strongest comes first: most of the others then need no integral.
    value, spreading = _patch_weight(candidate[best], columns, legs)
    strongest, count = abs(value) * spreading, 0
    share = math.sqrt(keep)
    for i in range(len(candidate)):
        if bound[i] < share * strongest or bound[i] == 0.0:
            continue
        value, spreading = _patch_weight(candidate[i], columns, legs)
        received = abs(value) * spreading
        if received < share * strongest or received == 0.0:
            continue
        strongest = max(strongest, received)
        index[count], weight[count], level[count] = candidate[i], value, received
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def point_weights(
    position: Float32,
    axis: Float32,
    kind: Int8,
    amplitude: Complex64,
    length: Float32,
    seen: UInt8,
    eye: Float64,
    path: int,
    wavelength: float,
    index: Int32,
    weight: Complex64,
    level: Float32,
) -> int:  # pragma: no cover - compiled
    """The same for points (``points.Points``): diffuse ones fall with cos, edges with the sinc of their length."""
    k = 2.0 * math.pi / wavelength
    need = SEEN if path == DIRECT else SEEN_IN_GROUND if path == GROUND else SEEN | SEEN_IN_GROUND
    z_tx, z_rx = eye[3] if path == GROUND else eye[2], eye[2] if path == DIRECT else eye[3]
    count = 0
    for p in range(len(kind)):
        if seen[p] & need != need:
            continue
        dx, dy = eye[0] - position[p, 0], eye[1] - position[p, 1]
        za, zb = z_tx - position[p, 2], z_rx - position[p, 2]
        flat = dx * dx + dy * dy
        ra, rb = 1.0 / math.sqrt(flat + za * za), 1.0 / math.sqrt(flat + zb * zb)
        factor = 1.0
        if kind[p] != 0:
            side = axis[p, 0] * dx + axis[p, 1] * dy
            a, b = (side + axis[p, 2] * za) * ra, (side + axis[p, 2] * zb) * rb
            if kind[p] == 1:
                factor = math.sqrt(a * b) if a * b > 0.0 else 0.0
            else:
                factor = _sinc(0.5 * k * (a + b) * length[p])
        if factor == 0.0:
            continue
        index[count], weight[count] = p, amplitude[p] * np.float32(factor)
        level[count] = abs(weight[count]) * ra * rb
        count += 1
    return count
