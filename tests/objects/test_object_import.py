# SPDX-License-Identifier: Apache-2.0
"""Importing mesh folders: formats, ShapeNet- and CAESAR-like layouts, scale, axes, cleaning, credits, bad files."""

from __future__ import annotations

import json
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.frames import Float64
from train.cli import main
from train.objects.clean import clean
from train.objects.credits import find_credit
from train.objects.hidden import visible_faces
from train.objects.layouts import find_meshes, read_class_map, read_sizes
from train.objects.library import read_manifest
from train.objects.mesh import Mesh, MeshError, stand
from train.objects.parametric import generate
from train.objects.parametric_person import Body, walking
from train.objects.primitives import box, join
from train.objects.readers import SUFFIXES, Faces, axes_rotation, read_soup
from train.objects.sampling import face_areas
from train.objects.upright import stand_up, unit_of_person

trimesh = pytest.importorskip("trimesh")

# A wedge in ShapeNet's axes (y up, -z forward), unit size: the nose at z = -0.5 is at the right (+x).
WEDGE = """
v -0.15 0.0 0.2
v 0.15 0.0 0.2
v 0.15 0.0 -0.5
v 0.15 0.25 0.0
f 1 2 4
f 2 3 4
f 1 2 3
"""


def run(*arguments: object) -> int:
    return main(["objects", *map(str, arguments)])


def block(folder: Path, name: str, size: tuple[float, float, float] = (4.0, 1.8, 1.5), suffix: str = "ply") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.{suffix}"
    trimesh.creation.box(size).export(path)
    return path


def only(target: Path) -> Mesh:
    (entry,) = read_manifest(target)
    return entry.load()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_gives_the_same_triangles(tmp_path: Path, suffix: str) -> None:
    solid = trimesh.creation.box((4.0, 1.8, 1.5))
    folder = tmp_path / "in" / "car"
    folder.mkdir(parents=True)
    if suffix == ".npz":
        np.savez(folder / "block.npz", vertices=solid.vertices, faces=solid.faces)
    elif suffix == ".gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(solid)).items():
            (folder / name).write_bytes(content)
    else:
        solid.export(folder / f"block{suffix}")
    assert run("import", tmp_path / "in", tmp_path / "out") == 0
    mesh = only(tmp_path / "out")
    np.testing.assert_allclose(mesh.size_m, [4.0, 1.8, 1.5], rtol=1e-5)
    assert (mesh.vertices[:, 2].min(), len(mesh.vertices), len(mesh.faces)) == (0, 8, 12)
    assert face_areas(mesh.vertices, mesh.faces, np.empty(12)) == pytest.approx(2 * (4 + 1.8) * 1.5 + 2 * 4 * 1.8)


def test_parts_of_a_scene_keep_their_places(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for x in (-1.5, 1.5):
        scene.add_geometry(
            trimesh.creation.box((1.0, 1.8, 1.5)), transform=trimesh.transformations.translation_matrix([x, 0, 0])
        )
    scene.export(tmp_path / "two.glb")
    vertices, faces = read_soup(tmp_path / "two.glb")
    assert len(faces) == 24
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [4.0, 1.8, 1.5], rtol=1e-5)


def shapenet(root: Path, synset: str, name: str) -> Path:
    folder = root / synset / name / "models"
    folder.mkdir(parents=True)
    (folder / "model_normalized.obj").write_text(WEDGE)
    (folder / "model_normalized.solid.ply").write_text("a voxel variant, never read")
    return folder


