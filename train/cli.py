# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train``: simulate data, fit a network, evaluate a model, export a checkpoint to a model folder."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.errors import ExitCode, ModelError, RfconstructError
from train.objects.commands import add_verbs as object_verbs
from train.simulate.bench_command import add_verb as add_bench_verb
from train.simulate.command import add_verb
from train.simulate.look_command import add_verbs as add_look_verbs
from train.simulate.rig_command import add_verb as add_rig_verb

if TYPE_CHECKING:
    from train.checkpoint import Checkpoint
    from train.evaluate import Scores

_ALLOCATOR = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "20000000000",
    "MALLOC_TOP_PAD_": "1000000000",
    "OMP_WAIT_POLICY": "PASSIVE",
}
"""glibc otherwise returns large tensors to the kernel at every step (1.4 times slower); OpenMP otherwise spins."""
_SAMPLES, _EMD_SAMPLES, _BANK = 192, 96, 800
_TRAIN_TRUTH, _TRAIN_POINTS = 4096, 1024


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
    fit = verbs.add_parser("fit", help="train a network, or go on with a run")
    fit.add_argument("run_folder", type=Path, help="checkpoint.pt and log.jsonl go here")
    fit.add_argument("--resume", action="store_true", help="continue the run in the folder exactly where it stopped")
    fit.add_argument("--width", choices=("edge", "paper", "tiny"), default="edge")
    fit.add_argument("--minutes", type=float, default=60.0, help="training time; a run of any length ends annealed")
    fit.add_argument("--steps", type=int, default=0, help="optimizer steps instead of minutes")
    fit.add_argument("--batch", type=int, default=16)
    fit.add_argument("--seed", type=int, default=0)
    fit.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N")
    fit.add_argument("--threads", type=int, default=2)
    fit.add_argument("--workers", type=int, default=1, help="processes that prepare samples")
    fit.add_argument("--squared", action="store_true", help="the squared distances of the paper's equations")
    fit.add_argument("--tensorboard", action="store_true", help="also write event files for TensorBoard")
    fit.add_argument("--simulated", type=Path, help="folder or file of simulated clouds to mix in")
    fit.add_argument("--simulated-share", type=float, default=0.5, help="of the training samples")
    fit.set_defaults(run=_fit)
    add_verb(verbs)
    add_rig_verb(verbs)
    add_bench_verb(verbs)
    add_look_verbs(verbs)
    for name, run, text in (
        ("evaluate", _evaluate, "measure a model folder on held-out objects"),
        ("export", _export, "write a model folder from a checkpoint, measured, with card and manifest"),
    ):
        verb = verbs.add_parser(name, help=text)
        verb.add_argument("source", type=Path, help="model folder" if name == "evaluate" else "checkpoint.pt")
        verb.add_argument("--samples", type=int, default=_SAMPLES, help="held-out samples")
        verb.add_argument("--emd-samples", type=int, default=_EMD_SAMPLES, help="of these, with EMD")
        verb.add_argument("--bank", type=int, default=_BANK, help="training shapes of the baselines, 0 = no baselines")
        verb.add_argument("--threads", type=int, default=1)
        verb.set_defaults(run=run)
        if name == "evaluate":
            verb.add_argument("--split", choices=("val", "test"), default="test")
            verb.add_argument("--json", type=Path, help="write all figures here")
        else:
            verb.add_argument("target", type=Path, help="model folder, for example models/default")
            verb.add_argument("--name", default="", help="of the model; the folder's name by default")
            verb.add_argument("--rig", action="append", help="rig the model fits; may be repeated (cascade_pair)")
    object_verbs(verbs)
    return parser


def _fit(options: argparse.Namespace) -> int:
    if options.own_process and any(os.environ.get(name) != value for name, value in _ALLOCATOR.items()):
        os.environ.update(_ALLOCATOR)  # read by the C library at start only, hence the new start
        os.execv(sys.executable, [sys.executable, "-m", "train.cli", *sys.argv[1:]])
    from train.dataset import CompletionDataset, DatasetSettings
    from train.fit import FitSettings, Trainer
    from train.losses import LossSettings

    names = {"width", "steps", "batch", "seed", "device", "threads", "workers", "tensorboard"}
    values = {field.name: getattr(options, field.name) for field in fields(FitSettings) if field.name in names}
    settings = FitSettings(budget_s=60 * options.minutes, loss=LossSettings(squared=options.squared), **values)
    data = DatasetSettings.default(truth_points=_TRAIN_TRUTH, max_points=_TRAIN_POINTS)
    train = CompletionDataset("train", data, options.seed)
    if options.simulated:
        from train.simulated import SimulatedDataset

        train = SimulatedDataset(options.simulated, "train", data, options.seed, options.simulated_share)
        print(train.summary, flush=True)
    validation = CompletionDataset("val", DatasetSettings.default(), 0)
    Trainer(settings, train, validation, options.run_folder, options.resume).run()
    return int(ExitCode.OK)


def _scores(options: argparse.Namespace, folder: Path, split: str) -> dict[str, Scores]:
    from train.baselines import Bank
    from train.dataset import CompletionDataset, DatasetSettings
    from train.evaluate import OnnxModel, evaluate
    from train.manifest import FULL, SMALL

    bank = Bank(CompletionDataset("train", DatasetSettings.default(), 1), options.bank) if options.bank else None
    dataset = CompletionDataset("val" if split == "val" else "test", DatasetSettings.default(), 0)
    models = {name: OnnxModel(folder / name) for name in (FULL, SMALL)}
    return evaluate(models, dataset, options.samples, options.emd_samples, bank, options.threads)


def _evaluate(options: argparse.Namespace) -> int:
    from train.evaluate import MACRO, table
    from train.manifest import FULL, SMALL

    scores = _scores(options, options.source, options.split)
    rows = [(f"{name} {c}", name, c) for name in (FULL, SMALL) for c in [*scores[FULL].classes, MACRO]]
    rows += [(name, name, MACRO) for name in scores if name not in (FULL, SMALL)]
    print(table(scores, rows))
    for name in (FULL, SMALL):
        print(f"{name} class accuracy {scores[name].summary('class_right').mean:.3f} (macro)")
    if options.json:
        options.json.write_text(json.dumps({name: asdict(one) for name, one in scores.items()}) + "\n")
    return int(ExitCode.OK)


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
