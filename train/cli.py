# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train``: simulate data, fit a network, evaluate a model, export a checkpoint to a model folder."""

from __future__ import annotations

import argparse
import platform
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.errors import ExitCode, ModelError, RfconstructError
from train.evaluate_command import add_verb as add_evaluate_verb
from train.fit_command import add_verb as add_fit_verb
from train.objects.commands import add_verbs as object_verbs
from train.simulate.bench_command import add_verb as add_bench_verb
from train.simulate.command import add_verb
from train.simulate.look_command import add_verbs as add_look_verbs
from train.simulate.rig_command import add_verb as add_rig_verb

if TYPE_CHECKING:
    from train.checkpoint import Checkpoint
    from train.evaluate import Scores

_SAMPLES, _EMD_SAMPLES, _BANK = 192, 96, 800


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns an exit code of ``edge.errors.ExitCode``."""
    options = _parser().parse_args(arguments)
    options.own_process = arguments is None
    try:
        return int(options.run(options))
    except RfconstructError as error:
        print(f"rfconstruct-train: {error}", file=sys.stderr)
        return int(error.exit_code)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="rfconstruct-train", description=__doc__)
    verbs = parser.add_subparsers(required=True, metavar="verb")
    add_fit_verb(verbs)
    add_verb(verbs)
    add_rig_verb(verbs)
    add_bench_verb(verbs)
    add_look_verbs(verbs)
    add_evaluate_verb(verbs)
    verb = verbs.add_parser("export", help="write a model folder from a checkpoint, measured, with card and manifest")
    verb.add_argument("source", type=Path, help="checkpoint.pt")
    verb.add_argument("target", type=Path, help="model folder, for example models/default")
    verb.add_argument("--name", default="", help="of the model; the folder's name by default")
    verb.add_argument("--rig", action="append", help="rig the model fits; may be repeated (cascade_pair)")
    verb.add_argument("--samples", type=int, default=_SAMPLES, help="held-out samples")
    verb.add_argument("--emd-samples", type=int, default=_EMD_SAMPLES, help="of these, with EMD")
    verb.add_argument("--bank", type=int, default=_BANK, help="training shapes of the baselines, 0 = no baselines")
    verb.add_argument("--threads", type=int, default=1)
    verb.set_defaults(run=_export)
    object_verbs(verbs)
    return parser


def _scores(options: argparse.Namespace, folder: Path, split: str) -> dict[str, Scores]:
    from train.baselines import Bank
    from train.dataset import CompletionDataset, DatasetSettings
    from train.evaluate import OnnxModel, evaluate
    from train.manifest import FULL, SMALL

    bank = Bank(CompletionDataset("train", DatasetSettings.default(), 1), options.bank) if options.bank else None
    dataset = CompletionDataset("val" if split == "val" else "test", DatasetSettings.default(), 0)
    models = {name: OnnxModel(folder / name) for name in (FULL, SMALL)}
    return evaluate(models, dataset, options.samples, options.emd_samples, bank, options.threads)


def _export(options: argparse.Namespace) -> int:
    from train.checkpoint import load_checkpoint
    from train.export import export
    from train.manifest import FULL, SMALL
    from train.quantize import quantize

    checkpoint, target = load_checkpoint(options.source), options.target
    if not checkpoint.step:
        raise ModelError(f"{options.source}: not trained yet", action="train first")
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".export-") as name:
        folder = Path(name)
        export(checkpoint.average, folder / FULL)
        quantize(folder / FULL, folder / SMALL)
        _measure(options, checkpoint, folder)
        for path in sorted(folder.iterdir()):
            path.replace(target / path.name)
    print((target / "card.md").read_text())
    return int(ExitCode.OK)


def _measure(options: argparse.Namespace, checkpoint: Checkpoint, folder: Path) -> None:
    """Choose the default file on the validation split, measure on the test split, write golden, manifest and card."""
    from train.card import write_card
    from train.dataset import CompletionDataset, DatasetSettings
    from train.evaluate import OnnxModel, evaluate, int8_is_good, spread
    from train.manifest import FULL, SMALL, write_golden, write_manifest

    models = {name: OnnxModel(folder / name) for name in (FULL, SMALL)}
    validation = CompletionDataset("val", DatasetSettings.default(), 0)
    gate = evaluate(models, validation, options.samples, 0, threads=options.threads)
    default = SMALL if int8_is_good(gate, FULL, SMALL) else FULL
    inputs = [validation[index].partial for index in spread(len(validation), min(8, options.samples))]
    tolerance_m = write_golden(folder / "golden.npz", models, inputs)
    scores = _scores(options, folder, "test")
    training = _training(checkpoint, scores[default])
    name = options.name or options.target.name
    write_manifest(folder, name, default, options.rig or ["cascade_pair"], tolerance_m, training)
    files = {"int8": SMALL, "fp32": FULL} if default == SMALL else {"fp32": FULL, "int8": SMALL}
    write_card(folder / "card.md", name, scores, files, training, _commands(options, checkpoint.settings))


def _training(checkpoint: Checkpoint, scores: Scores) -> dict[str, Any]:
    metrics = ("cd_cm", "accuracy_cm", "completeness_cm", "emd_cm", "f_5cm", "f_10cm", "f_1pct", "class_right")
    settings = checkpoint.settings
    return {
        "samples": checkpoint.samples,
        "seconds": round(checkpoint.elapsed_s),
        "seed": settings["seed"],
        "width": settings["width"],
        "parameters": sum(value.numel() for value in checkpoint.average.values()),
        "device": f"{settings['device']} ({platform.machine()}, {settings['threads']} threads, other work beside it)",
        "dataset": "Partial clouds made from meshes on the fly (visible surface, holes, noise spheres, ghosts), "
        "true scale, any heading, seen along the line of sight (x) and over the ground (z = 0), both with errors; "
        "simulated geometry, no radar data",
        "settings": settings,
        "metrics": {
            "split": "test",
            "macro": {name: asdict(scores.summary(name)) for name in metrics if scores.measured(name)},
            "by_class": {c: round(scores.summary("cd_cm", c).mean, 3) for c in scores.classes},
        },
    }


def _commands(options: argparse.Namespace, settings: dict[str, Any]) -> dict[str, str]:
    return {
        "fit": f"rfconstruct-train fit runs/{options.source.resolve().parent.name} --width {settings['width']} "
        f"--minutes {settings['budget_s'] / 60:g} --batch {settings['batch']} --seed {settings['seed']}",
        "export": f"rfconstruct-train evaluate models/{options.target.name} --samples {options.samples} "
        f"--emd-samples {options.emd_samples} --bank {options.bank}",
    }


if __name__ == "__main__":
    sys.exit(main())
