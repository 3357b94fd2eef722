# SPDX-License-Identifier: Apache-2.0
"""Sub-bin position and height of a peak from three amplitudes, fitted to the exact response of the windows.

With amplitudes A-, A0, A+ of three neighbouring bins the parabola gives p = (A+ - A-) / (2 (2 A0 - A- - A+)), which is
exact at p = 0 and +-1/2 for every symmetric response. The offset is d = p + p (1 - 4 p^2) f . (1, p^2, s, s p^2) and
the peak amplitude A0 g . (1, d^2, d^4, s, s d^2); s = u^2 counts the spread of a row's ranges at direction cosine u.
Without zero padding a rectangular window's neighbours vanish at d = 0 and the parabola is blind there; then
p = A / (A0 + A), A the larger neighbour, with the sign of its side: exact for sin(x) / x.
"""

from __future__ import annotations

import numpy as np

from edge.frames import Float64

OFFSETS = np.linspace(-0.49, 0.49, 33)
SPREADS = np.linspace(0.0, 0.6, 5)
GRID = 1024
"""Points at which a response is computed; linear interpolation between them errs by less than 1e-5."""
SMALL_NEIGHBOUR = 0.15
"""Neighbours of a centred target below this amplitude are read by the two-point formula."""
PARABOLA = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
"""No correction of the parabola, height of the centre bin."""


def fit_response(taper: Float64, bins: int, weight: Float64, shift_bins: Float64) -> Float64:
    """Fit the correction of one axis.

    Args:
        taper: [n] window before the FFT.
        bins: FFT length.
        weight: [m] of the elements whose responses add up.
        shift_bins: [m] by which each element's response is shifted at u = 1; zeros on the angle axis.
    Returns:
        float64 [10]: four coefficients f, five coefficients g, 1 for the two-point formula.
    """
    offset, spread = (grid.ravel() for grid in np.meshgrid(OFFSETS, SPREADS))
    minus, centre, plus = (_response(taper, bins, weight, shift_bins, offset + d, spread) for d in (1.0, 0.0, -1.0))
    origin = np.zeros(1)
    two_point = bool(_response(taper, bins, weight, shift_bins, origin + 1.0, origin)[0] < SMALL_NEIGHBOUR)
    larger = np.maximum(plus, minus)
    if two_point:
        p = np.sign(plus - minus) * larger / (centre + larger)
    else:
        p = 0.5 * (plus - minus) / (2.0 * centre - plus - minus)
    bend = p * (1.0 - 4.0 * p * p)
    f = np.linalg.lstsq(np.stack((bend, bend * p * p, bend * spread, bend * spread * p * p), axis=1), offset - p)[0]
    d2 = offset * offset
    g = np.linalg.lstsq(np.stack((np.ones_like(d2), d2, d2 * d2, spread, spread * d2), axis=1), 1.0 / centre)[0]
    return np.concatenate((f, g, [float(two_point)]))


def _response(taper: Float64, bins: int, weight: Float64, shift: Float64, offset: Float64, spread: Float64) -> Float64:
    """Amplitude at ``offset`` bins from a target whose elements are shifted by sqrt(spread) shift; 1 at its centre."""
    n = np.arange(len(taper))
    n = n - (taper * n).sum() / taper.sum()
    away = offset[:, None] - np.sqrt(spread)[:, None] * shift[None, :]
    grid = np.linspace(away.min(), away.max(), GRID)
    response = np.interp(away, grid, np.cos(2.0 * np.pi / bins * np.outer(grid, n)) @ taper)
    return np.asarray(np.abs(response @ weight) / (taper.sum() * weight.sum()))
