# SPDX-License-Identifier: Apache-2.0
"""What a run prints when it is over: the account of frames, latencies, objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge.best_shapes import class_text, keep_best
from edge.frames import Shape
from edge.pipeline import FrameResult, Road, WindowResult
from edge.stream.convert import shape_size_m


class Tally:
    """A sink that counts results and keeps the most trusted shapes."""

    def __init__(self) -> None:
        self.detections: dict[str, int] = {}
        self.points = self.windows = 0
        self.shapes: dict[int, Shape] = {}

    def frame(self, result: FrameResult) -> None:
        """Count one frame's results."""
        for radar, found in result.detections.items():
            self.detections[radar] = self.detections.get(radar, 0) + len(found)
        self.points += len(result.cloud) if result.cloud is not None else 0

    def window(self, result: WindowResult) -> None:
        """Count a window, keep its shapes."""
        self.windows += 1
        for shape in result.shapes:
            self.shape(shape)

    def shape(self, shape: Shape) -> None:
        """Keep the most trusted shape of every object."""
        keep_best(self.shapes, shape)


class Narrator:
    """A sink that prints one line for every window and every shape as they come."""

    def frame(self, result: FrameResult) -> None:
        """Frames come too fast to print."""

    def window(self, result: WindowResult) -> None:
        """Print what the window gave."""
        from tqdm import tqdm

        cloud = result.cloud
        whole = "" if cloud.complete else ", cut short"
        tqdm.write(f"window: {len(cloud)} points of {cloud.frames} frames, {cloud.travel_m:.2f} m of travel{whole}")
        for shape in result.shapes:
            tqdm.write(f"shape:  {_shape_line(shape)}")

    def shape(self, shape: Shape) -> None:
        """Print the final shape of an object; the live pipeline gives several a second before it."""
        from tqdm import tqdm

        if shape.input.final:
            tqdm.write(f"shape:  {_shape_line(shape)}")


def shape_as_dict(shape: Shape) -> dict[str, Any]:
    """A shape without its points."""
    return {
        "object": shape.identity,
        "class": shape.class_name,
        "class_probability": shape.class_probability,
        "confidence": shape.confidence,
        "size_m": [round(float(side), 3) for side in shape_size_m(shape)],
        "input_points": shape.input_points,
        "frames": shape.input.frames,
        "travel_m": shape.input.travel_m,
    }


def as_dict(pipeline: Road, tally: Tally, pictures: Sequence[Path], notes: Sequence[str]) -> dict[str, Any]:
    """The whole report for machines."""
    return {
        "rig": pipeline.rig.name,
        "frames": {radar: ledger.snapshot().as_dict() for radar, ledger in pipeline.ledgers.items()},
        "detections": tally.detections,
        "points": tally.points,
        "windows": tally.windows,
        "shapes": [shape_as_dict(shape) for _, shape in sorted(tally.shapes.items())],
        "stages": {stage: asdict(time) for stage, time in pipeline.times.summary().items()},
        "faults": asdict(pipeline.faults),
        "pictures": [str(path) for path in pictures],
        "notes": list(notes),
    }


def account_lines(pipeline: Road) -> list[str]:
    """The account of every radar's frames, for people."""
    text = [f"{'radar':<12}{'frames in':>10}{'ok':>8}{'lost':>8}  causes"]
    for radar, ledger in pipeline.ledgers.items():
        account = ledger.snapshot()
        causes = ", ".join(f"{cause.value} {count}" for cause, count in account.lost.items())
        text.append(f"{radar:<12}{account.frames_in:>10}{account.frames_ok:>8}{account.frames_lost:>8}  {causes}")
    return text


def stage_lines(pipeline: Road) -> list[str]:
    """The stages' latencies, for people."""
    text = [f"{'stage':<12}{'calls':>10}{'p50 ms':>10}{'p99 ms':>10}"]
    for stage, time in pipeline.times.summary().items():
        text.append(f"{stage:<12}{time.count:>10}{time.p50_us / 1e3:>10.3f}{time.p99_us / 1e3:>10.3f}")
    return text


def lines(pipeline: Road, tally: Tally, notes: Sequence[str]) -> list[str]:
    """The whole report for people."""
    text = [*account_lines(pipeline), "", *stage_lines(pipeline)]
    found = ", ".join(f"{radar} {count}" for radar, count in tally.detections.items())
    text += ["", f"detections: {found or 'none'}; associated points: {tally.points}; windows: {tally.windows}"]
    text += [_shape_line(shape) for _, shape in sorted(tally.shapes.items())]
    text += [f"dead channels of {radar}: {', '.join(names)}" for radar, names in _dead(pipeline).items()]
    if pipeline.faults.last:
        text.append(f"last fault: {pipeline.faults.last}")
    text += [f"note: {note}" for note in notes]
    return text


def _dead(pipeline: Road) -> dict[str, tuple[str, ...]]:
    return {radar: names for radar, names in pipeline.faults.dead_channels.items() if names}


def _shape_line(shape: Shape) -> str:
    facts = shape_as_dict(shape)
    size = " x ".join(f"{side:.2f}" for side in facts["size_m"])
    return (
        f"object {shape.identity}: {class_text(shape)} (confidence {shape.confidence:.2f}), "
        f"{size} m, from {shape.input_points} radar points of {shape.input.frames} frames"
    )
