# SPDX-License-Identifier: Apache-2.0
"""Cars from a side profile, plan taper, tumblehome, wheel arches and wheels: eight body styles to true scale."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from edge.frames import Float64
from train.objects.primitives import Part, box, fan, grid, lathe, mirrored, superellipsoid

Style = str
STYLES: dict[Style, float] = {
    "sedan": 0.22, "hatchback": 0.22, "estate": 0.1, "suv": 0.18, "coupe": 0.08, "pickup": 0.08, "van": 0.08,
    "minivan": 0.04,
}  # fmt: skip
"""Body styles and how often each is drawn."""

_RANGES: dict[Style, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "sedan": ((4.3, 5.1), (1.72, 1.92), (1.36, 1.50)),
    "hatchback": ((3.5, 4.4), (1.62, 1.84), (1.38, 1.56)),
    "estate": ((4.4, 5.0), (1.74, 1.92), (1.40, 1.54)),
    "suv": ((4.1, 5.0), (1.78, 2.02), (1.58, 1.90)),
    "coupe": ((4.0, 4.8), (1.72, 1.96), (1.18, 1.36)),
    "pickup": ((4.8, 5.6), (1.76, 2.04), (1.60, 1.92)),
    "van": ((4.4, 5.6), (1.80, 2.05), (1.90, 2.70)),
    "minivan": ((4.4, 5.1), (1.78, 2.0), (1.62, 1.85)),
}
"""Length, width (without mirrors) and height of every style, metres."""
_WELL_DEPTH = 0.26
"""How far the wheel wells reach in from the side, metres."""


@dataclass(frozen=True, slots=True)
class CarShape:
    """Measures of a car, metres and radians; distances along the car count from the front bumper.

    Args:
        style: one of STYLES.
        length, width, height: outer size without mirrors.
        wheelbase, front_overhang, wheel_radius, clearance: running gear.
        hood_height, belt_height: front edge of the hood, lower edge of the side windows.
        cowl: distance of the lower edge of the windscreen.
        windscreen_rad, rear_rad: slope of windscreen and rear window from the horizontal.
        deck: length of the boot lid or bed behind the rear window.
        tumblehome_rad: inward lean of the side windows.
        taper_front, taper_rear: narrowing of the plan at the ends, as a share of the half width.
    """

    style: Style
    length: float
    width: float
    height: float
    wheelbase: float
    front_overhang: float
    wheel_radius: float
    clearance: float
    hood_height: float
    belt_height: float
    cowl: float
    windscreen_rad: float
    rear_rad: float
    deck: float
    tumblehome_rad: float
    taper_front: float
    taper_rear: float

    @property
    def axles(self) -> tuple[float, float]:
        """Distance of both axles from the front."""
        return self.front_overhang, self.front_overhang + self.wheelbase

    @property
    def arch_radius(self) -> float:
        """Radius of the wheel arches."""
        return self.wheel_radius + 0.06


def draw_shape(rng: np.random.Generator, style: Style | None = None) -> CarShape:
    """Draw the measures of a car; ranges from type sheets of common cars and the collected training cars."""
    if style is None:
        style = str(rng.choice(list(STYLES), p=np.array(list(STYLES.values())) / sum(STYLES.values())))
    length, width, height = (float(rng.uniform(*limits)) for limits in _RANGES[style])
    van, tall = style == "van", style in ("suv", "pickup")

    def pick(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    rear = {"sedan": (24, 38), "coupe": (14, 24), "hatchback": (48, 68), "estate": (52, 75), "suv": (58, 80),
            "minivan": (68, 82), "pickup": (72, 88), "van": (84, 89)}[style]  # fmt: skip
    deck = {"sedan": (0.35, 0.65), "coupe": (0.15, 0.4), "pickup": (1.35, 1.75)}.get(style, (0.0, 0.08))
    overhang = pick(0.70, 0.98)
    cowl = {"van": (0.45, 0.9), "minivan": (0.75, 1.0)}.get(style, (1.0, 1.35))
    shape = CarShape(
        style=style,
        length=length,
        width=width,
        height=height,
        wheelbase=length * pick(0.56, 0.62),
        front_overhang=overhang,
        wheel_radius=pick(0.34, 0.40) if tall else pick(0.29, 0.35),
        clearance=pick(0.20, 0.26) if tall else pick(0.13, 0.19),
        hood_height=min(1.1, height * (pick(0.42, 0.50) if van else pick(0.49, 0.57))),
        belt_height=min(1.25, height * (pick(0.46, 0.54) if van else pick(0.61, 0.67))),
        cowl=pick(*cowl),
        windscreen_rad=math.radians(pick(50, 70) if van else pick(26, 38) + (6 if tall else 0)),
        rear_rad=math.radians(pick(*rear)),
        deck=pick(*deck),
        tumblehome_rad=math.radians(pick(3, 7) if van else pick(12, 22)),
        taper_front=pick(0.10, 0.22),
        taper_rear=pick(0.05, 0.14),
    )
    return replace(shape, wheelbase=min(shape.wheelbase, length - overhang - 0.55))


def top_profile(shape: CarShape) -> Float64:
    """Corners of the side view's upper edge from the front bumper to the tail: (distance, height), float64 [k, 2]."""
    h, length = shape.height, shape.length
    hood = shape.hood_height
    cowl_height = max(shape.belt_height + 0.03, hood + 0.08)
    header = shape.cowl + (0.965 * h - cowl_height) / math.tan(shape.windscreen_rad)
    tail_height = 0.88 * shape.belt_height + 0.06 if shape.style in ("sedan", "coupe") else 0.8 * shape.belt_height
    deck_height = shape.belt_height + (0.02 if shape.style in ("sedan", "coupe") else 0.0)
    deck_start = length - max(shape.deck, 0.05) - 0.03
    roof_end = deck_start - (0.95 * h - deck_height) / math.tan(shape.rear_rad)
    roof_end = max(roof_end, header + 0.3)
    points = [
        (0.0, 0.80 * hood),
        (0.04, 0.92 * hood),
        (0.18, hood),
        (shape.cowl, cowl_height),
        (header, 0.965 * h),
        (header + 0.45 * (roof_end - header), h),
        (roof_end, 0.95 * h),
        (max(deck_start, roof_end + 0.05), deck_height),
        (length - 0.05, tail_height + 0.02),
        (length, 0.92 * tail_height),
    ]
    if shape.style == "pickup":
        points[-3:] = [(points[-3][0], deck_height), (length - 0.03, deck_height), (length, deck_height - 0.03)]
    return np.array(points)


