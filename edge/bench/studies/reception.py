# SPDX-License-Identifier: Apache-2.0
"""Study of the capture card's receiver: how fast it takes packets from a loopback socket to frames, and what it loses.

``python -m edge.bench.studies.reception [--rate MB_S] [--seconds S]`` sends packets of a schedule's frames from another
process at a constant rate and prints what came, what the kernel dropped and what the receiving process cost. Both need
a core of their own; on a busy machine the sender falls behind, and says so.
"""

from __future__ import annotations

import argparse
import socket
import subprocess
import sys
import time

from edge.bench.measure import processor
from edge.drivers.dca1000.assembler import FrameAssembler
from edge.drivers.dca1000.packets import PAYLOAD_BYTES, data_header
from edge.drivers.dca1000.receiver import CardReceiver, PacketSocket
from edge.rig import load_rig

BURST = 32
"""Packets between two looks at the clock."""
QUIET_S = 1.0


def send(port: int, rate_mb_s: float, packets: int) -> float:
    """Send a recording at a constant rate.

    Returns:
        MB/s of samples that were reached.
    """
    payload, begin_s = bytes(PAYLOAD_BYTES), time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.connect(("127.0.0.1", port))
        for number in range(packets):
            wire.sendmsg([data_header(number + 1, number * PAYLOAD_BYTES), payload])
            if number % BURST == BURST - 1:
                ahead_s = begin_s + (number + 1) * PAYLOAD_BYTES / (1e6 * rate_mb_s) - time.monotonic()
                if ahead_s > 0:
                    time.sleep(ahead_s)
    return packets * PAYLOAD_BYTES / 1e6 / (time.monotonic() - begin_s)


def receive(rate_mb_s: float, seconds: float) -> str:
    """Receive one such recording; a report of one line."""
    schedule = load_rig("awr1843_pair").radars["horizontal"].schedule
    size, chirps = schedule.frame_bytes, schedule.loops * schedule.slots
    frames = max(1, round(1e6 * rate_mb_s * seconds / size))
    packets = frames * size // PAYLOAD_BYTES
    wire = PacketSocket("127.0.0.1", 0, 16 << 20)
    receiver = CardReceiver(wire, FrameAssembler(size, size // chirps), "study").start()
    receiver.begin()
    sender = [sys.executable, "-m", "edge.bench.studies.reception", "--rate", str(rate_mb_s)]
    arguments = ["--port", str(wire.address[1]), "--packets", str(packets)]
    begin_s, whole = time.process_time(), 0
    with subprocess.Popen([*sender, *arguments], stdout=subprocess.PIPE, text=True) as process:
        while (item := receiver.get(QUIET_S)) is not None or process.poll() is None:
            whole += item is not None and item.data is not None and not item.missing_bytes
        reached = process.stdout.read().strip() if process.stdout else ""
    used_s = time.process_time() - begin_s
    counters = receiver.counters()
    receiver.close()
    counters.account.check()
    megabytes, account = packets * PAYLOAD_BYTES / 1e6, counters.account
    return (
        f"{processor()}: sent {reached} MB/s; {whole} of {frames} frames whole, {account.packets} of {packets} "
        f"packets, {counters.kernel_drops} dropped by the kernel, {counters.overflow_frames} frames not taken in time; "
        f"CPU {1e3 * used_s / megabytes:.2f} ms a MB, so {megabytes / used_s:.0f} MB/s a core"
    )


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=100.0, help="MB/s of samples")
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--port", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--packets", type=int, default=0, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.port:
        print(f"{send(chosen.port, chosen.rate, chosen.packets):.1f}")
    else:
        print(receive(chosen.rate, chosen.seconds))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
