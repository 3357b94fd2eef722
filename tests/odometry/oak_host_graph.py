# SPDX-License-Identifier: Apache-2.0
"""A pipeline without a camera for ``edge.odometry.oak_child``: a host node sends poses along a known path.

Used with ``RFCONSTRUCT_OAK_GRAPH=tests.odometry.oak_host_graph:build``; runs where depthai is installed.
"""

from __future__ import annotations

import argparse
import math
import os
import threading
import time
from datetime import timedelta
from typing import Any

from edge.odometry.oak_child import Graph

RATE_HZ = 100.0
SPEED_M_S = 2.0
TURN_RATE_RAD_S = 0.1
FRAME_LEAD_S = 0.008
"""The frame of a pose was exposed so long before the pose came."""


def pose_at(number: int) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Position and quaternion of pose ``number``: straight, slowly turning."""
    t_s = number / RATE_HZ
    half = TURN_RATE_RAD_S * t_s / 2
    return (SPEED_M_S * t_s, 0.25, 1e-3 * number), (0.0, 0.0, math.sin(half), math.cos(half))


def build(dai: Any, args: argparse.Namespace) -> Graph:
    """A host-only pipeline; the variable OAK_TEST_MODE: "frames" (default), "timed", "bare", "abort", "lost"."""
    mode = os.environ.get("OAK_TEST_MODE", "frames")

    class Source(dai.node.ThreadedHostNode):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.transform, self.passthrough = self.createOutput(), self.createOutput()
            self.imu = self.createOutput()

        def run(self) -> None:
            number = 0
            while self.isRunning():
                (x, y, z), (qx, qy, qz, qw) = pose_at(number)
                message = dai.Odometry(x, y, z, qx, qy, qz, qw, dai.Point3d(SPEED_M_S, 0.0, 0.0))
                instant = timedelta(seconds=time.monotonic() - FRAME_LEAD_S)
                if mode == "timed":
                    message.setTimestamp(instant)
                self.transform.send(message)
                if mode != "bare":
                    frame = dai.ImgFrame()
                    frame.setTimestamp(instant)
                    frame.setSequenceNum(number)
                    self.passthrough.send(frame)
                number += 1
                if mode == "abort" and number == 20:
                    os.abort()
                if mode == "lost" and number == 20:
                    threading.Thread(target=pipeline.stop).start()
                time.sleep(1 / RATE_HZ)

    pipeline = dai.Pipeline(False)
    source = pipeline.create(Source)
    return Graph(
        pipeline=pipeline,
        transform=source.transform.createOutputQueue(maxSize=64, blocking=False),
        passthrough=source.passthrough.createOutputQueue(maxSize=64, blocking=False),
        imu=None,
        exact_frame=args.vio == "rtabmap",
        about="host node",
    )
