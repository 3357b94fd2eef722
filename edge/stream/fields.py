# SPDX-License-Identifier: Apache-2.0
"""Checked access to the maps of a message header."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from edge.errors import WireError

U32, U64 = 2**32 - 1, 2**64 - 1


class Fields:
    """Checked access to a msgpack map; keys that nobody asks for are ignored.

    Args:
        content: the decoded map.
        where: its name in error messages.
    Raises:
        WireError: by every method, for a key that is missing, of another type, or outside its range.
    """

    def __init__(self, content: object, where: str) -> None:
        if not isinstance(content, dict):
            raise WireError(f"{where}: no map", value=type(content).__name__, allowed="map")
        self._content: dict[str, Any] = content
        self.where = where

    def _fail(self, key: str, allowed: str) -> WireError:
        value = repr(self._content.get(key, "nothing"))[:80]
        return WireError(f"{self.where}: key {key}", value=value, allowed=allowed)

    def __contains__(self, key: str) -> bool:
        return key in self._content

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def integer(self, key: str, high: int = U64, low: int = 0) -> int:
        """Integer in low..high."""
        value = self._content.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise self._fail(key, f"integer {low}..{high}")
        return value

    def instant(self, key: str) -> int:
        """Nanoseconds, signed 64 bit."""
        return self.integer(key, 2**63 - 1, -(2**63))

    def number(self, key: str) -> float:
        """Finite number."""
        value = self._content.get(key)
        if isinstance(value, int | float) and _is_number(value):
            return float(value)
        raise self._fail(key, "finite number")

    def flag(self, key: str) -> bool:
        """True or False."""
        value = self._content.get(key)
        if not isinstance(value, bool):
            raise self._fail(key, "boolean")
        return value

    def text(self, key: str, choices: Sequence[str] = ()) -> str:
        """Text, one of ``choices`` when there are any."""
        value = self._content.get(key)
        if not isinstance(value, str) or (choices and value not in choices):
            raise self._fail(key, ", ".join(choices) or "text")
        return value

    def binary(self, key: str, length: int) -> bytes:
        """Exactly ``length`` bytes."""
        value = self._content.get(key)
        if not isinstance(value, bytes) or len(value) != length:
            raise self._fail(key, f"{length} bytes")
        return value

    def array(self, key: str, length: int | None = None) -> list[Any]:
        """List, of ``length`` when given."""
        value = self._content.get(key)
        if not isinstance(value, list) or (length is not None and len(value) != length):
            raise self._fail(key, f"array{'' if length is None else f' of {length}'}")
        return value

    def numbers(self, key: str, length: int | None = None) -> list[float]:
        """List of finite numbers."""
        values = self.array(key, length)
        if not all(_is_number(value) for value in values):
            raise self._fail(key, "finite numbers")
        return [float(value) for value in values]

    def section(self, key: str) -> Fields:
        """The map under ``key``."""
        return Fields(self._content.get(key), f"{self.where}.{key}")

    def sections(self, key: str) -> list[Fields]:
        """The list of maps under ``key``."""
        return [Fields(value, f"{self.where}.{key}") for value in self.array(key)]


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return math.isfinite(value)
