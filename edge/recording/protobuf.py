# SPDX-License-Identifier: Apache-2.0
"""Protocol Buffers as far as a recording needs them: messages from tables of fields, and the descriptors of the tables.

Encoding: https://protobuf.dev/programming-guides/encoding. A schema in MCAP is a binary ``FileDescriptorSet``
(google/protobuf/descriptor.proto) of the message's file and all that it needs.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5
_TYPE_CODES = {"double": 1, "int64": 3, "int32": 5, "fixed32": 7, "bool": 8, "string": 9, "bytes": 12}
_MESSAGE, _ENUM, _OPTIONAL, _REPEATED = 11, 14, 1, 3


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message.

    Args:
        number: on the wire.
        kind: scalar, or full name of a message or enumeration.
        repeated: a list.
    """

    number: int
    kind: str
    repeated: bool = False


@dataclass(frozen=True, slots=True)
class Schema:
    """Messages and enumerations by full name, for example ``foxglove.Pose``; nested enumerations have a longer name."""

    messages: Mapping[str, Mapping[str, Field]]
    enums: Mapping[str, Mapping[str, int]]

    def encode(self, name: str, values: Mapping[str, Any]) -> bytes:
        """A message.

        Args:
            name: of the message.
            values: field -> value; mappings for messages, names or numbers for enumerations, lists where repeated.
                Fields that are absent have their default.
        Raises:
            KeyError: no such message or field.
        """
        fields, out = self.messages[name], bytearray()
        for key, value in values.items():
            field = fields[key]
            for one in value if field.repeated else (value,):
                out += self._field(field, one)
        return bytes(out)

    def descriptors(self, name: str) -> bytes:
        """FileDescriptorSet of a message and all that it needs, dependencies first."""
        ordered: dict[str, None] = {}
        self._collect(name, ordered)
        return b"".join(_bytes(1, self._file(one)) for one in ordered)

    def _field(self, field: Field, value: Any) -> bytes:
        kind = field.kind
        if kind in self.messages:
            return _bytes(field.number, self.encode(kind, value))
        if kind in self.enums:
            return _integer(field.number, self.enums[kind][value] if isinstance(value, str) else value)
        if kind == "double":
            return _key(field.number, FIXED64) + struct.pack("<d", value)
        if kind == "fixed32":
            return _key(field.number, FIXED32) + struct.pack("<I", value)
        if kind == "string":
            return _bytes(field.number, value.encode())
        if kind == "bytes":
            return _bytes(field.number, value)
        return _integer(field.number, int(value))

    def _collect(self, name: str, ordered: dict[str, None]) -> None:
        for field in self.messages[name].values():
            if field.kind in self.messages and field.kind not in ordered:
                self._collect(field.kind, ordered)
        ordered[name] = None

    def _file(self, name: str) -> bytes:
        """FileDescriptorProto of one message: name 1, package 2, dependency 3, message_type 4, syntax 12."""
        package, _, short = name.rpartition(".")
        needs = dict.fromkeys(field.kind for field in self.messages[name].values() if field.kind in self.messages)
        parts = [_text(1, _file_name(name)), _text(2, package), *(_text(3, _file_name(one)) for one in needs)]
        return b"".join([*parts, _bytes(4, self._message(name, short)), _text(12, "proto3")])

    def _message(self, name: str, short: str) -> bytes:
        """DescriptorProto: name 1, field 2, enum_type 4."""
        fields = [_bytes(2, self._described(key, field)) for key, field in self.messages[name].items()]
        nested = [one for one in self.enums if one.rpartition(".")[0] == name]
        enums = [_bytes(4, _enum(one.rpartition(".")[2], self.enums[one])) for one in nested]
        return b"".join([_text(1, short), *fields, *enums])

    def _described(self, key: str, field: Field) -> bytes:
        """FieldDescriptorProto: name 1, number 3, label 4, type 5, type_name 6, json_name 10."""
        code = (
            _MESSAGE if field.kind in self.messages else _ENUM if field.kind in self.enums else _TYPE_CODES[field.kind]
        )
        head = _text(1, key) + _integer(3, field.number) + _integer(4, _REPEATED if field.repeated else _OPTIONAL)
        named = _text(6, f".{field.kind}") if code in (_MESSAGE, _ENUM) else b""
        first, *rest = key.split("_")
        return head + _integer(5, code) + named + _text(10, first + "".join(map(str.capitalize, rest)))


def _enum(name: str, values: Mapping[str, int]) -> bytes:
    """EnumDescriptorProto: name 1, value 2 (EnumValueDescriptorProto: name 1, number 2)."""
    return _text(1, name) + b"".join(_bytes(2, _text(1, key) + _integer(2, value)) for key, value in values.items())


def _file_name(message: str) -> str:
    """As the official files are called: ``foxglove/Pose.proto``, ``google/protobuf/timestamp.proto``."""
    package, _, short = message.rpartition(".")
    return f"{package.replace('.', '/')}/{short.lower() if package.startswith('google') else short}.proto"


def varint(value: int) -> bytes:
    """Seven bits a byte, lowest first; negative numbers as 64-bit two's complement."""
    value &= 2**64 - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _key(number: int, wire_type: int) -> bytes:
    return varint(number << 3 | wire_type)


def _integer(number: int, value: int) -> bytes:
    return _key(number, VARINT) + varint(value)


def _bytes(number: int, value: bytes) -> bytes:
    return _key(number, LENGTH) + varint(len(value)) + value


def _text(number: int, value: str) -> bytes:
    return _bytes(number, value.encode())


def fields(**kinds: tuple[int, str] | tuple[int, str, bool]) -> dict[str, Field]:
    """A table of fields: ``name=(number, kind)`` or ``name=(number, kind, True)`` for a list."""
    return {name: Field(*kind) for name, kind in kinds.items()}


def numbered(names: Iterable[str] | Sequence[str]) -> dict[str, int]:
    """Values of an enumeration that counts from 0."""
    return {name: number for number, name in enumerate(names)}
