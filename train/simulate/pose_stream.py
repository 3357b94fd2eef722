# SPDX-License-Identifier: Apache-2.0
"""The pose sensor of the virtual rig: poses on a ZeroMQ socket in our own wire format, and as the lines of a file.

Messages are those of docs/wire_format.md, topic ``1/pose/``, source "sim": what reads an appliance's poses reads these.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import zmq

from edge.errors import ConfigError
from edge.frames import Pose
from edge.odometry.recorded import COLUMNS
from edge.stream.convert import encode_pose
from edge.stream.wire import BOOT_BYTES, HASH_BYTES, Stamp, pack
from train.simulate.faults import Faults, FaultyChannel
from train.simulate.threads import Later, join, wait_until

WHERE = "pose"


@dataclass(frozen=True, slots=True)
class PoseStreamSettings:
    """How the emulated sensor behaves.

    Args:
        address: of the PUB socket; a port given as * is any free one.
        pace: 1: each pose at its time, 0: as fast as they are taken.
        rebase: times of the poses are moved so that the first one is at the start of the stream, CLOCK_MONOTONIC.
    """

    address: str = "tcp://127.0.0.1:*"
    pace: float = 1.0
    rebase: bool = True


class PoseStream:
    """Sends poses.

    Args:
        poses: in order of time.
        settings: behaviour.
        faults: channel ``pose``.
    Attributes:
        address: of the socket, with its port.
        sent: poses given to the channel.
    Raises:
        ConfigError: the address cannot be bound.
    """

    def __init__(
        self, poses: Iterable[Pose], settings: PoseStreamSettings | None = None, faults: Faults | None = None
    ) -> None:
        self.settings, self.sent = settings or PoseStreamSettings(), 0
        self._poses, self._powered = poses, True
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        try:
            self._socket.bind(self.settings.address)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise ConfigError(f"pose stream cannot use its address ({error})", value=self.settings.address) from error
        self.address = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
        self._lock, self._stop, self._later = threading.Lock(), threading.Event(), Later("pose faults")
        self._channel = FaultyChannel(faults, WHERE, self._emit, self._later, self.unplug)
        self._boot = os.urandom(BOOT_BYTES)
        self._thread = threading.Thread(target=self._run, name="poses", daemon=True)
        self._begin: Callable[[threading.Event], int | None] | None = None

    def start(self, begin: Callable[[threading.Event], int | None] | None = None) -> PoseStream:
        """Begin to send.

        Args:
            begin: waits for the scene to begin and returns by how many ns its times are moved, None: never mind, it
                was stopped; without it the stream begins at once.
        """
        self._begin = begin
        self._thread.start()
        return self

    def stop(self) -> bool:
        """End; whether all threads ended."""
        self._stop.set()
        ended = [join(self._thread), self._later.close()]
        with self._lock:
            self._context.destroy(linger=0)
        return all(ended)

    def __enter__(self) -> PoseStream:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def unplug(self) -> None:
        """Silence."""
        self._powered = False

    def plug(self) -> None:
        """Poses again."""
        self._powered = True

    def _run(self) -> None:
        shift_ns = self._begin(self._stop) if self._begin is not None else None
        if self._begin is not None and shift_ns is None:
            return
        for pose, shift in self._shifted(shift_ns):
            if self.settings.pace > 0:
                due_s = self._start_s + (pose.t_ns - self._first_ns) / 1e9 / self.settings.pace
                if not wait_until(due_s, self._stop):
                    return
            if self._stop.is_set():
                return
            moved = Pose(pose.t_ns + shift, pose.position_m, pose.quaternion_xyzw)
            now_ns = time.monotonic_ns()
            stamp = Stamp(self._boot, self.sent, now_ns, time.time_ns(), False, "sim", bytes(8), bytes(HASH_BYTES))
            self._channel.send(pack(encode_pose(moved), stamp)[1])
            self.sent += 1

    def _shifted(self, shift_ns: int | None) -> Iterator[tuple[Pose, int]]:
        """Poses and what is added to their times; the first one sets the clock."""
        for index, pose in enumerate(self._poses):
            if index == 0:
                now_ns = time.monotonic_ns()
                if shift_ns is None:
                    shift_ns = now_ns - pose.t_ns if self.settings.rebase else 0
                    self._start_s = now_ns / 1e9
                else:
                    self._start_s = (pose.t_ns + shift_ns) / 1e9
                self._first_ns = pose.t_ns
            yield pose, shift_ns or 0

    def _emit(self, header: bytes) -> None:
        with self._lock, contextlib.suppress(zmq.ZMQError):
            if self._powered and not self._socket.closed:
                self._socket.send_multipart([b"1/pose/", header], zmq.NOBLOCK)


def write_poses(path: Path, poses: Iterable[Pose], form: str = "csv") -> int:
    """Write poses as lines that ``edge.odometry.recorded.read_poses`` reads.

    Args:
        path: of the file.
        poses: in order of time.
        form: "csv" with a header line, or "jsonl".
    Returns:
        Lines with a pose.
    """
    count = 0
    with path.open("w", encoding="ascii") as file:
        if form == "csv":
            file.write(",".join(COLUMNS) + "\n")
        for pose in poses:
            values = [pose.t_ns, *pose.position_m.tolist(), *pose.quaternion_xyzw.tolist()]
            line = ",".join(map(repr, values)) if form == "csv" else json.dumps(dict(zip(COLUMNS, values, strict=True)))
            file.write(line + "\n")
            count += 1
    return count
