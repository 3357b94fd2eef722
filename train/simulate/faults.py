# SPDX-License-Identifier: Apache-2.0
"""Faults on command: which packet, frame or line of the virtual rig goes wrong, the same ones for the same seed.

A rule names a fault, the channels it strikes (a pattern such as ``vertical/data`` or ``*/control``), and how often.
Each rule draws from its own generator for every channel, so that what threads do elsewhere changes nothing.
"""

from __future__ import annotations

import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from fnmatch import fnmatchcase

import numpy as np

from edge.errors import ConfigError
from train.simulate.threads import Later

REORDER_FLUSH_S = 0.05
"""A packet that waits to be overtaken is sent after this when no other comes."""


class Fault(StrEnum):
    """What can go wrong; the value of a rule is given with each."""

    DROP = "drop"
    """Packet, line, pose or frame never comes."""
    DELAY = "delay"
    """It comes later; value: seconds."""
    DUPLICATE = "duplicate"
    """It comes twice."""
    REORDER = "reorder"
    """It comes after the next one."""
    GARBLE = "garble"
    """Bits are flipped; value: how many."""
    TRUNCATE = "truncate"
    """It ends early; value: bytes that are missing (at most all)."""
    BABBLE = "babble"
    """Something else comes in its place, without an end of line; value: bytes."""
    SPLIT = "split"
    """TCP: written in pieces; value: bytes of a piece."""
    NACK = "nack"
    """The order is not carried out and answered NACK, fail or Error; value: only this opcode, code (-1: any)."""
    SPI_NACK = "spi_nack"
    """The radar chip answers a message with a NACK of its own (type 2)."""
    REFUSE = "refuse"
    """The radar chip refuses a message; value: error code."""
    LATE = "late"
    """The radar's bursts begin later; value: seconds."""
    STUCK = "stuck"
    """A receiver repeats its first sample; value: which one, from 0."""
    DEAD = "dead"
    """A receiver gives zeros; value: which one, from 0."""
    SATURATE = "saturate"
    """Samples at the rails; value: share of them."""
    HANG_UP = "hang_up"
    """TCP: the connection ends, the board keeps its state and runs on."""
    UNPLUG = "unplug"
    """Power or cable gone: TCP closed and everything configured lost, UDP silent, pseudo-terminal gone."""


_VALUES: dict[Fault, tuple[float, float, float]] = {
    Fault.DELAY: (0.05, 0.0, 3600.0),
    Fault.GARBLE: (1, 1, 4096),
    Fault.TRUNCATE: (1, 1, 2**31),
    Fault.BABBLE: (4096, 1, 2**24),
    Fault.SPLIT: (1, 1, 2**16),
    Fault.NACK: (-1, -1, 0xFFFF),
    Fault.REFUSE: (6, 1, 0xFFFF),
    Fault.LATE: (2e-3, 0.0, 3600.0),
    Fault.STUCK: (0, 0, 15),
    Fault.DEAD: (0, 0, 15),
    Fault.SATURATE: (0.05, 0.0, 1.0),
}
"""Default, least and largest value of the faults that have one."""


@dataclass(frozen=True, slots=True)
class Hit:
    """A fault that strikes now.

    Args:
        value: of the rule.
        rng: generator of this rule on this channel.
    """

    value: float
    rng: np.random.Generator


@dataclass(slots=True)
class _Rule:
    identity: int
    fault: Fault
    where: str
    share: float
    times: int | None
    skip: int
    value: float
    hits: int = 0
    seen: Counter[str] = field(default_factory=Counter)
    rngs: dict[str, np.random.Generator] = field(default_factory=dict)

    def text(self) -> str:
        times = "" if self.times is None else f" times={self.times}"
        return f"{self.fault} {self.where} share={self.share:g}{times} skip={self.skip} value={self.value:g}"


