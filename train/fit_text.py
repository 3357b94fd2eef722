# SPDX-License-Identifier: Apache-2.0
"""The command that makes a run, from the settings in its checkpoint: for the model card."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from train.fit_settings import FitSettings
from train.losses import LossSettings
from train.objects.mesh import CLASSES

_VALUES = ("rate", "cells", "average", "precision")
"""Settings of the same name as their option that are named where they are not the usual ones."""
_LOSS = {"emd_points": "emd-points", "fine_emd": "fine-emd", "coarse_emd": "coarse-emd", "beta": "beta"}
_SWITCHES = {"squared": "squared", "joint": "joint-uncertainty"}
_DATA = {"max_points": "points", "truth_points": "truth-points"}


def fit_command(run: str, settings: Mapping[str, Any]) -> str:
    """``rfconstruct-train fit`` as it was called, but for what does not change the result (threads, device).

    Args:
        run: name of the run folder.
        settings: of a checkpoint; the batch is that of all processes.
    """
    network, width = settings["network"], settings["width"]
    return " ".join([f"rfconstruct-train fit runs/{run} --network {network} --width {width}", *_options(settings)])


def starting_point(path: str) -> str:
    """Where a run began, without the place where that lay: ``runs/NAME/checkpoint.pt`` or ``models/NAME``."""
    where = Path(path)
    if where.suffix == ".pt":
        return f"runs/{where.parent.name}/{where.name}"
    return f"models/{where.parent.name if where.suffix == '.onnx' else where.name}"


def drive_bys(count: int) -> list[str]:
    """The options that name sets of drive-bys, DRIVE_BYS or DRIVE_BYS1, DRIVE_BYS2, ... for their places."""
    return [f"--simulated DRIVE_BYS{number or ''}" for number in (range(1, count + 1) if count > 1 else (0,))]


def _options(settings: Mapping[str, Any]) -> Iterator[str]:
    usual, loss, data = asdict(FitSettings()), settings.get("loss", {}), settings.get("data", {})
    usual_loss, usual_data = asdict(LossSettings()), {"max_points": 1024, "truth_points": 4096}
    yield from (f"--option {key}={_plain(value)}" for key, value in settings.get("options", {}).items())
    if settings.get("frame", "sight") != "sight":
        yield f"--frame {settings['frame']}"
    yield f"--steps {settings['steps']}" if settings.get("steps") else f"--minutes {settings['budget_s'] / 60:g}"
    yield f"--batch {settings['batch']} --seed {settings['seed']}"
    for chosen, given, names in (
        (settings, usual, {name: name for name in _VALUES}),
        (loss, usual_loss, _LOSS),
        (data, usual_data, _DATA),
    ):
        yield from (f"--{names[n]} {_plain(chosen[n])}" for n in names if chosen.get(n, given[n]) != given[n])
    yield from (f"--{option}" for name, option in _SWITCHES.items() if loss.get(name))
    yield from (f"--class-weight {c}={w:g}" for c, w in zip(CLASSES, loss.get("class_weights", ()), strict=False))
    if "perturbation" in data:
        yield "--data pcn"
    yield from (f"--{n} {starting_point(settings[n])}" for n in ("start", "teacher") if settings.get(n))
    if "simulated_share" in data:
        yield " ".join(drive_bys(1 + str(data.get("simulated_set", "")).count("+")))
        yield f"--simulated-share {data['simulated_share']:g}"


def _plain(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)
