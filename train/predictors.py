# SPDX-License-Identifier: Apache-2.0
"""What can be evaluated: an answer to a held-out case, from the edge runtime, a checkpoint or any callable."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from edge.completion.model import CompletionModel
from edge.config import CompletionSettings
from edge.errors import ModelError
from edge.frames import Float32, ObjectCloud, Pose
from train.dataset import Sample
from train.held_out import Case

if TYPE_CHECKING:
    from train import network as networks

_SENSOR_M = 10.0


class Answer(NamedTuple):
    """What a predictor says; all but the points may be absent.

    Args:
        fine_m: float32 [n, 3], metres, frame of the input.
        coarse_m: float32 [m, 3], same frame.
        probability: float32 [classes], in the order of ``train.dataset.CLASSES``.
        confidence: 0..1. class_name: what would be published.
        sigma_m: the network's own mean uncertainty of a point.
        seconds: time of the answer where the predictor knows better than the clock around it.
    """

    fine_m: Float32
    coarse_m: Float32 | None = None
    probability: Float32 | None = None
    confidence: float | None = None
    class_name: str = ""
    sigma_m: float | None = None
    seconds: float | None = None


Predictor = Callable[[Case], Answer]


def object_cloud(case: Case) -> ObjectCloud:
    """A case as the edge pipeline would hand it over: the sensor stands on the negative x axis (line of sight)."""
    points = case.sample.partial
    sensor_m = points.mean(axis=0, dtype=np.float64) - (_SENSOR_M, 0, 0)
    pose = Pose(0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    power_db = np.zeros(len(points), np.float32) if case.sample.power_db is None else case.sample.power_db
    return ObjectCloud(case.number, points, power_db, pose, 0, 0, 0.0, case.frames, True, sensor_m)


def box_unit(sample: Sample) -> tuple[np.float32, Float32]:
    """Diagonal and middle of the object's box, metres: where a network of the box frame has its unit and origin."""
    size_m = np.array(sample.size_m, np.float32)
    return np.float32(np.linalg.norm(size_m)), np.array([0, 0, size_m[2] / 2], np.float32)


class EdgePredictor:
    """A shipped model through the code that runs on the vehicle: manifest, hashes, known answer, confidence.

    Args:
        folder: model folder.
        file: of the folder; None: the default one.
    Raises:
        ModelError: of ``CompletionModel.load``.
    """

    def __init__(self, folder: Path, file: str | None = None) -> None:
        self.model = CompletionModel.load(folder, CompletionSettings(), file=file)

    @property
    def box_frame(self) -> bool:
        """Whether the model wants the object's own box (the setting with box priors)."""
        return self.model.manifest.input_frame == "box"

    def __call__(self, case: Case) -> Answer:
        """The answer; ModelError for a cloud that the runtime refuses.

        The vehicle knows no boxes, so a model of the box frame runs without what follows the network: no confidence.
        """
        if self.box_frame:
            return self._in_box(case)
        shape = self.model.complete(object_cloud(case))
        if shape is None:
            raise ModelError(
                "the runtime gives no shape", value=f"{len(case.sample.partial)} points", action="use larger clouds"
            )
        named = np.array([shape.class_probability[name] for name in self.model.manifest.classes], np.float32)
        seconds = 1e-6 * sum(shape.latency_us.values())
        fine, coarse = shape.fine_m, shape.coarse_m
        known = named if named.size else None
        return Answer(fine, coarse, known, shape.confidence, shape.class_name, seconds=seconds)

    def _in_box(self, case: Case) -> Answer:
        from train.batches import collate

        unit_m, origin_m = box_unit(case.sample)
        answer = self.model.run(collate([case.sample], "box", self.model.manifest.columns).points_m.numpy())
        sigma_m = None if answer.sigma_m is None else float(answer.sigma_m.mean() * unit_m)
        known = answer.probability if answer.probability.size else None
        fine, coarse = (points * unit_m + origin_m for points in (answer.fine_m, answer.coarse_m))
        return Answer(fine, coarse, known, sigma_m=sigma_m)


class TorchPredictor:
    """A network in PyTorch.

    Args:
        network: any of ``networks.registry``.
    """

    def __init__(self, network: networks.CompletionModel) -> None:
        self.network = network.eval()
        self.box_frame = network.frame == "box"

    @classmethod
    def load(cls, checkpoint: Path) -> TorchPredictor:
        """The averaged weights of a run; ModelError when it is no checkpoint."""
        from train.checkpoint import load_checkpoint
        from train.networks.registry import of_checkpoint

        return cls(of_checkpoint(load_checkpoint(checkpoint)))

    def __call__(self, case: Case) -> Answer:
        """The answer, in the frame of the case, metres."""
        import torch

        from train.batches import collate

        network = self.network
        batch = collate([case.sample], network.frame, network.columns)
        with torch.inference_mode():
            answer = network(batch.points_m, batch.counts)
        unit_m, origin_m = box_unit(case.sample) if self.box_frame else (np.float32(1), np.zeros(3, np.float32))
        fine, coarse = (points[0].float().numpy() * unit_m + origin_m for points in (answer.fine, answer.coarse))
        known = answer.logits is not None and answer.logits.shape[1] > 0
        sigma = answer.log_sigma
        return Answer(
            np.ascontiguousarray(fine, np.float32),
            np.ascontiguousarray(coarse, np.float32),
            answer.logits[0].float().softmax(0).numpy() if known else None,
            sigma_m=None if sigma is None else float(sigma[0].exp().mean() * network.scale * unit_m),
        )
