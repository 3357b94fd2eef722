# SPDX-License-Identifier: Apache-2.0
"""Bicycles from tubes and tyres to true scale, and where a rider touches them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edge.frames import Float64
from train.objects.primitives import Part, box, curve, lathe, mirrored, superellipsoid, torus, tube, vec
from train.objects.rider import Contacts

_KINDS = ("city", "road", "mountain", "stepthrough", "kids", "folding")
_WHEEL = {"city": (0.33, 0.35), "road": (0.33, 0.345), "mountain": (0.33, 0.37), "stepthrough": (0.33, 0.35),
          "kids": (0.22, 0.28), "folding": (0.20, 0.24)}  # fmt: skip
_TYRE = {"city": (0.016, 0.024), "road": (0.0125, 0.016), "mountain": (0.025, 0.035), "stepthrough": (0.016, 0.024),
         "kids": (0.02, 0.026), "folding": (0.018, 0.024)}  # fmt: skip


@dataclass(frozen=True, slots=True)
class BicycleFrame:
    """Points of the frame in the plane of symmetry (x, 0, z), metres, rear axle at x = 0, and unit vectors.

    Args:
        rear, front: axles. bottom: bottom bracket. seat: top of the seat tube. head_top, head_low: head tube.
        saddle: middle of the saddle. stem: where the handle bar is clamped.
    """

    rear: Float64
    front: Float64
    bottom: Float64
    seat: Float64
    head_top: Float64
    head_low: Float64
    saddle: Float64
    stem: Float64


def draw_frame(kind: str, wheel: float, rng: np.random.Generator) -> BicycleFrame:
    """Geometry from chainstay .405-.48 m, head angle 63-74, seat angle 64-76 degrees, fork offset 35-55 mm."""
    small = kind in ("kids", "folding")
    chainstay = rng.uniform(0.36, 0.42) if small else rng.uniform(0.41, 0.47)
    head = math.radians(rng.uniform(66, 73))
    seat_angle = math.radians(rng.uniform(68, 75))
    offset = rng.uniform(0.035, 0.055)
    wheelbase = rng.uniform(0.80, 1.0) if small else rng.uniform(0.98, 1.10)
    rear, front = np.array([0, 0, wheel]), np.array([wheelbase, 0, wheel])
    drop = rng.uniform(-0.02, 0.02) if small else rng.uniform(0.04, 0.075)
    bottom = np.array([math.sqrt(chainstay**2 - drop**2), 0, wheel - drop])
    up_seat = np.array([-math.cos(seat_angle), 0, math.sin(seat_angle)])
    up_head = np.array([-math.cos(head), 0, math.sin(head)])
    tube_length = {"kids": 0.28, "folding": 0.30}.get(kind, rng.uniform(0.44, 0.58))
    seat = bottom + tube_length * up_seat
    axis = front - offset * np.array([math.sin(head), 0, math.cos(head)])
    head_low = axis + (wheel + rng.uniform(0.06, 0.10)) * up_head
    head_top = head_low + (0.12 if small else rng.uniform(0.12, 0.20)) * up_head
    if kind == "folding":
        head_top = head_top + 0.15 * up_head
    saddle_height = {"kids": (0.62, 0.75), "folding": (0.85, 0.98)}.get(kind, (0.88, 1.04))
    saddle = seat + up_seat * max(0.05, rng.uniform(*saddle_height) - seat[2]) / up_seat[2]
    rise = {"road": (0.02, 0.05), "mountain": (0.04, 0.08)}.get(kind, (0.10, 0.22))
    stem = head_top + rng.uniform(*rise) * up_head
    return BicycleFrame(rear, front, bottom, seat, head_top, head_low, saddle, stem)


def _wheel(center: Float64, radius: float, tyre: float) -> list[Part]:
    """Tyre, rim, hub and a few spokes."""
    parts = [torus(center, radius - tyre, tyre, 36, 8)]
    rim = radius - 2.2 * tyre
    parts.append(lathe(center, [(rim, 0.011), (rim - 0.018, 0.004), (rim - 0.018, -0.004), (rim, -0.011)], 36))
    parts.append(lathe(center, [(0.018, 0.045), (0.03, 0.03), (0.016, 0), (0.03, -0.03), (0.018, -0.045)], 10))
    for number in range(18):
        angle = 2 * math.pi * number / 18
        side = 0.03 if number % 2 else -0.03
        out = np.array([math.cos(angle), 0, math.sin(angle)])
        parts.append(tube([center + 0.02 * out + vec(0, side, 0), center + (rim - 0.01) * out], 0.0015, 3))
    return parts


def _bars(kind: str, stem: Float64, rng: np.random.Generator) -> tuple[list[Part], Float64]:
    """Handle bar and both grips [2, 3]."""
    half = {"road": 0.21, "kids": 0.26}.get(kind, rng.uniform(0.27, 0.37))
    reach = np.array([0.07 if kind == "road" else 0.05, 0, 0.02])
    if kind == "road":
        side = curve(
            [stem + reach, stem + reach + vec(0, half, 0), stem + reach + vec(0.09, half, -0.01),
             stem + reach + vec(0.10, half, -0.08), stem + reach + vec(0.0, half, -0.13)], 14
        )  # fmt: skip
        grip = stem + reach + vec(0.09, half, 0.01)
    else:
        back = 0.03 if kind == "mountain" else rng.uniform(0.08, 0.22)
        side = curve(
            [
                stem + reach,
                stem + reach + vec(0.02, 0.35 * half, 0.03),
                stem + reach + vec(-0.3 * back, 0.75 * half, 0.04),
                stem + reach + vec(-back, half, 0.03),
            ],
            12,
        )
        grip = side[-2]
    part = tube(side, 0.014, 7)
    parts = [part, mirrored(part), tube([stem - vec(0.0, 0, 0.03), stem + reach], 0.015, 6)]
    return parts, np.stack([grip, grip * np.array([1, -1, 1])])


def _cranks(frame: BicycleFrame, angle: float) -> tuple[list[Part], Float64]:
    """Chain ring, both cranks and pedals; returns the upper sides of the pedals [2, 3] too."""
    bottom = frame.bottom
    ring = lathe(bottom + vec(0, -0.045, 0), [(0.02, 0), (0.09, 0.004), (0.09, -0.004), (0.02, -0.004)], 20)
    parts, treads = [ring], []
    for sign in (1.0, -1.0):
        out = 0.17 * sign * np.array([math.cos(angle), 0, math.sin(angle)])
        start = bottom + vec(0, 0.055 * sign, 0)
        end = start + out + vec(0, 0.02 * sign, 0)
        parts.append(tube([start, end], 0.012, 6))
        parts.append(box(end + vec(0, 0.055 * sign, 0), (0.09, 0.09, 0.025)))
        treads.append(end + vec(0, 0.055 * sign, 0.0125))
    return parts, np.stack(treads)


def _tubes(kind: str, frame: BicycleFrame, rng: np.random.Generator) -> list[Part]:
    """Main triangle, stays and fork."""
    thick = rng.uniform(0.014, 0.024)
    lower = frame.head_low + 0.25 * (frame.head_top - frame.head_low)
    upper = frame.head_top - 0.2 * (frame.head_top - frame.head_low)
    parts = [
        tube([frame.head_low, frame.head_top], 0.02, 8),
        tube([frame.head_top, frame.stem], 0.014, 8),
        tube([frame.bottom, frame.saddle], [0.017, 0.014], 8),
    ]
    if kind in ("stepthrough", "folding"):
        seat_low = frame.bottom + 0.35 * (frame.seat - frame.bottom)
        bend = (lower + frame.bottom) / 2 - vec(0.0, 0, 0.06)
        parts.append(tube(curve([lower, bend, frame.bottom], 8), 1.3 * thick, 8))
        if kind == "stepthrough":
            parts.append(tube(curve([upper, bend + vec(0.02, 0, 0.13), seat_low], 8), thick, 8))
    else:
        top = frame.seat - (0.05 if kind != "mountain" else rng.uniform(0.05, 0.15)) * np.array([-0.3, 0, 0.95])
        parts += [tube([lower, frame.bottom], 1.15 * thick, 8), tube([upper, top], thick, 8)]
    for sign in (1.0, -1.0):
        drop = frame.rear + vec(0, 0.065 * sign, 0)
        parts.append(tube([frame.bottom + vec(0, 0.03 * sign, 0), drop], 0.009, 6))
        parts.append(tube([frame.seat + vec(0, 0.02 * sign, -0.03), drop], 0.008, 6))
        crown = frame.head_low + vec(0, 0.05 * sign, -0.01)
        parts.append(tube([frame.head_low, crown, frame.front + vec(0, 0.05 * sign, 0)], [0.014, 0.014, 0.009], 6))
    return parts


def _extras(kind: str, frame: BicycleFrame, wheel: float, rng: np.random.Generator) -> list[Part]:
    """Mudguards, rack, basket or bag, as the kind usually has them."""
    parts: list[Part] = []
    city = kind in ("city", "stepthrough", "folding")
    if city and rng.random() < 0.8:
        for center, first, last in ((frame.rear, 15, 175), (frame.front, 40, 170)):
            angle = np.radians(np.linspace(first, last, 14))
            arc = center + (wheel + 0.02) * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
            edges = np.stack([arc + vec(0, 0.027, -0.006), arc, arc - vec(0, 0.027, 0.006)], axis=1)
            index = np.arange(13)[:, None] * 3 + np.arange(2)
            a = index.ravel()
            parts.append((edges.reshape(-1, 3), np.concatenate([np.stack([a, a + 1, a + 3], 1),
                                                               np.stack([a + 1, a + 4, a + 3], 1)])))  # fmt: skip
    if city and rng.random() < 0.6:
        rack = frame.rear + vec(-0.05, 0, wheel + 0.06)
        parts.append(box(rack, (0.36, 0.12, 0.015)))
        parts += [tube([rack + vec(0.05, 0.06 * s, 0), frame.rear + vec(0, 0.06 * s, 0)], 0.006, 5) for s in (1, -1)]
        if rng.random() < 0.3:
            parts.append(box(rack + vec(0, rng.choice([-1, 1]) * 0.13, -0.15), (0.32, 0.13, 0.3)))
    if city and rng.random() < 0.25:
        parts.append(superellipsoid(frame.stem + vec(0.22, 0, -0.02), (0.15, 0.18, 0.13), (0.3, 0.3), steps=(12, 7)))
    return parts


def bicycle(rng: np.random.Generator) -> tuple[list[Part], Contacts]:
    """A random bicycle and the places of its rider; x forward, ground z = 0, not centred."""
    kind = str(rng.choice(_KINDS, p=[0.3, 0.2, 0.2, 0.12, 0.1, 0.08]))
    wheel = float(rng.uniform(*_WHEEL[kind]))
    frame = draw_frame(kind, wheel, rng)
    tyre = float(rng.uniform(*_TYRE[kind]))
    steering = rng.normal(0, 0.12)
    bars, grips = _bars(kind, frame.stem, rng)
    front = _wheel(frame.front, wheel, tyre) + bars
    axis = (frame.head_top - frame.head_low) / np.linalg.norm(frame.head_top - frame.head_low)
    turn = _about(axis, steering)
    turned = [((v - frame.head_low) @ turn.T + frame.head_low, f) for v, f in front]
    grips = (grips - frame.head_low) @ turn.T + frame.head_low
    cranks, treads = _cranks(frame, rng.uniform(0, 2 * math.pi))
    saddle = [
        superellipsoid(frame.saddle - vec(0.04, 0, 0), (0.10, 0.075, 0.03), (0.8, 0.9), steps=(12, 7)),
        superellipsoid(frame.saddle + vec(0.07, 0, 0), (0.10, 0.025, 0.025), (0.8, 0.9), steps=(10, 7)),
    ]
    parts = _wheel(frame.rear, wheel, tyre) + turned + _tubes(kind, frame, rng) + cranks + saddle
    parts += _extras(kind, frame, wheel, rng)
    reach = rng.uniform(0.86, 0.93) if kind == "road" else rng.uniform(0.88, 0.97)
    return parts, Contacts(frame.saddle + vec(-0.04, 0, 0.03), grips, treads, True, float(reach))


def _about(axis: Float64, angle_rad: float) -> Float64:
    """Rotation about a unit vector (Rodrigues), float64 [3, 3]."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn: Float64 = np.eye(3) + math.sin(angle_rad) * cross + (1 - math.cos(angle_rad)) * cross @ cross
    return turn
