# SPDX-License-Identifier: Apache-2.0
"""Shape completion with ONNX Runtime on the CPU: a partial cloud in, a completed shape out.

A model that is loaded has given its known answer in this process, on this processor: of altered ONNX files a good third
load without complaint and compute something else, so neither the hash nor the runtime alone is trusted. An int8 file
that fails here, as on a processor whose eight-bit products saturate, is replaced by the folder's fp32 file.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.completion.confidence import measures
from edge.completion.golden import PROBE, check_golden
from edge.completion.manifest import Manifest, read_files, read_manifest
from edge.completion.network import Answer, Network
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
FARTHEST_M = 1000.0
"""Coordinates beyond it are no object frame's; the graph's search reckons with less than 10 km."""
_THINNING_SEED = 0
_LOG = logging.getLogger(__name__)


class CompletionModel:
    """A loaded model; made by ``CompletionModel.load``.

    Args:
        manifest: of the folder.
        file: name of the ONNX file that runs.
        network: the loaded file.
        settings: limits and threads.
        fallback: why the default file does not run; "": it does, or another was asked for.
    """

    def __init__(
        self, manifest: Manifest, file: str, network: Network, settings: CompletionSettings, fallback: str = ""
    ) -> None:
        self.manifest, self.file, self.settings, self.fallback = manifest, file, settings, fallback
        self.identifier = manifest.files[file].sha256[:16]
        self._network = network

    @classmethod
    def load(
        cls,
        directory: Path,
        settings: CompletionSettings,
        rig_name: str | None = None,
        file: str | None = None,
    ) -> CompletionModel:
        """Load a model folder: manifest, hashes of all files, session, known answer.

        When the default file is int8 and fails, the fp32 file is taken; ``fallback`` and the log tell why.

        Args:
            directory: model folder (``find_model(settings.model)``).
            settings: limits and threads.
            rig_name: rig whose clouds will be completed; None: not checked.
            file: ONNX file to run, and no other; None: the manifest's default.
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
        candidates = [name]
        if file is None and manifest.files[name].precision != "fp32":
            candidates += [entry.file for entry in manifest.files.values() if entry.precision == "fp32"]
        fallback = ""
        for name in candidates:
            try:
                network = Network(contents[name], str(directory / name), settings.intra_op_threads)
                _check_graph(directory / name, manifest, network)
                check_golden(directory, manifest, name, network)
                break
            except ModelError as error:
                if name == candidates[-1]:
                    raise
                fallback = str(error)
                _LOG.warning("model %s: %s runs instead of its default: %s", manifest.name, candidates[-1], fallback)
        model = cls(manifest, name, network, settings, fallback)
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
            is the calibrated one of the manifest (``edge.completion.confidence``), or that of ``confidence``. The class
            is "unknown" below ``min_confidence``, below the manifest's threshold, and without a classifier.
        Raises:
            ModelError: input or output is not finite, the input is a kilometre away, or there is no line of sight; the
                shape is withheld.
        """
        if len(cloud) < self.settings.min_points:
            return None
        started_ns = time.perf_counter_ns()
        if not (np.abs(cloud.xyz_m) < FARTHEST_M).all():
            raise ModelError(
                f"object {cloud.identity}: its points are not finite and within {FARTHEST_M:g} m, the shape is withheld"
            )
        bearing = self._bearing_rad(cloud)
        points = self._input(cloud, bearing)
        answer = self.run(points)
        if not answer.is_finite:
            raise ModelError(
                f"object {cloud.identity}: the network's answer is not finite, the shape is withheld",
                value=f"{len(points)} points, coordinates up to {float(np.abs(points).max()):.3g} m",
            )
        trust, class_name = self._judged(cloud, points, answer)
        probabilities = dict(zip(self.manifest.classes, answer.probability.tolist(), strict=True))
        probabilities.setdefault(UNKNOWN, 0.0 if probabilities else 1.0)
        return Shape(
            identity=cloud.identity,
            class_name=class_name,
            class_probability=probabilities,
            confidence=trust,
            fine_m=turned(answer.fine_m, bearing),
            coarse_m=turned(answer.coarse_m, bearing),
            input=cloud,
            model=self.identifier,
            latency_us={STAGE: (time.perf_counter_ns() - started_ns) // 1000},
            seen_points=len(points),
        )

    def run(self, points: Float32) -> Answer:
        """The bare network, for one cloud float32 [n, columns] in the manifest's input frame; see ``Network.run``."""
        return self._network.run(points)

    def run_all(self, points: Float32, counts: Sequence[int]) -> Answer:
        """The bare network, for many clouds; see ``Network.run_all``."""
        return self._network.run_all(points, counts)

    def _input(self, cloud: ObjectCloud, bearing: float) -> Float32:
        """What the network sees: at most ``max_points`` rows, turned into its frame, with power where it wants it."""
        points = np.ascontiguousarray(cloud.xyz_m, np.float32)
        rows = _thinned(len(points), self.settings.max_points)
        points = points if rows is None else points[rows]
        points = turned(points, -bearing)
        if self.manifest.columns == len("xyz"):
            return points
        power_db = cloud.power_db if rows is None else cloud.power_db[rows]
        return np.column_stack([points, power_db - np.median(power_db)]).astype(np.float32)

    def _judged(self, cloud: ObjectCloud, points: Float32, answer: Answer) -> tuple[float, str]:
        """Confidence and class: calibrated when the manifest says how."""
        most = float(answer.probability.max(initial=0.0))
        best = self.manifest.classes[int(answer.probability.argmax())] if answer.probability.size else UNKNOWN
        calibrated = self.manifest.confidence
        if calibrated is None:
            likely = most if answer.probability.size else 1.0
            trust = confidence(likely, len(points), cloud)
            return trust, best if trust >= self.settings.min_confidence else UNKNOWN
        sigma_m = None if answer.sigma_m is None else float(answer.sigma_m.mean())
        seen = measures(points[:, :3], answer.fine_m, answer.probability, cloud.frames, sigma_m)
        judged = calibrated.trust(seen)
        unknown = calibrated.is_unknown(judged) or judged.class_right < self.settings.min_confidence
        return judged.shape, UNKNOWN if unknown else best

    def _bearing_rad(self, cloud: ObjectCloud) -> float:
        """Angle of the network's input frame in the object frame."""
        if self.manifest.input_frame == "box":
            raise ModelError(
                f"object {cloud.identity}: the model completes in the object's own box, and no box is known",
                value=self.manifest.name,
                action="choose a model of the line of sight (completion.model)",
            )
        if self.manifest.input_frame == "object":
            return 0.0
        return bearing_rad(f"object {cloud.identity}", cloud.sensor_m, cloud.xyz_m)


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


