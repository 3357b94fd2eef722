# SPDX-License-Identifier: Apache-2.0
"""Subscribe to an appliance and save every completed shape and every fused cloud as PLY, in odometry coordinates.

``python examples/save_ply.py FOLDER [tcp://127.0.0.1:5600]``; ends with Ctrl-C, or after a minute of silence.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from edge import connect
from edge.frames import Float32, Pose
from edge.odometry.transforms import transform_points
from edge.stream.client import DEFAULT_ENDPOINT
from edge.stream.convert import write_ply
from edge.stream.messages import CloudMessage, Message, ShapeMessage

SILENCE_S = 60.0


def placed(pose: Pose, xyz_m: Float32) -> Float32:
    """Points of a shape (object frame) or of a window (window frame) in the odometry frame, metres."""
    return transform_points(pose, xyz_m).astype(np.float32)


def save(folder: Path, message: Message) -> Path | None:
    """Write the message's points; None: it has none."""
    match message:
        case ShapeMessage():
            path = folder / f"{message.class_name}_{message.identity}_{message.header.sequence:06d}.ply"
            facts = {"frame": "odom, metres", "confidence": f"{message.confidence:.3f}", "t_ns": message.t_end_ns}
            write_ply(path, placed(message.pose, message.fine_m), facts)
        case CloudMessage():
            path = folder / f"cloud_{message.header.sequence:06d}.ply"
            facts = {"frame": "odom, metres", "frames": message.cloud.frames, "t_ns": message.cloud.t_end_ns}
            write_ply(path, placed(message.cloud.reference, message.cloud.xyz_m), facts)
        case _:
            return None
    return path


def main() -> int:
    """Save until silence or Ctrl-C."""
    if len(sys.argv) < 2:
        print("usage: python examples/save_ply.py FOLDER [ADDRESS]", file=sys.stderr)
        return 2
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    endpoint = sys.argv[2] if len(sys.argv) > 2 else DEFAULT_ENDPOINT
    with connect(endpoint, topics=("shape", "cloud"), timeout_s=SILENCE_S) as client:
        try:
            for message in client:
                print(save(folder, message), flush=True)
        except KeyboardInterrupt:
            pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
