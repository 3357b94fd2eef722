# SPDX-License-Identifier: Apache-2.0
"""The radar chips: register steps, antennas' firing order and limits.

Sources: TI Radar Interface Control Document 2.23, the chips' data sheets, TI mmWave SDK. Limits of the IWR6843 and of
the AWR2944 are data sheet values that no board has confirmed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DeviceName = Literal["AWR2243", "AWR1843", "IWR6843", "AWR2944"]


@dataclass(frozen=True, slots=True)
class Device:
    """What one board can do.

    The synthesizer divides 3.6 GHz (76-81 GHz chips) or 2.7 GHz (60-64 GHz chips) by 2^26: one step of the start
    frequency is 53.644 or 40.233 Hz, one of the slope 900 times that per microsecond, 48.280 or 36.210 kHz/us.

    Args:
        name: of the chip; "AWR2243" is the four-chip cascade board MMWCAS-RF-EVM.
        chips, rx: radar chips, receivers of one chip.
        firing_order: transmitters by slot unless a schedule says otherwise, numbered from 1 as on the board.
        reference_hz: 3.6e9 or 2.7e9.
        band_hz: lowest and highest frequency of a ramp.
        max_slope_hz_per_s: magnitude.
        sample_rate_range_hz: lowest and highest ADC rate.
        complex_samples: complex1x; False: real samples only (AWR2944).
        adc_buffer_bytes: one chirp of one chip must fit.
        cube_bytes: memory for one frame inside the chip; 0: the samples leave the chip chirp by chirp.
        max_bandwidth_hz: sampled bandwidth the chip allows.
        vco: profile byte 2; 2 selects VCO2 of the AWR2243.
    """

    name: DeviceName
    chips: int
    rx: int
    firing_order: tuple[int, ...]
    reference_hz: float
    band_hz: tuple[float, float]
    max_slope_hz_per_s: float
    sample_rate_range_hz: tuple[float, float]
    complex_samples: bool
    adc_buffer_bytes: int
    cube_bytes: int
    max_bandwidth_hz: float
    vco: int = 0

    @property
    def frequency_lsb_hz(self) -> float:
        """Step of the start frequency."""
        return self.reference_hz / 2**26

    @property
    def slope_lsb_hz_per_s(self) -> float:
        """Step of the slope."""
        return self.reference_hz * 900.0 / 2**26 * 1e6

    @property
    def sample_bytes(self) -> int:
        """Bytes of one sample in memory: two int16 when complex, one when real."""
        return 4 if self.complex_samples else 2


_BAND_77_HZ = (76e9, 81e9)
_DEVICES = (
    Device(
        name="AWR2243",
        chips=4,
        rx=4,
        firing_order=tuple(range(12, 0, -1)),
        reference_hz=3.6e9,
        band_hz=_BAND_77_HZ,
        max_slope_hz_per_s=266e12,
        sample_rate_range_hz=(2e6, 22.5e6),
        complex_samples=True,
        adc_buffer_bytes=16 << 10,
        cube_bytes=0,
        max_bandwidth_hz=5e9,
        vco=2,
    ),
    Device(
        name="AWR1843",
        chips=1,
        rx=4,
        firing_order=(1, 3, 2),
        reference_hz=3.6e9,
        band_hz=_BAND_77_HZ,
        max_slope_hz_per_s=100e12,
        sample_rate_range_hz=(2e6, 12.5e6),
        complex_samples=True,
        adc_buffer_bytes=32 << 10,
        cube_bytes=1024 << 10,
        max_bandwidth_hz=4e9,
    ),
    Device(
        name="IWR6843",
        chips=1,
        rx=4,
        firing_order=(1, 3, 2),
        reference_hz=2.7e9,
        band_hz=(60e9, 64e9),
        max_slope_hz_per_s=250e12,
        sample_rate_range_hz=(2e6, 12.5e6),
        complex_samples=True,
        adc_buffer_bytes=32 << 10,
        cube_bytes=768 << 10,
        max_bandwidth_hz=4e9,
    ),
    Device(
        name="AWR2944",
        chips=1,
        rx=4,
        firing_order=(1, 3, 4, 2),
        reference_hz=3.6e9,
        band_hz=_BAND_77_HZ,
        max_slope_hz_per_s=250e12,
        sample_rate_range_hz=(2e6, 37.5e6),
        complex_samples=False,
        adc_buffer_bytes=32 << 10,
        cube_bytes=2560 << 10,
        max_bandwidth_hz=5e9,
    ),
)
DEVICES: dict[str, Device] = {device.name: device for device in _DEVICES}
