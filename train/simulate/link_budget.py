# SPDX-License-Identifier: Apache-2.0
"""Radar equation: how strong a scatterer of a given cross section stands in one complex sample.

a^2 / noise^2 = P G^2 lambda^2 sigma / ((4 pi)^3 R_t^2 R_r^2 k T F B), B the rate of the complex samples. The defaults
give +14.6 dB for 1 m^2 at 5 m. Source: Skolnik, Introduction to Radar Systems, eq. 1.2 with the noise kTB F; power and
noise figure are data sheet values of the AWR2243, the antenna gain is not published (docs/simulation.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from edge.config import require

BOLTZMANN_J_K = 1.380649e-23


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """One channel's budget.

    Args:
        tx_power_dbm: at one transmitter's output, 0 to 20.
        gain_dbi: of either antenna on boresight, 0 to 30.
        noise_figure_db: of the receiver, 0 to 30.
        temperature_k: of the noise, 200 to 400.
        bandwidth_hz: of one complex sample, the sampling rate (half of it with real samples), 1 to 40 MHz.
    Raises:
        ConfigError: a value out of its range.
    """

    tx_power_dbm: float = 12.0
    gain_dbi: float = 10.0
    noise_figure_db: float = 13.0
    temperature_k: float = 290.0
    bandwidth_hz: float = 8e6

    def __post_init__(self) -> None:
        for key, low, high in (
            ("tx_power_dbm", 0.0, 20.0),
            ("gain_dbi", 0.0, 30.0),
            ("noise_figure_db", 0.0, 30.0),
            ("temperature_k", 200.0, 400.0),
            ("bandwidth_hz", 1e6, 40e6),
        ):
            require(low <= getattr(self, key) <= high, f"link.{key}", getattr(self, key), f"{low:g} to {high:g}")


def noise_power_w(link: LinkSettings) -> float:
    """Noise of one complex sample, referred to the receiver's input: k T F B."""
    return BOLTZMANN_J_K * link.temperature_k * math.pow(10.0, 0.1 * link.noise_figure_db) * link.bandwidth_hz


def snr_db(link: LinkSettings, wavelength_m: float, rcs_m2: float, range_m: float) -> float:
    """Signal over noise of one complex sample of a scatterer on boresight, before any integration.

    Args:
        link: budget.
        wavelength_m: at the middle of the ADC window.
        rcs_m2: radar cross section.
        range_m: from both antennas.
    """
    return 20.0 * math.log10(amplitude_per_rcs(link, wavelength_m, 1.0) * math.sqrt(rcs_m2) / range_m**2)


def amplitude_per_rcs(link: LinkSettings, wavelength_m: float, noise_lsb: float) -> float:
    """Amplitude in LSB of 1 m^2 at 1 m on boresight; times sqrt(rcs) / (R_t R_r) it is any scatterer's.

    Args:
        link: budget.
        wavelength_m: at the middle of the ADC window.
        noise_lsb: standard deviation of one complex sample's noise.
    Returns:
        LSB m^2 / m, so that amplitude = value * sqrt(rcs_m2) / (R_t * R_r).
    """
    power_w = 1e-3 * math.pow(10.0, 0.1 * link.tx_power_dbm + 0.2 * link.gain_dbi)
    received_w = power_w * wavelength_m**2 / (4.0 * math.pi) ** 3
    return noise_lsb * math.sqrt(received_w / noise_power_w(link))
