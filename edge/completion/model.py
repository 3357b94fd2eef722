# SPDX-License-Identifier: Apache-2.0
"""Shape completion with ONNX Runtime on the CPU: a partial cloud in, a completed shape out.

A model that is loaded has given its known answer in this process, on this processor: of altered ONNX files a good third
load without complaint and compute something else, so neither the hash nor the runtime alone is trusted.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from edge.completion.manifest import Manifest, read_files, read_manifest
from edge.completion.sight import bearing_rad, turned
from edge.config import CompletionSettings
from edge.errors import ConfigError, ModelError
from edge.frames import FULL_WINDOW_FRAMES, Float32, ObjectCloud, Shape

UNKNOWN = "unknown"
STAGE = "nn"
"""Name of this stage in ``Shape.latency_us``."""
ENOUGH_POINTS = 256
"""Input points from which on the confidence is not lowered: 60 clouds of held-out objects thinned to 64, 128, 256 and
768 points were completed to a mean Chamfer distance of 8.7, 8.2, 7.2 and 7.5 cm."""
CUT_WINDOW_FACTOR = 0.8
"""Confidence of a window that time, a pose gap or the end of the data cut, against a whole one."""
PROBABILITY_TOLERANCE = 0.02
"""Largest difference of a class probability from its known answer."""
_THINNING_SEED = 0
_OUTPUTS = ["fine", "coarse", "class_probability"]


class CompletionModel:
    """A loaded model; made by ``CompletionModel.load``.

    Args:
        manifest: of the folder.
        file: name of the ONNX file that runs.
        session: the loaded file.
        settings: limits and threads.
    """

    def __init__(
        self, manifest: Manifest, file: str, session: onnxruntime.InferenceSession, settings: CompletionSettings
    ) -> None:
        self.manifest, self.file, self.settings = manifest, file, settings
        self.identifier = manifest.files[file].sha256[:16]
        self._session = session

    @classmethod
    def load(
        cls,
        directory: Path,
        settings: CompletionSettings,
        rig_name: str | None = None,
        file: str | None = None,
    ) -> CompletionModel:
        """Load a model folder: manifest, hashes of all files, session, known answer.

        Args:
            directory: model folder (``find_model(settings.model)``).
            settings: limits and threads.
            rig_name: rig whose clouds will be completed; None: not checked.
            file: ONNX file to run; None: the manifest's default.
        Returns:
            The model, ready; its first shape takes no longer than the next.
        Raises:
            ModelError: absent or altered files, another graph than promised, a wrong known answer (measured and allowed
                difference are named), or a rig the model is not made for.
            ConfigError: the settings ask for clouds the model was not trained on.
        """
        manifest = read_manifest(directory)
        _check_limits(manifest, settings)
        contents = read_files(directory, manifest)
        name = manifest.default_file if file is None else file
        if name not in contents:
            raise ModelError(f"{directory}: no such model file", value=name, allowed=", ".join(contents))
        session = _session(directory / name, contents[name], settings)
        model = cls(manifest, name, session, settings)
        model._check_graph(directory / name)
        model._check_golden(directory)
        if rig_name is not None and not model.valid_for(rig_name):
            raise ModelError(
                f"model {manifest.name} is not made for rig {rig_name}",
                value=rig_name,
                allowed=", ".join(manifest.rigs),
                action="choose another model (completion.model) or train one for this rig",
            )
        return model

    def valid_for(self, rig_name: str) -> bool:
        """Whether the training data are like the clouds of this rig, as the manifest says."""
        return rig_name in self.manifest.rigs

    def complete(self, cloud: ObjectCloud) -> Shape | None:
        """Complete one object.

        More than ``max_points`` points are thinned at random, the same rows every time; nothing is padded or repeated.

        Args:
            cloud: partial cloud in the object frame; a model of the line-of-sight frame also needs ``sensor_m``.
        Returns:
            The shape in the object frame, or None when the cloud has fewer than ``min_points`` points. Its confidence
            is that of ``confidence``; below ``min_confidence`` the class is "unknown".
        Raises:
            ModelError: input or output is not finite, or there is no line of sight; the shape is withheld.
        """
        if len(cloud) < self.settings.min_points:
            return None
        started_ns = time.perf_counter_ns()
        if not np.isfinite(cloud.xyz_m).all():
            raise ModelError(f"object {cloud.identity}: its points are not finite, the shape is withheld")
        points = _thinned(np.ascontiguousarray(cloud.xyz_m, np.float32), self.settings.max_points)
        bearing = self._bearing_rad(cloud)
        fine, coarse, probability = self.run(turned(points, -bearing))
        if not (np.isfinite(fine).all() and np.isfinite(coarse).all() and np.isfinite(probability).all()):
            raise ModelError(
                f"object {cloud.identity}: the network's answer is not finite, the shape is withheld",
                value=f"{len(points)} points, coordinates up to {float(np.abs(points).max()):.3g} m",
            )
        best = int(np.argmax(probability))
        trust = confidence(float(probability[best]), len(points), cloud)
        probabilities = dict(zip(self.manifest.classes, probability.tolist(), strict=True))
        probabilities.setdefault(UNKNOWN, 0.0)
        return Shape(
            identity=cloud.identity,
            class_name=self.manifest.classes[best] if trust >= self.settings.min_confidence else UNKNOWN,
            class_probability=probabilities,
            confidence=trust,
            fine_m=turned(fine, bearing),
            coarse_m=turned(coarse, bearing),
            input=cloud,
            model=self.identifier,
            latency_us={STAGE: (time.perf_counter_ns() - started_ns) // 1000},
            seen_points=len(points),
        )

    def run(self, points_m: Float32) -> tuple[Float32, Float32, Float32]:
        """The bare network.

        Args:
            points_m: float32 [n, 3] in the manifest's input frame.
        Returns:
            Fine points float32 [16384, 3], coarse points float32 [1024, 3], metres in the frame of the input, and class
            probabilities float32 [classes].
        Raises:
            ModelError: ONNX Runtime failed.
        """
        try:
            fine, coarse, probability = self._session.run(_OUTPUTS, {"points": points_m})
        except Exception as error:  # ONNX Runtime's own classes have no common root
            raise ModelError(
                f"model {self.manifest.name}: {self.file} failed ({type(error).__name__})", value=points_m.shape
            ) from error
        return fine, coarse, probability

    def _bearing_rad(self, cloud: ObjectCloud) -> float:
        """Angle of the network's input frame in the object frame."""
        if self.manifest.input_frame == "object":
            return 0.0
        return bearing_rad(f"object {cloud.identity}", cloud.sensor_m, cloud.xyz_m)

    def _check_graph(self, path: Path) -> None:
        """Inputs and outputs by name, type and shape; a dimension the graph leaves open is any number."""
        manifest = self.manifest
        promised = {
            "points": [None, 3],
            "fine": [manifest.fine_points, 3],
            "coarse": [manifest.coarse_points, 3],
            "class_probability": [len(manifest.classes)],
        }
        nodes = [*self._session.get_inputs(), *self._session.get_outputs()]
        found = {n.name: [d if isinstance(d, int) else None for d in n.shape] for n in nodes}
        if found != promised or any(node.type != "tensor(float)" for node in nodes):
            raise ModelError(f"{path}: another graph than the manifest promises", value=found, allowed=str(promised))

    def _check_golden(self, directory: Path) -> None:
        """Run the known input and compare with the known answer."""
        path = directory / self.manifest.golden_file
        golden = _read_golden(path, self.file, self.manifest)
        fine, coarse, probability = self.run(golden["points"])
        allowed_m = self.manifest.tolerance_m[self.file]
        checks = (
            ("fine", fine[golden["fine_rows"]], allowed_m, "m"),
            ("coarse", coarse, allowed_m, "m"),
            ("class_probability", probability, PROBABILITY_TOLERANCE, ""),
        )
        for name, answer, allowed, unit in checks:
            measured = float(np.abs(answer - golden[name]).max())
            if not measured <= allowed:
                raise ModelError(
                    f"{directory / self.file}: {name} of the known input differs from its known answer",
                    value=f"{measured:.3g} {unit}".strip(),
                    allowed=f"at most {allowed:.3g} {unit}".strip(),
                    action="altered weights, or a processor that rounds otherwise: install again or use the fp32 file",
                )


