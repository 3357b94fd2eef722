# SPDX-License-Identifier: Apache-2.0
"""The runtime on the vehicle; ``from edge import connect`` is all a subscriber needs."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edge.stream.client import connect

__all__ = ["connect"]

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
"""ONNX Runtime would keep a device id and report to its maker; it reads this when it is imported."""


def __getattr__(name: str) -> object:
    """Load ZeroMQ and the stream only when they are asked for."""
    if name == "connect":
        from edge.stream.client import connect

        return connect
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
