# SPDX-License-Identifier: Apache-2.0
"""Live frames of two emulated radars with their cards: numbers, times, losses of all kinds, outages, accounts."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from card_rig import CardRig, slow_pair

from edge.errors import ConfigError, LinkError
from edge.frames import RADARS, LossCause, RadarFrame, RadarId
from edge.rig import Rig
from edge.sources.base import FrameSource, Loss
from edge.sources.live_cards import CardSource
from edge.sources.pairing import FramePairer
from train.simulate.faults import Faults

PERIOD_S = 0.1


def collect(source: CardSource) -> dict[RadarId, list[RadarFrame | Loss]]:
    """All items by radar; in order of time over both."""
    found: dict[RadarId, list[RadarFrame | Loss]] = {radar: [] for radar in RADARS}
    for item in source:
        assert isinstance(item, RadarFrame | Loss)
        found[item.radar].append(item)
    return found


def numbers(items: list[RadarFrame | Loss]) -> list[int]:
    """Numbers of frames and losses, each as often as it was given."""
    spans = [range(i.number, i.number + (i.count if isinstance(i, Loss) else 1)) for i in items]
    return list(itertools.chain.from_iterable(spans))


def times(items: list[RadarFrame | Loss]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([i.t_ns if isinstance(i, Loss) else i.t_first_chirp_ns for i in items], dtype=np.float64)


def test_a_pair_without_faults(tmp_path: Path) -> None:
    """Twelve pairs, equal numbers, no loss, half a period apart; what arrived is what the radars sent."""
    with CardRig(slow_pair(PERIOD_S), tmp_path) as cards:
        before_ns = time.monotonic_ns()
        said: list[str] = []
        source = CardSource(cards.ready().rig, cards.drivers, frames=12, say=said.append)
        assert isinstance(source, FrameSource)
        assert source.total_frames == 24
        pairer, order, pairs = FramePairer(RADARS), [], 0
        items: dict[RadarId, list[RadarFrame | Loss]] = {radar: [] for radar in RADARS}
        for item in source:
            assert isinstance(item, RadarFrame)
            order.append(item.t_first_chirp_ns)
            items[item.radar].append(item)
            done, losses = pairer.add(item)
            assert losses == []
            pairs += len(done)
        assert order == sorted(order)
        assert pairs == 12
        assert before_ns < order[0] < order[-1] < time.monotonic_ns()
        for radar in RADARS:
            assert numbers(items[radar]) == list(range(12))
            truth = [cards.supply(radar, k).adc for k in range(3)]
            shown = [next(k for k in range(3) if np.array_equal(truth[k], f.adc)) for f in items[radar]]  # type: ignore[union-attr]
            assert shown == [(shown[0] + k) % 3 for k in range(12)]
            assert np.ptp(np.diff(times(items[radar]))) < 1e9 * PERIOD_S / 2
        offset = (times(items["vertical"]) - times(items["horizontal"])) / (1e9 * PERIOD_S)
        assert np.all(np.abs(offset - 0.5) < 0.4)
        assert "offset" in said[0]
        assert cards.violations() == []
        assert source.alone["vertical"] == 0
        assert source.reception()["vertical"].endswith("frames whole")
        for driver in cards.drivers.values():
            assert driver.receiver is not None
            counters = driver.receiver.counters()
            counters.account.check()
            assert (counters.account.missing_bytes, counters.kernel_drops, counters.overflow_frames) == (0, 0, 0)


@pytest.mark.parametrize("kind", ["drop", "reorder", "duplicate", "garble", "truncate", "delay", "babble"])
def test_packets_that_go_wrong(tmp_path: Path, kind: str) -> None:
    """Each number comes once for each radar, as a frame or as a loss; a frame is whole or it is none."""
    faults = Faults(seed=3)
    with CardRig(slow_pair(PERIOD_S), tmp_path, faults) as cards:
        cards.ready()
        value = {"garble": 200, "truncate": 700, "delay": 0.01, "babble": 900}.get(kind)
        faults.set(kind, "vertical/data", share=0.01, skip=200, value=value)
        source = CardSource(cards.rig, cards.drivers, frames=15)
        items = collect(source)
        for radar in RADARS:
            assert numbers(items[radar]) == list(range(15))
            assert np.all(np.diff(times(items[radar])) > 0)
            truth = {cards.supply(radar, k).adc.tobytes() for k in range(3)}
            frames = [item.adc.tobytes() in truth for item in items[radar] if isinstance(item, RadarFrame)]
            assert all(frames) or kind == "garble", "flipped sample bits cannot be seen"
        assert all(isinstance(item, RadarFrame) for item in items["horizontal"])
        losses = [item for item in items["vertical"] if isinstance(item, Loss)]
        assert {loss.cause for loss in losses} <= {LossCause.TRUNCATED}
        if kind in ("drop", "truncate", "babble"):
            assert losses
            assert "of 139776 bytes missing" in losses[0].detail
            assert "of 48 chirps whole" in losses[0].detail
        if kind in ("reorder", "duplicate"):
            assert losses == []
        receiver = cards.drivers["vertical"].receiver
        assert receiver is not None
        account = receiver.counters().account
        account.check()
        counted = {"duplicate": account.duplicate_packets, "reorder": account.reordered_packets}
        assert counted.get(kind, 1) > 0
        assert cards.violations() == []


def test_frames_with_few_missing_bytes_may_be_kept(tmp_path: Path) -> None:
    faults = Faults()
    with CardRig(slow_pair(PERIOD_S, ("horizontal",)), tmp_path, faults) as cards:
        cards.ready()
        faults.set("drop", "horizontal/data", times=1, skip=150)
        source = CardSource(cards.rig, cards.drivers, frames=4, keep_missing_share=0.02)
        items = collect(source)["horizontal"]
        assert all(isinstance(item, RadarFrame) for item in items)
        assert source.repaired == {"horizontal": 1}
        zeros = [int((item.adc.view(np.int64) == 0).sum()) for item in items if isinstance(item, RadarFrame)]
        assert sorted(zeros)[-1] >= 1456 // 8


def test_whole_frames_missing(tmp_path: Path) -> None:
    """Two frames' packets vanish: one loss of two numbers, the numbering goes on."""
    faults = Faults()
    with CardRig(slow_pair(PERIOD_S, ("vertical",)), tmp_path, faults) as cards:
        cards.ready()
        faults.set("drop", "vertical/data", skip=96 * 3, times=96 * 2)
        source = CardSource(cards.rig, cards.drivers, frames=8)
        assert source.total_frames == 8
        items = collect(source)["vertical"]
        assert numbers(items) == list(range(8))
        losses = [item for item in items if isinstance(item, Loss)]
        assert {loss.cause for loss in losses} == {LossCause.GAP}
        assert sum(loss.count for loss in losses) == 2
        assert numbers(list(losses)) == [3, 4]


