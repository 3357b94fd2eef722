# SPDX-License-Identifier: Apache-2.0
"""A folder of foreign meshes into a library: true scale, z up, on the ground, clean, with licences and credits."""

from __future__ import annotations

import csv
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from edge.frames import Float64
from train.objects.clean import CleanReport, clean, compact
from train.objects.credits import Credit, find_credit, read_credit_manifest
from train.objects.hidden import visible_faces
from train.objects.layouts import TYPICAL_LENGTH_M, Found, Layout
from train.objects.library import COLUMNS
from train.objects.mesh import CLASSES, ClassName, Mesh, MeshError, stand
from train.objects.readers import Soup, axes_rotation, read_soup
from train.objects.reduce import reduce_to
from train.objects.upright import UNITS_M, stand_up, unit_of_person

EXTRA_COLUMNS = ("length_m", "width_m", "height_m", "triangles", "src_triangles", "scale_method", "notes")
_EXTENTS = ("length", "width", "height")
_SIZES_M: dict[ClassName, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "car": ((2.2, 7.5), (1.2, 2.8), (0.9, 3.5)),
    "bicycle": ((0.8, 2.8), (0.2, 1.3), (0.5, 2.4)),
    "motorcycle": ((1.2, 3.0), (0.3, 1.6), (0.6, 2.4)),
    "pedestrian": ((0.12, 2.0), (0.2, 2.1), (0.5, 2.4)),
}
"""Length, width and height that an object of the class can have."""


@dataclass(frozen=True, slots=True)
class ImportSettings:
    """How meshes are read.

    Args:
        layout: see ``layouts``. forward, up: axes of the files; "auto" finds those of standing people.
        unit: of the files: m, dm, cm, mm, in, "auto" (people only) or "normalised" (no unit: needs a length).
        lengths_m: scale every object of a class to this length (height of a pedestrian).
        sizes_m: the same by name, stronger.
        licence: written where nothing beside or inside the file states one.
        max_faces: limit of triangles. remove_hidden: drop the unseen interior of cars.
    Raises:
        MeshError: axes not at right angles, an unknown unit, a limit below 100.
    """

    layout: Layout = "folders"
    forward: str = "+x"
    up: str = "+z"
    unit: str = "m"
    lengths_m: dict[ClassName, float] = field(default_factory=dict)
    sizes_m: dict[str, float] = field(default_factory=dict)
    licence: str = "unknown"
    max_faces: int = 20_000
    remove_hidden: bool = True

    def __post_init__(self) -> None:
        if self.up != "auto":
            axes_rotation(self.forward, self.up)
        units = (*UNITS_M, "auto", "normalised")
        if self.unit not in units:
            raise MeshError("unknown unit", value=self.unit, allowed=", ".join(units))
        if self.max_faces < 100:
            raise MeshError("too few triangles for an object", value=self.max_faces, allowed=">= 100")

    @classmethod
    def for_layout(cls, layout: Layout, **changes: object) -> ImportSettings:
        """What files of a layout usually are: ShapeNet y up, -z forward, without a unit; body scans of any kind."""
        usual: dict[str, object] = {"layout": layout}
        if layout == "shapenet":
            usual |= {"up": "+y", "forward": "-z", "unit": "normalised", "lengths_m": dict(TYPICAL_LENGTH_M)}
        elif layout == "caesar":
            usual |= {"up": "auto", "unit": "auto", "max_faces": 8_000}
        return cls(**(usual | changes))  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Imported:
    """An object in library form with how it came about: faces dropped as hidden and by reduction, and its scale."""

    mesh: Mesh
    credit: Credit
    cleaned: CleanReport
    hidden: int
    reduced: int
    scale_method: str


@dataclass(frozen=True, slots=True)
class ImportReport:
    """Objects written by class, and (file, reason) of the bad ones."""

    written: Counter[str]
    bad: list[tuple[str, str]]


def import_one(found: Found, root: Path, settings: ImportSettings, credits: dict[str, dict[str, str]]) -> Imported:
    """Read, orient, scale and clean one object.

    Raises:
        MeshError: unreadable, no surface, or not of a size that its class can have.
    """
    vertices, faces = read_soup(found.path)
    rotation = stand_up(vertices, faces) if settings.up == "auto" else axes_rotation(settings.forward, settings.up)
    vertices = vertices @ rotation.T
    (vertices, faces), cleaned = clean((vertices, faces))
    vertices, method = _scaled(vertices, found, settings)
    hidden = 0
    if settings.remove_hidden and found.class_name == "car":
        vertices, faces, hidden = _outer((vertices, faces))
    shown = len(faces)
    vertices, faces = reduce_to(vertices, faces, settings.max_faces)
    credit = find_credit(found.path, root, credits)
    licence = settings.licence if credit.sidecar is None else credit.licence
    grade = credit.grade if credit.sidecar else "B" if licence != "unknown" else "C"
    mesh = Mesh(
        stand(vertices.astype(np.float32)), faces.astype(np.int32), CLASSES.index(found.class_name),
        f"{found.class_name}/{found.name}", credit.group or found.group, grade,
        licence, credit.attribution or found.path.name,
    )  # fmt: skip
    for axis, extent, (low, high) in zip(_EXTENTS, mesh.size_m, _SIZES_M[found.class_name], strict=True):
        if not low <= extent <= high:
            raise MeshError(
                f"{found.path.name}: no {found.class_name} has this {axis}",
                value=f"{extent:.3g} m",
                allowed=f"{low}..{high} m",
                action="give --up, --forward, --unit, --length or --sizes",
            )
    return Imported(mesh, credit, cleaned, hidden, shown - len(faces), method)


