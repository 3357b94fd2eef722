# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train objects``: import a folder of meshes, list the library, draw contact sheets."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from edge.errors import ExitCode
from train.objects.layouts import LAYOUTS, find_meshes, read_class_map, read_sizes
from train.objects.library import SPLITS, default_objects_dir
from train.objects.mesh import CLASSES, MeshError
from train.output import add_json, emit


def add_verbs(verbs: Any) -> None:
    """Add ``objects`` with its own verbs to the subparsers of ``rfconstruct-train``."""
    objects = verbs.add_parser("objects", help="3-D objects: import a folder of meshes, list, contact sheets")
    inner = objects.add_subparsers(required=True, metavar="verb")
    _add_import(inner)
    listing = inner.add_parser("list", help="every object with its split, source group and licence")
    _add_choice(listing)
    listing.set_defaults(run=_list)
    sheet = inner.add_parser("sheet", help="contact sheets as PNG, one for every class")
    _add_choice(sheet)
    sheet.add_argument("--out", type=Path, required=True, help="folder for the PNG files")
    sheet.add_argument("--count", type=int, default=24, help="parametric objects, or deformations of one object")
    sheet.add_argument("--parametric", action="store_true", help="parametric objects instead of a library")
    sheet.add_argument("--object", help="variations of one object instead, such as car/parametric_00000")
    sheet.add_argument("--styles", action="store_true", help="with --parametric: a car of every body style instead")
    sheet.add_argument("--together", action="store_true", help="all classes on one sheet")
    sheet.add_argument("--riders", action="store_true", help="put riders on the two-wheelers of a library")
    sheet.set_defaults(run=_sheet)
    look = inner.add_parser("oracle", help="distance of unseen objects to the nearest training object, with variations")
    look.add_argument("--objects", type=Path, help="library folder (default: the project's)")
    look.add_argument("--class", dest="class_name", choices=CLASSES, default="car")
    look.add_argument("--variants", type=int, default=6, help="of every training object")
    look.add_argument("--points", type=int, default=1500, help="of each cloud")
    look.set_defaults(run=_oracle)
    times = inner.add_parser("time", help="CPU time of making, varying and perturbing objects")
    times.set_defaults(run=_time)
    for verb in inner.choices.values():
        add_json(verb)


def _add_import(inner: Any) -> None:
    verb = inner.add_parser(
        "import",
        help="a folder of OBJ, PLY, GLB, GLTF, OFF, STL or NPZ meshes into a library",
        description="Folders name the classes: car, bicycle, motorcycle, pedestrian, a ShapeNet synset; or see --map.",
    )
    verb.add_argument("source", type=Path)
    verb.add_argument("target", type=Path, help="new folder; give it to --objects of other commands")
    verb.add_argument("--layout", choices=LAYOUTS, default="folders")
    verb.add_argument(
        "--map", type=Path, help="class map, TOML: [classes] folder or glob = class; [lengths_m]; up; ..."
    )
    verb.add_argument("--forward", help="the files' forward axis, +x -x +y -y +z -z (default +x; ShapeNet -z)")
    verb.add_argument("--up", help="the files' up axis, or auto for people (default +z; ShapeNet +y)")
    verb.add_argument("--unit", help="m, dm, cm, mm, in, normalised, or auto for people (default m)")
    verb.add_argument(
        "--length", action="append", default=[], metavar="CLASS=METRES", help="scale a class to this length"
    )
    verb.add_argument("--sizes", type=Path, help="CSV of true lengths by name (name,length_m or fullId,aligned.dims)")
    verb.add_argument("--licence", default="unknown", help="where nothing beside or inside a file states one")
    verb.add_argument("--max-triangles", type=int, help="reduce larger meshes (default 20000, people 8000)")
    verb.add_argument("--keep-hidden", action="store_true", help="keep the unseen interior of cars")
    verb.add_argument("--skip-bad", action="store_true", help="import the others when a file is bad")
    verb.set_defaults(run=_import)


