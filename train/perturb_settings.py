# SPDX-License-Identifier: Apache-2.0
"""Settings of the geometric perturbation: a switch and a range for every step, the paper's steps by themselves."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from edge.config import require

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class PerturbSettings:
    """Settings of every step; a pair is the range of a uniform draw, a probability is that the step happens at all.

    Args:
        distance_m: camera to the nearer end of the object, log-uniform; half the object's length is added.
        height_m: camera above ground. aim_deg: largest error of the aim, in azimuth and elevation.
        columns, rows: size of the depth map, fitted to the object.
        path_probability, path_views, path_m: several snapshots merged along a straight path past the object (ours).
        base_points: points drawn from the snapshot.
        specular_probability: draw them in dense clusters about points that face the radar (ours; measured on clouds of
            the real pipeline: 16..53 % of the visible surface has a point within 15 cm). specular_spots: number of
            clusters; specular_radius_m: their sigma; specular_background: share of the weight that is not clustered.
        pass_probability, pass_share: only this share of the object's width was passed (ours).
        holes, hole_count, hole_radius_share: spheres cut out; radius as a share of the object's 3-D diagonal.
        hole_min_keep: a hole that would leave less than this share of the points is skipped.
        noise, noise_copies, noise_radius_m: each point becomes several on a sphere about it of radius R0 U(0, 1).
        noise_by_distance: R0 = (0.02 R + 0.03 m) U(0.5, 1.5), kept inside noise_radius_m (ours); else R0 is uniform.
        ellipsoid_probability: the sphere becomes an ellipsoid of half a range bin (3 cm) along the ray (ours).
        noise_first: order of the paper; False cuts the holes first, so that their rims get fuzzy (ours).
        drift_probability, drift_sigma: odometry that drifts, metres a metre of path (ours).
        outlier_probability, outlier_share, outlier_margin_m: uniform points in the cloud's box and so far beyond it; a
            share is of the points there are (ours).
        ghost_probability, ghost_share, ghost_ground_sigma_m: points mirrored in a ground of uncertain height (ours).
        streak_probability, streak_share, streak_deg: copies along the iso-range arc, as side lobes make them (ours).
        clip, clip_z_m: points whose height is outside are dropped (ours).
        sparse_probability, sparse_points: thin to a very sparse cloud (ours), log-uniform.
        thin: thin the other clouds to a log-uniform number between sparse_points[1] and max_points (ours).
        max_points: never more; fewer are never filled up.
    """

    distance_m: Range = (3.0, 12.0)
    height_m: Range = (0.4, 1.2)
    aim_deg: float = 3.0
    columns: int = 160
    rows: int = 120
    path_probability: float = 0.5
    path_views: tuple[int, int] = (2, 4)
    path_m: float = 3.0
    base_points: tuple[int, int] = (400, 1500)
    specular_probability: float = 0.6
    specular_spots: tuple[int, int] = (3, 14)
    specular_radius_m: Range = (0.03, 0.25)
    specular_background: Range = (0.01, 0.05)
    pass_probability: float = 0.2
    pass_share: Range = (0.4, 0.9)
    holes: bool = True
    hole_count: tuple[int, int] = (2, 6)
    hole_radius_share: Range = (0.08, 0.25)
    hole_min_keep: float = 0.25
    noise: bool = True
    noise_copies: tuple[int, int] = (2, 6)
    noise_radius_m: Range = (0.05, 0.30)
    noise_by_distance: bool = True
    ellipsoid_probability: float = 0.3
    noise_first: bool = False
    drift_probability: float = 0.25
    drift_sigma: float = 0.03
    outlier_probability: float = 0.25
    outlier_share: float = 0.03
    outlier_margin_m: float = 0.5
    ghost_probability: float = 0.25
    ghost_share: float = 0.05
    ghost_ground_sigma_m: float = 0.1
    streak_probability: float = 0.25
    streak_share: float = 0.05
    streak_deg: Range = (2.0, 6.0)
    clip: bool = True
    clip_z_m: Range = (0.0, 3.0)
    sparse_probability: float = 0.25
    sparse_points: tuple[int, int] = (64, 300)
    thin: bool = True
    max_points: int = 2048

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            value = getattr(self, name)
            if isinstance(value, tuple):
                require(value[0] <= value[1], f"perturb.{name}", value, "lowest <= highest")
            elif name.endswith(("_probability", "_share", "_keep")):
                require(0 <= value <= 1, f"perturb.{name}", value, "0..1")
        require(self.distance_m[0] > 0, "perturb.distance_m", self.distance_m, "> 0 m")
        for name in ("path_views", "base_points", "specular_spots", "noise_copies", "sparse_points"):
            require(getattr(self, name)[0] >= 1, f"perturb.{name}", getattr(self, name), ">= 1")
        for name in ("aim_deg", "path_m", "drift_sigma", "outlier_margin_m", "ghost_ground_sigma_m"):
            require(getattr(self, name) >= 0, f"perturb.{name}", getattr(self, name), ">= 0")
        for name in ("max_points", "columns", "rows"):
            require(getattr(self, name) >= 1, f"perturb.{name}", getattr(self, name), ">= 1")

    @classmethod
    def paper(cls, **changes: object) -> PerturbSettings:
        """Only what the paper describes (section 4.3), in its order: one snapshot, noise spheres, then holes."""
        plain = cls(
            path_probability=0, specular_probability=0, pass_probability=0, noise_by_distance=False,
            ellipsoid_probability=0, noise_first=True, drift_probability=0, outlier_probability=0, ghost_probability=0,
            streak_probability=0, clip=False, sparse_probability=0, thin=False,
        )  # fmt: skip
        return replace(plain, **changes)  # type: ignore[arg-type]

    @classmethod
    def clean(cls, **changes: object) -> PerturbSettings:
        """Partial clouds as PCN makes them (Yuan et al. 2018, section 5.1): one depth scan, back-projected, no noise.

        The camera stands anywhere around the object, up to 6 m high, as PCN's views are not those of a car.
        """
        plain = cls.paper(holes=False, noise=False, height_m=(0.3, 6.0), aim_deg=0.0, base_points=(2048, 2048))
        return replace(plain, **changes)  # type: ignore[arg-type]
