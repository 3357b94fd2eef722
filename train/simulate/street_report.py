# SPDX-License-Identifier: Apache-2.0
"""What the showcase says at its end: which road user every object is, how near its shape comes, who was missed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edge.accounting import LedgerSnapshot
from edge.best_shapes import class_text
from edge.frames import Float32, LossCause, Shape
from edge.pipeline import FrameResult, WindowResult
from train.nearest import nearest_distance, nearest_index
from train.simulate.street import Street

TRUTH_POINTS = 16_384
"""Of every user's true surface, as many as a fine shape has."""
GHOST_M = 0.5
"""An object whose radar points are farther from every user, on average, is none of them."""
MERGED_SHARE = 0.2
"""A second user to whom at least this share of an object's points belongs is in it too."""


def busy_note(accounts: Iterable[LedgerSnapshot], most: float) -> str:
    """What to say when frames were left out because the machine was too busy.

    Args:
        accounts: of every radar.
        most: share of the frames that may be lost without a word.
    Returns:
        One sentence; empty: there is nothing to say.
    """
    accounts = list(accounts)
    frames = sum(account.frames_in for account in accounts)
    left = sum(account.lost.get(cause, 0) for account in accounts for cause in (LossCause.OVERFLOW, LossCause.SHED))
    if left <= most * frames:
        return ""
    return (
        f"DEGRADED: {left} of {frames} frames were left out (overflow, shed), because the pipeline had too little of "
        "this machine: end other work, or --rig cascade_demo, which needs a third"
    )


class ShapeLog:
    """A sink that keeps what an object gave when it left, how many shapes it had before, and how far the drive came.

    Attributes:
        final: of every object that left, in that order; the same identity again when it was found again.
        counts: identity -> shapes, the final ones included.
        seen_s: identity -> how long it was in view.
        t_ns: instant of the newest frame; None: there was none.
    """

    def __init__(self) -> None:
        self.final: list[Shape] = []
        self.counts: dict[int, int] = {}
        self.seen_s: dict[int, float] = {}
        self.t_ns: int | None = None

    def frame(self, result: FrameResult) -> None:
        """Note how far the drive came."""
        self.t_ns = result.t_ns

    def window(self, result: WindowResult) -> None:
        """Shapes come by themselves."""

    def shape(self, shape: Shape) -> None:
        """Count it, keep a final one."""
        identity = shape.identity
        self.counts[identity] = self.counts.get(identity, 0) + 1
        self.seen_s[identity] = max(self.seen_s.get(identity, 0.0), shape.input.age_s)
        if shape.input.final:
            self.final.append(shape)


@dataclass(frozen=True, slots=True)
class Finding:
    """One object beside the truth.

    Args:
        shape: its final one.
        users: indices into ``Street.users`` of those whose points it holds, most points first; empty: a ghost.
        nearest: the user whose surface its points are nearest to.
        away_m: mean distance of its points from that surface.
        truth_m: float32 [n, 3], that surface in the object's frame.
        shape_cm, input_cm: Chamfer distance (mean of both directions, unsquared) of fine shape and radar points.
        shapes: that were made of the object.
        seen_s: how long it was in view.
    """

    shape: Shape
    users: tuple[int, ...]
    nearest: int
    away_m: float
    truth_m: Float32
    shape_cm: float
    input_cm: float
    shapes: int
    seen_s: float


def find(street: Street, log: ShapeLog, shift_ns: int, seed: int = 0) -> list[Finding]:
    """Every object that left the view beside the nearest user.

    Args:
        street: the truth.
        log: of the run.
        shift_ns: by which the instants of the results are later than those of the street.
        seed: of the points on the true surfaces.
    """
    rng = np.random.default_rng((seed, 7))
    world = [user.points_m(TRUTH_POINTS, rng) for user in street.users]
    own = [
        ((points - user.placed.position_m) @ user.placed.rotation).astype(np.float32)
        for points, user in zip(world, street.users, strict=True)
    ]
    return [_finding(street, shape, own, log, shift_ns) for shape in log.final]


