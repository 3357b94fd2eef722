# SPDX-License-Identifier: Apache-2.0
"""Virtual antenna arrays of the boards: who stands where, in firing and in capture order.

Positions are in half wavelengths of the board's design frequency. Azimuth is the axis of the board's long row,
elevation the axis across it. Sources: TI TIDUEN5A (MMWCAS-RF-EVM), TI user's guides of the BOOST, ISK and EVM boards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.devices import DEVICES
from edge.frames import Float64
from edge.waveform import SPEED_OF_LIGHT_M_S

Channel = tuple[int, int]
"""(slot, receiver)."""


@dataclass(frozen=True, eq=False)
class VirtualArray:
    """One board's antennas and the virtual elements that every transmitter makes with every receiver.

    A virtual element stands at TX + RX; its two-way path to a far target at direction cosine u along the row is shorter
    by (TX + RX) u. The *row* is what elevation 0 gives: a filled uniform line, some of its elements made by two
    channels.

    Both antenna tables are taken to count from one common origin of the board, so that path = |p - A| + |p - B| with
    A and B offset from the phase centre, the middle of the row at (TX + RX) / 2. A constant distance between the two
    tables would leave TX + RX, thus all angles, as they are and shift only the wavefront's curvature.

    Args:
        tx_azimuth, tx_elevation: float64 [slots], in firing order (slot 0 first).
        rx_azimuth, rx_elevation: float64 [receivers], in capture order (device-major).
        design_frequency_hz: frequency whose half wavelength is the unit.
    Raises:
        ConfigError: elevation 0 gives no filled row on whole half wavelengths.
    """

    tx_azimuth: Float64
    tx_elevation: Float64
    rx_azimuth: Float64
    rx_elevation: Float64
    design_frequency_hz: float

    def __post_init__(self) -> None:
        for name in ("tx_azimuth", "tx_elevation", "rx_azimuth", "rx_elevation"):
            values = np.array(getattr(self, name), dtype=np.float64)
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        places = np.unique(self._azimuth[self._elevation == 0.0])
        filled = len(places) > 1 and bool(np.all(places == places[0] + np.arange(len(places))))
        require(
            filled, "array", places.tolist(), "a filled row of half wavelengths", "let more transmitters take turns"
        )

    @property
    def _azimuth(self) -> Float64:
        return np.asarray(self.tx_azimuth[:, None] + self.rx_azimuth)

    @property
    def _elevation(self) -> Float64:
        return np.asarray(self.tx_elevation[:, None] + self.rx_elevation)

    @cached_property
    def position(self) -> NDArray[np.int64]:
        """int64 [slots, receivers], element of the row, 0 first; -1: not in the row."""
        inside = self._elevation == 0.0
        place = np.rint(self._azimuth - self._azimuth[inside].min()).astype(np.int64)
        position = np.where(inside, place, -1)
        position.setflags(write=False)
        return position

    @property
    def count(self) -> int:
        """Elements of the row."""
        return int(self.position.max()) + 1

    @cached_property
    def multiplicity(self) -> NDArray[np.int64]:
        """int64 [count], channels that make each element of the row."""
        return np.bincount(self.position[self.position >= 0], minlength=self.count)

    @property
    def unique_count(self) -> int:
        """Different virtual elements of the whole array, all elevations."""
        both = np.stack((self._azimuth.ravel(), self._elevation.ravel()), axis=1)
        return len(np.unique(both.round(6), axis=0))

    @cached_property
    def doubled(self) -> list[tuple[Channel, Channel]]:
        """Pairs of channels at one element of the row, ascending by element, the earlier slot first.

        Their phases differ only by the target's motion between the two slots (and by calibration).
        """
        pairs = []
        for element in np.flatnonzero(self.multiplicity > 1):
            channels = [(int(slot), int(rx)) for slot, rx in np.argwhere(self.position == element)]
            pairs += [(channels[0], other) for other in channels[1:]]
        return pairs

    @property
    def unit_m(self) -> float:
        """Half a wavelength of the design frequency."""
        return SPEED_OF_LIGHT_M_S / (2.0 * self.design_frequency_hz)

    def pitch_wavelengths(self, frequency_hz: float) -> float:
        """Spacing of the row's elements in wavelengths of ``frequency_hz``; a grating lobe enters above 0.5."""
        return frequency_hz / (2.0 * self.design_frequency_hz)

    def element_offsets_m(self) -> tuple[Float64, Float64]:
        """Antennas along the row, from the phase centre.

        Returns:
            Transmitters [slots] and receivers [receivers], metres; their sums average to 0 over the row's ends.
        """
        ends = self._azimuth[self._elevation == 0.0]
        middle = 0.25 * (ends.min() + ends.max())
        return (self.tx_azimuth - middle) * self.unit_m, (self.rx_azimuth - middle) * self.unit_m


