# SPDX-License-Identifier: Apache-2.0
"""Kernels are compiled anew when anything changes that Numba does not notice, and never for another reason."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from edge import numba_cache
from edge.numba_cache import KEPT_FOLDERS, VARIABLE, enable, is_temporary, key, prune, shared_sources


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    from numba import config

    monkeypatch.setattr(config, "CACHE_DIR", config.CACHE_DIR)
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "rfconstruct"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Two kernel files of which one imports the other, and one that stands alone."""
    (tmp_path / "dsp").mkdir()
    (tmp_path / "dsp" / "kernels_low.py").write_text("LIMIT = 1\n")
    (tmp_path / "dsp" / "kernels_high.py").write_text("import numpy\nfrom edge.dsp.kernels_low import LIMIT\n")
    (tmp_path / "dsp" / "kernels_alone.py").write_text("X = 1\n")
    return tmp_path


def test_the_key_follows_the_contents_of_shared_files_version_and_processor(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [path.name for path in shared_sources(package)] == ["kernels_low.py"]
    first = key(package)
    assert key(package) == first
    (package / "dsp" / "kernels_alone.py").write_text("X = 2\n")  # Numba itself notices
    assert key(package) == first
    (package / "dsp" / "kernels_low.py").write_text("LIMIT = 2\n")
    second = key(package)
    assert second != first
    monkeypatch.setattr(numba_cache, "processor", lambda: "another")
    third = key(package)
    monkeypatch.setattr(numba_cache, "version", lambda: "another")
    assert len({first, second, third, key(package)}) == 4


def test_the_real_package_has_shared_kernels_and_numba_uses_the_folder(environment: Path) -> None:
    program = (
        "from edge.dsp import kernels_checks as k; from numba import config;"
        "print(k.all_zero._cache._cache_path); print(config.CACHE_DIR)"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    path, folder = map(Path, done.stdout.split())
    assert folder == environment / f"numba-{key()}"
    assert path.parent == folder
    assert any(folder.rglob("*.nbi"))


def test_a_folder_that_the_user_chose_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "mine"))
    assert enable() == tmp_path / "mine"
    assert os.environ[VARIABLE] == str(tmp_path / "mine")
    assert not (tmp_path / "mine").exists()


def test_a_child_of_another_version_does_not_inherit_our_folder(
    environment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = enable()
    assert first == enable() == environment / f"numba-{key()}"
    monkeypatch.setattr(numba_cache, "version", lambda: "another")
    assert enable() not in (first, None)


@pytest.mark.parametrize("obstacle", ["a file", "not private", "no home"])
def test_one_warning_says_what_to_do_and_the_kernels_still_compile(
    obstacle: str, environment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if obstacle == "a file":
        environment.write_text("")
    elif obstacle == "not private":
        enable().chmod(0o777)
        monkeypatch.delenv(VARIABLE)
    else:
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr(Path, "home", _no_home)
    with pytest.warns(RuntimeWarning, match=f"set {VARIABLE} to a private folder .* doctor --warm") as caught:
        folder = enable()
    assert len(caught) == 1
    assert is_temporary(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert enable() == folder
    numba_cache.check_private(folder)


def _no_home() -> Path:
    raise RuntimeError("Could not determine home directory.")


def test_longest_unused_folders_go(environment: Path) -> None:
    current = enable()
    others = [environment / f"numba-{n:016x}" for n in range(KEPT_FOLDERS + 2)]
    for age, folder in enumerate(others):
        folder.mkdir()
        os.utime(folder, (1e9 - age, 1e9 - age))
    foreign = environment / "numba-of-somebody-else"
    foreign.mkdir()
    assert prune(current) == others[KEPT_FOLDERS:]
    assert set(environment.iterdir()) == {current, foreign, *others[:KEPT_FOLDERS]}
