# SPDX-License-Identifier: Apache-2.0
"""Counts what steady frames allocate: in compiled kernels beyond the descriptors of their arguments, and in Python."""

from __future__ import annotations

import importlib
import pkgutil
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import _nrt_python, rtsys

import edge.dsp
import edge.fusion

PACKAGES = (edge.dsp, edge.fusion)
Run = Callable[[int], None]


def arrays_in(arguments: tuple[Any, ...]) -> int:
    """Arrays a call hands over; Numba allocates and frees one small descriptor for each."""
    return sum(arrays_in(a) if isinstance(a, tuple) else isinstance(a, np.ndarray) for a in arguments)


def check_kernels(run: Run, count: int, stages: Iterable[Any], patch: pytest.MonkeyPatch) -> Counter[str]:
    """Assert that ``count`` frames allocate nothing but descriptors, and free them; returns the arrays by kernel.

    Args:
        run: processes so many frames; every kernel must have been compiled.
        count: frames.
        stages: objects that may hold kernels, or parts that do.
        patch: puts counting kernels in the places of all others.
    """
    seen: Counter[str] = Counter()
    for owner in (*_modules(), *_owners(stages)):
        _count_calls(owner, patch, seen)
    _nrt_python.memsys_enable_stats()
    try:
        before = rtsys.get_allocation_stats()
        run(count)
        after = rtsys.get_allocation_stats()
    finally:
        _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == seen.total(), seen
    assert after.free - before.free == after.alloc - before.alloc
    return seen


def check_python(run: Run, count: int, most_kept: int, most_temporary: int) -> None:
    """Assert that ``count`` frames keep less than ``most_kept`` bytes and need less than ``most_temporary`` at once."""
    tracemalloc.start()
    try:
        run(5)
        start = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        run(count)
        end, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert end - start < most_kept
    assert peak - start < most_temporary


def _modules() -> Iterator[Any]:
    for package in PACKAGES:
        for entry in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
            yield importlib.import_module(entry.name)


def _owners(stages: Iterable[Any]) -> Iterator[Any]:
    names = tuple(package.__name__ for package in PACKAGES)
    for stage in stages:
        for part in (stage, *vars(stage).values()):
            if type(part).__module__.startswith(names) and hasattr(part, "__dict__"):
                yield part


def _count_calls(owner: Any, patch: pytest.MonkeyPatch, seen: Counter[str]) -> None:
    """Replace the compiled kernels that a module or stage holds by ones that count the arrays they are given."""

    def counting(kernel: Dispatcher) -> Callable[..., Any]:
        def counted(*arguments: Any) -> Any:
            seen[kernel.__name__] += arrays_in(arguments)
            return kernel(*arguments)

        return counted

    for name, value in list(vars(owner).items()):
        if isinstance(value, Dispatcher):
            patch.setattr(owner, name, counting(value))
        elif isinstance(value, list) and any(isinstance(entry, Dispatcher) for entry in value):
            patch.setattr(owner, name, [counting(entry) for entry in value])
