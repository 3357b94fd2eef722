# SPDX-License-Identifier: Apache-2.0
"""What is measured: a simulated scene, our chain in every case of interest, the peers of each, and their accuracy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from edge.bench.array_peers import NumpyPeer, ScipyPeer, ScipyRankPeer
from edge.bench.package_peers import MmwcorePeer, OpenRadarPeer, OpenRadarRankPeer, XwrPeer
from edge.bench.peer import Peer, covered
from edge.config import CFAR_KINDS, CfarKind, CfarSettings, DopplerChoice, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import DependencyError
from edge.frames import RADARS, Detections, Float64, Heatmap, PointCloud, RadarFrame, RadarId
from edge.fusion.association import Associator
from edge.reference.point_targets import make_frame
from edge.rig import Rig
from edge.two_cores import TwoCores

REFLECTORS = 24
NOISE_LSB = 25.0
NEAR_M = 0.2
"""A point this close to a reflector counts as having found it."""
LOOPS = 8
PASSING_M_S = np.array([0.0, 3.0, 0.0])
PEERS_OF: dict[CfarKind, tuple[tuple[type[Peer], float | None], ...]] = {
    "ca": ((NumpyPeer, None), (ScipyPeer, 10.0), (MmwcorePeer, 20.0), (OpenRadarPeer, 50.0), (XwrPeer, None)),
    "os": ((ScipyRankPeer, None), (OpenRadarRankPeer, 500.0)),
}
"""Peers of the one-loop frame and how many times faster we want to be."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A peer in one case.

    Args:
        name: package and version.
        differences: what it computes otherwise.
        call: the same work as ours.
        covered, ours, detections: our detections that it has within one bin, all of ours, all of its; both radars
            together, -1 for a single stage.
        found, points: reflectors found and 3-D points made; -1 for a single stage.
        goal: how many times faster we want to be.
    """

    name: str
    differences: str
    call: Callable[[], object]
    covered: int = -1
    ours: int = -1
    detections: int = -1
    found: int = -1
    points: int = -1
    goal: float | None = None


@dataclass(frozen=True, slots=True)
class Case:
    """Something that is measured.

    Args:
        name: what.
        call: ours.
        goal_ms: what it should take on a core of the Sapphire Rapids class.
        found, points: reflectors found and 3-D points made; -1 for a single stage.
        peers: the competition.
        cores: used; more than one is timed by the wall clock.
    """

    name: str
    call: Callable[[], object]
    goal_ms: float | None = None
    found: int = -1
    points: int = -1
    peers: tuple[Contender, ...] = field(default_factory=tuple)
    cores: int = 1


class Scene:
    """Point reflectors seen by both radars of a rig.

    Args:
        rig: two cascades.
        loops: of every burst.
        velocity_m_s: of the rig.
    """

    def __init__(self, rig: Rig, loops: int, velocity_m_s: Float64 | None = None) -> None:
        radars = {r: replace(rig.radars[r], schedule=replace(rig.radars[r].schedule, loops=loops)) for r in RADARS}
        self.rig, self.velocity_m_s = replace(rig, radars=radars), velocity_m_s
        rng = np.random.default_rng(0)
        columns = (rng.uniform(2, 12, REFLECTORS), rng.uniform(-4, 4, REFLECTORS), rng.uniform(-0.7, 2, REFLECTORS))
        self.reflectors_m = np.c_[columns]
        amplitude = rng.uniform(20, 200, REFLECTORS)
        self.frames: dict[RadarId, RadarFrame] = {
            r: make_frame(radars[r], self.reflectors_m, amplitude, 0, 0, velocity_m_s, NOISE_LSB, rng) for r in RADARS
        }

    def settings(
        self, kind: CfarKind, doppler: DopplerChoice = "sum", elevation: bool = True
    ) -> tuple[HeatmapSettings, CfarSettings]:
        """The rig's with another detector, another use of loops, with or without the chirps of the elevation rows."""
        heatmap = replace(self.rig.settings.heatmap, doppler=doppler, read_elevation=elevation)
        return heatmap, replace(self.rig.settings.cfar, kind=kind)

    def found(self, cloud: PointCloud) -> int:
        """Reflectors with a point nearby."""
        away_m = np.linalg.norm(self.reflectors_m[:, None] - cloud.xyz_m, axis=-1)
        return int((away_m < NEAR_M).any(axis=1).sum()) if len(cloud) else 0


class Road:
    """Our chain: raw frames of both radars to associated points.

    Args:
        scene: rig, frames and velocity.
        kind, doppler, elevation: as ``Scene.settings`` takes them.
    """

    def __init__(self, scene: Scene, kind: CfarKind, doppler: DopplerChoice = "sum", elevation: bool = True) -> None:
        heatmap, cfar = scene.settings(kind, doppler, elevation)
        rig, self._frames, self._velocity_m_s = scene.rig, scene.frames, scene.velocity_m_s
        self.imagers = {r: Imager(rig.radars[r], heatmap, rig.settings.antenna) for r in RADARS}
        self.detectors = {r: Detector(rig.radars[r], cfar) for r in RADARS}
        self.associator = Associator(rig)
        self._calls = {r: partial(self.one, r) for r in RADARS}

    def one(self, radar: RadarId) -> Detections:
        """Detections of one radar."""
        return self.detectors[radar].process(self.imagers[radar].process(self._frames[radar], self._velocity_m_s))

    def __call__(self) -> PointCloud:
        """Points, in one thread."""
        return self.associator.process(self.one("horizontal"), self.one("vertical"), self._velocity_m_s)

    def threaded(self, cores: TwoCores) -> PointCloud:
        """Points, with a radar on each core."""
        horizontal, vertical = cores.both(self._calls["horizontal"], self._calls["vertical"])
        return self.associator.process(horizontal, vertical, self._velocity_m_s)  # type: ignore[arg-type]


