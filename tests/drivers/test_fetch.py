# SPDX-License-Identifier: Apache-2.0
"""Segments by ssh and by folder: a stand-in for ssh on PATH runs the orders that the board's shell would run."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from edge.board_settings import CascadeBoard
from edge.drivers import fetch
from edge.drivers.fetch import ATTEMPTS, FolderFetcher, SshFetcher, fetcher_for
from edge.errors import CaptureError, DeviceError, LinkError, RefusalError

FAKE_SSH = """#!/bin/sh
printf '%s\\n' "$@" >> {log}
for last; do :; done
read mode < {mode}
case "$mode" in
  ok) exec sh -c "$last" ;;
  cut*) case "$last" in ls*) exec sh -c "$last" ;; esac
        sh -c "$last" | head -c "${{mode#cut}}"
        echo 'client_loop: send disconnect: Broken pipe' >&2; exit 255 ;;
  hang) exec sleep 30 ;;
  *) echo "$mode" >&2; exit 255 ;;
esac
"""
SESSION = "segment_0001"


class Board:
    """The board's disk and the stand-in's orders."""

    def __init__(self, folder: Path) -> None:
        self.storage, self._mode, self._log = folder / "its ssd's", folder / "mode", folder / "log"
        self.mode("ok")
        session = self.storage / SESSION
        session.mkdir(parents=True)
        random = np.random.default_rng(3)
        self.content = {f"{name}_0000_data.bin": random.bytes(100_000) for name in ("master", "slave1")}
        self.content["master_0000_idx.bin"] = b""
        for name, data in self.content.items():
            (session / name).write_bytes(data)
        (session / "a folder").mkdir()
        binaries = folder / "bin"
        binaries.mkdir()
        (binaries / "ssh").write_text(FAKE_SSH.format(log=self._log, mode=self._mode))
        (binaries / "ssh").chmod(0o755)
        self.path = f"{binaries}{os.pathsep}{os.environ['PATH']}"
        self.settings = CascadeBoard(address="192.168.33.181", storage=str(self.storage), ssh_port=2222)

    def mode(self, text: str) -> None:
        self._mode.write_text(text + "\n")

    @property
    def words(self) -> list[str]:
        return self._log.read_text().splitlines() if self._log.exists() else []


@pytest.fixture
def board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Board:
    made = Board(tmp_path)
    monkeypatch.setenv("PATH", made.path)
    return made


def ssh(board: Board, tmp_path: Path) -> SshFetcher:
    return SshFetcher(board.settings, tmp_path / "state")


def test_all_files_come(board: Board, tmp_path: Path) -> None:
    fetcher = ssh(board, tmp_path)
    assert fetcher.check().startswith("ssh root@192.168.33.181")
    assert fetcher.files(SESSION) == {name: len(data) for name, data in board.content.items()}
    folder = fetcher.fetch(SESSION, tmp_path / "here")
    assert folder == tmp_path / "here" / SESSION
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == board.content
    fetcher.delete(SESSION)
    assert not (board.storage / SESSION).exists()
    assert folder.exists()


def test_arguments(board: Board, tmp_path: Path) -> None:
    """No password is ever asked for, waiting is bounded, the known hosts are our own, the user's shell is not used."""
    ssh(board, tmp_path).files(SESSION)
    words = board.words
    assert words[:5] == ["-T", "-p", "2222", "-l", "root"]
    for option in ("BatchMode=yes", "ConnectTimeout=5", "StrictHostKeyChecking=accept-new"):
        assert words[words.index(option) - 1] == "-o"
    assert f'UserKnownHostsFile="{tmp_path / "state" / "known_hosts"}"' in words
    assert words[-3:-1] == ["--", "192.168.33.181"]
    assert words[-1].startswith("ls -ln '")


@pytest.mark.parametrize("session", ["../etc", "a b", "x;reboot", "-rf", "", ".", "a/b", "$(reboot)"])
def test_names_that_are_none(board: Board, tmp_path: Path, session: str) -> None:
    for fetcher in (ssh(board, tmp_path), FolderFetcher(board.storage)):
        for call in (fetcher.files, fetcher.delete, lambda name, f=fetcher: f.fetch(name, tmp_path)):
            with pytest.raises(RefusalError, match="no name"):
                call(session)
    assert board.words == []


def test_a_broken_copy_is_continued(board: Board, tmp_path: Path) -> None:
    board.mode("cut40000")
    folder = ssh(board, tmp_path).fetch(SESSION, tmp_path / "here")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == board.content
    parts = [word for word in board.words if word.startswith("tail -c +") and "slave1" in word]
    assert [word.split()[2] for word in parts] == ["+1", "+40001", "+80001"]


