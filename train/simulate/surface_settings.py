# SPDX-License-Identifier: Apache-2.0
"""Settings of the surfaces: patch size, curvature, materials of the classes, how many points stand for the rest."""

from __future__ import annotations

from dataclasses import dataclass, field

from edge.config import require
from train.objects.mesh import CLASSES, ClassName
from train.simulate.materials import BY_CLASS, Material


@dataclass(frozen=True, slots=True)
class SurfaceSettings:
    """How meshes become reflecting surfaces.

    Args:
        patch_share: size of a patch, half a square, in units of sqrt(lambda R); its longest side is sqrt(2) of it.
        patch_least_m, max_patches: patches are never smaller, and coarser where there would be more of them.
        crease_deg: faces that meet at less are one smooth surface; at more the edge reflects on its own.
        phong: share of Phong tessellation; 0 leaves facets flat, 1/2 gives a sphere of facets its own curvature.
        diffuse_points: how many points stand for the diffuse part of an object.
        edge_m: longest piece of an edge that is one point.
        edge_points: most edge points of an object; longer pieces stand for more.
        reflection_db, diffuse_db, points_db: added to the class's amplitude reflection, diffuse share and persistent
            points (as power).
        imbalance_scale: multiplies the class's spread of the power between the two boards.
        car, bicycle, motorcycle, pedestrian: what each class is made of.
    """

    patch_share: float = 0.3
    patch_least_m: float = 0.01
    max_patches: int = 250_000
    crease_deg: float = 40.0
    phong: float = 0.5
    diffuse_points: int = 256
    edge_m: float = 0.05
    edge_points: int = 1500
    reflection_db: float = 0.0
    diffuse_db: float = 0.0
    points_db: float = 0.0
    imbalance_scale: float = 1.0
    car: Material = field(default=BY_CLASS["car"])
    bicycle: Material = field(default=BY_CLASS["bicycle"])
    motorcycle: Material = field(default=BY_CLASS["motorcycle"])
    pedestrian: Material = field(default=BY_CLASS["pedestrian"])

    def __post_init__(self) -> None:
        require(0.02 <= self.patch_share <= 1.0, "surface.patch_share", self.patch_share, "0.02..1")
        require(5e-4 <= self.patch_least_m <= 1.0, "surface.patch_least_m", self.patch_least_m, "0.0005..1 m")
        require(1000 <= self.max_patches <= 20_000_000, "surface.max_patches", self.max_patches, "1000..20000000")
        require(1 <= self.crease_deg <= 90, "surface.crease_deg", self.crease_deg, "1..90")
        require(0 <= self.phong <= 1, "surface.phong", self.phong, "0..1")
        require(0 <= self.diffuse_points <= 100_000, "surface.diffuse_points", self.diffuse_points, "0..100000")
        require(0.005 <= self.edge_m <= 1.0, "surface.edge_m", self.edge_m, "0.005..1 m")
        require(0 <= self.edge_points <= 100_000, "surface.edge_points", self.edge_points, "0..100000")
        for name in ("reflection_db", "diffuse_db", "points_db"):
            require(abs(getattr(self, name)) <= 40, f"surface.{name}", getattr(self, name), "-40..40 dB")
        require(0 <= self.imbalance_scale <= 5, "surface.imbalance_scale", self.imbalance_scale, "0..5")

    def material(self, label: int) -> Material:
        """Ranges of class number ``label``."""
        name: ClassName = CLASSES[label]
        found: Material = getattr(self, name)
        return found
