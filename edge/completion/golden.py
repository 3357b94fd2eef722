# SPDX-License-Identifier: Apache-2.0
"""The self-test of a model file: a stored input, the stored answer of every file, and the allowed difference.

It notices altered weights, and a processor on which eight-bit products saturate: x86 without VNNI cuts the sum of two
products of unsigned by signed bytes to 16 bits. An int8 file brings a product of the largest codes for that.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from edge.completion.manifest import Manifest
from edge.completion.network import Network
from edge.errors import ModelError

PROBE, PROBE_DEPTH = "eight_bit_sum", 64
"""Output of an int8 file: a product of codes 255 and weights 127, of this depth."""
PROBE_SUM = 255.0 * 127.0 * PROBE_DEPTH
PROBABILITY_TOLERANCE = 0.02
"""Largest difference of a class probability from its known answer."""


def check_golden(directory: Path, manifest: Manifest, file: str, network: Network) -> None:
    """Run the known input and compare with the known answer.

    Args:
        directory: model folder.
        manifest: of that folder; it names the file of answers and the allowed difference.
        file: ONNX file that runs.
        network: that file, loaded.
    Raises:
        ModelError: no known answer, or another one (measured and allowed difference are named), or eight-bit products
            saturate.
    """
    if PROBE in network.signature:
        total = network.constant(PROBE)
        if not (total == PROBE_SUM).all():
            raise ModelError(
                f"{directory / file}: eight-bit products saturate on this processor",
                value=float(total.min()),
                allowed=f"{PROBE_SUM:.0f}, exactly",
                action="use the fp32 file, or export with --weight-bits 7",
            )
    golden = _read_golden(directory / manifest.golden_file, file, manifest)
    answer = network.run(golden["points"])
    allowed_m = manifest.tolerance_m[file]
    checks = (
        ("fine", answer.fine_m[golden["fine_rows"]], allowed_m, "m"),
        ("coarse", answer.coarse_m, allowed_m, "m"),
        ("class_probability", answer.probability, PROBABILITY_TOLERANCE, ""),
    )
    for name, found, allowed, unit in checks:
        measured = float(np.abs(found - golden[name]).max(initial=0.0))
        if not measured <= allowed:
            raise ModelError(
                f"{directory / file}: {name} of the known input differs from its known answer",
                value=f"{measured:.3g} {unit}".strip(),
                allowed=f"at most {allowed:.3g} {unit}".strip(),
                action="altered weights, or a processor that rounds otherwise: install again or use the fp32 file",
            )


def _read_golden(path: Path, file: str, manifest: Manifest) -> dict[str, Any]:
    """Known input and the file's known answers, each of the promised shape."""
    shapes = {
        "fine": (None, 3),
        "coarse": (manifest.coarse_points, 3),
        "class_probability": (len(manifest.classes),),
    }
    try:
        with np.load(path, allow_pickle=False) as stored:
            golden = {name: stored[f"{file}:{name}"] for name in shapes}
            golden |= {"points": stored["points"], "fine_rows": stored["fine_rows"]}
    except Exception as error:  # zip, zlib, header and key errors have no common root
        raise ModelError(f"{path}: no known answer of {file} ({error})", action="install the model again") from error
    rows = golden["fine_rows"]
    right = rows.ndim == 1 and rows.dtype.kind == "i" and len(rows) == len(golden["fine"]) > 0
    right = right and bool(((rows >= 0) & (rows < manifest.fine_points)).all())
    shapes["points"] = (None, manifest.columns)
    for name, shape in shapes.items():
        array = golden[name]
        same = array.ndim == len(shape) and all(s in (None, n) for s, n in zip(shape, array.shape, strict=True))
        right = right and same and array.dtype == np.float32 and bool(np.isfinite(array).all())
    if not right:
        raise ModelError(f"{path}: known answer of {file} has another shape", action="install the model again")
    return golden
