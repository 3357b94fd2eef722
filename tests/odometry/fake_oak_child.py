# SPDX-License-Identifier: Apache-2.0
"""Stands in for the camera's process: ``fake_oak_child.py MODE --records FD ...`` sends what MODE says."""

from __future__ import annotations

import math
import os
import select
import signal
import sys
import time

from edge.odometry.oak_record import Kind, PoseFlag, PoseRecord, TextRecord

PERIOD_S = 0.005
FAULT_AT = 20


def record(number: int, t_ns: int, mode: str) -> bytes:
    """Pose ``number``: x in steps of 1 cm."""
    quaternion = (0.0, 0.0, 0.0, 1.0)
    rate, flags = 0.01, PoseFlag(0)
    if mode == "nan" and number % 4 == 1:
        quaternion = (math.nan, 0.0, 0.0, 1.0)
    if mode == "old" and number % 4 == 1:
        t_ns -= 60_000_000_000
    if mode == "future" and number % 4 == 1:
        t_ns += 60_000_000_000
    if mode == "spin" and 20 <= number < 40:
        rate = 1.0
    if mode == "turning":  # no gyroscope: 57 degrees a second about z, all the time
        rate, angle = math.nan, t_ns * 1e-9 % (2 * math.pi)
        quaternion = (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))
    if mode == "guessed":
        flags = PoseFlag.TIME_GUESSED
    arrival_ns = time.monotonic_ns()
    position = (0.01 * number, 0.0, 0.0)
    return PoseRecord(number + 1, flags, t_ns, arrival_ns, position, quaternion, (2.0, 0.0, 0.0), rate).pack()


def fault(mode: str) -> None:
    """What happens after ``FAULT_AT`` poses."""
    if mode == "segfault":
        os.kill(os.getpid(), signal.SIGSEGV)
    if mode == "abort":
        print("terminate called: X_LINK_ERROR", flush=True)
        os.abort()
    if mode == "quit":
        os._exit(12)
    if mode == "hang":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            time.sleep(1)


def main() -> None:
    mode, descriptor = sys.argv[1], int(sys.argv[sys.argv.index("--records") + 1])
    if mode == "no_package":
        sys.exit(10)
    if mode == "mute":
        while not select.select([0], [], [], 60)[0]:
            pass
        return
    os.write(descriptor, TextRecord(Kind.HELLO, 0, 0, f"stand-in, {mode}").pack())
    number = 0
    while not select.select([0], [], [], PERIOD_S)[0]:
        block = record(number, time.monotonic_ns(), mode)
        if mode == "garble" and number % 5 == 2:
            block = b"junk RFPO" + block[:60] + b"\xff" + block[61:]
        if not (mode == "lose" and number % 5 == 2):
            os.write(descriptor, block)
        number += 1
        if number == FAULT_AT:
            fault(mode)


main()