def import_folder(
    found: Iterable[Found], root: Path, target: Path, settings: ImportSettings, *, skip_bad: bool = False,
    tell: Callable[[str], None] = lambda line: None,
) -> ImportReport:  # fmt: skip
    """Write ``<target>/<class>/<name>.npz``, ``manifest.csv``, ``CREDITS.md`` and the licence texts.

    The library appears at once when all is done: until then everything lies in a folder beside it.

    Args:
        found: of ``layouts.find_meshes``. root: folder they lie in. target: new or empty.
        skip_bad: go on without the bad files; otherwise any of them means that nothing is written.
        tell: called with a line for every bad file as it is met.
    Raises:
        MeshError: the target holds something, a bad file without ``skip_bad``, or no good one.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise MeshError("the target is not an empty folder", value=str(target), action="give a new one")
    credits = read_credit_manifest(root)
    bad: list[tuple[str, str]] = []
    rows: list[dict[str, object]] = []
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".import-") as name:
        folder = Path(name) / "objects"
        folder.mkdir()
        for one in found:
            try:
                rows.append(_write(one, import_one(one, root, settings, credits), root, folder))
            except MeshError as error:
                bad.append((one.path.relative_to(root).as_posix(), str(error)))
                tell(f"bad: {bad[-1][0]}: {bad[-1][1]}")
        if bad and not skip_bad:
            raise MeshError(
                f"{len(bad)} of {len(bad) + len(rows)} files are bad, nothing is imported",
                value=", ".join(path for path, _ in bad[:5]), action="repair or remove them, or give --skip-bad",
            )  # fmt: skip
        if not rows:
            raise MeshError("not one file could be imported", value=str(root))
        _finish(rows, folder)
        if target.exists():
            target.rmdir()
        folder.replace(target)
    return ImportReport(Counter(str(row["class"]) for row in rows), bad)


def _scaled(vertices: Float64, found: Found, settings: ImportSettings) -> tuple[Float64, str]:
    """Vertices in metres, and how the scale was fixed."""
    axis = 2 if found.class_name == "pedestrian" else 0
    extent = max(float(np.ptp(vertices[:, axis])), 1e-12)
    length = settings.sizes_m.get(found.key)
    method = "length by name"
    if length is None:
        length, method = settings.lengths_m.get(found.class_name), "typical length of the class"
    if length is not None:
        return vertices * (length / extent), f"{method}, {length:g} m"
    if settings.unit == "normalised":
        raise MeshError(
            f"{found.path.name}: normalised, and no length of a {found.class_name}",
            action="give --length or --sizes",
        )
    if settings.unit == "auto":
        if found.class_name != "pedestrian":
            raise MeshError(f"{found.path.name}: only the unit of people can be found", action="give --unit")
        return vertices * unit_of_person(extent), "unit found from the height"
    return vertices * UNITS_M[settings.unit], f"unit {settings.unit}"


def _outer(soup: Soup) -> tuple[Float64, np.ndarray[tuple[int, ...], np.dtype[np.int64]], int]:
    """What can be seen from outside, and how many faces cannot."""
    vertices, faces = soup
    seen = visible_faces(stand(vertices.astype(np.float32)), faces.astype(np.int32))
    kept, remaining = compact(vertices, faces[seen])
    return kept, remaining, int(np.count_nonzero(~seen))


def _write(found: Found, one: Imported, root: Path, folder: Path) -> dict[str, object]:
    mesh = one.mesh
    file = Path(found.class_name) / f"{found.name}.npz"
    (folder / found.class_name).mkdir(exist_ok=True)
    np.savez_compressed(folder / file, vertices=mesh.vertices, faces=mesh.faces)
    if one.credit.sidecar is not None and one.credit.sidecar != found.path:
        copied = folder / "licences" / one.credit.sidecar.relative_to(root)
        copied.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(one.credit.sidecar, copied)
    c = one.cleaned
    notes = f"degenerate {c.degenerate}, double {c.double}, stray {c.stray}, hidden {one.hidden}, reduced {one.reduced}"
    size = {f"{axis}_m": round(float(s), 3) for axis, s in zip(_EXTENTS, mesh.size_m, strict=True)}
    return {
        "class": found.class_name, "name": found.name, "file": file.as_posix(), "licence": mesh.licence,
        "attribution": mesh.attribution, "provenance_grade": mesh.provenance, "source_group": mesh.source_group, **size,
        "triangles": len(mesh.faces), "src_triangles": c.source_faces, "scale_method": one.scale_method, "notes": notes,
    }  # fmt: skip


def _finish(rows: list[dict[str, object]], folder: Path) -> None:
    """Manifest and credits."""
    with (folder / "manifest.csv").open("w", newline="", encoding="utf-8") as lines:
        writer = csv.DictWriter(lines, [*COLUMNS, *EXTRA_COLUMNS])
        writer.writeheader()
        writer.writerows(rows)
    lines_ = ["# Credits", "", "What redistribution of these meshes, or of what is made from them, owes.", ""]
    lines_ += [f"- {r['class']}/{r['name']}: {r['licence']}; {r['attribution']} ({r['source_group']})" for r in rows]
    (folder / "CREDITS.md").write_text("\n".join(lines_) + "\n", encoding="utf-8")