def _stations(shape: CarShape) -> Float64:
    """Distances of the cross sections: dense at the ends and about the wheel arches, float64 [k]."""
    dense = [np.linspace(0, 0.25, 6), np.linspace(shape.length - 0.2, shape.length, 5)]
    for axle in shape.axles:
        dense.append(axle + shape.arch_radius * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 13)))
    every = np.concatenate([np.arange(0, shape.length, 0.14), top_profile(shape)[:, 0], *dense])
    every = np.unique(np.clip(every, 0, shape.length).round(3))
    kept: Float64 = every[np.concatenate([[True], np.diff(every) > 0.012])]
    return kept


def _smooth(x: Float64, profile: Float64, width: float) -> Float64:
    """Piecewise linear profile with its corners rounded over ``width``."""
    taps = np.linspace(-width / 2, width / 2, 7)
    rounded: Float64 = np.interp(x[:, None] + taps, profile[:, 0], profile[:, 1]).mean(axis=1)
    return rounded


def _arch(shape: CarShape, x: float) -> float:
    """Height of the wheel arch at distance x from the front, 0 where there is none."""
    for axle in shape.axles:
        if abs(x - axle) < shape.arch_radius - 1e-3:
            return shape.wheel_radius + math.sqrt(shape.arch_radius**2 - (x - axle) ** 2)
    return 0.0


