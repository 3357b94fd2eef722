# SPDX-License-Identifier: Apache-2.0
"""Scattering amplitudes of whole objects for one place of the radar, and which of them are kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.frames import Complex64, Float32, Float64
from train.objects.sampling import Int32
from train.simulate.ground import ground_reflection
from train.simulate.kernels_optics import (
    CURVED_FROM,
    DIRECT,
    GROUND,
    LOBE,
    MIXED,
    MOST_EXPONENT,
    UInt8,
    lobe_candidates,
    patch_weights,
    point_weights,
)
from train.simulate.optics_settings import OpticsSettings
from train.simulate.points import Patches
from train.simulate.surface import Surface
from train.simulate.visibility import Sight


@dataclass(frozen=True, slots=True)
class Entries:
    """Scattering amplitudes that are kept until the radar has moved on; columns of one length.

    Args:
        position: float32 [k, 3], frame of the object.
        weight: complex64 [k], sqrt(sigma) exp(j phase), m.
        board: float32 [2, k], amplitude factors of the boards in the order of RADARS.
        path: uint8 [k], DIRECT, MIXED or GROUND.
        owner: int32 [k], number of the object.
        level: float32 [k], |weight| / (R_t R_r) with the ground's reflection, 1/m.
    """

    position: Float32
    weight: Complex64
    board: Float32
    path: UInt8
    owner: Int32
    level: Float32

    def __len__(self) -> int:
        return len(self.path)


def join(parts: Sequence[Entries]) -> Entries:
    """All of them one after the other."""
    every = [_EMPTY, *parts]
    return Entries(
        np.concatenate([one.position for one in every]),
        np.concatenate([one.weight for one in every]),
        np.concatenate([one.board for one in every], axis=1),
        np.concatenate([one.path for one in every]),
        np.concatenate([one.owner for one in every]),
        np.concatenate([one.level for one in every]),
    )


_EMPTY = Entries(
    np.empty((0, 3), np.float32),
    np.empty(0, np.complex64),
    np.empty((2, 0), np.float32),
    np.empty(0, np.uint8),
    np.empty(0, np.int32),
    np.empty(0, np.float32),
)


def strongest(entries: Entries, most: int, least: float) -> Entries:
    """Entries above a level, and of those the strongest that make at most ``most`` scatterers (MIXED ones make two).

    Args:
        entries: of all objects.
        most: scatterers.
        least: level, 1/m.
    """
    kept = np.flatnonzero(entries.level >= least)
    cost = 1 + (entries.path[kept] == MIXED)
    if int(cost.sum()) > most:
        order = np.argsort(-entries.level[kept], kind="stable")
        kept = np.sort(kept[order[np.cumsum(cost[order]) <= most]])
    return Entries(
        entries.position[kept],
        entries.weight[kept],
        np.ascontiguousarray(entries.board[:, kept]),
        entries.path[kept],
        entries.owner[kept],
        entries.level[kept],
    )


NEVER = np.float32(1e6)
"""Least cosine of patches so rough that nothing of them is coherent."""


class Weigher:
    """Amplitudes of patches and points; owns the buffers.

    Args:
        surfaces: the objects.
        settings: limits and ground.
        wavelength_m: of the radar.
    """

    def __init__(self, surfaces: Sequence[Surface], settings: OpticsSettings, wavelength_m: float) -> None:
        self._surfaces, self._settings, self._wavelength_m = tuple(surfaces), settings, wavelength_m
        self._paths = (DIRECT, MIXED, GROUND) if settings.ground.enabled else (DIRECT,)
        most = max([len(one.patches) + len(one.points) for one in surfaces], default=0)
        self._index, self._level = np.empty(most, np.int32), np.empty(most, np.float32)
        self._bound = np.empty(most, np.float32)
        self._weight, self._mark = np.empty(most, np.complex64), np.empty(most, np.uint8)
        most_sine = float(np.sin(np.radians(settings.lobe_most_deg)))
        self._limits = np.array([settings.lobe_end**2, most_sine**2])
        self._facing = [self._make_facing(one.patches) for one in surfaces]

    def _make_facing(self, patches: Patches) -> Float32:
        """Centre, normal and least cosine of every patch's lobe, float32 [7, p]."""
        lobe = LOBE * self._wavelength_m**2 / patches.area
        curved_cosine = 1.0 / np.sqrt(1.0 + 4.0 * MOST_EXPONENT * (lobe + patches.spread))
        sine = self._settings.lobe_end * self._wavelength_m / (4.0 * np.pi * np.sqrt(patches.area))
        flat_cosine = np.sqrt(np.maximum(1.0 - sine * sine, 0.0))
        facing = np.empty((7, len(patches)), np.float32)
        facing[:3], facing[3:6] = patches.shape[:, 0].T, patches.shape[:, 1].T
        least = np.where(patches.spread > CURVED_FROM * lobe, curved_cosine, flat_cosine)
        facing[6] = np.maximum(least, np.cos(np.radians(self._settings.lobe_most_deg)))
        facing[6, patches.roughness * np.square(facing[6]) > MOST_EXPONENT] = NEVER
        return facing

    def candidates(self, number: int, eye_m: Float64, step_m: float) -> Int32:
        """Patches of an object whose lobes may reach a radar less than ``step_m`` away from ``eye_m`` [4]."""
        surface = self._surfaces[number]
        near = np.clip(eye_m[:2], surface.low_m[:2], surface.high_m[:2])
        slack_rad = min(1.5 * step_m / max(float(np.hypot(*(near - eye_m[:2]))), step_m), 1.5)
        facing = self._facing[number]
        count = lobe_candidates(facing, eye_m, slack_rad, self._mark[: facing.shape[1]], self._index)
        return self._index[:count].copy()

    def weigh(self, number: int, eye_m: Float64, sight: Sight) -> Entries:
        """Entries of one object within ``keep_db`` of its strongest.

        Args:
            number: of the object.
            eye_m: float64 [4], the radar in the object's frame and the z of its image.
            sight: what is seen of it.
        """
        surface, keep = self._surfaces[number], 10 ** (-self._settings.keep_db / 10)
        p, q = surface.patches, surface.points
        found: list[Entries] = []
        out = (self._index, self._weight, self._level)
        for path in self._paths:
            mirror = self._mirror(eye_m, 0.5 * (surface.low_m + surface.high_m)) ** path
            count = patch_weights(
                sight.candidates,
                (p.shape, p.area, p.spread, p.reflection, p.roughness),
                sight.patches,
                eye_m,
                path,
                self._wavelength_m,
                self._limits,
                keep,
                self._bound,
                *out,
            )
            found.append(self._entries(number, path, mirror, count, p.shape[:, 0], p.board))
            count = point_weights(
                *(q.position, q.axis, q.kind, q.amplitude, q.length, sight.points, eye_m, path, self._wavelength_m),
                *out,
            )
            found.append(self._entries(number, path, mirror, count, q.position, q.board))
        every = join(found)
        least = float(np.sqrt(keep)) * float(every.level.max(initial=0.0))
        return strongest(every, 2 * len(every), least)

    def _entries(self, number: int, path: int, mirror: float, count: int, place: Float32, board: Float32) -> Entries:
        index, full = self._index[:count], np.full
        return Entries(
            place[index],
            self._weight[:count].copy(),
            np.ascontiguousarray(board[index].T),
            full(count, path, np.uint8),
            full(count, number, np.int32),
            self._level[:count] * np.float32(mirror),
        )

    def _mirror(self, eye_m: Float64, middle_m: Float64) -> float:
        """Greatest |reflection| of the ground on the way to an object."""
        flat_m = float(np.hypot(*(eye_m[:2] - middle_m[:2])))
        rise_m = float(middle_m[2] - eye_m[3])
        ground = self._settings.ground
        sine = rise_m / max(float(np.hypot(flat_m, rise_m)), 1e-9)
        return abs(ground_reflection(sine, ground.permittivity, "H", ground.roughness_m, self._wavelength_m))
