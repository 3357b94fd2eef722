# SPDX-License-Identifier: Apache-2.0
"""A rig with small frames and what the recording tests put into files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from edge.calibration import Calibration
from edge.frames import RADARS, Layout, Pose, RadarFrame, RadarId
from edge.recording.reader import RecordingReader
from edge.recording.schema import RecordedMessage
from edge.recording.writer import RecordingWriter

LAYOUT = Layout("dca1000", 1, 1, 2, 4, 2, "QI")
BIG = Layout("cascade", 4, 2, 3, 256, 4)
"""Large enough that a frame is a chunk of its own."""

Item = RadarFrame | Pose | RecordedMessage


def small_rig(folder: Path, layout: Layout = LAYOUT, radars: Sequence[RadarId] = RADARS) -> Any:
    """Two radars with tiny frames; no board is like this, so it is no rig.toml of ours."""
    folder.mkdir(exist_ok=True)
    (folder / "rig.toml").write_text('description = "small"\n')
    times = {"frame_period_s": 0.02, "frame_period_s_actual": 0.02, "burst_s": 0.004}
    schedule = SimpleNamespace(layout=layout, packed_12_bit=False, **times)
    radar = SimpleNamespace(schedule=schedule, calibration=Calibration.identity(layout))
    return SimpleNamespace(
        name=folder.name, radars=dict.fromkeys(radars, radar), directory=folder, config_hash=bytes(range(8))
    )


def frame(radar: RadarId, number: int, layout: Layout = LAYOUT) -> RadarFrame:
    rng = np.random.default_rng((number, radar == "vertical"))
    adc = rng.integers(-32768, 32768, layout.shape, dtype=np.int16)
    return RadarFrame(radar, number, 10**9 + 20_000_000 * number + 10_000_000 * (radar == "vertical"), adc, layout)


def pose(number: int) -> Pose:
    angle = 0.1 * number
    rotation = np.array([0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)])
    return Pose(10**9 + 20_000_000 * number + 1, np.array([0.1 * number, 1 / 3, -1e-17]), rotation)


def content(count: int, layout: Layout = LAYOUT) -> list[Item]:
    """``count`` times: horizontal frame, pose, vertical frame, result."""
    items: list[Item] = []
    for n in range(count):
        t_ns = 10**9 + 20_000_000 * n + 15_000_000
        items += [frame("horizontal", n, layout), pose(n), frame("vertical", n, layout)]
        items.append(RecordedMessage("/shape", t_ns, b"result %06d" % n))
    return items


def write(writer: RecordingWriter, items: Sequence[Item]) -> None:
    for item in items:
        if isinstance(item, RadarFrame):
            writer.frame(item)
        elif isinstance(item, Pose):
            writer.pose(item)
        else:
            writer.message(item.topic, item.payload, item.t_ns)


def same(a: object, b: object) -> bool:
    """Exact equality of frames, poses and results."""
    if isinstance(a, RadarFrame) and isinstance(b, RadarFrame):
        head = (a.radar, a.number, a.t_first_chirp_ns, a.layout) == (b.radar, b.number, b.t_first_chirp_ns, b.layout)
        return head and np.array_equal(a.adc, b.adc)
    if isinstance(a, Pose) and isinstance(b, Pose):
        equal = np.array_equal(a.position_m, b.position_m) and np.array_equal(a.quaternion_xyzw, b.quaternion_xyzw)
        return a.t_ns == b.t_ns and equal
    return isinstance(a, RecordedMessage) and a == b


def assert_same(read: Sequence[object], expected: Sequence[object]) -> None:
    assert len(read) == len(expected)
    assert all(same(a, b) for a, b in zip(read, expected, strict=True))


def inputs(items: Sequence[Item]) -> list[Item]:
    """What iteration of a reader gives of ``items``."""
    return [item for item in items if not isinstance(item, RecordedMessage)]


def results(items: Sequence[Item]) -> list[Item]:
    """What ``results`` of a reader gives of ``items``."""
    return [item for item in items if isinstance(item, RecordedMessage)]


def assert_prefix(reader: RecordingReader, items: Sequence[Item]) -> int:
    """The file holds the first n of ``items``, exactly; returns n."""
    read = list(reader)
    published = list(reader.results())
    count = len(read) + len(published)
    assert_same(read, inputs(items[:count]))
    assert_same(published, results(items[:count]))
    return count
