# SPDX-License-Identifier: Apache-2.0
"""Batches of clouds of different sizes, in an order that depends on the seed and the step only."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Sampler

from train.dataset import CompletionDataset, Sample


class Batch(NamedTuple):
    """b samples.

    Args:
        points_m: float32 [sum(counts), 3], the clouds one after the other, never padded.
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


def collate(samples: list[Sample]) -> Batch:
    """Join samples."""
    return Batch(
        torch.from_numpy(np.concatenate([sample.partial for sample in samples])),
        [len(sample.partial) for sample in samples],
        torch.from_numpy(np.stack([sample.truth for sample in samples])),
        torch.tensor([sample.label for sample in samples]),
    )


class Order(Sampler[list[int]]):
    """Index lists of one epoch from a given batch on; the last incomplete batch is dropped.

    Args:
        length: samples of an epoch.
        batch: samples of a batch.
        seed: of the permutation, together with the epoch.
    """

    def __init__(self, length: int, batch: int, seed: int) -> None:
        self.length, self.batch, self.seed = length, min(batch, length), seed
        self.epoch, self.first = 0, 0

    def __len__(self) -> int:
        return self.length // self.batch - self.first

    def __iter__(self) -> Iterator[list[int]]:
        order = np.random.default_rng([self.seed, self.epoch]).permutation(self.length)
        for number in range(self.first, self.length // self.batch):
            yield order[number * self.batch : (number + 1) * self.batch].tolist()


def _start_worker(_: int) -> None:
    """One thread; the trainer alone decides what an interrupt means, and may end the worker."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def endless(dataset: CompletionDataset, batch: int, seed: int, step: int, workers: int) -> Iterator[Batch]:
    """Batches from a step on, for ever.

    Args:
        dataset: where the samples come from; its epoch is set.
        batch: samples of a batch.
        seed: of the order.
        step: batches that a run before has already used.
        workers: processes that prepare samples, 0 = this one.
    """
    order = Order(len(dataset), batch, seed)
    loader = DataLoader(
        dataset,
        batch_sampler=order,
        num_workers=workers,
        collate_fn=collate,
        worker_init_fn=_start_worker,
        persistent_workers=workers > 0,
        prefetch_factor=4 if workers else None,
    )
    order.epoch, order.first = divmod(step, len(order))
    while True:
        dataset.set_epoch(order.epoch)
        yield from loader
        order.epoch, order.first = order.epoch + 1, 0
