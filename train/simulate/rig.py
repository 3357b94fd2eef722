# SPDX-License-Identifier: Apache-2.0
"""The virtual rig: emulated boards for the radars of a rig, pose sensor and control socket, started and stopped as one.

A cascade becomes a capture board on TCP; a single-chip radar becomes a demo on a pseudo-terminal and a capture card on
UDP. Whatever drives real boards can drive these; ``addresses`` says where they are.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType

from edge.errors import ConfigError
from edge.frames import RADARS, Pose, RadarId
from edge.rig import Rig
from train.simulate.dca1000_board import COMMAND_PORT, Dca1000Board, Dca1000Settings
from train.simulate.demo_cli import DemoRadar, DemoSettings
from train.simulate.faults import Faults
from train.simulate.pose_stream import PoseStream, PoseStreamSettings
from train.simulate.rig_control import RigControl
from train.simulate.supplies import DEPTH, FrameSupply, PreparedSupply, frame_time_ns
from train.simulate.tda2_board import Tda2Board, Tda2Settings

_POLL_S = 0.1
REAL_HOSTS: Mapping[RadarId, str] = {"horizontal": "127.0.0.180", "vertical": "127.0.0.181"}
"""Loopback stands for the boards' network: last number as on real boards."""
TDA2_PORT = 5001


@dataclass(frozen=True, slots=True)
class VirtualRigSettings:
    """How the boards of a virtual rig behave.

    Args:
        tda2, card, demo, poses: of the single parts; their pace, addresses and links are set from here.
        pace: of frames and poses, 1: real time, 0: as fast as they go.
        real_ports: boards at 127.0.0.180 and .181 with their real port numbers; False: free ports of 127.0.0.1.
        control_port: of the control socket, 0: any free one.
        data_targets: where each card sends its samples; absent: port 4098 of whoever commands it.
        links: folder in which ``<radar>`` leads to that radar's terminal; None: none.
        depth: frames of a radar made ahead.
        scene_clock: frames show the scene as it is at their time, also after a pause between two captures; False:
            each capture goes on where the one before ended. Never with pace 0.
    """

    tda2: Tda2Settings = field(default_factory=Tda2Settings)
    card: Dca1000Settings = field(default_factory=Dca1000Settings)
    demo: DemoSettings = field(default_factory=DemoSettings)
    poses: PoseStreamSettings = field(default_factory=PoseStreamSettings)
    pace: float = 1.0
    real_ports: bool = False
    control_port: int = 0
    data_targets: Mapping[RadarId, tuple[str, int]] = field(default_factory=dict)
    links: Path | None = None
    depth: int = DEPTH
    scene_clock: bool = True


class SceneClock:
    """Time of the scene: it begins when the first radar's frames begin.

    Args:
        rig: radars and their periods.
        pace: of the scene.
    """

    def __init__(self, rig: Rig, pace: float) -> None:
        self._rig, self._pace, self._begun = rig, pace, threading.Event()
        self._lock, self._start_ns, self._scene_ns = threading.Lock(), 0, 0

    def first_number(self, radar: RadarId) -> int:
        """Number of the frame of a radar whose frames begin now."""
        now_ns = time.monotonic_ns()
        with self._lock:
            if not self._begun.is_set():
                self._start_ns, self._scene_ns = now_ns, frame_time_ns(self._rig, radar, 0)
                self._begun.set()
            scene_ns = self._scene_ns + (now_ns - self._start_ns) * self._pace
        period_ns = self._rig.radars[radar].schedule.frame_period_s_actual * 1e9
        return max(0, round((scene_ns - frame_time_ns(self._rig, radar, 0)) / period_ns))

    def shift_ns(self, stop: threading.Event) -> int | None:
        """What is added to times of the scene to get CLOCK_MONOTONIC; waits for the scene; None: stopped before."""
        while not self._begun.wait(_POLL_S):
            if stop.is_set():
                return None
        return self._start_ns - self._scene_ns


