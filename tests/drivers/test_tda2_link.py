# SPDX-License-Identifier: Apache-2.0
"""Connection and chips against a scripted board: half, wrong, late, foreign answers; every wait ends, with a name."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from scripted_board import ScriptedBoard, ack, board, chip_message, interrupt, reading

from edge.drivers.tda2.chips import ChipAnswerError, ChipFaultError, Chips, CommandRefusedError
from edge.drivers.tda2.crc import crc16
from edge.drivers.tda2.link import AnswerTimeoutError, Link, LinkLostError
from edge.drivers.tda2.packets import BOARD, MASTER, SLAVE1, AckType, Opcode, Packet
from edge.drivers.tda2.rhcp import READ_REQUEST, Event
from edge.drivers.tda2.steps import Command
from edge.drivers.tda2.timeouts import TimeOuts
from edge.errors import ExitCode, LinkError, RefusalError

SHORT = TimeOuts(connect_s=0.2, spi_s=0.2, answer_s=0.2, after_request_s=0.0)
PATIENT = TimeOuts(connect_s=20.0, spi_s=20.0, answer_s=20.0, after_request_s=0.0)
PING = Packet(Opcode.PING, BOARD, AckType.RECEIVED)
PONG = board(Opcode.ACK, BOARD, answers=Opcode.PING)
VERSION = Command("version", 0x0220)
"""Message 0x11 to the radar sub-system."""
GOOD = chip_message(0x11, 0, ((0x0220, bytes(8)),))


@contextmanager
def linked(scripted: ScriptedBoard, timeouts: TimeOuts = PATIENT) -> Iterator[Link]:
    with scripted:
        link = Link("horizontal", "127.0.0.1", scripted.port, timeouts)
        link.open()
        try:
            yield link
        finally:
            link.close()


def ping(link: Link, timeout_s: float = 20.0) -> Packet:
    return link.order(PING, Opcode.ACK, timeout_s, "ping")


def test_answer_is_found_among_others() -> None:
    foreign = board(Opcode.ACK, BOARD, answers=Opcode.CONNECT) + board(Opcode.ACK, MASTER, answers=Opcode.PING)
    with linked(ScriptedBoard([lambda _: foreign + interrupt(MASTER) + board(0x8D, BOARD) + PONG])) as link:
        assert ping(link).ack_code == Opcode.PING
        assert link.strays == 3
        assert link.interrupt(MASTER, 0.0) is not None
        assert link.interrupt(SLAVE1, 0.0) is None


def test_late_answer_is_no_answer_to_the_next() -> None:
    """A second ACK that nobody waits for is passed over when the next order is sent."""
    with linked(ScriptedBoard([lambda _: PONG + PONG, ack])) as link:
        ping(link)
        assert link.order(Packet(Opcode.VERSION_GET, BOARD), Opcode.ACK, 20.0, "version").ack_code == 0x13
        assert link.strays == 1


def test_nack() -> None:
    with (
        linked(ScriptedBoard([lambda p: board(Opcode.NACK, p.device, answers=p.opcode)])) as link,
        pytest.raises(RefusalError, match=r"horizontal capture board.*NACK to ping \(PING, board\)") as error,
    ):
        ping(link)
    assert error.value.exit_code == ExitCode.NO_HARDWARE


@pytest.mark.parametrize(
    ("answer", "what"),
    [
        (b"\x0f\0\0\0" + PONG[4:], "garbage instead of a packet: a packet of 15 bytes"),
        (struct.pack("<I", 1 << 30), "garbage instead of a packet: a packet of 1073741824 bytes"),
        (PONG[:-1] + bytes([PONG[-1] ^ 1]), "garbage instead of a packet: CRC-16"),
        (PONG[:4] + b"\0\0" + PONG[6:], "garbage instead of a packet: sync word"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "garbage"),
    ],
)
def test_garbage(answer: bytes, what: str) -> None:
    with linked(ScriptedBoard([lambda _: answer])) as link:
        with pytest.raises(LinkLostError, match=what):
            ping(link)
        assert not link.is_open
        with pytest.raises(LinkLostError, match="no connection"):
            ping(link)


def test_nothing_comes() -> None:
    with (
        linked(ScriptedBoard([lambda _: b""]), SHORT) as link,
        pytest.raises(AnswerTimeoutError, match=r"did not answer ping \(PING, board\) within 0.1 s"),
    ):
        ping(link, 0.1)


def test_only_strays_come() -> None:
    stray = board(Opcode.ACK, MASTER, answers=Opcode.CONNECT)
    with (
        linked(ScriptedBoard([lambda _: stray]), SHORT) as link,
        pytest.raises(AnswerTimeoutError, match="last came ACK to CONNECT of master"),
    ):
        ping(link, 0.1)


def test_half_an_answer() -> None:
    with (
        linked(ScriptedBoard([lambda _: PONG[:7]]), SHORT) as link,
        pytest.raises(LinkLostError, match=r"only 7 bytes of a packet came within 0.1 s of ping"),
    ):
        ping(link, 0.1)


def test_connection_ends() -> None:
    with (
        linked(ScriptedBoard([lambda _: b""], hang_up=True)) as link,
        pytest.raises(LinkLostError, match=r"the board ended the connection; .*one host at a time"),
    ):
        ping(link)


def test_connection_ends_in_the_middle() -> None:
    with (
        linked(ScriptedBoard([lambda _: PONG[:9]], hang_up=True)) as link,
        pytest.raises(LinkLostError, match=r"in the middle of a packet .9 bytes of it came"),
    ):
        ping(link)


def test_nobody_there() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(LinkError, match=r"connection refused: vertical capture board at 127.0.0.1"):
        Link("vertical", "127.0.0.1", port, SHORT).open()
    with pytest.raises(LinkError, match=r"no such address|no way to"):
        Link("vertical", "no.such.host.invalid", 5001, SHORT).open()


def test_options_of_the_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[socket.socket] = []
    create = socket.create_connection
    monkeypatch.setattr(socket, "create_connection", lambda *a, **k: opened.append(create(*a, **k)) or opened[-1])
    with linked(ScriptedBoard([])):
        (connection,) = opened
        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        idle = [connection.getsockopt(socket.IPPROTO_TCP, getattr(socket, f"TCP_KEEP{n}")) for n in ("IDLE", "CNT")]
        assert idle == [10, 20]


# --- chips


def run(reactions: list, timeouts: TimeOuts = PATIENT) -> tuple[bytes, Chips, list[Packet]]:  # type: ignore[type-arg]
    """Version of the master with these reactions; its data, the chips, the orders that came."""
    scripted = ScriptedBoard(reactions)
    with linked(scripted, timeouts) as link:
        chips = Chips("horizontal", link, timeouts)
        data = chips.run((MASTER,), VERSION)[MASTER].data
    return data, chips, scripted.orders


def written(packet: Packet) -> bytes:
    """ACK of a message, and the chip's interrupt at once."""
    return ack(packet) + interrupt(packet.device)


