# SPDX-License-Identifier: Apache-2.0
"""Messages of the stream as they lie in a recording: back to drafts that can be sent or digested again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from edge.errors import WireError
from edge.stream.wire import FLAG_REPEATED, Draft, split, unpack

STAMP_KEYS = frozenset(
    ("v", "type", "boot", "seq", "t_ns", "t_pub_ns", "utc_ns", "utc_ok", "frame", "src", "cfg", "cal", "flags", "pl")
)
"""Header keys that every message has; the rest belongs to its type."""
U32 = 2**32


@dataclass(frozen=True, slots=True)
class StoredResult:
    """One message.

    Args:
        draft: what was published, without its stamp; not marked as repeated any more.
        header: the whole header as it was sent.
    """

    draft: Draft
    header: Mapping[str, Any]

    @property
    def hashes(self) -> tuple[bytes, bytes]:
        """Hashes of configuration and calibration that the publisher stated."""
        return self.header["cfg"], self.header["cal"]


def parse(block: bytes) -> StoredResult:
    """A message from the single-frame form.

    Raises:
        WireError: it does not follow the wire format.
    """
    frames = split(block)
    received = unpack(frames)
    fields = received.fields
    kind, frame, t_ns = fields.text("type"), fields.text("frame"), fields.instant("t_ns")
    flags = fields.integer("flags", U32 - 1) & ~FLAG_REPEATED
    fields.binary("cfg", 8), fields.binary("cal", 8), fields.binary("boot", 16), fields.integer("seq")
    header = msgpack.unpackb(frames[1])
    own = {key: value for key, value in header.items() if key not in STAMP_KEYS}
    return StoredResult(Draft(received.topic, kind, t_ns, frame, flags, own, received.payloads), header)


def shifted(draft: Draft, shift_ns: int, shift: int) -> Draft:
    """The message as of a later pass: instants and frame numbers are moved, everything else is as it was.

    Args:
        draft: message.
        shift_ns: added to every instant of the measurement.
        shift: added to every frame number.
    """
    if not shift_ns and not shift:
        return draft
    fields = {key: _moved(key, value, shift_ns) for key, value in draft.fields.items()}
    payloads = list(draft.payloads)
    if isinstance(fields.get("number"), int):
        fields["number"] += shift
    if draft.type == "cloud" and payloads:
        payloads[0] = _renumbered(fields.get("pts"), payloads[0], shift)
    return Draft(draft.topic, draft.type, draft.t_ns + shift_ns, draft.frame, draft.flags, fields, payloads)


def _moved(key: str, value: Any, shift_ns: int) -> Any:
    """Instants anywhere in a header value: keys that end in ``_ns``."""
    if isinstance(value, dict):
        return {name: _moved(name, part, shift_ns) for name, part in value.items()}
    if isinstance(value, list):
        return [_moved("", part, shift_ns) for part in value]
    is_instant = key.endswith("_ns") and isinstance(value, int) and not isinstance(value, bool)
    return value + shift_ns if is_instant else value


def _renumbered(block: Any, payload: bytes, shift: int) -> bytes:
    """A cloud's points with later frame numbers (uint32, they wrap)."""
    try:
        step = block["step"]
        offset = next(field[1] for field in block["fields"] if field[0] == "frame" and field[2] == 6)
        layout = np.dtype({"names": ["frame"], "formats": ["<u4"], "offsets": [offset], "itemsize": step})
        points = np.frombuffer(bytearray(payload), layout)
    except (TypeError, KeyError, IndexError, ValueError, StopIteration) as error:
        raise WireError("cloud: points are not described", value=repr(block)[:80]) from error
    points["frame"] += np.uint32(shift % U32)
    return points.tobytes()