def test_shapenet_layout_is_scaled_by_class_or_by_metadata(tmp_path: Path) -> None:
    root = tmp_path / "in"
    for synset, name in (("02958343", "1a2b"), ("02958343", "3c4d"), ("02834778", "5e6f"), ("03790512", "7a8b")):
        shapenet(root, synset, name)
    shapenet(root, "04256520", "sofa")
    (tmp_path / "metadata.csv").write_text('fullId,category,aligned.dims\nwss.3c4d,Car,"480.0\\,140.0\\,190.0"\n')
    sizes = ("--sizes", tmp_path / "metadata.csv")
    assert run("import", root, tmp_path / "out", "--layout", "shapenet", *sizes) == 0
    meshes = {e.object_id: e.load() for e in read_manifest(tmp_path / "out")}
    lengths = {name: float(mesh.size_m[0]) for name, mesh in meshes.items()}
    expected = {"car/1a2b": 4.5, "car/3c4d": 4.8, "bicycle/5e6f": 1.75, "motorcycle/7a8b": 2.1}
    assert lengths == pytest.approx(expected, rel=1e-5)
    car = meshes["car/1a2b"]
    np.testing.assert_allclose(car.size_m, np.array([0.7, 0.3, 0.25]) * 4.5 / 0.7, rtol=1e-5)
    assert car.vertices[np.argmax(car.vertices[:, 0]), 1] < 0  # the nose is at the right
    assert len({mesh.source_group for mesh in meshes.values()}) == 4


@pytest.fixture(scope="module")
def person() -> tuple[Float64, Faces]:
    vertices, faces = join(walking(Body(1.75, 1.0, 0.01), 0.0, 0.0, np.random.default_rng(0)))
    return stand(vertices).astype(np.float64), faces.astype(np.int64)


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_a_standing_person_is_stood_up_from_any_axes(
    person: tuple[Float64, Faces], order: tuple[int, int, int]
) -> None:
    vertices, faces = person
    for signs in ((1, 1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1)):
        turn = np.zeros((3, 3))
        turn[np.arange(3), order] = signs
        if np.linalg.det(turn) < 0:
            continue
        upright = stand_up(vertices @ turn.T, faces)
        np.testing.assert_allclose(upright @ turn, np.eye(3), atol=1e-12)


def test_caesar_layout_takes_every_file_for_a_person(tmp_path: Path, person: tuple[Float64, Faces]) -> None:
    vertices, faces = person
    (tmp_path / "in" / "scans").mkdir(parents=True)
    turn = axes_rotation("+z", "+y").T  # y up, facing z, millimetres
    trimesh.Trimesh(vertices @ turn.T * 1000, faces, process=False).export(tmp_path / "in" / "scans" / "csr0001a.ply")
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "in" / "scans" / "csr0002a.obj")
    assert run("import", tmp_path / "in", tmp_path / "out", "--layout", "caesar") == 0
    first, second = (e.load() for e in read_manifest(tmp_path / "out"))
    assert first.object_id == "pedestrian/scans_csr0001a"
    for mesh in (first, second):
        np.testing.assert_allclose(mesh.size_m, np.ptp(vertices, axis=0), rtol=1e-4)
    np.testing.assert_allclose(first.vertices.mean(axis=0), second.vertices.mean(axis=0), atol=1e-3)


def test_unit_of_a_person() -> None:
    assert [unit_of_person(x) for x in (1.8, 18.0, 180.0, 1800.0)] == [1.0, 0.1, 0.01, 0.001]
    with pytest.raises(MeshError, match="height of a person"):
        unit_of_person(5.0)


def test_a_class_map_names_folders_and_globs(tmp_path: Path) -> None:
    block(tmp_path / "in" / "limousines" / "someone", "a")
    block(tmp_path / "in" / "mixed", "truck_1", (5.5, 2.0, 2.2))
    block(tmp_path / "in" / "mixed", "tree")
    block(tmp_path / "in" / "velos", "v", (900.0, 300.0, 550.0))
    plan = tmp_path / "map.toml"
    plan.write_text(
        '[classes]\nlimousines = "car"\n"mixed/truck*" = "car"\nvelos = "bicycle"\n[lengths_m]\nbicycle = 1.8\n'
    )
    assert run("import", tmp_path / "in", tmp_path / "out", "--map", plan) == 0
    entries = {e.object_id: e for e in read_manifest(tmp_path / "out")}
    assert sorted(entries) == ["bicycle/v", "car/someone_a", "car/truck_1"]
    assert entries["car/someone_a"].source_group == "someone"
    assert entries["bicycle/v"].load().size_m[0] == pytest.approx(1.8, rel=1e-5)


