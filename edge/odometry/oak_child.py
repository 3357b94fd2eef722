# SPDX-License-Identifier: Apache-2.0
"""The process that holds an OAK: ``python -m edge.odometry.oak_child --records FD``. depthai is imported here only.

It writes records (``edge/odometry/oak_record.py``) to the file descriptor FD and stops when its standard input ends.
Poses carry no time in depthai 3.12.0, so each is paired with the frame that the odometry node passes on.

``RFCONSTRUCT_OAK_GRAPH=module:function`` replaces the pipeline of a camera (``edge/odometry/oak_graph.py``), for tests
with a host node instead of a device. The process then says so in its first record, and so does the source's name.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import math
import os
import select
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any

from edge.odometry.oak_record import Kind, PoseFlag, PoseRecord, TextRecord

OFFLINE = {
    "DEPTHAI_TELEMETRY": "0",  # only 0, off, OFF and false switch it off
    "DEPTHAI_PROTOCOL": "usb",  # no search for cameras by UDP broadcast
    "DEPTHAI_LEVEL": "error",
    "DEPTHAI_INSTALL_SIGNAL_HANDLER": "0",
    "DEPTHAI_DISABLE_STARTUP_NOTIFICATIONS": "1",
    "DEPTHAI_DISABLE_FEEDBACK": "1",
    "DEPTHAI_DISABLE_CRASHDUMP_COLLECTION": "1",
    "DEPTHAI_ZOO_INTERNET_CHECK": "0",
}
"""Environment with which depthai 3.12.0 opens no socket; it must be set before the import."""
GRAPH_VARIABLE = "RFCONSTRUCT_OAK_GRAPH"
DEFAULT_GRAPH = "edge.odometry.oak_graph:build"

EXIT_NO_PACKAGE, EXIT_NO_DEVICE, EXIT_ENDED, EXIT_FAULT = 10, 11, 12, 13
"""depthai is not installed; no camera, or it cannot be opened; its pipeline ended; anything else."""
ENDED = "the camera's pipeline ended: unplugged, or the device failed"
STOP_LIMIT_S = 3
"""The library's stop may hang; SIGALRM then ends the process."""
WAIT_S = 0.05
ALIVE_S = 0.25
PAIR_WAIT_S = 0.05
"""A pose's frame is sent right after it, unless the processor is busy."""
PATIENCE = 10
"""After so many poses in a row without a frame none is waited for until one comes by itself."""
MOST_SURPLUS = 3
"""So many times in a row more frames than poses may wait: the two do not come at the same instant."""
GYRO_SPAN_NS = 100_000_000
"""The turn rate of a pose is the fastest of so long a time before it."""


class Graph:
    """A pipeline with the queues that are read.

    Args:
        pipeline: not started.
        transform: queue of odometry messages.
        passthrough: queue of the frames that belong to them, in the same order.
        imu: queue of IMU packets; None: no gyroscope.
        exact_frame: the frame is the very one of the pose; False: it is the newest one.
        about: versions and device, for the first record.
    """

    def __init__(
        self, pipeline: Any, transform: Any, passthrough: Any, imu: Any, exact_frame: bool, about: str
    ) -> None:
        self.pipeline, self.transform, self.passthrough, self.imu = pipeline, transform, passthrough, imu
        self.exact_frame, self.about = exact_frame, about


