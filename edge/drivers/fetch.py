# SPDX-License-Identifier: Apache-2.0
"""Brings recorded segments from a capture board: by the system's OpenSSH, or through a folder that is seen here.

Only ``ssh`` is used, no ``scp``: today's scp speaks SFTP, which an embedded system may not serve, and it cannot go on
where a copy broke off. ``ls -ln``, ``tail -c`` and ``rm`` are there on every BusyBox.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Protocol

from edge.board_settings import CascadeBoard
from edge.errors import CaptureError, DeviceError, LinkError, RefusalError

CONNECT_TIMEOUT_S = 5
"""For TCP and the key exchange each; a board on a direct cable answers within a second."""
ORDER_TIMEOUT_S = 30.0
"""For an order without data."""
LEAST_BYTES_S = 2e6
"""A copy slower than this is broken off; 30 to 60 MB/s are expected of the board."""
ATTEMPTS = 3
"""Of a copy, each from where the one before ended."""
RESERVE_BYTES = 64 << 20
"""Stays free on this computer's disk."""
POLL_S = 0.1
SSH_FAILED = 255
"""Exit code of ssh itself; other codes are the remote order's."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")

_Failure = tuple[re.Pattern[str], type[DeviceError], str, str]
_FAILURES: tuple[_Failure, ...] = tuple(
    (re.compile(pattern, re.IGNORECASE), kind, what, action)
    for pattern, kind, what, action in (
        (
            "identification has changed|host key verification failed",
            RefusalError,
            "another computer than before answers at this address",
            "two boards with one address, or a new SD card: remove its line from the known_hosts file that is named",
        ),
        (
            "permission denied|too many authentication|no supported authentication",
            RefusalError,
            "the board does not let this user in without a password",
            "set ssh_user, or copy a key once: ssh-copy-id",
        ),
        (
            "no matching (host key|key exchange|cipher|mac)|unable to negotiate",
            RefusalError,
            "the board's SSH is too old for this client's defaults",
            "allow what it offers in ~/.ssh/config, for example: HostKeyAlgorithms +ssh-rsa",
        ),
        (
            "connection refused",
            LinkError,
            "no SSH server listens on the board",
            "start it on the board's console, or set ssh_port",
        ),
        (
            "could not resolve|name or service not known",
            LinkError,
            "the board's name is not known",
            "give its number as address",
        ),
        (
            "no route|unreachable|timed out|timeout|closed by|reset by|broken pipe|not responding",
            LinkError,
            "the board cannot be reached by SSH",
            "check its supply, the cable and the address: rfconstruct doctor --hardware",
        ),
        ("no space left", LinkError, "this computer's disk is full", "free space, or set another folder"),
    )
)


def state_dir() -> Path:
    """Folder of what this software remembers between runs, made for this user alone (XDG base directories)."""
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    folder = Path(base) / "rfconstruct"
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    return folder


class Fetcher(Protocol):
    """Access to the recordings of one board. A session is a folder's name, not a path."""

    def check(self) -> str:
        """Whether recordings can be reached, in words. DeviceError: they cannot."""

    def files(self, session: str) -> dict[str, int]:
        """Names and bytes of a session's files. DeviceError: it cannot be listed."""

    def fetch(self, session: str, into: Path, stopped: Callable[[], bool] = lambda: False) -> Path:
        """Bring all files here, with their sizes checked.

        Args:
            session: its name.
            into: parent of the folder that is made.
            stopped: asked again and again; True breaks it off.
        Returns:
            Folder that holds the files.
        Raises:
            DeviceError: not reached, refused, or broken off after the last attempt.
            CaptureError: no space here.
        """

    def delete(self, session: str) -> None:
        """Remove a session from the board. DeviceError: it cannot be."""


def fetcher_for(board: CascadeBoard, state: Path | None = None) -> Fetcher:
    """What the board's settings ask for.

    Args:
        board: settings.
        state: folder of the known hosts; None: ``state_dir``.
    """
    return FolderFetcher(Path(board.folder)) if board.fetch == "folder" else SshFetcher(board, state)


