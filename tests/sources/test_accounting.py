# SPDX-License-Identifier: Apache-2.0
"""The ledger: frames add up exactly, twice closed or negative is refused, threads do not lose counts."""

from __future__ import annotations

import json
import threading

import pytest

from edge.accounting import FrameLedger
from edge.errors import RfconstructError
from edge.frames import LossCause


def test_counts_by_cause() -> None:
    ledger = FrameLedger("horizontal")
    ledger.frame_in(5)
    ledger.ok(2)
    ledger.lost(LossCause.ALL_ZERO)
    ledger.lost(LossCause.NO_POSE)
    ledger.missing(LossCause.GAP, 3)
    before = ledger.snapshot()
    assert (before.frames_in, before.frames_ok, before.frames_lost, before.pending) == (8, 2, 5, 1)
    assert not ledger.balanced
    with pytest.raises(RfconstructError, match="1 unaccounted"):
        ledger.check()
    ledger.lost(LossCause.ALL_ZERO)
    ledger.check()
    after = ledger.snapshot()
    assert after.lost == {LossCause.ALL_ZERO: 2, LossCause.NO_POSE: 1, LossCause.GAP: 3}
    assert after.frames_in == after.frames_ok + sum(after.lost.values())
    assert before.frames_lost == 5, "a snapshot does not change"
    assert json.loads(json.dumps(after.as_dict()))["lost"] == {"all_zero": 2, "no_pose": 1, "gap": 3}


@pytest.mark.parametrize("close", [lambda x: x.ok(), lambda x: x.lost(LossCause.GAP)])
def test_a_frame_is_closed_only_once(close: object) -> None:
    ledger = FrameLedger("vertical")
    ledger.frame_in()
    close(ledger)  # type: ignore[operator]
    with pytest.raises(RfconstructError, match="twice"):
        close(ledger)  # type: ignore[operator]
    ledger.check()


@pytest.mark.parametrize("count", [0, -1])
def test_counts_are_positive(count: int) -> None:
    ledger = FrameLedger("vertical")
    for call in (ledger.frame_in, ledger.ok, lambda n: ledger.missing(LossCause.GAP, n)):
        with pytest.raises(RfconstructError, match="positive"):
            call(count)
    assert ledger.snapshot().frames_in == 0


def test_threads_lose_nothing() -> None:
    ledger = FrameLedger("horizontal")

    def work(cause: LossCause) -> None:
        for i in range(2000):
            ledger.frame_in()
            ledger.ok() if i % 2 else ledger.lost(cause)

    threads = [threading.Thread(target=work, args=(cause,)) for cause in list(LossCause)[:4]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    ledger.check()
    snapshot = ledger.snapshot()
    assert (snapshot.frames_in, snapshot.frames_ok) == (8000, 4000)
    assert set(snapshot.lost.values()) == {1000}
