# SPDX-License-Identifier: Apache-2.0
"""TOML tables to settings dataclasses: unknown keys, wrong types and wrong units are refused by file, key and value.

Keys are the fields' names. Every quantity may also be given in another unit of its kind by naming the unit in the key:
``idle_us = 5`` fills ``idle_s``, ``slope_mhz_per_us = 79.034`` fills ``slope_hz_per_s``.
"""

from __future__ import annotations

import difflib
import math
import tomllib
import types
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from edge.errors import ConfigError

T = TypeVar("T")

Scale = tuple[float, float]
"""Multiplier and divisor; one of them is 1, so that 5 us is exactly the number 5e-6."""

UNITS: dict[str, dict[str, Scale]] = {
    "_hz_per_s": {"_mhz_per_us": (1e12, 1.0), "_ghz_per_ms": (1e12, 1.0)},
    "_hz": {"_khz": (1e3, 1.0), "_mhz": (1e6, 1.0), "_ghz": (1e9, 1.0), "_ksps": (1e3, 1.0), "_msps": (1e6, 1.0)},
    "_s_per_s": {"_us_per_s": (1.0, 1e6), "_ppm": (1.0, 1e6)},
    "_m": {"_cm": (1.0, 1e2), "_mm": (1.0, 1e3)},
    "_s": {"_ms": (1.0, 1e3), "_us": (1.0, 1e6), "_ns": (1.0, 1e9)},
}
"""SI suffix of a field -> suffixes that may stand in a file instead."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a value stands: file and dotted key."""

    file: Path
    key: str = ""

    def at(self, key: str) -> Place:
        """A key inside this table."""
        return Place(self.file, f"{self.key}.{key}" if self.key else key)

    def error(self, what: str, *, value: object = None, allowed: str = "", action: str = "") -> ConfigError:
        """ConfigError that begins with file and key."""
        where = f"{self.file}: {self.key}" if self.key else str(self.file)
        return ConfigError(f"{where}: {what}", value=value, allowed=allowed, action=action)

    @contextmanager
    def named(self) -> Iterator[None]:
        """Put the file's name in front of a ConfigError raised inside."""
        try:
            yield
        except ConfigError as error:
            raise ConfigError(
                f"{self.file}: {error.what}", value=error.value, allowed=error.allowed, action=error.action
            ) from error


def read_toml(path: Path) -> dict[str, Any]:
    """The file's top table.

    Raises:
        ConfigError: absent, not UTF-8 or not TOML; the parser's message holds line and column.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not a TOML file", value=str(error)) from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read", value=error.strerror) from error


def require_known(table: Mapping[str, Any], known: Iterable[str], place: Place) -> None:
    """Refuse keys that are not in ``known``.

    Raises:
        ConfigError: naming the key, its value and the nearest known key.
    """
    names = list(known)
    for key in table:
        if key not in names:
            raise _unknown(key, table[key], names, place)


def _unknown(key: str, value: object, names: list[str], place: Place) -> ConfigError:
    nearest = difflib.get_close_matches(key, names, n=1, cutoff=0.5)
    action = f"did you mean {nearest[0]}?" if nearest else "remove it"
    return place.at(key).error("unknown key", value=value, allowed=", ".join(names), action=action)


def subtable(table: Mapping[str, Any], key: str, place: Place) -> dict[str, Any]:
    """Table ``key`` inside ``table``, empty when absent.

    Raises:
        ConfigError: the key holds something else than a table.
    """
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise place.at(key).error("must be a table", value=value, allowed=f"[{place.at(key).key}]")
    return value


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with the keys of ``over`` in their place, table by table; neither is changed."""
    result = dict(base)
    for key, value in over.items():
        inner = result.get(key)
        result[key] = merged(inner, value) if isinstance(inner, dict) and isinstance(value, dict) else value
    return result