class FramePairing:
    """Times of poses from the frames that are passed on with them, one by one and in order.

    Exactly as many frames are taken as there are poses: the next frame may lie in the queue before its pose was taken.
    When one of the two was dropped on the way, the newest frame goes with the newest pose again.

    Args:
        frames: queue of frames.
        poses: queue of poses; only its length is looked at.
        time_ns: instant of a frame.
    """

    def __init__(self, frames: Any, poses: Any, time_ns: Callable[[Any], int]) -> None:
        self._frames, self._poses, self._time_ns = frames, poses, time_ns
        self._owed = self._surplus = self._alone = 0

    def times(self, count: int) -> list[int]:
        """Instants of ``count`` poses that were just taken, oldest first; 0 for those without a frame."""
        deadline_s = time.monotonic() + (PAIR_WAIT_S if self._alone < PATIENCE else 0.0)
        found: deque[int] = deque(maxlen=count)
        missing = count + self._owed
        while missing and (frame := self._frames.tryGet() or self._later(deadline_s)) is not None:
            found.append(self._time_ns(frame))
            missing -= 1
        lacking = count - len(found)
        self._alone = 0 if found else self._alone + count
        self._owed = min(lacking, 1)  # it may still come, late; then it is passed over
        self._drop_surplus()
        return [0] * lacking + list(found)

    def _later(self, deadline_s: float) -> Any:
        left_s = deadline_s - time.monotonic()
        return self._frames.get(timedelta(seconds=left_s)) if left_s > 0 else None

    def _drop_surplus(self) -> None:
        """Frames that stay behind again and again have lost their poses."""
        surplus = self._frames.getSize() - self._poses.getSize()
        self._surplus = self._surplus + 1 if surplus > 0 else 0
        if self._surplus > MOST_SURPLUS:
            for _ in range(surplus):
                self._frames.tryGet()
            self._surplus = 0


class TurnRate:
    """Fastest rotation of the last ``GYRO_SPAN_NS``."""

    def __init__(self) -> None:
        self._rates: deque[tuple[int, float]] = deque(maxlen=1024)

    def add(self, t_ns: int, rate_rad_s: float) -> None:
        """A sample of the gyroscope's magnitude."""
        self._rates.append((t_ns, rate_rad_s))
        while self._rates and t_ns - self._rates[0][0] > GYRO_SPAN_NS:
            self._rates.popleft()

    def fastest(self, now_ns: int) -> float:
        """NaN when the gyroscope is silent."""
        recent = [rate for t_ns, rate in self._rates if now_ns - t_ns <= 2 * GYRO_SPAN_NS]
        return max(recent, default=math.nan)


