# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train export``: a checkpoint becomes a model folder: two files, manifest, known answers and card."""

from __future__ import annotations

import argparse
import json
import platform
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.config import require
from edge.errors import ExitCode, ModelError
from train.output import add_json, emit

if TYPE_CHECKING:
    from edge.frames import Float32
    from train.checkpoint import Checkpoint
    from train.dataset import CompletionDataset
    from train.evaluate import Scores
    from train.network import CompletionModel
    from train.objects.library import Split

_SAMPLES, _EMD_SAMPLES, _BANK = 192, 96, 800
_CALIBRATION_INPUTS, _GOLDEN_INPUTS, _CALIBRATION_SEED = 96, 48, 7
_DATASET = {
    "sight": "true scale, any heading, seen along the line of sight (x) and over the ground (z = 0), both with errors",
    "box": "in the object's own box: heading and centre known, lengths in diagonals of the box",
}


def add_verb(verbs: argparse._SubParsersAction[Any]) -> None:
    """The verb and its options."""
    verb = verbs.add_parser("export", help="write a model folder from a checkpoint, measured, with card and manifest")
    verb.add_argument("source", type=Path, help="checkpoint.pt")
    verb.add_argument("target", type=Path, help="model folder, for example models/default")
    verb.add_argument("--name", default="", help="of the model; the folder's name by default")
    verb.add_argument("--rig", action="append", help="rig the model fits; may be repeated (cascade_pair)")
    verb.add_argument("--simulated", type=Path, action="append", help="drive-bys: calibrate and gate int8 on them, too")
    verb.add_argument("--confidence", type=Path, help="calibrated confidence (JSON of evaluate) for the manifest")
    verb.add_argument("--weight-bits", type=int, choices=(7, 8), default=8, help="7: int8 saturates on no processor")
    verb.add_argument("--samples", type=int, default=_SAMPLES, help="held-out samples")
    verb.add_argument("--emd-samples", type=int, default=_EMD_SAMPLES, help="of these, with EMD")
    verb.add_argument("--bank", type=int, default=_BANK, help="training shapes of the baselines, 0 = no baselines")
    verb.add_argument("--threads", type=int, default=1)
    add_json(verb)
    verb.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Export, quantize, measure; the folder is replaced when all is done."""
    from train.checkpoint import load_checkpoint
    from train.export import INT8_NODES, build, export
    from train.manifest import FULL, SMALL
    from train.networks.registry import of_checkpoint
    from train.quantize import quantize

    require(options.samples >= 1, "--samples", options.samples, ">= 1")
    if options.confidence is not None and not options.confidence.is_file():
        raise ModelError(f"{options.confidence}: no such file", action="evaluate --fit-confidence makes it")
    checkpoint, target = load_checkpoint(options.source), options.target
    if not checkpoint.step:
        raise ModelError(f"{options.source}: not trained yet", action="train first")
    network = of_checkpoint(checkpoint)
    model = build(network, classifier=checkpoint.settings["network"] != "paper")
    inputs = calibration_inputs(network, _sets(options, network, "val"))
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".export-") as name:
        folder = Path(name)
        export(model, folder / FULL)
        export(quantize(model, INT8_NODES, inputs, options.weight_bits), folder / SMALL)
        _measure(options, checkpoint, network, folder)
        for path in sorted(folder.iterdir()):
            path.replace(target / path.name)
    manifest = json.loads((target / "manifest.json").read_text())
    emit(options, {"folder": str(target), "manifest": manifest}, [(target / "card.md").read_text()])
    return int(ExitCode.OK)


def _sets(options: argparse.Namespace, network: CompletionModel, split: Split) -> list[CompletionDataset]:
    """Held-out data of every kind that was given, in the network's frame."""
    from train.dataset import CompletionDataset, DatasetSettings
    from train.simulated import SimulatedDataset

    settings = DatasetSettings.default(box_frame=network.frame == "box")
    sets = [CompletionDataset(split, settings, _CALIBRATION_SEED if split == "val" else 0)]
    if options.simulated:
        sets.append(SimulatedDataset(options.simulated, split, settings, 0))
    return sets


def calibration_inputs(network: CompletionModel, sets: list[CompletionDataset]) -> list[Float32]:
    """Validation clouds of every kind of data in equal parts, as the network reads them."""
    from train.batches import collate
    from train.evaluate import spread

    count = _CALIBRATION_INPUTS // len(sets)
    return [
        collate([data[index]], network.frame, network.columns).points_m.numpy()
        for data in sets
        for index in spread(len(data), count)
    ]


