# SPDX-License-Identifier: Apache-2.0
"""The doctor names what is wrong and what to do, and fails for nothing else."""

from __future__ import annotations

import os
import socket
import sys
from importlib import metadata
from pathlib import Path

import pytest
from cli_run import rfconstruct

import edge.warm  # noqa: F401  compiles into this process's cache before a test hides it
from edge import numba_cache
from edge.commands import doctor_command
from edge.config import StreamSettings
from edge.errors import ExitCode
from edge.rig import Rig

ENDPOINT = "tcp://127.0.0.1:{}"


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Kernels stay where this process keeps them; only the doctor looks elsewhere."""
    from numba import config

    monkeypatch.setattr(config, "CACHE_DIR", config.CACHE_DIR)
    monkeypatch.delenv(numba_cache.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(doctor_command, "StreamSettings", lambda: StreamSettings(endpoints=(ENDPOINT.format(_free()),)))
    return tmp_path / "cache"


def _free() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def outcomes(*argv: str) -> dict[str, dict[str, str]]:
    return {check["name"]: check for check in rfconstruct("doctor", "--json", *argv).json["checks"]}


def test_a_healthy_machine(own_cache: Path) -> None:
    outcome = rfconstruct("doctor")
    assert outcome.code == ExitCode.OK
    assert outcome.out.splitlines()[-1] == "ready"
    assert "gives its known answer" in outcome.out
    checks = outcomes()
    assert "fails" not in {check["outcome"] for check in checks.values()}
    assert checks["kernel cache"]["outcome"] == "note"  # empty
    assert all(check["action"] for check in checks.values() if check["outcome"] != "ok")
    (folder,) = (own_cache / "rfconstruct").iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700


def test_warm_loads_every_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    warmed = []

    def warm_up(rig: Rig) -> None:
        warmed.append(rig.name)

    monkeypatch.setattr("edge.warm.warm_up", warm_up)
    checks = outcomes("--warm")
    assert checks["kernels"]["outcome"] == "ok"
    assert checks["kernels"]["found"].count("_pair") == 5
    assert warmed == list(doctor_command.known_rigs())
    assert "kernels" not in outcomes()


def test_a_port_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = StreamSettings(endpoints=(ENDPOINT.format(other.getsockname()[1]),))
        monkeypatch.setattr(doctor_command, "StreamSettings", lambda: taken)
        outcome = rfconstruct("doctor")
    assert outcome.code == ExitCode.DEGRADED
    assert "-> another pipeline may be running: stop it, or publish elsewhere with --endpoint" in outcome.out
    assert outcome.out.splitlines()[-1].startswith("1 of ")


def test_a_missing_package_and_a_broken_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def without(name: str) -> str:
        if name in ("msgpack", "scipy"):
            raise metadata.PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(doctor_command.metadata, "version", without)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    for module in ("model", "network"):
        monkeypatch.delitem(sys.modules, f"edge.completion.{module}", raising=False)
    checks = outcomes()
    assert checks["packages"] == {
        "name": "packages", "outcome": "fails", "found": "not installed: msgpack", "action": "pip install msgpack",
    }  # fmt: skip
    assert checks["optional packages"]["outcome"] == "note"
    assert checks["model"]["outcome"] == "fails"
    assert "onnxruntime" in checks["model"]["found"]


def test_an_altered_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge.completion.manifest.find_model", lambda name: tmp_path)
    check = outcomes()["model"]
    assert check["outcome"] == "fails"
    assert check["action"]


def test_a_cache_that_others_may_write_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    monkeypatch.setenv(numba_cache.VARIABLE, str(shared))
    check = outcomes()["kernel cache"]
    assert check["outcome"] == "fails"
    assert "not private" in check["found"]
    assert numba_cache.VARIABLE in check["action"]


def test_a_cache_that_cannot_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    check = outcomes()["kernel cache"]
    assert check["outcome"] == "fails"
    assert numba_cache.VARIABLE in check["action"]
    assert numba_cache.is_temporary(Path(os.environ[numba_cache.VARIABLE]))


def test_no_data_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RFCONSTRUCT_DATA", str(tmp_path))
    outcome = rfconstruct("doctor", "--json")
    assert outcome.code == ExitCode.OK
    assert "RFCONSTRUCT_DATA" in {c["name"]: c for c in outcome.json["checks"]}["data"]["action"]