def _half_section(shape: CarShape, top: float, bottom: float, half: float, belt: float, arch: float) -> Float64:
    """One side of a cross section from the middle of the floor to the middle of the top: (y, z), float64 [27, 2]."""
    radius = min(0.11 if shape.style != "van" else 0.16, 0.35 * (top - bottom))
    shoulder = min(belt, top - radius)
    sill = bottom + 0.07
    middle, reach = 0.45 * (bottom + shoulder) + 0.1 * shoulder, max(shoulder - bottom, 0.1)
    z_side = np.linspace(min(max(sill, arch), shoulder), shoulder, 9)
    y_side = half * (1 - 0.10 * ((z_side - middle) / reach) ** 2)
    if arch > sill:
        inner = half - _WELL_DEPTH
        floor = np.array([[0, bottom], [0.5 * inner, bottom], [inner, bottom], [inner, z_side[0]]])
    else:
        floor = np.array([[0, bottom], [0.5 * half, bottom], [0.86 * half, bottom], [0.95 * half, sill - 0.03]])
    z_glass = np.linspace(shoulder, top - radius, 5)[1:]
    y_glass = y_side[-1] - (z_glass - shoulder) * math.tan(shape.tumblehome_rad)
    turn = np.linspace(0, math.pi / 2, 6)[1:]
    across = min(1.6 * radius, 0.45 * half)
    y_arc = y_glass[-1] - across * (1 - np.cos(turn))
    z_arc = top - radius + radius * np.sin(turn)
    y = np.concatenate([floor[:, 0], y_side, y_glass, y_arc, y_arc[-1] * np.linspace(1, 0, 6)[1:]])
    z = np.concatenate([floor[:, 1], z_side, z_glass, z_arc, np.full(5, top)])
    crown = np.clip((z - (top - radius)) / radius, 0, 1) * 0.05 * (y / half) ** 2
    return np.stack([y, z - crown], axis=1)


def _body(shape: CarShape) -> list[Part]:
    """The painted body as a loft over cross sections."""
    x = _stations(shape)
    top = _smooth(x, top_profile(shape), 0.13)
    nose, tail = np.clip(1 - x / 0.6, 0, 1), np.clip(1 - (shape.length - x) / 0.6, 0, 1)
    bottom = shape.clearance + 0.05 * nose**2 + 0.12 * tail**2
    front, rear = np.clip(1 - x / 1.1, 0, 1), np.clip(1 - (shape.length - x) / 1.1, 0, 1)
    half = shape.width / 2 * (1 - shape.taper_front * front**2.6 - shape.taper_rear * rear**2.6)
    belt = shape.belt_height + 0.03 * (x / shape.length - 0.5)
    bed = shape.length - shape.deck + 0.03
    rings = []
    for i in range(len(x)):
        section = _half_section(shape, top[i], bottom[i], half[i], belt[i], _arch(shape, float(x[i])))
        if shape.style == "pickup" and bed < x[i] < shape.length - 0.07:
            inside = (section[:, 0] < half[i] - 0.14) & (section[:, 1] > 0.6)
            section[inside, 1] = 0.55 * shape.belt_height + 0.1
        ring = np.vstack([section, section[-2:0:-1] * np.array([-1.0, 1])])
        rings.append(np.column_stack([np.full(len(ring), -x[i]), ring]))
    points = np.stack(rings)
    return [grid(points), fan(points[0]), fan(points[-1])]


