# SPDX-License-Identifier: Apache-2.0
"""A body scan of unknown axes and unit, stood up: z up, x where the toes point, metres."""

from __future__ import annotations

import numpy as np

from edge.frames import Float32, Float64
from train.objects.mesh import MeshError
from train.objects.readers import Faces
from train.objects.sampling import sample_surface

UNITS_M: dict[str, float] = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}
_STATURE_M = (0.6, 2.4)


def unit_of_person(extent: float) -> float:
    """Metres of the unit in which the longest extent of a standing person is one from 0.6 to 2.4 m.

    Raises:
        MeshError: no unit (m, dm, cm, mm) fits.
    """
    for name in ("m", "dm", "cm", "mm"):
        if _STATURE_M[0] <= extent * UNITS_M[name] <= _STATURE_M[1]:
            return UNITS_M[name]
    raise MeshError("not the height of a person in m, dm, cm or mm", value=extent, action="give --unit or --length")


def stand_up(vertices: Float64, faces: Faces) -> Float64:
    """Rotation [3, 3] that stands a scanned person up, from the shape alone; the axes of the file are those of the box.

    Standing, a body is longest along its height, wider than deep, heavier above the middle of its height than below
    (trunk and arms against two legs), and the toes lie before the ankles.

    Args:
        vertices: float64 [n, 3], faces [m, 3]; standing along any axis of the file, arms hanging or a little apart.
    Returns:
        Rotation to x forward, y left, z up.
    """
    points = sample_surface(vertices.astype(np.float32), faces.astype(np.int32), 20_000, np.random.default_rng(0))
    up = int(np.argmax(np.ptp(points, axis=0)))
    middle = (points[:, up].max() + points[:, up].min()) / 2
    up_sign = 1.0 if float(points[:, up].mean()) > middle else -1.0
    height = up_sign * points[:, up]
    height = (height - height.min()) / float(np.ptp(height))
    flat = [axis for axis in range(3) if axis != up]
    widths = [float(np.ptp(points[(height > 0.4) & (height < 0.9), axis])) for axis in flat]
    forward = flat[int(np.argmin(widths))]
    toes, ankles = points[height < 0.03, forward], points[(height > 0.06) & (height < 0.12), forward]
    forward_sign = 1.0 if _middle(toes) > _middle(ankles) else -1.0
    x, z = np.zeros(3), np.zeros(3)
    x[forward], z[up] = forward_sign, up_sign
    return np.stack([x, np.cross(z, x), z])


def _middle(values: Float32) -> float:
    return float(values.max() + values.min()) / 2 if len(values) else 0.0