def _finding(street: Street, shape: Shape, own: Sequence[Float32], log: ShapeLog, shift_ns: int) -> Finding:
    seen = shape.input
    span = replace(seen, t_start_ns=seen.t_start_ns - shift_ns, t_end_ns=seen.t_end_ns - shift_ns)
    truths = []
    for number, points in enumerate(own):
        rotation, translation_m = street.truth_in_frame(number, span, span.pose)
        truths.append((points @ rotation.T + translation_m).astype(np.float32))
    away_m = np.stack([nearest_distance(seen.xyz_m, truth) for truth in truths])
    nearest = int(np.argmin(away_m.mean(axis=1)))
    shares = np.bincount(np.argmin(away_m, axis=0), minlength=len(own)) / len(seen)
    users = [int(n) for n in np.argsort(-shares) if shares[n] >= MERGED_SHARE]
    ghost = away_m[nearest].mean() > GHOST_M and away_m.min(axis=0).mean() > GHOST_M
    return Finding(
        shape=shape,
        users=() if ghost else tuple(users),
        nearest=nearest,
        away_m=float(away_m[nearest].mean()),
        truth_m=truths[nearest],
        shape_cm=100.0 * chamfer_m(shape.fine_m, truths[nearest]),
        input_cm=100.0 * chamfer_m(seen.xyz_m, truths[nearest]),
        shapes=log.counts[shape.identity],
        seen_s=log.seen_s[shape.identity],
    )


def chamfer_m(a_m: Float32, b_m: Float32) -> float:
    """CD-L1 as ``edge.reference.chamfer`` defines it, by a search that is fast enough for 16 384 points."""
    there = nearest_distance(a_m, b_m).mean()
    back = np.linalg.norm(b_m.astype(np.float64) - a_m[nearest_index(b_m, a_m)], axis=1).mean()
    return float(0.5 * (there + back))


def verdicts(street: Street, findings: Sequence[Finding], x_m: float) -> list[str]:
    """One sentence for every user: found, split, found together with another, missed, or not passed.

    Args:
        street: users.
        findings: of ``find``.
        x_m: how far along the street the rig came.
    """
    lines = []
    for number, user in enumerate(street.users):
        mine = [one for one in findings if number in one.users]
        others = sorted({name(street, u) for one in mine for u in one.users if u != number})
        objects = " and ".join(str(one.shape.identity) for one in mine)
        if not mine:
            passed = x_m >= user.placed.position_m[0]
            text = "MISSED" if passed else f"not passed: the drive ended at {x_m:.1f} m"
        elif others:
            text = f"MERGED with {', '.join(others)} in object {objects}"
        elif len(mine) > 1:
            text = f"SPLIT into objects {objects}"
        else:
            text = f"found as object {objects}"
        lines.append(f"{name(street, number)}: {text}")
    return lines


def ghosts(street: Street, findings: Sequence[Finding]) -> list[str]:
    """One sentence for every object that is nobody."""
    return [
        f"object {one.shape.identity} is nobody: {one.away_m:.2f} m from the {name(street, one.nearest)} on average"
        for one in findings
        if not one.users
    ]


def name(street: Street, number: int) -> str:
    """What people call a user."""
    ref = street.users[number].ref
    return "cyclist" if ref.class_name == "bicycle" and ref.rider else ref.class_name


def lines(street: Street, findings: Sequence[Finding], x_m: float) -> list[str]:
    """Objects and users, for people."""
    head = f"{'object':<7}{'is the':<24}{'class':<27}{'conf.':>6}{'view s':>8}{'shapes':>8}{'points':>8}"
    text = [head + f"{'CD shape':>10}{'CD points':>11}"]
    for one in findings:
        known = " + ".join(name(street, user) for user in one.users) or "nobody (ghost)"
        text.append(
            f"{one.shape.identity:<7}{known:<24}{class_text(one.shape):<27}{one.shape.confidence:>6.2f}"
            f"{one.seen_s:>8.2f}{one.shapes:>8}{one.shape.input_points:>8}"
            f"{one.shape_cm:>7.1f} cm{one.input_cm:>8.1f} cm"
        )
    if findings:
        text.append("CD: Chamfer distance to the nearest user's true surface, of final shape and radar points")
    else:
        text.append("no object gave a shape")
    return [*text, "", *verdicts(street, findings, x_m), *ghosts(street, findings)]


def as_dict(street: Street, findings: Sequence[Finding], x_m: float) -> dict[str, Any]:
    """Objects and users, for machines."""
    return {
        "objects": [
            {
                "object": one.shape.identity,
                "users": [name(street, user) for user in one.users],
                "nearest": name(street, one.nearest),
                "away_m": round(one.away_m, 3),
                "class": one.shape.class_name,
                "confidence": one.shape.confidence,
                "age_s": round(one.seen_s, 3),
                "shapes": one.shapes,
                "points": one.shape.input_points,
                "shape_chamfer_cm": round(one.shape_cm, 2),
                "points_chamfer_cm": round(one.input_cm, 2),
            }
            for one in findings
        ],
        "users": verdicts(street, findings, x_m),
        "ghosts": ghosts(street, findings),
    }
