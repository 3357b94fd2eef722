# SPDX-License-Identifier: Apache-2.0
"""Identities of objects from window to window: nearest centres are the same object, an identity is never used twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.frames import Float64

NS_PER_S = 1_000_000_000


@dataclass(slots=True)
class _Track:
    center_m: Float64
    seen_ns: int
    first_ns: int


class IdentityKeeper:
    """Gives objects identities that last; windows may overlap or follow each other.

    Args:
        match_m: farthest that an object's centre may have moved since it was last seen.
        forget_s: an identity unseen for longer is retired; this bounds the memory.
    """

    def __init__(self, match_m: float, forget_s: float) -> None:
        self._match_m = match_m
        self._forget_ns = round(forget_s * NS_PER_S)
        self._tracks: dict[int, _Track] = {}
        self._next = 0
        self._last_ns = 0

    def __len__(self) -> int:
        return len(self._tracks)

    def update(self, centers_m: Float64, t_ns: int) -> list[int]:
        """Identities of one window's objects.

        One to one, the nearest pair first (global nearest neighbour by greed; equally near pairs: the older identity,
        then the earlier object). Identities of the window before come first: one that was lost takes no object from
        one that is still followed, as when two parts of a car have become one and lose a part again. What finds no
        partner gets a new identity.

        Args:
            centers_m: float64 [n, 2], on the ground plane of the odometry frame.
            t_ns: end of the window.
        Returns:
            One identity per object, in the order of ``centers_m``.
        """
        self._tracks = {
            identity: track for identity, track in self._tracks.items() if t_ns - track.seen_ns <= self._forget_ns
        }
        found, self._last_ns = self._match(centers_m), int(t_ns)
        identities = []
        for index, center_m in enumerate(centers_m):
            identity = found.get(index)
            if identity is None:
                identity, self._next = self._next, self._next + 1
            known = self._tracks.get(identity)
            first_ns = int(t_ns) if known is None else known.first_ns
            self._tracks[identity] = _Track(center_m.copy(), int(t_ns), first_ns)
            identities.append(identity)
        return identities

    def age_s(self, identity: int) -> float:
        """From the first to the last window in which an identity that is not forgotten was seen, end to end."""
        track = self._tracks[identity]
        return (track.seen_ns - track.first_ns) / NS_PER_S

    def _match(self, centers_m: Float64) -> dict[int, int]:
        """Object index -> identity for the pairs within reach."""
        if not self._tracks or not len(centers_m):
            return {}
        known = list(self._tracks)  # in order of age: identities are inserted ascending and keep their place
        tracked_m = np.array([track.center_m for track in self._tracks.values()])
        distance_m = np.linalg.norm(tracked_m[:, None] - centers_m[None], axis=2)
        pairs = np.argwhere(distance_m <= self._match_m)
        lost = np.array([track.seen_ns < self._last_ns for track in self._tracks.values()])
        order = np.lexsort((distance_m[pairs[:, 0], pairs[:, 1]], lost[pairs[:, 0]]))
        found: dict[int, int] = {}
        taken: set[int] = set()
        for track, index in pairs[order].tolist():
            if index not in found and track not in taken:
                found[index] = known[track]
                taken.add(track)
        return found
