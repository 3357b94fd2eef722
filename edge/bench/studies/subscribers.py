# SPDX-License-Identifier: Apache-2.0
"""What stuck subscribers cost the others: ``python -m edge.bench.studies.subscribers``.

Clouds of 10,000 points (200 kB) at 60 Hz go to one reader that keeps up, first alone, then beside stuck subscribers: a
process that subscribed to everything and was stopped by SIGSTOP. Latency is from the stamp of publication to the
decoded message in the reader's process, on the clock that both share. Loopback TCP, or CURVE with ``--curve``.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from edge.config import StreamSettings
from edge.frames import Float64, FusedCloud, Pose
from edge.stream.keys import KeyFolder, create_client
from edge.stream.publisher import Publisher

RATE_HZ = 60.0
POINTS = 10_000
READER = """
import sys, time
from edge import connect
from edge.stream.messages import CloudMessage
found = []
with connect(sys.argv[1], ("cloud",), timeout_s=3.0, keys=sys.argv[2] or None) as client:
    for message in client:
        if isinstance(message, CloudMessage):
            if not found:
                print("there", flush=True)
            found.append(time.monotonic_ns() - message.header.t_pub_ns)
print(sum(client.lost.values()), *found)
"""
STUCK = """
import sys, time, zmq
context = zmq.Context()
context.set(zmq.MAX_SOCKETS, 4096)
sockets = [context.socket(zmq.SUB) for _ in range(int(sys.argv[2]))]
for receiver in sockets:
    receiver.setsockopt(zmq.RCVHWM, 4)
    receiver.setsockopt(zmq.SUBSCRIBE, b"")
    receiver.connect(sys.argv[1])
time.sleep(1.0)
print("there", flush=True)
time.sleep(600.0)
"""


def main() -> None:
    """Measure both cases and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stuck", type=int, default=100, help="subscribers that stand still (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each case (default: %(default)s)")
    parser.add_argument("--curve", action="store_true", help="the reader comes through CURVE")
    args = parser.parse_args()
    heads = ("received", "lost", "p50 ms", "p99 ms", "max ms", "send p99 ms", "send max ms")
    print(f"{'case':<20}" + "".join(f"{head:>13}" for head in heads))
    for count in (0, args.stuck):
        lost, latency_ms, send_ms = measure(count, args.seconds, args.curve)
        figures = [*np.percentile(latency_ms, (50, 99, 100)), *np.percentile(send_ms, (99, 100))]
        name = f"{count} stuck{', CURVE' if args.curve else ''}"
        print(f"{name:<20}{len(latency_ms):>13}{lost:>13}" + "".join(f"{figure:>13.2f}" for figure in figures))


def measure(stuck: int, seconds: float, curve: bool) -> tuple[int, Float64, Float64]:
    """One case.

    Args:
        stuck: subscribers that stand still.
        seconds: how long clouds are published.
        curve: the reader comes through CURVE.
    Returns:
        Messages lost to the reader, its latencies and the times of publishing, milliseconds.
    """
    with tempfile.TemporaryDirectory() as folder:
        keys = KeyFolder(Path(folder) / "keys")
        keys.allow("reader", create_client("reader", Path(folder), keys.create().public).public)
        secret = str(Path(folder) / "reader.key_secret") if curve else ""
        settings = StreamSettings(("tcp://127.0.0.1:*", "tcp://0.0.0.0:*"), key_folder=str(keys.path))
        with Publisher(settings, bytes(8), bytes(8), "sim") as publisher:
            local, remote = publisher.endpoints[0], publisher.endpoints[1].replace("0.0.0.0", "127.0.0.1")
            with _stopped(local, stuck):
                return _publish(publisher, remote if curve else local, secret, seconds)


@contextmanager
def _stopped(endpoint: str, count: int) -> Iterator[None]:
    """A process of ``count`` subscribers that was stopped."""
    if not count:
        yield
        return
    with subprocess.Popen([sys.executable, "-c", STUCK, endpoint, str(count)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        os.kill(process.pid, signal.SIGSTOP)
        try:
            yield
        finally:
            process.kill()


def _cloud() -> FusedCloud:
    xyz_m = np.random.default_rng(0).normal(0.0, 3.0, (POINTS, 3)).astype(np.float32)
    pose = Pose(1, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    return FusedCloud(
        xyz_m, xyz_m[:, 0].copy(), np.arange(POINTS, dtype=np.int64), pose, 1, 2, 3.0, 60, False, np.zeros(3)
    )


def _publish(publisher: Publisher, endpoint: str, secret: str, seconds: float) -> tuple[int, Float64, Float64]:
    cloud, send_ms = _cloud(), []
    with subprocess.Popen(
        [sys.executable, "-c", READER, endpoint, secret], stdout=subprocess.PIPE, text=True
    ) as reader:
        assert reader.stdout is not None
        while not select.select([reader.stdout], [], [], 0.05)[0]:
            publisher.cloud(cloud)
        start_s = time.monotonic()
        for number in range(round(seconds * RATE_HZ)):
            time.sleep(max(0.0, start_s + number / RATE_HZ - time.monotonic()))
            before_ns = time.perf_counter_ns()
            publisher.cloud(cloud)
            send_ms.append((time.perf_counter_ns() - before_ns) / 1e6)
        words = reader.communicate(timeout=60.0)[0].removeprefix("there").split()
    latency_ms = np.array(words[1:], dtype=np.float64)[-len(send_ms) :] / 1e6
    return int(words[0]), latency_ms, np.array(send_ms)


if __name__ == "__main__":
    main()
