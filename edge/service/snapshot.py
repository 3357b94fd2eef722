# SPDX-License-Identifier: Apache-2.0
"""What the running appliance shows of itself at one instant: input of the metrics, made by the live pipeline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from edge.stream.messages import Status
from edge.timing import Histogram


@dataclass(frozen=True, slots=True)
class RecordingFigures:
    """What the recording of the run has taken so far.

    Args:
        written, dropped: topic -> messages.
        bytes_written: of frames and messages.
        waiting_bytes: in the queue before the disk.
        ended: why it ended before the run; empty: it goes on.
    """

    written: Mapping[str, int] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)
    bytes_written: int = 0
    waiting_bytes: int = 0
    ended: str = ""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Counters and gauges of one instant; counters never fall while the process lives.

    Args:
        status: as published on the stream: state, reasons, accounts of both radars, pose source, uptime.
        latency: stage -> histogram since the start (``StageTimes.histograms``).
        objects: class -> objects that are tracked now.
        shapes: class -> shapes published since the start.
        shapes_withheld: shapes computed and not published, since the start.
        auth_failures: handshakes refused since the start (``Publisher.auth_failures``).
        shed_step: step of load shedding, 0 = none.
        queues: name -> entries that wait now.
        rss_bytes: resident memory of the process.
        temperature_c: hottest sensor of the machine; None: no sensor.
        recording: of the run; None: it is not recorded.
    """

    status: Status
    latency: Mapping[str, Histogram] = field(default_factory=dict)
    objects: Mapping[str, int] = field(default_factory=dict)
    shapes: Mapping[str, int] = field(default_factory=dict)
    shapes_withheld: int = 0
    auth_failures: int = 0
    shed_step: int = 0
    queues: Mapping[str, int] = field(default_factory=dict)
    rss_bytes: int = 0
    temperature_c: float | None = None
    recording: RecordingFigures | None = None