def test_a_copy_that_never_ends_is_given_up(board: Board, tmp_path: Path) -> None:
    board.mode("cut1000")
    with pytest.raises(LinkError, match="cannot be reached"):
        ssh(board, tmp_path).fetch(SESSION, tmp_path / "here")
    assert sum(word.startswith("tail") and "master_0000_data" in word for word in board.words) == ATTEMPTS
    board.mode("ok")  # what is there is not copied again
    ssh(board, tmp_path).fetch(SESSION, tmp_path / "here")
    assert any(word.startswith(f"tail -c +{ATTEMPTS * 1000 + 1} ") for word in board.words)


@pytest.mark.parametrize(
    ("complaint", "kind", "words"),
    [
        ("root@x: Permission denied (publickey,password).", RefusalError, "without a password"),
        ("ssh: connect to host x port 22: Connection refused", LinkError, "no SSH server"),
        ("ssh: connect to host x port 22: No route to host", LinkError, "cannot be reached"),
        ("ssh: connect to host x port 22: Connection timed out", LinkError, "cannot be reached"),
        ("ssh: Could not resolve hostname x: Name or service not known", LinkError, "name is not known"),
        ("WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED!", RefusalError, "another computer than before"),
        ("Unable to negotiate with x: no matching host key type found. Their offer: ssh-rsa", RefusalError, "too old"),
        ("write: No space left on device", LinkError, "disk is full"),
        ("something new", LinkError, "ssh failed"),
    ],
)
def test_refusals_are_named(board: Board, tmp_path: Path, complaint: str, kind: type[DeviceError], words: str) -> None:
    board.mode(complaint)
    for call in (ssh(board, tmp_path).check, lambda: ssh(board, tmp_path).fetch(SESSION, tmp_path / "here")):
        with pytest.raises(kind, match=words) as caught:
            call()
        assert caught.value.value == complaint
        assert caught.value.action


def test_no_such_session(board: Board, tmp_path: Path) -> None:
    with pytest.raises(RefusalError, match="refused") as caught:
        ssh(board, tmp_path).fetch("other", tmp_path)
    assert "No such file" in str(caught.value.value)
    with pytest.raises(LinkError, match="No such file"):
        FolderFetcher(board.storage).fetch("other", tmp_path)


def test_no_ssh(board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path / "nowhere"))
    with pytest.raises(LinkError, match="ssh cannot be run") as caught:
        ssh(board, tmp_path).check()
    assert "openssh-client" in caught.value.action


def test_a_hung_ssh_is_ended(board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    board.mode("hang")
    monkeypatch.setattr(fetch, "ORDER_TIMEOUT_S", 0.3)
    with pytest.raises(LinkError, match="cannot be reached") as caught:
        ssh(board, tmp_path).check()
    assert "timed out" in str(caught.value.value)


def test_an_interrupt_ends_a_copy(board: Board, tmp_path: Path) -> None:
    fetcher = ssh(board, tmp_path)
    sizes = fetcher.files(SESSION)
    board.mode("hang")
    fetcher.files = lambda session: sizes  # type: ignore[method-assign]
    end_s = time.monotonic() + 0.2
    with pytest.raises(LinkError, match="broken off"):
        fetcher.fetch(SESSION, tmp_path / "here", lambda: time.monotonic() > end_s)


def test_no_space(board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetch, "RESERVE_BYTES", 1 << 60)
    with pytest.raises(CaptureError, match="no space"):
        ssh(board, tmp_path).fetch(SESSION, tmp_path / "here")


def test_folder(board: Board, tmp_path: Path) -> None:
    fetcher = fetcher_for(CascadeBoard(fetch="folder", folder=str(board.storage)))
    assert isinstance(fetcher, FolderFetcher)
    assert str(board.storage) in fetcher.check()
    assert fetcher.fetch(SESSION, tmp_path) == board.storage / SESSION
    assert fetcher.files(SESSION).keys() == board.content.keys()
    fetcher.delete(SESSION)
    with pytest.raises(LinkError):
        fetcher.files(SESSION)
    with pytest.raises(LinkError, match="not there"):
        FolderFetcher(tmp_path / "nothing").check()


def test_the_state_folder_is_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert fetch.state_dir() == tmp_path / "rfconstruct"
    assert (tmp_path / "rfconstruct").stat().st_mode & 0o077 == 0
