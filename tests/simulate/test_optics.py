# SPDX-License-Identifier: Apache-2.0
"""Physical optics against closed forms: plates far and near, tilt, spheres, a trihedral, the integral itself."""

from __future__ import annotations

import numpy as np
import pytest

from edge.frames import Float64
from tests.simulate.plain_surfaces import EVERYTHING, WAVELENGTH_M, eye, hemisphere, plate, point_surface, pure
from train.simulate.kernels_optics import triangle_integral
from train.simulate.rcs import CrossSection


def decibel(value: float) -> float:
    return 10.0 * float(np.log10(value))


@pytest.mark.parametrize("scale", [1e-3, 0.3, 1.0, 30.0])
def test_triangle_integral_is_that_of_a_dense_sum(scale: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(4):
        u, v = rng.normal(0, 0.02, (2, 3))
        normal = np.cross(u, v)
        area = 0.5 * np.linalg.norm(normal)
        q = rng.normal(0, 30 * scale, 3) + 500 * normal / np.linalg.norm(normal)
        shape = np.array([np.zeros(3), normal / np.linalg.norm(normal), u, v], np.float32)
        n = 1500
        i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
        # Centroids of the n^2 equal triangles of both orientations.
        up = i + j < n
        down = i + j < n - 1
        a = np.concatenate([i[up] + 1 / 3, i[down] + 2 / 3]) / n
        b = np.concatenate([j[up] + 1 / 3, j[down] + 2 / 3]) / n
        u32, v32 = shape[2].astype(np.float64), shape[3].astype(np.float64)
        phase = (a - 1 / 3) * (q @ u32) + (b - 1 / 3) * (q @ v32)
        expected = area * np.mean(np.exp(1j * phase))
        assert abs(triangle_integral(*q, shape) - expected) < 1e-4 * area


@pytest.mark.parametrize("tilt_deg", [0.0, 0.2, 0.5, 1.5, 2.0, 2.5, 3.0])
def test_far_plate_and_its_tilt(tilt_deg: float) -> None:
    side_m = 0.1
    section = CrossSection(pure(plate(side_m), 50.0), EVERYTHING, hidden=False)
    tilt = np.radians(tilt_deg)
    lobe = np.sinc(2.0 * side_m * np.sin(tilt) / WAVELENGTH_M) * np.cos(tilt)
    expected = 4.0 * np.pi * side_m**4 / WAVELENGTH_M**2 * lobe**2
    assert section.dbsm(eye(50.0, tilt_deg), np.zeros(3)) == pytest.approx(decibel(expected), abs=0.1)


PLACES = ((0.0, 0.0), (0.11, 0.05), (0.21, 0.13), (0.05, 0.3))
"""Of the radar in front of a plate, off its middle."""


def aperture_dbsm(side_m: float, distance_m: float, y_m: float, z_m: float) -> float:
    """Physical optics of a square plate by a dense sum, referred to the radar's foot on the plate."""
    n = 750
    s = (np.arange(n) + 0.5) / n * side_m - side_m / 2
    range_m = np.sqrt(distance_m**2 + (s[:, None] - y_m) ** 2 + (s - z_m) ** 2)
    field = distance_m / range_m * np.exp(4j * np.pi / WAVELENGTH_M * range_m) * (distance_m / range_m) ** 2
    return decibel(4 * np.pi / WAVELENGTH_M**2 * abs(field.sum() * (side_m / n) ** 2) ** 2)


@pytest.mark.parametrize("distance_m", [3.0, 5.0, 10.0])
@pytest.mark.parametrize(("patch_share", "error_db"), [(0.15, 0.15), (0.3, 0.9)])
def test_near_plate(distance_m: float, patch_share: float, error_db: float) -> None:
    side_m = 1.5
    section = CrossSection(pure(plate(side_m), distance_m, patch_share=patch_share), EVERYTHING, hidden=False)
    for y, z in PLACES:
        found = section.dbsm(np.array([distance_m, y, z]), np.array([0.0, y, z]))
        assert found == pytest.approx(aperture_dbsm(side_m, distance_m, y, z), abs=error_db)


@pytest.mark.parametrize(("distance_m", "mirror_dbsm"), [(3.0, 14.5), (5.0, 19.0), (10.0, 25.0)])
def test_near_plate_is_a_mirror_with_the_defaults(distance_m: float, mirror_dbsm: float) -> None:
    """pi R^2, about which the rim's waves make the level ripple."""
    section = CrossSection(pure(plate(1.5), distance_m), hidden=False)
    levels = [section.dbsm(np.array([distance_m, y, z]), np.array([0.0, y, z])) for y, z in PLACES]
    assert np.mean(levels) == pytest.approx(mirror_dbsm, abs=0.6)
    assert abs(np.array(levels) - mirror_dbsm).max() < 1.7


def sphere_levels(radius_m: float, rings: int, patch_m: float, distance_m: float = 20.0) -> Float64:
    """Cross-sections over those of a sphere from several sides, dB; the wavefront's curvature is allowed for."""
    surface = pure(hemisphere(radius_m, rings), patch_m**2 / WAVELENGTH_M, patch_share=1.0)
    section, rng, levels = CrossSection(surface, EVERYTHING, hidden=False), np.random.default_rng(1), []
    nearest_m = distance_m - radius_m
    expected = np.pi * radius_m**2 * (nearest_m / (nearest_m + radius_m / 2)) ** 2
    for _ in range(6):
        towards = np.array([1.0, *rng.uniform(-0.3, 0.3, 2)])
        towards /= np.linalg.norm(towards)
        levels.append(section.dbsm(distance_m * towards, radius_m * towards) - decibel(expected))
    return np.array(levels)


@pytest.mark.parametrize("radius_m", [0.25, 0.5, 1.0])
def test_sphere_with_fine_patches(radius_m: float) -> None:
    # 120 rings: facets of 3, 7 and 13 mm, with patches of 3 mm on the two small spheres.
    assert abs(sphere_levels(radius_m, 120, 0.003 if radius_m < 1.0 else 0.008)).max() < 0.6


@pytest.mark.parametrize("radius_m", [0.25, 0.5, 1.0])
def test_sphere_of_coarse_facets_made_round(radius_m: float) -> None:
    """Facets of 7.5 degrees, up to 13 cm: Phong tessellation with share 1/2 restores the curvature."""
    assert abs(sphere_levels(radius_m, 12, 0.01)).max() < 1.5


def test_sphere_with_patches_of_three_centimetres_is_right_in_the_mean_only() -> None:
    """Patches larger than the Fresnel zone of a sphere of 0.5 m: docs/simulation.md, limits."""
    levels = np.concatenate([sphere_levels(0.5, rings, 0.03) for rings in (12, 17, 24)])
    assert abs(levels).max() < 6.0
    assert decibel(np.mean(10 ** (levels / 10))) == pytest.approx(0.0, abs=3.0)


def test_trihedral_as_a_point() -> None:
    side_m = 0.1
    sigma_m2 = 4.0 * np.pi * side_m**4 / (3.0 * WAVELENGTH_M**2)
    section = CrossSection(point_surface((0.0, 0.0, 0.5), sigma_m2), EVERYTHING, hidden=False)
    where = np.array([5.0, 0.3, 0.8])
    assert section.dbsm(where, np.array([0.0, 0.0, 0.5])) == pytest.approx(14.6, abs=0.05)


def test_amplitude_of_a_patch_changes_smoothly() -> None:
    """No twinkling: a millimetre of motion moves no patch's amplitude by more than its lobe allows."""
    section = CrossSection(pure(hemisphere(0.5, 12), 4.0), EVERYTHING, hidden=False)
    before: dict[bytes, complex] = {}
    for step in range(40):
        entries = section.entries(np.array([4.0, 1e-3 * step, 0.7]))
        now = {p.tobytes(): complex(w) for p, w in zip(entries.position, entries.weight, strict=True)}
        strongest = max(abs(w) for w in now.values())
        for patch, weight in before.items():
            assert abs(abs(now.get(patch, 0.0)) - abs(weight)) < 0.05 * strongest
        before = now
