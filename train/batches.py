# SPDX-License-Identifier: Apache-2.0
"""Batches of clouds of different sizes, in an order that depends on the seed and the step only."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Sampler

from edge.config import require
from train.dataset import CompletionDataset, Sample
from train.network import Frame


class Batch(NamedTuple):
    """b samples.

    Args:
        points_m: float32 [sum(counts), columns], the clouds one after the other, never padded; metres, or diagonals of
            the object in frame "box"; a fourth column is dB.
        counts: points of each cloud.
        truth_m: float32 [b, t, 3].
        labels: int64 [b].
    """

    points_m: Tensor
    counts: list[int]
    truth_m: Tensor
    labels: Tensor

    def to(self, device: torch.device) -> Batch:
        """The same batch on a device."""
        moved = (tensor.to(device, non_blocking=True) for tensor in (self.points_m, self.truth_m, self.labels))
        points, truth, labels = moved
        return Batch(points, self.counts, truth, labels)


def in_frame(sample: Sample, frame: Frame) -> Sample:
    """A sample as a network of this frame sees it.

    Line of sight: as it is. Box: a sample of ``DatasetSettings.box_frame``, moved so that the middle of the object's
    box is the origin, and divided by the box's diagonal: the object touches the sphere of diameter 1.
    """
    if frame == "sight":
        return sample
    size_m = np.array(sample.size_m, np.float32)
    diagonal_m = np.float32(np.linalg.norm(size_m))
    require(bool(diagonal_m > 0), "size of the object", sample.size_m, "> 0 m")
    middle_m = np.array([0, 0, size_m[2] / 2], np.float32)
    return replace(
        sample, partial=(sample.partial - middle_m) / diagonal_m, truth=(sample.truth - middle_m) / diagonal_m
    )


def collate(samples: list[Sample], frame: Frame = "sight", columns: int = 3) -> Batch:
    """Join samples; a source without powers counts as all points equal (0 dB)."""
    samples = [in_frame(sample, frame) for sample in samples]
    points = np.concatenate([sample.partial for sample in samples])
    if columns == 4:
        power = [np.zeros(len(s.partial), np.float32) if s.power_db is None else s.power_db for s in samples]
        points = np.concatenate([points, np.concatenate(power)[:, None]], 1)
    return Batch(
        torch.from_numpy(points),
        [len(sample.partial) for sample in samples],
        torch.from_numpy(np.stack([sample.truth for sample in samples])),
        torch.tensor([sample.label for sample in samples]),
    )


class Order(Sampler[list[int]]):
    """Index lists of one epoch from a given batch on; the last incomplete batch is dropped.

    Args:
        length: samples of an epoch.
        batch: samples of a batch of one process.
        seed: of the permutation, together with the epoch.
        rank, ranks: this process's part of every step; together they take what one process with a ``ranks`` times
            larger batch would.
    """

    def __init__(self, length: int, batch: int, seed: int, rank: int = 0, ranks: int = 1) -> None:
        require(length >= ranks, "samples of an epoch", length, f">= {ranks} processes")
        self.length, self.seed = length, seed
        self.batch, self.rank = min(batch, length // ranks), rank
        self.step = self.batch * ranks
        self.epoch, self.first = 0, 0

    def __len__(self) -> int:
        return self.length // self.step - self.first

    def __iter__(self) -> Iterator[list[int]]:
        order = np.random.default_rng([self.seed, self.epoch]).permutation(self.length)
        for number in range(self.first, self.length // self.step):
            start = number * self.step + self.rank * self.batch
            yield order[start : start + self.batch].tolist()


def _start_worker(_: int) -> None:
    """One thread; the trainer alone decides what an interrupt means, and may end the worker."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def endless(
    dataset: CompletionDataset,
    batch: int,
    seed: int,
    step: int,
    workers: int,
    rank: int = 0,
    ranks: int = 1,
    frame: Frame = "sight",
    columns: int = 3,
) -> Iterator[Batch]:
    """Batches from a step on, for ever.

    Args:
        dataset: where the samples come from; its epoch is set.
        batch: samples of a batch.
        seed: of the order.
        step: batches that a run before has already used.
        workers: processes that prepare samples, 0 = this one.
        rank, ranks: see ``Order``.
        frame, columns: see ``collate``.
    """
    order = Order(len(dataset), batch, seed, rank, ranks)
    loader = DataLoader(
        dataset,
        batch_sampler=order,
        num_workers=workers,
        collate_fn=partial(collate, frame=frame, columns=columns),
        worker_init_fn=_start_worker,
        persistent_workers=workers > 0,
        prefetch_factor=4 if workers else None,
    )
    order.epoch, order.first = divmod(step, len(order))
    while True:
        dataset.set_epoch(order.epoch)
        yield from loader
        order.epoch, order.first = order.epoch + 1, 0
