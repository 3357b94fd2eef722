# SPDX-License-Identifier: Apache-2.0
"""Placed objects and a moving radar to the point scatterers of one burst: sight, physical optics, ground, pattern."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from edge.config import AntennaSettings, require
from edge.frames import RADARS, Float64, RadarId
from train.simulate.clutter import GroundClutter
from train.simulate.ground import GroundSettings as GroundSettings
from train.simulate.kernels_emission import emit
from train.simulate.kernels_optics import DIRECT, MIXED, SEEN
from train.simulate.link_budget import LinkSettings, amplitude_per_rcs
from train.simulate.optics_settings import OpticsSettings as OpticsSettings
from train.simulate.scatterers import GroundPlane, Scatterers
from train.simulate.surface import Placed as Placed
from train.simulate.visibility import SceneVisibility, Sight, View
from train.simulate.weights import Entries, Weigher, join, strongest

REACH_MARGIN_M = 0.3
"""Between the longest half path from the board's phase centre and that from any antenna during the burst."""
CLUTTER_IMBALANCE_DB = 2.0
MOVER_STEPS = 3
"""A moving object hides others as from the nearest point of a grid this many times as wide as its own."""
_BLIND = Sight(np.empty(0, np.int32), np.empty(0, np.uint8), np.empty(0, np.uint8), np.empty(0, np.uint8))


