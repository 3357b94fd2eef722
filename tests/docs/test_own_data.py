# SPDX-License-Identifier: Apache-2.0
"""Every command of docs/own_data.md runs, in order, from meshes to a model that completes shapes; tiny budget."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from doc_commands import ROOT, commands

PAGE = ROOT / "docs" / "own_data.md"
LITTLE = {"objects": "6", "drive_bys": "1", "perturbed": "1", "val_share": "0.4", "test_share": "0.4", "every": "6"}
"""Of the recipe; with fewer, val and test have no drive-by."""
LESS = {
    "fit": "--width tiny --steps 3 --batch 4 --threads 1 --workers 0",
    "evaluate": "--samples 24 --emd-samples 0 --bank 0",
    "export": "--samples 4 --emd-samples 0 --bank 0",
    "street": "--seconds 2 --pace 0 --no-plot --no-publish",
    "simulate": "--workers 1",
}
"""Options that shorten a verb."""


def write_meshes(folder: Path) -> None:
    """Files as a reader has them: three of each of two classes."""
    import trimesh

    from train.objects.parametric import generate

    for name in ("car", "pedestrian"):
        (folder / name).mkdir(parents=True)
        for number in range(3):
            mesh = generate(name, 100 + number)
            trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(folder / name / f"{name}{number}.obj")


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_every_command_runs(tmp_path: Path) -> None:
    recipe, setting = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    for key, value in LITTLE.items():
        recipe, count = re.subn(rf"^{key} = .*$", f"{key} = {value}", recipe, flags=re.MULTILINE)
        assert count == 1, key
    (tmp_path / "own.toml").write_text(recipe)
    (tmp_path / "firmware_cfg").symlink_to(ROOT / "firmware_cfg")
    write_meshes(tmp_path / "meshes")
    environment = {**os.environ, "RFCONSTRUCT_DATA": str(tmp_path / "own")}
    ran = 0
    for command in commands(PAGE):
        program, *rest = command.words
        if program == "export":
            continue
        if rest[0] == "street":
            with (tmp_path / "rigs" / "van" / "rig.toml").open("a") as rig:
                rig.write(f"\n{setting}")
        more = LESS.get(rest[0], "").split() if "--check" not in rest else []
        module = {"rfconstruct-train": "train.cli", "rfconstruct": "edge"}.get(program)
        words = [sys.executable, "-m", module, *rest, *more] if module else [program, *rest]
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, (str(command), done.stdout[-800:], done.stderr[-800:])
        ran += 1
    assert ran == len(commands(PAGE)) - 1 > 12
    assert (tmp_path / "models" / "own" / "card.md").is_file()
