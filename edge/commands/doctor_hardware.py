# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct doctor --hardware``: follows every link from this host to the samples, and names the dead one."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from edge.board_settings import CaptureCardBoard, CascadeBoard
from edge.commands.checks import Check, failure, lines
from edge.commands.hardware import make_boards
from edge.commands.key_checks import keys_check
from edge.commands.network_checks import receive_buffer, tcp_port, way_to
from edge.drivers.board import Board
from edge.drivers.dca1000.control import CaptureCard
from edge.drivers.dca1000.receiver import open_udp
from edge.drivers.demo_cli import DemoCli, find_cli_port
from edge.drivers.fetch import fetcher_for
from edge.drivers.single_chip import SingleChipDriver
from edge.drivers.tda2.cascade import CascadeDriver
from edge.drivers.tda2.firmware import load_image
from edge.drivers.usb import usb_report
from edge.errors import ConfigError, ExitCode, FirmwareError, LinkError, RefusalError, RfconstructError
from edge.frames import RadarFrame, RadarId
from edge.odometry.source import make_pose_source
from edge.rig import Rig, load_rig
from edge.rig_boards import require_apart
from edge.sources.pose_feed import PoseFeed
from edge.sources.segments import SegmentSource

FRAMES = 30
"""Of a trial: half a second at 60 frames/s."""
POSES_S = 3.0
PLATFORM = re.compile(r"(?:xWR|AWR|IWR)(\d\d)", re.IGNORECASE)
Step = tuple[str, Callable[[], str | Check]]


def run(args: argparse.Namespace) -> int:
    """Every check in its order, each within a stated time; exit code 0, 4 when a link is dead, 3 when only keys are."""
    if args.rig is None:
        raise ConfigError("the hardware of which rig?", action="give it with --rig")
    doctor, checks = HardwareDoctor(args.rig, args.boards, not args.quick), list[Check]()
    for check in _links_and_keys(doctor):
        checks.append(check)
        if not args.json:
            print("\n".join(lines(check)), flush=True)
    keys_fail = checks[-1].outcome == "fails"
    dead = sum(check.outcome == "fails" for check in checks[:-1])
    code = ExitCode.NO_HARDWARE if dead else ExitCode.DEGRADED if keys_fail else ExitCode.OK
    if args.json:
        print(json.dumps({"checks": [asdict(check) for check in checks], "exit_code": int(code)}, indent=2))
    else:
        ready = f"{dead} of {len(checks) - 1} links are dead" if dead else "the hardware is ready"
        print(f"{ready}, the keys are not" if keys_fail else ready)
    return code


def _links_and_keys(doctor: HardwareDoctor) -> Iterator[Check]:
    yield from doctor.checks()
    yield keys_check(doctor.rig.settings.stream)


@dataclass
class _Chain:
    """Links of one radar, each of which needs those before it."""

    name: str
    steps: list[Step] = field(default_factory=list)

    def checks(self) -> Iterator[Check]:
        """Until one fails; what comes behind it was not looked at."""
        for index, (what, step) in enumerate(self.steps):
            name = f"{self.name} {what}"
            try:
                found = step()
                check = found if isinstance(found, Check) else Check(name, "ok", found)
            except RfconstructError as error:
                check = failure(name, error)
            except Exception as error:  # whatever the system refuses is a finding, not the end of the doctor
                check = Check(name, "fails", f"{type(error).__name__}: {error}", "check the rights of this user")
            yield check
            if check.outcome == "fails":
                rest = ", ".join(later for later, _ in self.steps[index + 1 :])
                if rest:
                    yield Check(self.name, "note", f"not looked at behind it: {rest}")
                return


