# SPDX-License-Identifier: Apache-2.0
"""Commands to the emulated card: answers, time-outs, refusals, reports, and what is no answer."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import pytest
from card_rig import HOST

from edge.board_settings import CaptureCardBoard
from edge.drivers.dca1000.control import CaptureCard
from edge.drivers.dca1000.packets import Code, Status
from edge.errors import LinkError, RefusalError
from train.simulate.dca1000_board import Dca1000Board, Dca1000Settings
from train.simulate.faults import Faults

SAFETY_S = 30.0


class Bench:
    """Card, faults and command socket."""

    def __init__(self, **settings: Any) -> None:
        self.faults = Faults()
        chosen = Dca1000Settings(**{"deaf_s": 0.0, "data_target": (HOST, 9), "pace": 0.0, **settings})
        self.board = Dca1000Board("vertical", chosen, self.faults).start()
        port = self.board.address[1]
        self.card = CaptureCard(CaptureCardBoard("127.0.0.1", HOST, port), "vertical card")
        self.card.open()

    def close(self) -> None:
        self.card.close()
        assert self.board.stop()


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    made = Bench(**getattr(request, "param", {}))
    yield made
    made.close()


@pytest.mark.parametrize("bench", [{"deaf_s": 0.25}], indirect=True)
def test_configure_and_record(bench: Bench) -> None:
    """The card is deaf after its configuration; it is asked until it answers."""
    card, board = bench.card, bench.board
    card.request(Code.SYSTEM_ALIVE)
    assert card.version().text() == "2.8"
    card.configure(25e-6, 2)
    assert board.packet_delay_s == pytest.approx(25e-6)
    assert board.configuration is not None
    assert board.configuration.streams_raw
    card.record()
    assert board.recording
    card.stop()
    assert card.wait_status(Status.RECORD_COMPLETED, SAFETY_S)
    (report,) = card.poll()
    assert report.status is Status.RECORD_COMPLETED
    assert report.t_ns > 0
    assert card.counts[Status.RECORD_COMPLETED] == 1
    assert card.poll() == []
    assert board.violations == []


def test_lost_answers_are_asked_for_again(bench: Bench) -> None:
    bench.faults.set("drop", "vertical/command", times=3)
    bench.card.request(Code.SYSTEM_ALIVE)
    assert bench.board.log == [9, 9, 9, 9]


def test_silence_is_a_named_error(bench: Bench) -> None:
    bench.faults.set("drop", "vertical/command")
    with pytest.raises(LinkError, match="vertical card does not answer FPGA_VERSION") as caught:
        bench.card.request(Code.FPGA_VERSION, timeout_s=0.02)
    assert "4 times 5aa50e000000aaee to 127.0.0.1" in str(caught.value.value)
    assert "SW2" in caught.value.action


def test_refusal(bench: Bench) -> None:
    bench.faults.set("nack", "vertical/command", value=int(Code.CONFIGURE_FPGA))
    with pytest.raises(RefusalError, match="refuses CONFIGURE_FPGA") as caught:
        bench.card.configure(25e-6, 2)
    assert "5aa50300060001020102031eaaee, status 1" in str(caught.value.value)


def test_record_start_whose_answer_is_lost(bench: Bench) -> None:
    """The card records by then: the recording is ended and begun again, so that its bytes count from 0."""
    bench.card.configure(25e-6, 2)
    bench.faults.set("drop", "vertical/command", times=1)
    bench.card.record()
    assert bench.board.log[-3:] == [5, 6, 5]
    assert bench.board.recording
    assert bench.board.violations == []


def test_garbled_late_and_doubled_answers(bench: Bench) -> None:
    for kind, value in (("garble", 3.0), ("truncate", 2.0), ("duplicate", None), ("babble", 40.0)):
        bench.faults.set(kind, "vertical/command", times=1, value=value)
        bench.card.request(Code.SYSTEM_ALIVE)
        assert bench.card.version().text() == "2.8"
    bench.card.poll()
    assert bench.card.strangers >= 3


def test_answers_of_strangers_do_not_count(bench: Bench) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.3", 0))
        stranger.sendto(bytes.fromhex("5aa50a000001aaee"), (HOST, bench.board.address[1]))
        bench.card.request(Code.SYSTEM_ALIVE)
    assert bench.card.poll() == []
    assert bench.card.strangers == 1


@pytest.mark.parametrize("bench", [{"no_data_s": 0.01}], indirect=True)
def test_report_of_no_samples(bench: Bench) -> None:
    bench.card.configure(25e-6, 2)
    bench.card.record()
    assert bench.card.wait_status(Status.NO_LVDS_DATA, SAFETY_S)
    assert not bench.card.wait_status(Status.LVDS_BUFFER_FULL, 0.0)
    assert [report.status.text() for report in bench.card.poll()] == ["no lvds data"]


def test_addresses() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, 0))
        board = CaptureCardBoard("127.0.0.1", HOST, other.getsockname()[1])
        with pytest.raises(LinkError, match="another program has this port"):
            CaptureCard(board, "vertical card").open()
    with pytest.raises(LinkError, match="sudo ip address add"):
        CaptureCard(CaptureCardBoard(host_address="192.0.2.1"), "vertical card").open()
    closed = CaptureCard(CaptureCardBoard(), "vertical card")
    with pytest.raises(LinkError, match="not connected"):
        closed.stop()
    closed.close()
