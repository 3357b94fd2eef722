# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train fit``: train a network, alone or under torchrun, or go on with a run."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.config import require
from edge.errors import ExitCode
from train.output import on_a_screen

if TYPE_CHECKING:
    from train.dataset import CompletionDataset, DatasetSettings

_ALLOCATOR = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "20000000000",
    "MALLOC_TOP_PAD_": "1000000000",
    "OMP_WAIT_POLICY": "PASSIVE",
}
"""glibc otherwise returns large tensors to the kernel at every step (1.4 times slower); OpenMP otherwise spins."""
_TRUTH, _POINTS = 4096, 1024


def add_verb(verbs: Any) -> None:
    """Add ``fit`` to the verbs of a parser."""
    fit = verbs.add_parser("fit", help="train a network, or go on with a run (see docs/training.md)")
    fit.add_argument("run_folder", type=Path, help="checkpoint.pt and log.jsonl go here")
    fit.add_argument("--resume", action="store_true", help="continue the run in the folder exactly where it stopped")
    on_a_screen(fit, "RUN_FOLDER")
    _add_what(fit)
    fit.add_argument("--minutes", type=float, default=60.0, help="training time; a run of any length ends annealed")
    fit.add_argument("--steps", type=int, default=0, help="optimizer steps instead of minutes")
    fit.add_argument("--stop-after", type=float, default=0.0, metavar="MINUTES", help="end now, to be resumed later")
    fit.add_argument("--batch", type=int, default=16, help="samples of a step, of each process")
    fit.add_argument("--rate", type=float, default=1e-3, help="highest learning rate")
    fit.add_argument("--cells", type=int, default=4, help="of 16 shares of the fine cloud, how many in a step")
    fit.add_argument("--average", type=float, default=0.999, help="decay of the averaged weights")
    fit.add_argument("--emd-points", type=int, default=512, help="points that are matched")
    fit.add_argument("--fine-emd", type=float, default=0.0, metavar="W", help="weight of the EMD of random fine points")
    coarse = "weight of the EMD of the coarse points (queries, adapointr)"
    fit.add_argument("--coarse-emd", type=float, default=0.0, metavar="W", help=coarse)
    fit.add_argument("--beta", type=float, default=0.02, help="weight of the cross entropy of the classes")
    fit.add_argument("--seed", type=int, default=0)
    fit.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N")
    fit.add_argument("--precision", choices=("fp32", "bf16"), default="fp32", help="of the inner layers")
    fit.add_argument("--threads", type=int, default=2)
    fit.add_argument("--workers", type=int, default=1, help="processes that prepare samples")
    fit.add_argument("--squared", action="store_true", help="the squared distances of the paper's equations")
    fit.add_argument("--class-weight", action="append", default=[], metavar="CLASS=W", help="relative, 1 by default")
    fit.add_argument("--joint-uncertainty", action="store_true", help="the expected distance moves the points too")
    fit.add_argument("--start", default="", metavar="MODEL", help="begin with its weights: checkpoint or model folder")
    fit.add_argument("--teacher", default="", metavar="CHECKPOINT", help="learn from this trained network too")
    fit.add_argument("--tensorboard", action="store_true", help="also write event files for TensorBoard")
    fit.set_defaults(run=_fit)


def _add_what(fit: argparse.ArgumentParser) -> None:
    """Which network and which data."""
    fit.add_argument("--network", default="queries", help="queries, narrow, paper, pcn or adapointr")
    widths = "edge, wide, tiny; paper too for narrow, paper, pcn; full, small, tiny for adapointr"
    fit.add_argument("--width", default="", help=widths)
    fit.add_argument("--option", action="append", default=[], metavar="KEY=VALUE", help="of the network; repeatable")
    fit.add_argument("--frame", choices=("sight", "box"), default="sight", help="line of sight in metres, or box prior")
    fit.add_argument("--data", choices=("ours", "pcn"), default="ours", help="radar-like, or clean depth scans")
    fit.add_argument(
        "--simulated", type=Path, action="append", help="folder or file of simulated clouds to mix in; repeatable"
    )
    fit.add_argument("--simulated-share", type=float, default=0.5, metavar="SHARE", help="of the training samples")
    fit.add_argument("--points", type=int, default=_POINTS, help="of a training input at most")
    fit.add_argument("--truth-points", type=int, default=_TRUTH, help="of a training truth")


def _fit(options: argparse.Namespace) -> int:
    if options.own_process and any(os.environ.get(name) != value for name, value in _ALLOCATOR.items()):
        os.environ.update(_ALLOCATOR)  # read by the C library at start only, hence the new start
        os.execv(sys.executable, [sys.executable, "-m", "train.cli", *sys.argv[1:]])
    from train.fit import FitSettings, Trainer
    from train.losses import LossSettings
    from train.networks.registry import NETWORKS, parse_options

    network_options = parse_options(options.network, options.option)
    loss = LossSettings(
        squared=options.squared,
        emd_points=options.emd_points,
        fine_emd=options.fine_emd,
        coarse_emd=options.coarse_emd,
        beta=options.beta,
        joint=options.joint_uncertainty,
        class_weights=_class_weights(options.class_weight),
    )
    chosen = {field.name for field in fields(FitSettings)} & set(vars(options)) - {"width"}
    settings = FitSettings(
        width=options.width or NETWORKS[options.network].width,
        options=network_options,
        budget_s=60 * options.minutes,
        stop_after_s=60 * options.stop_after,
        loss=loss,
        **{name: getattr(options, name) for name in chosen},
    )
    trainer = Trainer(settings, *_data(options), options.run_folder, options.resume)
    trainer.run()
    trainer.group.close()
    return int(ExitCode.OK)


def _data(options: argparse.Namespace) -> tuple[CompletionDataset, CompletionDataset]:
    """Training data as asked for; validation on our data, whatever was trained on."""
    from train.dataset import CompletionDataset, DatasetSettings

    box = options.frame == "box"
    of: type[DatasetSettings] = DatasetSettings
    make = of.pcn if options.data == "pcn" else of.default
    data = make(truth_points=options.truth_points, max_points=options.points, box_frame=box)
    train = CompletionDataset("train", data, options.seed)
    if options.simulated:
        from train.simulated import SimulatedDataset

        require(options.data == "ours", "--simulated with --data", options.data, "ours")
        train = SimulatedDataset(options.simulated, "train", data, options.seed, options.simulated_share)
        print(train.summary, flush=True)
    return train, CompletionDataset("val", DatasetSettings.default(box_frame=box), 0)


def _class_weights(pairs: list[str]) -> tuple[float, ...]:
    """``car=1.5`` texts as one weight for every class; () when there are none."""
    from train.objects.mesh import CLASSES

    weights = dict.fromkeys(map(str, CLASSES), 1.0)
    for pair in pairs:
        name, _, text = pair.partition("=")
        require(name in weights, "--class-weight", pair, ", ".join(f"{c}=..." for c in CLASSES))
        try:
            weights[name] = float(text)
        except ValueError:
            require(False, "--class-weight", pair, f"{name}=number")
    return tuple(weights.values()) if pairs else ()
