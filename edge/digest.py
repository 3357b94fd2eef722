# SPDX-License-Identifier: Apache-2.0
"""SHA-256 over everything a run found: detections, points, fused windows and shapes, in order, without times taken."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np

from edge.config import PointEncoding
from edge.errors import WireError
from edge.pipeline import FrameResult, WindowResult
from edge.stream import convert
from edge.stream.wire import Draft

DIGESTED = ("det", "cloud", "shape")
"""Types of messages; pose, status, heartbeat and heatmaps (ten a second) are not."""
MEASURED_TIMES = ("lat_us",)
"""Header keys that are no result: how long something took."""


class ResultDigest:
    """A sink of the pipeline. The stream of the same run, recorded without loss, has the same digest.

    Args:
        encoding: of the shapes' points (``stream.shape_encoding``).
    """

    def __init__(self, encoding: PointEncoding = "f4") -> None:
        self._hash, self._encoding = hashlib.sha256(), encoding
        self.messages = 0
        """How many went into it."""

    def frame(self, result: FrameResult) -> None:
        """Add one frame's detections and points."""
        found = result.detections
        self._encode(lambda: convert.encode_detections(found.get("horizontal"), found.get("vertical"), result.cloud))

    def window(self, result: WindowResult) -> None:
        """Add a window and its shapes."""
        self._encode(lambda: convert.encode_cloud(result.cloud))
        for shape in result.shapes:
            self._encode(lambda shape=shape: convert.encode_shape(shape, self._encoding))  # type: ignore[misc]

    def add(self, draft: Draft) -> None:
        """Add a message; types that are no result change nothing."""
        if draft.type not in DIGESTED:
            return
        fields = {key: value for key, value in draft.fields.items() if key not in MEASURED_TIMES}
        head = [draft.topic, draft.type, draft.t_ns, draft.frame, draft.flags, fields, list(map(len, draft.payloads))]
        self._hash.update(msgpack.packb(head, default=_plain))
        for payload in draft.payloads:
            self._hash.update(payload)
        self.messages += 1

    def hexdigest(self) -> str:
        """64 hexadecimal digits."""
        return self._hash.hexdigest()

    def _encode(self, make: Callable[[], Draft]) -> None:
        """What the stream cannot carry (points that are not finite) is not published either."""
        try:
            self.add(make())
        except WireError:
            return


def _plain(value: object) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} in a message")
