# SPDX-License-Identifier: Apache-2.0
"""The naive form of the paper's network, against which speed is stated, computes the same."""

from __future__ import annotations

import numpy as np
import torch

from train.bench_completion import naive
from train.network import WIDTHS, CompletionNetwork


def test_naive_form_answers_as_the_split_one() -> None:
    torch.manual_seed(0)
    network = CompletionNetwork(WIDTHS["tiny"], 4).eval()
    points = torch.randn(200, 3) + torch.tensor([5.0, 1.0, 1.0])
    with torch.no_grad():
        np.testing.assert_allclose(naive(network, points), network(points, [200]).fine[0], atol=1e-4)