def _measure(options: argparse.Namespace, checkpoint: Checkpoint, network: CompletionModel, folder: Path) -> None:
    """Choose the default file on the validation split, measure on the test split, write golden, manifest and card."""
    from edge.completion.confidence import ConfidenceModel
    from train.baselines import Bank
    from train.card import write_card
    from train.dataset import CLASSES, CompletionDataset, DatasetSettings
    from train.evaluate import OnnxModel, evaluate, int8_is_faster, int8_is_good
    from train.manifest import FULL, SMALL, write_golden, write_manifest

    models = {name: OnnxModel(folder / name, network.frame) for name in (FULL, SMALL)}
    sets = _sets(options, network, "val")
    gates = [evaluate(models, data, options.samples, 0, threads=options.threads) for data in sets]
    pays = int8_is_faster(gates[0], FULL, SMALL) and all(int8_is_good(gate, FULL, SMALL) for gate in gates)
    default = SMALL if pays else FULL
    settings = DatasetSettings.default(box_frame=network.frame == "box", neighbour_probability=0.0)
    bank = Bank(CompletionDataset("train", settings, 1), options.bank) if options.bank else None
    test = _sets(options, network, "test")[0]
    scores = evaluate(models, test, options.samples, options.emd_samples, bank, options.threads)
    tolerance_m = write_golden(folder / "golden.npz", models, calibration_inputs(network, sets)[:_GOLDEN_INPUTS])
    confidence = None
    if options.confidence is not None:
        confidence = ConfidenceModel.from_dict(json.loads(options.confidence.read_text()))
    name, training = options.name or options.target.name, _training(checkpoint, network, scores[default])
    classes = CLASSES if models[FULL].has_classes else ()
    rigs = options.rig or ["cascade_pair"]
    write_manifest(folder, name, default, network, classes, rigs, tolerance_m, confidence, training)
    files = {"int8": SMALL, "fp32": FULL} if default == SMALL else {"fp32": FULL, "int8": SMALL}
    commands = _commands(options, checkpoint.settings)
    write_card(folder / "card.md", name, scores, files, training, commands, confidence)


def _training(checkpoint: Checkpoint, network: CompletionModel, scores: Scores) -> dict[str, Any]:
    metrics = ("cd_cm", "accuracy_cm", "completeness_cm", "emd_cm", "f_5cm", "f_10cm", "f_1pct", "class_right")
    from train.fit_text import starting_point

    settings = dict(checkpoint.settings)
    for name in ("start", "teacher"):  # where it lay is nobody's business, which one it was is
        if settings.get(name):
            settings[name] = starting_point(settings[name])
    share = settings.get("data", {}).get("simulated_share", 0.0)
    drive_bys = f"; {100 * share:.0f} % simulated drive-bys as the pipeline saw them" if share else ""
    return {
        "samples": checkpoint.samples,
        "samples_before": settings.get("samples_before", 0),
        "seconds": round(checkpoint.elapsed_s),
        "seed": settings["seed"],
        "network": settings["network"],
        "width": settings["width"],
        "frame": network.frame,
        "parameters": network.parameter_count,
        "device": f"{settings['device']} ({platform.machine()}, {settings['threads']} threads)",
        "dataset": "Partial clouds made from meshes on the fly (visible surface, holes, noise spheres, ghosts), "
        f"{_DATASET[network.frame]}; simulated geometry{drive_bys}, no radar recording",
        "settings": settings,
        "metrics": {
            "split": "test",
            "macro": {name: asdict(scores.summary(name)) for name in metrics if scores.measured(name)},
            "by_class": {c: round(scores.summary("cd_cm", c).mean, 3) for c in scores.classes},
        },
    }


def _commands(options: argparse.Namespace, settings: dict[str, Any]) -> dict[str, str]:
    from train.fit_text import drive_bys, fit_command

    source, target = options.source.resolve().parent.name, options.name or options.target.name
    more = drive_bys(len(options.simulated)) if options.simulated else []
    more += [f"--confidence {options.confidence.name}"] if options.confidence else []
    more += [f"--rig {rig}" for rig in options.rig or []]
    given: Callable[[str], str] = lambda name: f"--{name.replace('_', '-')} {getattr(options, name)}"  # noqa: E731
    return {
        "fit": fit_command(source, settings),
        "export": f"rfconstruct-train export runs/{source}/checkpoint.pt models/{target} "
        + " ".join([*(given(name) for name in ("samples", "emd_samples", "bank")), *more]),
    }