@dataclass(frozen=True, slots=True)
class _Board:
    """Antennas by their numbers: transmitter -> (azimuth, elevation), receivers in capture order in one row."""

    tx: dict[int, tuple[float, float]]
    rx: tuple[int, ...]
    design_frequency_hz: float


_ROW = {tx: (4.0 * (12 - tx), 0.0) for tx in range(4, 13)}
_ISK_TX = {1: (0.0, 0.0), 2: (2.0, 1.0), 3: (4.0, 0.0)}
_BOARDS = {
    "AWR2243": _Board(
        {1: (11.0, 6.0), 2: (10.0, 4.0), 3: (9.0, 1.0), **_ROW},
        (11, 12, 13, 14, 50, 51, 52, 53, 46, 47, 48, 49, 0, 1, 2, 3),
        76.8e9,
    ),
    "AWR1843": _Board(_ISK_TX, (0, 1, 2, 3), 77e9),
    "IWR6843": _Board(_ISK_TX, (0, 1, 2, 3), 62e9),
    "AWR2944": _Board({1: (0.0, 0.0), 2: (2.0, 1.6), 3: (4.0, 0.0), 4: (8.0, 0.0)}, (0, 1, 2, 3), 77e9),
}


def array_for(device: str, transmitters: tuple[int, ...] = ()) -> VirtualArray:
    """Array of a board.

    Args:
        device: a key of ``edge.devices.DEVICES``.
        transmitters: in firing order, as in ``Schedule.transmitters``; empty: the device's order.
    Raises:
        ConfigError: unknown device or transmitter, or no filled row.
    """
    require(device in _BOARDS, "profile.device", device, ", ".join(_BOARDS))
    board = _BOARDS[device]
    order = transmitters or DEVICES[device].firing_order
    require(set(order) <= set(board.tx), "schedule.transmitters", order, f"of {sorted(board.tx)}")
    tx = np.array([board.tx[number] for number in order])
    rx = np.array(board.rx, dtype=np.float64)
    return VirtualArray(tx[:, 0], tx[:, 1], rx, np.zeros_like(rx), board.design_frequency_hz)


def cascade() -> VirtualArray:
    """MMWCAS-RF-EVM: 86 elements in the row, 58 of them doubled, 134 different ones in all; slot s fires TX 12 - s.

    Receivers in file order: master, slave 1, slave 2, slave 3. The row is 42.5 wavelengths long, elevations 0, 1, 4, 6.
    """
    return array_for("AWR2243")


def awr1843() -> VirtualArray:
    """AWR1843BOOST: 8 elements in the row; TX2, half a wavelength higher, fires last. Design taken as 77 GHz."""
    return array_for("AWR1843")


def iwr6843() -> VirtualArray:
    """IWR6843ISK: antennas as on the AWR1843BOOST. Design frequency taken as 62 GHz, the middle of its band."""
    return array_for("IWR6843")


def awr2944() -> VirtualArray:
    """AWR2944EVM: 12 elements in the row; TX2, 0.8 wavelengths higher, fires last. Design frequency taken as 77 GHz."""
    return array_for("AWR2944")
