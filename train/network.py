# SPDX-License-Identifier: Apache-2.0
"""The paper's network, and PCN: two cascaded PointNet layers, coarse decoder, folding with local features, classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

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
"""Metres of one network unit in the line-of-sight frame: a car is about one unit long."""

Frame = Literal["sight", "box"]
"""Input frame: line of sight in metres, or the object's own box, centred, divided by its diagonal (unit sphere)."""


@dataclass(frozen=True, slots=True)
class Width:
    """Channels of the layers (paper: PCN's numbers; edge: half of them with a narrow folding; wide: a teacher).

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
    "wide": Width((128, 256), (1024, 2048), 2048, 512, 256),
    "paper": Width((128, 256), (512, 1024), 1024, 512, 256),
    "edge": Width((64, 128), (256, 512), 512, 128, 64),
    "tiny": Width((16, 32), (32, 64), 64, 32, 16),
}


class Completion(NamedTuple):
    """What a network gives for a batch of b clouds; lengths in the unit of the input unless said otherwise.

    Args:
        coarse: [b, coarse points, 3].
        fine: [b, coarse points * cells, 3], the cells of one coarse point in a row.
        logits: [b, classes]; [b, 0] from a network without a classifier.
        log_sigma: [b, coarse points * cells], natural logarithm of the expected distance of a fine point to the
            surface, in network units.
        plane: [b, 3], the vertical plane of symmetry: unit normal (x, y) and offset along it, network units, about the
            centre of the input.
        center: [b, 3], that centre.
        feature: [b, channels], the global feature.
        denoised: noisy centres [b, q, 3] and the patches rebuilt about them [b, q, k, 3] (training of a transformer).
    """

    coarse: Tensor
    fine: Tensor
    logits: Tensor
    log_sigma: Tensor | None = None
    plane: Tensor | None = None
    center: Tensor | None = None
    feature: Tensor | None = None
    denoised: tuple[Tensor, Tensor] | None = None


class CompletionModel(nn.Module):
    """What the trainer needs of a network: ``forward`` (below), ``start_from`` and these attributes.

    Attributes:
        frame: of the input.
        coarse_points, cells: the fine cloud has their product.
        coarse_loss: how the coarse cloud is compared with the truth.
        ramp: whether the fine cloud's weight rises during training (PCN) or is 1 throughout.
        columns: of the input: 3, or 4 with relative power in dB as the last.
        trim_percent: of the points that the centre leaves out at each end of x and of y (``middle``).
    """

    coarse_loss: Literal["emd", "chamfer"] = "emd"
    ramp = True
    columns = 3
    trim_percent = 0

    def __init__(self, frame: Frame, coarse_points: int = COARSE_POINTS, cells: int = PATCH_CELLS) -> None:
        super().__init__()
        require(frame in get_args(Frame), "network.frame", frame, ", ".join(get_args(Frame)))
        self.frame, self.coarse_points, self.cells = frame, coarse_points, cells

    @property
    def scale(self) -> float:
        """Input units of one network unit."""
        return SCALE_M if self.frame == "sight" else 1.0

    @property
    def parameter_count(self) -> int:
        """Of everything that is trained."""
        return sum(parameter.numel() for parameter in self.parameters())

    def forward(self, points_m: Tensor, counts: Sequence[int], cells: Tensor | None = None) -> Completion:
        """Complete a batch of clouds of different sizes.

        Args:
            points_m: [sum(counts), columns], the clouds one after the other; in frame "box" not metres but diagonals.
            counts: points of each cloud, each >= 1.
            cells: [k] int64, the cells of a coarse point's patch to compute, None for all.
        Returns:
            Points in the frame of the input.
        """
        raise NotImplementedError

    def start_from(self, shape_m: Float32) -> None:
        """Make the untrained network answer with this shape: float32 [coarse points, 3], from the input's centre."""

    def begin_without(self, missing: Sequence[str]) -> bool:
        """Let parameters that a network of fewer options lacks begin at no effect; False: that is another network."""
        return not missing

    def to_units(self, points_m: Tensor, counts: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Centred points in network units [n, 3], the centres [b, 3] in the input's unit, the cloud of every point [n].

        Line of sight: the centre is the ``middle`` in the plane, the ground in height. Box: 0.
        """
        with torch.no_grad():
            points_m = points_m[:, :3].float() if points_m.dtype != torch.float64 else points_m[:, :3]
            clouds = torch.split(points_m, list(counts))
            center_m = torch.stack([middle(cloud, self.trim_percent) for cloud in clouds])
            center_m[:, 2] = 0
            center_m = center_m * (self.frame == "sight")
            repeats = torch.tensor(counts, device=points_m.device)
            owner = torch.repeat_interleave(repeats, output_size=len(points_m))
            return (points_m - center_m[owner]) / self.scale, center_m, owner


def middle(cloud: Tensor, trim_percent: int = 0) -> Tensor:
    """Middle of the bounding box of a cloud [n, 3], or of what is left of every axis without its ends: [3].

    One stray point moves the middle of the box by half of its distance. With ``trim_percent`` the k smallest and the k
    largest coordinates of every axis do not count, k = (n - 1) trim_percent // 100.
    """
    if trim_percent == 0:
        return (cloud.amax(0) + cloud.amin(0)) / 2
    left_out = (len(cloud) - 1) * trim_percent // 100
    ordered = cloud.sort(0).values
    return (ordered[len(cloud) - 1 - left_out] + ordered[left_out]) / 2


def exactly(tensor: Tensor) -> torch.autocast:
    """Context in which nothing is rounded to bfloat16: for coordinates."""
    return torch.autocast(tensor.device.type, enabled=False)


def patch_grid(rows: int = PATCH_SIDE, columns: int = PATCH_SIDE) -> Tensor:
    """The folded grid: [rows * columns, 2], network units, row by row."""
    first, second = (torch.linspace(-PATCH_HALF_WIDTH, PATCH_HALF_WIDTH, n) for n in (rows, columns))
    return torch.cartesian_prod(first, second)


class CompletionNetwork(CompletionModel):
    """Network of the paper's section on shape completion, with PCN's channel counts where the paper gives none.

    Without local features and classes it is PCN. Invariant to the order and to repetition of the input points. A shift
    of the input in the plane shifts the output in the line-of-sight frame; z stays the height above the ground.

    Args:
        width: channels.
        classes: number of classes, 0 for no classifier.
        frame: of the input.
        local: whether the folding gets the local feature of the nearest input point.
        coarse_points: 1024, or 512 with twice the cells.
        extra: inputs of a point beside its coordinates.
    """

    patch: Tensor

    def __init__(
        self,
        width: Width,
        classes: int,
        frame: Frame = "sight",
        local: bool = True,
        coarse_points: int = COARSE_POINTS,
        extra: int = 0,
    ) -> None:
        cells = FINE_POINTS // coarse_points
        require(coarse_points in (512, 1024), "network.coarse_points", coarse_points, "512, 1024")
        require(classes >= 0, "network.classes", classes, ">= 0")
        super().__init__(frame, coarse_points, cells)
        self.width, self.local = width, local
        point, channels = width.point, width.local
        self.point1, self.point2 = nn.Linear(3 + extra, point[0]), nn.Linear(point[0], point[1])
        self.local1, self.local2 = nn.Linear(2 * point[1], channels[0]), nn.Linear(channels[0], channels[1])
        self.coarse1, self.coarse2 = nn.Linear(channels[1], width.coarse), nn.Linear(width.coarse, width.coarse)
        self.coarse3 = nn.Linear(width.coarse, 3 * coarse_points)
        self.fold1 = nn.Linear(2 + 3 + (1 + local) * channels[1], width.fold)
        self.fold2, self.fold3 = nn.Linear(width.fold, width.fold), nn.Linear(width.fold, 3)
        if classes:
            self.class1, self.class2 = nn.Linear(channels[1], width.classifier), nn.Linear(width.classifier, classes)
        self.classes = classes
        self.register_buffer("patch", patch_grid(cells // PATCH_SIDE), persistent=False)

    @torch.no_grad()
    def start_from(self, shape_m: Float32) -> None:
        """Make the untrained network answer with this shape: it becomes the bias of the coarse decoder's last layer.

        What the folding adds begins small, or its random bias would move everything by half a metre.

        Args:
            shape_m: float32 [coarse points, 3], unit of the input; from the centre of the input, z from the ground.
        """
        allowed = (self.coarse_points, 3)
        require(shape_m.shape == allowed, "start shape", shape_m.shape, str(allowed))
        self.coarse3.bias.copy_((torch.from_numpy(shape_m) / self.scale).flatten())
        self.coarse3.weight.mul_(0.1)
        self.fold3.weight.mul_(0.1)
        self.fold3.bias.zero_()

    def forward(self, points_m: Tensor, counts: Sequence[int], cells: Tensor | None = None) -> Completion:
        """See ``CompletionModel.forward``."""
        points, center, owner = self.to_units(points_m, counts)
        hidden, feature = self._encode(points, counts, owner)
        coarse = self._coarse(feature)
        base = self._shared(coarse, feature)
        if self.local:
            base = base + self._of_local(hidden[nearest_rows(coarse, points, counts)])
        fine = self._fold(coarse, base, cells)[0]
        return self._completion(coarse, fine, feature, center)

    def _completion(self, coarse: Tensor, fine: Tensor, feature: Tensor, center: Tensor) -> Completion:
        """Back in the unit of the input, with the classes."""
        logits = feature.new_zeros(len(feature), 0)
        if self.classes:
            logits = self.class2(functional.relu(self.class1(feature)))
        shift = center[:, None, :]
        return Completion(
            coarse * self.scale + shift, fine * self.scale + shift, logits.to(feature.dtype), center=center,
            feature=feature,
        )  # fmt: skip

    def _encode(self, points: Tensor, counts: Sequence[int], owner: Tensor) -> tuple[Tensor, Tensor]:
        """Hidden rows of the second PointNet layer [points, local[0]] and the global feature [b, local[1]]."""
        split = self.width.point[1]
        with exactly(points):
            lifted = functional.relu(self.point1(points))
        first = self.point2(lifted)
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
        with exactly(hidden):
            winners = hidden[torch.stack(rows)].to(self.local2.weight.dtype)
            return torch.einsum("bfh,fh->bf", winners, self.local2.weight) + self.local2.bias

    def _coarse(self, feature: Tensor) -> Tensor:
        """Coarse points [b, coarse points, 3], network units."""
        hidden = functional.relu(self.coarse2(functional.relu(self.coarse1(feature))))
        with exactly(feature):
            points: Tensor = self.coarse3(hidden.to(self.coarse3.weight.dtype))
        return points.view(-1, self.coarse_points, 3)

    def _shared(self, coarse: Tensor, feature: Tensor) -> Tensor:
        """Part of the folding's first layer that comes from coarse point and global feature: [b, coarse points, fold].

        Everything that does not differ per fine point is computed once.
        """
        weight, channels = self.fold1.weight, self.width.local[1]
        bias: Tensor = self.fold1.bias
        with exactly(coarse):
            if self.local:
                bias = bias + weight[:, 5 : 5 + channels] @ self.local2.bias
            shared = functional.linear(feature, weight[:, -channels:], bias)
            base: Tensor = functional.linear(coarse, weight[:, 2:5]) + shared[:, None, :]
        return base

    def _of_local(self, hidden: Tensor) -> Tensor:
        """Part of the local feature; it is linear in the hidden row, so both weights are multiplied first."""
        of_local = self.fold1.weight[:, 5 : 5 + self.width.local[1]]
        return functional.linear(hidden, of_local @ self.local2.weight)

    def _fold(self, coarse: Tensor, base: Tensor, cells: Tensor | None) -> tuple[Tensor, Tensor]:
        """Fine points [b, coarse points * k, 3], network units, and the folding's last hidden layer."""
        patch = self.patch if cells is None else self.patch[cells]
        of_patch = functional.linear(patch, self.fold1.weight[:, :2])
        first = functional.relu(base.to(of_patch.dtype)[:, :, None, :] + of_patch)
        last = functional.relu(self.fold2(first))
        fine: Tensor = coarse[:, :, None, :] + self.fold3(last)
        return fine.flatten(1, 2), last


@torch.no_grad()
def nearest_rows(queries: Tensor, points: Tensor, counts: Sequence[int]) -> Tensor:
    """Row in ``points`` of the own cloud's point nearest to each query: [b, q, 3], [n, 3] -> int64 [b, q]."""
    offset, rows = 0, []
    with exactly(points):
        for own, cloud in zip(queries, torch.split(points, list(counts)), strict=True):
            score = torch.addmm((cloud * cloud).sum(1), own, cloud.T, alpha=-2.0)
            rows.append(score.argmin(1) + offset)
            offset += len(cloud)
    return torch.stack(rows)
