# SPDX-License-Identifier: Apache-2.0
"""What of several objects is seen from the radar and from its image below the ground: one fitted z-buffer an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.frames import Float32, Float64
from train.depth_scan import look_at
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
    def image_m(self) -> Float64:
        """The radar's image as ``eye_m``."""
        return np.array([self.eye_m[0], self.eye_m[1], self.image_z_m])

    @property
    def in_object_m(self) -> Float64:
        """The radar in the object's frame and the z of its image, float64 [4]; objects stand upright."""
        return np.append(self.rotation.T @ self.eye_m, self.image_z_m)


@dataclass(frozen=True, slots=True)
class Sight:
    """What is seen of one object.

    Args:
        candidates: int32 [c], numbers of the patches that were looked at and are seen.
        patches: uint8 [c], bits SEEN and SEEN_IN_GROUND of those.
        points: uint8 [m], the same of all its points.
        clutter: uint8 [g], SEEN where it does not hide a ground point.
    """

    candidates: Int32
    patches: UInt8
    points: UInt8
    clutter: UInt8


class SceneVisibility:
    """Visibility of patches, points and ground points; owns the picture.

    Args:
        surfaces: the objects.
        columns, rows: of one picture; it is fitted to its object.
    """

    def __init__(self, surfaces: Sequence[Surface], columns: int, rows: int) -> None:
        self._surfaces = tuple(surfaces)
        self._camera = [np.empty_like(surface.vertices) for surface in surfaces]
        self._inverse = np.empty((rows, columns), np.float32)

    def hiders(self, number: int, views: Sequence[View]) -> list[int]:
        """Numbers of the other objects that may hide part of object ``number``, by their boxes on the ground plan."""
        own = self._corners(number, views[number])
        others = [other for other in range(len(views)) if other != number]
        return [other for other in others if kernels.may_hide(self._corners(other, views[other]), own)]

    def _corners(self, number: int, view: View) -> Float64:
        """Corners of an object's box on the ground plan relative to the eye, world axes, float64 [4, 2]."""
        low, high = self._surfaces[number].low_m, self._surfaces[number].high_m
        box = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
        return np.ascontiguousarray(box @ view.rotation[:2, :2].T - view.eye_m[:2])

    def look(
        self,
        number: int,
        views: Sequence[View],
        hiders: Sequence[int],
        ground: bool,
        candidates: Int32,
        clutter_m: Float32,
    ) -> Sight:
        """Visibility of one object.

        Args:
            number: of the object.
            views: of all objects, in their order.
            hiders: numbers of those that may hide it.
            ground: also from the image below the ground.
            candidates: int32 [c], numbers of the patches that are looked at.
            clutter_m: float32 [g, 3], ground points in world axes from the radar.
        """
        surface = self._surfaces[number]
        patches, points = np.zeros(len(candidates), np.uint8), np.zeros(len(surface.points), np.uint8)
        clutter = np.full(len(clutter_m), SEEN, np.uint8)
        for bit in (SEEN, SEEN_IN_GROUND) if ground else (SEEN,):
            patches |= np.uint8(bit)
            points |= np.uint8(bit)
            picture = self._picture(number, views, hiders, bit)
            if picture is None:
                continue
            axes, turned, eye, pinhole = picture
            for place, index, bias_m, seen in (
                (surface.patches.flat, candidates, PATCH_BIAS_M, patches),
                (surface.points.position, np.arange(len(points), dtype=np.int32), POINT_BIAS_M, points),
            ):
                kernels.test_points(place, index, turned, eye, *pinhole, self._inverse, bias_m, bit, seen)
            if bit == SEEN:
                every, origin = np.arange(len(clutter_m), dtype=np.int32), np.zeros(3)
                kernels.test_points(
                    clutter_m, every, axes, origin, *pinhole, self._inverse, CLUTTER_BIAS_M, bit, clutter
                )
        kept = patches > 0
        return Sight(candidates[kept], patches[kept], points, clutter)

    def _picture(
        self, number: int, views: Sequence[View], hiders: Sequence[int], bit: int
    ) -> tuple[Float64, Float64, Float64, tuple[float, float, float]] | None:
        """Draw one object and all that hides it; camera axes in the world and in its frame, eye there, pinhole."""
        surface, mirrored = self._surfaces[number], bit == SEEN_IN_GROUND
        eyes = {n: views[n].image_m if mirrored else views[n].eye_m for n in (number, *hiders)}
        middle = views[number].rotation @ (0.5 * (surface.low_m + surface.high_m)) - eyes[number]
        if np.linalg.norm(middle[:2]) < 1e-6:
            return None
        axes = look_at(np.zeros(3), middle)
        window = np.array([np.inf, np.inf, -np.inf, -np.inf])
        turned, eye = self._project(number, views[number].rotation, eyes[number], axes, window)
        if not window[0] < window[2] or not window[1] < window[3]:
            return None
        rows, columns = self._inverse.shape
        focal = float(min((columns - 3) / (window[2] - window[0]), (rows - 3) / (window[3] - window[1])))
        column = float(0.5 * (columns - 1) - 0.5 * focal * (window[0] + window[2]))
        row = float(0.5 * (rows - 1) - 0.5 * focal * (window[1] + window[3]))
        self._inverse[:] = 0.0
        kernels.rasterize(self._camera[number], surface.faces, focal, column, row, self._inverse)
        for other in hiders:
            ways = [(eyes[other], axes)]
            if mirrored:
                # On its way down to the ground the wave meets other objects; in the image's space, their images. What
                # an object's own image hides of it is next to nothing.
                ways.append((views[other].eye_m, axes * (1.0, 1.0, -1.0)))
            for eye_m, camera_axes in ways:
                self._project(other, views[other].rotation, eye_m, camera_axes, np.zeros(4))
                kernels.rasterize(self._camera[other], self._surfaces[other].faces, focal, column, row, self._inverse)
        return axes, turned, eye, (focal, column, row)

    def _project(
        self, number: int, rotation: Float64, eye_m: Float64, axes: Float64, window: Float64
    ) -> tuple[Float64, Float64]:
        """Camera axes and place in the object's frame; its vertices go to its buffer."""
        turned, eye = np.ascontiguousarray(axes @ rotation), rotation.T @ eye_m
        kernels.to_camera(self._surfaces[number].vertices, turned, eye, self._camera[number], window)
        return turned, eye
