# SPDX-License-Identifier: Apache-2.0
"""Data-parallel training under ``torchrun``: the processes of a run, their mean gradient and their common clock."""

from __future__ import annotations

import os
from collections.abc import Iterable

import torch
import torch.distributed as dist
from torch import Tensor


class Group:
    """The processes of this run; one alone without ``torchrun``. gloo on the CPU, nccl on CUDA.

    Args:
        device: as asked for; "cuda" becomes this process's own GPU.
    """

    def __init__(self, device: str) -> None:
        self.rank, self.size = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
        if self.size > 1 and device == "cuda":
            device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
            torch.cuda.set_device(device)
        self.device = torch.device(device)
        if self.size > 1 and not dist.is_initialized():
            dist.init_process_group("nccl" if self.device.type == "cuda" else "gloo")

    @property
    def leads(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def average_gradients(self, parameters: Iterable[torch.nn.Parameter]) -> None:
        """Replace every gradient by its mean over the processes; one message for all."""
        if self.size == 1:
            return
        gradients = [
            parameter.grad if parameter.grad is not None else torch.zeros_like(parameter) for parameter in parameters
        ]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        dist.all_reduce(flat)
        flat /= self.size
        parts = flat.split([gradient.numel() for gradient in gradients])  # type: ignore[no-untyped-call]
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def agree(self, elapsed_s: float, stop: bool) -> tuple[float, bool]:
        """The first process's clock, and whether any process was told to stop."""
        if self.size == 1:
            return elapsed_s, stop
        said = torch.tensor([elapsed_s if self.leads else 0.0, float(stop)], dtype=torch.float64, device=self.device)
        dist.all_reduce(said)
        return float(said[0]), bool(said[1] > 0)

    def same(self, tensors: Iterable[Tensor]) -> None:
        """Overwrite tensors with the first process's."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor, 0)

    def close(self) -> None:
        """Leave the group, when all have come here: the first process may still be validating and writing.

        Python must not end while a thread of gloo lets go of a tensor: it would abort, and ``torchrun`` end the others.
        """
        if self.size > 1 and dist.is_initialized():
            dist.barrier()
            dist.destroy_process_group()
