# SPDX-License-Identifier: Apache-2.0
"""The process pool: every item answered once, dying, raising and hanging workers included, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from edge.errors import ConfigError
from train.simulate.pool import Failure, LocalPool


def square(x: int) -> int:
    return x * x


def moody(folder: Path, x: int) -> int:
    """0 dies always, 1 dies once, 2 raises always, 3 raises once."""
    first = not (folder / str(x)).exists()
    (folder / str(x)).touch()
    if x == 0 or (x == 1 and first):
        os.kill(os.getpid(), signal.SIGKILL)
    if x == 2 or (x == 3 and first):
        raise ValueError(f"item {x}")
    return x


def stuck(x: int) -> int:
    time.sleep(0 if x else 3600)
    return x


def threads(_: int) -> str:
    return os.environ["OMP_NUM_THREADS"] + os.environ["NUMBA_NUM_THREADS"]


def test_every_item_once() -> None:
    assert sorted(LocalPool(2).run(square, range(9))) == [(x, x * x) for x in range(9)]


def test_no_items_and_more_workers_than_items() -> None:
    assert list(LocalPool(3).run(square, [])) == []
    assert list(LocalPool(3).run(square, [4])) == [(4, 16)]


def test_a_failing_item_gets_a_second_try_and_is_then_reported(tmp_path: Path) -> None:
    answers = dict(LocalPool(2).run(partial(moody, tmp_path), range(7)))
    assert answers[0] == Failure("its process died (signal SIGKILL)")
    assert answers[2] == Failure("ValueError: item 2")
    assert {x: answers[x] for x in (1, 3, 4, 5, 6)} == {x: x for x in (1, 3, 4, 5, 6)}


def test_an_item_that_hangs_is_stopped() -> None:
    answers = dict(LocalPool(1, limit_s=1.0).run(stuck, [1, 0, 2]))
    assert answers == {1: 1, 0: Failure("stopped after 1 s"), 2: 2}


def test_workers_have_one_thread_and_the_caller_keeps_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    assert [answer for _, answer in LocalPool(1).run(threads, [0])] == ["11"]
    assert os.environ["OMP_NUM_THREADS"] == "7"


def test_leaving_early_ends_the_workers() -> None:
    import multiprocessing

    run = LocalPool(2).run(stuck, [1, 0, 0])
    assert next(run) == (1, 1)
    run.close()
    assert multiprocessing.active_children() == []


def test_workers_end_with_a_caller_that_is_killed(tmp_path: Path) -> None:
    here = Path(__file__)
    script = (
        f"import sys; sys.path.insert(0, {str(here.parent)!r})\n"
        "from test_pool import pid\nfrom train.simulate.pool import LocalPool\n"
        "if __name__ == '__main__':\n"
        "    for item, answer in LocalPool(1).run(pid, range(10**9)):\n"
        "        print(answer, flush=True)\n"
    )
    path = tmp_path / "caller.py"
    path.write_text(script)
    with subprocess.Popen([sys.executable, str(path)], stdout=subprocess.PIPE, text=True) as caller:
        assert caller.stdout is not None
        worker = int(caller.stdout.readline())
        caller.kill()
    for _ in range(100):
        if not Path(f"/proc/{worker}").exists():
            return
        time.sleep(0.1)
    pytest.fail("the worker outlived its caller")


def test_workers_that_cannot_start_are_an_error_and_not_the_items_fault(tmp_path: Path) -> None:
    path = tmp_path / "script.py"
    path.write_text("from train.simulate.pool import LocalPool\nprint(list(LocalPool(2).run(abs, range(50))))\n")
    run = subprocess.run([sys.executable, str(path)], capture_output=True, text=True, timeout=60)
    assert run.returncode == 1
    assert "a worker process ended before it began to work" in run.stderr


def pid(_: int) -> int:
    return os.getpid()


@pytest.mark.parametrize("arguments", [{"workers": -1}, {"limit_s": 0.0}])
def test_numbers_outside_their_range(arguments: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        LocalPool(**arguments)  # type: ignore[arg-type]
