# SPDX-License-Identifier: Apache-2.0
"""A snapshot as text in the exposition format of Prometheus, version 0.0.4."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import accumulate

from edge.service.snapshot import RecordingFigures, Snapshot
from edge.stream.messages import STATES, RadarStatus
from edge.timing import BOUNDS_US

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
PREFIX = "rfconstruct_"
Labels = Mapping[str, str]
Sample = tuple[str, Labels, float]
"""Ending of the name, labels, value."""
Family = Callable[[str, str, str, Iterable[Sample]], None]


def exposition(snapshot: Snapshot) -> str:
    """All metrics of a snapshot.

    Args:
        snapshot: of one instant.
    Returns:
        Text of ``CONTENT_TYPE``; every family has its help and its type.
    """
    status = snapshot.status
    lines: list[str] = []

    def family(name: str, kind: str, text: str, samples: Iterable[Sample]) -> None:
        lines.extend(_family(PREFIX + name, kind, text, samples))

    def one(name: str, kind: str, text: str, value: float | None) -> None:
        family(name, kind, text, [] if value is None else [("", {}, value)])

    def by(name: str, kind: str, text: str, label: str, values: Mapping[str, float]) -> None:
        family(name, kind, text, [("", {label: key}, value) for key, value in values.items()])

    by(
        "build_info",
        "gauge",
        "Always 1; the version is a label.",
        "version",
        {status.versions.get("rfconstruct", ""): 1},
    )
    by("state", "gauge", "1 for the present state.", "state", {state: state == status.state for state in STATES})
    one("level", "gauge", "0 OK, 1 WARN, 2 ERROR, 3 STALE.", status.level)
    reasons = {reason.code: float(reason.count) for reason in status.reasons}
    by("reason", "gauge", "How often what keeps the state from RUN occurred.", "code", reasons)
    one("uptime_seconds", "gauge", "Since the start.", status.uptime_s)
    _radars(family, status.radars)
    family("stage_duration_seconds", "histogram", "Time of one stage.", _histograms(snapshot))
    by("objects", "gauge", "Objects tracked now.", "class", snapshot.objects)
    by("shapes_total", "counter", "Shapes published.", "class", snapshot.shapes)
    one("shapes_withheld_total", "counter", "Shapes computed and not published.", snapshot.shapes_withheld)
    if status.pose is not None:
        one("pose_age_seconds", "gauge", "Age of the newest pose.", status.pose.age_ms / 1e3)
        one("pose_rate_hertz", "gauge", "Poses a second.", status.pose.rate_hz)
        one("pose_gaps_total", "counter", "Gaps between poses.", status.pose.gaps)
    one("auth_failures_total", "counter", "Handshakes of subscribers that failed.", snapshot.auth_failures)
    one("shed_step", "gauge", "Step of load shedding, 0 = none.", snapshot.shed_step)
    by("queue_entries", "gauge", "Entries that wait.", "queue", snapshot.queues)
    if snapshot.recording is not None:
        _recording(family, snapshot.recording)
    one("resident_memory_bytes", "gauge", "Of the process.", snapshot.rss_bytes)
    one("temperature_celsius", "gauge", "Hottest sensor of the machine.", snapshot.temperature_c)
    return "\n".join(lines) + "\n"


def _radars(family: Family, radars: Mapping[str, RadarStatus]) -> None:
    """The exact account: frames_in = frames_ok + the sum of frames_lost, once nothing is under way."""

    def counted(value: str) -> list[Sample]:
        return [("", {"radar": radar}, getattr(account, value)) for radar, account in radars.items()]

    family("frames_in_total", "counter", "Frames that came or are known to be missing.", counted("frames_in"))
    family("frames_ok_total", "counter", "Frames that became a result.", counted("frames_ok"))
    lost: list[Sample] = [
        ("", {"radar": radar, "cause": cause}, count)
        for radar, account in radars.items()
        for cause, count in account.lost.items()
    ]
    family("frames_lost_total", "counter", "Frames that did not, by cause.", lost)
    family("frame_rate_hertz", "gauge", "Frames a second.", counted("fps"))


def _recording(family: Family, figures: RecordingFigures) -> None:
    """Messages written and dropped by topic, and whether the recording goes on."""

    def counted(counts: Mapping[str, int]) -> list[Sample]:
        return [("", {"topic": topic}, count) for topic, count in counts.items()]

    going_on: list[Sample] = [("", {}, not figures.ended)]
    family("recording", "gauge", "1 while the run is recorded, 0 when the disk ended the recording.", going_on)
    family("recorded_total", "counter", "Messages written to the recording.", counted(figures.written))
    family("recording_dropped_total", "counter", "Messages that the disk did not take.", counted(figures.dropped))
    family("recorded_bytes_total", "counter", "Bytes written to the recording.", [("", {}, figures.bytes_written)])
    family("recording_waiting_bytes", "gauge", "Bytes that wait for the disk.", [("", {}, figures.waiting_bytes)])


def _histograms(snapshot: Snapshot) -> Iterable[Sample]:
    for stage, histogram in snapshot.latency.items():
        bounds = [*(_number(bound / 1e6) for bound in BOUNDS_US), "+Inf"]
        for bound, count in zip(bounds, accumulate(histogram.counts), strict=True):
            yield "_bucket", {"stage": stage, "le": bound}, count
        yield "_sum", {"stage": stage}, histogram.sum_us / 1e6
        yield "_count", {"stage": stage}, sum(histogram.counts)


def _family(name: str, kind: str, text: str, samples: Iterable[Sample]) -> list[str]:
    """Help, type and samples; nothing without samples."""
    found = [f"{name}{ending}{_labels(labels)} {_number(value)}" for ending, labels, value in samples]
    return [f"# HELP {name} {text}", f"# TYPE {name} {kind}", *found] if found else []


def _labels(labels: Labels) -> str:
    return "{" + ",".join(f'{key}="{_escaped(value)}"' for key, value in labels.items()) + "}" if labels else ""


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _number(value: float) -> str:
    """Shortest text that is the same number; NaN, +Inf and -Inf as the format spells them."""
    number = float(value)
    if number != number:
        return "NaN"
    if number in (float("inf"), float("-inf")):
        return "+Inf" if number > 0 else "-Inf"
    return str(int(number)) if number.is_integer() and abs(number) < 2**53 else repr(number)
