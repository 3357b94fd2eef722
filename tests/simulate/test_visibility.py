# SPDX-License-Identifier: Apache-2.0
"""The z-buffer against rays cast through every triangle; objects hide one another; the image below the ground."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from edge.frames import Float32, Float64
from tests.simulate.plain_surfaces import pure
from train.objects.mesh import Mesh
from train.objects.primitives import box, capsule, join, torus
from train.objects.sampling import Int32
from train.simulate.kernels_optics import SEEN, SEEN_IN_GROUND
from train.simulate.kernels_visibility import UInt8, may_hide
from train.simulate.visibility import SceneVisibility, View

Bool = NDArray[np.bool_]


def seen_by_rays(points: Float64, eye_m: Float64, vertices: Float32, faces: Int32, slack_m: float) -> Bool:
    """Whether no triangle cuts the way from the eye to a point, but for its last ``slack_m`` (Moeller and Trumbore)."""
    corner = vertices[faces].astype(np.float64)
    a, u, v = corner[:, 0], corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    free = np.ones(len(points), np.bool_)
    for i, point in enumerate(points):
        length = np.linalg.norm(point - eye_m)
        ray = (point - eye_m) / length
        p = np.cross(ray, v)
        determinant = np.einsum("ij,ij->i", u, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            to_eye = eye_m - a
            s = np.einsum("ij,ij->i", to_eye, p) / determinant
            q = np.cross(to_eye, u)
            t = (q @ ray) / determinant
            distance = np.einsum("ij,ij->i", v, q) / determinant
            cut = (s >= 0) & (t >= 0) & (s + t <= 1) & (distance > 0) & (distance < length - slack_m)
        free[i] = not bool(cut[np.abs(determinant) > 1e-14].any())
    return free


def whole_sight(visibility: SceneVisibility, number: int, views: list[View], patches: int) -> UInt8:
    """Bits of all patches of one object."""
    every, bits = np.arange(patches, dtype=np.int32), np.zeros(patches, np.uint8)
    hiders = visibility.hiders(number, views)
    sight = visibility.look(number, views, hiders, True, every, np.empty((0, 3), np.float32))
    bits[sight.candidates] = sight.patches
    return bits


def cart() -> Mesh:
    """A box on wheels with a mast and a rail: things that hide one another."""
    wheels = [torus((x, y, 0.3), 0.25, 0.05, 24, 6) for x in (-0.6, 0.6) for y in (-0.45, 0.45)]
    mast = capsule((0.3, 0, 0.9), (0.3, 0, 1.7), 0.06, 0.04)
    rail = capsule((-0.8, 0.6, 0.8), (0.8, 0.6, 0.8), 0.03, 0.03)
    vertices, faces = join([box((0, 0, 0.65), (1.8, 0.8, 0.5)), *wheels, mast, rail])
    return Mesh(vertices, faces, 0, "test/cart")


def turn(yaw_rad: float) -> Float64:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("yaw_rad", [0.3, 1.2, 2.6])
def test_agrees_with_ray_casting(yaw_rad: float) -> None:
    """Patches of an object, part of it behind another one, from the radar and from its image."""
    surface = pure(cart(), 4.0, phong=0.0)
    places = [np.array([0.0, 4.0, 0.0]), np.array([-0.7, 2.0, 0.0])]
    yaws = [yaw_rad, 0.8]
    eye_m = np.array([0.1, 0.0, 0.8])
    views = [View(eye_m - p, -0.8, turn(y)) for p, y in zip(places, yaws, strict=True)]
    visibility = SceneVisibility([surface, surface], 320, 240)
    every = np.arange(len(surface.patches), dtype=np.int32)
    bits = whole_sight(visibility, 0, views, len(every))
    # Both objects in the frame of the first one.
    across = turn(-yaws[0]) @ turn(yaws[1])
    other = surface.vertices.astype(np.float64) @ across.T + turn(-yaws[0]) @ (places[1] - places[0])
    vertices = np.concatenate([surface.vertices, other.astype(np.float32)])
    faces = np.concatenate([surface.faces, surface.faces + len(other)]).astype(np.int32)
    chosen = np.random.default_rng(5).choice(len(every), 500, replace=False)
    for bit, height_m in ((SEEN, 0.8), (SEEN_IN_GROUND, -0.8)):
        eye = turn(-yaws[0]) @ (np.array([eye_m[0], eye_m[1], height_m]) - places[0])
        points = surface.patches.flat[chosen].astype(np.float64)
        expected = seen_by_rays(points, eye, vertices, faces, 0.005)
        if bit == SEEN_IN_GROUND:
            # The way down to the ground meets the objects' images where the image's space is below it.
            expected &= seen_by_rays(points, eye, vertices * np.float32([1, 1, -1]), faces, 0.005)
        found = bits[chosen] & bit > 0
        assert 0.05 < expected.mean() < 0.6
        assert (found == expected).mean() >= 0.97


def test_wall_hides_what_is_behind_it_and_nothing_beside() -> None:
    wall = pure(Mesh(*join([box((0, 0, 1), (3.0, 0.1, 2.0))]), 0, "test/wall"), 4.0)
    target = pure(Mesh(*join([box((0, 0, 0.5), (0.4, 0.4, 1.0))]), 0, "test/box"), 4.0)
    visibility = SceneVisibility([wall, target, target], 160, 120)
    eye_m = np.array([0.0, 0.0, 0.8])
    places = [(0.0, 3.0, 0.0), (0.0, 5.0, 0.0), (4.5, 5.0, 0.0)]
    views = [View(eye_m - p, -0.8, np.eye(3)) for p in places]
    clutter = np.array([[0.0, 5.0, -0.8], [0.0, 2.0, -0.8], [3.0, 5.0, -0.8]], np.float32)
    assert [visibility.hiders(n, views) for n in (1, 2)] == [[0], []]
    wall_bits, behind_bits, beside_bits = (
        whole_sight(visibility, n, views, len(s.patches)) for n, s in enumerate((wall, target, target))
    )
    assert wall_bits.any()
    assert not behind_bits.any()
    assert beside_bits.any()
    sight = visibility.look(0, views, [], False, np.empty(0, np.int32), clutter)
    assert sight.clutter.tolist() == [0, SEEN, SEEN]


def test_triangles_that_reach_behind_the_camera_do_no_harm() -> None:
    """The radar drives beside a long wall; its far end is seen, what stands behind it is not."""
    wall = pure(Mesh(*join([box((0, 0, 1), (40.0, 0.1, 2.0))]), 0, "test/wall"), 2.0, patch_share=1.0)
    target = pure(Mesh(*join([box((0, 0, 0.5), (0.4, 0.4, 1.0))]), 0, "test/box"), 4.0)
    visibility = SceneVisibility([wall, target], 320, 160)
    views = [View(np.array([0.0, -2.0, 0.8]), -0.8, np.eye(3)), View(np.array([-3.0, -6.0, 0.8]), -0.8, np.eye(3))]
    front = wall.patches.flat[:, 1] < -0.04
    assert (whole_sight(visibility, 0, views, len(front))[front] & SEEN > 0).mean() > 0.99
    assert not whole_sight(visibility, 1, views, len(target.patches)).any()


def test_only_what_stands_between_may_hide() -> None:
    def square(x: float, y: float, half: float, yaw_rad: float = 0.0) -> Float64:
        corner = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
        return corner @ turn(yaw_rad)[:2, :2].T + (x, y)

    target = square(0.0, 6.0, 1.5, 0.3)
    assert may_hide(square(0.5, 3.0, 0.4), target)
    assert may_hide(square(1.2, 4.5, 0.4, 0.7), target)
    assert not may_hide(square(0.0, 9.0, 0.4), target)  # behind
    assert not may_hide(square(4.0, 4.0, 0.4), target)  # beside
    assert not may_hide(square(0.0, -4.0, 0.4), target)  # at the radar's back
    rng = np.random.default_rng(2)
    for _ in range(300):
        boxes = [square(*rng.uniform(-6, 6, 2), rng.uniform(0.2, 1.5), rng.uniform(0, 6)) for _ in range(2)]
        blocked = any(crosses(boxes[0], point) for point in interior(boxes[1], rng))
        assert may_hide(*boxes) or not blocked


def interior(corners: Float64, rng: np.random.Generator) -> Float64:
    """Random points of a rectangle, float64 [40, 2]."""
    a, b = rng.random((2, 40, 1))
    return np.asarray(corners[0] + a * (corners[1] - corners[0]) + b * (corners[3] - corners[0]))


def crosses(corners: Float64, point: Float64) -> bool:
    """Whether the way from the eye at the origin to a point meets a rectangle."""
    t = np.linspace(0.0, 1.0, 200)[:, None] * point - corners[0]
    u, v = corners[1] - corners[0], corners[3] - corners[0]
    a, b = t @ u / (u @ u), t @ v / (v @ v)
    return bool(((a > 0) & (a < 1) & (b > 0) & (b < 1)).any())