class SceneOptics:
    """Scatterers of a scene for both radars of a rig, a function of its place and time only.

    Amplitudes are those for the rig's origin on a grid of ``weight_step_m``, so that any burst can be made again alone;
    both radars share them.

    Args:
        placed: objects; z of the ground is 0.
        settings, link, antenna: of the scene, the amplitude and the element pattern.
        wavelength_m: at the middle of the chirp.
        noise_lsb: of one complex sample.
        rng: of the clutter.
    """

    def __init__(
        self,
        placed: Sequence[Placed],
        settings: OpticsSettings,
        link: LinkSettings,
        antenna: AntennaSettings,
        wavelength_m: float,
        noise_lsb: float,
        rng: np.random.Generator,
    ) -> None:
        self._placed = tuple(placed)
        self._settings, self._antenna, self._wavelength_m = settings, antenna, wavelength_m
        self._lsb_per_m = amplitude_per_rcs(link, wavelength_m, noise_lsb)
        self._least_lsb = noise_lsb * 10 ** (settings.floor_db / 20)
        self._clutter = GroundClutter(settings.ground, CLUTTER_IMBALANCE_DB, rng)
        surfaces = [one.surface for one in self._placed]
        self._visibility = SceneVisibility(surfaces, *settings.picture)
        self._weigher = Weigher(surfaces, settings, wavelength_m)
        self._looked_from, self._clutter_from = b"", b""
        self._seen_from = [b""] * len(surfaces)
        self._weighed_from = [b""] * len(surfaces)
        self._sights: list[Sight] = [_BLIND] * len(surfaces)
        self._weighed: list[Entries] = [join([])] * len(surfaces)
        self._entries, self._clutter_origin_m = join([]), np.zeros(3)

    def scatterers(
        self,
        radar: RadarId,
        t_s: float,
        rig_position_m: Float64,
        rig_rotation: Float64,
        rig_velocity_m_s: Float64,
        reach_m: float,
        board_m: Float64 | None = None,
    ) -> tuple[Scatterers, GroundPlane]:
        """What one radar sees in a burst.

        Args:
            radar: which board: pattern, polarisation.
            t_s: of the first chirp.
            rig_position_m: float64 [3], the rig's origin in the world.
            rig_rotation: float64 [3, 3], rig to world.
            rig_velocity_m_s: float64 [3], world.
            reach_m: longest half path that the synthesis accepts.
            board_m: float64 [3], the board's phase centre in the rig frame, from which ranges and directions of the
                amplitudes count; None: the rig's origin.
        Returns:
            Scatterers and the ground in the rig frame.
        """
        position = np.asarray(rig_position_m, dtype=np.float64)
        rotation = np.asarray(rig_rotation, dtype=np.float64)
        require(bool(np.isfinite(position).all()), "rig position", position, "finite")
        require(position[2] > 0.0, "rig height above the ground", float(position[2]), "> 0 m")
        now = [one.at(t_s) for one in self._placed]
        self._refresh(now, position)
        placing = np.zeros((len(now) + 1, 5, 3))
        for number, one in enumerate(now):
            placing[number, :3] = rotation.T @ one.rotation
            placing[number, 3] = rotation.T @ (one.position_m - position)
            placing[number, 4] = rotation.T @ (np.asarray(one.velocity_m_s) - rig_velocity_m_s)
        placing[-1, :3] = rotation.T
        placing[-1, 3] = rotation.T @ (self._clutter_origin_m - position)
        placing[-1, 4] = rotation.T @ -np.asarray(rig_velocity_m_s, dtype=np.float64)
        plane = GroundPlane(np.ascontiguousarray(rotation[2]), float(position[2]))
        board = np.zeros(3) if board_m is None else np.asarray(board_m, dtype=np.float64)
        return self._emit(radar, placing, plane, reach_m, board), plane

    def _emit(
        self, radar: RadarId, placing: Float64, plane: GroundPlane, reach_m: float, board_m: Float64
    ) -> Scatterers:
        entries, antenna, settings = self._entries, self._antenna, self._settings.ground
        permittivity = settings.permittivity * (-1.0 if settings.polarization(radar) == "H" else 1.0)
        roughness = (2.0 * math.pi * settings.roughness_m / self._wavelength_m) ** 2
        ground = np.array([*plane.normal, plane.offset_m + plane.normal @ board_m, permittivity, roughness])
        edges = (antenna.along_edge_deg, antenna.along_loss_db, antenna.across_edge_deg, antenna.across_loss_db)
        pattern = np.array([1.0 if radar == "horizontal" else 2.0, *edges, antenna.max_loss_db])
        limits = np.array([reach_m - REACH_MARGIN_M, self._lsb_per_m, self._least_lsb])
        room = len(entries) + int(np.count_nonzero(entries.path == MIXED))
        place, velocity = np.empty((room, 3)), np.empty((room, 3))
        amplitude, image = np.empty(room, np.complex64), np.empty((2, room), np.bool_)
        columns = (entries.position, entries.weight, entries.board[RADARS.index(radar)], entries.path, entries.owner)
        n = emit(*columns, placing, board_m, ground, pattern, limits, place, velocity, amplitude, image)
        return Scatterers(place[:n], velocity[:n], amplitude[:n], image[0, :n], image[1, :n])

    def _views(self, now: Sequence[Placed], position_m: Float64, step_m: float) -> list[View]:
        """Every object as seen from the grid's nearest point; the grid moves with a moving object."""
        views = []
        for one, start in zip(now, self._placed, strict=True):
            moved = np.asarray(one.position_m) - np.asarray(start.position_m)
            eye = step_m * np.rint((position_m - moved) / step_m) - start.position_m
            eye[2] = position_m[2] - one.position_m[2]
            views.append(View(eye, -position_m[2] - one.position_m[2], one.rotation))
        return views

    def _refresh(self, now: Sequence[Placed], position_m: Float64) -> None:
        """Visibility and amplitudes of the grid's points that belong to this place, of the objects that need it."""
        step_m = self._settings.visibility_step_m
        origin = np.append(step_m * np.rint(position_m[:2] / step_m), position_m[2])
        views = self._views(now, position_m, step_m)
        coarse = self._views(now, position_m, MOVER_STEPS * step_m)
        moving = [bool(np.any(one.velocity_m_s)) for one in now]
        as_hiders = [far if moves else near for near, far, moves in zip(views, coarse, moving, strict=True)]
        changed = self._look(views, as_hiders, origin)
        near = self._views(now, position_m, self._settings.weight_step_m)
        for number, view in enumerate(near):
            eye = view.in_object_m
            if number in changed or eye.tobytes() != self._weighed_from[number]:
                self._weighed[number] = self._weigher.weigh(number, eye, self._sights[number])
                self._weighed_from[number] = eye.tobytes()
                changed.add(number)
        if changed or origin.tobytes() != self._clutter_from:
            self._entries = self._gather(origin)
            self._clutter_origin_m, self._clutter_from = origin, origin.tobytes()

    def _look(self, views: Sequence[View], as_hiders: Sequence[View], origin_m: Float64) -> set[int]:
        """Make new pictures where an object, or one that may hide it, or the ground's points have moved."""
        whole = b"".join([origin_m.tobytes(), *(view.eye_m.tobytes() for view in (*views, *as_hiders))])
        if whole == self._looked_from:
            return set()
        self._looked_from = whole
        changed, around = set(), self._clutter.around(origin_m)
        for number, view in enumerate(views):
            others = [view if n == number else hider for n, hider in enumerate(as_hiders)]
            hiders = self._visibility.hiders(number, others)
            key = b"".join(
                [origin_m.tobytes(), *(others[n].eye_m.tobytes() + bytes([n % 256]) for n in (number, *hiders))]
            )
            if key == self._seen_from[number]:
                continue
            candidates = self._weigher.candidates(number, view.in_object_m, self._settings.visibility_step_m)
            ground = self._settings.ground.enabled
            self._sights[number] = self._visibility.look(number, others, hiders, ground, candidates, around)
            self._seen_from[number] = key
            changed.add(number)
        return changed

    def _gather(self, origin_m: Float64) -> Entries:
        """The strongest amplitudes of all objects, and the visible clutter."""
        least = self._least_lsb / self._lsb_per_m
        objects = strongest(join(self._weighed), self._settings.max_scatterers, least)
        seen = np.full(len(self._clutter.weight), SEEN, np.uint8)
        for sight in self._sights:
            seen &= sight.clutter
        kept = seen > 0
        count = int(np.count_nonzero(kept))
        clutter = Entries(
            self._clutter.around(origin_m)[kept],
            self._clutter.weight[kept],
            np.ascontiguousarray(self._clutter.board[kept].T),
            np.full(count, DIRECT, np.uint8),
            np.full(count, len(self._placed), np.int32),
            np.zeros(count, np.float32),
        )
        return join([objects, clutter])
