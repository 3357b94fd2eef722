# SPDX-License-Identifier: Apache-2.0
"""Multi-head attention and the transformer block around it (Vaswani et al. 2017, normalisation first)."""

from __future__ import annotations

from itertools import pairwise

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