@pytest.mark.parametrize(
    "text",
    ["", "nonsense", 'classes = "car"', '[classes]\na = "tram"', "[classes]\n[lengths_m]\ncar = -1", "[classes]\n[x]"],
)
def test_class_maps_that_cannot_work(tmp_path: Path, text: str) -> None:
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(MeshError):
        read_class_map(tmp_path / "map.toml")


def test_sizes_by_name(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("name,length_m\na,4.2\n")
    assert read_sizes(tmp_path / "s.csv") == {"a": 4.2}
    (tmp_path / "s.csv").write_text("name,size\na,4.2\n")
    with pytest.raises(MeshError, match="bad line"):
        read_sizes(tmp_path / "s.csv")


def test_cleaning_drops_what_has_no_area_is_double_or_far_away() -> None:
    vertices, faces = join([box((0, 0, 0), (4, 2, 1)), box((30, 0, 0), (0.1, 0.1, 0.1)), box((0, 0, 0.7), (1, 1, 0.2))])
    split = vertices[faces].reshape(-1, 3).astype(np.float64)  # no vertex is shared
    loose = np.arange(len(split)).reshape(-1, 3)
    flat = np.array([[0, 0, 1], [0, 1, 1]])
    (v, f), report = clean((split, np.vstack([loose, loose[:4], flat])))
    assert (report.double, report.degenerate, report.stray) == (4, 2, 12)
    assert (len(v), len(f)) == (16, 24)  # the small box on the roof is a part of the object
    with pytest.raises(MeshError, match="no surface"):
        clean((split, flat))


def test_hidden_faces_are_those_inside() -> None:
    shell, inside = box((0, 0, 0.75), (4.0, 1.8, 1.5)), box((0.5, 0.3, 0.7), (0.8, 0.5, 0.6))
    vertices, faces = join([shell, inside])
    seen = visible_faces(stand(vertices), faces)
    np.testing.assert_array_equal(seen, np.arange(24) < 12)


def test_a_parametric_car_is_nearly_all_outside_and_keeps_its_shape(tmp_path: Path) -> None:
    car = generate("car", 3)
    (tmp_path / "in" / "car").mkdir(parents=True)
    np.savez(tmp_path / "in" / "car" / "c.npz", vertices=car.vertices, faces=car.faces)
    assert run("import", tmp_path / "in", tmp_path / "out", "--max-triangles", 5000) == 0
    mesh = only(tmp_path / "out")
    assert 2000 < len(mesh.faces) <= 5000
    np.testing.assert_allclose(mesh.size_m, car.size_m, atol=0.08)  # a mirror shrinks by half a cell
    assert run("import", tmp_path / "in", tmp_path / "all", "--keep-hidden") == 0
    assert len(only(tmp_path / "all").faces) > 0.98 * len(car.faces)


def test_licences_are_carried_along(tmp_path: Path) -> None:
    root = tmp_path / "in"
    block(root / "car" / "one", "a")
    (root / "car" / "one" / "a.ply.license").write_text(
        "SPDX-FileCopyrightText: 2024 A. Author\nSPDX-License-Identifier: MIT\n"
    )
    block(root / "car" / "two", "b")
    (root / "car" / "two" / "LICENSE.txt").write_text(
        "Creative Commons Attribution 4.0 International\nCopyright (c) B. Builder\n"
    )
    glb = block(root / "car" / "three", "c", suffix="glb")
    asset = {"version": "2.0", "extras": {"author": "C. Creator", "license": "CC0 1.0", "title": "Block"}}
    glb.unlink()
    gltf = trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box((4.0, 1.8, 1.5))))
    for name, content in gltf.items():
        data = json.dumps(json.loads(content) | {"asset": asset}).encode() if name.endswith("gltf") else content
        (glb.parent / name).write_bytes(data)
    block(root / "car" / "four", "d")
    (root / "manifest.csv").write_text(
        "file,licence,attribution,source_group,provenance_grade\ncar/four/d.ply,CC-BY-4.0,D,studio,P\n"
    )
    block(root / "car" / "five", "e")
    assert run("import", root, tmp_path / "out", "--licence", "CC-BY-NC-4.0") == 0
    got = {e.name.split("_")[0]: (e.licence, e.attribution, e.source_group) for e in read_manifest(tmp_path / "out")}
    assert got["one"] == ("MIT", "2024 A. Author", "one")
    assert got["two"] == ("CC-BY-4.0", "B. Builder", "two")
    assert got["three"] == ("CC0-1.0", "Block, C. Creator", "C. Creator")
    assert got["four"] == ("CC-BY-4.0", "D", "studio")
    grades = {e.name.split("_")[0]: e.provenance for e in read_manifest(tmp_path / "out")}
    assert grades == {"one": "A", "two": "A", "three": "B", "four": "P", "five": "B"}  # a procedural one stays one
    assert got["five"] == ("CC-BY-NC-4.0", "e.ply", "five")
    assert "car/one_a: MIT; 2024 A. Author" in (tmp_path / "out" / "CREDITS.md").read_text()
    assert (tmp_path / "out" / "licences" / "car" / "two" / "LICENSE.txt").is_file()