class HardwareDoctor:
    """Checks of one rig.

    Args:
        rig: name or folder.
        boards: file that overrides where boards are reached.
        trial: configure the boards and take some frames; without it nothing is changed on them.
    Raises:
        ConfigError: no such rig, or the file is wrong.
    """

    def __init__(self, rig: str, boards: Path | None, trial: bool) -> None:
        self.rig: Rig = load_rig(rig, boards)
        self._trial = trial

    def checks(self) -> Iterator[Check]:
        """All, radar by radar; USB first, poses last."""
        try:
            require_apart(self.rig.boards)
        except ConfigError as error:
            yield failure("addresses", error)
            return
        yield Check("addresses", "ok", "every board has its own")
        if any(isinstance(board, CaptureCardBoard) and not board.port for board in self.rig.boards.values()):
            for finding in usb_report():
                yield Check(f"usb {finding.name}", finding.outcome, finding.found, finding.action)
        feed, problem = self._feed()
        try:
            for radar, driver in make_boards(self.rig).items():
                with contextlib.closing(driver):
                    yield from self._chain(radar, driver).checks()
            if problem is not None:
                yield problem
            elif feed is not None:
                yield self._pose_check(feed)
        finally:
            if feed is not None:
                feed.close()

    def _chain(self, radar: RadarId, driver: Board) -> _Chain:
        board, chain = self.rig.boards[radar], _Chain(radar)
        if isinstance(board, CascadeBoard) and isinstance(driver, CascadeDriver):
            chain.steps = self._cascade(board, driver)
        elif isinstance(board, CaptureCardBoard) and isinstance(driver, SingleChipDriver):
            chain.steps = self._card(board, driver)
        return chain

    # --- cascade

    def _cascade(self, board: CascadeBoard, driver: CascadeDriver) -> list[Step]:
        def greet() -> str:
            driver.connect()
            return driver.version or "no version text"

        def recordings() -> str:
            return fetcher_for(board).check()

        steps: list[Step] = [
            ("route", lambda: way_to(board.address)),
            ("control port", lambda: tcp_port(board.address, board.control_port, "control")),
            ("greeting", greet),
            ("firmware file", lambda: _image(board, self.rig)),
            ("recordings", recordings),
        ]
        trial: list[Step] = [
            ("chips", lambda: _configured(driver)),
            ("frames", lambda: self._segment(board, driver)),
        ]
        return steps + (trial if self._trial else [])

    def _segment(self, board: CascadeBoard, driver: CascadeDriver) -> str:
        """A short segment, from the chips to this host."""
        alone, count = _rig_of(self.rig, driver.radar), 0
        with tempfile.TemporaryDirectory(prefix="rfconstruct-") as folder:
            source = SegmentSource(
                alone,
                {driver.radar: driver},
                {driver.radar: fetcher_for(board)},
                frames=FRAMES,
                segments=1,
                folder=Path(folder),
            )
            count = sum(isinstance(item, RadarFrame) for item in source)
        trouble = "; ".join(report.text for report in source.reports if report.text)
        if count < FRAMES or trouble:
            raise LinkError(
                f"{driver.radar}: {count} of {FRAMES} frames came",
                value=trouble or None,
                action="when nothing was written: reset the board (S1) and check its supply; it is known to happen",
            )
        return f"{FRAMES} frames recorded and fetched"

    # --- single chip

    def _card(self, board: CaptureCardBoard, driver: SingleChipDriver) -> list[Step]:
        steps: list[Step] = [
            ("route", lambda: way_to(board.card_address)),
            ("host ports", lambda: _ports(board)),
            ("receive buffer", lambda: _buffer(board, driver)),
            ("card", lambda: _answering(board, driver.radar)),
            ("serial port", lambda: _serial(board, driver.radar)),
            ("demo", lambda: _demo(board, driver)),
        ]
        trial: list[Step] = [
            ("configuration", lambda: _set_up(driver)),
            ("frames", lambda: _live_frames(driver)),
        ]
        return steps + (trial if self._trial else [])

    # --- poses

    def _feed(self) -> tuple[PoseFeed | None, Check | None]:
        try:
            source = make_pose_source(self.rig)
            if source is None:
                return None, Check("poses", "note", 'pose.kind is "none"', "without poses nothing is fused: set [pose]")
            return PoseFeed(source), None
        except RfconstructError as error:
            return None, failure("poses", error)

    def _pose_check(self, feed: PoseFeed) -> Check:
        came = feed.first.wait(POSES_S)
        health = feed.health
        if not came:
            return Check(
                "poses",
                "fails",
                f"none within {POSES_S:g} s from {feed.name}, refused {health.refused}",
                "is the sensor or the sending process running? check [pose]: endpoint, device_id, clock",
            )
        found = f"{feed.name}: {health.rate_hz:.0f} a second"
        if health.refused:
            return Check("poses", "note", f"{found}, {health.refused} refused", "check pose.clock of the sender")
        return Check("poses", "ok", found)


def _rig_of(rig: Rig, radar: RadarId) -> Rig:
    return replace(rig, radars={radar: rig.radars[radar]})


def _image(board: CascadeBoard, rig: Rig) -> str:
    load_image(board.firmware, rig.directory)
    return f"{board.firmware}: size and CRC-32 are right"


def _configured(driver: CascadeDriver) -> str:
    """Set up; chips that report the same are named together."""
    alike: dict[str, list[str]] = {}
    for note in driver.configure(lambda what, done, of: None):
        head, _, report = note.partition(": ")
        alike.setdefault(re.sub(r", die [0-9a-f]+", "", report), []).append(head.rpartition(", ")[2])
    return "; ".join(f"{', '.join(names)}: {report}" for report, names in alike.items())


