# SPDX-License-Identifier: Apache-2.0
"""Colours of the viewer: one ramp for quantities, one hue for every class, fading towards the background."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

Rgb = tuple[int, int, int]
Colours = NDArray[np.uint8]

BACKGROUND: Rgb = (18, 20, 26)
"""What old things fade to; near the page's dark canvas."""
NEUTRAL: Rgb = (178, 184, 194)
CLASS_COLOURS: dict[str, Rgb] = {
    "car": (92, 160, 255),
    "bicycle": (72, 208, 140),
    "motorcycle": (255, 170, 64),
    "pedestrian": (255, 116, 190),
    "unknown": NEUTRAL,
}
_OTHERS: tuple[Rgb, ...] = ((200, 150, 255), (240, 220, 90), (110, 220, 225), (230, 120, 100))
_STOPS = np.array([[43, 32, 110], [40, 92, 170], [32, 150, 160], [96, 200, 110], [222, 220, 60], [255, 246, 190]])
"""Dark blue to pale yellow, brightness rising: it reads the same without colour vision."""


def _table(stops: NDArray[np.integer]) -> Colours:
    """256 colours, uint8 [256, 3], through evenly spaced stops."""
    places = np.linspace(0, len(stops) - 1, 256)
    return np.stack([np.interp(places, np.arange(len(stops)), stops[:, c]) for c in range(3)], axis=1).astype(np.uint8)


SHADE = 0.35
"""Brightness of a shape's lowest points."""
RAMP = _table(_STOPS)
HEAT = _table(np.concatenate([[[14, 15, 24]], _STOPS]))
"""The ramp from almost black: noise stays in the background."""


def class_colour(name: str) -> Rgb:
    """Colour of a class; a class that the viewer does not know always gets the same one of a few."""
    return CLASS_COLOURS.get(name) or _OTHERS[zlib.crc32(name.encode()) % len(_OTHERS)]


def ramp(values: NDArray[np.floating], low: float, high: float) -> Colours:
    """Colours uint8 [n, 3] of values [n] between ``low`` (dark) and ``high`` (bright); beyond: the ends."""
    share = (np.asarray(values, np.float64) - low) / max(high - low, 1e-9)
    return RAMP[np.clip(np.nan_to_num(share) * 255.0, 0, 255).astype(np.intp)]


def ramp_colour(value: float, low: float = 0.0, high: float = 1.0) -> Rgb:
    """One colour of the ramp."""
    red, green, blue = ramp(np.array([value]), low, high)[0].tolist()
    return red, green, blue


def shaded(colour: Rgb, heights_m: NDArray[np.floating]) -> Colours:
    """One hue for points [n], darker towards the bottom: without light a cloud of one colour has no form."""
    low, high = float(heights_m.min()), float(heights_m.max())
    share = SHADE + (1.0 - SHADE) * (heights_m - low) / max(high - low, 1e-6)
    return np.rint(np.asarray(colour, np.float32) * share[:, None]).astype(np.uint8)


def faded(colours: Colours | Rgb, strength: float) -> Colours:
    """Colours uint8 [..., 3] mixed with the background; strength 1 leaves them, 0 is the background."""
    mixed = np.asarray(colours, np.float32) * strength + np.asarray(BACKGROUND, np.float32) * (1.0 - strength)
    return np.rint(mixed).astype(np.uint8)
