# SPDX-License-Identifier: Apache-2.0
"""The ground: Fresnel coefficients, two-ray pattern over height, clutter that stays; pattern, range, motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.config import AntennaSettings
from edge.dsp.antenna import across_loss_db, along_loss_db
from edge.errors import ConfigError
from edge.frames import RADARS, Float64, RadarId
from tests.simulate.plain_surfaces import EVERYTHING, NO_GROUND, OPEN, WAVELENGTH_M, point_surface
from train.objects.mesh import Mesh
from train.objects.primitives import box, join
from train.simulate.ground import GroundSettings, ground_reflection
from train.simulate.link_budget import LinkSettings, amplitude_per_rcs
from train.simulate.optics import OpticsSettings, Placed, SceneOptics
from train.simulate.scatterers import GroundPlane, Scatterers
from train.simulate.surface import SurfaceSettings, make_surface

LOOK_LEFT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
STILL = np.zeros(3)
REACH_M = 14.0


def optics(placed: list[Placed], settings: OpticsSettings, antenna: AntennaSettings = OPEN) -> SceneOptics:
    return SceneOptics(placed, settings, LinkSettings(), antenna, WAVELENGTH_M, 25.0, np.random.default_rng(1))


def mirror(ground: GroundSettings) -> OpticsSettings:
    return replace(EVERYTHING, ground=replace(ground, clutter_points=0))


def received(scatterers: Scatterers, plane: GroundPlane) -> complex:
    """Sum of the scatterers at the rig's origin, every leg by its own path."""
    image_m = plane.mirrored(np.zeros((1, 3)))[0]
    direct_m = np.linalg.norm(scatterers.position_m, axis=1)
    mirrored_m = np.linalg.norm(scatterers.position_m - image_m, axis=1)
    path_m = np.where(scatterers.tx_image, mirrored_m, direct_m) + np.where(scatterers.rx_image, mirrored_m, direct_m)
    return complex(np.sum(scatterers.amplitude * np.exp(2j * np.pi * path_m / WAVELENGTH_M)))


def test_fresnel_coefficients() -> None:
    sine = float(np.sin(np.radians(11.0)))
    assert ground_reflection(sine, 4.0, "H", 0.0, 0.0038) == pytest.approx(-0.80, abs=0.005)
    assert ground_reflection(sine, 4.0, "V", 0.0, 0.0038) == pytest.approx(-0.38, abs=0.015)
    assert ground_reflection(1.0, 4.0, "H", 0.0, 0.0038) == pytest.approx(-1 / 3)
    brewster = float(np.sin(np.arctan(1 / np.sqrt(4.0))))
    assert ground_reflection(brewster, 4.0, "V", 0.0, 0.0038) == pytest.approx(0.0, abs=1e-12)
    smooth, rough = (ground_reflection(0.2, 4.0, "H", s, 0.0038) for s in (0.0, 1e-3))
    assert rough / smooth == pytest.approx(np.exp(-2 * (2 * np.pi * 1e-3 * 0.2 / 0.0038) ** 2))