class Sender:
    """Writes records without ever waiting: a full pipe loses them, and their numbers show it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self._sequence, self._sent_s = descriptor, 0, 0.0
        os.set_blocking(descriptor, False)

    def text(self, kind: Kind, text: str, code: int = 0) -> None:
        """A TextRecord."""
        self._write(TextRecord(kind, self._sequence, code, text).pack())

    def pose(self, message: Any, flags: PoseFlag, t_ns: int, arrival_ns: int, turn_rate_rad_s: float) -> None:
        """A PoseRecord of an odometry message."""
        position, turn, speed = message.getTranslation(), message.getQuaternion(), message.velocity
        record = PoseRecord(
            sequence=self._sequence,
            flags=flags,
            t_ns=t_ns,
            arrival_ns=arrival_ns,
            position_m=(position.x, position.y, position.z),
            quaternion_xyzw=(turn.qx, turn.qy, turn.qz, turn.qw),
            velocity_m_s=(speed.x, speed.y, speed.z),
            turn_rate_rad_s=turn_rate_rad_s,
        )
        self._write(record.pack())

    def skip(self) -> None:
        """A pose that is not sent: the numbers show it."""
        self._sequence += 1

    def alive(self, text: str) -> None:
        """Say so when nothing was said for a while."""
        if time.monotonic() - self._sent_s > ALIVE_S:
            self.text(Kind.ALIVE, text)

    def _write(self, record: bytes) -> None:
        self._sequence += 1
        with contextlib.suppress(BlockingIOError):
            os.write(self._descriptor, record)
            self._sent_s = time.monotonic()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until standard input ends or the camera does; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m edge.odometry.oak_child")
    parser.add_argument("--records", type=int, required=True, help="file descriptor for the records")
    parser.add_argument("--device", default="", help="device id")
    parser.add_argument("--rate", type=float, default=60.0)
    parser.add_argument("--imu-rate", type=float, default=200.0)
    parser.add_argument("--vio", choices=("basalt", "rtabmap"), default="basalt")
    args = parser.parse_args(arguments)
    os.environ.update(OFFLINE)
    sender = Sender(args.records)
    try:
        return _run(args, sender)
    except BrokenPipeError:
        return EXIT_ENDED
    except Exception as error:  # whatever the library raises is a sentence for the other side
        code = EXIT_NO_PACKAGE if isinstance(error, ModuleNotFoundError) and error.name == "depthai" else EXIT_FAULT
        return _failed(sender, code, f"{type(error).__name__}: {error}")


def _run(args: argparse.Namespace, sender: Sender) -> int:
    import depthai

    module, _, function = os.environ.get(GRAPH_VARIABLE, DEFAULT_GRAPH).partition(":")
    build = getattr(importlib.import_module(module), function)
    test = "" if f"{module}:{function}" == DEFAULT_GRAPH else f"not a camera: {module}:{function}, "
    try:
        graph: Graph = build(depthai, args)
    except RuntimeError as error:  # "No available devices", and the same for busy or forbidden ones
        return _failed(sender, EXIT_NO_DEVICE, f"no camera: {error}")
    sender.text(Kind.HELLO, f"{test}depthai {depthai.__version__}, {graph.about}")
    graph.pipeline.start()
    try:
        code = _pump(graph, sender)
    except depthai.MessageQueue.QueueException:
        code = _failed(sender, EXIT_ENDED, ENDED)
    finally:
        signal.alarm(STOP_LIMIT_S)
        graph.pipeline.stop()  # without stop and wait the library aborts
        graph.pipeline.wait()
    return code


def _pump(graph: Graph, sender: Sender) -> int:
    """Poses to the other side until this one is asked to stop."""
    middle = importlib.import_module("depthai").CameraExposureOffset.MIDDLE
    pairing = FramePairing(graph.passthrough, graph.transform, lambda frame: _ns(frame.getTimestamp(middle)))
    rate, wait = TurnRate(), timedelta(seconds=WAIT_S)
    while graph.pipeline.isRunning():
        if select.select([0], [], [], 0.0)[0] and not os.read(0, 4096):
            return 0
        first = graph.transform.get(wait)
        arrival_ns = time.monotonic_ns()
        for packet in graph.imu.tryGetAll() if graph.imu is not None else ():
            _gyroscope(packet, rate)
        if first is None:
            sender.alive("no pose")
            continue
        messages = [first, *graph.transform.tryGetAll()]
        for message, frame_ns in zip(messages, pairing.times(len(messages)), strict=True):
            t_ns, flags = pose_time(_ns(message.getTimestamp()), frame_ns, arrival_ns, graph.exact_frame)
            if flags & PoseFlag.TIME_GUESSED and message is not messages[-1]:
                sender.skip()  # several came at once: only the newest is of about now
            else:
                sender.pose(message, flags, t_ns, arrival_ns, rate.fastest(arrival_ns))
    return _failed(sender, EXIT_ENDED, ENDED)


def pose_time(own_ns: int, frame_ns: int, arrival_ns: int, exact_frame: bool) -> tuple[int, PoseFlag]:
    """Instant of a pose: its own, else its frame's, else its arrival. 0 means that there is none."""
    if own_ns > 0:
        return own_ns, PoseFlag(0)
    if frame_ns > 0:
        return frame_ns, PoseFlag(0) if exact_frame else PoseFlag.TIME_APPROXIMATE
    return arrival_ns, PoseFlag.TIME_GUESSED


def _gyroscope(message: Any, rate: TurnRate) -> None:
    for packet in message.packets:
        gyro = packet.gyroscope
        rate.add(_ns(gyro.getTimestamp()), math.sqrt(gyro.x * gyro.x + gyro.y * gyro.y + gyro.z * gyro.z))


def _ns(time_: timedelta) -> int:
    return (time_.days * 86400 + time_.seconds) * 1_000_000_000 + time_.microseconds * 1000


def _failed(sender: Sender, code: int, text: str) -> int:
    with contextlib.suppress(OSError):
        sender.text(Kind.ERROR, text, code)
    return code


if __name__ == "__main__":
    result = main()
    sys.stdout.flush()
    os._exit(result)  # the library's threads abort an orderly exit