def test_nothing_above_the_folder_speaks_for_it(tmp_path: Path) -> None:
    path = block(tmp_path / "in" / "car", "a")
    (tmp_path / "LICENSE").write_text("MIT License")
    assert find_credit(path, tmp_path / "in", {}).sidecar is None


def test_bad_files_are_told_one_by_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "in"
    block(root / "car", "good")
    block(root / "car", "millimetres", (4000.0, 1800.0, 1500.0))
    (root / "car" / "broken.ply").write_text("nonsense")
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(20, 3))).export(root / "car" / "points.ply")
    assert run("import", root, tmp_path / "out") == 1
    error = capsys.readouterr().err
    assert [name in error for name in ("broken.ply", "points.ply", "millimetres.ply", "3 of 4")] == [True] * 4
    assert not (tmp_path / "out").exists()
    assert list(tmp_path.iterdir()) == [root]  # nothing half done is left behind
    assert run("import", root, tmp_path / "out", "--skip-bad") == 0
    printed = capsys.readouterr()
    assert printed.out.strip() == "1 objects (1 car), 3 bad files skipped"
    assert only(tmp_path / "out").object_id == "car/good"
    assert run("import", root, tmp_path / "out", "--skip-bad") == 1  # never into a folder that holds something


@pytest.mark.parametrize(
    "options",
    [("--up", "+x"), ("--unit", "miles"), ("--length", "tram=3"), ("--length", "car"), ("--max-triangles", 5)],
)
def test_options_that_cannot_work(tmp_path: Path, options: tuple[Any, ...]) -> None:
    block(tmp_path / "in" / "car", "a")
    assert run("import", tmp_path / "in", tmp_path / "out", *options) == 1


def test_empty_folders_and_equal_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="no meshes"):
        find_meshes(tmp_path, "folders")
    with pytest.raises(MeshError, match="no such folder"):
        find_meshes(tmp_path / "none", "folders")
    block(tmp_path / "car", "a")
    block(tmp_path / "car", "a", suffix="off")
    with pytest.raises(MeshError, match="two meshes"):
        find_meshes(tmp_path, "folders")
    with pytest.raises(MeshError, match="right angles"):
        axes_rotation("+x", "-x")


def test_names_cannot_be_taken_for_parametric_objects(tmp_path: Path) -> None:
    block(tmp_path / "car", "parametric_00001")
    (found,) = find_meshes(tmp_path, "folders")
    assert found.name == "file_parametric_00001"


def test_list_and_sheets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    block(tmp_path / "in" / "car", "a")
    assert run("import", tmp_path / "in", tmp_path / "out") == 0
    assert run("list", "--objects", tmp_path / "out") == 0
    assert "car/a" in capsys.readouterr().out
    assert run("list", "--objects", tmp_path / "out", "--class", "bicycle") == 1
    assert run("sheet", "--objects", tmp_path / "out", "--out", tmp_path / "png") == 0
    assert run("sheet", "--parametric", "--class", "bicycle", "--count", 2, "--out", tmp_path / "png") == 0
    assert run("sheet", "--object", "car/parametric_00001", "--count", 2, "--out", tmp_path / "png") == 0
    names = {path.name for path in (tmp_path / "png").iterdir()}
    assert names == {"car.png", "parametric_bicycle.png", "car_parametric_00001.png"}
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in (tmp_path / "png").iterdir())
