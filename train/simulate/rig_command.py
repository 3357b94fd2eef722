# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train rig``: start the virtual rig, say where its boards are, run until Ctrl-C."""

from __future__ import annotations

import argparse
import signal
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from edge.frames import Pose
    from edge.rig import Rig
    from train.simulate.faults import Faults
    from train.simulate.rig import VirtualRig, VirtualRigSettings
    from train.simulate.supplies import FrameSupply


def add_verb(verbs: Any) -> None:
    """Add the verb to ``rfconstruct-train``'s parser."""
    verb = verbs.add_parser(
        "rig",
        help="emulate the boards of a rig on loopback: what drives real radars can drive these",
        description="Emulates both radars of a rig and a pose sensor on this machine until Ctrl-C, and prints their "
        "addresses. Faults are set on the control socket, one line each (docs/simulation.md).",
    )
    verb.add_argument("name", help="rig: name or folder, for example cascade_pair or awr1843_pair")
    verb.add_argument("--object", metavar="REF", help="drive past this object, for example car/parametric_00012")
    verb.add_argument("--settings", type=Path, metavar="TOML", help="with --object: settings, instead of drawn ones")
    verb.add_argument("--poses", type=Path, metavar="FILE", help="with --object: write its reported poses as CSV too")
    verb.add_argument("--frames", type=int, help="make this many frames first and repeat them (point targets: 8)")
    verb.add_argument("--seed", type=int, default=0, help="of scene and faults")
    verb.add_argument("--pace", type=float, default=1.0, help="1: real time, 2: twice as fast, 0: as fast as it goes")
    verb.add_argument("--root", type=Path, help="folder of the capture boards' disks (default: a temporary one)")
    verb.add_argument("--links", type=Path, help="folder with links <radar> to the serial terminals")
    verb.add_argument("--real-ports", action="store_true", help="127.0.0.180 and .181, ports 5001, 4096, 4098")
    verb.add_argument("--control-port", type=int, default=0, help="of the control socket (default: any free one)")
    verb.add_argument("--quick", action="store_true", help="no delays of boards at configuration and start")
    verb.add_argument("--fault", action="append", default=[], metavar="RULE", help="'drop vertical/data share=0.01'")
    verb.add_argument("--seconds", type=float, help="end after this time instead of at Ctrl-C")
    verb.add_argument("--source", action="store_true", help="no boards: read the simulator source, say if it kept up")
    verb.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """The verb; returns the exit code."""
    from train.simulate.faults import Faults
    from train.simulate.rig import VirtualRig
    from train.simulate.rig_control import set_fault

    if not 0 <= options.pace < 1e6 or (options.frames is not None and options.frames < 1):
        raise ConfigError("rig", value=(options.pace, options.frames), allowed="--pace >= 0, --frames >= 1")
    faults = Faults(options.seed)
    for rule in options.fault:
        set_fault(faults, rule.split())
    loaded, supply, poses = _scene(options)
    if options.source:
        return _read_source(loaded, supply, poses, options, faults)
    with ExitStack() as stack:
        root = options.root or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rfconstruct-rig-")))
        stop = stack.enter_context(_interrupts())
        rig = stack.enter_context(VirtualRig(loaded, supply, root, poses, _settings(options), faults))
        for part, address in rig.addresses().items():
            print(f"{part:20s} {address}", flush=True)
        end_s = time.monotonic() + options.seconds if options.seconds else float("inf")
        while not stop.is_set() and time.monotonic() < end_s:
            stop.wait(min(1.0, max(0.0, end_s - time.monotonic())))
    _report(rig)
    return int(ExitCode.OK)


def _read_source(
    rig: Rig, supply: FrameSupply, poses: Iterable[Pose], options: argparse.Namespace, faults: Faults
) -> int:
    """Read the simulator source at its pace; say how many frames came, how many late, and what it cost."""
    from edge.frames import RadarFrame
    from train.simulate.simulator_source import SimulatorSource

    source = SimulatorSource(rig, supply, None, poses, pace=options.pace, faults=faults)
    frames, first_s, last_s, cpu_s = 0, 0.0, 0.0, 0.0
    with _interrupts() as stop:
        for item in source:
            if isinstance(item, RadarFrame):
                frames, last_s = frames + 1, time.monotonic()
                if frames == 1:
                    first_s, cpu_s = last_s, time.process_time()
                if stop.is_set() or last_s - first_s >= (options.seconds or float("inf")):
                    break
    load, taken_s = time.process_time() - cpu_s, max(last_s - first_s, 1e-9)
    source.close()
    print(f"{frames} frames, {(frames - 1) / taken_s:.1f} a second, {100 * load / taken_s:.0f} % of one core")
    print(f"late because they were not made in time: {source.late.total()}; asked for late: {source.slow_reads}")
    return int(ExitCode.DEGRADED if source.late else ExitCode.OK)


def _scene(options: argparse.Namespace) -> tuple[Rig, FrameSupply, Iterable[Pose]]:
    """Rig, frames and poses: a drive-by past an object, or point targets again and again."""
    from edge.rig import load_rig
    from train.simulate.supplies import rendered, straight_poses, targets

    if options.object is None:
        if options.settings or options.poses:
            raise ConfigError("rig --settings, --poses", allowed="with --object only")
        rig = load_rig(options.name)
        return rig, targets(rig, options.frames or 8, options.seed), straight_poses(rig)
    from train.objects.reference import ObjectRef
    from train.simulate.cloud import DriveSpec, make_drive
    from train.simulate.pose_stream import write_poses
    from train.simulate.settings import read_settings

    settings = read_settings(options.settings) if options.settings else None
    spec = DriveSpec(ObjectRef.from_text(options.object), options.seed, rig=options.name, every=1, settings=settings)
    drive = make_drive(spec, spec.object.mesh())
    if options.poses:
        write_poses(options.poses, drive.poses)
    supply = rendered(drive.rig, drive.frame, options.frames) if options.frames else drive.frame
    return drive.rig, supply, drive.poses


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
