# SPDX-License-Identifier: Apache-2.0
"""Key files: modes from the first byte on, nothing overwritten, damaged files let nobody in."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path

import pytest
import zmq.auth
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.cli import main
from edge.errors import ConfigError, ExitCode
from edge.stream.keys import KeyFolder, create_client, read_certificate, read_secret


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def folder(tmp_path: Path) -> KeyFolder:
    keys = KeyFolder(tmp_path / "keys")
    keys.create()
    return keys


def test_modes_do_not_depend_on_the_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        keys = KeyFolder(tmp_path / "keys")
        server = keys.create()
        create_client("viewer", tmp_path, server.public)
    finally:
        os.umask(before)
    assert [mode(path) for path in (keys.path, keys.clients)] == [0o700, 0o700]
    assert mode(keys.path / "server.key_secret") == mode(tmp_path / "viewer.key_secret") == 0o600
    assert mode(tmp_path / "viewer.key") == 0o644


def test_public_files_hold_no_secret_and_zeromq_reads_them_all(folder: KeyFolder, tmp_path: Path) -> None:
    client = create_client("viewer", tmp_path, folder.server().public)
    assert b"secret" not in (tmp_path / "viewer.key").read_bytes() + (folder.path / "server.key").read_bytes()
    secret = read_secret(tmp_path / "viewer.key_secret")
    assert zmq.auth.load_certificate(tmp_path / "viewer.key_secret") == (secret.public, secret.secret)
    assert zmq.auth.load_certificate(tmp_path / "viewer.key") == (client.public, None)
    assert zmq.curve_public(secret.secret) == secret.public == client.public
    assert secret.server == folder.server().public
    assert secret.secret.decode() not in repr(secret)


def test_nothing_is_overwritten(folder: KeyFolder, tmp_path: Path) -> None:
    pair = folder.server()
    with pytest.raises(ConfigError, match="exists"):
        folder.create()
    assert folder.server() == pair
    (tmp_path / "viewer.key_secret").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="exists"):
        create_client("viewer", tmp_path, pair.public)
    assert not (tmp_path / "elsewhere").exists()


def test_allow_and_revoke(folder: KeyFolder, tmp_path: Path) -> None:
    public = create_client("viewer", tmp_path, folder.server().public).public
    folder.allow("viewer", public)
    assert folder.allowed() == {public: "viewer"}
    with pytest.raises(ConfigError, match="exists"):
        folder.allow("viewer", public)
    folder.revoke("viewer")
    assert folder.allowed() == {}
    with pytest.raises(ConfigError, match="no such client"):
        folder.revoke("viewer")


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "a/b", "-rf", "server", "x" * 65, "a\n", "ä"])
def test_names_are_no_paths(folder: KeyFolder, name: str) -> None:
    for act in (lambda: folder.allow(name, folder.server().public), lambda: folder.revoke(name)):
        with pytest.raises(ConfigError, match="not a name"):
            act()


def test_problems_are_named(folder: KeyFolder) -> None:
    assert list(folder.problems()) == []
    (folder.clients / "broken.key").write_text("public-key = nothing\n")
    (folder.path / "server.key_secret").chmod(0o644)
    folder.path.chmod(0o755)
    found = " | ".join(folder.problems())
    for part in ("0755", "0644", "broken.key"):
        assert part in found
    assert folder.allowed() == {}


@given(st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_damaged_files_raise_one_kind_of_error(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.key"
    path.write_bytes(content)
    with pytest.raises(ConfigError):
        read_certificate(path)


@pytest.mark.parametrize(
    "text",
    [
        'public-key = "short"',
        'public-key = "' + "x" * 41 + '"',
        'public-key = "' + '"' * 40 + '"',
        ('public-key = "' + "x" * 40 + '"\n') * 2,
        'secret-key = "' + "x" * 40 + '"',
        'public-key = "' + "x" * 40 + '"\n' + "#" * 5000,
    ],
)
def test_keys_that_are_none(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.key"
    path.write_text(text)
    with pytest.raises(ConfigError):
        read_certificate(path)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = str(tmp_path / "keys"), str(tmp_path)

    def call(*argv: str) -> int:
        return main(["keys", *argv, "--folder", folder, "--out", out])

    assert call("init") == ExitCode.OK
    assert call("init") == ExitCode.BAD_CONFIG
    assert call("client", "viewer") == ExitCode.OK
    assert call("client", "viewer") == ExitCode.BAD_CONFIG
    assert call("client", "logger", "--server", f"{folder}/server.key") == ExitCode.OK
    assert call("allow", str(tmp_path / "logger.key")) == ExitCode.OK
    assert call("revoke", "viewer") == ExitCode.OK
    assert call("revoke", "viewer") == ExitCode.BAD_CONFIG
    assert call("list", "viewer") == call("allow") == ExitCode.USAGE
    capsys.readouterr()
    assert call("list", "--json") == ExitCode.OK
    answer = json.loads(capsys.readouterr().out)
    assert list(answer["clients"]) == ["logger"]
    assert answer["problems"] == []
    (tmp_path / "keys" / "server.key_secret").chmod(0o604)
    assert call("list") == ExitCode.DEGRADED
    assert "0604" in capsys.readouterr().out
    assert not (tmp_path / "keys" / "clients" / "viewer.key").exists()
    assert (tmp_path / "logger.key_secret").exists()