class VirtualRig:
    """All boards of a rig.

    Args:
        rig: radars; the layout of the frames.
        supply: makes the frames; called by one thread at a time.
        root: folder below which each capture board's disk lies, ``root/<radar>`` for its /mnt/ssd.
        poses: in order of time, in the time of the frames; sent from when frames begin. None: no pose sensor.
        settings: behaviour.
        faults: rules that may change while it runs.
    Attributes:
        boards: capture boards of cascades.
        cards, radars: capture cards and single-chip radars.
        pose_stream: None: the rig has no pose sensor.
        control: control socket.
    Raises:
        ConfigError: an address that cannot be used.
    """

    def __init__(
        self,
        rig: Rig,
        supply: FrameSupply,
        root: Path,
        poses: Iterable[Pose] | None = None,
        settings: VirtualRigSettings | None = None,
        faults: Faults | None = None,
    ) -> None:
        self.rig, self.settings, self.root = rig, settings or VirtualRigSettings(), root
        self.faults = Faults() if faults is None else faults
        s = self.settings
        self._supply = PreparedSupply(supply, s.depth)
        self._clock = SceneClock(rig, s.pace)
        self.boards: dict[RadarId, Tda2Board] = {}
        self.cards: dict[RadarId, Dca1000Board] = {}
        self.radars: dict[RadarId, DemoRadar] = {}
        self.pose_stream: PoseStream | None = None
        self._control: RigControl | None = None
        try:
            self.control = self._control = RigControl(self, s.control_port)
            for radar, board in rig.radars.items():
                if board.schedule.is_cascade:
                    self._add_cascade(radar)
                else:
                    self._add_single(radar, board.schedule.profile.device)
            if poses is not None:
                self.pose_stream = PoseStream(poses, replace(s.poses, pace=s.pace), self.faults)
        except OSError as error:
            self.stop()
            action = "leave the ports free (0), or end what uses them"
            raise ConfigError(f"an address of the virtual rig cannot be used ({error})", action=action) from error
        except ConfigError:
            self.stop()
            raise

    def start(self) -> VirtualRig:
        """Power on."""
        for radar in self.rig.radars:
            self._supply.prepare(radar, 0)
        parts: list[Tda2Board | Dca1000Board | DemoRadar] = [*self.boards.values(), *self.cards.values()]
        for part in [*parts, *self.radars.values()]:
            part.start()
        if self.pose_stream is not None:
            self.pose_stream.start(self._clock.shift_ns if self._by_clock else None)
        self.control.start()
        return self

    def stop(self) -> bool:
        """Power off for good; whether every thread ended in time."""
        ended = [self._supply.close()]
        if self._control is not None:
            ended.append(self._control.stop())
        parts: list[Tda2Board | Dca1000Board | DemoRadar] = [*self.boards.values(), *self.radars.values()]
        ended += [part.stop() for part in [*parts, *self.cards.values()]]
        if self.pose_stream is not None:
            ended.append(self.pose_stream.stop())
        return all(ended)

    def __enter__(self) -> VirtualRig:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def addresses(self) -> dict[str, str]:
        """Part -> where it is."""
        found: dict[str, str] = {}
        for radar in self.rig.radars:
            if radar in self.boards:
                found[f"{radar}.control"] = _text(self.boards[radar].address)
                found[f"{radar}.ssd"] = str(self.boards[radar].recorder.root)
            else:
                card = self.cards[radar]
                found[f"{radar}.command"] = _text(card.address)
                found[f"{radar}.data"] = _text(card.data_target) if card.data_target else "port 4098 of the commander"
                found[f"{radar}.cli"] = str(self.radars[radar].settings.link or self.radars[radar].port)
        if self.pose_stream is not None:
            found["pose"] = self.pose_stream.address
        found["faults"] = _text(self.control.address)
        return found

    def violations(self) -> dict[str, list[str]]:
        """Part -> what the host did wrong."""
        return {
            **{f"{radar}.control": list(board.violations) for radar, board in self.boards.items()},
            **{f"{radar}.command": list(card.violations) for radar, card in self.cards.items()},
            **{f"{radar}.cli": list(demo.firmware.violations) for radar, demo in self.radars.items()},
        }

    def unplug(self, part: str, silent: bool = False) -> None:
        """Cut the power of a radar (all its boards) or of "pose". ConfigError: no such part."""
        self._require(part)
        for radar in RADARS:
            if radar == part and radar in self.boards:
                self.boards[radar].unplug(silent)
            elif radar == part:
                self.cards[radar].unplug()
                self.radars[radar].unplug()
        if part == "pose" and self.pose_stream is not None:
            self.pose_stream.unplug()

    def plug(self, part: str) -> None:
        """Power again. ConfigError: no such part."""
        self._require(part)
        for radar in RADARS:
            if radar == part and radar in self.boards:
                self.boards[radar].plug()
            elif radar == part:
                self.cards[radar].plug()
                self.radars[radar].plug()
        if part == "pose" and self.pose_stream is not None:
            self.pose_stream.plug()

    def pulse(self, part: str) -> None:
        """A trigger pulse to a radar. ConfigError: no such radar."""
        self._require(part)
        for radar in RADARS:
            if radar == part:
                (self.boards[radar] if radar in self.boards else self.radars[radar]).pulse()

    def late(self) -> dict[RadarId, int]:
        """Radar -> bursts that began late because frames were made or sent too slowly."""
        parts: dict[RadarId, Tda2Board | DemoRadar] = {**self.boards, **self.radars}
        return {radar: part.late for radar, part in parts.items()}

    @property
    def _by_clock(self) -> bool:
        return self.settings.scene_clock and self.settings.pace > 0

    def _host(self, radar: RadarId) -> str:
        return REAL_HOSTS[radar] if self.settings.real_ports else "127.0.0.1"

    def _add_cascade(self, radar: RadarId) -> None:
        s = self.settings
        port = TDA2_PORT if s.real_ports else s.tda2.port
        own = replace(s.tda2, host=self._host(radar), port=port, pace=s.pace)
        board = Tda2Board(radar, self._supply, self.root / radar, own, self.faults)
        if self._by_clock:
            board.first_number = lambda: self._clock.first_number(radar)
        self.boards[radar] = board

    def _add_single(self, radar: RadarId, device: str) -> None:
        s = self.settings
        port = COMMAND_PORT if s.real_ports else s.card.command_port
        target = s.data_targets.get(radar, s.card.data_target)
        own = replace(s.card, host=self._host(radar), command_port=port, data_target=target, pace=s.pace)
        card = Dca1000Board(
            radar, own, self.faults, lambda: self.radars[radar].reset(), lambda: self.radars[radar].streaming
        )
        link = s.links / radar if s.links is not None else s.demo.link
        demo = DemoRadar(
            radar, self._supply, card.lvds, replace(s.demo, device=device, link=link, pace=s.pace), self.faults
        )
        if self._by_clock:
            demo.first_number = lambda: self._clock.first_number(radar)
        self.cards[radar], self.radars[radar] = card, demo

    def _require(self, part: str) -> None:
        known = [*self.rig.radars, *(["pose"] if self.pose_stream is not None else [])]
        if part not in known:
            raise ConfigError("the virtual rig has no such part", value=part, allowed=", ".join(known))


def _text(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"