def _ports(board: CaptureCardBoard) -> str:
    """Both UDP ports of this host are free."""
    for port, what in ((board.command_port, "commands"), (board.data_port, "samples")):
        try:
            open_udp(board.host_address, port, what).close()
        except LinkError as error:
            user = _user_of(port)
            raise LinkError(
                error.what, value=f"{error.value}{f', held by {user}' if user else ''}", action=error.action
            ) from error
    return f"{board.host_address}: UDP {board.command_port} and {board.data_port} are free"


def _user_of(port: int) -> str:
    """Process of this user that holds a UDP port; "" when it is another user's."""
    with contextlib.suppress(OSError):
        rows = [line.split() for line in Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]]
        inodes = {row[9] for row in rows if int(row[1].rpartition(":")[2], 16) == port}
        return _holder({f"socket:[{inode}]" for inode in inodes})
    return ""


def _holder(targets: set[str]) -> str:
    """Name and number of a process that holds one of these files open."""
    for process in (entry for entry in os.listdir("/proc") if entry.isdigit()):
        with contextlib.suppress(OSError):
            for handle in os.listdir(f"/proc/{process}/fd"):
                if os.readlink(f"/proc/{process}/fd/{handle}") in targets:
                    name = Path(f"/proc/{process}/comm").read_text(encoding="utf-8").strip()
                    return f"{name} (process {process})"
    return ""


def _buffer(board: CaptureCardBoard, driver: SingleChipDriver) -> Check:
    name = f"{driver.radar} receive buffer"
    enough, found, action = receive_buffer(board.receive_buffer_bytes, 2 * driver.timing.frame_bytes)
    if enough:
        return Check(name, "note" if action else "ok", found, action)
    return Check(name, "fails", found, action)


def _answering(board: CaptureCardBoard, radar: RadarId) -> str:
    card = CaptureCard(board, f"{radar} card")
    try:
        card.open()
        return f"FPGA version {card.version().text()}"
    finally:
        card.close()


def _serial(board: CaptureCardBoard, radar: RadarId) -> str:
    port = board.port or find_cli_port(board.serial_number, f"{radar} radar")
    if not os.path.exists(port):
        raise LinkError(
            f"serial port {port} is not there",
            action="connect the radar board's USB cable; name the board by serial_number instead of port",
        )
    if not os.access(port, os.R_OK | os.W_OK):
        raise RefusalError(f"no right to open {port}", action="add the user to group dialout, install the udev rules")
    user = _holder({os.path.realpath(port)}) if not os.path.realpath(port).startswith("/dev/pts") else ""
    if user:
        raise LinkError(
            f"serial port {port} is in use by {user}", action="end it; ModemManager: install the udev rules"
        )
    DemoCli(port, f"{radar} radar", board.baud_rate).close()
    return port


def _demo(board: CaptureCardBoard, driver: SingleChipDriver) -> Check | str:
    """The demo answers, and is that of the rig's device."""
    name, device = f"{driver.radar} radar", driver.schedule.profile.device
    cli = DemoCli(board.port or find_cli_port(board.serial_number, name), name, board.baud_rate, answer_s=3.0)
    try:
        cli.send("")
        cli.wait_prompt(3.0)
        text = [line for line in cli.command("version") if line != "Done"]
    except RefusalError:
        return Check(f"{driver.radar} demo", "note", "answers, but has no command version: an unknown firmware")
    finally:
        cli.close()
    found = PLATFORM.search("\n".join(text))
    if found and found[1] != device[3:5]:
        raise FirmwareError(
            f"{name} runs the demo of another device",
            value=found[0],
            allowed=device,
            action="flash the demo of this device's SDK with UniFlash, or load the rig of this board",
        )
    return "; ".join(re.sub(r"\s+", " ", line) for line in text)


def _set_up(driver: SingleChipDriver) -> str:
    driver.connect()
    notes = driver.configure(lambda what, done, of: None)
    return "; ".join(notes) or "done"


def _live_frames(driver: SingleChipDriver) -> str:
    """Half a second of frames."""
    driver.arm(0)
    assert driver.receiver is not None, "connected"
    driver.start()
    time.sleep(FRAMES * driver.timing.period_s)
    reports = driver.check()
    driver.stop()
    account = driver.receiver.counters().account
    bad = account.frames_cut + account.frames_missing
    if bad or not account.frames_whole:
        raise LinkError(
            f"{driver.radar}: {account.frames_whole} whole frames, {account.frames_cut} cut, "
            f"{account.frames_missing} missing",
            value="; ".join(reports) or None,
            action="a larger receive buffer, a direct cable, a longer packet delay",
        )
    return f"{account.frames_whole} whole frames, {account.packets} packets"