def whole_frames(rig: Rig, cores: TwoCores, errors: dict[str, str]) -> list[Case]:
    """Two-radar frames, raw int16 to associated points, with their peers.

    Args:
        rig: two cascades.
        cores: for the case on two cores.
        errors: receives peer -> why it cannot be measured.
    """
    one, eight, moving = Scene(rig, 1), Scene(rig, LOOPS), Scene(rig, LOOPS, PASSING_M_S)
    road, kept = Road(one, "ca"), Road(eight, "ca", "fft")
    return [
        _case("one loop, CA", one, road, 0.5, _contenders(one, "ca", errors)),
        _case("one loop, CA, elevation rows not read", one, Road(one, "ca", elevation=False)),
        _case("one loop, OS", one, Road(one, "os"), 1.0, _contenders(one, "os", errors)),
        _case("8 loops summed, CA", eight, Road(eight, "ca"), 0.9, _contenders(eight, "ca", errors, (ScipyPeer,))),
        _case("8 loops steered at 3 m/s, CA", moving, Road(moving, "ca", "steer")),
        _case("8 loops, Doppler kept, CA", eight, kept, 4.0),
        _on_two_cores("one loop, CA, two cores", one, road, 0.35, cores),
        _on_two_cores("8 loops, Doppler kept, CA, two cores", eight, kept, None, cores),
    ]


def _on_two_cores(name: str, scene: Scene, road: Road, goal_ms: float | None, cores: TwoCores) -> Case:
    call = partial(road.threaded, cores)
    cloud = call()
    return Case(name, call, goal_ms, scene.found(cloud), len(cloud), cores=2)


def _case(name: str, scene: Scene, road: Road, goal_ms: float | None = None, peers: tuple[Contender, ...] = ()) -> Case:
    cloud = road()
    return Case(name, road, goal_ms, scene.found(cloud), len(cloud), peers)


def _contenders(
    scene: Scene, kind: CfarKind, errors: dict[str, str], only: tuple[type[Peer], ...] = ()
) -> tuple[Contender, ...]:
    """The peers of a detector that are installed."""
    heatmap, cfar = scene.settings(kind)
    ours = Road(scene, kind)
    maps: dict[RadarId, Heatmap] = {r: ours.imagers[r].process(scene.frames[r]) for r in RADARS}
    mine = {r: ours.one(r) for r in RADARS}
    made: list[Contender] = []
    for peer_class, goal in PEERS_OF[kind]:
        if only and peer_class not in only:
            continue
        try:
            peers = {r: peer_class(scene.rig.radars[r], heatmap, scene.rig.settings.antenna, cfar) for r in RADARS}
        except DependencyError as error:
            errors[peer_class.__name__.removesuffix("Peer")] = str(error)
            continue
        theirs = {r: peers[r].detect(scene.frames[r]) for r in RADARS}
        cloud = ours.associator.process(theirs["horizontal"], theirs["vertical"], None)
        contender = Contender(
            *(peers["horizontal"].name, peers["horizontal"].differences, _peer_call(scene, peers, ours.associator)),
            covered=sum(covered(maps[r], mine[r], theirs[r]) for r in RADARS),
            ours=sum(map(len, mine.values())),
            detections=sum(map(len, theirs.values())),
            found=scene.found(cloud),
            points=len(cloud),
            goal=None if only else goal,
        )
        made.append(contender)
    return tuple(made)


def _peer_call(scene: Scene, peers: dict[RadarId, Peer], associator: Associator) -> Callable[[], object]:
    def call() -> object:
        horizontal, vertical = (peers[r].detect(scene.frames[r]) for r in RADARS)
        return associator.process(horizontal, vertical, None)

    return call


STAGE_PEERS: tuple[tuple[type[NumpyPeer], CfarKind], ...] = (
    (NumpyPeer, "ca"),
    (ScipyPeer, "ca"),
    (ScipyRankPeer, "os"),
)


def stages(rig: Rig) -> list[Case]:
    """Single stages of one radar, one loop, beside those of NumPy and SciPy."""
    scene, radar = Scene(rig, 1), RADARS[0]
    board, frame = scene.rig.radars[radar], scene.frames[radar]
    road = Road(scene, "ca")
    imager, associator = road.imagers[radar], road.associator
    heatmap = imager.process(frame)
    heatmap = replace(heatmap, power=heatmap.power.copy())
    horizontal, vertical = (road.one(r) for r in RADARS)
    peers: dict[str, list[Contender]] = {}
    for peer_class, kind in STAGE_PEERS:
        settings = scene.settings(kind)
        try:
            peer = peer_class(board, settings[0], scene.rig.settings.antenna, settings[1])
        except DependencyError:
            continue
        if kind == "ca":
            peers.setdefault("heatmap", []).append(Contender(peer.name, "", partial(peer.image, frame)))
        finder = Contender(peer.name, "", partial(peer.cells, peer.image(frame)))
        peers.setdefault(_cfar_name(kind), []).append(finder)
    calls: dict[str, Callable[[], object]] = {"heatmap": partial(imager.process, frame)}
    for kind in CFAR_KINDS:
        calls[_cfar_name(kind)] = partial(Detector(board, scene.settings(kind)[1]).process, heatmap)
    calls["association"] = partial(associator.process, horizontal, vertical, None)
    return [Case(name, call, peers=tuple(peers.get(name, ()))) for name, call in calls.items()]


def _cfar_name(kind: CfarKind) -> str:
    return f"CFAR {kind.upper()} with peaks"
