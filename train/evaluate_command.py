# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train evaluate``: models, checkpoints and baselines on held-out objects, as a table and a report."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.config import require
from edge.errors import ConfigError, ExitCode, ModelError
from train.output import on_a_screen

if TYPE_CHECKING:
    from edge.completion.confidence import ConfidenceModel
    from train.baselines import Bank
    from train.held_out import Case, Source
    from train.objects.library import Split
    from train.predictors import Predictor
    from train.report import Part

_SAMPLES, _EMD_SAMPLES, _BANK = 192, 96, 800
_CLUTTER, _EXACT = 100, 3


def add_verb(verbs: Any) -> None:
    """Add the verb and its options to the parser."""
    verb = verbs.add_parser("evaluate", help="measure models on held-out objects, against baselines")
    verb.add_argument(
        "models",
        nargs="+",
        help="model folder, .onnx file of a model folder, or checkpoint.pt; NAME=PATH to name it; the report is about "
        "the first",
    )
    on_a_screen(verb, "MODEL ...")
    verb.add_argument("--split", choices=("val", "test"), default="test")
    verb.add_argument("--simulated", type=Path, action="append", help="set of drive-bys: folder or file; repeatable")
    verb.add_argument(
        "--source", choices=("scans", "drive-bys", "both"), help="default: both where --simulated is given"
    )
    verb.add_argument("--samples", type=int, default=_SAMPLES, help="held-out samples of a source")
    verb.add_argument("--emd-samples", type=int, default=_EMD_SAMPLES, help="of these, with EMD")
    verb.add_argument("--bank", type=int, default=_BANK, help="training shapes of the baselines, 0 = no baselines")
    verb.add_argument("--threads", type=int, default=1)
    verb.add_argument("--confidence", type=Path, help="take the first model's confidence from this file")
    verb.add_argument("--fit-confidence", type=Path, help="fit it on the val split first and write it here")
    verb.add_argument("--robustness", type=int, default=0, help="samples that are worsened, each some 40 times")
    verb.add_argument("--gallery", type=int, default=0, help="random samples in a picture, columns as models are given")
    verb.add_argument("--pictures", type=Path, help="folder: gallery, worst ten and calibration as PNG")
    verb.add_argument("--coarse", action="append", default=[], help="model whose coarse cloud is a column too")
    verb.add_argument("--seed", type=int, default=0, help="of gallery and robustness")
    verb.add_argument("--markdown", type=Path, help="write the report here")
    verb.add_argument("--json", type=Path, help="write all figures here")
    verb.add_argument("--update", type=Path, help="document whose section is replaced, for example docs/results.md")
    verb.add_argument("--section", help="of that document; default: SETTING-SOURCE-SPLIT")
    verb.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Evaluate; returns an exit code."""
    from train.report import markdown, plain, update_section

    require(options.samples >= 1, "--samples", options.samples, ">= 1")
    require(options.threads >= 1, "--threads", options.threads, ">= 1")
    models = dict(_named(text) for text in options.models)
    require(len(models) == len(options.models), "models", options.models, "different names (NAME=PATH)")
    source = options.source or ("both" if options.simulated else "scans")
    if source != "scans" and not options.simulated:
        raise ConfigError("drive-bys are read from a data set", action="give --simulated FOLDER")
    opened = {name: _open(path) for name, path in models.items()}
    command = _command(options)
    parts = []
    for setting in ("nobbox", "bbox"):
        here = {name: one for name, one in opened.items() if _in_box(one) == (setting == "bbox")}
        if here:
            parts.append(_part(options, setting, source, here))
    texts = [markdown(part, command) for part in parts]
    print("\n\n".join(texts))
    if options.markdown:
        options.markdown.write_text("\n\n".join(markdown(p, command, options.markdown.parent) for p in parts) + "\n")
    if options.json:
        options.json.write_text(json.dumps([plain(part, command) for part in parts]) + "\n")
    for part in parts if options.update else []:
        name = f"{part.setting}-{part.source}-{part.split}"
        if options.section:
            name = options.section if len(parts) == 1 else f"{options.section}-{part.setting}"
        update_section(options.update, name, markdown(part, command, options.update.parent))
    return int(ExitCode.OK)


def _part(options: argparse.Namespace, setting: str, source: str, models: dict[str, Predictor]) -> Part:
    """One setting: confidence, figures, robustness and pictures."""
    from train.baselines import FLOOR, floor
    from train.evaluate import measure
    from train.report import Part
    from train.robustness import clutter_named, robustness

    box = setting == "bbox"
    main = next(iter(models))
    trust = _confidence(options, models[main], source, box)
    if trust is not None:
        from train.confidence import Trusting

        models = models | {main: Trusting(models[main], trust)}
    cases = _cases(options, source, options.split, box, options.samples)
    bank = _bank(options, source, box)
    predictors: dict[str, Predictor] = models | (bank.predictors() if bank else {}) | {FLOOR: floor}
    part = Part(
        setting,
        source,
        options.split,
        main,
        list(models),
        measure(predictors, cases, options.emd_samples, options.threads),
    )
    if options.emd_samples:
        part.emd_excess = _emd_excess(models[main], cases)
    if options.robustness:
        some = _evenly(cases, options.robustness)
        part.levels = robustness(models[main], some, options.seed, options.threads)
        if not box:
            part.clutter = clutter_named(models[main], some, _CLUTTER)
    if options.pictures:
        _pictures(options, part, models, cases)
    return part


def _cases(options: argparse.Namespace, source: str, split: Split, box: bool, samples: int) -> Sequence[Case]:
    """Held-out cases of one source or of both, as many of each."""
    from train.held_out import Joined, held_out

    names: tuple[Source, ...] = ("scans", "drive-bys")
    chosen = [name for name in names if source in (name, "both")]
    return Joined([held_out(name, split, box, options.simulated).spread(samples) for name in chosen])


def _bank(options: argparse.Namespace, source: str, box: bool) -> Bank | None:
    """Training shapes from what training would draw: half simulated where the set is given."""
    if not options.bank:
        return None
    from train.baselines import Bank
    from train.dataset import CompletionDataset, DatasetSettings
    from train.simulated import SimulatedDataset

    # no neighbours and no added strays: shapes stand about their own clouds
    settings = DatasetSettings.default(box_frame=box, neighbour_probability=0.0, vary_clouds=False)
    if source == "scans":
        return Bank(CompletionDataset("train", settings, 1), options.bank)
    return Bank(SimulatedDataset(options.simulated, "train", settings, 1), options.bank)


def _confidence(options: argparse.Namespace, model: Predictor, source: str, box: bool) -> ConfidenceModel | None:
    """The confidence that replaces the model's own, if one is asked for."""
    from edge.completion.confidence import ConfidenceModel

    if options.fit_confidence:
        from train.confidence import confidence_for

        known = _cases(options, source, "val", box, options.samples)
        trust = confidence_for(model, known, seed=options.seed, threads=options.threads)
        options.fit_confidence.write_text(json.dumps(trust.to_dict()) + "\n")
        return trust
    if options.confidence is None:
        return None
    try:
        return ConfidenceModel.from_dict(json.loads(options.confidence.read_text()))
    except (OSError, ValueError) as error:
        raise ModelError(
            f"{options.confidence}: unreadable ({error})", action="fit it with --fit-confidence"
        ) from error


