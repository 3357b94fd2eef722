# SPDX-License-Identifier: Apache-2.0
"""Motorcycles and scooters from lofted bodies to true scale, and where a rider touches them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edge.frames import Float64
from train.objects.primitives import (
    Part,
    box,
    capsule,
    curve,
    frame_of,
    lathe,
    loft,
    mirrored,
    superellipsoid,
    torus,
    tube,
    vec,
)
from train.objects.rider import Contacts

_KINDS = ("naked", "sport", "cruiser", "enduro", "touring", "scooter")


@dataclass(frozen=True, slots=True)
class Machine:
    """Measures of one machine, metres and radians; rear axle at x = 0.

    Args:
        wheelbase, front_radius, rear_radius, front_tyre, rear_tyre: wheels, outer radius and half the tyre's width.
        seat_height, bar_height, bar_half: rider's contact points. rake_rad: steering head from the vertical.
        foot: pegs or floor, forward of the rear axle, to the side and above ground.
        reach: share of the rider's arm from the shoulders to the grips.
    """

    kind: str
    wheelbase: float
    front_radius: float
    rear_radius: float
    front_tyre: float
    rear_tyre: float
    seat_height: float
    bar_height: float
    bar_half: float
    rake_rad: float
    foot: tuple[float, float, float]
    reach: float


def draw_machine(kind: str, rng: np.random.Generator) -> Machine:
    """Measures of a kind from type sheets."""

    def pick(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    base = {
        "naked": (1.37, 1.48),
        "sport": (1.37, 1.45),
        "cruiser": (1.55, 1.70),
        "enduro": (1.42, 1.52),
        "touring": (1.48, 1.60),
        "scooter": (1.22, 1.42),
    }[kind]
    seat = {
        "naked": (0.78, 0.83),
        "sport": (0.80, 0.85),
        "cruiser": (0.66, 0.72),
        "enduro": (0.84, 0.93),
        "touring": (0.78, 0.84),
        "scooter": (0.75, 0.80),
    }[kind]
    bar = {
        "naked": (1.00, 1.08),
        "sport": (0.88, 0.95),
        "cruiser": (1.02, 1.22),
        "enduro": (1.10, 1.20),
        "touring": (1.05, 1.14),
        "scooter": (0.98, 1.05),
    }[kind]
    scooter = kind == "scooter"
    wheelbase = pick(*base)
    foot = {"cruiser": 0.69, "sport": 0.37, "scooter": 0.56}.get(kind, 0.50) * wheelbase
    return Machine(
        kind=kind,
        wheelbase=wheelbase,
        front_radius=pick(0.21, 0.27) if scooter else pick(0.33, 0.36) if kind == "enduro" else pick(0.29, 0.32),
        rear_radius=pick(0.21, 0.26) if scooter else pick(0.30, 0.33),
        front_tyre=pick(0.045, 0.06),
        rear_tyre=pick(0.05, 0.065) if scooter else pick(0.065, 0.095),
        seat_height=pick(*seat),
        bar_height=pick(*bar),
        bar_half=pick(0.31, 0.35) if kind in ("sport", "scooter") else pick(0.36, 0.42),
        rake_rad=math.radians(pick(30, 36) if kind == "cruiser" else pick(23, 28)),
        foot=(foot, 0.12, 0.35) if scooter else (foot, 0.21, 0.36 if kind == "sport" else 0.30),
        reach=pick(0.82, 0.95),
    )


def _wheel(center: Float64, radius: float, tyre: float) -> list[Part]:
    """Tyre, rim and brake disc."""
    parts = [torus(center, radius - 0.85 * tyre, 0.85 * tyre, 32, 8)]
    rim, h = radius - 1.7 * tyre, 0.6 * tyre
    parts.append(lathe(center, [(rim, h), (rim - 0.02, 0.7 * h), (rim - 0.02, -0.7 * h), (rim, -h)], 32))
    parts.append(lathe(center, [(0.05, 0.06), (0.05, -0.06)], 12))
    parts.append(lathe(center + vec(0, 0.06, 0), [(0.06, 0), (min(0.15, rim - 0.03), 0)], 20))
    for angle in 2 * math.pi * np.arange(5) / 5:
        out = np.array([math.cos(angle), 0, math.sin(angle)])
        parts.append(tube([center + 0.04 * out, center + (rim - 0.01) * out], 0.017, 5))
    return parts


def _hull(stations: list[tuple[float, float, float, float]], exponent: float = 0.7) -> list[Part]:
    """A smooth body along x: stations of (x, middle height, half width, half height), superelliptic sections."""
    fine = curve(np.array(stations), 18)
    fine[:, 2:] = np.maximum(fine[:, 2:], 0.005)
    angle = 2 * math.pi * np.arange(16) / 16
    c, s = np.cos(angle), np.sin(angle)
    y = np.sign(c) * np.abs(c) ** exponent
    z = np.sign(s) * np.abs(s) ** exponent
    x, middle, half, high = fine.T
    points = np.stack(
        [np.repeat(x[:, None], 16, axis=1), half[:, None] * y, middle[:, None] + high[:, None] * z], axis=2
    )
    return loft(points)


def _fork(m: Machine, stem: Float64, axle: Float64) -> list[Part]:
    """Fork legs, front mudguard, head lamp."""
    parts = [tube([stem + vec(0, 0.09 * s, -0.04), axle + vec(0, 0.09 * s, 0)], 0.025, 8) for s in (1, -1)]
    angle = np.radians(np.linspace(35, 160, 10))
    arc = axle + (m.front_radius + 0.025) * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    for side in (0.04, -0.04, 0.0):
        parts.append(tube(arc + vec(0, side, 0), 0.022, 5))
    if m.kind not in ("sport", "touring"):
        lamp = stem + vec(0.10, 0, -0.10)
        parts.append(superellipsoid(lamp, (0.08, 0.09, 0.09), (0.8, 0.8), steps=(12, 9)))
    return parts


def _bars(m: Machine, stem: Float64) -> tuple[list[Part], Float64]:
    """Handle bar with mirrors and the grips [2, 3]."""
    grip = np.array([stem[0] - (0.05 if m.kind == "sport" else 0.16), m.bar_half - 0.05, m.bar_height])
    end = grip + vec(-0.02, 0.06, -0.01)
    side = tube(curve([stem, stem + vec(0.0, 0.1, 0.04), grip + vec(0.03, -0.1, 0), end], 10), 0.016, 7)
    clamp = tube([stem + vec(0, 0, -0.06), stem + vec(0, 0, 0.01)], 0.022, 6)
    parts = [side, mirrored(side), clamp, box(stem - vec(0, 0, 0.05), (0.06, 0.24, 0.03))]
    mirror_at = grip + vec(0.10, 0.02, 0.17)
    mirror = superellipsoid(mirror_at, (0.02, 0.07, 0.045), (0.7, 0.7), steps=(10, 7))
    stalk = tube([grip + vec(0.03, -0.06, 0.01), mirror_at], 0.007, 5)
    parts += [mirror, mirrored(mirror), stalk, mirrored(stalk)]
    return parts, np.stack([grip, grip * np.array([1, -1, 1])])


def _motorcycle_body(m: Machine, stem: Float64, rng: np.random.Generator) -> list[Part]:
    """Tank, seat, tail, engine, swing arm, exhaust, and fairing or cases where the kind has them."""
    w, seat = m.wheelbase, m.seat_height
    tank_end, tank_front = 0.46 * w, float(stem[0]) - 0.10
    top = seat + rng.uniform(0.10, 0.18)
    half = rng.uniform(0.13, 0.17)
    parts = _hull(
        [
            (tank_end - 0.03, seat - 0.02, 0.07, 0.06),
            (0.65 * tank_end + 0.35 * tank_front, top - 0.13, half, 0.12),
            (0.3 * tank_end + 0.7 * tank_front, top - 0.12, half, 0.13),
            (tank_front + 0.04, top - 0.13, 0.09, 0.09),
        ]
    )
    tail = {"cruiser": -0.18, "touring": -0.35}.get(m.kind, -0.24)
    rise = 0.10 if m.kind in ("sport", "naked") else 0.05
    parts += _hull(
        [
            (tail, seat + rise + 0.02, 0.06, 0.03),
            (0.5 * tail, seat + rise, 0.10, 0.055),
            (0.22 * w, seat - 0.05, 0.14, 0.06),
            (0.38 * w, seat - 0.05, 0.12, 0.055),
            (tank_end + 0.02, seat - 0.04, 0.08, 0.05),
        ]
    )
    low = 0.24 if m.kind == "enduro" else 0.17
    middle = 0.52 * w
    parts.append(superellipsoid((middle - 0.06, 0, low + 0.17), (0.25, 0.18, 0.16), (0.5, 0.5), steps=(14, 9)))
    tilt = frame_of((0.35, 0, 1.0))
    parts.append(superellipsoid((middle + 0.10, 0, low + 0.38), (0.11, 0.13, 0.17), (0.4, 0.4), tilt, (12, 9)))
    for sign in (1, -1):
        pivot = np.array([0.36 * w, 0.11 * sign, m.rear_radius + 0.06])
        cradle = vec(middle + 0.12, 0.13 * sign, low + 0.3)
        parts.append(tube([pivot, vec(0, 0.11 * sign, m.rear_radius)], [0.035, 0.028], 7))
        parts.append(tube([stem + vec(0, 0.05 * sign, -0.12), cradle, pivot], 0.022, 7))
        parts.append(tube([[0.02, 0.13 * sign, m.rear_radius], [0.12 * w, 0.12 * sign, seat - 0.1]], 0.03, 7))
    pipe = curve(
        [
            [middle + 0.22, -0.08, low + 0.36],
            [middle + 0.24, -0.12, low],
            [0.35 * w, -0.16, low + 0.02],
            [0.12 * w, -0.19, m.rear_radius + 0.04],
        ],
        12,
    )
    parts.append(tube(pipe, 0.022, 7))
    high = 0.20 if m.kind in ("enduro", "sport") else 0.0
    parts.append(capsule(pipe[-1], pipe[-1] + vec(-0.42, -0.02, 0.06 + high), 0.045, 0.055))
    if m.kind in ("sport", "touring"):
        parts += _fairing(m, stem)
    if m.kind == "touring":
        for sign in (1, -1):
            parts.append(superellipsoid((-0.06, 0.30 * sign, 0.60), (0.27, 0.12, 0.18), (0.4, 0.4), steps=(12, 7)))
        if rng.random() < 0.5:
            parts.append(superellipsoid((-0.32, 0, seat + 0.22), (0.2, 0.24, 0.16), (0.4, 0.4), steps=(12, 7)))
    return parts


def _fairing(m: Machine, stem: Float64) -> list[Part]:
    """Nose, side panels and screen."""
    nose = float(stem[0]) + 0.28
    high = 0.10 if m.kind == "touring" else 0.0
    parts = _hull(
        [
            (nose, stem[2] - 0.18, 0.05, 0.05),
            (nose - 0.12, stem[2] - 0.12, 0.17, 0.14),
            (nose - 0.28, stem[2] - 0.12, 0.21, 0.20),
            (0.60 * m.wheelbase, 0.52, 0.24, 0.30),
            (0.40 * m.wheelbase, 0.42, 0.2, 0.2),
        ]
    )
    top = np.array([nose - 0.32, 0, stem[2] + 0.16 + 2.5 * high])
    foot = np.array([nose - 0.10, 0, stem[2] - 0.02])
    width = np.array([0, 0.16, 0])
    corners = np.array(
        [
            foot - width,
            foot + vec(0.04, 0, 0),
            foot + width,
            top + 0.8 * width,
            top + vec(0.03, 0, 0.03),
            top - 0.8 * width,
        ]
    )
    parts.append((corners, np.array([[0, 1, 5], [1, 4, 5], [1, 2, 3], [1, 3, 4]])))
    return parts


def _scooter_body(m: Machine, stem: Float64, rng: np.random.Generator) -> list[Part]:
    """Leg shield, floor, rear body, seat, and sometimes a top case."""
    w, seat = m.wheelbase, m.seat_height
    parts = _hull(
        [
            (-0.38, seat - 0.12, 0.06, 0.06),
            (-0.20, seat - 0.18, 0.15, 0.15),
            (0.18 * w, seat - 0.22, 0.18, 0.20),
            (0.38 * w, seat - 0.27, 0.15, 0.22),
            (0.43 * w, seat - 0.32, 0.11, 0.18),
        ]
    )
    parts += _hull(
        [
            (-0.34, seat - 0.02, 0.08, 0.04),
            (-0.05, seat - 0.02, 0.14, 0.06),
            (0.25 * w, seat - 0.05, 0.15, 0.06),
            (0.42 * w, seat - 0.08, 0.09, 0.05),
        ]
    )
    parts.append(superellipsoid((0.52 * w, 0, 0.29), (0.24, 0.17, 0.06), (0.5, 0.5), steps=(14, 7)))
    slope = frame_of((-math.tan(m.rake_rad), 0, 1.0))
    shield = np.array([0.72 * w, 0, 0.58])
    parts.append(superellipsoid(shield, (0.07, 0.23, 0.34), (0.6, 0.7), slope @ np.diag([-1.0, -1, 1]), (16, 9)))
    parts.append(superellipsoid(stem + vec(0.03, 0, 0.04), (0.12, 0.17, 0.10), (0.7, 0.8), steps=(14, 9)))
    parts.append(superellipsoid((0.02, 0.12, m.rear_radius + 0.02), (0.22, 0.07, 0.10), (0.6, 0.6), steps=(12, 7)))
    parts.append(capsule((0.1, -0.15, m.rear_radius), (-0.28, -0.16, m.rear_radius + 0.08), 0.05, 0.055))
    if rng.random() < 0.35:
        parts.append(superellipsoid((-0.24, 0, seat + 0.14), (0.2, 0.2, 0.15), (0.5, 0.5), steps=(12, 7)))
    if rng.random() < 0.3:
        top = stem + vec(0.0, 0, 0.42)
        foot = stem + vec(0.14, 0, 0.08)
        width = np.array([0, 0.2, 0])
        corners = np.array([foot - width, foot + width, top + width, top - width])
        parts.append((corners, np.array([[0, 1, 2], [0, 2, 3]])))
    return parts


def motorcycle(rng: np.random.Generator) -> tuple[list[Part], Contacts]:
    """A random machine and the places of its rider; x forward, ground z = 0, not centred."""
    kind = str(rng.choice(_KINDS, p=[0.22, 0.15, 0.15, 0.1, 0.13, 0.25]))
    m = draw_machine(kind, rng)
    axle = np.array([m.wheelbase, 0, m.front_radius])
    height = m.bar_height - 0.08 - m.front_radius
    stem = axle + np.array([-math.tan(m.rake_rad) * height - 0.02, 0, height])
    parts = _wheel(axle, m.front_radius, m.front_tyre)
    parts += _wheel(np.array([0, 0, m.rear_radius]), m.rear_radius, m.rear_tyre)
    bars, grips = _bars(m, stem)
    parts += _fork(m, stem, axle) + bars
    parts += _scooter_body(m, stem, rng) if kind == "scooter" else _motorcycle_body(m, stem, rng)
    if kind != "scooter":
        parts.append(box((-0.22, 0, 0.6 * m.seat_height), (0.04, 0.16, 0.16)))
    forward, side, height = m.foot
    if kind != "scooter":
        peg = tube([vec(forward, side - 0.09, height - 0.012), vec(forward, side + 0.04, height - 0.012)], 0.012, 6)
        parts += [peg, mirrored(peg)]
    feet = np.array([[forward, side, height], [forward, -side, height]])
    saddle = vec((0.27 if kind == "scooter" else 0.33) * m.wheelbase, 0, m.seat_height)
    return parts, Contacts(saddle, grips, feet, False, m.reach)