@pytest.mark.parametrize("radar", RADARS)
@pytest.mark.parametrize("pitch_deg", [0.0, 7.0])
def test_two_ray_pattern_over_height(radar: RadarId, pitch_deg: float) -> None:
    """|R_d^-1 + Gamma R_g^-1 e^(j Delta)|^4 R_d^4 over a point without ground, 0.3 to 1.5 m high; tilted rig too."""
    c, s = np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    attitude = LOOK_LEFT @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    ground = GroundSettings(permittivity=4.0, roughness_m=5e-4, horizontal_board="V")
    polarization = "V" if radar == "horizontal" else "H"
    height_m, away_m = 0.8, 6.0
    for point_m in np.linspace(0.3, 1.5, 25):
        placed = [Placed(point_surface((0.0, 0.0, float(point_m)), 1.0), np.array([0.0, away_m, 0.0]))]
        arguments = (radar, 0.0, np.array([0.0, 0.0, height_m]), attitude, STILL, REACH_M)
        over, plane = optics(placed, mirror(ground)).scatterers(*arguments)
        alone, _ = optics(placed, replace(EVERYTHING, ground=NO_GROUND)).scatterers(*arguments)
        assert (len(over), len(alone)) == (4, 1)
        direct_m, ground_m = np.hypot(away_m, point_m - height_m), np.hypot(away_m, point_m + height_m)
        cosine = away_m / ground_m
        root = np.sqrt(4.0 - cosine**2)
        sine = (point_m + height_m) / ground_m
        gamma = (sine - root) / (sine + root) if polarization == "H" else (4 * sine - root) / (4 * sine + root)
        gamma *= np.exp(-2 * (2 * np.pi * 5e-4 * sine / WAVELENGTH_M) ** 2)
        delta = 2 * np.pi * (ground_m - direct_m) / WAVELENGTH_M
        expected = abs(1 + gamma * direct_m / ground_m * np.exp(1j * delta)) ** 4
        found = abs(received(over, plane)) ** 2 / abs(received(alone, plane)) ** 2
        assert found == pytest.approx(expected, rel=2e-3)


def test_level_is_the_radar_equation_with_both_boards_patterns() -> None:
    antenna = AntennaSettings()
    where = np.array([1.0, 4.0, 1.3])
    placed = [Placed(point_surface((0.0, 0.0, float(where[2])), 0.25), np.array([where[0], where[1], 0.0]))]
    made = optics(placed, replace(EVERYTHING, ground=NO_GROUND), antenna)
    rig_m = np.array([0.0, 0.0, 0.8])
    towards = LOOK_LEFT.T @ (where - rig_m)
    range_m = np.linalg.norm(towards)
    for radar, along, across in (("horizontal", 1, 2), ("vertical", 2, 1)):
        found, _ = made.scatterers(radar, 0.0, rig_m, LOOK_LEFT, STILL, REACH_M)  # type: ignore[arg-type]
        unit = towards / range_m
        loss_db = along_loss_db(antenna, unit[along]) + across_loss_db(antenna, unit[across])
        level = amplitude_per_rcs(LinkSettings(), WAVELENGTH_M, 25.0) * 0.5 / range_m**2 * 10 ** (-loss_db / 10)
        assert abs(found.amplitude[0]) == pytest.approx(level, rel=1e-5)
        np.testing.assert_allclose(found.position_m[0], towards, atol=1e-6)


def test_moving_object_and_rig() -> None:
    velocity = np.array([2.0, -1.0, 0.0])
    placed = [Placed(point_surface((0.0, 0.0, 0.5), 1.0), np.array([0.0, 5.0, 0.0]), 0.4, velocity)]
    rig_velocity = np.array([0.5, 0.0, 0.0])
    made = optics(placed, replace(EVERYTHING, ground=NO_GROUND))
    for t_s in (0.0, 0.7):
        rig_m = np.array([0.0, 0.0, 0.8]) + rig_velocity * t_s
        found, _ = made.scatterers("horizontal", t_s, rig_m, LOOK_LEFT, rig_velocity, REACH_M)
        place = np.array([0.0, 5.0, 0.5]) + velocity * t_s - rig_m
        np.testing.assert_allclose(found.position_m[0], LOOK_LEFT.T @ place, atol=1e-6)
        np.testing.assert_allclose(found.velocity_m_s[0], LOOK_LEFT.T @ (velocity - rig_velocity), atol=1e-12)


def world(found: Scatterers, rig_m: Float64) -> Float64:
    return found.position_m @ LOOK_LEFT.T + rig_m


