# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train bench-completion``: the shipped model beside a transformer and the paper's network."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edge.bench.measure import Timing, measure, processor
from edge.completion.manifest import Manifest, find_model, read_files, read_manifest
from edge.completion.network import Network
from edge.config import require
from edge.errors import ExitCode
from train.output import add_json, emit

if TYPE_CHECKING:
    from torch import Tensor

    from train.network import CompletionNetwork

POINTS = 2048
OURS_MS, TRANSFORMER_RATIO, NAIVE_RATIO, RESIDENT_MB = 20.0, 25.0, 15.0, 350.0
"""Goals."""
_TRANSFORMER, _SAMPLING, _NAIVE = "AdaPoinTr-style transformer", "of it, farthest-point sampling", "paper's network"


def add_verb(verbs: argparse._SubParsersAction[Any]) -> None:
    """The verb and its options."""
    verb = verbs.add_parser("bench-completion", help="speed of a shipped model beside its peers, one thread")
    verb.add_argument("model", nargs="?", default="default", help="name or folder (default: %(default)s)")
    verb.add_argument("--rig", default="cascade_pair", help="rig whose whole runtime is measured (%(default)s)")
    verb.add_argument("--seconds", type=float, default=60.0, help="time to spend measuring (default: %(default)s)")
    verb.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    add_json(verb)
    verb.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Measure and print."""
    import torch

    from edge.bench.startup import start

    require(options.seconds > 0, "--seconds", options.seconds, "> 0 s")
    torch.set_num_threads(1)
    folder = find_model(options.model)
    manifest = read_manifest(folder)
    times = measure(_calls(manifest, read_files(folder, manifest)), options.seconds)
    resident_mb = start(options.rig, "completion").resident_mb
    text = "\n".join(_lines(manifest, times, resident_mb))
    facts = {"processor": processor(), "model": manifest.name, "default_file": manifest.default_file}
    figures = {name: asdict(timing) for name, timing in times.items()}
    emit(options, {**facts, "times": figures, "resident_mb": resident_mb}, [text])
    if options.markdown is not None:
        command = f"rfconstruct-train bench-completion {options.model} --seconds {options.seconds:g} "
        command += f"--markdown {options.markdown}"
        head = f"# Benchmarks of the completion\n\nWritten by one command; do not edit:\n\n```\n{command}\n```\n\n"
        options.markdown.write_text(head + text + "\n")
    return int(ExitCode.OK)


def _calls(manifest: Manifest, contents: dict[str, bytes]) -> dict[str, Callable[[], object]]:
    """What competes; all get the same 2048 points and give 16,384."""
    import torch

    from train.network import CompletionNetwork
    from train.networks.neighbours import farthest
    from train.networks.registry import build

    rng = np.random.default_rng(0)
    cloud = (rng.normal(size=(POINTS, 3)) * (1.5, 0.6, 0.5) + (8, -3, 0.8)).astype(np.float32)
    powers = np.zeros((POINTS, manifest.columns - 3), np.float32)
    inputs, tensor = np.concatenate([cloud, powers], axis=1), torch.from_numpy(cloud)

    def shipped(network: Network) -> Callable[[], object]:
        return lambda: network.run(inputs)

    calls = {file: shipped(Network(contents[file], file)) for file in manifest.files}
    torch.manual_seed(0)
    transformer, paper = build("adapointr").eval(), build("paper").eval()
    assert isinstance(paper, CompletionNetwork)

    def peer(call: Callable[[], object]) -> Callable[[], object]:
        def quietly() -> object:
            with torch.inference_mode():
                return call()

        return quietly

    return calls | {
        _TRANSFORMER: peer(lambda: transformer(tensor, [POINTS])),
        _SAMPLING: peer(lambda: farthest(tensor[None], 512)),
        _NAIVE: peer(lambda: naive(paper, tensor)),
    }


def naive(network: CompletionNetwork, points_m: Tensor) -> Tensor:
    """The paper's network as its equations read: everything concatenated for every point; fine points [16384, 3]."""
    import torch
    from torch.nn.functional import relu

    points, center, _ = network.to_units(points_m, [len(points_m)])
    first = network.point2(relu(network.point1(points)))
    both = torch.cat([first, first.amax(0).expand_as(first)], 1)
    local = network.local2(relu(network.local1(both)))
    feature = local.amax(0)
    coarse = network.coarse3(relu(network.coarse2(relu(network.coarse1(feature))))).view(-1, 3)
    found = local[torch.cdist(coarse, points).argmin(1)]
    cells = len(network.patch)
    rows = torch.cat(
        [
            network.patch.repeat(len(coarse), 1),
            coarse.repeat_interleave(cells, 0),
            found.repeat_interleave(cells, 0),
            feature.expand(len(coarse) * cells, -1),
        ],
        1,
    )
    offset = network.fold3(relu(network.fold2(relu(network.fold1(rows)))))
    fine: Tensor = (rows[:, 2:5] + offset) * network.scale + center
    return fine


def _lines(manifest: Manifest, times: dict[str, Timing], resident_mb: float) -> Iterator[str]:
    from edge.bench.report import table  # it brings the signal path

    ours = times[manifest.default_file].median_ms
    about = {file: f"shipped, {one.precision}, {one.size / 1e6:.1f} MB" for file, one in manifest.files.items()}
    about |= {
        _TRANSFORMER: "torch fp32, its architecture with random weights, written from the publication",
        _SAMPLING: "512 of 2048 points in torch; other code for it is faster",
        _NAIVE: "torch fp32, random weights, everything concatenated for every fine point",
    }
    goals = {manifest.default_file: f"<= {OURS_MS:g} ms", _TRANSFORMER: f">= {TRANSFORMER_RATIO:g}x"}
    goals[_NAIVE] = f">= {NAIVE_RATIO:g}x"
    yield f"{processor()}; one thread, {POINTS} -> {manifest.fine_points} points, CPU time of the thread, all in one"
    yield f"process, in turn. Model `{manifest.name}`, default file `{manifest.default_file}`."
    yield ""
    rows = []
    for name, timing in times.items():
        part = [f"{name}: {about[name]}", f"{timing.median_ms:.1f}", f"{timing.p99_ms:.1f}"]
        rows.append([*part, f"{timing.median_ms / ours:.1f}", goals.get(name, ""), str(timing.repetitions)])
    yield from table(["what", "median ms", "p99 ms", "times the default", "goal", "runs"], rows)
    without = (times[_TRANSFORMER].median_ms - times[_SAMPLING].median_ms) / ours
    yield f"Without the sampling the transformer takes {without:.1f} times as long as the default file."
    yield ""
    yield (
        f"Resident memory of the whole edge runtime (signal path, association, tracking, completion), ready: "
        f"{resident_mb:.0f} MB (goal: <= {RESIDENT_MB:g} MB)."
    )