def confidence(class_probability: float, points: int, cloud: ObjectCloud) -> float:
    """How far a shape can be trusted.

    ``p(class) * sqrt(min(1, points / 256)) * sqrt(min(1, frames / 60)) * (1 if the window is complete else 0.8)``: the
    scatter of what the input pins down falls with the square root of points and of independent frames. The class
    probability is the network's own and not calibrated: the product orders shapes and is no rate of being right.

    Args:
        class_probability: of the most probable class.
        points: points the network saw.
        cloud: the object they came from.
    Returns:
        0..1.
    """
    enough = math.sqrt(min(1.0, points / ENOUGH_POINTS))
    window = math.sqrt(min(1.0, max(cloud.frames, 0) / FULL_WINDOW_FRAMES))
    whole = 1.0 if cloud.complete else CUT_WINDOW_FACTOR
    return min(1.0, max(0.0, class_probability * enough * window * whole))


def _thinned(points: Float32, most: int) -> Float32:
    """At most ``most`` different rows, in their order; a function of the cloud alone."""
    if len(points) <= most:
        return points
    rows = np.random.default_rng(_THINNING_SEED).choice(len(points), most, replace=False)
    rows.sort()
    return points[rows]


def _check_limits(manifest: Manifest, settings: CompletionSettings) -> None:
    """The settings may narrow what the model was trained on, not widen it."""
    for key, value in (("min_points", settings.min_points), ("max_points", settings.max_points)):
        if not manifest.min_points <= value <= manifest.max_points:
            raise ConfigError(
                f"setting completion.{key} leaves what model {manifest.name} was trained on",
                value=value,
                allowed=f"{manifest.min_points}..{manifest.max_points}",
            )


def _session(path: Path, content: bytes, settings: CompletionSettings) -> onnxruntime.InferenceSession:
    """ONNX Runtime on the CPU; threads sleep between runs, nothing is written to disk."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = settings.intra_op_threads, 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's own classes have no common root
        raise ModelError(
            f"{path}: ONNX Runtime cannot load it ({type(error).__name__})", action="install the model again"
        ) from error


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
    shapes["points"] = (None, 3)
    for name, shape in shapes.items():
        array = golden[name]
        same = array.ndim == len(shape) and all(s in (None, n) for s, n in zip(shape, array.shape, strict=True))
        right = right and same and array.dtype == np.float32 and bool(np.isfinite(array).all())
    if not right:
        raise ModelError(f"{path}: known answer of {file} has another shape", action="install the model again")
    return golden
