# SPDX-License-Identifier: Apache-2.0
"""One-way element pattern of the antennas as the settings describe it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from edge.config import AntennaSettings
from edge.frames import Float64


def along_loss_db(settings: AntennaSettings, direction_cosine: ArrayLike) -> Float64:
    """One-way loss in the plane of the radar's own array.

    Args:
        settings: loss_db * (angle / edge)^2, at most max_loss_db.
        direction_cosine: along the array, any shape; beyond +-1 counts as 90 degrees.
    Returns:
        float64 dB, positive, same shape. A radar echo loses it twice.
    """
    return _loss_db(direction_cosine, settings.along_edge_deg, settings.along_loss_db, settings.max_loss_db)


def across_loss_db(settings: AntennaSettings, direction_cosine: ArrayLike) -> Float64:
    """One-way loss in the other plane; arguments as for ``along_loss_db``."""
    return _loss_db(direction_cosine, settings.across_edge_deg, settings.across_loss_db, settings.max_loss_db)


def _loss_db(direction_cosine: ArrayLike, edge_deg: float, loss_db: float, most_db: float) -> Float64:
    sine = np.clip(np.asarray(direction_cosine, dtype=np.float64), -1.0, 1.0)
    return np.asarray(np.minimum(loss_db * np.square(np.degrees(np.arcsin(sine)) / edge_deg), most_db))
