# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train rig``: start the virtual rig, say where its boards are, run until Ctrl-C."""

from __future__ import annotations

import argparse
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.errors import ConfigError, ExitCode
from train.output import on_a_screen

if TYPE_CHECKING:
    from edge.frames import Pose, RadarFrame
    from edge.rig import Rig
    from edge.sources.base import Loss
    from train.simulate.faults import Faults
    from train.simulate.rig import VirtualRig, VirtualRigSettings
    from train.simulate.supplies import FrameSupply


SCENES = ("street",)


def add_verb(verbs: Any) -> None:
    """Add the verb to ``rfconstruct-train``'s parser."""
    verb = verbs.add_parser(
        "rig",
        help="emulate the boards of a rig on loopback: what drives real radars can drive these",
        description="Emulates both radars of a rig and a pose sensor on this machine until Ctrl-C, and prints their "
        "addresses. Faults are set on the control socket, one line each (docs/simulation.md).",
    )
    on_a_screen(verb, "NAME")
    verb.add_argument("name", help="rig: name or folder, for example cascade_pair or awr1843_pair")
    verb.add_argument("--object", metavar="REF", help="drive past this object, for example car/parametric_00012")
    verb.add_argument("--settings", type=Path, metavar="TOML", help="with --object: settings, instead of drawn ones")
    verb.add_argument("--poses", type=Path, metavar="FILE", help="with --object: write its reported poses as CSV too")
    verb.add_argument("--scene", choices=SCENES, help="drive along it; street: car, motorcycle, cyclist, pedestrian")
    verb.add_argument("--frames", type=int, help="make this many frames first and repeat them (point targets: 8)")
    verb.add_argument("--seed", type=int, default=0, help="of scene and faults")
    verb.add_argument("--pace", type=float, default=1.0, help="1: real time, 2: twice as fast, 0: as fast as it goes")
    verb.add_argument("--root", type=Path, help="folder of the capture boards' disks (default: a temporary one)")
    verb.add_argument("--links", type=Path, help="folder with links <radar> to the serial terminals")
    verb.add_argument("--write-boards", type=Path, metavar="FILE", help="for rfconstruct run --boards FILE")
    verb.add_argument("--real-ports", action="store_true", help="127.0.0.180 and .181, ports 5001, 4096, 4098")
    verb.add_argument("--control-port", type=int, default=0, help="of the control socket (default: any free one)")
    verb.add_argument("--quick", action="store_true", help="no delays of boards at configuration and start")
    verb.add_argument("--fault", action="append", default=[], metavar="RULE", help="'drop vertical/data share=0.01'")
    verb.add_argument("--seconds", type=float, help="end after this time instead of at Ctrl-C")
    verb.add_argument("--source", action="store_true", help="no boards: read the simulator source, say if it kept up")
    verb.add_argument("--pipeline", action="store_true", help="with --source: the edge pipeline runs beside it")
    verb.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """The verb; returns the exit code."""
    from train.simulate.boards_file import data_targets, write_boards
    from train.simulate.faults import Faults
    from train.simulate.rig import VirtualRig
    from train.simulate.rig_control import set_fault

    if not 0 <= options.pace < 1e6 or (options.frames is not None and options.frames < 1):
        raise ConfigError("rig", value=(options.pace, options.frames), allowed="--pace >= 0, --frames >= 1")
    faults = Faults(options.seed)
    for rule in options.fault:
        set_fault(faults, rule.split())
    scene = _scene(options)
    if options.source:
        return _read_source(scene, options, faults)
    with ExitStack() as stack:
        root = options.root or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rfconstruct-rig-")))
        stop = stack.enter_context(_interrupts())
        settings = _settings(options)
        if options.write_boards is not None:
            settings = replace(settings, data_targets=data_targets(scene.rig))
        rig = stack.enter_context(VirtualRig(scene.rig, scene.supply, root, scene.poses, settings, faults))
        if options.write_boards is not None:
            write_boards(options.write_boards, rig)
        for part, address in rig.addresses().items():
            print(f"{part:20s} {address}", flush=True)
        end_s = time.monotonic() + options.seconds if options.seconds else float("inf")
        while not stop.is_set() and time.monotonic() < end_s:
            stop.wait(min(1.0, max(0.0, end_s - time.monotonic())))
    _report(rig)
    return int(ExitCode.OK)


