# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train street``: a simulated drive past a street, live through the whole road, and the truth."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.errors import ExitCode, RfconstructError

if TYPE_CHECKING:
    from edge.commands.session import Session
    from edge.frames import Pose, RadarFrame
    from edge.sources.base import Loss
    from train.simulate.simulator_source import SimulatorSource
    from train.simulate.street import Street, StreetSettings
    from train.simulate.street_files import RoadPictures
    from train.simulate.street_report import Finding, ShapeLog
    from train.simulate.street_stream import ResultsRecording, Viewer

RIG = "cascade_pair"
LENGTH_M = 20.0
"""2.2 m between two road users: objects nearer to one another become one (``objects.neighbour_m``)."""
DEPTH = 64
"""Frames and poses made ahead, half a second: a machine that does something else meanwhile costs no frame."""
AHEAD_SHARE = 0.25
"""Of the free memory at most for frames that are made ahead, where the simulator is slower than the radars."""
TRIED_FRAMES = 6
BESIDE_PIPELINE = 0.6
"""Speed of the simulator while the pipeline runs, as a share of what it has alone (2 cores: 0.6 to 0.8)."""
SWITCH_S = 0.0005
"""The simulator shares the interpreter with the pipeline here: stages must not wait 5 ms for it (Python's default)."""
LAST_POSES_NS = 100_000_000
"""Poses go on for so long after the last frame, whose velocity they give."""
PAGE = "http://127.0.0.1:8080"
"""Of ``rfconstruct view``."""
KEPT_PACE = 0.98
"""Below this share of real time a note says so."""
MOST_LOST = 0.01
"""Share of the frames beyond which the exit code is 3."""


def add_verb(verbs: Any) -> None:
    """Add the verb to ``rfconstruct-train``'s parser."""
    from edge.commands import arguments

    verb = verbs.add_parser(
        "street",
        help="the showcase: drive past car, motorcycle, cyclist and pedestrian, live, and compare with the truth",
        description="Simulates both radars of a rig that drives along a street, 60 raw frames of each a second, and "
        "runs the live pipeline on them: shapes are published while it drives. At the end: account, latencies, and "
        "every object beside the true surface; pictures, PLY files and a recording of the results.",
    )
    verb.add_argument("--rig", default=RIG, help="two radars that look to the left (default: %(default)s)")
    verb.add_argument("--seconds", type=arguments.seconds, help="end the drive after this time (whole: 13 s)")
    verb.add_argument("--seed", type=int, default=0, help="of places, headings, noise, odometry")
    verb.add_argument("--pace", type=float, default=1.0, help="1: real time; 0: as fast as it goes, nothing is dropped")
    verb.add_argument("--out", type=Path, default=Path("out/run"), help="folder of the files (default: %(default)s)")
    verb.add_argument("--no-plot", action="store_true", help="no pictures")
    verb.add_argument("--view", action="store_true", help="the viewer's page beside it, until Ctrl-C (extra 'view')")
    verb.add_argument("--endpoint", action="append", metavar="ADDRESS", help="publish there instead of the rig's")
    verb.add_argument("--no-publish", action="store_true", help="publish and record nothing")
    verb.add_argument("--json", action="store_true", help="machine-readable output on stdout")
    verb.set_defaults(run=run)


def run(options: argparse.Namespace, settings: StreetSettings | None = None) -> int:
    """The verb; returns the exit code: 3 when there was no shape or more than 1 % of the frames were lost.

    Ctrl-C and SIGTERM end the drive in order: account printed, exit code 130 or 143.

    Args:
        options: of the verb.
        settings: another street.
    """
    from edge.errors import ConfigError

    if not 0 <= options.pace < 1e6:
        raise ConfigError("street", value=f"--pace {options.pace:g}", allowed="0 or more")
    _make_folder(options.out)
    try:
        return _drive(options, settings)
    except KeyboardInterrupt:
        print("rfconstruct-train street: interrupted", file=sys.stderr)
        return 130