def _emd_excess(model: Predictor, cases: Sequence[Case]) -> list[float]:
    from train.metrics import emd_excess

    return [emd_excess(model(case).fine_m, case.sample.truth, case.number) for case in _evenly(cases, _EXACT)]


def _evenly(cases: Sequence[Case], count: int) -> list[Case]:
    from train.held_out import spread

    return [cases[position] for position in spread(len(cases), count)]


def _pictures(options: argparse.Namespace, part: Part, models: dict[str, Predictor], cases: Sequence[Case]) -> None:
    """Gallery of random cases, the worst ten, calibration."""
    from train.gallery import calibration_picture, case_row, drawn, gallery
    from train.report import WORST, calibrations

    stem = f"{part.setting}_{part.source}_{part.split}"
    if options.gallery:
        rows = []
        for position in drawn(part.scores[part.main].labels, options.gallery, options.seed):
            columns = []
            for name, model in models.items():
                answer = model(cases[position])
                if name in options.coarse and answer.coarse_m is not None:
                    columns.append((f"{name}, coarse", answer.coarse_m))
                columns.append((f"{name}, {part.scores[name].values['cd_cm'][position]:.1f} cm", answer.fine_m))
            rows.append(case_row(cases[position], columns))
        gallery(rows, path := options.pictures / f"gallery_{stem}.png")
        part.pictures.append((f"Random samples of the split {part.split} (seed {options.seed}), none chosen.", path))
    scores = part.scores[part.main]
    worst = [
        case_row(
            cases[row], [(f"{part.main}, {scores.values['cd_cm'][row]:.1f} cm", models[part.main](cases[row]).fine_m)]
        )
        for row in scores.worst(WORST)
    ]
    gallery(worst, path := options.pictures / f"worst_{stem}.png")
    part.pictures.append(("The worst ten.", path))
    diagrams, curves = calibrations(scores)
    if diagrams:
        calibration_picture(
            list(diagrams.items()), list(curves.items()), path := options.pictures / f"trust_{stem}.png"
        )
        part.pictures.append(("Reliability, and risk against coverage.", path))


def _named(text: str) -> tuple[str, Path]:
    """NAME=PATH, or a path whose folder or file gives the name."""
    name, equals, path = text.partition("=")
    if equals:
        return name, Path(path)
    given = Path(text)
    name = given.parent.name if given.suffix == ".pt" else given.name
    return name or given.resolve().name, given


def _open(path: Path) -> Predictor:
    from train.predictors import EdgePredictor, TorchPredictor

    if path.suffix == ".pt":
        return TorchPredictor.load(path)
    if path.suffix == ".onnx":
        return EdgePredictor(path.parent, path.name)
    return EdgePredictor(path)


def _in_box(predictor: Predictor) -> bool:
    return bool(getattr(predictor, "box_frame", False))


def _command(options: argparse.Namespace) -> str:
    """The command that repeats this, without where it writes; see ``_shown``."""
    words = ["rfconstruct-train", "evaluate"]
    for text in options.models:
        name, path = _named(text)
        words.append(f"{name}={_shown(path)}" if "=" in text else _shown(path))
    words += ["--split", options.split]
    if options.simulated:
        words += [word for path in options.simulated for word in ("--simulated", _shown(path))]
        words += ["--source", options.source] if options.source else []
    words += ["--samples", str(options.samples), "--emd-samples", str(options.emd_samples), "--bank", str(options.bank)]
    if options.fit_confidence or options.confidence:
        given = options.fit_confidence or options.confidence
        words += ["--fit-confidence" if options.fit_confidence else "--confidence", _shown(given)]
    for name in ("robustness", "gallery", "seed"):
        if value := getattr(options, name):
            words += [f"--{name}", str(value)]
    words += [word for name in options.coarse for word in ("--coarse", name)]
    return shlex.join(words)


def _shown(path: Path) -> str:
    """A path inside this folder as it is, of any other the name only."""
    return path.as_posix() if not path.is_absolute() else f".../{path.name}"
