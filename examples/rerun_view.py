# SPDX-License-Identifier: Apache-2.0
"""Show an appliance's stream in Rerun (``pip install rerun-sdk``, 0.23 or newer; 700 MB, for a workstation).

``python examples/rerun_view.py [tcp://127.0.0.1:5600]`` starts Rerun's viewer and logs until a minute of silence.
"""

from __future__ import annotations

import sys
from typing import Any

from edge import connect
from edge.odometry.transforms import transform_points
from edge.stream.client import DEFAULT_ENDPOINT
from edge.stream.messages import CloudMessage, HeatmapMessage, Message, PoseMessage, ShapeMessage, StatusMessage


def log(rr: Any, message: Message) -> None:
    """One message of the stream as entities of Rerun, in the odometry frame at the time of the measurement.

    Args:
        rr: the module ``rerun``.
        message: of the stream.
    """
    rr.set_time("measurement", duration=message.header.t_ns / 1e9)
    match message:
        case ShapeMessage():
            entity, label = f"world/objects/{message.identity}", f"{message.class_name} {message.confidence:.2f}"
            rr.log(f"{entity}/shape", rr.Points3D(transform_points(message.pose, message.fine_m), radii=0.02))
            rr.log(f"{entity}/label", rr.Points3D([message.pose.position_m], labels=[label], radii=0.05))
        case CloudMessage():
            placed_m = transform_points(message.cloud.reference, message.cloud.xyz_m)
            rr.log("world/cloud", rr.Points3D(placed_m, radii=0.03))
        case PoseMessage():
            pose = message.pose
            turn = rr.Quaternion(xyzw=pose.quaternion_xyzw)
            rr.log("world/rig", rr.Transform3D(translation=pose.position_m, rotation=turn))
        case HeatmapMessage():
            rr.log(f"heatmap/{message.radar}", rr.Tensor(message.power_db, dim_names=("direction_cosine", "range")))
        case StatusMessage():
            for stage, values in message.status.latency_us.items():
                rr.log(f"latency_ms/{stage}", rr.Scalars([values[1] / 1e3]))


def main() -> int:
    """Log until silence or Ctrl-C."""
    try:
        import rerun
    except ImportError:
        print("rerun is not installed: pip install rerun-sdk", file=sys.stderr)
        return 2
    endpoint = sys.argv[1] if len(sys.argv) > 1 else DEFAULT_ENDPOINT
    rerun.init("rfconstruct", spawn=True)
    rerun.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    with connect(endpoint, timeout_s=60.0) as client:
        try:
            for message in client:
                log(rerun, message)
        except KeyboardInterrupt:
            pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
