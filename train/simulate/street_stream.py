# SPDX-License-Identifier: Apache-2.0
"""Subscribers of the showcase's own stream: a recording of its results, and the viewer in a process of its own."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from edge.errors import DependencyError, RecordingError, RfconstructError
from edge.recording.recorder import Recorder
from edge.recording.subscribing import RecordingClient
from edge.recording.writer import RecordingWriter

POLL_S = 0.1
END_S = 5.0


class ResultsRecording:
    """Records what is published from ``begin`` until it is closed; the run goes on when it cannot.

    Args:
        endpoint: of the publisher.
        path: of the recording; an older one of that name is replaced.
    Attributes:
        failure: why there is no recording, or not all of it; empty: there is.
    """

    def __init__(self, endpoint: str, path: Path) -> None:
        self.path, self.failure = path, ""
        self._stop = threading.Event()
        path.unlink(missing_ok=True)
        self._client = RecordingClient(endpoint)
        self._recorder = Recorder(RecordingWriter(path, None, ["results of simulated radar data"]))
        self._thread = threading.Thread(target=self._listen, name="street-recording", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Record from here on: nobody wants to watch how the simulator makes its frames."""
        self._client.record_to(self._recorder)

    def _listen(self) -> None:
        try:
            while not self._stop.is_set():
                self._client.recv(POLL_S)
        except RfconstructError as error:
            self.failure = str(error)

    def __enter__(self) -> ResultsRecording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(END_S)
        try:
            self._recorder.close()
        except RecordingError as refused:
            self.failure = str(refused)
        if not self._thread.is_alive():
            self._client.close()


class Viewer:
    """``rfconstruct view`` as a process that ends with the showcase.

    Args:
        endpoint: of the publisher.
        quiet: it must not write to stdout.
    Raises:
        DependencyError: viser is not installed.
    """

    def __init__(self, endpoint: str, quiet: bool) -> None:
        if importlib.util.find_spec("viser") is None:
            raise DependencyError("the viewer needs viser", action="pip install 'rfconstruct[view]'")
        words = [sys.executable, "-m", "edge", "view", "--endpoint", endpoint]
        self._process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL if quiet else None,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self._failure = ""

    def wait(self, stopped: Callable[[], bool]) -> None:
        """Until it ends or ``stopped``."""
        while self._process.poll() is None and not stopped():
            try:
                self._process.wait(POLL_S)
            except subprocess.TimeoutExpired:
                continue

    def failure(self) -> str:
        """What it said when it ended by itself; empty: it runs."""
        if not self.running and self._process.stderr is not None and not self._process.stderr.closed:
            with self._process.stderr as errors:
                self._failure = errors.read().decode("utf-8", "replace").strip() or "without a word"
        return self._failure

    @property
    def running(self) -> bool:
        """Whether the page is still there."""
        return self._process.poll() is None

    def close(self) -> None:
        """End it, in order if it can."""
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stderr is not None:
            self._process.stderr.close()
