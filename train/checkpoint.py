# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: everything an exact continuation needs, written atomically."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from edge.errors import ModelError

_EARLIER_NAME = "ours"
"""Of the network ``narrow``, in older checkpoints."""
SCHEMA = 1


@dataclass(slots=True)
class Checkpoint:
    """State of a training run after a whole number of steps.

    All chance decisions derive from (seed, step), so no generator state is needed.

    Args:
        model: weights that are trained.
        average: their exponential moving average, which is exported.
        optimizer: AdamW state.
        step: optimizer steps done.
        samples: samples seen.
        elapsed_s: training time spent, validation and checkpoints not counted.
        settings: the run's settings as plain values.
        history: validation results so far.
        anchor: time (or steps) and progress at which the present budget took over; see ``fit_settings.progress``.
    """

    model: dict[str, torch.Tensor]
    average: dict[str, torch.Tensor]
    optimizer: dict[str, Any]
    step: int
    samples: int
    elapsed_s: float
    settings: dict[str, Any]
    history: list[dict[str, float]]
    anchor: list[float] = field(default_factory=lambda: [0.0, 0.0])


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write beside the target, flush to disk, rename: a kill leaves the old or the new file, never half of one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        fields = {name: getattr(checkpoint, name) for name in Checkpoint.__slots__}
        torch.save({"schema": SCHEMA, **fields}, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint onto the CPU.

    Raises:
        ModelError: absent, unreadable or of another schema.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        if content.pop("schema") != SCHEMA:
            raise KeyError("schema")
        checkpoint = Checkpoint(**content)
    except (OSError, RuntimeError, KeyError, TypeError, EOFError, ValueError) as error:
        raise ModelError(
            f"{path.name}: not a checkpoint of this trainer ({type(error).__name__})",
            allowed=f"a file written by 'rfconstruct-train fit', schema {SCHEMA}",
            action="name the checkpoint.pt of a run folder",
        ) from error
    name = checkpoint.settings.get("network", _EARLIER_NAME)
    checkpoint.settings["network"] = "narrow" if name == _EARLIER_NAME else name
    return checkpoint
