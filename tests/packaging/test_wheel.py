# SPDX-License-Identifier: Apache-2.0
"""The wheel: installed without its dependencies it says what it is; nothing of the edge needs torch."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import venv
import zipfile
from email import message_from_string
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("torch", "ray", "tensorboard", "depthai", "viser", "matplotlib", "scipy")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built with the pinned build requirements of this environment."""
    if importlib.util.find_spec("hatchling") is None:
        pytest.skip("no hatchling here: pip install -r requirements/build.txt")
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet"]
    options = ["--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run([*pip, *options], check=True, timeout=240)
    (found,) = folder.glob("rfconstruct-*.whl")
    return found


def test_required_packages_are_light(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as content:
        names = content.namelist()
        (metadata,) = [name for name in names if name.endswith(".dist-info/METADATA")]
        fields = message_from_string(content.read(metadata).decode("utf-8"))
    required = [line for line in fields.get_all("Requires-Dist", []) if "extra ==" not in line]
    assert required
    assert not [line for line in required if line.startswith(HEAVY)]
    for part in ("edge/cli.py", "edge/_shipped/firmware_cfg/cascade_pair/rig.toml", "edge/py.typed"):
        assert part in names
    assert any(name.startswith("edge/_shipped/models/") and name.endswith(".onnx") for name in names)
    assert not [name for name in names if name.startswith(("tests/", "docs/")) or "__pycache__" in name]


def test_installed_into_a_bare_environment_it_runs_what_needs_no_package(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "bare", with_pip=False, symlinks=True)
    python = tmp_path / "bare" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python)]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], check=True, timeout=240)
    for argument in ("--help", "--version"):
        answer = subprocess.run(
            [tmp_path / "bare" / "bin" / "rfconstruct", argument],
            check=True, timeout=60, capture_output=True, text=True, cwd=tmp_path,
        )  # fmt: skip
        assert "rfconstruct" in answer.stdout


def test_the_pipeline_and_the_stream_import_nothing_heavy() -> None:
    heavy = [name for name in HEAVY if name != "scipy"]  # Numba looks for SciPy by itself and does without
    code = (
        "import sys, edge.pipeline, edge.publish, edge.service.metrics, edge.stream.client; "
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], check=True, timeout=120, capture_output=True, text=True)
    assert answer.stdout.strip() == "[]"
