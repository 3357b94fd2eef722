# SPDX-License-Identifier: Apache-2.0
"""Pairing: hand-worked sequences, and exact conservation under dropped, doubled, reordered and stalled frames."""

from __future__ import annotations

from collections import Counter
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.errors import CaptureError
from edge.frames import RADARS, Layout, LossCause, RadarFrame, RadarId
from edge.sources import pairing
from edge.sources.base import Loss
from edge.sources.pairing import MAX_GAP_FRAMES, REFUSED_NUMBERS, FramePair, FramePairer

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


@pytest.mark.parametrize("absurd", [2**62, 10 + MAX_GAP_FRAMES])
def test_one_absurd_number_costs_one_frame(absurd: int) -> None:
    pairer = FramePairer(RADARS)
    items: list[RadarFrame | Loss] = []
    for n in range(20):
        t_ns = n * PERIOD_NS
        items += [frame("horizontal", absurd if n == 10 else n, t_ns), frame("vertical", n, t_ns + 1)]
    pairs, losses = play(pairer, items)
    assert [p.number for p in pairs] == [n for n in range(20) if n != 10]
    assert [(x.radar, x.cause, x.count) for x in losses] == [
        ("horizontal", LossCause.BACKWARDS_TIME, 1),
        ("horizontal", LossCause.GAP, 1),
        ("vertical", LossCause.UNPAIRED, 1),
    ]
    settle(pairer, pairs)
    assert pairer.ledgers["horizontal"].snapshot().frames_in == 21


def test_ten_minutes_without_frames_are_a_gap_and_more_a_new_numbering() -> None:
    pairer = FramePairer(["horizontal"])
    far = 2 * MAX_GAP_FRAMES + 1
    numbers = [0, MAX_GAP_FRAMES, *range(far, far + REFUSED_NUMBERS + 5)]
    pairs, losses = play(pairer, [frame("horizontal", n) for n in numbers])
    assert [p.number for p in pairs] == [0, MAX_GAP_FRAMES, *range(far + REFUSED_NUMBERS, far + REFUSED_NUMBERS + 5)]
    assert [(x.cause, x.count) for x in losses] == [
        (LossCause.GAP, MAX_GAP_FRAMES - 1),
        *[(LossCause.BACKWARDS_TIME, 1)] * REFUSED_NUMBERS,
    ]
    settle(pairer, pairs)


def test_after_a_reboot_of_both_boards_pairs_come_again() -> None:
    pairer, start = FramePairer(RADARS), 5000
    numbers = [*range(start, start + 100), *range(start)]
    items: list[RadarFrame | Loss] = []
    for k, n in enumerate(numbers[: 100 + 2 * REFUSED_NUMBERS]):
        t_ns = k * PERIOD_NS
        items += [frame("horizontal", n, t_ns), frame("vertical", n, t_ns + PERIOD_NS // 2)]
    pairs, losses = play(pairer, items)
    after = range(REFUSED_NUMBERS, 2 * REFUSED_NUMBERS)
    assert [p.number for p in pairs] == [*range(start, start + 100), *after]
    assert Counter((x.radar, x.cause) for x in losses) == dict.fromkeys(
        [(radar, LossCause.BACKWARDS_TIME) for radar in RADARS], REFUSED_NUMBERS
    )
    settle(pairer, pairs)


def test_after_a_reboot_nothing_old_is_paired_with_a_new_frame_of_its_number() -> None:
    pairer = FramePairer(RADARS)
    old = [frame("horizontal", n) for n in (3, 4)]
    repeated = [frame("horizontal", 0, 9 * PERIOD_NS)] * REFUSED_NUMBERS
    pairs, losses = play(pairer, [*old, *repeated, frame("horizontal", 3, 10 * PERIOD_NS), frame("vertical", 3)])
    (pair,) = pairs
    assert pair.t_ns == 10 * PERIOD_NS
    assert [x.number for x in losses if x.cause is LossCause.UNPAIRED] == [3, 4]
    settle(pairer, pairs)


def test_a_loss_far_ahead_moves_nothing() -> None:
    pairer = FramePairer(["horizontal"])
    absurd = Loss("horizontal", 2**62, LossCause.TRUNCATED, "", 0, 2)
    pairs, losses = play(pairer, [frame("horizontal", 0), absurd, frame("horizontal", 1)])
    assert [p.number for p in pairs] == [0, 1]
    assert losses == [absurd]
    settle(pairer, pairs)


def test_foreign_radar_is_refused() -> None:
    with pytest.raises(CaptureError, match="does not have"):
        FramePairer(["horizontal"]).add(frame("vertical", 0))
    with pytest.raises(CaptureError, match="paired"):
        FramePairer([])


@st.composite
def disturbed(draw: st.DrawFn) -> tuple[int, list[RadarFrame | Loss]]:
    """Two streams with drops, doubles, swaps, wrong times and numbers, reboots and losses, interleaved anyhow."""
    streams: dict[RadarId, list[RadarFrame | Loss]] = {}
    for radar in RADARS:
        stream: list[RadarFrame | Loss] = []
        for number in range(draw(st.integers(0, 12))):
            fate = draw(st.sampled_from(["keep", "keep", "keep", "drop", "double", "swap", "loss", "early", "absurd"]))
            if fate == "loss":
                stream.append(Loss(radar, number, LossCause.TRUNCATED, "", 0, draw(st.integers(1, 3))))
            elif fate != "drop":
                stream.append(frame(radar, number, -number if fate == "early" else None))
                if fate == "absurd":
                    stream.append(frame(radar, draw(st.sampled_from([2**62, number + MAX_GAP_FRAMES + 13]))))
                if fate == "double":
                    stream.append(frame(radar, number))
                if fate == "swap" and len(stream) > 1:
                    stream[-1], stream[-2] = stream[-2], stream[-1]
        streams[radar] = stream
        if draw(st.booleans()):
            reboot_ns = 20 * PERIOD_NS
            stream += [frame(radar, n, reboot_ns + n * PERIOD_NS) for n in range(draw(st.integers(0, 12)))]
    order = draw(st.permutations([r for r in RADARS for _ in streams[r]]))
    iterators = {radar: iter(stream) for radar, stream in streams.items()}
    return draw(st.integers(1, 6)), [next(iterators[radar]) for radar in order]


@given(disturbed(), st.sampled_from([1, 3, 100]))
def test_every_frame_leaves_exactly_once(case: tuple[int, list[RadarFrame | Loss]], refused: int) -> None:
    depth, items = case
    pairer = FramePairer(RADARS, depth=depth)
    with mock.patch.object(pairing, "REFUSED_NUMBERS", refused):
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
    assert refused < 100 or numbers == sorted(set(numbers)), "ascending while the numbering is not restarted"
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
