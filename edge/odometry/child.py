# SPDX-License-Identifier: Apache-2.0
"""A process that sends pose records: started, read, stopped politely, killed when it does not listen."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence

from edge.errors import DeviceError
from edge.odometry.oak_record import Record, RecordReader

READ_BYTES = 1 << 16
LAST_WORDS_BYTES = 2048
"""Of what the process wrote as text, so much of the end is kept for messages."""
REAP_S = 2.0
"""After SIGKILL a process is gone at once, unless the kernel holds it in a driver."""


class Child:
    """One run of the process. It writes records to the file descriptor given by ``--records``; the end of its standard
    input asks it to stop, so it also stops when this process dies.

    Args:
        command: program and arguments.
        environment: added to this process's.
    Raises:
        DeviceError: it cannot be started.
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self._reader, self._words, self._stop_by_s = RecordReader(), b"", float("inf")
        self._records, theirs = os.pipe()
        try:
            self._process = subprocess.Popen(
                [*command, "--records", str(theirs)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,  # the camera's library prints to both
                pass_fds=(theirs,),
                env={**os.environ, **environment},
                start_new_session=True,  # Ctrl-C is for us; the child is asked to stop
            )
        except OSError as error:
            os.close(self._records)
            raise DeviceError(f"cannot start {command[0]}", value=error.strerror, action="check the path") from error
        finally:
            os.close(theirs)
        assert self._process.stdout is not None
        self._output = self._process.stdout.fileno()
        self._selector = selectors.DefaultSelector()
        for descriptor in (self._records, self._output):
            os.set_blocking(descriptor, False)
            self._selector.register(descriptor, selectors.EVENT_READ)

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def garbage_bytes(self) -> int:
        """Bytes that were no record."""
        return self._reader.garbage_bytes

    @property
    def last_words(self) -> str:
        """End of what it wrote as text, in one line."""
        return " ".join(self._words.decode("utf-8", "replace").split())

    @property
    def stopping(self) -> bool:
        """Whether it was asked to stop."""
        return self._stop_by_s < float("inf")

    def read(self, timeout_s: float) -> list[Record]:
        """Records that came; waits at most ``timeout_s`` for the first."""
        found: list[Record] = []
        if not self._selector.get_map():  # both ends closed: it ends, or it lives on in silence
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout_s)
            return found
        for key, _ in self._selector.select(max(0.0, timeout_s)):
            chunk = self._take(key.fd)
            if key.fd == self._records:
                found = self._reader.feed(chunk)
            else:
                self._words = (self._words + chunk)[-LAST_WORDS_BYTES:]
        return found

    def exit_code(self) -> int | None:
        """Code with which it ended, -N: by signal N; None while it runs. Kills it when it should have stopped."""
        if time.monotonic() > self._stop_by_s:
            self._process.kill()
        return self._process.poll()

    def ask_to_stop(self, limit_s: float) -> None:
        """End its standard input; ``exit_code`` kills it after ``limit_s``."""
        if not self.stopping:
            self._stop_by_s = time.monotonic() + limit_s
            self._close_input()

    def close(self, limit_s: float) -> int | None:
        """Stop it, at the latest by SIGKILL after ``limit_s``, and release everything; its exit code."""
        self.ask_to_stop(limit_s)
        try:
            self._process.wait(max(0.0, self._stop_by_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(REAP_S)
        self._selector.close()
        with contextlib.suppress(OSError):
            os.close(self._records)
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._close_input()
        return self._process.poll()

    def _take(self, descriptor: int) -> bytes:
        """Bytes that wait; at the end of the file it is not looked at again."""
        try:
            chunk = os.read(descriptor, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            chunk = b""
        if not chunk:
            self._selector.unregister(descriptor)
        return chunk

    def _close_input(self) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()


def exit_text(code: int) -> str:
    """An exit code in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {-code} ({signal.Signals(-code).name})"
    except ValueError:
        return f"signal {-code}"
