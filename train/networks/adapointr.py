# SPDX-License-Identifier: Apache-2.0
"""A transformer in the manner of AdaPoinTr, written from the published description, for comparison.

Yu, Rao, Wang, Lu, Zhou: "AdaPoinTr: Diverse Point Cloud Completion with Adaptive Geometry-Aware Transformers", TPAMI
2023. Point proxies by local grouping, geometry-aware encoder, queries from the global feature and from the input of
which a learned score keeps the best, decoder, patches rebuilt by a perceptron, denoising queries in training. Here the
score also scales the query, which is how it learns; points that only repeat others are no neighbours in the grouping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from edge.config import require
from edge.frames import Float32
from train.network import FINE_POINTS, Completion, CompletionModel, Frame, exactly
from train.networks.attention import near_layers, perceptron
from train.networks.neighbours import farthest, fixed, most_of_groups, neighbours, take

GROUP, NEAR = 16, 8
"""Neighbours in the grouping and in the geometry-aware layers."""
DENOISED, JITTER = 64, 0.02
"""Noisy queries in training, and the standard deviation of their noise in network units."""


@dataclass(frozen=True, slots=True)
class TransformerWidth:
    """Sizes.

    Args:
        channels, heads: of the attention.
        encoder, decoder: blocks.
        points: of the input after repetition or thinning.
        proxies: points after the first and the second sampling of the grouping.
        queries: coarse points; the patches have 16384 / queries points.
        feature: channels of the global feature.
    """

    channels: int
    heads: int
    encoder: int
    decoder: int
    points: int
    proxies: tuple[int, int]
    queries: int
    feature: int


TRANSFORMER_WIDTHS = {
    "full": TransformerWidth(384, 6, 6, 8, 2048, (512, 256), 512, 1024),
    "small": TransformerWidth(96, 3, 2, 3, 1024, (256, 128), 256, 256),
    "tiny": TransformerWidth(16, 2, 1, 1, 128, (64, 32), 128, 32),
}


class _Edge(nn.Module):
    """Maximum over neighbours of a layer on [neighbour - own, own] features (Wang et al. 2019)."""

    def __init__(self, before: int, after: int, groups: int = 0) -> None:
        super().__init__()
        self.layer = nn.Linear(2 * before, after, bias=not groups)
        self.norm = nn.GroupNorm(groups, after) if groups else nn.Identity()
        self.activation = nn.LeakyReLU(0.2)

    def forward(self, own: Tensor, others: Tensor, index: Tensor) -> Tensor:
        """[b, q, c], [b, p, c], int64 [b, q, k] -> [b, q, c']."""
        near = take(others, index)
        mine = own[:, :, None].expand_as(near)
        value = self.layer(torch.cat([near - mine, mine], -1))
        value = self.activation(self.norm(value.flatten(1, 2).transpose(1, 2)).transpose(1, 2))
        return most_of_groups(value.reshape(*index.shape, value.shape[-1]))


def _edge(channels: int) -> _Edge:
    """The edge layer beside an attention."""
    return _Edge(channels, channels)


class _Grouper(nn.Module):
    """Point proxies: two samplings with edge convolutions between; 128 channels."""

    def __init__(self, proxies: tuple[int, int]) -> None:
        super().__init__()
        self.proxies = proxies
        self.lift = nn.Linear(3, 8)
        self.layers = nn.ModuleList([_Edge(8, 32, 4), _Edge(32, 64, 4), _Edge(64, 64, 4), _Edge(64, 128, 4)])

    def forward(self, points: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        """[b, n, 3], bool [b, n] -> positions [b, p, 3] and features [b, p, 128]."""
        with exactly(points):
            feature = self.lift(points)
        k = min(GROUP, *self.proxies)
        allowed = first[:, None, :]
        feature = self.layers[0](feature, feature, neighbours(points, points, k, allowed))
        for number, count in enumerate(self.proxies):
            rows = farthest(points, count)
            centers, own = take(points, rows), take(feature, rows)
            index = neighbours(centers, points, k, allowed if number == 0 else None)
            feature = self.layers[2 * number + 1](own, feature, index)
            points = centers
            if number == 0:
                feature = self.layers[2](feature, feature, neighbours(points, points, k))
        return points, feature


class AdaPoinTr(CompletionModel):
    """See the module.

    Args:
        width: sizes.
        frame: of the input.
    """

    coarse_loss = "chamfer"
    ramp = False

    def __init__(self, width: TransformerWidth, frame: Frame = "sight") -> None:
        super().__init__(frame, width.queries, FINE_POINTS // width.queries)
        self.width = width
        channels, heads, wide = width.channels, width.heads, width.feature
        self.grouper = _Grouper(width.proxies)
        self.place, self.proxy = perceptron(3, 128, channels), perceptron(128, 512, channels)
        self.encoder = near_layers(width.encoder, channels, heads, _edge)
        self.widen = perceptron(channels, wide, wide)
        self.coarse = perceptron(wide, wide, 3 * width.queries)
        self.score = perceptron(3, 256, 256, 1)
        self.query = perceptron(wide + 3, wide, wide, channels)
        self.decoder = near_layers(width.decoder, channels, heads, _edge, cross=True)
        self.reduce = nn.Linear(channels + wide + 3, channels)
        self.rebuild = perceptron(2 * channels, 512, 3 * self.cells)

    @torch.no_grad()
    def start_from(self, shape_m: Float32) -> None:
        """See ``CompletionModel.start_from``; the predicted queries start there."""
        allowed = (self.coarse_points, 3)
        require(shape_m.shape == allowed, "start shape", shape_m.shape, str(allowed))
        last = self.coarse[-1]
        assert isinstance(last, nn.Linear)
        last.bias.copy_((torch.from_numpy(shape_m) / self.scale).flatten())
        last.weight.mul_(0.1)

    def forward(self, points_m: Tensor, counts: Sequence[int], cells: Tensor | None = None) -> Completion:
        """See ``CompletionModel.forward``; while training also the denoised patches."""
        points, center, _ = self.to_units(points_m, counts)
        cloud, first = fixed(points, counts, self.width.points)
        places, proxies = self.grouper(cloud, first)
        memory = self._encode(places, proxies)
        feature = self.widen(memory).amax(1)
        queries, score = self._queries(feature, cloud)
        noisy = self._noisy(cloud) if self.training else None
        asked = queries if noisy is None else torch.cat([queries, noisy], 1)
        tokens = self.query(torch.cat([feature[:, None].expand(-1, asked.shape[1], -1), asked], -1))
        gate = score if noisy is None else torch.cat([score, torch.ones_like(noisy[..., :1])], 1)
        patches = asked[:, :, None] + self._decode(tokens * gate, asked, memory, places, feature)
        kept = patches[:, : self.coarse_points]
        kept = kept if cells is None else kept[:, :, cells]
        shift = center[:, None]
        result = Completion(
            queries * self.scale + shift, kept.flatten(1, 2) * self.scale + shift, feature.new_zeros(len(feature), 0),
            center=center, feature=feature,
        )  # fmt: skip
        if noisy is None:
            return result
        rebuilt = patches[:, self.coarse_points :] * self.scale + shift[:, None]
        return result._replace(denoised=(noisy * self.scale + shift, rebuilt))

    def _encode(self, places: Tensor, proxies: Tensor) -> Tensor:
        """Encoded proxies [b, p, channels]."""
        with exactly(places):
            where = self.place(places)
        tokens: Tensor = self.proxy(proxies) + where
        index = neighbours(places, places, NEAR)
        for layer in self.encoder:
            tokens = layer(tokens, index)
        return tokens

    def _queries(self, feature: Tensor, cloud: Tensor) -> tuple[Tensor, Tensor]:
        """The best of predicted and input points: positions [b, q, 3], network units, and their scores [b, q, 1]."""
        with exactly(feature):
            predicted = self.coarse(feature.float() if feature.dtype == torch.bfloat16 else feature)
            predicted = predicted.view(len(feature), self.coarse_points, 3)
            candidates = torch.cat([predicted, take(cloud, farthest(cloud, self.coarse_points // 2))], 1)
            score = torch.sigmoid(self.score(candidates))
        best = score[..., 0].topk(self.coarse_points, dim=1).indices
        return take(candidates, best), take(score, best)

    def _noisy(self, cloud: Tensor) -> Tensor:
        """Input points with noise, whose true surroundings the decoder must rebuild: [b, 64, 3]."""
        chosen = take(cloud, farthest(cloud, DENOISED))
        return chosen + JITTER * torch.randn_like(chosen)

    def _decode(self, tokens: Tensor, asked: Tensor, memory: Tensor, places: Tensor, feature: Tensor) -> Tensor:
        """Patches about the queries [b, q, cells, 3]; the true queries never see the noisy ones behind them."""
        true = torch.arange(asked.shape[1], device=asked.device) < self.coarse_points
        mask = true[None, :] | ~true[:, None]
        index = neighbours(asked, asked, NEAR, mask[None])
        of_memory = neighbours(asked, places, NEAR)
        for layer in self.decoder:
            tokens = layer(tokens, index, None if true.all() else mask, memory, of_memory)
        wide = torch.cat([feature[:, None].expand(-1, asked.shape[1], -1), tokens, asked], -1)
        reduced = self.reduce(wide)
        top = reduced[:, : self.coarse_points].amax(1, keepdim=True).expand_as(reduced)
        patches: Tensor = self.rebuild(torch.cat([top, reduced], -1))
        return patches.view(*asked.shape[:2], self.cells, 3)