def _read_source(scene: _Scene, options: argparse.Namespace, faults: Faults) -> int:
    """Read the simulator source at its pace; say how many frames came, how many late, and what it cost."""
    from edge.frames import RadarFrame
    from train.simulate.simulator_source import SimulatorSource

    rig = scene.rig
    source = SimulatorSource(rig, scene.supply, scene.frames, scene.poses, pace=options.pace, faults=faults)
    feed = _pipeline(rig) if options.pipeline else None
    counts, first_s, last_s, cpu_s = Counter[str](), 0.0, 0.0, 0.0
    with _interrupts() as stop:
        for item in source:
            if isinstance(item, RadarFrame):
                counts[item.radar], last_s = counts[item.radar] + 1, time.monotonic()
                if not first_s:
                    first_s, cpu_s = last_s, time.process_time()
            if feed is not None:
                feed(item)
            if stop.is_set() or last_s - first_s >= (options.seconds or float("inf")):
                break
    load, taken_s = time.process_time() - cpu_s, max(last_s - first_s, 1e-9)
    source.close()
    fewest, frames = min(counts.values(), default=0), counts.total()
    print(f"{frames} frames, {(frames - 1) / taken_s:.1f} a second, {100 * load / taken_s:.0f} % of one core")
    print(f"{(fewest - 1) / taken_s:.1f} of every radar a second")
    print(f"late because they were not made in time: {source.late.total()}; asked for late: {source.slow_reads}")
    return int(ExitCode.DEGRADED if source.late or source.slow_reads else ExitCode.OK)


def _pipeline(rig: Rig) -> Callable[[RadarFrame | Pose | Loss], None]:
    """The live road behind the source, in this thread; what it finds is printed, window by window."""
    from edge.pipeline import FrameResult, Pipeline, WindowResult

    class Print:
        """A sink that says what stands where."""

        def frame(self, result: FrameResult) -> None:
            """Nothing of single frames."""

        def window(self, result: WindowResult) -> None:
            """Number, travel and the objects' places."""
            places = ", ".join(
                f"({one.pose.position_m[0]:.1f}, {one.pose.position_m[1]:.1f})" for one in result.objects
            )
            print(f"window of {result.cloud.travel_m:.1f} m: objects at {places or 'no place'}", flush=True)

    return Pipeline(rig, None, [Print()]).feed


@dataclass(frozen=True, slots=True)
class _Scene:
    """What the boards see: rig with the calibrations of its boards, frames of both radars, poses.

    Args:
        frames: of each radar; None: endless.
    """

    rig: Rig
    supply: FrameSupply
    poses: Iterable[Pose]
    frames: int | None = None


def _scene(options: argparse.Namespace) -> _Scene:
    """A drive past an object or along a street, or point targets again and again."""
    from edge.rig import load_rig
    from train.simulate.supplies import rendered, straight_poses, targets

    if options.object is not None and options.scene is not None:
        raise ConfigError("rig", value=f"--object {options.object} --scene {options.scene}", allowed="one of them")
    if options.scene is not None:
        from train.simulate.street import make_street

        drive = make_street(load_rig(options.name), seed=options.seed).drive
    elif options.object is not None:
        from train.objects.reference import ObjectRef
        from train.simulate.cloud import DriveSpec, make_drive

        spec = DriveSpec(ObjectRef.from_text(options.object), options.seed, rig=options.name, every=1)
        drive = make_drive(spec, spec.object.mesh())
    else:
        rig = load_rig(options.name)
        return _Scene(rig, targets(rig, options.frames or 8, options.seed), straight_poses(rig))
    if options.frames:
        return _Scene(drive.rig, rendered(drive.rig, drive.frame, options.frames), drive.poses)
    return _Scene(drive.rig, drive.frame, drive.poses, drive.frames)


def _settings(options: argparse.Namespace) -> VirtualRigSettings:
    from train.simulate.cascade_chip import ChipDelays
    from train.simulate.rig import VirtualRigSettings
    from train.simulate.tda2_board import Tda2Settings

    settings = VirtualRigSettings(
        pace=options.pace, real_ports=options.real_ports, control_port=options.control_port, links=options.links
    )
    if options.quick:
        demo = replace(settings.demo, start_s=0.0, restart_s=0.0, boot_s=0.0)
        return replace(settings, demo=demo, card=replace(settings.card, deaf_s=0.0))
    return replace(settings, tda2=Tda2Settings(chip_delays=ChipDelays.real(), create_s=1.0, stop_s=0.5))


@contextmanager
def _interrupts() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set, in the main thread."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _report(rig: VirtualRig) -> None:
    """What the host did wrong and what the rig could not keep up with."""
    for part, texts in rig.violations().items():
        for text in texts:
            print(f"violation {part}: {text}")
    for radar, count in rig.late().items():
        if count:
            print(f"late {radar}: {count} bursts began more than half a period late")
    for (fault, where), count in sorted(rig.faults.struck.items()):
        if count:
            print(f"fault {fault} {where}: {count}")
