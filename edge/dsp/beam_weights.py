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
lobes at -30 dB; weights are kept by sector and speed, since solving for them takes one to two milliseconds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edge.dsp import tables, tdm
from edge.dsp.buffers import zeros
from edge.dsp.kernels_weights import level_lobes
from edge.frames import Float64

GRID_M_S = 0.5
RIDGE = 0.04
"""rho, over the mean of the points' squared responses."""
HEADROOM = 0.6
"""Lobes asked for, over the resting ones': speeds are rounded."""
ROUNDS = 8
POINTS = 140
"""Directions of points over the field of view, for each direction of the beam; those of three beams interlace."""
BEAMS = 5
"""Directions of the beam over a sector."""
MAIN_LOBE_WEIGHT = 2.0
LOBES_FROM = 1.03
"""Nulls from the middle: the main lobe may widen by so much."""
OUTER, BENT_SHARE = (0.8, 0.95), 0.25
"""Directions of the beam beyond the field of view, and what their lobes count where the tangent leaves the curve."""
DIRECTIONS = np.linspace(-tdm.FOV_COSINE, tdm.FOV_COSINE, POINTS)
LOBE = np.array([-0.9, -0.7, -0.5, -0.3, 0.0, 0.3, 0.5, 0.7, 0.9])
"""Points within the main lobe, nulls from its middle."""
MOST_POINTS = (BEAMS + 2 * len(OUTER)) * (POINTS + len(LOBE))
MOST_KEPT = 2000
Int64 = NDArray[np.int64]


class BeamWeights:
    """Weights of one burst of one loop.

    Args:
        element, slot: int64 [channel].
        slot_s: from slot to slot.
        taper: float64 [element], the window at rest.
        pitch: element spacing in wavelengths, two-way phase 2 pi pitch u per element.
        wavelength_m: at the middle of the ADC window.
    """

    def __init__(
        self, element: Int64, slot: Int64, slot_s: float, taper: Float64, pitch: float, wavelength_m: float
    ) -> None:
        self._step = 2.0 * math.pi * pitch, 4.0 * math.pi / wavelength_m * slot_s
        self._index = np.stack((element - element.min(), slot - slot.min()))
        elements, slots = self._index.max(axis=1) + 1
        self._place = np.stack((element - 0.5 * (len(taper) - 1), self._index[1] - 0.5 * (slots - 1)))
        self._resting = self._step[0] * (np.arange(len(taper)) - 0.5 * (len(taper) - 1))
        self._taper = taper / taper.sum()
        self._null = tables.main_lobe(taper, 1024) / (1024.0 * pitch)
        response = tables.response_envelope(taper, 1024)
        self._level = HEADROOM * float(response.max(where=response < 1.0, initial=0.0))
        self._pair, self._of = channel_pairs(self._index)
        channels = len(element)
        self._along, self._late, self._line = (zeros(n * MOST_POINTS) for n in (2 * elements, 4 * slots, 6))
        self._sums, self._normal = np.zeros(self._pair.shape[1]), np.zeros((channels, channels))
        self._kept: dict[tuple[float, ...], Float64] = {}
        self.solved = 0
        """Sectors that were solved for, ever."""

    def known(self, sector: tdm.Sector, forward_m_s: float, along_m_s: float) -> Float64 | None:
        """Weights float64 [channel] of one sector, which sum to about 1, if they were solved for."""
        return self._kept.get(_key(sector, forward_m_s, along_m_s))

    def of(self, sector: tdm.Sector, forward_m_s: float, along_m_s: float) -> Float64:
        """The same, solved for when they are not known."""
        key = _key(sector, forward_m_s, along_m_s)
        if key not in self._kept:
            if len(self._kept) >= MOST_KEPT:
                self._kept.clear()
            self._kept[key] = self._solve(sector, *key[2:])
            self.solved += 1
        return self._kept[key]

    def forget(self) -> None:
        """Start anew: what was solved for is unknown again."""
        self._kept.clear()

    def _solve(self, sector: tdm.Sector, forward_m_s: float, along_m_s: float) -> Float64:
        step, point, beyond = self._equations(sector, forward_m_s, along_m_s)
        points = len(beyond)
        elements, slots = self._index.max(axis=1) + 1
        weight = np.zeros((3, self._place.shape[1]))
        level_lobes(
            *(step, point, beyond, self._place, self._index, self._pair, self._of),
            *(MAIN_LOBE_WEIGHT, RIDGE, self._level, ROUNDS),
            self._along[: 2 * elements * points].reshape(2, elements, points),
            self._late[: 4 * slots * points].reshape(4, slots, points),
            self._line[: 6 * points].reshape(6, points),
            *(self._sums, self._normal, weight),
        )
        return np.array(weight[0])

    def _equations(
        self, sector: tdm.Sector, forward_m_s: float, along_m_s: float
    ) -> tuple[Float64, Float64, NDArray[np.bool_]]:
        """Phase steps, shares and wanted responses, what lies beyond the main lobe, as ``level_lobes`` takes them."""
        away, late, shares, wanted, outside = [], [], [], [], []
        for n, (u, share) in enumerate(_beams(sector)):
            points = DIRECTIONS + (n % 3 - 1) * tdm.FOV_COSINE / (1.5 * POINTS)
            lobe = u + self._null * LOBE
            points = np.concatenate((points[np.abs(points - u) > LOBES_FROM * self._null], lobe[np.abs(lobe) < 1.0]))
            beyond = np.abs(points - u) > self._null
            closing_m_s = forward_m_s * np.sqrt(np.maximum(1.0 - points * points, 0.0)) + along_m_s * points
            away.append(points - u)
            late.append(closing_m_s - sector_closing_m_s(sector, u, forward_m_s, along_m_s))
            resting = np.zeros(len(points))
            resting[~beyond] = np.cos(np.outer(points[~beyond] - u, self._resting)) @ self._taper
            shares.append(np.full(len(points), share))
            wanted.append(resting)
            outside.append(beyond)
        step = np.stack((np.concatenate(away), np.concatenate(late))) * np.array(self._step)[:, None]
        return step, np.stack((np.concatenate(shares), np.concatenate(wanted))), np.concatenate(outside)


def _key(sector: tdm.Sector, forward_m_s: float, along_m_s: float) -> tuple[float, float, float, float]:
    forward_m_s, along_m_s = (GRID_M_S * round(speed / GRID_M_S) for speed in (forward_m_s, along_m_s))
    return sector.centre, sector.half_width, forward_m_s, along_m_s


def channel_pairs(index: Int64) -> tuple[Int64, Int64]:
    """Different differences of two channels, int64 [2, pairs], and which of them two channels have, int64 [n, n].

    The cosine of a phase is even, so that a difference and its opposite count as one, elements not negative.
    """
    apart = index[:, :, None] - index[:, None, :]
    apart = np.where((apart[0] < 0) | ((apart[0] == 0) & (apart[1] < 0)), -apart, apart)
    pair, of = np.unique(apart.reshape(2, -1), axis=1, return_inverse=True)
    return np.ascontiguousarray(pair), np.ascontiguousarray(of.reshape(apart.shape[1:]))


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
