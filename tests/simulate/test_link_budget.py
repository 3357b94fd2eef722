# SPDX-License-Identifier: Apache-2.0
"""The radar equation against figures worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from edge.errors import ConfigError
from train.simulate.link_budget import LinkSettings, amplitude_per_rcs, snr_db

WAVELENGTH_M = 299_792_458.0 / 78.74e9


def test_one_square_metre_at_five_metres() -> None:
    """15.85 mW x 100 x (3.807 mm)^2 / (1984.4 x 625) over 1.38e-23 x 290 x 19.95 x 8e6 = 29.0."""
    assert snr_db(LinkSettings(), WAVELENGTH_M, 1.0, 5.0) == pytest.approx(14.6, abs=0.05)
    assert snr_db(LinkSettings(), WAVELENGTH_M, 1.0, 5.0) + 10 * np.log10(256) == pytest.approx(38.7, abs=0.05)


def test_40_db_per_decade_and_20_db_per_hundred_square_metres() -> None:
    at = [snr_db(LinkSettings(), WAVELENGTH_M, 1.0, range_m) for range_m in (0.7, 7.0)]
    assert at[0] - at[1] == pytest.approx(40.0)
    assert snr_db(LinkSettings(), WAVELENGTH_M, 100.0, 7.0) - at[1] == pytest.approx(20.0)


def test_amplitude_scales_with_the_noise_it_is_measured_in() -> None:
    one, many = (amplitude_per_rcs(LinkSettings(), WAVELENGTH_M, lsb) for lsb in (1.0, 25.0))
    assert many == pytest.approx(25.0 * one)
    assert 20 * np.log10(one / 25.0) == pytest.approx(14.6, abs=0.05)


@pytest.mark.parametrize(
    ("key", "value"), [("tx_power_dbm", 25.0), ("noise_figure_db", -1.0), ("bandwidth_hz", float("nan"))]
)
def test_impossible_budgets_are_refused(key: str, value: float) -> None:
    with pytest.raises(ConfigError, match=key):
        LinkSettings(**{key: value})
