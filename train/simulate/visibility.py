# SPDX-License-Identifier: Apache-2.0
"""What of several objects is seen from the radar and from its image below the ground: one fitted z-buffer an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.frames import Float32, Float64
from train.objects.sampling import Int32
from train.simulate import kernels_visibility as kernels
from train.simulate.kernels_optics import SEEN, SEEN_IN_GROUND
from train.simulate.kernels_visibility import UInt8
from train.simulate.surface import Surface

PATCH_BIAS_M = 0.01
POINT_BIAS_M = 0.03
"""Points may lie this much deeper than what the picture shows; edges and wheels stand on corners, hence more."""
CLUTTER_BIAS_M = 0.05


@dataclass(frozen=True, slots=True)
class View:
    """Where an object is, as seen from the radar.

    Args:
        eye_m: float64 [3], the radar in world axes from the origin of the object's frame.
        image_z_m: z of its image below the ground, as ``eye_m``.
        rotation: float64 [3, 3], object frame to world.
    """

    eye_m: Float64
    image_z_m: float
    rotation: Float64

    @property
    def in_object_m(self) -> Float64:
        """The radar in the object's frame and the z of its image, float64 [4]; objects stand upright."""
        return np.append(self.rotation.T @ self.eye_m, self.image_z_m)


class SceneVisibility:
    """Visibility of every patch, point and ground point; owns the pictures.

    Args:
        surfaces: the objects.
        columns, rows: of one picture; it is fitted to its object.
    """

    def __init__(self, surfaces: Sequence[Surface], columns: int, rows: int) -> None:
        self._surfaces = tuple(surfaces)
        self._camera = [np.empty_like(surface.vertices) for surface in surfaces]
        self._inverse = np.empty((rows, columns), np.float32)
        self._every_point = [np.arange(len(surface.points), dtype=np.int32) for surface in surfaces]
        self.candidates: list[Int32] = [np.empty(0, np.int32) for _ in surfaces]
        """Patches of every object that were looked at."""
        self.patches: list[UInt8] = [np.empty(0, np.uint8) for _ in surfaces]
        """Bits SEEN and SEEN_IN_GROUND of those."""
        self.points: list[UInt8] = [np.empty(len(surface.points), np.uint8) for surface in surfaces]
        """The same of all points."""

    def update(
        self,
        views: Sequence[View],
        ground: bool,
        candidates: list[Int32],
        clutter_m: Float32,
        clutter_seen: UInt8,
    ) -> None:
        """Visibility from one place.

        Args:
            views: of the objects, in their order.
            ground: also from the image below the ground.
            candidates: numbers of the patches of every object that are looked at.
            clutter_m: float32 [c, 3], ground points in world axes from the radar.
            clutter_seen: uint8 [c], out: SEEN or 0.
        """
        clutter_seen[:] = SEEN
        self.candidates = candidates
        self.patches = [np.zeros(len(index), np.uint8) for index in candidates]
        for seen in self.points:
            seen[:] = 0
        for mirrored in (False, True) if ground else (False,):
            bit = SEEN_IN_GROUND if mirrored else SEEN
            eyes = [np.append(view.eye_m[:2], view.image_z_m) if mirrored else view.eye_m for view in views]
            for number in range(len(views)):
                if mirrored:
                    self._one(number, views, eyes, bit, clutter_m[:0], clutter_seen[:0])
                else:
                    self._one(number, views, eyes, bit, clutter_m, clutter_seen)

    def _one(
        self,
        number: int,
        views: Sequence[View],
        eyes: Sequence[Float64],
        bit: int,
        clutter_m: Float32,
        clutter_seen: UInt8,
    ) -> None:
        """Picture of one object with all that hides it, and what it shows."""
        surface = self._surfaces[number]
        self.patches[number] |= np.uint8(bit)
        self.points[number] |= np.uint8(bit)
        middle = views[number].rotation @ (0.5 * (surface.low_m + surface.high_m)) - eyes[number]
        if np.linalg.norm(middle[:2]) < 1e-6:
            return
        axes = _look(middle)
        window = np.array([np.inf, np.inf, -np.inf, -np.inf])
        turned, eye = self._project(number, views[number].rotation, eyes[number], axes, window)
        if not window[0] < window[2] or not window[1] < window[3]:
            return
        rows, columns = self._inverse.shape
        focal = float(min((columns - 3) / (window[2] - window[0]), (rows - 3) / (window[3] - window[1])))
        column = 0.5 * (columns - 1) - 0.5 * focal * (window[0] + window[2])
        row = 0.5 * (rows - 1) - 0.5 * focal * (window[1] + window[3])
        self._inverse[:] = 0.0
        kernels.rasterize(self._camera[number], surface.faces, focal, column, row, self._inverse)
        for other in range(len(views)):
            if other == number or not self._may_hide(other, number, views, eyes, middle):
                continue
            ways = [(eyes[other], axes)]
            if bit == SEEN_IN_GROUND:
                # On its way down to the ground the wave meets other objects; in the image's space, their images. What
                # an object's own image hides of it is next to nothing.
                ways.append((views[other].eye_m, axes * (1.0, 1.0, -1.0)))
            for eye_m, mirrored in ways:
                self._project(other, views[other].rotation, eye_m, mirrored, np.zeros(4))
                kernels.rasterize(self._camera[other], self._surfaces[other].faces, focal, column, row, self._inverse)
        picture = (focal, column, row, self._inverse)
        for points, index, bias_m, seen in (
            (surface.patches.flat, self.candidates[number], PATCH_BIAS_M, self.patches[number]),
            (surface.points.position, self._every_point[number], POINT_BIAS_M, self.points[number]),
        ):
            kernels.test_points(points, index, turned, eye, *picture, bias_m, bit, seen)
        every = np.arange(len(clutter_m), dtype=np.int32)
        kernels.test_points(clutter_m, every, axes, np.zeros(3), *picture, CLUTTER_BIAS_M, bit, clutter_seen)

    def _project(
        self, number: int, rotation: Float64, eye_m: Float64, axes: Float64, window: Float64
    ) -> tuple[Float64, Float64]:
        """Camera axes and place in the object's frame; its vertices go to its buffer."""
        turned, eye = np.ascontiguousarray(axes @ rotation), rotation.T @ eye_m
        kernels.to_camera(self._surfaces[number].vertices, turned, eye, self._camera[number], window)
        return turned, eye

    def _may_hide(
        self, other: int, number: int, views: Sequence[View], eyes: Sequence[Float64], middle: Float64
    ) -> bool:
        """Whether the spheres around two objects overlap as seen from the eye, and the other one is not behind."""
        radius, distance = self._radius(number), float(np.linalg.norm(middle))
        surface = self._surfaces[other]
        towards = views[other].rotation @ (0.5 * (surface.low_m + surface.high_m)) - eyes[other]
        other_radius, other_distance = self._radius(other), float(np.linalg.norm(towards))
        if other_distance - other_radius > distance + radius:
            return False
        if distance <= radius or other_distance <= other_radius:
            return True
        between = np.arccos(np.clip(middle @ towards / (distance * other_distance), -1.0, 1.0))
        return bool(between < np.arcsin(radius / distance) + np.arcsin(other_radius / other_distance))

    def _radius(self, number: int) -> float:
        surface = self._surfaces[number]
        return 0.5 * float(np.linalg.norm(surface.high_m - surface.low_m))


def _look(towards: Float64) -> Float64:
    """Rows right, down and forward of a camera that looks along ``towards`` [3], which is not vertical."""
    forward = towards / np.linalg.norm(towards)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])
