# SPDX-License-Identifier: Apache-2.0
"""A triangle mesh of one road user with its class, origin and licence, and how it is stood on the ground."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from edge.errors import RfconstructError
from edge.frames import Float32
from train.objects.sampling import Int32, bounds

ClassName = Literal["car", "bicycle", "motorcycle", "pedestrian"]
CLASSES: tuple[ClassName, ...] = ("car", "bicycle", "motorcycle", "pedestrian")


class MeshError(RfconstructError):
    """A mesh that cannot be read or has no surface."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """A road user as a two-sided triangle soup; it need not be watertight and its winding means nothing.

    Args:
        vertices: float32 [n, 3], metres, x forward, y left, z up; ground z = 0, bounding box centred in x and y.
        faces: int32 [m, 3], vertex numbers.
        label: index into CLASSES.
        object_id: unique name, "<class>/<name>".
        source_group: author or project; objects of one group never fall into two splits.
        provenance: A explicit licence, B uploader's tag, C crude or implied, P procedural, own = generated here.
        licence: SPDX name or the source's own words.
        attribution: what redistribution of a derived work owes.
    Raises:
        MeshError: no face, an index outside the vertices, or a vertex that is not finite.
    """

    vertices: Float32
    faces: Int32
    label: int
    object_id: str
    source_group: str = "own"
    provenance: str = "own"
    licence: str = "Apache-2.0"
    attribution: str = ""

    def __post_init__(self) -> None:
        if len(self.faces) == 0 or self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise MeshError(
                f"{self.object_id}: faces do not fit the vertices",
                value=f"{len(self.faces)} faces, {len(self.vertices)} vertices",
                allowed="at least one face, every index inside the vertices",
                action="remove the file from the folder or repair it",
            )
        if not np.isfinite(self.vertices).all():
            raise MeshError(f"{self.object_id}: a vertex is not finite", action="remove the file or repair it")

    @property
    def size_m(self) -> Float32:
        """Extent along x, y and z, float32 [3]."""
        low, high = bounds(self.vertices)
        return high - low

    def moved(self, vertices: Float32) -> Mesh:
        """Same object with other vertices (deformed, leaned), stood on the ground again."""
        return replace(self, vertices=stand(vertices))


def stand(vertices: Float32) -> Float32:
    """Shift so that the lowest point has z = 0 and the bounding box is centred in x and y; float32 [n, 3]."""
    vertices = np.ascontiguousarray(vertices, dtype=np.float32)
    low, high = bounds(vertices)
    return vertices - np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]], np.float32)
