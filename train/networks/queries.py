# SPDX-License-Identifier: Apache-2.0
"""A transformer for the edge: its queries are points of the input, their mirror images and predicted points.

After AdaPoinTr (Yu, Rao, Wang, Lu, Zhou, TPAMI 2023): proxies of local neighbourhoods, encoder, queries of which some
are predicted and some come from the input, decoder, patches rebuilt about the queries. Different: a sampling without a
loop (``sampling.spread``), one grouping instead of four, half of the queries always predicted and the other half chosen
among proxies and their images in the estimated plane of symmetry, by a learned score that knows the whole cloud;
classes, and an expected distance of every fine point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from edge.config import require
from edge.frames import Float32
from train.network import FINE_POINTS, Completion, CompletionModel, Frame, exactly
from train.networks.attention import near_layers, perceptron
from train.networks.narrow import mirrored
from train.networks.neighbours import most_of_groups, most_of_neighbours, neighbours, take
from train.networks.sampling import shuffled, spread

DENOISED_SHARE, JITTER = 8, 0.02
"""Queries for each noisy one in training, as published, and the standard deviation of its noise in network units."""


@dataclass(frozen=True, slots=True)
class QueryWidth:
    """Sizes.

    Args:
        channels, heads: of the attention.
        encoder, decoder: layers.
        points: of the input after repetition or thinning.
        proxies: points that stand for their neighbourhoods.
        group, near: neighbours of a proxy in the grouping, and in the layers that look at neighbours.
        local: channels of the grouping.
        queries: coarse points, the first half of them predicted; the patches have 16384 / queries points.
        feature: channels of the global feature.
        rebuild: hidden channels of the last perceptron.
    """

    channels: int
    heads: int
    encoder: int
    decoder: int
    points: int
    proxies: int
    group: int
    near: int
    local: tuple[int, int]
    queries: int
    feature: int
    rebuild: int


QUERY_WIDTHS = {
    "wide": QueryWidth(256, 8, 4, 6, 2048, 256, 32, 8, (128, 256), 512, 512, 512),
    "edge": QueryWidth(96, 3, 2, 3, 1024, 128, 32, 8, (64, 128), 256, 256, 512),
    "tiny": QueryWidth(16, 2, 1, 1, 128, 32, 8, 4, (16, 32), 64, 32, 64),
}


@dataclass(frozen=True, slots=True)
class QueryOptions:
    """Switches.

    Args:
        mirror: the images of the proxies in the estimated plane of symmetry may be queries too.
        denoise: noisy queries in training.
        trim: percent of the points that do not count at each end of x and of y when the cloud is centred.
    """

    mirror: bool = True
    denoise: bool = True
    trim: int = 0

    def __post_init__(self) -> None:
        require(0 <= self.trim < 50, "option trim", self.trim, "0..49 percent")


class _Edge(nn.Module):
    """Maximum over neighbours of a layer on [neighbour - own, own] features (Wang et al. 2019).

    The layer is linear before its activation, so every feature goes through it once, not once per neighbour.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.other, self.own = nn.Linear(channels, channels, bias=False), nn.Linear(channels, channels)

    def forward(self, own: Tensor, others: Tensor, index: Tensor) -> Tensor:
        """[b, q, c], [b, p, c], int64 [b, q, k] -> [b, q, c]."""
        most = most_of_neighbours(self.other(others), index)  # the activation rises, so the maximum may come before it
        return functional.leaky_relu(most + self.own(own), 0.2)


