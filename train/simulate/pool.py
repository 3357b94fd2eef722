# SPDX-License-Identifier: Apache-2.0
"""Work on all cores of this machine: a process for each, a second try for a failed item, nothing lost silently."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Generic, NamedTuple, Protocol, TypeVar

from edge.config import require
from edge.errors import RfconstructError

T = TypeVar("T")
R = TypeVar("R")
TRIES = 2
_GREETING = "here"
LIMIT_S = 900.0
_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "NUMBA")
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in _LIBRARIES}


class Failure(NamedTuple):
    """An item that gave no result at its last try, and why."""

    error: str


class Pool(Protocol):
    """Something that applies a function to items, in any order."""

    def run(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Failure]]:
        """Every item exactly once, as soon as its result is there."""
        ...


class LocalPool:
    """Processes on this machine, one thread each.

    They are started fresh (spawn), ignore Ctrl-C, which is the caller's to handle, and end when the caller's process
    ends, however it ends. Leaving ``run`` early (an exception, Ctrl-C, a closed generator) ends them at once.

    Args:
        workers: processes, 0 = one for each core this process may use.
        limit_s: an item that takes longer is stopped with its process.
    Raises:
        ConfigError: a number outside its range.
        RfconstructError: in ``run``: processes cannot be started.
    """

    def __init__(self, workers: int = 0, limit_s: float = LIMIT_S) -> None:
        require(workers >= 0, "simulate.workers", workers, ">= 0")
        require(limit_s > 0, "simulate.limit_s", limit_s, "> 0 s")
        self.workers = workers or len(os.sched_getaffinity(0))
        self.limit_s = limit_s

    def run(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Failure]]:
        """See ``Pool``; the function and the items must be picklable."""
        source = iter(items)
        again: deque[tuple[T, int]] = deque()
        crew = [_Worker[T, R](function) for _ in range(self.workers)]
        try:
            while True:
                for worker in crew:
                    if worker.job is None and not _give(worker, again, source):
                        break
                busy = [worker for worker in crew if worker.job is not None]
                if not busy:
                    return
                for worker in _ready(busy, self.limit_s):
                    if worker.began():
                        continue
                    item, tries = worker.take()
                    answer = worker.answer(self.limit_s)
                    if isinstance(answer, Failure) and tries < TRIES:
                        again.append((item, tries + 1))
                    else:
                        yield item, answer
        finally:
            for worker in crew:
                worker.end()


def _give(worker: _Worker[T, R], again: deque[tuple[T, int]], source: Iterator[T]) -> bool:
    """Hand the next job to an idle worker; False when there is none."""
    if again:
        worker.start(*again.popleft())
        return True
    for item in source:
        worker.start(item, 1)
        return True
    return False


def _ready(busy: list[_Worker[T, R]], limit_s: float) -> list[_Worker[T, R]]:
    """Wait until a busy worker has answered, died or used up its time."""
    first_end = min(worker.since_s for worker in busy) + limit_s
    ready = wait([worker.pipe for worker in busy], timeout=max(0.0, first_end - time.monotonic()))
    now = time.monotonic()
    return [worker for worker in busy if worker.pipe in ready or now - worker.since_s >= limit_s]


class _Worker(Generic[T, R]):
    """One process that is started again when it is gone."""

    def __init__(self, function: Callable[[T], R]) -> None:
        self._function = function
        self._process: BaseProcess | None = None
        self.pipe: Connection
        self.job: tuple[T, int] | None = None
        self.since_s = 0.0
        self._greeted = False

    def start(self, item: T, tries: int) -> None:
        """Begin with an item."""
        if self._process is None or not self._process.is_alive():
            self._launch()
        self.job, self.since_s = (item, tries), time.monotonic()
        with suppress(OSError):  # it died just now: the answer will say so
            self.pipe.send(item)

    def began(self) -> bool:
        """Whether the process has only just said that it is there; its time counts from now on.

        Raises:
            RfconstructError: it died before: no process can work here, so no item is to blame.
        """
        if self._greeted or not self.pipe.poll():
            return False
        try:
            self._greeted = self.pipe.recv() == _GREETING
        except (EOFError, OSError) as error:
            raise RfconstructError(
                "a worker process ended before it began to work",
                action="look at its message above; a script must start the pool under if __name__ == '__main__'",
            ) from error
        self.since_s = time.monotonic()
        return True

    def take(self) -> tuple[T, int]:
        """The job that is over."""
        assert self.job is not None
        job, self.job = self.job, None
        return job

    def answer(self, limit_s: float) -> R | Failure:
        """Result of the job; of a process that died or hangs, why there is none."""
        assert self._process is not None
        if not self.pipe.poll():
            self.end()
            return Failure(f"stopped after {limit_s:g} s")
        try:
            result: R | Failure = self.pipe.recv()
        except (EOFError, OSError):
            self._process.join(5)
            code = self._process.exitcode
            self.end()
            cause = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
            return Failure(f"its process died ({cause})")
        return result

    def _launch(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self._greeted = False
        self._process = context.Process(target=_serve, args=(other, self._function), daemon=True)
        with _for_workers():
            self._process.start()
        other.close()  # so that the death of the process closes the pipe

    def end(self) -> None:
        """Stop the process at once."""
        if self._process is None:
            return
        self._process.kill()
        self._process.join()
        self._process.close()
        self.pipe.close()
        self._process = None


@contextmanager
def _for_workers() -> Iterator[None]:
    """What a process started now inherits: one thread for every library, and Ctrl-C blocked."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    resource_tracker.ensure_running()  # its own start would unblock the signal
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(pipe: Connection, function: Callable[[T], R]) -> None:
    """Answer items until the other end is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(EOFError, OSError):
        pipe.send(_GREETING)
        while True:
            pipe.send(guarded(function, pipe.recv()))


def guarded(function: Callable[[T], R], item: T) -> R | Failure:
    """The function's result, or its exception as text: no bad item may end a run."""
    try:
        return function(item)
    except Exception as error:
        return Failure(f"{type(error).__name__}: {error}")
