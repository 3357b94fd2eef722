# SPDX-License-Identifier: Apache-2.0
"""The doctor looks at the CURVE keys: present where configured, owner, modes, and that they are one pair."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import zmq
from cli_run import rfconstruct

from edge.commands import doctor_command, key_checks
from edge.commands.key_checks import keys_check
from edge.config import StreamSettings
from edge.errors import ExitCode
from edge.stream.keys import KeyFolder, create_client

REMOTE = "tcp://0.0.0.0:5600"


@pytest.fixture
def folder(tmp_path: Path) -> KeyFolder:
    keys = KeyFolder(tmp_path / "keys")
    keys.allow("viewer", create_client("viewer", tmp_path, keys.create().public).public)
    return keys


def settings(folder: KeyFolder) -> StreamSettings:
    return StreamSettings((REMOTE,), key_folder=str(folder.path))


def fails(stream: StreamSettings | None, *words: str) -> None:
    check = keys_check(stream)
    assert check.outcome == "fails", check
    assert check.action
    assert all(word in check.found for word in words), check.found


def test_keys_in_order(folder: KeyFolder) -> None:
    check = keys_check(settings(folder))
    assert (check.outcome, check.found.endswith("let in: viewer")) == ("ok", True)
    folder.revoke("viewer")
    assert keys_check(settings(folder)).outcome == "note"


def test_none_configured(tmp_path: Path, folder: KeyFolder) -> None:
    assert keys_check(StreamSettings()).outcome == "ok"
    assert keys_check(None, tmp_path / "none").outcome == "ok"
    assert keys_check(None, folder.path).found.startswith(str(folder.path))
    fails(StreamSettings((REMOTE,)), "none configured", REMOTE)


def test_configured_and_absent(tmp_path: Path, folder: KeyFolder) -> None:
    absent = KeyFolder(tmp_path / "none")
    fails(settings(absent), f"no folder {absent.path}")
    assert f"keys init --folder {absent.path}" in keys_check(settings(absent)).action
    (folder.path / "server.key_secret").unlink()
    fails(settings(folder), "server.key_secret does not exist")


def test_modes(folder: KeyFolder) -> None:
    (folder.path / "server.key_secret").chmod(0o640)
    fails(settings(folder), "server.key_secret is open to others (mode 0640)")
    folder.path.chmod(0o755)
    fails(settings(folder), "should be 0700", "mode 0640")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_a_secret_of_another_user(folder: KeyFolder) -> None:
    os.chown(folder.path / "server.key_secret", 65534, -1)
    fails(settings(folder), "another user than its folder (id 65534)")


def test_keys_that_are_no_pair(folder: KeyFolder) -> None:
    path = folder.path / "server.key_secret"
    pair, (other, _) = folder.server(), zmq.curve_keypair()
    path.write_text(path.read_text().replace(pair.public.decode(), other.decode()))
    fails(settings(folder), f"secret and public key in {path} are no pair")
    path.write_text(path.read_text().replace(other.decode(), pair.public.decode()))
    public = folder.path / "server.key"
    public.write_text(public.read_text().replace(pair.public.decode(), other.decode()))
    fails(settings(folder), f"{public} is not the public key of {path}")
    public.unlink()
    fails(settings(folder), "server.key does not exist")


def test_a_folder_of_somebody_else_is_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(folder: KeyFolder) -> list[str]:
        raise PermissionError(13, "Permission denied", str(folder.path))

    monkeypatch.setattr(key_checks.KeyFolder, "problems", closed)
    check = keys_check(StreamSettings((REMOTE,), key_folder="/var/lib/rfconstruct/keys"))
    assert (check.outcome, "sudo -u rfconstruct" in check.action) == ("note", True)


def test_the_doctor_and_the_list_say_the_same(folder: KeyFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the rig that is named; other checks are left out."""
    (folder.path / "server.key_secret").chmod(0o644)
    for name in ("machine", "cpu_features", "memory", "python", "packages", "optional_packages", "rigs", "model"):
        monkeypatch.setattr(doctor_command, name, doctor_command.memory)
    monkeypatch.setattr(key_checks, "DEFAULT_FOLDER", folder.path)
    monkeypatch.setattr(doctor_command, "keys_check", lambda stream: keys_check(settings(folder)))
    outcome = rfconstruct("doctor", "--rig", "cascade_pair", "--json")
    found = {check["name"]: check for check in outcome.json["checks"]}
    assert outcome.code == ExitCode.DEGRADED
    assert "open to others (mode 0644)" in found["keys"]["found"]
    listed = rfconstruct("keys", "list", "--folder", folder.path, "--json")
    assert listed.code == ExitCode.DEGRADED
    assert listed.json["problems"] == [found["keys"]["found"]]