def fill(kind: type[T], table: Mapping[str, Any], place: Place) -> T:
    """An instance of dataclass ``kind`` from a table; absent keys keep their defaults.

    Raises:
        ConfigError: unknown or doubled key, wrong unit, wrong type, not finite, missing key without default, or a value
            that the dataclass itself refuses.
    """
    assert is_dataclass(kind)
    hints = get_type_hints(kind)
    known = {f.name: f for f in fields(kind) if f.init}
    values: dict[str, Any] = {}
    for key, value in table.items():
        name, scale = _field_of(key, value, known, place)
        if name in values:
            raise place.at(key).error("set twice in different units", value=value, allowed=f"{name} once")
        values[name] = _convert(value, hints[name], scale, place.at(key))
    missing = [name for name, f in known.items() if name not in values and not _has_default(f)]
    if missing:
        allowed = ", ".join(spellings(missing[0]))
        raise place.error("keys are missing", allowed=allowed, action=f"set {', '.join(missing)}")
    with place.named():
        return kind(**values)


def _has_default(item: Field[Any]) -> bool:
    return item.default is not MISSING or item.default_factory is not MISSING


def spellings(name: str) -> list[str]:
    """The field's name and the names it has in other units."""
    suffix = _suffix(name, UNITS)
    return [name] + [name.removesuffix(suffix) + other for other in UNITS.get(suffix, ())]


def _suffix(name: str, suffixes: Iterable[str]) -> str:
    return max((s for s in suffixes if name.endswith(s)), key=len, default="")


def _field_of(key: str, value: object, known: Mapping[str, Any], place: Place) -> tuple[str, Scale]:
    """Field that ``key`` names, and the scale of the unit in the key."""
    if key in known:
        return key, (1.0, 1.0)
    for si, others in UNITS.items():
        alias = _suffix(key, others)
        if alias and key.removesuffix(alias) + si in known:
            return key.removesuffix(alias) + si, others[alias]
    units = [*UNITS, *(alias for others in UNITS.values() for alias in others)]
    stem = key.removesuffix(_suffix(key, units))
    for name in known:
        if name.removesuffix(_suffix(name, UNITS)) == stem and name != stem:
            raise place.at(key).error("wrong or missing unit", value=value, allowed=", ".join(spellings(name)))
    raise _unknown(key, value, list(known), place)


def _convert(value: Any, hint: Any, scale: Scale, place: Place) -> Any:
    """``value`` as type ``hint``."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        if value not in args or isinstance(value, bool):
            raise place.error("not one of the possible values", value=value, allowed=", ".join(map(str, args)))
        return value
    if origin in (Union, types.UnionType):
        return _convert(value, next(a for a in args if a is not type(None)), scale, place)
    if origin is tuple:
        return _tuple(value, args, scale, place)
    if is_dataclass(hint) and isinstance(hint, type):
        if not isinstance(value, dict):
            raise place.error("must be a table", value=value, allowed=f"[{place.key}]")
        return fill(hint, value, place)
    return _scalar(value, hint, scale, place)


def _tuple(value: Any, args: tuple[Any, ...], scale: Scale, place: Place) -> tuple[Any, ...]:
    open_ended = len(args) == 2 and args[1] is Ellipsis
    if not isinstance(value, list) or (not open_ended and len(value) != len(args)):
        length = "a list" if open_ended else f"a list of {len(args)} values"
        raise place.error("wrong type or length", value=value, allowed=length)
    kinds = [args[0]] * len(value) if open_ended else list(args)
    pairs = enumerate(zip(value, kinds, strict=True))
    return tuple(_convert(item, kind, scale, place.at(str(n))) for n, (item, kind) in pairs)


def _scalar(value: Any, hint: Any, scale: Scale, place: Place) -> Any:
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "a path"}
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and number:
        scaled = float(value) * scale[0] / scale[1]
        if not math.isfinite(scaled):
            raise place.error("not finite", value=value, allowed="a finite number")
        return scaled
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint in (bool, str) and isinstance(value, hint):
        return value
    if hint is int and number and isinstance(value, int):
        return value
    raise place.error("wrong type", value=value, allowed=names.get(hint, str(hint)))
