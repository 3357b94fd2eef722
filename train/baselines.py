# SPDX-License-Identifier: Apache-2.0
"""What a completion network must beat: answers that need no network, and two references that know the truth."""

from __future__ import annotations

import numpy as np

from edge.config import require
from edge.frames import Float32, Float64
from train.dataset import CLASSES, CompletionDataset, Sample
from train.held_out import Case, in_box_frame, motion
from train.nearest import nearest_distance, nearest_index
from train.predictors import Answer, Predictor

FLOOR = "floor (truth sampled twice)"
ORACLE = "posed oracle"
"""Start of the row's name; it ends with the number of shapes."""
_QUERY_POINTS, _CANDIDATE_POINTS, _FINAL_POINTS = 256, 512, 4096
_FINALISTS = 8
_ALIGN_STEPS = 5
_ALIGN_SHARE = 0.8


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


def floor(case: Case) -> Answer:
    """What a perfect answer scores: the true surface, sampled once more."""
    return Answer(case.resampled())


class Bank:
    """Training shapes, each placed about its own partial input as a network sees it; in the box frame where they are.

    Args:
        dataset: training split, in the frame of the cases.
        shapes: how many samples are kept; the classes come in turn.
    Raises:
        ConfigError: fewer shapes than classes.
    """

    def __init__(self, dataset: CompletionDataset, shapes: int) -> None:
        require(len(CLASSES) <= shapes <= len(dataset), "bank", shapes, f"{len(CLASSES)}..{len(dataset)} shapes")
        self.box_frame = dataset.settings.box_frame
        twin = in_box_frame(dataset)
        self.shapes: list[Float32] = []
        self._motions: list[tuple[Float64, Float64]] = []
        labels = []
        for index in range(shapes):
            sample = dataset[index]
            self.shapes.append(np.asarray(sample.truth - self._place(sample), np.float32))
            self._motions.append(motion(twin[index].truth, self.shapes[-1]))
            labels.append(sample.label)
        self.labels = np.array(labels)

    def _place(self, sample: Sample) -> Float32:
        return np.zeros(3, np.float32) if self.box_frame else place(sample.partial)

    def class_mean(self, sample: Sample) -> Float32:
        """A cloud of the mean distribution of the sample's TRUE class about the input's middle (a help to it)."""
        own = [shape for shape, label in zip(self.shapes, self.labels, strict=True) if label == sample.label]
        each = -(-len(sample.truth) // len(own))
        mean: Float32 = np.concatenate([shape[:each] for shape in own]) + self._place(sample)
        return mean

    def retrieve(self, sample: Sample) -> Float32:
        """The training shape whose surface is nearest to the partial input (Chamfer distance), put at its place.

        Without box priors the eight best are also turned and shifted to fit the input (iterative closest points).
        """
        center = self._place(sample)
        query = np.ascontiguousarray((sample.partial - center)[:_QUERY_POINTS])
        scores = [_chamfer(query, shape[:_CANDIDATE_POINTS]) for shape in self.shapes]
        order = np.argsort(scores)
        best, answer = scores[order[0]], self.shapes[order[0]]
        for number in [] if self.box_frame else order[:_FINALISTS]:
            rotation, shift_m = align(self.shapes[number][:_CANDIDATE_POINTS], query)
            moved = np.ascontiguousarray(self.shapes[number] @ rotation.T + shift_m, np.float32)
            score = _chamfer(query, moved[:_CANDIDATE_POINTS])
            if score < best:
                best, answer = score, moved
        found: Float32 = answer + center
        return found

    def oracle(self, case: Case) -> Float32:
        """The training shape nearest to the TRUTH, with the object's true place and heading: no method can know it."""
        truth = case.unposed(case.sample.truth)
        scores = [
            _chamfer(self._canonical(number, _CANDIDATE_POINTS), truth[:_CANDIDATE_POINTS])
            for number in range(len(self.shapes))
        ]
        finalists = np.argsort(scores)[:_FINALISTS]
        close = [_chamfer(self._canonical(n, _FINAL_POINTS), truth[:_FINAL_POINTS]) for n in finalists]
        return case.posed(self._canonical(int(finalists[int(np.argmin(close))]), len(truth)))

    def _canonical(self, number: int, points: int) -> Float32:
        rotation, translation_m = self._motions[number]
        return np.ascontiguousarray((self.shapes[number][:points] - translation_m) @ rotation, np.float32)

    def predictors(self) -> dict[str, Predictor]:
        """Name to baseline."""
        return {
            "input as output": lambda case: Answer(input_itself(case.sample)),
            "collapse to centre": lambda case: Answer(collapse(case.sample)),
            "class mean shape": lambda case: Answer(self.class_mean(case.sample)),
            f"retrieval of {len(self.shapes)}": lambda case: Answer(self.retrieve(case.sample)),
            f"{ORACLE} of {len(self.shapes)}": lambda case: Answer(self.oracle(case)),
        }


def align(shape: Float32, query: Float32) -> tuple[Float64, Float64]:
    """Turn about z and horizontal shift that bring a shape to a partial cloud: [3, 3] and [3], p' = R p + t.

    Iterative closest points from the query to the shape; the fifth of the pairs that is furthest apart is left out.
    """
    rotation, shift_m = np.eye(3), np.zeros(3)
    for _ in range(_ALIGN_STEPS):
        moved = np.ascontiguousarray(shape @ rotation.T + shift_m, np.float32)
        index = nearest_index(query, moved)
        distance = np.linalg.norm(query - moved[index], axis=1)
        keep = distance <= np.quantile(distance, _ALIGN_SHARE)
        source, target = moved[index][keep][:, :2].astype(np.float64), query[keep][:, :2].astype(np.float64)
        a, b = source - source.mean(axis=0), target - target.mean(axis=0)
        angle_rad = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
        step = np.zeros(3)
        step[:2] = target.mean(axis=0) - turn[:2, :2] @ source.mean(axis=0)
        rotation, shift_m = turn @ rotation, turn @ shift_m + step
    return rotation, shift_m


def _chamfer(first: Float32, second: Float32) -> float:
    return float(nearest_distance(first, second).mean() + nearest_distance(second, first).mean())
