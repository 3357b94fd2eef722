# SPDX-License-Identifier: Apache-2.0
"""Reads a pose source until something holds; a test that would wait for ever fails instead."""

from __future__ import annotations

import time
from collections.abc import Callable

from edge.frames import Pose
from edge.odometry.source import PoseEvent, PoseSource

LIMIT_S = 60.0


class Collected:
    """What came out of a source."""

    def __init__(self) -> None:
        self.items: list[Pose | PoseEvent] = []

    @property
    def poses(self) -> list[Pose]:
        return [item for item in self.items if isinstance(item, Pose)]

    @property
    def events(self) -> list[PoseEvent]:
        return [item for item in self.items if isinstance(item, PoseEvent)]

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


def collect(source: PoseSource, until: Callable[[Collected], bool], into: Collected | None = None) -> Collected:
    """Poll until ``until``."""
    collected, deadline_s = into or Collected(), time.monotonic() + LIMIT_S
    while not until(collected):
        assert time.monotonic() < deadline_s, f"{source.health}, {collected.events}"
        collected.items += source.poll(0.05)
    return collected