def _thinned(count: int, most: int) -> NDArray[np.int64] | None:
    """At most ``most`` different rows of ``count``, in their order, a function of the count alone; None: all."""
    if count <= most:
        return None
    rows = np.random.default_rng(_THINNING_SEED).choice(count, most, replace=False)
    rows.sort()
    return rows


def _check_graph(path: Path, manifest: Manifest, network: Network) -> None:
    """Inputs and outputs by name, type and shape; a dimension the graph leaves open is any number."""
    real, whole = "tensor(float)", "tensor(int64)"
    promised: dict[str, tuple[str, list[int | None]]] = {
        "points": (real, [None, manifest.columns]),
        "counts": (whole, [None]),
        "fine": (real, [None, manifest.fine_points, 3]),
        "coarse": (real, [None, manifest.coarse_points, 3]),
    }
    if manifest.classes:
        promised["class_probability"] = (real, [None, len(manifest.classes)])
    found = {name: value for name, value in network.signature.items() if name != PROBE}
    if "sigma" in found:
        promised["sigma"] = (real, [None, manifest.fine_points])
    if found != promised:
        raise ModelError(f"{path}: another graph than the manifest promises", value=found, allowed=str(promised))


def _check_limits(manifest: Manifest, settings: CompletionSettings) -> None:
    """The settings may narrow what the model was trained on, not widen it."""
    for key, value in (("min_points", settings.min_points), ("max_points", settings.max_points)):
        if not manifest.min_points <= value <= manifest.max_points:
            raise ConfigError(
                f"setting completion.{key} leaves what model {manifest.name} was trained on",
                value=value,
                allowed=f"{manifest.min_points}..{manifest.max_points}",
            )