def _add_choice(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--objects", type=Path, help="library folder (default: the project's)")
    verb.add_argument("--class", dest="class_name", choices=CLASSES, help="only this class")
    verb.add_argument("--split", choices=SPLITS, help="only this split")


def _import(options: argparse.Namespace) -> int:
    from train.objects.importer import ImportSettings, import_folder

    classes = read_class_map(options.map) if options.map else None
    changes: dict[str, Any] = {"licence": options.licence, "remove_hidden": not options.keep_hidden}
    for name in ("forward", "up", "unit"):
        value = getattr(options, name) or (getattr(classes, name) if classes else None)
        if value is not None:
            changes[name] = value
    if options.max_triangles is not None:
        changes["max_faces"] = options.max_triangles
    if options.sizes:
        changes["sizes_m"] = read_sizes(options.sizes)
    usual = ImportSettings.for_layout(options.layout).lengths_m if options.unit in (None, "normalised") else {}
    lengths = usual | (classes.lengths_m if classes else {}) | _lengths(options.length)
    settings = ImportSettings.for_layout(options.layout, **changes, lengths_m=lengths)
    found = find_meshes(options.source, options.layout, classes)
    report = import_folder(
        found, options.source, options.target, settings, skip_bad=options.skip_bad,
        tell=lambda line: print(line, file=sys.stderr),
    )  # fmt: skip
    total = sum(report.written.values())
    bad = [{"file": file, "reason": reason} for file, reason in report.bad]
    text = f"{total} objects ({_counts(report.written)}), {len(report.bad)} bad files skipped"
    emit(options, {"folder": str(options.target), "written": dict(report.written), "bad": bad}, [text])
    return int(ExitCode.OK)


def _lengths(items: list[str]) -> dict[Any, float]:
    lengths: dict[Any, float] = {}
    for item in items:
        name, _, text = item.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = 0.0
        if name not in CLASSES or not value > 0:
            raise MeshError("--length", value=item, allowed="CLASS=METRES, such as car=4.5")
        lengths[name] = value
    return lengths


def _list(options: argparse.Namespace) -> int:
    refs = _chosen(options)
    width = max(len(ref.to_text()) for ref in refs)
    columns = ("split", "provenance", "source_group", "licence")
    rows = [{"object": ref.to_text(), **{c: getattr(ref.entry(options.objects), c) for c in columns}} for ref in refs]
    counts = Counter(f"{ref.class_name} {ref.entry(options.objects).split}" for ref in refs)
    lines = [
        f"{row['object']:{width}}  {row['split']:5}  {row['provenance']}  {row['source_group']}  {row['licence']}"
        for row in rows
    ]
    emit(options, {"objects": rows, "counts": dict(counts)}, [*lines, f"{len(refs)} objects: {_counts(counts)}"])
    return int(ExitCode.OK)


def _chosen(options: argparse.Namespace) -> list[Any]:
    """Objects of the library that the options leave."""
    from train.objects.reference import library_refs

    if options.objects is None and default_objects_dir() is None:
        raise MeshError("no object library here", action="give --objects, or set RFCONSTRUCT_DATA")
    refs = [
        ref for ref in library_refs(options.objects)
        if options.class_name in (None, ref.class_name)
        and options.split in (None, ref.entry(options.objects).split)
    ]  # fmt: skip
    if not refs:
        raise MeshError("no object fits", value=f"{options.class_name}, {options.split}")
    return refs


def _sheet(options: argparse.Namespace) -> int:
    from dataclasses import replace

    from train.contact_sheet import object_sheet
    from train.objects.parametric import generate
    from train.objects.parametric_car import STYLES
    from train.objects.reference import RIDDEN, ObjectRef

    options.out.mkdir(parents=True, exist_ok=True)
    names = [options.class_name] if options.class_name else list(CLASSES)
    if options.object:
        ref = ObjectRef.from_text(options.object)
        meshes = [replace(ref, deform_seed=seed).mesh(options.objects) for seed in range(options.count - 1)]
        sheets = {ref.to_text().replace("/", "_"): [ref.mesh(options.objects), *meshes]}
    elif options.parametric:
        sheets = {f"parametric_{name}": [generate(name, seed) for seed in range(options.count)] for name in names}
        if options.styles and "car" in names:
            cars = [replace(generate("car", k, style=style), object_id=style) for k, style in enumerate(STYLES)]
            sheets["parametric_car"] = cars
    else:
        refs = _chosen(options)
        sheets = {}
        for ref in refs:
            ridden = replace(ref, rider="rider0") if options.riders and ref.class_name in RIDDEN else ref
            try:
                mesh = ridden.mesh(options.objects)
            except MeshError as error:
                print(error, file=sys.stderr)
                mesh = ref.mesh(options.objects)
            sheets.setdefault(ref.class_name, []).append(mesh)
    if options.together:
        sheets = {"parametric" if options.parametric else "objects": [m for meshes in sheets.values() for m in meshes]}
    files = [options.out / f"{name}.png" for name in sheets]
    for file, meshes in zip(files, sheets.values(), strict=True):
        object_sheet(meshes, file)
    emit(options, {"files": [str(file) for file in files]}, map(str, files))
    return int(ExitCode.OK)


def _oracle(options: argparse.Namespace) -> int:
    from train.objects.oracle import oracle

    rows = list(oracle(options.class_name, options.variants, options.points, options.objects))
    lines = [f"{'training objects':24} {'number':>7} {'median cm':>10} {'largest cm':>11}"]
    lines += [f"{name:24} {count:7} {100 * mid:10.2f} {100 * largest:11.2f}" for name, count, mid, largest in rows]
    keys = ("training_objects", "number", "median_m", "largest_m")
    emit(options, {"class": options.class_name, "sets": [dict(zip(keys, row, strict=True)) for row in rows]}, lines)
    return int(ExitCode.OK)


def _time(options: argparse.Namespace) -> int:
    from train.objects.timing import timings

    rows = dict(timings())
    emit(options, {"mean_ms": rows}, (f"{what:36} {mean_ms:7.2f} ms" for what, mean_ms in rows.items()))
    return int(ExitCode.OK)


def _counts(counts: Counter[str]) -> str:
    return ", ".join(f"{number} {name}" for name, number in sorted(counts.items()))
