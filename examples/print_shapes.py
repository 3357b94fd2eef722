# SPDX-License-Identifier: Apache-2.0
"""Subscribe to an appliance and print one line for every completed shape.

Run it in a second terminal: ``python examples/print_shapes.py [tcp://127.0.0.1:5600]``.
"""

from __future__ import annotations

import sys

from edge import connect
from edge.stream.client import DEFAULT_ENDPOINT
from edge.stream.messages import ShapeMessage


def line(shape: ShapeMessage) -> str:
    """Identity, class, trust, place, size and how old the data were when they were published."""
    x, y, _ = shape.pose.position_m
    length, width, height = shape.size_m
    age_ms = (shape.header.t_pub_ns - shape.t_end_ns) / 1e6 if shape.header.source == "live" else None
    return (
        f"object {shape.identity:3d}  {shape.class_name:<10s}  confidence {shape.confidence:.2f}  "
        f"at x {x:+7.2f} m, y {y:+7.2f} m  size {length:.2f} x {width:.2f} x {height:.2f} m  "
        f"{len(shape.fine_m)} points from {shape.input_points} in {shape.frames} frames"
        + (f"  {age_ms:.0f} ms old" if age_ms is not None else "")
    )


def main() -> int:
    """Print until interrupted; the appliance may come and go."""
    endpoint = sys.argv[1] if len(sys.argv) > 1 else DEFAULT_ENDPOINT
    print(f"waiting for shapes from {endpoint} (Ctrl-C ends)", flush=True)
    with connect(endpoint, topics=("shape",)) as client:
        try:
            for message in client:
                if isinstance(message, ShapeMessage):
                    print(line(message), flush=True)
        except KeyboardInterrupt:
            pass
        print(f"lost {sum(client.lost.values())}, malformed {client.malformed}, restarts {client.restarts}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
