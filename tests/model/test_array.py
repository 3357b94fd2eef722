# SPDX-License-Identifier: Apache-2.0
"""Virtual arrays against the boards' published geometry and the definition of a far target's phase."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from edge.array import array_for, awr1843, awr2944, cascade, iwr6843
from edge.devices import DEVICES
from edge.errors import ConfigError

C = 299_792_458.0


def tx(slot):
    """Number of the cascade's transmitter in a slot."""
    return 12 - slot


def test_cascade_has_86_58_28_134():
    array = cascade()
    assert array.count == 86
    assert (array.position >= 0).sum() == 144
    assert (array.multiplicity == 2).sum() == len(array.doubled) == 58
    assert (array.multiplicity == 1).sum() == 28
    assert array.unique_count == 134
    assert array.position.shape == (12, 16)


def test_cascade_singles_and_doubles_stand_where_the_tables_say():
    single = np.flatnonzero(cascade().multiplicity == 1)
    assert single.tolist() == [*range(11), *range(36, 46), 47, 48, 49, *range(82, 86)]


@pytest.mark.parametrize(
    ("element", "channels"),
    [
        (11, {(12, 1), (10, 16)}),
        (15, {(11, 1), (9, 16)}),
        (46, {(12, 9), (4, 4)}),
        (50, {(12, 5), (11, 9)}),
        (62, {(9, 5), (8, 9)}),
        (81, {(5, 8), (4, 12)}),
    ],
)
def test_cascade_doubles_by_antenna_number(element, channels):
    pairs = [{(tx(slot), rx + 1) for slot, rx in pair} for pair in cascade().doubled]
    assert pairs.count(channels) == 1
    first, _ = cascade().doubled[pairs.index(channels)]
    assert cascade().position[first] == element


def test_doubles_are_apart_in_time_as_listed():
    array = cascade()
    for (slot, rx), (later, other) in array.doubled:
        element = array.position[slot, rx]
        assert element == array.position[later, other]
        if element == 46:
            apart = 8
        elif element >= 50:
            apart = 1
        else:
            apart = 2 if element % 4 == 3 else 3
        assert later - slot == apart


def test_cascade_elevation_rows():
    array = cascade()
    rows = {
        9: (1, {*range(9, 13), *range(20, 24), *range(55, 63)}),
        10: (4, {*range(10, 14), *range(21, 25), *range(56, 64)}),
        11: (6, {*range(11, 15), *range(22, 26), *range(57, 65)}),
    }
    for slot, (elevation, azimuth) in rows.items():
        assert array.tx_elevation[slot] == elevation
        assert set((array.tx_azimuth[slot] + array.rx_azimuth).tolist()) == azimuth
        assert (array.position[slot] == -1).all()
    heights = {0, *array.tx_elevation.tolist()}
    assert {abs(a - b) for a, b in product(heights, heights)} == set(range(7))


def test_cascade_receivers_from_left_to_right():
    assert (np.argsort(cascade().rx_azimuth) + 1).tolist() == [
        13,
        14,
        15,
        16,
        *range(1, 5),
        *range(9, 13),
        *range(5, 9),
    ]


def test_cascade_at_the_actual_frequency():
    array = cascade()
    assert array.unit_m * 1e3 == pytest.approx(1.9518, abs=1e-4)
    assert array.pitch_wavelengths(78.7387e9) == pytest.approx(0.5126, abs=1e-4)
    assert (array.count - 1) * array.unit_m == pytest.approx(0.166, abs=5e-4)


@pytest.mark.parametrize(
    ("make", "row", "unique", "raised", "height"),
    [(awr1843, 8, 12, {2, 3, 4, 5}, 1.0), (iwr6843, 8, 12, {2, 3, 4, 5}, 1.0), (awr2944, 12, 16, {2, 3, 4, 5}, 1.6)],
)
def test_single_chips(make, row, unique, raised, height):
    array = make()
    assert (array.count, array.unique_count, array.doubled) == (row, unique, [])
    assert sorted(array.position[array.position >= 0].tolist()) == list(range(row))
    assert array.tx_elevation[:-1].tolist() == [0.0] * (len(array.tx_elevation) - 1)
    assert array.tx_elevation[-1] == height
    assert set((array.tx_azimuth[-1] + array.rx_azimuth).tolist()) == raised


@pytest.mark.parametrize("device", DEVICES)
def test_far_targets_phase_is_linear_in_position(device):
    """Exact two-way paths to a target 100 km away differ by position x pitch x u wavelengths, 0 in the row's middle."""
    array = array_for(device)
    transmit_m, receive_m = array.element_offsets_m()
    far_m, u, wavelength_m = 1e5, 0.4, 1.02 * 2 * array.unit_m
    target = far_m * np.array([np.sqrt(1 - u * u), u])
    path_m = np.hypot(target[0], target[1] - transmit_m)[:, None] + np.hypot(target[0], target[1] - receive_m)
    expected = array.pitch_wavelengths(C / wavelength_m) * (array.position - 0.5 * (array.count - 1)) * u
    inside = array.position >= 0
    assert ((2 * far_m - path_m) / wavelength_m)[inside] == pytest.approx(expected[inside], abs=1e-4)
    assert np.unique((transmit_m[:, None] + receive_m)[inside].round(9)).mean() == pytest.approx(0.0, abs=1e-9)


def test_other_firing_orders():
    turned = array_for("IWR6843", (1, 2, 3))
    assert turned.tx_elevation.tolist() == [0.0, 1.0, 0.0]
    assert (turned.position[1] == -1).all()
    assert array_for("AWR2243", tuple(range(12, 3, -1))).count == 86


def test_arrays_that_cannot_image_are_refused():
    with pytest.raises(ConfigError, match="filled row"):
        array_for("AWR2243", (12, 4))
    with pytest.raises(ConfigError, match="filled row"):
        array_for("AWR1843", (2,))
    with pytest.raises(ConfigError, match="AWR2243"):
        array_for("AWR9999")
    with pytest.raises(ConfigError, match="transmitters"):
        array_for("AWR1843", (1, 4))


def test_tables_are_read_only():
    array = cascade()
    with pytest.raises(ValueError, match="read-only"):
        array.tx_azimuth[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        array.position[0, 0] = 1