def words(data: bytes) -> list:  # type: ignore[type-arg]
    """Reactions to reads of four bytes each."""
    parts = [data[k : k + 4] for k in range(0, len(data), 4)]
    return [lambda p, d=d: board(Opcode.SPI_DATA, p.device, d, Opcode.SPI_READ) for d in parts]


def test_command_and_answer() -> None:
    data, _, orders = run([written, *reading(GOOD)])
    assert data == bytes(8)
    assert [order.opcode for order in orders] == [0x23, 0x23, 0x24, 0x24, 0x24, 0x24]
    assert [order.ack_type for order in orders[:2]] == [AckType.RECEIVED, AckType.PROCESSED]
    assert orders[1].data == READ_REQUEST
    assert [order.data for order in orders[2:]] == [b"\4\0", b"\x0c\0", b"\x0c\0", b"\4\0"]


def test_interrupt_before_the_acknowledgement() -> None:
    assert run([lambda p: interrupt(p.device) + ack(p), *reading(GOOD)])[0] == bytes(8)


def test_answer_with_crc_16() -> None:
    """As chips do before they are told to use CRC-32."""
    body = bytearray(GOOD[:-4])
    words = list(struct.unpack_from("<5H", body))
    words[1] -= 2
    words[2] &= 0xF3FF
    body[:12] = struct.pack("<6H", *words, (~((s := sum(words)) + (s >> 16)) & 0xFFFF))
    crc = crc16(bytes(body)).to_bytes(2, "little")
    parts = [bytes.fromhex("badccdab"), bytes(body[:12]), bytes(body[12:]), crc]
    reads = [lambda p, d=d: board(Opcode.SPI_DATA, p.device, d, Opcode.SPI_READ) for d in parts]
    assert run([written, ack, *reads])[0] == bytes(8)


def test_doubled_interrupt() -> None:
    """The second finds nothing to read and is passed over."""
    *silence, last = words(b"\xff" * 4 * 32)
    data, chips, _ = run([written, ack, *silence, lambda p: last(p) + interrupt(p.device), *reading(GOOD)])
    assert (data, chips.spurious) == (bytes(8), 1)


@pytest.mark.parametrize("late", [1, 4, 6, 11])
def test_sync_word_that_comes_late(late: int) -> None:
    """A chip that is slow fills with FF; the message may begin between two words."""
    begin = b"\xff" * late + bytes.fromhex("badccdab")
    over = -len(begin) % 4
    head = words(begin + GOOD[:over])
    parts = (GOOD[over:12], GOOD[12:-4], GOOD[-4:])
    reads = [lambda p, d=d: board(Opcode.SPI_DATA, p.device, d, Opcode.SPI_READ) for d in parts]
    assert run([written, ack, *head, *reads])[0] == bytes(8)


def test_event_before_the_answer() -> None:
    event = chip_message(0x80, 0, ((int(Event.FRAME_ENDED), b"\1\2\3\4"),), kind=3)
    *read, last = reading(event)
    data, chips, _ = run([written, *read, lambda p: last(p) + interrupt(p.device), *reading(GOOD)])
    assert data == bytes(8)
    kept = chips.take(MASTER, Event.FRAME_ENDED)
    assert kept is not None
    assert kept.data == b"\1\2\3\4"
    assert chips.take(MASTER, Event.FRAME_ENDED) is None