def test_clutter_is_fixed_to_the_world_and_has_its_mean_level() -> None:
    settings = replace(EVERYTHING, ground=GroundSettings(clutter_points=4000, clutter_db=-20.0, clutter_span_m=32.0))
    made = optics([], settings)
    near, far = np.array([0.0, 0.0, 0.8]), np.array([0.73, 0.0, 0.8])
    first, _ = made.scatterers("horizontal", 0.0, near, LOOK_LEFT, STILL, REACH_M)
    second, _ = made.scatterers("horizontal", 0.0, far, LOOK_LEFT, STILL, REACH_M)
    a, b = world(first, near), world(second, far)
    inside = (np.linalg.norm(a - far, axis=1) < 12.0) & (a[:, 1] > 0)
    nearest = np.linalg.norm(a[inside][:, None] - b[None], axis=2).min(axis=1)
    assert inside.sum() > 500
    assert nearest.max() < 1e-5
    level = amplitude_per_rcs(LinkSettings(), WAVELENGTH_M, 25.0)
    range_m = np.linalg.norm(first.position_m, axis=1)
    sigma = np.abs(first.amplitude) ** 2 / level**2 * range_m**4
    half_disc_m2 = 0.5 * np.pi * (REACH_M - 0.3) ** 2
    # 1200 exponential powers and their number, and the boards' imbalance (mean of 10^(N(0, 2 dB) / 20)): 3 %, 3 %, 3 %.
    assert sigma.sum() / half_disc_m2 == pytest.approx(0.01, rel=0.15)


def test_every_burst_is_a_function_of_place_and_time_alone() -> None:
    """Two boxes, one of which drives past in front of the other: in order, and each burst by a new object alone."""
    mesh = Mesh(*join([box((0, 0, 0.5), (1.6, 0.6, 1.0))]), 0, "test/box")
    surface = make_surface(mesh, SurfaceSettings(), 3.0, WAVELENGTH_M, np.random.default_rng(0))
    placed = [
        Placed(surface, np.array([0.3, 5.0, 0.0]), 0.2),
        Placed(surface, np.array([-1.0, 3.0, 0.0]), 0.0, np.array([1.5, 0.0, 0.0])),
    ]
    made = optics(placed, OpticsSettings())
    bursts = [(RADARS[n % 2], 0.05 * n, np.array([0.03 * n, 0.0, 0.8]), LOOK_LEFT, STILL, REACH_M) for n in range(24)]
    first = [made.scatterers(*burst)[0] for burst in bursts]
    assert len({len(found) for found in first}) > 8
    for number in (19, 2, 23, 0, 11, 10):
        for again in (made, optics(placed, OpticsSettings())):
            found, _ = again.scatterers(*bursts[number])
            assert found.amplitude.tobytes() == first[number].amplitude.tobytes()
            assert found.position_m.tobytes() == first[number].position_m.tobytes()


def test_what_is_too_far_or_behind_is_left_out() -> None:
    placed = [Placed(point_surface((0.0, 0.0, 0.5), 1.0), np.array([0.0, y, 0.0])) for y in (-4.0, 4.0, 13.9, 20.0)]
    found, plane = optics(placed, mirror(GroundSettings())).scatterers(
        "horizontal", 0.0, np.array([0.0, 0.0, 0.8]), LOOK_LEFT, STILL, REACH_M
    )
    np.testing.assert_allclose(world(found, np.array([0.0, 0.0, 0.8])), np.tile([0.0, 4.0, 0.5], (4, 1)), atol=1e-6)
    assert sorted(zip(found.tx_image.tolist(), found.rx_image.tolist(), strict=True)) == [
        *((False, False), (False, True), (True, False), (True, True))
    ]
    assert plane.offset_m == 0.8


def test_bad_settings_and_places_are_refused() -> None:
    with pytest.raises(ConfigError, match="permittivity"):
        GroundSettings(permittivity=0.5)
    with pytest.raises(ConfigError, match="weight_step_m"):
        OpticsSettings(visibility_step_m=0.01, weight_step_m=0.04)
    with pytest.raises(ConfigError, match="height"):
        optics([], OpticsSettings()).scatterers("horizontal", 0.0, np.zeros(3), LOOK_LEFT, STILL, REACH_M)