def _wheel(radius: float, width: float, center: tuple[float, float, float]) -> Part:
    """Tyre and disc as a body of revolution."""
    h = width / 2
    profile = [(0.0, 0.7 * h), (0.22 * radius, 0.75 * h), (0.58 * radius, 0.45 * h), (0.66 * radius, 0.95 * h),
               (0.88 * radius, h), (0.98 * radius, 0.75 * h), (radius, 0.0), (0.98 * radius, -0.75 * h),
               (0.88 * radius, -h), (0.6 * radius, -0.9 * h), (0.0, -0.8 * h)]  # fmt: skip
    part = lathe(center, profile, 26)
    return part if center[1] > 0 else (part[0] * np.array([1, -1, 1]) + np.array([0, 2 * center[1], 0]), part[1])


def _attachments(shape: CarShape, rng: np.random.Generator) -> list[Part]:
    """Mirrors, and sometimes roof rails, a roof box, a spoiler, a spare wheel, a sign on the roof or a load."""
    half, h = shape.width / 2, shape.height
    mirror = superellipsoid(
        (-(shape.cowl + 0.45), half + 0.06, shape.belt_height + 0.07), (0.06, 0.11, 0.075), (0.6, 0.6), steps=(10, 7)
    )
    parts = [mirror, mirrored(mirror)]
    profile = top_profile(shape)
    roof, middle = float(profile[6, 0] - profile[4, 0]), -float(profile[6, 0] + profile[4, 0]) / 2
    if shape.style in ("estate", "suv", "minivan") and rng.random() < 0.5:
        rail = box((middle, 0.5 * half + 0.12, h - 0.02), (0.85 * roof, 0.035, 0.09))
        parts += [rail, mirrored(rail)]
    if shape.style not in ("pickup", "van") and rng.random() < 0.06:
        half_box = (min(0.75, 0.5 * roof), 0.32, 0.16)
        parts.append(superellipsoid((middle, 0, h + 0.13), half_box, (0.5, 0.5), steps=(16, 9)))
    if shape.style in ("coupe", "sedan") and rng.random() < 0.12:
        parts += _spoiler(shape, float(np.interp(shape.length - 0.18, profile[:, 0], profile[:, 1])))
    if shape.style == "suv" and rng.random() < 0.2:
        spare, faces = lathe((0, 0, 0), [(0, 0.1), (0.3, 0.1), (0.34, 0), (0.3, -0.1), (0, -0.1)], 20)
        parts.append((spare[:, [1, 0, 2]] + np.array([-shape.length - 0.06, 0, 0.62 * h]), faces))
    if shape.style in ("sedan", "estate", "minivan") and rng.random() < 0.04:
        parts.append(box((middle + 0.2 * roof, 0, h + 0.06), (0.16, 0.5, 0.14)))
    if shape.style == "pickup" and rng.random() < 0.4:
        length, height = shape.deck * rng.uniform(0.4, 0.8), rng.uniform(0.2, 0.7)
        width = shape.width * rng.uniform(0.4, 0.65)
        floor = 0.55 * shape.belt_height + 0.1
        parts.append(box((-(shape.length - 0.12 - length / 2), 0, floor + height / 2), (length, width, height)))
    return parts


def _spoiler(shape: CarShape, deck: float) -> list[Part]:
    """A wing on two struts over the end of the boot lid, whose height is ``deck``."""
    x = -(shape.length - 0.18)
    strut = box((x, 0.28 * shape.width, deck + 0.06), (0.06, 0.03, 0.16))
    return [box((x - 0.03, 0, deck + 0.14), (0.2, 0.72 * shape.width, 0.03)), strut, mirrored(strut)]


def car(rng: np.random.Generator, style: Style | None = None) -> list[Part]:
    """A random car; x forward, ground z = 0, not centred."""
    shape = draw_shape(rng, style)
    parts = _body(shape)
    width = float(rng.uniform(0.18, 0.24))
    for axle in shape.axles:
        for side in (-1, 1):
            center = (-axle, side * (shape.width / 2 - 0.03 - width / 2), shape.wheel_radius)
            parts.append(_wheel(shape.wheel_radius, width, center))
    return parts + _attachments(shape, rng)
