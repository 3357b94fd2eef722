# SPDX-License-Identifier: Apache-2.0
"""The paper's network, narrow, in the line-of-sight frame, with switches for what may make it better.

Every switch is off by default; with all off it is ``CompletionNetwork`` of the same width. None needs farthest-point
sampling or a loop over the data, and order and repetition of the input points never matter (with ``trim``, which counts
points, repetition nearly does not).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from edge.config import require
from train.network import COARSE_POINTS, Completion, CompletionNetwork, Frame, Width, exactly, nearest_rows
from train.networks.attention import Block

Mirror = Literal["none", "plane", "cue"]
Attend = Literal["none", "tokens", "coarse", "both"]
ANCHORS = 4
"""The input is probed at 4 x 4 x 4 places of its bounding box."""
LANDMARKS = 128
"""Coarse points that the others look at."""
GROUND_M, GROUND_WIDTH_M = 0.2, 0.05
HEADS = 4
ADDED = ("plane", "of_mirror", "of_evidence", "token_", "coarse_in", "coarse_block", "coarse_move", "sigma")
"""Beginnings of the names of layers that options add."""
POWER_DB = 10.0
"""Decibels of one unit of the power input."""


@dataclass(frozen=True, slots=True)
class NarrowOptions:
    """Switches.

    Args:
        mirror: "plane" estimates the vertical plane of symmetry (a loss, no other effect); "cue" also gives every
            coarse point the local feature of the input point nearest to its mirror image, and where both are.
        attention: "tokens": self-attention over 64 probes of the input before the coarse decoder; "coarse": every
            coarse point looks at 128 others and moves once more; "both".
        uncertainty: a logarithmic expected distance for every fine point.
        coarse: 1024 coarse points with 16 cells, or 512 with 32.
        power: relative power in dB as an input column.
        ground: nearness to the ground as an input.
        trim: percent of the points that do not count at each end of x and of y when the cloud is centred.
    """

    mirror: Mirror = "none"
    attention: Attend = "none"
    uncertainty: bool = False
    coarse: int = COARSE_POINTS
    power: bool = False
    ground: bool = False
    trim: int = 0

    def __post_init__(self) -> None:
        require(self.mirror in get_args(Mirror), "option mirror", self.mirror, ", ".join(get_args(Mirror)))
        require(self.attention in get_args(Attend), "option attention", self.attention, ", ".join(get_args(Attend)))
        require(self.coarse in (512, 1024), "option coarse", self.coarse, "512, 1024")
        require(0 <= self.trim < 50, "option trim", self.trim, "0..49 percent")


class NarrowNetwork(CompletionNetwork):
    """See the module.

    Args:
        width, classes, frame: as in ``CompletionNetwork``.
        options: switches.
    """

    anchors: Tensor

    def __init__(
        self, width: Width, classes: int, frame: Frame = "sight", options: NarrowOptions | None = None
    ) -> None:
        options = options or NarrowOptions()
        extra = int(options.power) + int(options.ground)
        super().__init__(width, classes, frame, coarse_points=options.coarse, extra=extra)
        require(not options.ground or frame == "sight", "option ground", frame, "frame sight: only there z is a height")
        require(not options.trim or frame == "sight", "option trim", frame, "frame sight: the box gives the centre")
        self.options = options
        self.columns = 4 if options.power else 3
        self.trim_percent = options.trim
        channels, hidden, fold = width.local[1], width.local[0], width.fold
        if options.mirror != "none":
            self.plane = nn.Linear(channels, 3)
        if options.mirror == "cue":
            self.of_mirror, self.of_evidence = nn.Linear(hidden, fold, bias=False), nn.Linear(6, fold, bias=False)
        if options.attention in ("tokens", "both"):
            self.token_hidden, self.token_place = nn.Linear(hidden, fold), nn.Linear(6, fold, bias=False)
            self.token_global = nn.Linear(channels, fold, bias=False)
            self.token_blocks = nn.ModuleList([Block(fold, HEADS), Block(fold, HEADS)])
            self.token_out = nn.Linear(fold, channels)
        if options.attention in ("coarse", "both"):
            self.coarse_in, self.coarse_block = nn.Linear(3, fold), Block(fold, HEADS)
            self.coarse_move = nn.Linear(fold, 3)
        if options.uncertainty:
            self.sigma = nn.Linear(fold, 1)
        axis = (torch.arange(ANCHORS) + 0.5) / ANCHORS
        self.register_buffer("anchors", torch.cartesian_prod(axis, axis, axis), persistent=False)
        self._start()

    @torch.no_grad()
    def _start(self) -> None:
        """What is added begins at no effect: the plane along the line of sight, attention with a zero last layer."""
        zero = [getattr(self, name) for name in ("plane", "token_out", "coarse_move") if hasattr(self, name)]
        for layer in zero:
            layer.weight.zero_()
            layer.bias.zero_()
        if self.options.mirror != "none":
            self.plane.bias[1] = 1
        if self.options.uncertainty:
            self.sigma.weight.zero_()
            self.sigma.bias.fill_(-5)

    @torch.no_grad()
    def begin_without(self, missing: Sequence[str]) -> bool:
        """See ``CompletionModel``: options that a network of this width was trained without."""
        if not all(name.split(".")[0].startswith(ADDED) for name in missing):
            return False
        for layer in (getattr(self, name, None) for name in ("of_mirror", "of_evidence")):
            if isinstance(layer, nn.Linear) and missing:
                layer.weight.zero_()
        return True

    def forward(self, points_m: Tensor, counts: Sequence[int], cells: Tensor | None = None) -> Completion:
        """See ``CompletionModel.forward``; with the power option a fourth column holds dB about the cloud's median."""
        options = self.options
        points, center, owner = self.to_units(points_m, counts)
        hidden, feature = self._encode(self._inputs(points, points_m), counts, owner)
        if options.attention in ("tokens", "both"):
            feature = feature + self._probe(points, hidden, feature, counts)
        coarse = self._coarse(feature)
        rows = nearest_rows(coarse, points, counts)
        local = self._of_local(hidden[rows])
        context = None
        if options.attention in ("coarse", "both"):
            context = self._look(coarse, local)
            with exactly(coarse):
                coarse = coarse + self.coarse_move(context.to(coarse.dtype))
        base = self._shared(coarse, feature) + local
        base = base if context is None else base + context
        plane = self._plane(feature) if options.mirror != "none" else None
        if plane is not None and options.mirror == "cue":
            base = base + self._cue(coarse, points, hidden, rows, counts, plane)
        fine, last = self._fold(coarse, base, cells)
        log_sigma = self.sigma(last).float().flatten(1) if options.uncertainty else None
        return self._completion(coarse, fine, feature, center)._replace(log_sigma=log_sigma, plane=plane)

    def _inputs(self, points: Tensor, points_m: Tensor) -> Tensor:
        """Coordinates in network units and what the options add."""
        columns = [points]
        if self.options.power:
            require(points_m.shape[1] == 4, "input columns", points_m.shape[1], "4: x, y, z, relative power in dB")
            columns.append(points_m[:, 3:4].to(points.dtype) / POWER_DB)
        if self.options.ground:
            columns.append(torch.sigmoid((GROUND_M - points[:, 2:] * self.scale) / GROUND_WIDTH_M))
        return torch.cat(columns, 1) if len(columns) > 1 else points

    def _probe(self, points: Tensor, hidden: Tensor, feature: Tensor, counts: Sequence[int]) -> Tensor:
        """Addition to the global feature [b, channels] from attention over the points nearest to 64 anchors."""
        with torch.no_grad():
            clouds = torch.split(points, list(counts))
            low, high = torch.stack([c.amin(0) for c in clouds]), torch.stack([c.amax(0) for c in clouds])
            places = low[:, None] + (high - low)[:, None] * self.anchors.to(points.dtype)
            rows = nearest_rows(places, points, counts)
            found = points[rows]
        with exactly(points):
            place = self.token_place(torch.cat([found, found - places], -1))
        tokens = self.token_hidden(hidden[rows]) + place + self.token_global(feature)[:, None]
        for block in self.token_blocks:
            tokens = block(tokens)
        added: Tensor = self.token_out(tokens.amax(1))
        return added.to(feature.dtype)

    def _look(self, coarse: Tensor, local: Tensor) -> Tensor:
        """Context of every coarse point from 128 of them: [b, coarse points, fold]."""
        with exactly(coarse):
            tokens = self.coarse_in(coarse)
        tokens = tokens + local
        context: Tensor = self.coarse_block(tokens, tokens[:, :: self.coarse_points // LANDMARKS])
        return context

    def _plane(self, feature: Tensor) -> Tensor:
        """Unit normal in the plane and offset along it, network units: [b, 3]."""
        with exactly(feature):
            raw = self.plane(feature)
            return torch.cat([functional.normalize(raw[:, :2], dim=1), raw[:, 2:]], 1)

    def _cue(
        self, coarse: Tensor, points: Tensor, hidden: Tensor, rows: Tensor, counts: Sequence[int], plane: Tensor
    ) -> Tensor:
        """What the input shows at a coarse point's mirror image, in its folding: [b, coarse points, fold]."""
        image = mirrored(coarse, plane)
        other = nearest_rows(image, points, counts)
        with exactly(coarse):
            back = mirrored(points[other], plane)
            evidence = self.of_evidence(torch.cat([points[rows] - coarse, back - coarse], -1))
        cue: Tensor = self.of_mirror(hidden[other]) + evidence
        return cue


def mirrored(points: Tensor, plane: Tensor) -> Tensor:
    """Mirror image of points [b, n, 3] about vertical planes [b, 3] (normal x, y; offset)."""
    normal = functional.pad(plane[:, :2], (0, 1))[:, None]
    distance = (points * normal).sum(-1, keepdim=True) - plane[:, None, 2:]
    return points - 2 * distance * normal
