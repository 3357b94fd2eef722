# SPDX-License-Identifier: Apache-2.0
"""Weights of a moved row's channels: the resting main lobe kept, the highest sidelobe of the field of view the lowest.

Elements that motion moves during a burst stand closer together here and farther apart there; a window taken at their
places no longer fits, and weights by their density leave lobes of -20 dB. For every direction u of a sector the
response to a static point in direction u_0 is known exactly,

    S(u, u_0) = sum_c w_c exp(j (psi_c(u_0) - beta_c(u))),

psi the phases that the point has, c(u_0) = v_x sqrt(1 - u_0^2) + v_along u_0 its closing speed, beta those that the
sector's beam undoes, with the tangent in the place of c. The w_c are the least squares solution for the resting
pattern within its main lobe and 0 beyond, beyond reweighted by the error (Lawson 1961) until the lobes are level;
a ridge, rho |w|^2, keeps the noise within about 1 dB. Speeds are rounded to GRID_M_S, which costs less than 1 dB of
lobes at -30 dB; weights are kept by speed, since solving for them takes milliseconds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edge.dsp import tables, tdm
from edge.dsp.kernels_weights import level_lobes
from edge.frames import Float64

GRID_M_S = 0.5
RIDGE = 0.04
HEADROOM = 0.6
"""Lobes asked for, over the resting ones': speeds are rounded."""
ROUNDS = 8
POINTS = 140
"""Directions of points over the field of view, for each direction of the beam; those of three beams interlace."""
BEAMS = 5
MAIN_LOBE_WEIGHT = 2.0
LOBES_FROM = 1.03
"""Nulls from the middle: the main lobe may widen by so much."""
OUTER, BENT_SHARE = (0.8, 0.95), 0.25
MOST_KEPT = 2000


class BeamWeights:
    """Weights of one burst of one loop.

    Args:
        position: float64 [channel], in elements from the row's middle.
        time_s: float64 [channel], from the middle of the burst.
        taper: float64 [element], the window at rest.
        pitch: element spacing in wavelengths, two-way phase 2 pi pitch u per element.
        wavelength_m: at the middle of the ADC window.
    """

    def __init__(self, position: Float64, time_s: Float64, taper: Float64, pitch: float, wavelength_m: float) -> None:
        self._along, self._wavenumber_t = 2.0 * math.pi * pitch * position, 4.0 * math.pi / wavelength_m * time_s
        self._resting = 2.0 * math.pi * pitch * (np.arange(len(taper)) - 0.5 * (len(taper) - 1))
        self._taper = taper / taper.sum()
        self._null = tables.main_lobe(taper, 1024) / (1024.0 * pitch)
        response = tables.response_envelope(taper, 1024)
        self._level = HEADROOM * float(response.max(where=response < 1.0, initial=0.0))
        self._kept: dict[tuple[float, ...], Float64] = {}

    def of(self, sector: tdm.Sector, forward_m_s: float, along_m_s: float) -> Float64:
        """Weights float64 [channel] of one sector, which sum to about 1."""
        forward_m_s, along_m_s = (GRID_M_S * round(speed / GRID_M_S) for speed in (forward_m_s, along_m_s))
        key = (sector.centre, sector.half_width, forward_m_s, along_m_s)
        if key not in self._kept:
            if len(self._kept) >= MOST_KEPT:
                self._kept.clear()
            self._kept[key] = self._solve(sector, forward_m_s, along_m_s)
        return self._kept[key]

    def _solve(self, sector: tdm.Sector, forward_m_s: float, along_m_s: float) -> Float64:
        equations = self._equations(sector, forward_m_s, along_m_s)
        channels = equations[0].shape[1]
        weight, normal = np.zeros((2, channels)), np.zeros((channels, channels))
        level_lobes(*equations, MAIN_LOBE_WEIGHT, RIDGE, self._level, ROUNDS, normal, weight)
        return np.asarray(weight[0])

    def _equations(
        self, sector: tdm.Sector, forward_m_s: float, along_m_s: float
    ) -> tuple[Float64, Float64, NDArray[np.bool_]]:
        """Rows (re, im alternating) of S, its resting value, and which points lie beyond the main lobe."""
        rows, wanted, beyond = [], [], []
        for n, (u, share) in enumerate(_beams(sector)):
            points = np.linspace(-tdm.FOV_COSINE, tdm.FOV_COSINE, POINTS) + (n % 3 - 1) * tdm.FOV_COSINE / (
                1.5 * POINTS
            )
            lobe = u + self._null * np.array([-0.9, -0.7, -0.5, -0.3, 0.0, 0.3, 0.5, 0.7, 0.9])
            points = np.concatenate((points[np.abs(points - u) > LOBES_FROM * self._null], lobe[np.abs(lobe) < 1.0]))
            outside = np.abs(points - u) > self._null
            closing_m_s = forward_m_s * np.sqrt(np.maximum(1.0 - points * points, 0.0)) + along_m_s * points
            away = closing_m_s - sector_closing_m_s(sector, u, forward_m_s, along_m_s)
            phase = np.outer(points - u, self._along) + np.outer(away, self._wavenumber_t)
            rows.append(share * np.stack((np.cos(phase), np.sin(phase)), axis=1).reshape(-1, phase.shape[1]))
            resting = np.cos(np.outer(points - u, self._resting)) @ self._taper
            wanted.append(share * np.where(outside, 0.0, resting))
            beyond.append(outside)
        return np.concatenate(rows), np.concatenate(wanted), np.concatenate(beyond)


def sector_closing_m_s(sector: tdm.Sector, u: float, forward_m_s: float, along_m_s: float) -> float:
    """Closing speed that a sector's beam towards u undoes: the tangent at its centre, moved into the curve's bow."""
    across = math.sqrt(1.0 - sector.centre**2)
    slope_m_s = along_m_s - forward_m_s * sector.centre / across
    bow_m_s = -0.25 * forward_m_s / across**3 * sector.half_width**2
    return forward_m_s * across + along_m_s * sector.centre + bow_m_s + slope_m_s * (u - sector.centre)


def _beams(sector: tdm.Sector) -> list[tuple[float, float]]:
    """Directions of the beam in which lobes are made low, and their share: from end to end of the sector.

    Rows beyond the field of view belong to the outer sectors; what a bent tangent can do there counts less.
    """
    low, high = sector.centre - sector.half_width, sector.centre + sector.half_width
    beams = [(float(u), 1.0) for u in np.linspace(low, high, BEAMS)]
    share = 1.0 if low < 0.0 < high and sector.half_width > 0.99 * tdm.FOV_COSINE else BENT_SHARE
    for u in OUTER:
        beams += [(u, share)] if high > 0.99 * tdm.FOV_COSINE else []
        beams += [(-u, share)] if low < -0.99 * tdm.FOV_COSINE else []
    return beams