def test_slow_reader(tmp_path: Path) -> None:
    """Who takes nothing loses the oldest frames, counted; the newest are there."""
    with CardRig(slow_pair(0.03, ("vertical",)), tmp_path) as cards:
        for driver in cards.drivers.values():
            driver._keep = 4
        source = CardSource(cards.ready().rig, cards.drivers, frames=30)
        items: list[RadarFrame | Loss] = []
        for item in source:
            assert isinstance(item, RadarFrame | Loss)
            items.append(item)
            if len(items) == 3:
                time.sleep(0.6)
        assert numbers(items) == list(range(30))
        lost = [item for item in items if isinstance(item, Loss)]
        assert {loss.cause for loss in lost} == {LossCause.OVERFLOW}
        receiver = cards.drivers["vertical"].receiver
        assert receiver is not None
        assert sum(loss.count for loss in lost) <= receiver.counters().overflow_frames


def test_outage_is_overcome(tmp_path: Path) -> None:
    """One radar resets itself in the middle: both are set up anew, the numbers of the outage are left out."""
    said: list[str] = []
    with CardRig(slow_pair(0.05), tmp_path, card={"flush_s": 0.6}) as cards:
        source = CardSource(cards.ready().rig, cards.drivers, frames=200, say=said.append)
        items: dict[RadarId, list[RadarFrame | Loss]] = {radar: [] for radar in RADARS}
        for item in source:
            assert isinstance(item, RadarFrame | Loss)
            items[item.radar].append(item)
            if len(items["vertical"]) == 5:
                cards.virtual.radars["vertical"].reset()
            if source.restarts and isinstance(item, RadarFrame) and isinstance(items[item.radar][-5], RadarFrame):
                source.close()
        assert source.restarts >= 1
        assert any("restart 1 of 3 after: vertical radar stopped sending" in text for text in said)
        for radar in RADARS:
            assert numbers(items[radar]) == list(range(len(numbers(items[radar]))))
            assert np.all(np.diff(times(items[radar])) > 0)
            losses = [item for item in items[radar] if isinstance(item, Loss)]
            assert {loss.cause for loss in losses} == {LossCause.GAP}
            assert sum(loss.count for loss in losses) >= 2