def test_late_answer_of_a_command_before() -> None:
    *read, last = reading(chip_message(0x11, 15))
    assert run([written, *read, lambda p: last(p) + interrupt(p.device), *reading(GOOD)])[0] == bytes(8)


def test_nack_of_a_chip_is_repeated_with_the_next_number() -> None:
    nack = reading(chip_message(0x11, 0, kind=2))
    again = chip_message(0x11, 1, ((0x0220, bytes(8)),))
    data, chips, orders = run([written, *nack, written, *reading(again)])
    assert (data, chips.repeated) == (bytes(8), 1)
    sent = [order.data for order in orders if order.opcode == 0x23 and order.data != READ_REQUEST]
    assert [int.from_bytes(raw[8:10], "little") for raw in sent] == [0x0400, 0x1400]
    assert sent[0][16:-4] == sent[1][16:-4]


def test_three_nacks_of_a_chip() -> None:
    reactions = [r for k in range(3) for r in (written, *reading(chip_message(0x11, k, kind=2)))]
    with pytest.raises(RefusalError, match="master answered NACK to version 3 times"):
        run(reactions)


def test_refusal_of_a_chip() -> None:
    refused = chip_message(0, 0, ((0, struct.pack("<2H", 37, 0x0100)),))
    with pytest.raises(CommandRefusedError, match=r"master refused version: error 37 \(idle time\)") as error:
        run([written, *reading(refused)])
    assert error.value.code == 37


@pytest.mark.parametrize(
    ("message", "what"),
    [
        (GOOD[:2] + b"\x19" + GOOD[3:], "damaged message: header checksum"),
        (GOOD[:-1] + bytes([GOOD[-1] ^ 0x10]), "damaged message: CRC"),
        (chip_message(0x12, 0), "something else"),
    ],
)
def test_damaged_answers(message: bytes, what: str) -> None:
    with pytest.raises(ChipAnswerError, match=what):
        run([written, *reading(message)])


def test_no_sync_word() -> None:
    with pytest.raises(ChipAnswerError, match="no sync word"):
        run([written, ack, *words(bytes.fromhex("badccdac") * 32)])


def event_then(event: Event, data: bytes, *others: list) -> list:  # type: ignore[type-arg]
    """An event in the place of an answer, then others, each with its interrupt."""
    reactions = [written]
    messages = [chip_message(0x280, 0, ((int(event), data),), kind=3, direction=6), *others]
    for message in messages[:-1]:
        *read, last = reading(message)
        reactions += [*read, lambda p, last=last: last(p) + interrupt(p.device)]
    return reactions + reading(messages[-1])


def test_fault_of_a_running_chip() -> None:
    fault = chip_message(0x280, 0, ((int(Event.CPU_FAULT), bytes(32)),), kind=3, direction=6)
    with pytest.raises(ChipFaultError, match="master reports a CPU fault of the master sub-system"):
        run(event_then(Event.RADAR_POWERED_UP, bytes(32), fault))


@pytest.mark.parametrize("event", [Event.CPU_FAULT, Event.ESM_FAULT, Event.BOOT_STATUS])
def test_events_of_a_booting_chip(event: Event) -> None:
    """The boot status follows every firmware image; first silicon also reports faults each time."""
    data, chips, _ = run(event_then(event, b"\1" * 32, GOOD))
    assert data == bytes(8)
    assert chips.take(MASTER, event) is not None


def test_chip_stays_silent() -> None:
    with pytest.raises(AnswerTimeoutError, match=r"horizontal radar, master did not answer version within 0.2 s"):
        run([ack], SHORT)


def test_chip_that_never_stops_talking() -> None:
    """Events without end in the place of an answer end the wait all the same."""
    event = chip_message(0x80, 0, ((int(Event.FRAME_STARTED), bytes(4)),), kind=3)
    *read, last = reading(event)
    endless = [*read, lambda p: last(p) + interrupt(p.device)] * 5000
    with pytest.raises(AnswerTimeoutError, match="did not answer version"):
        run([written, *endless], SHORT)


def test_lost_interrupt_and_lost_data() -> None:
    with pytest.raises(AnswerTimeoutError, match="did not answer header"):
        run([written, *reading(GOOD)[:2]], SHORT)
    short = reading(GOOD)
    with pytest.raises(AnswerTimeoutError, match="did not answer header"):
        run([written, *short[:2], lambda p: board(Opcode.SPI_DATA, p.device, b"\0", Opcode.SPI_READ)], SHORT)


def test_event_that_never_comes() -> None:
    with linked(ScriptedBoard([]), SHORT) as link:
        chips = Chips("horizontal", link, SHORT)
        with pytest.raises(AnswerTimeoutError, match=r"slave1 did not report POWERED_UP \(0x5000\) within 0.1 s"):
            chips.event(SLAVE1, Event.POWERED_UP, 0.1)
