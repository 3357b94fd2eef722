# SPDX-License-Identifier: Apache-2.0
"""Fused cloud to objects: density clustering on the ground plane, ground points joined after, identities that last."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.config import ObjectSettings, RigGeometry
from edge.errors import CaptureError
from edge.frames import Float64, FusedCloud, ObjectCloud, Pose
from edge.fusion import kernels_cluster as kernels
from edge.fusion.identities import IdentityKeeper
from edge.odometry.transforms import rotation_matrix
from edge.odometry.vehicle import in_vehicle

FARTHEST_M = 10_000.0
SHORTER = 0.75
"""Of the links of a cluster that is too long, at every further try."""
_UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
_BEARING_RAD = np.arange(kernels.EXTENT_DIRECTIONS) * np.pi / kernels.EXTENT_DIRECTIONS
_DIRECTION = np.ascontiguousarray(np.stack([np.cos(_BEARING_RAD), np.sin(_BEARING_RAD)], axis=1))


@dataclass(frozen=True, slots=True)
class ObjectReport:
    """What became of a fused cloud's points and clusters: ``clusters = objects + too_small + too_long``.

    Args:
        points: of the cloud; ``points = in_objects + dropped + loose``.
        in_objects: points of the objects, ground points included.
        dropped: points of clusters that are no objects, ground points included.
        loose: points of no cluster.
        clusters: found.
        objects: kept.
        too_small: clusters of fewer than ``min_points`` points above the ground clearance.
        too_long: clusters longer than ``max_extent_m``.
    """

    points: int = 0
    in_objects: int = 0
    dropped: int = 0
    loose: int = 0
    clusters: int = 0
    objects: int = 0
    too_small: int = 0
    too_long: int = 0


class ObjectTracker:
    """Segments fused clouds into objects and follows them from window to window.

    The ground is level and lies ``geometry.height_m`` under the rig at the window's first pose. Points lower than the
    ground clearance would chain neighbours together; they take no part in the clustering and join the nearest cluster
    afterwards. Size and length of a cluster are those of its points above the clearance; length is its largest width
    over 16 directions (0.5 % short at worst), so that it does not depend on the object's heading.

    Args:
        settings: clustering and identities.
        geometry: height of the rig.
    """

    def __init__(self, settings: ObjectSettings, geometry: RigGeometry) -> None:
        self._settings = settings
        self._geometry, self._height_m = geometry, geometry.height_m
        self._identities = IdentityKeeper(settings.match_m, settings.forget_s)
        self._grid = kernels.make_grid(4096)
        self.last_report = ObjectReport()

    def process(self, cloud: FusedCloud) -> list[ObjectCloud]:
        """Objects of a window, the nearest to the rig's first position first; points keep the cloud's order.

        Args:
            cloud: fused cloud; the windows of one tracker share one odometry frame.
        Returns:
            Objects in their own frames: axes of ``odom``, origin on the ground under the middle of their bounding box.
        Raises:
            CaptureError: a point is not finite or farther than 10 km; the identities are unchanged.
        """
        xyz_m = self._above_ground(cloud)
        labels, standing = self._cluster(xyz_m)
        kept = self._keep(xyz_m, labels, standing)
        members = [np.flatnonzero(labels == label) for label in kept]
        boxes_m = [(xyz_m[member, :2].min(axis=0), xyz_m[member, :2].max(axis=0)) for member in members]
        centers_m = np.array([(low + high) / 2 for low, high in boxes_m]).reshape(-1, 2)
        identities = self._identities.update(centers_m + cloud.reference.position_m[:2], cloud.t_end_ns)
        order = np.argsort(np.linalg.norm(centers_m, axis=1), kind="stable")
        return [self._object(cloud, xyz_m, members[k], centers_m[k], identities[k]) for k in order]

    def _above_ground(self, cloud: FusedCloud) -> Float64:
        """Points along the axes of ``odom``, from the spot on the ground under the window's first rig position."""
        if not (np.abs(cloud.xyz_m) <= FARTHEST_M).all():
            raise CaptureError(
                f"fused cloud ending at {cloud.t_end_ns} ns holds points that cannot be",
                value=float(np.abs(cloud.xyz_m).max()),
                allowed=f"finite, within {FARTHEST_M:.0f} m",
                action="check the calibration and the poses of this window",
            )
        leveled_m = cloud.xyz_m.astype(np.float64) @ rotation_matrix(cloud.reference.quaternion_xyzw).T
        leveled_m[:, 2] += self._height_m
        return leveled_m

    def _cluster(self, xyz_m: Float64) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """Label of every point (-1: none) and which points stand above the ground clearance."""
        standing = xyz_m[:, 2] >= self._settings.ground_clearance_m
        plane_m, low_m = np.ascontiguousarray(xyz_m[standing, :2]), np.ascontiguousarray(xyz_m[~standing, :2])
        if len(plane_m) > len(self._grid.order):
            self._grid = kernels.make_grid(2 * len(plane_m))
        labels = np.empty(len(xyz_m), np.int32)
        found, joined = np.empty(len(plane_m), np.int32), np.empty(len(low_m), np.int32)
        kernels.dbscan(plane_m, self._settings.neighbour_m, self._settings.core_points, self._grid, found)
        self._split(plane_m, found)
        kernels.nearest_labels(low_m, plane_m, self._settings.neighbour_m, self._grid, found, joined)
        labels[standing], labels[~standing] = found, joined
        return labels, standing

    def _split(self, plane_m: Float64, labels: NDArray[np.int32]) -> None:
        """Cluster what is too long again with shorter links; ``labels`` [n] is changed in place and stays gapless."""
        settings, radius_m = self._settings, self._settings.neighbour_m
        while (radius_m := radius_m * SHORTER) >= settings.least_neighbour_m:
            _, extent_m = _measured(plane_m, labels)
            if not (extent_m > settings.max_extent_m).any():
                return
            for label in np.flatnonzero(extent_m > settings.max_extent_m):
                member = np.flatnonzero(labels == label)
                parts = np.empty(len(member), np.int32)
                part_m = np.ascontiguousarray(plane_m[member])
                kernels.dbscan(part_m, radius_m, settings.core_points, self._grid, parts)
                labels[member] = np.where(parts < 0, -1, parts + labels.max() + 1)
            _, gapless = np.unique(labels[labels >= 0], return_inverse=True)
            labels[labels >= 0] = gapless

    def _keep(self, xyz_m: Float64, labels: NDArray[np.int32], standing: NDArray[np.bool_]) -> list[int]:
        """Labels of the clusters that are objects; fills the report."""
        count, extent_m = _measured(np.ascontiguousarray(xyz_m[standing, :2]), labels[standing])
        too_small = count < self._settings.min_points
        too_long = ~too_small & (extent_m > self._settings.max_extent_m)
        kept = np.flatnonzero(~too_small & ~too_long)
        loose, in_objects = int((labels < 0).sum()), int(np.isin(labels, kept).sum())
        self.last_report = ObjectReport(
            points=len(labels),
            in_objects=in_objects,
            dropped=len(labels) - in_objects - loose,
            loose=loose,
            clusters=len(count),
            objects=len(kept),
            too_small=int(too_small.sum()),
            too_long=int(too_long.sum()),
        )
        return [int(label) for label in kept]

    def _object(
        self, cloud: FusedCloud, xyz_m: Float64, member: NDArray[np.int64], center_m: Float64, identity: int
    ) -> ObjectCloud:
        """One object in its own frame."""
        origin_m = np.array([center_m[0], center_m[1], 0.0])
        rig_m = np.array([0.0, 0.0, self._height_m])
        sensor_m = rotation_matrix(cloud.reference.quaternion_xyzw) @ cloud.sensor_m + rig_m
        pose = Pose(cloud.t_end_ns, cloud.reference.position_m - rig_m + origin_m, _UPRIGHT.copy())
        return ObjectCloud(
            identity=identity,
            xyz_m=(xyz_m[member] - origin_m).astype(np.float32),
            power_db=cloud.power_db[member],
            pose=pose,
            t_start_ns=cloud.t_start_ns,
            t_end_ns=cloud.t_end_ns,
            travel_m=cloud.travel_m,
            frames=cloud.frames,
            complete=cloud.complete,
            sensor_m=sensor_m - origin_m,
            age_s=self._identities.age_s(identity),
            pose_vehicle=None if cloud.last is None else in_vehicle(pose, cloud.last, self._geometry),
        )


def _measured(plane_m: Float64, labels: NDArray[np.int32]) -> tuple[NDArray[np.int64], Float64]:
    """Points and largest width in metres of every cluster of points [n, 2]."""
    clusters = int(labels.max(initial=-1)) + 1
    count, extent_m = np.empty(clusters, np.int64), np.empty(clusters, np.float64)
    span_m = np.empty((clusters, len(_DIRECTION), 2), np.float64)
    kernels.measure(plane_m, labels, _DIRECTION, count, span_m, extent_m)
    return count, extent_m
