# SPDX-License-Identifier: Apache-2.0
"""Tells systemd how the service does: one datagram a message, as sd_notify(3) describes; nothing without systemd."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping

STATUS_LIMIT = 512
_USEC = "WATCHDOG_USEC"


class Notifier:
    """The service manager's socket of this process; every method does nothing where there is none.

    Args:
        environment: with ``NOTIFY_SOCKET``, ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` as systemd sets them.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.failures = 0
        """Messages that could not be sent."""
        self._watchdog_s = _watchdog_s(environment)
        self._due_s = 0.0
        self._status = ""

    @property
    def present(self) -> bool:
        """Whether a service manager listens."""
        return self._address.startswith(("/", "\0"))

    @property
    def watchdog_s(self) -> float | None:
        """Longest time between two signs of progress before systemd restarts the service; None: no watchdog."""
        return self._watchdog_s

    def ready(self, status: str = "") -> bool:
        """The service does what it is for, or waits for its devices."""
        return self._send("READY=1", *self._status_lines(status))

    def status(self, text: str) -> bool:
        """One line for ``systemctl status``; sent when it changed."""
        lines = self._status_lines(text)
        return self._send(*lines) if lines else False

    def progress(self) -> bool:
        """The pipeline moved, or has nothing to do: feed the watchdog, not more often than a quarter of its time.

        Call it from the loop that would be stuck if the pipeline were, never from a thread of its own.
        """
        now_s = time.monotonic()
        if self._watchdog_s is None or now_s < self._due_s:
            return False
        self._due_s = now_s + self._watchdog_s / 4
        return self._send("WATCHDOG=1")

    def reloading(self) -> bool:
        """Settings are being read again; ``ready`` ends it."""
        return self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self, status: str = "") -> bool:
        """The service ends."""
        return self._send("STOPPING=1", *self._status_lines(status))

    def _status_lines(self, text: str) -> list[str]:
        line = " ".join(text.split())[:STATUS_LIMIT]
        if not line or line == self._status:
            return []
        self._status = line
        return [f"STATUS={line}"]

    def _send(self, *lines: str) -> bool:
        if not self.present:
            return False
        try:
            with socket.socket(
                socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
            ) as sender:
                sender.sendto("\n".join(lines).encode("utf-8", "replace"), self._address)
        except OSError:
            self.failures += 1
            return False
        return True


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """sd_watchdog_enabled(3): the time, if it is meant for this process."""
    text, pid = environment.get(_USEC, ""), environment.get("WATCHDOG_PID", "")
    if not (text.isascii() and text.isdigit()) or int(text) == 0 or (pid and pid != str(os.getpid())):
        return None
    return int(text) / 1e6
