# SPDX-License-Identifier: Apache-2.0
"""Multi-head attention, the transformer block around it (Vaswani et al. 2017), and a layer that sees neighbours too."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional


class Attention(nn.Module):
    """Scaled dot-product attention.

    Args:
        channels: of queries, values and output; a multiple of ``heads``.
        heads: number of heads.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(channels, channels, bias=False)
        self.key_value = nn.Linear(channels, 2 * channels, bias=False)
        self.output = nn.Linear(channels, channels)

    def forward(self, queries: Tensor, memory: Tensor, mask: Tensor | None = None) -> Tensor:
        """[b, q, c] and [b, m, c] -> [b, q, c]; ``mask`` bool [q, m], True where a query may look."""
        batch, count, channels = queries.shape
        q = self._split(self.query(queries))
        key, value = (self._split(part) for part in self.key_value(memory).chunk(2, dim=-1))
        mixed = functional.scaled_dot_product_attention(q, key, value, mask)
        result: Tensor = self.output(mixed.transpose(1, 2).reshape(batch, count, channels))
        return result

    def _split(self, tokens: Tensor) -> Tensor:
        batch, count, channels = tokens.shape
        return tokens.reshape(batch, count, self.heads, channels // self.heads).transpose(1, 2)


class Block(nn.Module):
    """Self-attention, or attention to a memory, then a two-layer perceptron, each added to its input.

    Args:
        channels, heads: of the attention.
        ratio: hidden channels of the perceptron over ``channels``.
    """

    def __init__(self, channels: int, heads: int, ratio: int = 2) -> None:
        super().__init__()
        self.before, self.middle = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.attention = Attention(channels, heads)
        self.mlp = perceptron(channels, ratio * channels, channels)

    def forward(self, tokens: Tensor, memory: Tensor | None = None) -> Tensor:
        """[b, q, c] (and a memory [b, m, c]) -> [b, q, c]."""
        normal = self.before(tokens)
        tokens = tokens + self.attention(normal, normal if memory is None else self.before(memory))
        return tokens + self.mlp(self.middle(tokens))  # type: ignore[no-any-return]


def perceptron(*channels: int) -> nn.Sequential:
    """Linear layers with GELU between them."""
    layers: list[nn.Module] = []
    for before, after in pairwise(channels):
        layers += [nn.Linear(before, after), nn.GELU()]
    return nn.Sequential(*layers[:-1])


EdgeMaker = Callable[[int], nn.Module]
"""Channels -> a module (own [b, q, c], others [b, p, c], neighbours int64 [b, q, k]) -> [b, q, c]."""


class _Mixed(nn.Module):
    """Attention, and with ``edge`` a layer over spatial neighbours beside it, joined by a linear layer."""

    def __init__(self, channels: int, heads: int, edge: EdgeMaker | None) -> None:
        super().__init__()
        self.attention = Attention(channels, heads)
        self.edge = edge(channels) if edge else None
        self.join = nn.Linear(2 * channels, channels) if edge else None

    def forward(self, own: Tensor, others: Tensor, index: Tensor, mask: Tensor | None = None) -> Tensor:
        """[b, q, c], [b, p, c], int64 [b, q, k] -> [b, q, c]."""
        value: Tensor = self.attention(own, others, mask)
        if self.edge is None or self.join is None:
            return value
        joined: Tensor = self.join(torch.cat([value, self.edge(own, others, index)], -1))
        return joined


class NearLayer(nn.Module):
    """Self-attention, in a decoder cross-attention, then a perceptron; normalisation first (Yu et al. 2023).

    Args:
        channels, heads: of the attention.
        edge: makes the layer over spatial neighbours beside either attention; None: attention alone.
        cross: whether the tokens look at a memory too.
    """

    def __init__(self, channels: int, heads: int, edge: EdgeMaker | None, cross: bool = False) -> None:
        super().__init__()
        self.norms = nn.ModuleList([nn.LayerNorm(channels) for _ in range(4 if cross else 2)])
        self.own = _Mixed(channels, heads, edge)
        self.cross = _Mixed(channels, heads, edge) if cross else None
        self.mlp = perceptron(channels, 2 * channels, channels)

    def forward(
        self,
        tokens: Tensor,
        index: Tensor,
        mask: Tensor | None = None,
        memory: Tensor | None = None,
        of_memory: Tensor | None = None,
    ) -> Tensor:
        """Tokens [b, q, c] with their neighbours [b, q, k]; memory [b, m, c] with its own [b, q, k]."""
        normal = self.norms[0](tokens)
        tokens = tokens + self.own(normal, normal, index, mask)
        if self.cross is not None and memory is not None:
            tokens = tokens + self.cross(self.norms[2](tokens), self.norms[3](memory), of_memory)
        return tokens + self.mlp(self.norms[1](tokens))  # type: ignore[no-any-return]


def near_layers(count: int, channels: int, heads: int, edge: EdgeMaker, cross: bool = False) -> nn.ModuleList:
    """``count`` layers of which the first sees spatial neighbours beside its attention."""
    return nn.ModuleList([NearLayer(channels, heads, None if n else edge, cross) for n in range(count)])
