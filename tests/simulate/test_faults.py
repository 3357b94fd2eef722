# SPDX-License-Identifier: Apache-2.0
"""Fault rules: counting, patterns, repetition by seed, bad values; the channel; calls that are due later."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from edge.errors import ConfigError
from train.simulate.faults import Fault, Faults, FaultyChannel, garble
from train.simulate.threads import Bursts, Later, wait_until

SAFETY_S = 20.0


def test_skip_times_and_pattern() -> None:
    faults = Faults()
    faults.set("drop", "*/data", skip=2, times=3)
    hits = [bool(faults.hit(Fault.DROP, "vertical/data")) for _ in range(7)]
    assert hits == [False, False, True, True, True, False, False]
    assert faults.hit(Fault.DROP, "vertical/command") is None
    assert faults.hit(Fault.DELAY, "vertical/data") is None
    assert faults.struck == {(Fault.DROP, "vertical/data"): 3}
    assert not faults.quiet("vertical/data")
    assert faults.quiet("pose")


def test_share_is_a_probability_and_repeats() -> None:
    def run(seed: int, other_first: bool) -> list[bool]:
        faults = Faults(seed)
        faults.set(Fault.DROP, "*", share=0.3)
        if other_first:
            for _ in range(100):
                faults.hit(Fault.DROP, "elsewhere")
        return [bool(faults.hit(Fault.DROP, "here")) for _ in range(2000)]

    first = run(1, False)
    assert first == run(1, True), "what another channel does changes nothing"
    assert first != run(2, False)
    assert np.mean(first) == pytest.approx(0.3, abs=4 * np.sqrt(0.21 / 2000))


def test_keys() -> None:
    faults = Faults()
    faults.set("nack", "x", value=0x31)
    assert faults.hit(Fault.NACK, "x", 0x12) is None
    assert faults.hit(Fault.NACK, "x", 0x31) is not None
    faults.set("nack", "x")
    assert faults.hit(Fault.NACK, "x", 0x12) is not None, "-1: any"


def test_clear_and_list() -> None:
    faults = Faults()
    faults.set("drop", "a")
    faults.set("drop", "b", share=0.5, times=2)
    faults.set("delay", "a", value=0.1)
    assert faults.rules()[1] == "drop b share=0.5 times=2 skip=0 value=0"
    assert faults.clear("drop", "a") == 1
    assert faults.clear(where="a") == 1
    assert faults.clear() == 1
    assert faults.rules() == []


@pytest.mark.parametrize(
    "changes",
    [{"fault": "melt"}, {"share": 1.5}, {"share": float("nan")}, {"times": 0}, {"skip": -1}, {"value": 10**9}],
)
def test_bad_rules(changes: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        Faults().set(**{"fault": "delay", "where": "*", **changes})  # type: ignore[arg-type]


def test_garble_flips_just_so_many_bits() -> None:
    rng = np.random.default_rng(0)
    for bits in (1, 7, 100):
        packet = bytes(range(50))
        changed = garble(packet, bits, rng)
        assert sum((a ^ b).bit_count() for a, b in zip(packet, changed, strict=True)) == bits
    assert garble(b"", 3, rng) == b""
    assert garble(b"\0", 30, rng) == b"\xff"


def through(fault: str, count: int = 6, **rule: float) -> list[bytes]:
    """What a channel makes of packets 0..count-1 when the rule strikes packet 2."""
    faults, got, later = Faults(seed=1), list[bytes](), Later("test")
    faults.set(fault, "x", skip=2, times=1, **rule)  # type: ignore[arg-type]
    channel = FaultyChannel(faults, "x", got.append, later)
    for k in range(count):
        channel.send(bytes((k, k, k)))
    assert later.close()
    return got


def test_channel() -> None:
    clean = [bytes((k, k, k)) for k in range(6)]
    assert through("drop") == [*clean[:2], *clean[3:]]
    assert through("duplicate") == [*clean[:3], *clean[2:]]
    assert through("reorder") == [clean[0], clean[1], clean[3], clean[2], *clean[4:]]
    assert through("truncate", value=2) == [*clean[:2], b"\2", *clean[3:]]
    garbled = through("garble")
    assert [a == b for a, b in zip(garbled, clean, strict=True)] == [True, True, False, True, True, True]


def test_delayed_and_overtaken_last_packets_still_come() -> None:
    faults, later, all_there = Faults(), Later("test"), threading.Event()
    got: list[bytes] = []

    def emit(packet: bytes) -> None:
        got.append(packet)
        if len(got) == 3:
            all_there.set()

    faults.set("delay", "x", times=1, value=0.01)
    faults.set("reorder", "x", skip=2, times=1)
    channel = FaultyChannel(faults, "x", emit, later)
    for packet in (b"a", b"b", b"c"):
        channel.send(packet)
    assert all_there.wait(SAFETY_S)
    assert got[0] == b"b"
    assert sorted(got) == [b"a", b"b", b"c"]
    assert later.close()


def test_unplug_on_a_channel() -> None:
    pulled: list[int] = []
    faults, later = Faults(), Later("test")
    faults.set("unplug", "x", skip=1, times=1)
    channel = FaultyChannel(faults, "x", lambda _: None, later, lambda: pulled.append(1))
    for _ in range(3):
        channel.send(b"a")
    assert pulled == [1]
    assert later.close()


def test_later_keeps_order_and_forgets_at_the_end() -> None:
    later, done, order = Later("test"), threading.Event(), list[int]()
    for k in range(5):
        later.call(0.0, order.append, k)
    later.call(0.005, done.set)
    later.call(60.0, order.append, 99)
    assert done.wait(SAFETY_S)
    assert later.close()
    later.call(0.0, order.append, 100)
    assert order == [0, 1, 2, 3, 4]


def test_bursts_count_and_end() -> None:
    seen, ended = list[int](), threading.Event()
    bursts = Bursts(seen.append, 0.0, 5, ended=ended.set)
    bursts.start()
    assert ended.wait(SAFETY_S)
    assert bursts.stop()
    assert seen == [0, 1, 2, 3, 4]
    assert bursts.late == 0


def test_late_bursts_are_counted() -> None:
    ended = threading.Event()
    slow = threading.Event()
    bursts = Bursts(lambda k: None if k else slow.wait(0.02), 1e-3, 5, ended=ended.set)  # type: ignore[func-returns-value]
    bursts.start()
    assert ended.wait(SAFETY_S)
    assert bursts.late >= 1
    assert bursts.stop()


def test_wait_is_interrupted() -> None:
    stop = threading.Event()
    threading.Timer(0.01, stop.set).start()
    assert wait_until(time.monotonic() + 600, stop) is False