def test_dead_board_ends_the_source(tmp_path: Path) -> None:
    with CardRig(slow_pair(0.05, ("horizontal",)), tmp_path) as cards:
        source = CardSource(cards.ready().rig, cards.drivers, retries=0)
        iterator = iter(source)
        next(iterator)
        cards.virtual.unplug("horizontal")
        with pytest.raises(LinkError, match="no samples of the horizontal radar"):
            for _ in iterator:
                pass


def test_started_anew_without_a_hole(tmp_path: Path) -> None:
    """When drift would close the guard both radars are started again; every number still comes from both."""

    class Due:
        overlap, last, fired = False, None, 0

        def add(self, radar: RadarId, number: int, t_ns: int) -> None:
            self.newest = number

        def restarted(self, radar: RadarId) -> None: ...

        def measure(self) -> None: ...

        @property
        def rearm_due(self) -> bool:
            self.fired += self.newest >= 8 and not self.fired
            return self.fired == 1 and bool(self.__dict__.setdefault("once", [1]) and self.once.pop())  # type: ignore[attr-defined]

    with CardRig(slow_pair(PERIOD_S), tmp_path) as cards:
        source = CardSource(cards.ready().rig, cards.drivers, frames=30)
        assert source.watch is not None
        source.watch = Due()  # type: ignore[assignment]
        items = collect(source)
        assert source.rearms == 1
        for radar in RADARS:
            assert numbers(items[radar]) == list(range(30))
            assert all(isinstance(item, RadarFrame) for item in items[radar])
            assert np.all(np.diff(times(items[radar])) > 0)
        assert cards.violations() == []


def test_poses_come_between(tmp_path: Path) -> None:
    pose = SimpleNamespace(t_ns=5)
    feed = SimpleNamespace(take=lambda: [pose])
    with CardRig(slow_pair(PERIOD_S, ("vertical",)), tmp_path) as cards:
        source = CardSource(cards.ready().rig, cards.drivers, frames=2, poses=feed)  # type: ignore[arg-type]
        items = list(source)
        assert pose in items
        assert len([item for item in items if isinstance(item, RadarFrame)]) == 2


def test_stopped_from_outside(tmp_path: Path) -> None:
    with CardRig(slow_pair(PERIOD_S, ("vertical",)), tmp_path) as cards:
        count: list[int] = []
        source = CardSource(cards.ready().rig, cards.drivers, stopped=lambda: len(count) >= 3)
        assert source.total_frames is None
        for item in source:
            count.append(item.number)  # type: ignore[union-attr]
        assert count == [0, 1, 2]
        assert not cards.virtual.radars["vertical"].streaming


def test_wrong_drivers(tmp_path: Path) -> None:
    rig: Rig = slow_pair(PERIOD_S)
    with pytest.raises(ConfigError, match="drivers are not those of the rig"):
        CardSource(rig, {})
