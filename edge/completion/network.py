# SPDX-License-Identifier: Apache-2.0
"""One ONNX file in ONNX Runtime on the CPU: clouds of any number and size in, completed clouds out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import onnxruntime

from edge.errors import ModelError
from edge.frames import Float32

_OUTPUTS = ("fine", "coarse", "class_probability", "sigma")


class Answer(NamedTuple):
    """What a network says of b clouds, or of one; then the arrays have no leading axis.

    Args:
        fine_m: float32 [b, fine, 3], metres in the frame of the input; the cells of one coarse point in a row.
        coarse_m: float32 [b, coarse, 3].
        probability: float32 [b, classes]; no classes when the graph has no classifier.
        sigma_m: float32 [b, fine], expected distance to the surface, from a network that gives one.
    """

    fine_m: Float32
    coarse_m: Float32
    probability: Float32
    sigma_m: Float32 | None = None

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are."""
        return all(bool(np.isfinite(part).all()) for part in self if part is not None)


class Network:
    """A loaded file; threads sleep between runs, nothing is written to disk.

    Args:
        content: of the file.
        name: for errors.
        threads: of ONNX Runtime.
    Raises:
        ModelError: ONNX Runtime cannot load it.
    """

    def __init__(self, content: bytes, name: str, threads: int = 1) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.add_session_config_entry("session.inter_op.allow_spinning", "0")
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime's own classes have no common root
            raise ModelError(
                f"{name}: ONNX Runtime cannot load it ({type(error).__name__})", action="install the model again"
            ) from error
        self.name = name
        found = {node.name for node in self._session.get_outputs()}
        self._outputs = [output for output in _OUTPUTS if output in found]

    @property
    def signature(self) -> dict[str, tuple[str, list[int | None]]]:
        """Input or output -> type and shape; a dimension that the graph leaves open is None."""
        nodes = [*self._session.get_inputs(), *self._session.get_outputs()]
        return {n.name: (n.type, [d if isinstance(d, int) else None for d in n.shape]) for n in nodes}

    def constant(self, output: str) -> Float32:
        """An output that depends on no input."""
        columns = self.signature["points"][1][1]
        feed = {"points": np.zeros((0, columns or 3), np.float32), "counts": np.zeros(0, np.int64)}
        result: Float32 = self._session.run([output], feed)[0]
        return result

    def run(self, points: Float32) -> Answer:
        """Complete one cloud.

        Args:
            points: float32 [n, columns], n >= 1, in the frame that the manifest names.
        Raises:
            ModelError: ONNX Runtime failed.
        """
        fine, coarse, probability, sigma = self.run_all(points, [len(points)])
        return Answer(fine[0], coarse[0], probability[0], None if sigma is None else sigma[0])

    def run_all(self, points: Float32, counts: Sequence[int]) -> Answer:
        """Complete clouds of different sizes; each gets the numbers that it gets alone.

        Args:
            points: float32 [sum(counts), columns], the clouds one after the other.
            counts: points of each cloud, each >= 1.
        Raises:
            ModelError: counts that do not fit the points, or ONNX Runtime failed.
        """
        if min(counts, default=0) < 1 or sum(counts) != len(points):
            raise ModelError(
                f"{self.name}: counts do not fit the points", value=list(counts), allowed=f">= 1, sum {len(points)}"
            )
        feed = {"points": points, "counts": np.asarray(counts, np.int64)}
        try:
            found: dict[str, Any] = dict(zip(self._outputs, self._session.run(self._outputs, feed), strict=True))
        except Exception as error:  # ONNX Runtime's own classes have no common root
            raise ModelError(f"{self.name} failed ({type(error).__name__})", value=points.shape) from error
        none = np.empty((len(counts), 0), np.float32)
        return Answer(found["fine"], found["coarse"], found.get("class_probability", none), found.get("sigma"))