def checked_session(session: str) -> str:
    """The name; RefusalError when it is no plain one, so that no path is ever made of it."""
    if not _NAME.fullmatch(session):
        raise RefusalError("no name of a session", value=session, allowed=_NAME.pattern)
    return session


class FolderFetcher:
    """Recordings in a folder that this computer sees: a mounted disk. Nothing is copied.

    Args:
        folder: stands for the board's storage.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def check(self) -> str:
        """As ``Fetcher.check``."""
        if not self.folder.is_dir():
            raise LinkError(
                f"folder {self.folder} of the board's recordings is not there",
                action="mount the board's disk, or set board.folder",
            )
        if not os.access(self.folder, os.R_OK | os.X_OK):
            raise RefusalError(f"folder {self.folder} cannot be read", action="change its rights")
        return f"folder {self.folder}"

    def files(self, session: str) -> dict[str, int]:
        """As ``Fetcher.files``."""
        path = self.folder / checked_session(session)
        try:
            return {entry.name: entry.stat().st_size for entry in sorted(path.iterdir()) if entry.is_file()}
        except OSError as error:
            self.check()
            raise LinkError(
                f"{path}: {error.strerror}",
                action="the board wrote no such session: check its storage, or record again",
            ) from error

    def fetch(self, session: str, into: Path, stopped: Callable[[], bool] = lambda: False) -> Path:
        """The session's folder itself."""
        self.files(session)
        return self.folder / session

    def delete(self, session: str) -> None:
        """As ``Fetcher.delete``."""
        path = self.folder / checked_session(session)
        try:
            shutil.rmtree(path)
        except OSError as error:
            raise RefusalError(f"{path} cannot be removed: {error.strerror}") from error