class QueryNetwork(CompletionModel):
    """See the module. Order and repetition of the input points hardly matter: they decide which of close points stay.

    Args:
        width: sizes.
        classes: number of classes.
        frame: of the input.
        options: switches.
    """

    coarse_loss = "chamfer"
    ramp = False

    def __init__(
        self, width: QueryWidth, classes: int, frame: Frame = "sight", options: QueryOptions | None = None
    ) -> None:
        super().__init__(frame, width.queries, FINE_POINTS // width.queries)
        options = options or QueryOptions()
        require(not options.trim or frame == "sight", "option trim", frame, "frame sight: the box gives the centre")
        self.width, self.options, self.classes, self.trim_percent = width, options, classes, options.trim
        channels, wide = width.channels, width.feature
        self.near_point, self.near_center = nn.Linear(3, width.local[0]), nn.Linear(3, width.local[0], bias=False)
        self.group = nn.Linear(*width.local)
        self.place, self.proxy = perceptron(3, 128, channels), perceptron(width.local[1], 2 * channels, channels)
        self.encoder = near_layers(width.encoder, channels, width.heads, _Edge)
        self.widen = perceptron(channels, wide, wide)
        self.predicted = width.queries // 2
        require(width.proxies >= width.queries - self.predicted, "proxies", width.proxies, ">= half of the queries")
        self.coarse = perceptron(wide, wide, 3 * self.predicted)
        self.score_place, self.score_feature = nn.Linear(6, wide, bias=False), nn.Linear(wide, wide)
        self.score = perceptron(wide, wide // 2, 1)
        self.query_place, self.query_feature = nn.Linear(6, wide, bias=False), nn.Linear(wide, wide)
        self.query = perceptron(wide, wide, channels)
        self.decoder = near_layers(width.decoder, channels, width.heads, _Edge, cross=True)
        self.reduce, self.reduce_feature = nn.Linear(channels + 3, channels), nn.Linear(wide, channels, bias=False)
        self.top = nn.Linear(channels, width.rebuild, bias=False)
        self.rebuild1, self.rebuild2 = nn.Linear(channels, width.rebuild), nn.Linear(width.rebuild, 3 * self.cells)
        self.sigma = nn.Linear(width.rebuild, self.cells)
        self.classifier = perceptron(wide, 64, classes)
        if options.mirror:
            self.plane = nn.Linear(wide, 3)
        self._start()

    @torch.no_grad()
    def _start(self) -> None:
        """The plane begins along the line of sight, the expected distance at a few centimetres."""
        for layer in (self.sigma, self.plane) if self.options.mirror else (self.sigma,):
            layer.weight.zero_()
            layer.bias.zero_()
        self.sigma.bias.fill_(-5)
        if self.options.mirror:
            self.plane.bias[1] = 1

    @torch.no_grad()
    def start_from(self, shape_m: Float32) -> None:
        """See ``CompletionModel.start_from``; the predicted queries start there."""
        allowed = (self.coarse_points, 3)
        require(shape_m.shape == allowed, "start shape", shape_m.shape, str(allowed))
        last = self.coarse[-1]
        assert isinstance(last, nn.Linear)
        some = torch.from_numpy(shape_m)[:: self.coarse_points // self.predicted]
        last.bias.copy_((some / self.scale).flatten())
        last.weight.mul_(0.1)

    def forward(self, points_m: Tensor, counts: Sequence[int], cells: Tensor | None = None) -> Completion:
        """See ``CompletionModel.forward``; while training also the denoised patches."""
        points, center, _ = self.to_units(points_m, counts)
        cloud, first = shuffled(points, counts, self.width.points)
        rows = spread(cloud, first, self.width.proxies)
        places, new = take(cloud, rows), first.gather(1, rows)
        memory = self._encode(cloud, first, places)
        feature = self.widen(memory).amax(1)
        plane = self._plane(feature) if self.options.mirror else None
        queries, score = self._queries(feature, places, new, plane)
        noisy = self._noisy(places) if self.training and self.options.denoise else None
        patches, log_sigma = self._decode(queries, score, noisy, memory, places, feature)
        count, shift = self.coarse_points, center[:, None]
        kept, expected = patches[:, :count], log_sigma[:, :count]
        if cells is not None:
            kept, expected = kept[:, :, cells], expected[:, :, cells]
        result = Completion(
            queries[..., :3] * self.scale + shift, kept.flatten(1, 2) * self.scale + shift, self.classifier(feature),
            expected.flatten(1).float(), plane, center, feature,
        )  # fmt: skip
        if noisy is None:
            return result
        rebuilt = patches[:, count:] * self.scale + shift[:, None]
        return result._replace(denoised=(noisy[..., :3] * self.scale + shift, rebuilt))

    def _encode(self, cloud: Tensor, first: Tensor, places: Tensor) -> Tensor:
        """Encoded proxies [b, p, channels]."""
        index = neighbours(places, cloud, self.width.group, first[:, None])
        with exactly(cloud):
            hidden = take(self.near_point(cloud), index) - self.near_center(places)[:, :, None]
            where = self.place(places)
        tokens: Tensor = self.proxy(functional.relu(most_of_groups(self.group(functional.relu(hidden))))) + where
        near = neighbours(places, places, self.width.near)
        for layer in self.encoder:
            tokens = layer(tokens, near)
        return tokens

    def _plane(self, feature: Tensor) -> Tensor:
        """Unit normal in the plane and offset along it, network units: [b, 3]."""
        with exactly(feature):
            raw = self.plane(_wide(feature))
            return torch.cat([functional.normalize(raw[:, :2], dim=1), raw[:, 2:]], 1)

    def _queries(self, feature: Tensor, places: Tensor, new: Tensor, plane: Tensor | None) -> tuple[Tensor, Tensor]:
        """Predicted queries and the best candidates: [b, q, 6], network units and what each is (one of three is 1).

        ``new`` is False for a place that repeats another: it is chosen last. Beside them their scores [b, q, 1], 1 for
        a predicted one; a score that is multiplied into its token is how the choice is learned.
        """
        with exactly(feature):
            wide = _wide(feature)
            predicted = self.coarse(wide).view(len(feature), self.predicted, 3)
            parts = [predicted, places] + ([] if plane is None else [mirrored(places, plane)])
            kinds = torch.eye(3, dtype=places.dtype, device=places.device)
            marked = [torch.cat([part, kind.expand_as(part)], -1) for part, kind in zip(parts, kinds, strict=False)]
            candidates = torch.cat(marked[1:], 1)
            hidden = functional.gelu(self.score_place(candidates) + self.score_feature(wide)[:, None])
            score = torch.sigmoid(self.score(hidden))
        last = -torch.arange(1, candidates.shape[1] + 1, dtype=score.dtype, device=score.device)
        rank = torch.where(new.repeat(1, len(marked) - 1), score[..., 0], last)
        best = rank.topk(self.coarse_points - self.predicted, dim=1).indices.sort(1).values
        given = torch.ones_like(predicted[..., :1])
        return torch.cat([marked[0], take(candidates, best)], 1), torch.cat([given, take(score, best)], 1)

    def _noisy(self, places: Tensor) -> Tensor:
        """Input points with noise, whose true surroundings the decoder must rebuild: [b, q / 8, 6]."""
        chosen = places[:, : self.width.queries // DENOISED_SHARE]
        kind = torch.tensor([0.0, 1.0, 0.0], dtype=places.dtype, device=places.device)
        return torch.cat([chosen + JITTER * torch.randn_like(chosen), kind.expand_as(chosen)], -1)

    def _decode(
        self, queries: Tensor, score: Tensor, noisy: Tensor | None, memory: Tensor, places: Tensor, feature: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Patches about the queries [b, q, cells, 3] and log sigma [b, q, cells]; true queries never see noisy ones."""
        asked, mask, true = queries, None, queries.shape[1]
        allowed = None
        if noisy is not None:
            asked = torch.cat([queries, noisy], 1)
            score = torch.cat([score, torch.ones_like(noisy[..., :1])], 1)
            real = torch.arange(asked.shape[1], device=asked.device) < true
            mask = real[None, :] | ~real[:, None]
            allowed = mask[None]
        with exactly(asked):
            hidden = functional.gelu(self.query_place(asked) + self.query_feature(_wide(feature))[:, None])
        tokens = self.query(hidden) * score
        index = neighbours(asked[..., :3], asked[..., :3], self.width.near, allowed)
        of_memory = neighbours(asked[..., :3], places, self.width.near)
        for layer in self.decoder:
            tokens = layer(tokens, index, mask, memory, of_memory)
        with exactly(asked):
            reduced = self.reduce(torch.cat([_wide(tokens), asked[..., :3]], -1))
        reduced = reduced + self.reduce_feature(feature)[:, None]
        top = self.top(reduced[:, :true].amax(1))
        last = functional.gelu(self.rebuild1(reduced) + top[:, None])
        patches = self.rebuild2(last).view(*asked.shape[:2], self.cells, 3)
        return asked[:, :, None, :3] + patches, self.sigma(last)


def _wide(values: Tensor) -> Tensor:
    """bfloat16 as float32, anything else as it is."""
    return values.float() if values.dtype == torch.bfloat16 else values
