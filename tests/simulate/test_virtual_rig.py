# SPDX-License-Identifier: Apache-2.0
"""The rig as a whole: both radar families driven by hand, faults on the control socket, poses that fit the frames."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import tda2_host as h
import zmq
from demo_terminal import Terminal, eventually
from tda2_host import ACK, SAFETY_S, Host

from edge.cli_text import cli_lines
from edge.errors import ConfigError
from edge.frames import RADARS, RadarFrame, RadarId
from edge.rig import Rig, load_rig
from edge.sources.ti_capture import CaptureFolder
from edge.waveform import Schedule
from train.cli import main
from train.simulate.demo_cli import DemoSettings
from train.simulate.faults import Faults
from train.simulate.rig import SceneClock, VirtualRig, VirtualRigSettings
from train.simulate.supplies import CyclicSupply, frame_time_ns, straight_poses, targets
from train.simulate.tda2_board import Tda2Settings

SAMPLES, LOOPS = 8, 2


def small(rig: Rig, **changes: Any) -> Rig:
    """The rig with a schedule that is quick to make and to send."""
    radars = {}
    for radar, board in rig.radars.items():
        profile = replace(board.schedule.profile, samples=changes.get("samples", SAMPLES))
        schedule = replace(board.schedule, profile=profile, loops=changes.get("loops", LOOPS))
        radars[radar] = replace(board, schedule=schedule)
    return replace(rig, radars=radars)


@pytest.fixture(scope="module")
def cascade() -> tuple[Rig, CyclicSupply]:
    rig = small(load_rig("cascade_pair"))
    return rig, targets(rig, count=3)


@pytest.fixture(scope="module")
def single() -> tuple[Rig, CyclicSupply]:
    rig = small(load_rig("awr1843_pair"), samples=182, loops=16)
    return rig, targets(rig, count=3)


def threads() -> set[str]:
    return {t.name for t in threading.enumerate() if t is not threading.current_thread()}


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Any]:
    rigs: list[VirtualRig] = []
    before = threads()

    def start(rig: Rig, supply: CyclicSupply, faults: Faults | None = None, **settings: Any) -> VirtualRig:
        demo = DemoSettings(start_s=0.0, restart_s=0.0, boot_s=0.0)
        chosen = VirtualRigSettings(demo=demo, **{"pace": 0.0, **settings})
        poses = islice(straight_poses(rig), 400)
        rigs.append(VirtualRig(rig, supply, tmp_path / "disks", poses, chosen, faults).start())
        return rigs[-1]

    yield start
    assert all([rig.stop() for rig in rigs])  # noqa: C419
    assert threads() <= before, "threads are left"


def capture(board_address: str, schedule: Schedule, frames: int, session: str) -> None:
    """Configure and record with one board, with register values of the rig's own schedule."""
    host_name, port = board_address.split(":")
    with Host((host_name, int(port))) as host:
        h.connect(host)
        for device in (1, 2, 4, 8):
            h.boot(host, device)
            h.configure(host, device, LOOPS, SAMPLES, frames, schedule.profile.registers.to_bytes())
            own = schedule.frame_registers(slave=device != 1, frames=frames).to_bytes()
            host.good(device, 1, 8, 0x0102, own)
            host.good(device, 5, 0x206, 0x40C0, struct.pack("<IHH", 12 * LOOPS, 2 * SAMPLES, 0))
        h.arm(host, LOOPS, SAMPLES, session, frames)
        for device in (8, 4, 2, 1):
            assert h.trigger(host, device, 1).refusal is None
            host.event(device, 0x100B)
        for device in (8, 4, 2, 1):
            host.event(device, 0x100F)
        assert host.order(0x32) == ACK


def read(rig: Rig, radar: RadarId, folder: Path) -> list[RadarFrame]:
    return [item for item in CaptureFolder(folder, rig, radar) if isinstance(item, RadarFrame)]


def test_cascade_pair_by_segments(started: Any, cascade: tuple[Rig, CyclicSupply], tmp_path: Path) -> None:
    rig, supply = cascade
    virtual = started(rig, supply)
    addresses = virtual.addresses()
    for radar in RADARS:
        schedule = rig.radars[radar].schedule
        for session in ("a", "b"):
            capture(addresses[f"{radar}.control"], schedule, 4, session)
        frames = [f for s in ("a", "b") for f in read(rig, radar, Path(addresses[f"{radar}.ssd"]) / s)]
        assert len(frames) == 8
        assert all(np.array_equal(f.adc, supply(radar, k).adc) for k, f in enumerate(frames))
    assert virtual.violations() == {"horizontal.control": [], "vertical.control": []}
    assert virtual.late() == {"horizontal": 0, "vertical": 0}


