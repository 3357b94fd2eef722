# SPDX-License-Identifier: Apache-2.0
"""Shows the running appliance to who supervises it: systemd and the metrics. The live loop calls it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType

from edge.service.metrics import Metrics
from edge.service.notify import Notifier
from edge.service.snapshot import Snapshot

PERIOD_S = 1.0
SOCKET = "metrics.sock"


class Supervision:
    """READY, STATUS, WATCHDOG and STOPPING for systemd, snapshots for the metrics; a context manager.

    Args:
        notifier: nothing happens where no service manager listens.
        metrics: None: nobody asks.
    """

    def __init__(self, notifier: Notifier, metrics: Metrics | None = None) -> None:
        self._notifier, self._metrics = notifier, metrics
        self._ready, self._due_s = False, 0.0

    @classmethod
    def of_environment(
        cls, path: Path | None = None, port: int | None = None, environment: Mapping[str, str] = os.environ
    ) -> Supervision:
        """What the service manager set up.

        Args:
            path: socket of the metrics; None: ``metrics.sock`` in ``RUNTIME_DIRECTORY``, none without that.
            port: of the metrics on 127.0.0.1; None: none.
            environment: of the process.
        Raises:
            ConfigError: an address of the metrics cannot be bound.
        """
        runtime = environment.get("RUNTIME_DIRECTORY", "").split(":")[0]
        if path is None and runtime:
            path = Path(runtime) / SOCKET
        metrics = Metrics(path, port) if path is not None or port is not None else None
        return cls(Notifier(environment), metrics)

    def progress(self) -> None:
        """Every stage that has work makes progress, or there is none: feed systemd's watchdog."""
        self._notifier.progress()

    def show(self, snapshot: Callable[[], Snapshot]) -> None:
        """Call it as often as convenient: once a second it takes a snapshot for the metrics and for systemd.

        The first one of another state than INIT tells systemd that the service is there.

        Args:
            snapshot: makes it.
        """
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + PERIOD_S
        taken = snapshot()
        if self._metrics is not None:
            self._metrics.update(taken)
        line = summary(taken)
        if not self._ready and taken.status.state != "INIT":
            self._ready = True
            self._notifier.ready(line)
        else:
            self._notifier.status(line)

    def close(self) -> None:
        """Tell systemd that the service ends; the metrics are gone then."""
        self._notifier.stopping("stopping")
        if self._metrics is not None:
            self._metrics.close()

    def __enter__(self) -> Supervision:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def summary(snapshot: Snapshot) -> str:
    """One line for ``systemctl status``: state with its reasons, frame rates, losses, objects."""
    status = snapshot.status
    parts = [status.state + "".join(f" {reason.code}" for reason in status.reasons)]
    parts += [f"{radar} {account.fps:.1f} fps" for radar, account in status.radars.items()]
    lost = sum(sum(account.lost.values()) for account in status.radars.values())
    parts += [f"{lost} frames lost", f"{sum(snapshot.objects.values())} objects"]
    return ", ".join(parts)
