# SPDX-License-Identifier: Apache-2.0
"""The pipelines of an OAK: stereo camera and IMU into BasaltVIO or RTABMapVIO, as depthai 3.12 names them.

No device has confirmed them; the nodes, their inputs and outputs are those of the installed package.
"""

from __future__ import annotations

import argparse
from typing import Any

from edge.odometry.oak_child import Graph

SIZE = (640, 400)
QUEUE = 16
RTABMAP_RATE_HZ = 30.0
"""Most that stereo depth and features together reach."""
IMU_STREAMS = ("ACCELEROMETER_UNCALIBRATED", "GYROSCOPE_UNCALIBRATED")
"""In the axes of the device; since 3.12 the RAW streams are in those of the sensor chip."""


def build(dai: Any, args: argparse.Namespace) -> Graph:
    """The pipeline of a camera, not started.

    Args:
        dai: the package.
        args: options of ``edge/odometry/oak_child.py``.
    Raises:
        RuntimeError: no such device (after 11.5 s), or it cannot be opened.
    """
    device = dai.Device(dai.DeviceInfo(args.device)) if args.device else dai.Device()
    pipeline = dai.Pipeline(device)
    exact_frame = args.vio == "rtabmap"
    rate_hz = min(args.rate, RTABMAP_RATE_HZ) if exact_frame else args.rate
    sockets = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
    left, right = (
        pipeline.create(dai.node.Camera).build(socket, sensorFps=rate_hz).requestOutput(SIZE) for socket in sockets
    )
    imu = pipeline.create(dai.node.IMU)
    imu.enableIMUSensor([getattr(dai.IMUSensor, name) for name in IMU_STREAMS], round(args.imu_rate))
    imu.setBatchReportThreshold(1)
    imu.setMaxBatchReports(10)
    if exact_frame:
        odometry, passthrough = _rtabmap(dai, pipeline, left, right)
    else:
        odometry = pipeline.create(dai.node.BasaltVIO)
        odometry.setImuUpdateRate(round(args.imu_rate))
        left.link(odometry.left)
        right.link(odometry.right)
        passthrough = odometry.passthrough
    imu.out.link(odometry.imu)
    return Graph(
        pipeline=pipeline,
        transform=odometry.transform.createOutputQueue(maxSize=QUEUE, blocking=False),
        passthrough=passthrough.createOutputQueue(maxSize=QUEUE, blocking=False),
        imu=imu.out.createOutputQueue(maxSize=4 * QUEUE, blocking=False),
        exact_frame=exact_frame,
        about=f"{args.vio}, {device.getDeviceId()}",
    )


def _rtabmap(dai: Any, pipeline: Any, left: Any, right: Any) -> tuple[Any, Any]:
    """RTABMapVIO with the stereo depth and the features it wants; the node, and the output of its frames."""
    stereo = pipeline.create(dai.node.StereoDepth)
    stereo.setLeftRightCheck(True)
    stereo.setDepthAlign(dai.CameraBoardSocket.CAM_B)
    features = pipeline.create(dai.node.FeatureTracker)
    features.initialConfig.setNumTargetFeatures(1000)
    features.initialConfig.setMotionEstimator(False)
    odometry = pipeline.create(dai.node.RTABMapVIO)
    left.link(stereo.left)
    right.link(stereo.right)
    stereo.rectifiedLeft.link(features.inputImage)
    features.passthroughInputImage.link(odometry.rect)
    stereo.depth.link(odometry.depth)
    features.outputFeatures.link(odometry.features)
    return odometry, odometry.passthroughRect