class CardHost:
    """Sockets of a host for one capture card."""

    def __init__(self, command_address: str) -> None:
        self.command, self.data = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for one in (self.command, self.data):
            one.bind(("127.0.0.1", 0))
            one.settimeout(SAFETY_S)
        self.data.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
        host, port = command_address.split(":")
        self.card = (host, int(port))

    def __enter__(self) -> CardHost:
        return self

    def __exit__(self, *_: object) -> None:
        self.command.close()
        self.data.close()

    def order(self, code: int, data: bytes = b"") -> None:
        """Send until it is answered: the card is deaf for a moment after its configuration."""
        packet = struct.pack("<3H", 0xA55A, code, len(data)) + data + b"\xaa\xee"
        self.command.settimeout(0.02)
        for _ in range(100):
            self.command.sendto(packet, self.card)
            try:
                got_code, status = struct.unpack_from("<2H", self.command.recv(64), 2)
            except TimeoutError:
                continue
            assert (got_code, status) == (code, 0)
            return
        raise AssertionError("the card never answered")

    def stream(self, nbytes: int) -> bytes:
        received = b""
        while len(received) < nbytes:
            packet = self.data.recv(4096)
            assert int.from_bytes(packet[4:10], "little") == len(received)
            received += packet[10:]
        return received


def test_single_chip_pair_streams(started: Any, single: tuple[Rig, CyclicSupply], tmp_path: Path) -> None:
    """Our own command lines configure both demos, and what arrives over UDP are the supply's samples."""
    rig, supply = single
    virtual = started(rig, supply, pace=1.0, links=tmp_path / "ports")
    addresses = virtual.addresses()
    with control(virtual) as ask, CardHost(addresses["horizontal.command"]) as a, CardHost(
        addresses["vertical.command"]
    ) as b:
        for radar, card in zip(RADARS, (a, b), strict=True):
            port = card.data.getsockname()[1]
            assert ask(f"target {radar} 127.0.0.1:{port}") == ["ok"]
            delay, configuration = bytes.fromhex("be0571020000"), bytes.fromhex("01020102031e")
            for code, data in ((6, b""), (9, b""), (0x0B, delay), (3, configuration)):
                card.order(code, data)
            card.order(9)
            card.order(5)
            terminal = Terminal(addresses[f"{radar}.cli"])
            assert b"*****" in terminal.until()
            for line in cli_lines(rig.radars[radar].schedule):
                assert terminal.ask(line.replace(" 16 0 16.667", " 16 3 16.667"))[-1] == "Done", line
            terminal.close()
            size = rig.radars[radar].schedule.layout.nbytes
            stream = card.stream(3 * size)
            frames = [stream[k * size : (k + 1) * size] for k in range(3)]
            start = next(n for n in range(3) if supply(radar, n).adc.tobytes() == frames[0])
            assert frames == [supply(radar, start + k).adc.tobytes() for k in range(3)]
            assert start == (virtual.radars[radar].next_number - 3) % 3, "by the clock of the scene"
    assert all(not texts for texts in virtual.violations().values()), virtual.violations()


class control:  # noqa: N801
    """One connection to the control socket, used as a function."""

    def __init__(self, virtual: VirtualRig) -> None:
        self.socket = socket.create_connection(virtual.control.address, timeout=SAFETY_S)
        self.file = self.socket.makefile("r")

    def __enter__(self) -> control:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()
        self.socket.close()

    def __call__(self, line: str) -> list[str]:
        self.socket.sendall(line.encode() + b"\n")
        got: list[str] = []
        while not got or not got[-1].startswith(("ok", "error")):
            got.append(self.file.readline().rstrip("\n"))
        return got


def test_faults_by_the_control_socket(started: Any, cascade: tuple[Rig, CyclicSupply]) -> None:
    rig, supply = cascade
    virtual = started(rig, supply)
    host, port = virtual.addresses()["vertical.control"].split(":")
    with control(virtual) as ask:
        assert ask("set nack vertical/control times=2 value=18") == ["ok"]
        assert ask("list") == ["nack vertical/control share=1 times=2 skip=0 value=18", "ok"]
        with Host((host, int(port))) as board:
            assert [board.order(0x12) for _ in range(3)] == [h.NACK, h.NACK, ACK]
            assert ask("struck") == ["nack vertical/control 2", "ok"]
            assert ask("unplug vertical") == ["ok"]
            with pytest.raises(ConnectionError):
                board.answer()
        assert ask("plug vertical") == ["ok"]
        eventually(lambda: virtual.boards["vertical"]._server._client is None)
        with Host((host, int(port))) as board:
            assert board.order(0x12) == ACK
        assert ask("violations")[0].startswith("vertical.control NACK")
        assert ask("clear nack") == ["1 removed", "ok"]
        assert ask("late") == ["horizontal 0", "vertical 0", "ok"]
        assert any(line.startswith("faults 127.0.0.1:") for line in ask("addresses"))
        assert ask("unplug pose") == ask("plug pose") == ask("pulse horizontal") == ["ok"]
        wrongs = ["", "melt", "set melt x", "set drop", "set drop x share=2", "set drop x y=1", "unplug", "plug camera"]
        for wrong in wrongs:
            assert ask(wrong)[-1].startswith("error"), wrong
        assert ask("target horizontal 127.0.0.1:1")[-1].startswith("error"), "a cascade has no card"
        ask.socket.sendall(b"x" * 2000)
        assert ask.file.readline() == "", "an endless line ends the connection"
    with control(virtual) as ask:
        assert ask("list") == ["ok"]


