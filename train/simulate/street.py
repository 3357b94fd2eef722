# SPDX-License-Identifier: Apache-2.0
"""A street to show the whole road: parked and standing road users side by side, past which the rig drives once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge.config import require
from edge.frames import Float32, Float64, FusedCloud, ObjectCloud, Pose
from edge.rig import Rig
from train.objects.mesh import ClassName, Mesh
from train.objects.reference import ObjectRef
from train.objects.sampling import sample_surface
from train.simulate.drive_by import DriveBy
from train.simulate.scene import footprint
from train.simulate.settings import SimulationSettings, TrackSettings
from train.simulate.surface import Placed, make_surface

USERS = (
    ObjectRef("car", "parametric_00011"),
    ObjectRef("motorcycle", "parametric_00008"),
    ObjectRef("bicycle", "parametric_00005", rider="rider1"),
    ObjectRef("pedestrian", "parametric_00017"),
)
"""Car, motorcycle, cyclist, pedestrian; none of them is trained on, none needs files."""
TURN_DEG: dict[ClassName, float] = {"car": 4.0, "motorcycle": 15.0, "bicycle": 15.0, "pedestrian": 180.0}
"""By class: heading off the street's, at most."""
SETBACK_M = 0.3
"""By which an object stands farther from the track than the kerb, at most."""


@dataclass(frozen=True, slots=True)
class StreetSettings:
    """What stands along the street, and how it is driven past.

    Args:
        users: who or what, in the order in which they are passed.
        length_m: of the street and of the track along it.
        side_m: from the track to the kerb, behind which all stand.
        least_gap_m: between two of them along the street; more than the tracker's ``objects.neighbour_m``.
        speed_m_s, height_m: of the rig.
        max_scatterers, weight_step_m, visibility_step_m: see ``OpticsSettings``.
        clutter_points: of the ground, see ``GroundSettings``; their mean level stays.

    The defaults of these four are coarser than a data set's, so that a core can make two cascades of 8 loops live.
    """

    users: Sequence[ObjectRef] = USERS
    length_m: float = 15.0
    side_m: float = 3.5
    least_gap_m: float = 0.9
    speed_m_s: float = 1.5
    height_m: float = 0.8
    max_scatterers: int = 600
    clutter_points: int = 1024
    weight_step_m: float = 0.10
    visibility_step_m: float = 0.20

    def __post_init__(self) -> None:
        require(len(self.users) > 0, "street.users", len(self.users), "at least one")
        require(1.0 <= self.length_m <= 1000.0, "street.length_m", self.length_m, "1..1000 m")
        require(0.5 <= self.side_m <= 50.0, "street.side_m", self.side_m, "0.5..50 m")
        require(self.least_gap_m >= 0.0, "street.least_gap_m", self.least_gap_m, ">= 0 m")
        require(0.0 < self.speed_m_s <= 40.0, "street.speed_m_s", self.speed_m_s, "above 0 to 40")


