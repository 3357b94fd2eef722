# SPDX-License-Identifier: Apache-2.0
"""Pairing: hand-worked sequences, and exact conservation under dropped, doubled, reordered and stalled frames."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.errors import CaptureError
from edge.frames import RADARS, Layout, LossCause, RadarFrame, RadarId
from edge.sources.base import Loss
from edge.sources.pairing import FramePair, FramePairer

LAYOUT = Layout("dca1000", 1, 1, 1, 2, 1)
ADC = np.zeros(LAYOUT.shape, np.int16)
PERIOD_NS = 16_666_667


def frame(radar: RadarId, number: int, t_ns: int | None = None) -> RadarFrame:
    offset = PERIOD_NS // 2 if radar == "vertical" else 0
    return RadarFrame(radar, number, number * PERIOD_NS + offset if t_ns is None else t_ns, ADC, LAYOUT)


def play(pairer: FramePairer, items: list[RadarFrame | Loss]) -> tuple[list[FramePair], list[Loss]]:
    pairs, losses = [], []
    for item in items:
        some, lost = pairer.add(item)
        pairs += some
        losses += lost
    return pairs, losses + pairer.flush()


def settle(pairer: FramePairer, pairs: list[FramePair]) -> None:
    """What the owner of the pairs owes."""
    for pair in pairs:
        for radar in pair.frames:
            pairer.ledgers[radar].ok()
    for ledger in pairer.ledgers.values():
        ledger.check()


def test_pairs_come_as_soon_as_they_are_complete() -> None:
    pairer = FramePairer(RADARS)
    assert pairer.add(frame("horizontal", 0)) == ([], [])
    (pair,), losses = pairer.add(frame("vertical", 0))
    assert losses == []
    assert (pair.number, pair.t_ns) == (0, 0)
    assert list(pair.frames) == ["horizontal", "vertical"]


def test_one_radar_passes_alone() -> None:
    pairer = FramePairer(["vertical"])
    pairs, losses = play(pairer, [frame("vertical", n) for n in (3, 4, 6)])
    assert [(p.number, p.horizontal, p.t_ns) for p in pairs] == [
        (n, None, n * PERIOD_NS + PERIOD_NS // 2) for n in (3, 4, 6)
    ]
    assert [(x.cause, x.number, x.count) for x in losses] == [(LossCause.GAP, 5, 1)]
    settle(pairer, pairs)
    assert pairer.ledgers["vertical"].snapshot().frames_in == 4


def test_missing_partner_is_known_when_the_other_radar_is_past_it() -> None:
    pairer = FramePairer(RADARS)
    for n in (0, 1):
        pairer.add(frame("horizontal", n))
    pairer.add(frame("vertical", 0))
    pairs, losses = pairer.add(frame("vertical", 2))
    assert pairs == []
    assert [(x.radar, x.number, x.cause) for x in losses] == [
        ("vertical", 1, LossCause.GAP),
        ("horizontal", 1, LossCause.UNPAIRED),
    ]
    (pair,), losses = pairer.add(frame("horizontal", 2))
    assert (pair.number, losses) == (2, [])


def test_backwards_time_loses_one_frame_and_its_partner() -> None:
    pairer = FramePairer(RADARS)
    items = [frame("horizontal", 0), frame("vertical", 0), frame("horizontal", 1, t_ns=-5), frame("vertical", 1)]
    items += [frame("horizontal", 2), frame("vertical", 2)]
    pairs, losses = play(pairer, items)
    assert [p.number for p in pairs] == [0, 2]
    assert [(x.radar, x.number, x.cause) for x in losses] == [
        ("horizontal", 1, LossCause.BACKWARDS_TIME),
        ("vertical", 1, LossCause.UNPAIRED),
    ]
    settle(pairer, pairs)


def test_a_time_stamp_from_the_future_does_not_lose_all_that_follow() -> None:
    pairer = FramePairer(["horizontal"])
    items = [frame("horizontal", n, 10**15 if n == 3 else None) for n in range(8)]
    pairs, losses = play(pairer, items)  # type: ignore[arg-type]
    assert [p.number for p in pairs] == [0, 1, 2, 3, 5, 6, 7]
    assert [x.number for x in losses] == [4]


def test_equal_time_stamps_and_duplicates_are_backwards() -> None:
    pairer = FramePairer(["horizontal"])
    pairs, losses = play(pairer, [frame("horizontal", 0, 7), frame("horizontal", 1, 7), frame("horizontal", 1, 9)])
    assert [p.number for p in pairs] == [0]
    assert [x.cause for x in losses] == [LossCause.BACKWARDS_TIME] * 2
    settle(pairer, pairs)
    assert pairer.ledgers["horizontal"].snapshot().frames_in == 3


def test_a_silent_radar_does_not_grow_the_queue() -> None:
    pairer = FramePairer(RADARS, depth=4)
    pairer.add(frame("vertical", 0))
    pairs, losses = pairer.add(frame("horizontal", 0))
    for n in range(1, 100):
        losses += pairer.add(frame("horizontal", n))[1]
        assert pairer.ledgers["horizontal"].snapshot().pending <= 5, "the pair and four that wait"
    assert [(x.radar, x.number, x.cause) for x in losses] == [
        ("horizontal", n, LossCause.UNPAIRED) for n in range(1, 96)
    ]
    assert len(pairer.flush()) == 4
    settle(pairer, pairs)


def test_losses_of_the_source_count_in_and_lost_and_unpair_the_partner() -> None:
    pairer = FramePairer(RADARS)
    cut = Loss("vertical", 1, LossCause.TRUNCATED, "cut", PERIOD_NS)
    items: list[Any] = [frame("horizontal", 0), frame("vertical", 0), frame("horizontal", 1), cut]
    pairs, losses = play(pairer, items)
    assert losses[0] is cut
    assert [(x.radar, x.cause) for x in losses[1:]] == [("horizontal", LossCause.UNPAIRED)]
    settle(pairer, pairs)
    assert pairer.ledgers["vertical"].snapshot().lost == {LossCause.TRUNCATED: 1}


def test_foreign_radar_is_refused() -> None:
    with pytest.raises(CaptureError, match="does not have"):
        FramePairer(["horizontal"]).add(frame("vertical", 0))
    with pytest.raises(CaptureError, match="paired"):
        FramePairer([])


@st.composite
def disturbed(draw: st.DrawFn) -> tuple[int, list[RadarFrame | Loss]]:
    """Two streams with drops, doubles, swaps, wrong times and losses of the source, interleaved anyhow."""
    streams: dict[RadarId, list[RadarFrame | Loss]] = {}
    for radar in RADARS:
        stream: list[RadarFrame | Loss] = []
        for number in range(draw(st.integers(0, 12))):
            fate = draw(st.sampled_from(["keep", "keep", "keep", "drop", "double", "swap", "loss", "early"]))
            if fate == "loss":
                stream.append(Loss(radar, number, LossCause.TRUNCATED, "", 0, draw(st.integers(1, 3))))
            elif fate != "drop":
                stream.append(frame(radar, number, -number if fate == "early" else None))
                if fate == "double":
                    stream.append(frame(radar, number))
                if fate == "swap" and len(stream) > 1:
                    stream[-1], stream[-2] = stream[-2], stream[-1]
        streams[radar] = stream
    order = draw(st.permutations([r for r in RADARS for _ in streams[r]]))
    iterators = {radar: iter(stream) for radar, stream in streams.items()}
    return draw(st.integers(1, 6)), [next(iterators[radar]) for radar in order]


@given(disturbed())
def test_every_frame_leaves_exactly_once(case: tuple[int, list[RadarFrame | Loss]]) -> None:
    depth, items = case
    pairer = FramePairer(RADARS, depth=depth)
    pairs, losses = play(pairer, items)
    for radar in RADARS:
        arrived = [x for x in items if isinstance(x, RadarFrame) and x.radar == radar]
        reported = [x for x in items if isinstance(x, Loss) and x.radar == radar]
        paired = [p.frames[radar] for p in pairs]
        lost = Counter(dict.fromkeys(LossCause, 0))
        for loss in losses:
            if loss.radar == radar:
                lost[loss.cause] += loss.count
        single = lost[LossCause.UNPAIRED] + lost[LossCause.BACKWARDS_TIME]
        assert len(paired) + single == len(arrived)
        assert len({id(f) for f in paired}) == len(paired)
        assert lost[LossCause.TRUNCATED] == sum(x.count for x in reported)
        snapshot = pairer.ledgers[radar].snapshot()
        assert snapshot.lost == +lost
        assert snapshot.frames_in == len(arrived) + lost[LossCause.TRUNCATED] + lost[LossCause.GAP]
        assert snapshot.pending == len(paired)
    numbers = [p.number for p in pairs]
    assert numbers == sorted(set(numbers))
    assert all(p.horizontal and p.vertical and p.horizontal.number == p.vertical.number == p.number for p in pairs)
    settle(pairer, pairs)


@given(st.sets(st.integers(0, 30)), st.sets(st.integers(0, 30)), st.randoms(use_true_random=False))
def test_with_drops_alone_the_pairs_are_the_common_numbers(h: set[int], v: set[int], random: Any) -> None:
    pairer = FramePairer(RADARS, depth=31)
    queues = {"horizontal": sorted(h), "vertical": sorted(v)}
    order = [radar for radar, numbers in queues.items() for _ in numbers]
    random.shuffle(order)
    pairs, _ = play(pairer, [frame(radar, queues[radar].pop(0)) for radar in order])  # type: ignore[arg-type]
    assert [p.number for p in pairs] == sorted(h & v)
    settle(pairer, pairs)
    for radar, numbers in (("horizontal", h), ("vertical", v)):
        span = max(numbers) - min(numbers) + 1 if numbers else 0
        assert pairer.ledgers[radar].snapshot().frames_in == span  # type: ignore[index]
