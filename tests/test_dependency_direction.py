# SPDX-License-Identifier: Apache-2.0
"""Kernels <- stages <- processes, edge never sees train or torch: read from the import statements themselves."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EDGE = sorted((ROOT / "edge").rglob("*.py"))
STANDARD = {"__future__", "math", "typing", "collections", "dataclasses", "enum", "functools"}
DATA = {"edge.frames", "edge.config", "edge.errors", "edge.waveform", "edge.array", "edge.rig"}
HEAVY = {"scipy", "matplotlib", "mpl_toolkits", "tqdm", "depthai", "trimesh", "viser"}
PROCESS_FILES = (
    *("bench", "cli", "commands", "computed_results", "digest", "plot", "player", "publish", "service", "view", "warm"),
    "__main__",
)
PROCESSES = ("edge.cli", "edge.commands", "edge.plot", "edge.pipeline")


def imports(path: Path, top_level_only: bool = False) -> set[str]:
    """Full names of the modules that a file imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = tree.body if top_level_only else list(ast.walk(tree))
    names: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
    return names


def label(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", EDGE, ids=label)
def test_edge_never_imports_train_or_torch(path: Path) -> None:
    roots = {name.split(".")[0] for name in imports(path)}
    assert not roots & {"train", "torch", "onnx", "tests", "pickle"}


@pytest.mark.parametrize("path", [p for p in EDGE if p.name.startswith("kernels_")], ids=label)
def test_kernels_import_only_numpy_and_numba(path: Path) -> None:
    for name in imports(path):
        allowed = name.split(".")[0] in {"numpy", "numba"} | STANDARD or ".kernels_" in name
        assert allowed, f"{label(path)} imports {name}"


@pytest.mark.parametrize("path", sorted((ROOT / "edge/reference").glob("*.py")), ids=label)
def test_definitions_import_only_numpy_and_the_data(path: Path) -> None:
    for name in imports(path):
        own = name.startswith("edge.reference") or name in DATA
        assert name.split(".")[0] in {"numpy"} | STANDARD or own, f"{label(path)} imports {name}"


@pytest.mark.parametrize("path", EDGE, ids=label)
def test_nothing_below_imports_processes(path: Path) -> None:
    relative = label(path)
    if relative.startswith(tuple(f"edge/{name}" for name in PROCESS_FILES)):
        return
    for name in imports(path):
        assert not any(name == one or name.startswith(f"{one}.") for one in PROCESSES), f"{relative} imports {name}"


@pytest.mark.parametrize("path", EDGE, ids=label)
def test_stages_import_no_sources_streams_or_recordings(path: Path) -> None:
    if not label(path).startswith(("edge/dsp", "edge/fusion", "edge/completion", "edge/odometry/transforms")):
        return
    for name in imports(path):
        assert not name.startswith(("edge.sources", "edge.stream", "edge.recording")), f"{label(path)} imports {name}"


@pytest.mark.parametrize("path", EDGE, ids=label)
def test_heavy_and_optional_packages_are_imported_where_they_are_used(path: Path) -> None:
    if label(path).startswith("edge/plot"):
        return
    assert not {name.split(".")[0] for name in imports(path, top_level_only=True)} & HEAVY


def test_no_module_imports_itself_in_a_circle() -> None:
    modules = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in EDGE}
    graph = {name: {n for n in imports(p, top_level_only=True) if n in modules} for name, p in modules.items()}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail, name))
        if name not in done:
            for other in graph[name]:
                visit(other, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())
