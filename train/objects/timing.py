# SPDX-License-Identifier: Apache-2.0
"""CPU time of making, varying and perturbing objects, least of several rounds over the same seeds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from train.objects.deform import DeformSettings, vary
from train.objects.mesh import CLASSES
from train.objects.parametric import generate
from train.perturb import perturb
from train.perturb_settings import PerturbSettings

_SEEDS, _ROUNDS = 60, 3


def timings() -> Iterator[tuple[str, float]]:
    """(what, mean milliseconds of one), after a first call that compiles."""
    for name in CLASSES:
        yield f"parametric {name}", _mean_ms(lambda seed, name=name: generate(name, seed))  # type: ignore[misc]
    car = generate("car", 0)
    yield "variation of a car", _mean_ms(lambda seed: vary(car, DeformSettings(), np.random.default_rng(seed)))
    for order, settings in (("ours", PerturbSettings()), ("the paper's", PerturbSettings.paper())):
        yield (
            f"perturbed cloud of a car, {order}",
            _mean_ms(
                lambda seed, s=settings: perturb(car, s, np.random.default_rng(seed))  # type: ignore[misc]
            ),
        )


def _mean_ms(make: Callable[[int], object]) -> float:
    make(0)
    least = np.full(_SEEDS, np.inf)
    for _ in range(_ROUNDS):
        for seed in range(_SEEDS):
            start_s = time.thread_time()
            make(seed)
            least[seed] = min(least[seed], time.thread_time() - start_s)
    return 1e3 * float(least.mean())