def test_scene_clock(cascade: tuple[Rig, CyclicSupply]) -> None:
    """Radar 2 half a period after radar 1 shows the same frame; after a pause both are where the scene is."""
    rig, _ = cascade
    period_s = rig.radars["horizontal"].schedule.frame_period_s
    clock = SceneClock(rig, pace=1.0)
    assert clock.first_number("horizontal") == 0
    for periods, vertical, horizontal in ((0.5, 0, None), (0.3, 0, None), (100.0, None, 100), (100.5, 100, None)):
        clock._start_ns = time.monotonic_ns() - round(periods * period_s * 1e9)
        if horizontal is not None:
            assert clock.first_number("horizontal") == horizontal
        if vertical is not None:
            assert clock.first_number("vertical") == vertical
    shift = clock.shift_ns(threading.Event())
    assert shift == clock._start_ns - frame_time_ns(rig, "horizontal", 0)
    stopped = threading.Event()
    stopped.set()
    assert SceneClock(rig, 1.0).shift_ns(stopped) is None


def test_poses_begin_with_the_frames(started: Any, cascade: tuple[Rig, CyclicSupply]) -> None:
    rig, supply = cascade
    virtual = started(rig, supply, pace=1.0, tda2=Tda2Settings(start_latency_s=0.0))
    addresses = virtual.addresses()
    with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
        subscriber.setsockopt(zmq.SUBSCRIBE, b"")
        subscriber.connect(addresses["pose"])
        assert not subscriber.poll(50), "nothing moves before frames begin"
        before_ns = time.monotonic_ns()
        capture(addresses["horizontal.control"], rig.radars["horizontal"].schedule, 4, "one")
        after_ns = time.monotonic_ns()
        assert subscriber.poll(round(SAFETY_S * 1000))
        pose = msgpack.unpackb(subscriber.recv_multipart()[1])["pose"]
        start_ns = pose["t_ns"] - round(pose["p"][0] / 0.5 * 1e9)  # by 0.5 m/s from the scene's beginning
        assert before_ns - 1e6 <= start_ns <= after_ns


def test_real_addresses(cascade: tuple[Rig, CyclicSupply], tmp_path: Path) -> None:
    rig, supply = cascade
    try:
        virtual = VirtualRig(rig, supply, tmp_path, settings=VirtualRigSettings(real_ports=True))
    except ConfigError as error:
        pytest.skip(f"ports are in use: {error}")
    with virtual:
        found = virtual.addresses()
        assert found["horizontal.control"] == "127.0.0.180:5001"
        assert found["vertical.control"] == "127.0.0.181:5001"


def test_address_in_use(cascade: tuple[Rig, CyclicSupply], tmp_path: Path) -> None:
    rig, supply = cascade
    with socket.create_server(("127.0.0.1", 0)) as taken:
        settings = VirtualRigSettings(tda2=Tda2Settings(port=taken.getsockname()[1]))
        with pytest.raises(ConfigError, match="cannot be used"):
            VirtualRig(rig, supply, tmp_path, settings=settings)


def test_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["rig", "awr1843_pair", "--frames", "1", "--quick", "--seconds", "0.2", "--root", str(tmp_path)]
    assert main([*words, "--fault", "drop vertical/data share=0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    parts = [line.split()[0] for line in lines]
    expected = ["command", "data", "cli"]
    assert parts == [f"{radar}.{part}" for radar in RADARS for part in expected] + ["pose", "faults"]
    assert main([*words, "--source", "--pace", "0"]) == 0
    assert capsys.readouterr().out.splitlines()[2].startswith("late because they were not made in time: 0")
    assert main(["rig", "no_such_rig"]) != 0
    assert main([*words, "--fault", "melt x"]) != 0
    assert "unknown fault" in capsys.readouterr().err
