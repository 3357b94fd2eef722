# SPDX-License-Identifier: Apache-2.0
"""The completion network: two cascaded PointNet layers, coarse decoder, folding with local features, classifier."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from edge.config import require
from edge.frames import Float32

COARSE_POINTS = 1024
PATCH_SIDE = 4
PATCH_CELLS = PATCH_SIDE * PATCH_SIDE
FINE_POINTS = COARSE_POINTS * PATCH_CELLS
PATCH_HALF_WIDTH = 0.05
"""Half side of the folded grid, in network units."""
SCALE_M = 5.0
"""Metres of one network unit: a car is about one unit long."""


@dataclass(frozen=True, slots=True)
class Width:
    """Channels of the layers (paper: PCN's numbers; edge: half of them with a narrow folding).

    Args:
        point: hidden and output channels of the first PointNet layer.
        local: hidden and output channels of the second.
        coarse: hidden channels of the coarse decoder.
        fold: hidden channels of the folding.
        classifier: hidden channels of the class head.
    """

    point: tuple[int, int]
    local: tuple[int, int]
    coarse: int
    fold: int
    classifier: int


WIDTHS = {
    "paper": Width((128, 256), (512, 1024), 1024, 512, 256),
    "edge": Width((64, 128), (256, 512), 512, 128, 64),
    "tiny": Width((16, 32), (32, 64), 64, 32, 16),
}


class Completion(NamedTuple):
    """What the network gives for a batch of b clouds.

    Args:
        coarse: [b, 1024, 3], metres.
        fine: [b, 1024 * cells, 3], metres, the cells of one coarse point in a row.
        logits: [b, classes].
    """

    coarse: Tensor
    fine: Tensor
    logits: Tensor


def patch_grid() -> Tensor:
    """The folded grid: [16, 2], network units, row by row."""
    axis = torch.linspace(-PATCH_HALF_WIDTH, PATCH_HALF_WIDTH, PATCH_SIDE)
    return torch.cartesian_prod(axis, axis)


class CompletionNetwork(nn.Module):
    """Network of the paper's section on shape completion, with PCN's channel counts where the paper gives none.

    Input and output are in the line-of-sight frame (``edge.completion.sight``) in true metres. Invariant to the order
    and to repetition of the input points. A shift of the input in the plane shifts the output: x and y are centred on
    the middle of the input's bounding box; z stays the height above the ground. All are divided by a constant.

    Args:
        width: channels.
        classes: number of classes.
    """

    patch: Tensor

    def __init__(self, width: Width, classes: int) -> None:
        super().__init__()
        require(classes >= 1, "network.classes", classes, ">= 1")
        self.width = width
        point, local = width.point, width.local
        self.point1, self.point2 = nn.Linear(3, point[0]), nn.Linear(point[0], point[1])
        self.local1, self.local2 = nn.Linear(2 * point[1], local[0]), nn.Linear(local[0], local[1])
        self.coarse1, self.coarse2 = nn.Linear(local[1], width.coarse), nn.Linear(width.coarse, width.coarse)
        self.coarse3 = nn.Linear(width.coarse, 3 * COARSE_POINTS)
        self.fold1 = nn.Linear(2 + 3 + 2 * local[1], width.fold)
        self.fold2, self.fold3 = nn.Linear(width.fold, width.fold), nn.Linear(width.fold, 3)
        self.class1, self.class2 = nn.Linear(local[1], width.classifier), nn.Linear(width.classifier, classes)
        self.register_buffer("patch", patch_grid(), persistent=False)

    @torch.no_grad()
    def start_from(self, shape_m: Float32) -> None:
        """Make the untrained network answer with this shape: it becomes the bias of the coarse decoder's last layer.

        Args:
            shape_m: float32 [1024, 3], metres; x and y from the middle of the input, z from the ground.
        """
        require(shape_m.shape == (COARSE_POINTS, 3), "start shape", shape_m.shape, f"({COARSE_POINTS}, 3)")
        self.coarse3.bias.copy_((torch.from_numpy(shape_m) / SCALE_M).flatten())
        self.coarse3.weight.mul_(0.1)

    def forward(self, points_m: Tensor, counts: Sequence[int], cells: Tensor | None = None) -> Completion:
        """Complete a batch of clouds of different sizes.

        Args:
            points_m: [sum(counts), 3], metres, the clouds one after the other.
            counts: points of each cloud, each >= 1.
            cells: [k] int64, the cells of the patch to compute, None for all 16.
        Returns:
            Coarse and fine points in the frame of the input, and class logits.
        """
        with torch.no_grad():
            clouds = torch.split(points_m, list(counts))
            center_m = torch.stack([(cloud.amax(0) + cloud.amin(0)) / 2 for cloud in clouds])
            center_m[:, 2] = 0
            repeats = torch.tensor(counts, device=points_m.device)
            owner = torch.repeat_interleave(repeats, output_size=len(points_m))
        points = (points_m - center_m[owner]) / SCALE_M
        hidden, feature = self._encode(points, counts, owner)
        coarse = functional.relu(self.coarse2(functional.relu(self.coarse1(feature))))
        coarse = self.coarse3(coarse).view(-1, COARSE_POINTS, 3)
        row = _nearest_rows(coarse.detach(), points, counts)
        fine = self._fold(coarse, hidden[row], feature, self.patch if cells is None else self.patch[cells])
        logits = self.class2(functional.relu(self.class1(feature)))
        shift = center_m[:, None, :]
        return Completion(coarse * SCALE_M + shift, fine * SCALE_M + shift, logits)

    def _encode(self, points: Tensor, counts: Sequence[int], owner: Tensor) -> tuple[Tensor, Tensor]:
        """Hidden rows of the second PointNet layer [points, local[0]] and the global feature [b, local[1]]."""
        split = self.width.point[1]
        first = self.point2(functional.relu(self.point1(points)))
        global1 = torch.stack([part.amax(0) for part in torch.split(first, list(counts))])
        weight = self.local1.weight
        shared = functional.linear(global1, weight[:, split:], self.local1.bias)
        hidden = functional.relu(functional.linear(first, weight[:, :split]) + shared.index_select(0, owner))
        return hidden, self._sparse_max(hidden, counts)

    def _sparse_max(self, hidden: Tensor, counts: Sequence[int]) -> Tensor:
        """Maximum over the points of the last encoder layer; only the winning rows are differentiated (exact)."""
        with torch.no_grad():
            dense = functional.linear(hidden, self.local2.weight)
            offset, rows = 0, []
            for part, count in zip(torch.split(dense, list(counts)), counts, strict=True):
                rows.append(part.argmax(0) + offset)
                offset += count
        winners = hidden[torch.stack(rows)]
        return torch.einsum("bfh,fh->bf", winners, self.local2.weight) + self.local2.bias

    def _fold(self, coarse: Tensor, hidden: Tensor, feature: Tensor, patch: Tensor) -> Tensor:
        """Folding with everything that does not differ per fine point computed once: [b, 1024 * k, 3].

        The local feature is linear in the hidden row, so its weight is multiplied into the folding's first layer.
        """
        channels = self.width.local[1]
        weight = self.fold1.weight
        of_patch, of_coarse = weight[:, :2], weight[:, 2:5]
        of_local, of_global = weight[:, 5 : 5 + channels], weight[:, 5 + channels :]
        shared = functional.linear(feature, of_global, self.fold1.bias + of_local @ self.local2.bias)
        base = functional.linear(hidden, of_local @ self.local2.weight) + functional.linear(coarse, of_coarse)
        base = base + shared[:, None, :]
        first = functional.relu(base[:, :, None, :] + functional.linear(patch, of_patch))
        offset = self.fold3(functional.relu(self.fold2(first)))
        fine: Tensor = coarse[:, :, None, :] + offset
        return fine.flatten(1, 2)


@torch.no_grad()
def _nearest_rows(coarse: Tensor, points: Tensor, counts: Sequence[int]) -> Tensor:
    """Row in ``points`` of the own cloud's point nearest to each coarse point: int64 [b, 1024]."""
    offset, rows = 0, []
    for queries, cloud in zip(coarse, torch.split(points, list(counts)), strict=True):
        score = torch.addmm((cloud * cloud).sum(1), queries, cloud.T, alpha=-2.0)
        rows.append(score.argmin(1) + offset)
        offset += len(cloud)
    return torch.stack(rows)