class Faults:
    """The rules in force; usable from several threads.

    Args:
        seed: of every draw.
    Attributes:
        struck: (fault, channel) -> how often it struck.
    """

    def __init__(self, seed: int = 0) -> None:
        self.struck: Counter[tuple[Fault, str]] = Counter()
        self._seed, self._rules, self._made, self._lock = seed, list[_Rule](), 0, threading.Lock()

    def set(
        self,
        fault: Fault | str,
        where: str = "*",
        *,
        share: float = 1.0,
        times: int | None = None,
        skip: int = 0,
        value: float | None = None,
    ) -> None:
        """Add a rule.

        Args:
            fault: what goes wrong.
            where: pattern of channels, with * and ?.
            share: probability for each packet.
            times: strikes after which the rule is spent, all channels together; None: never.
            skip: packets of a channel that pass before it begins.
            value: of the fault; None: its default.
        Raises:
            ConfigError: unknown fault or a number out of range.
        """
        if fault not in list(Fault):
            raise ConfigError("unknown fault", value=str(fault), allowed=", ".join(Fault))
        kind = Fault(fault)
        default, low, high = _VALUES.get(kind, (0.0, 0.0, 0.0))
        chosen = default if value is None else float(value)
        ranges = [("share", share, 0.0, 1.0), ("value", chosen, low, high), ("skip", skip, 0, 2**31)]
        for name, given, least, most in [*ranges, ("times", 1 if times is None else times, 1, 2**31)]:
            if not least <= given <= most:
                raise ConfigError(f"fault {kind}: {name} out of range", value=given, allowed=f"{least:g}..{most:g}")
        with self._lock:
            self._rules.append(_Rule(self._made, kind, where, share, times, skip, chosen))
            self._made += 1

    def clear(self, fault: Fault | str | None = None, where: str | None = None) -> int:
        """Remove rules by fault and by their pattern as it was given; None: any. Returns how many."""
        with self._lock:
            kept = [
                r for r in self._rules if (fault is not None and r.fault != fault) or (where not in (None, r.where))
            ]
            removed = len(self._rules) - len(kept)
            self._rules = kept
        return removed

    def rules(self) -> list[str]:
        """One line a rule, as the control socket takes it."""
        with self._lock:
            return [rule.text() for rule in self._rules]

    def quiet(self, where: str) -> bool:
        """Whether no rule can strike this channel: the fast path of data."""
        return not any(fnmatchcase(where, rule.where) for rule in self._rules)

    def hit(self, fault: Fault, where: str, key: int | None = None) -> Hit | None:
        """Whether a fault strikes the present packet of a channel; each asking counts as one packet.

        Args:
            fault: which.
            where: channel.
            key: opcode or code, which a rule's value must equal unless it is -1; None: values are no keys.
        """
        return next(self._striking(fault, where, key), None) if self._rules else None

    def hits(self, fault: Fault, where: str) -> list[Hit]:
        """Every rule of a fault that strikes, for example one for each dead receiver."""
        return list(self._striking(fault, where, None)) if self._rules else []

    def _striking(self, fault: Fault, where: str, key: int | None) -> Iterator[Hit]:
        for rule in list(self._rules):
            wanted = key is None or rule.value in (-1, key)
            if rule.fault != fault or not wanted or not fnmatchcase(where, rule.where):
                continue
            with self._lock:
                struck = self._strikes(rule, where)
                self.struck[fault, where] += struck
            if struck:
                yield Hit(rule.value, rule.rngs[where])

    def _strikes(self, rule: _Rule, where: str) -> bool:
        if where not in rule.rngs:
            rule.rngs[where] = np.random.default_rng((self._seed, rule.identity, zlib.crc32(where.encode())))
        rule.seen[where] += 1
        drawn = rule.rngs[where].random() < rule.share
        if rule.seen[where] <= rule.skip or (rule.times is not None and rule.hits >= rule.times) or not drawn:
            return False
        rule.hits += 1
        return True


def garble(packet: bytes, bits: int, rng: np.random.Generator) -> bytes:
    """The packet with ``bits`` bits flipped, at different places."""
    if not packet:
        return packet
    changed = bytearray(packet)
    for place in rng.choice(8 * len(packet), size=min(bits, 8 * len(packet)), replace=False):
        changed[place >> 3] ^= 1 << (place & 7)
    return bytes(changed)


class FaultyChannel:
    """Sends packets on, with the faults of one channel; usable from several threads.

    Args:
        faults: rules; None: the channel is perfect.
        where: name of the channel.
        emit: puts a packet on the wire.
        later: calls what is delayed.
        unplug: what an unplug does.
    """

    def __init__(
        self,
        faults: Faults | None,
        where: str,
        emit: Callable[[bytes], None],
        later: Later,
        unplug: Callable[[], None] | None = None,
    ) -> None:
        self._faults, self._where, self._emit, self._later, self._unplug = faults, where, emit, later, unplug
        self._held: list[bytes] = []
        self._lock = threading.Lock()

    @property
    def quiet(self) -> bool:
        """Whether packets may go straight to the wire."""
        return not self._held and (self._faults is None or self._faults.quiet(self._where))

    def send(self, packet: bytes) -> None:
        """Send one packet, or what the faults make of it."""
        faults, where = self._faults, self._where
        if faults is None or (faults.quiet(where) and not self._held):
            self._emit(packet)
            return
        if faults.hit(Fault.UNPLUG, where) and self._unplug is not None:
            self._unplug()
            return
        if faults.hit(Fault.DROP, where):
            return
        if other := faults.hit(Fault.BABBLE, where):
            packet = other.rng.integers(0x20, 0x7F, int(other.value), dtype=np.uint8).tobytes()
        if cut := faults.hit(Fault.TRUNCATE, where):
            packet = packet[: max(0, len(packet) - int(cut.value))]
        if flipped := faults.hit(Fault.GARBLE, where):
            packet = garble(packet, int(flipped.value), flipped.rng)
        packets = [packet, packet] if faults.hit(Fault.DUPLICATE, where) else [packet]
        with self._lock:
            overtaken, self._held = self._held, []
            if not overtaken and faults.hit(Fault.REORDER, where):
                self._held = packets
                self._later.call(REORDER_FLUSH_S, self._flush, packets)
                return
        slow = faults.hit(Fault.DELAY, where)
        for one in [*packets, *overtaken]:
            if slow:
                self._later.call(slow.value, self._emit, one)
            else:
                self._emit(one)

    def _flush(self, packets: list[bytes]) -> None:
        """No other packet overtook these."""
        with self._lock:
            if self._held is not packets:
                return
            self._held = []
        for one in packets:
            self._emit(one)