@dataclass(frozen=True, slots=True)
class StreetUser:
    """One object of the street and the truth about it.

    Args:
        ref: its name.
        mesh: own frame, on the ground.
        placed: where it stands in the world: z up, ground 0, the rig drives along +x from 0, objects at +y.
    """

    ref: ObjectRef
    mesh: Mesh
    placed: Placed

    def points_m(self, count: int, rng: np.random.Generator) -> Float32:
        """Points of the true surface, uniform by area, in the world, float32 [count, 3]."""
        own = sample_surface(self.mesh.vertices, self.mesh.faces, count, rng)
        return np.asarray(own @ self.placed.rotation.T + self.placed.position_m, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Street:
    """The scene, and the drive along it.

    Args:
        users: in the order in which they are passed.
        drive: source of both radars' frames and the reported poses.
    """

    users: tuple[StreetUser, ...]
    drive: DriveBy

    def truth_in_frame(
        self, number: int, window: FusedCloud | ObjectCloud | None, pose: Pose | None
    ) -> tuple[Float64, Float64]:
        """Rotation [3, 3] and translation [3] from the mesh of user ``number`` into a frame of the reported odometry.

        Args:
            number: index into ``users``.
            window, pose: of an ``ObjectCloud`` or a shape; see ``cloud.truth_in_frame``.
        """
        from train.simulate.cloud import truth_in_frame  # it brings the whole pipeline

        return truth_in_frame(self.drive, window, pose, number)

    def nearest(self, window: FusedCloud, pose: Pose) -> tuple[int, float]:
        """The user who stands nearest to the origin of an object's frame, and the distance on the ground, metres."""
        places = [self.truth_in_frame(number, window, pose)[1] for number in range(len(self.users))]
        away_m = [math.hypot(place[0], place[1]) for place in places]
        number = int(np.argmin(away_m))
        return number, away_m[number]


def make_street(
    rig: Rig, settings: StreetSettings | None = None, seed: int = 0, base: SimulationSettings | None = None
) -> Street:
    """The street of a seed; the same arguments give the same samples.

    Args:
        rig: of two radars that looks to the left.
        settings: what stands there.
        seed: of places, headings, surfaces, front ends, odometry.
        base: everything else; track, scatterers, steps and clutter points are replaced. None: defaults.
    Raises:
        ConfigError: the objects do not fit into the street.
        MeshError: no such object.
    """
    street, base = settings or StreetSettings(), base or SimulationSettings()
    schedule = next(iter(rig.radars.values())).schedule
    frames = math.ceil(street.length_m / (street.speed_m_s * schedule.frame_period_s))
    track = TrackSettings(frames=frames, speed_m_s=street.speed_m_s, height_m=street.height_m)
    ground = replace(base.optics.ground, clutter_points=street.clutter_points)
    optics = replace(base.optics, weight_step_m=street.weight_step_m, visibility_step_m=street.visibility_step_m)
    optics = replace(optics, max_scatterers=street.max_scatterers, ground=ground)
    simulation = replace(base, track=track, optics=optics)
    users = _line_up(street, simulation, float(schedule.profile.wavelength_m), seed)
    return Street(users, DriveBy(rig, [user.placed for user in users], simulation, seed))


def _line_up(
    street: StreetSettings, simulation: SimulationSettings, wavelength_m: float, seed: int
) -> tuple[StreetUser, ...]:
    """All users along the kerb with even gaps between them and at both ends, their backs and fronts as drawn."""
    rng = np.random.default_rng((seed, 5))
    meshes = [ref.mesh() for ref in street.users]
    yaws = [_heading(ref.class_name, rng) for ref in street.users]
    boxes = [footprint(mesh, np.zeros(3), yaw) for mesh, yaw in zip(meshes, yaws, strict=True)]
    widths_m = [float(box.high_m[0] - box.low_m[0]) for box in boxes]
    gap_m = (street.length_m - sum(widths_m)) / (len(widths_m) + 1)
    require(gap_m >= street.least_gap_m, "street.length_m", street.length_m, f"gaps >= {street.least_gap_m:g} m")
    users, x_m = [], gap_m
    for ref, mesh, yaw, box, width_m in zip(street.users, meshes, yaws, boxes, widths_m, strict=True):
        kerb_m = street.side_m + rng.uniform(0.0, SETBACK_M)
        where_m = np.array([x_m - box.low_m[0], kerb_m - box.low_m[1], 0.0])
        surface = make_surface(mesh, simulation.surface, street.side_m, wavelength_m, rng)
        users.append(StreetUser(ref, mesh, Placed(surface, where_m, yaw)))
        x_m += width_m + gap_m
    return tuple(users)


def _heading(name: ClassName, rng: np.random.Generator) -> float:
    """Along the street or against it, a little turned."""
    turn_deg = rng.uniform(-TURN_DEG[name], TURN_DEG[name])
    return math.radians(turn_deg + 180.0 * float(rng.random() < 0.5))
