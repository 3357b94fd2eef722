# SPDX-License-Identifier: Apache-2.0
"""Write the small car that the runtime's demo falls back to: ``python -m train.objects.demo_object``.

The result, ``edge/reference/demo_car.npz``, is committed: ``vertices`` float32 [n, 3] in metres, x forward, y left,
z up, ground z = 0, centred in x and y; ``faces`` int32 [m, 3]; under 60 kB. It is the project's own parametric sedan.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import edge
from train.objects.mesh import Mesh, stand
from train.objects.parametric_car import car
from train.objects.primitives import join

DEMO_SEED = 7
DEMO_FILE = Path(edge.__file__).parent / "reference" / "demo_car.npz"


def demo_car() -> Mesh:
    """The sedan of the demo; vertices on a grid of 1 mm, unused ones dropped."""
    vertices, faces = join(car(np.random.default_rng(DEMO_SEED), "sedan"))
    used, compacted = np.unique(faces, return_inverse=True)
    compact = stand(np.round(vertices[used], 3).astype(np.float32))
    return Mesh(np.round(compact, 3), compacted.reshape(-1, 3).astype(np.int32), 0, "car/demo")


def main() -> int:
    """Write the file; returns the exit code."""
    mesh = demo_car()
    np.savez_compressed(DEMO_FILE, vertices=mesh.vertices, faces=mesh.faces)
    print(f"{DEMO_FILE.name}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, {DEMO_FILE.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
