# SPDX-License-Identifier: Apache-2.0
"""The same work on an existing Ray cluster: items are tasks, results come back to the driver, which writes files."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, TypeVar

from edge.config import require
from edge.errors import DependencyError, RfconstructError
from train.simulate.pool import LIMIT_S, TRIES, Failure, guarded

T = TypeVar("T")
R = TypeVar("R")
_DIED = "its process died"
_AHEAD = 4
"""Tasks handed out for every core of the cluster: enough to keep all busy, few enough to stop quickly."""
_CONNECT_S = 5.0
_GROWTH_S = 10.0
"""How often the number of cores is looked up again: a cluster may grow and shrink."""


class RayPool:
    """Cores of a Ray cluster whose nodes have this software, in this version, and the object library.

    Args:
        address: of the cluster as Ray takes it: "auto", "host:6379", "ray://host:10001"; "local" starts Ray here.
        cores: with "local", how many cores it may use; None = all.
        limit_s: an item that takes longer is stopped with its process.
    Raises:
        DependencyError: Ray is not installed.
        RfconstructError: no cluster answers there.
    """

    def __init__(self, address: str, cores: int | None = None, limit_s: float = LIMIT_S) -> None:
        require(limit_s >= 1, "simulate.limit_s", limit_s, ">= 1 s")
        try:
            import ray
        except ImportError as error:
            raise DependencyError("--address needs Ray", action="pip install 'rfconstruct[cluster]'") from error
        _require_open(address)
        self._ray: Any = ray
        self._limit_s = limit_s
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to anybody
        local = {"num_cpus": cores, "include_dashboard": False} if address == "local" else {}
        try:
            ray.init(address=address, log_to_driver=False, configure_logging=False, **local)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            raise _no_cluster(address, error) from error

    def run(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Failure]]:
        """See ``pool.Pool``: a task whose process or node dies is run once more by Ray, one that raises as well."""
        ray = self._ray
        task = ray.remote(num_cpus=1, max_retries=TRIES - 1)(_run).remote
        shared = ray.put(function)
        source = iter(items)
        pending: dict[Any, tuple[T, int]] = {}
        wanted, looked_s = 0, -_GROWTH_S
        try:
            while True:
                if time.monotonic() - looked_s >= _GROWTH_S:
                    wanted = _AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
                    looked_s = time.monotonic()
                for item in islice(source, max(0, wanted - len(pending))):
                    pending[task(shared, item, self._limit_s)] = (item, 1)
                if not pending:
                    return
                done, _ = ray.wait(list(pending), num_returns=1, timeout=_GROWTH_S)
                for reference in done:
                    item, tries = pending.pop(reference)
                    answer = self._answer(reference)
                    if isinstance(answer, Failure) and tries < TRIES and not answer.error.startswith(_DIED):
                        pending[task(shared, item, self._limit_s)] = (item, tries + 1)
                    else:
                        yield item, answer
        finally:
            for reference in pending:
                ray.cancel(reference, force=True)

    def _answer(self, reference: Any) -> Any:
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            return Failure(f"{_DIED} ({type(error).__name__})")

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()


def _require_open(address: str) -> None:
    """Refuse a host and port where nobody listens; Ray itself would go on trying for minutes.

    Raises:
        RfconstructError: no connection.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon:
        return
    try:
        socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()
    except (OSError, ValueError, OverflowError) as error:
        raise _no_cluster(address, error) from error


def _no_cluster(address: str, error: Exception) -> RfconstructError:
    allowed = "auto, host:6379, ray://host:10001 or local"
    return RfconstructError(f"no Ray cluster answers ({error})", value=address, allowed=allowed)


def _run(function: Callable[[T], R], item: T, limit_s: float) -> R | Failure:
    """Answer an item, or die of the alarm, which also ends a kernel that hangs."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        return guarded(function, item)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