def _drive(options: argparse.Namespace, settings: StreetSettings | None) -> int:
    """Kernels, drive, closing table, files."""
    from train.simulate.warm import is_cold, warm_both

    start_s = time.monotonic()
    if is_cold():
        _say(options, "first start: kernels are being compiled")
        _say(options, f"compiled in {warm_both(options.rig):.0f} s")
    drive = _Drive.make(options, settings)
    with ExitStack() as stack:
        viewer = drive.play(options, stack)
        drive.note_pace(options.pace)
        findings = drive.findings()
        files = _files(options, drive, findings)
        elapsed_s = time.monotonic() - start_s
        if options.json:
            print(json.dumps(drive.as_dict(findings, files, elapsed_s), indent=2))
        _say(options, "\n".join(drive.lines(findings, files, elapsed_s)))
        if viewer is not None and viewer.running and not drive.session.stopped():
            _keep(viewer, drive.session)
    return drive.exit_code()


@dataclass(slots=True)
class _Drive:
    """The street, the source, the live pipeline and what came out.

    Args:
        shift_ns: by which the source's instants are later than the street's.
        wall_s: when the first and the last frame came.
        cpu_s: processor time of this process then.
        recording: of the results; None: there is none. results: writes it.
    """

    street: Street
    source: SimulatorSource
    session: Session
    log: ShapeLog
    pictures: RoadPictures | None
    shift_ns: int = 0
    wall_s: tuple[float, float] = (0.0, 0.0)
    cpu_s: tuple[float, float] = (0.0, 0.0)
    recording: Path | None = None
    results: ResultsRecording | None = None
    notes: list[str] = field(default_factory=list)

    @staticmethod
    def make(options: argparse.Namespace, settings: StreetSettings | None) -> _Drive:
        """Everything but the first frame."""
        from edge.commands.session import Session
        from edge.rig import load_rig
        from train.simulate.simulator_source import SimulatorSource
        from train.simulate.street import StreetSettings, make_street
        from train.simulate.street_files import RoadPictures, remove_old
        from train.simulate.street_report import ShapeLog

        street = make_street(load_rig(options.rig), settings or StreetSettings(length_m=LENGTH_M), options.seed)
        drive, log = street.drive, ShapeLog()
        frames = drive.frames
        if options.seconds is not None:
            frames = max(1, min(frames, round(frames * options.seconds / drive.seconds(drive.span_ns[1]))))
        last_ns = max(drive.t_first_chirp_ns(radar, frames - 1) for radar in drive.rig.radars)
        poses = [pose for pose in drive.poses if pose.t_ns <= last_ns + LAST_POSES_NS]
        pace = options.pace
        source = SimulatorSource(drive.rig, drive.frame, frames, poses, pace=pace, depth=DEPTH, rebase=True)
        quiet = argparse.Namespace(**{**vars(options), "plot": None, "speed": 0.0})
        title = f"simulated street, rig {drive.rig.name}, seed {options.seed}"
        notes = ["simulated radar data; the odometry has errors too"]
        session = Session(drive.rig, quiet, "sim", title, notes, live=True, patient=pace == 0.0)
        remove_old(options.out)
        session.pipeline.sinks.append(log)
        pictures = None
        if not options.no_plot:
            pictures = RoadPictures(options.out, title, drive.rig.settings.association.fov_deg)
            session.pipeline.sinks.append(pictures)
        users = ", ".join(str(user.ref) for user in street.users)
        session.say(f"street: {users}; rig {drive.rig.name}, {frames} frames of each radar")
        return _Drive(street, source, session, log, pictures)

    def play(self, options: argparse.Namespace, stack: ExitStack) -> Viewer | None:
        """Drive along; the viewer that was asked for ends with ``stack``."""
        from edge.stream.client import DEFAULT_ENDPOINT
        from train.simulate.street_stream import ResultsRecording, Viewer

        endpoint = (options.endpoint or self.session.rig.settings.stream.endpoints)[0]
        viewer = None
        if options.view and not options.no_publish:
            viewer = Viewer(endpoint, options.json)
            stack.callback(viewer.close)
        elif not options.no_publish:
            where = "" if endpoint == DEFAULT_ENDPOINT else f" --endpoint {endpoint}"
            self.session.say(f"viewer: {_program()} view{where}, in another terminal; page: {PAGE}")
        if options.no_publish:
            self._run()
            return None
        with ResultsRecording(endpoint, options.out / "street.mcap") as recording:
            self.results = recording
            self._run()
        self.recording = recording.path
        if recording.failure:
            self.notes.append(f"the recording is not whole: {recording.failure}")
        if viewer is not None and viewer.failure():
            self.notes.append(f"the viewer ended: {viewer.failure()}")
        return viewer

    def note_pace(self, pace: float) -> None:
        """Say when the simulator was slower than ``pace``, so that the pipeline had time; or the pipeline too slow."""
        from train.simulate.street_report import busy_note

        seconds = 0.0 if self.log.t_ns is None else self.street.drive.seconds(self.log.t_ns - self.shift_ns)
        taken_s = self.wall_s[1] - self.wall_s[0]
        if pace > 0 and 1.0 < seconds < KEPT_PACE * pace * taken_s:
            self.notes.append(
                f"NOT IN REAL TIME: {seconds:.1f} s of the drive took {taken_s:.1f} s, because the simulator had too "
                "little of this machine (other work on it? --rig cascade_demo needs a third)"
            )
        accounts = [ledger.snapshot() for ledger in self.session.pipeline.ledgers.values()]
        self.notes += [note] if (note := busy_note(accounts, MOST_LOST)) else []

    def _run(self) -> None:
        switch_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            self.session.run(self._items(), self.source.total_frames, self._warm_up)
        finally:
            sys.setswitchinterval(switch_s)
            self.source.close()

    def _warm_up(self) -> None:
        """The simulator's kernels compile before its clock begins."""
        start_s, drive = time.monotonic(), self.street.drive
        for radar in drive.rig.radars:
            drive.frame(radar, 0)
        self.session.say(f"simulator ready after {time.monotonic() - start_s:.1f} s")
        if self.source.pace > 0:
            self._make_ahead()
        if self.results is not None:
            self.results.begin()

    def _make_ahead(self) -> None:
        """As many frames before the clock begins as the simulator will be behind at the end of the drive."""
        drive, frames = self.street.drive, (self.source.total_frames or 0) // 2
        start_s = time.monotonic()
        tried = range(0, frames, max(1, frames // TRIED_FRAMES))
        for number in tried:
            for radar in drive.rig.radars:
                drive.frame(radar, number)
        pair_s = (time.monotonic() - start_s) / len(tried)
        period_s = max(radar.schedule.frame_period_s for radar in drive.rig.radars.values()) / self.source.pace
        pair_bytes = sum(radar.schedule.frame_bytes for radar in drive.rig.radars.values())
        ahead = pairs_ahead(frames, pair_s, period_s, int(AHEAD_SHARE * free_bytes() / pair_bytes))
        poses_per_pair = len(drive.poses) / drive.frames
        self.source.depth = max(DEPTH, round(ahead * (2 + poses_per_pair)))
        pace = f"{1e3 * pair_s:.0f} ms a pair of frames"
        self.session.say(f"simulator: {pace}, {ahead} pairs are made before the clock starts")
        self.source.make_ahead(self.session.stopped)

    def _items(self) -> Iterator[RadarFrame | Pose | Loss]:
        """What the source gives; the first item, a pose, tells by how much its clock is later."""
        poses = iter(self.street.drive.poses[:1])
        for item in self.source:
            now_s, cpu_s = time.monotonic(), time.process_time()
            for first in poses:
                self.shift_ns = getattr(item, "t_ns", first.t_ns) - first.t_ns
            if hasattr(item, "adc"):
                self.wall_s, self.cpu_s = (self.wall_s[0] or now_s, now_s), (self.cpu_s[0] or cpu_s, cpu_s)
            yield item

    @property
    def x_m(self) -> float:
        """How far along the street the last frame was."""
        if self.log.t_ns is None:
            return 0.0
        return float(self.street.drive.true_pose(self.log.t_ns - self.shift_ns).position_m[0])

    def findings(self) -> list[Finding]:
        """Every object beside the truth."""
        from train.simulate.street_report import find

        return find(self.street, self.log, self.shift_ns)

    def lines(self, findings: list[Finding], files: list[Path], elapsed_s: float) -> list[str]:
        """The closing table."""
        from edge.commands.report import account_lines, stage_lines
        from train.simulate.street_report import lines

        pipeline = self.session.pipeline
        text = ["", *account_lines(pipeline), self._pace()]
        text += ["", *stage_lines(pipeline), "", *lines(self.street, findings, self.x_m), ""]
        text += [f"note: {note}" for note in (*self.session.notes, *self.notes)]
        text += [f"picture: {path}" for path in files if path.suffix == ".png"]
        clouds = [path for path in files if path.suffix == ".ply"]
        if clouds:
            text.append(f"PLY: {clouds[0].parent}/object_*_{{shape,points,truth}}.ply, {len(clouds)} files, one frame")
        if self.recording is not None:
            text.append(f"again: {_program()} view {self.recording}; page: {PAGE}")
        return [*text, f"{elapsed_s:.1f} s in all"]

    def as_dict(self, findings: list[Finding], files: list[Path], elapsed_s: float) -> dict[str, Any]:
        """The same for machines."""
        from edge.commands.report import as_dict
        from train.simulate.street_report import as_dict as street_dict

        report = as_dict(self.session.pipeline, self.session.tally, files, [*self.session.notes, *self.notes])
        report["files"] = report.pop("pictures")
        report.pop("shapes")
        report |= street_dict(self.street, findings, self.x_m)
        report["simulator"] = {"late": dict(self.source.late), "slow_reads": self.source.slow_reads}
        report["recording"] = str(self.recording) if self.recording is not None else None
        return {**report, "elapsed_s": round(elapsed_s, 1), "simulated": True}

    def _pace(self) -> str:
        """Pairs a second of the clock on the wall, and the frames that were not made in time."""
        frames = min(ledger.snapshot().frames_in for ledger in self.session.pipeline.ledgers.values())
        taken_s = max(self.wall_s[1] - self.wall_s[0], 1e-9)
        late, reads = self.source.late.total(), self.source.slow_reads
        share = (self.cpu_s[1] - self.cpu_s[0]) / taken_s
        pace = f"{(frames - 1) / taken_s:.1f} pairs a second for {taken_s:.1f} s, {100.0 * share:.0f} % of one core"
        return f"simulator and pipeline: {pace}; frames over 4 ms late: {late} made late, {reads} taken late"

    def exit_code(self) -> int:
        """Of the verb."""
        accounts = [ledger.snapshot() for ledger in self.session.pipeline.ledgers.values()]
        frames_in = sum(account.frames_in for account in accounts)
        lost = sum(account.frames_lost for account in accounts)
        good = self.log.final and lost <= MOST_LOST * frames_in
        return self.session.exit_code(ExitCode.OK if good else ExitCode.DEGRADED)


def _files(options: argparse.Namespace, drive: _Drive, findings: list[Finding]) -> list[Path]:
    """Write PLY files, and pictures unless the run was interrupted; what cannot be drawn becomes a note."""
    from train.simulate.street_files import write_pictures, write_ply

    paths = write_ply(options.out, drive.street, findings)
    if drive.pictures is None:
        return paths
    if drive.session.stopped():
        drive.notes.append("no pictures of an interrupted run")
        return paths
    subtitle = f"simulated street, rig {drive.street.drive.rig.name}, seed {options.seed}; grey: the true surfaces"
    try:
        return write_pictures(options.out, drive.street, findings, subtitle) + drive.pictures.write() + paths
    except Exception as error:  # matplotlib, its fonts and the disk have no common root
        drive.notes.append(f"pictures could not be drawn ({type(error).__name__}: {error})")
        return paths


def _keep(viewer: Viewer, session: Session) -> None:
    """Leave the page open until Ctrl-C."""
    from edge.commands.interrupts import Interrupts

    session.say("the viewer's page stays until Ctrl-C")
    with Interrupts() as interrupts:
        viewer.wait(interrupts.asked)


def _program() -> str:
    """``rfconstruct`` as it is called here."""
    beside = Path(sys.argv[0]).with_name("rfconstruct")
    return str(beside) if beside.is_file() else "rfconstruct"


def _say(options: argparse.Namespace, text: str) -> None:
    if not options.json:
        print(text, flush=True)


def pairs_ahead(frames: int, pair_s: float, period_s: float, most: int) -> int:
    """Pairs of frames to make before the clock starts, so that none of the drive is late.

    Args:
        frames: pairs of the drive. pair_s: time that the simulator takes for one, alone. period_s: between two of the
            radars. most: that memory holds.
    """
    return min(most, math.ceil(frames * max(0.0, 1.0 - BESIDE_PIPELINE * period_s / pair_s)))


def free_bytes() -> int:
    """Memory that nothing uses, as the operating system counts it."""
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RfconstructError("the folder cannot be made", value=str(folder), action="set --out") from error