class SshFetcher:
    """Recordings of a board by the system's ``ssh``: never a password, never a shell on this side.

    Args:
        board: address, user, port, storage.
        state: folder of the known hosts; None: ``state_dir``. Host keys are taken at first sight and held to.
    """

    def __init__(self, board: CascadeBoard, state: Path | None = None) -> None:
        self._board, self._state = board, state

    def check(self) -> str:
        """As ``Fetcher.check``: logs in and looks at the storage."""
        board = self._board
        self._order(f"ls -ld {shlex.quote(board.storage)}", f"{board.storage} of the board")
        return f"ssh {board.ssh_user}@{board.address}, {board.storage}"

    def files(self, session: str) -> dict[str, int]:
        """As ``Fetcher.files``."""
        path = self._path(session)
        return _sizes(self._order(f"ls -ln {shlex.quote(path)}", path))

    def fetch(self, session: str, into: Path, stopped: Callable[[], bool] = lambda: False) -> Path:
        """As ``Fetcher.fetch``; a file that is here in part is continued."""
        sizes, folder = self.files(session), into / checked_session(session)
        folder.mkdir(parents=True, exist_ok=True)
        _require_space(folder, sizes)
        for name, size in sizes.items():
            self._fetch_file(session, name, size, folder / name, stopped)
        return folder

    def delete(self, session: str) -> None:
        """As ``Fetcher.delete``."""
        path = self._path(session)
        self._order(f"rm -rf -- {shlex.quote(path)}", path)

    def command(self, order: str) -> list[str]:
        """Arguments of ssh for one order; ``order`` is quoted for the board's shell already."""
        known = (self._state or state_dir()) / "known_hosts"
        options = {
            "BatchMode": "yes",
            "ConnectTimeout": str(CONNECT_TIMEOUT_S),
            "StrictHostKeyChecking": "accept-new",
            "UserKnownHostsFile": f'"{known}"',
            "ServerAliveInterval": "5",
            "ServerAliveCountMax": "2",
            "ClearAllForwardings": "yes",
            "LogLevel": "ERROR",
        }
        board = self._board
        settings = [word for key, value in options.items() for word in ("-o", f"{key}={value}")]
        return ["ssh", "-T", "-p", str(board.ssh_port), "-l", board.ssh_user, *settings, "--", board.address, order]

    def _path(self, session: str) -> str:
        return f"{self._board.storage.rstrip('/')}/{checked_session(session)}"

    def _order(self, order: str, what: str) -> str:
        """Output of a short order."""
        with tempfile.TemporaryFile() as output:
            code, complaint = self._run(order, output, ORDER_TIMEOUT_S, lambda: False)
            if code:
                raise self._failure(code, complaint, what)
            output.seek(0)
            return output.read().decode("utf-8", "replace")

    def _fetch_file(self, session: str, name: str, size: int, path: Path, stopped: Callable[[], bool]) -> None:
        """One file, in as many parts as it takes."""
        source = f"{self._path(session)}/{name}"
        error: DeviceError | None = None
        for _ in range(ATTEMPTS):
            have = path.stat().st_size if path.exists() else 0
            if have > size:
                path.unlink()
                have = 0
            if have == size and path.exists():
                return
            with path.open("ab") as file:
                timeout_s = ORDER_TIMEOUT_S + (size - have) / LEAST_BYTES_S
                code, complaint = self._run(f"tail -c +{have + 1} {shlex.quote(source)}", file, timeout_s, stopped)
            if stopped():
                raise LinkError(f"{source} of {self._board.address}: the copy was broken off")
            if path.stat().st_size == size:
                return
            error = self._failure(code, complaint, source)
            if isinstance(error, RefusalError):
                break
            _require_space(path.parent, {name: size})
        raise error or LinkError(f"{source}: nothing came")

    def _run(self, order: str, output: IO[bytes], timeout_s: float, stopped: Callable[[], bool]) -> tuple[int, str]:
        """Exit code and complaint of one ssh; ended when it takes too long or the run ends."""
        with tempfile.TemporaryFile() as errors:
            try:
                process = subprocess.Popen(
                    self.command(order),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=errors,
                    start_new_session=True,  # Ctrl-C of the terminal is for this process; it ends ssh in order
                )
            except OSError as error:
                raise LinkError(
                    f"ssh cannot be run: {error.strerror}",
                    action='install OpenSSH (Debian: openssh-client), or set board.fetch = "folder"',
                ) from error
            end_s, late = time.monotonic() + timeout_s, False
            try:
                while not stopped() and not (late := time.monotonic() > end_s):
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(POLL_S)
                        break
            finally:
                _end(process)
            errors.seek(0)
            complaint = errors.read(4096).decode("utf-8", "replace").strip()
        return process.returncode, f"timed out after {timeout_s:.0f} s; {complaint}" if late else complaint

    def _failure(self, code: int, complaint: str, what: str) -> DeviceError:
        """The named error of what ssh or the board's shell said."""
        board = self._board
        where, last = f"{what}, {board.ssh_user}@{board.address}:{board.ssh_port}", complaint or f"exit code {code}"
        for pattern, kind, sentence, action in _FAILURES:
            if pattern.search(complaint):
                return kind(f"{sentence} ({where})", value=last, action=action)
        if code == SSH_FAILED or code < 0:
            return LinkError(f"ssh failed ({where})", value=last, action="try it by hand: ssh -v")
        return RefusalError(f"the board refused ({where})", value=last, action="look at its storage with ssh")


def _end(process: subprocess.Popen[bytes]) -> None:
    """See to it that a child is gone."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(2.0)
        except subprocess.TimeoutExpired:
            process.kill()
    process.wait()


def _sizes(listing: str) -> dict[str, int]:
    """Name -> bytes of the plain files in the output of ``ls -ln``; names that could lead elsewhere are left out."""
    found: dict[str, int] = {}
    for line in listing.splitlines():
        words: Sequence[str] = line.split(maxsplit=8)
        if len(words) == 9 and words[0].startswith("-") and words[4].isdigit() and _NAME.fullmatch(words[8]):
            found[words[8]] = int(words[4])
    return found


def _require_space(folder: Path, sizes: dict[str, int]) -> None:
    """CaptureError unless what is still missing fits on this computer's disk."""
    have = sum(min(size, (folder / name).stat().st_size) for name, size in sizes.items() if (folder / name).exists())
    needed, free = sum(sizes.values()) - have + RESERVE_BYTES, shutil.disk_usage(folder).free
    if needed > free:
        raise CaptureError(
            f"no space for a segment in {folder}",
            value=f"{free / 1e6:.0f} MB free",
            allowed=f"{needed / 1e6:.0f} MB or more",
            action="free space, take shorter segments, or give another folder",
        )
