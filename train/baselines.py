# SPDX-License-Identifier: Apache-2.0
"""What a completion network must beat: answers that need no network."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from edge.config import require
from edge.frames import Float32
from train.dataset import CLASSES, CompletionDataset, Sample
from train.nearest import nearest_distance
from train.objects.sampling import sample_surface

Predictor = Callable[[Sample], Float32]
_QUERY_POINTS = 256
_CANDIDATE_POINTS = 512


def middle(cloud: Float32) -> Float32:
    """Middle of the bounding box: float32 [3]."""
    center: Float32 = (cloud.max(axis=0) + cloud.min(axis=0)) / 2
    return center


def place(cloud: Float32) -> Float32:
    """Where the network puts its origin: on the ground under the middle of the bounding box, float32 [3]."""
    center = middle(cloud)
    center[2] = 0
    return center


def input_itself(sample: Sample) -> Float32:
    """The partial cloud as it is."""
    return sample.partial


def collapse(sample: Sample) -> Float32:
    """One point: the middle of the input's bounding box."""
    return middle(sample.partial)[None]


class Bank:
    """Training shapes in the line-of-sight frame, each placed as its own partial input was.

    Args:
        dataset: training split.
        shapes: how many samples are kept; the classes come in turn.
    Raises:
        ConfigError: fewer shapes than classes.
    """

    def __init__(self, dataset: CompletionDataset, shapes: int) -> None:
        require(len(CLASSES) <= shapes <= len(dataset), "bank", shapes, f"{len(CLASSES)}..{len(dataset)} shapes")
        samples = [dataset[index] for index in range(shapes)]
        self.shapes = [sample.truth - place(sample.partial) for sample in samples]
        self.labels = np.array([sample.label for sample in samples])

    def class_mean(self, sample: Sample) -> Float32:
        """A cloud of the mean distribution of the sample's TRUE class about the input's middle (a help to it)."""
        own = [shape for shape, label in zip(self.shapes, self.labels, strict=True) if label == sample.label]
        each = -(-len(sample.truth) // len(own))
        mean: Float32 = np.concatenate([shape[:each] for shape in own]) + place(sample.partial)
        return mean

    def retrieve(self, sample: Sample) -> Float32:
        """The training shape whose surface is nearest to the partial input (Chamfer distance), put at its place."""
        center = place(sample.partial)
        query = np.ascontiguousarray((sample.partial - center)[:_QUERY_POINTS])
        best, answer = np.inf, self.shapes[0]
        for shape in self.shapes:
            candidate = shape[:_CANDIDATE_POINTS]
            score = nearest_distance(query, candidate).mean() + nearest_distance(candidate, query).mean()
            if score < best:
                best, answer = score, shape
        found: Float32 = answer + center
        return found

    def predictors(self) -> dict[str, Predictor]:
        """Name to baseline."""
        return {
            "input as output": input_itself,
            "collapse to centre": collapse,
            "class mean shape": self.class_mean,
            f"retrieval of {len(self.shapes)}": self.retrieve,
        }


def resampled(dataset: CompletionDataset, index: int, points: int) -> tuple[Float32, Float32]:
    """Two independent samplings of one object's surface: their distance is the floor of every metric."""
    mesh = dataset.mesh(index)
    rng = np.random.default_rng([dataset.seed, index])
    first, second = (sample_surface(mesh.vertices, mesh.faces, points, rng) for _ in range(2))
    return first, second
