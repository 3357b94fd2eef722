# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct view``: a web page of a running appliance's stream, or of a recording."""

from __future__ import annotations

import argparse
import ipaddress
import json
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

from edge.commands import arguments, subscriber
from edge.commands.interrupts import Interrupts
from edge.commands.open_source import calibrated
from edge.errors import ConfigError, ExitCode, RecordingError
from edge.recording.reader import RecordingReader
from edge.rig import load_rig
from edge.stream.client import Client, connect
from edge.view.health import STALE_S, Banner
from edge.view.page import DEFAULT_PORT, HOST, Page
from edge.view.playback import Player
from edge.view.scene import Scene
from edge.view.store import MessageStore

PERIOD_S = 0.1
"""The page is updated ten times a second."""
MOST_MESSAGES = 2000
"""Taken between two updates; more wait in ZeroMQ's queue, which drops and counts."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("recording", nargs="?", type=Path, help="MCAP recording; without: a running pipeline")
    subscriber.add_arguments(parser)
    parser.add_argument("--port", type=port, default=DEFAULT_PORT, help="of the page; 0: any (default: %(default)s)")
    parser.add_argument("--host", default=HOST, help="only this machine: %(default)s; from others by an SSH tunnel")
    parser.add_argument("--rig", help="name or folder, instead of the one in the recording")
    parser.add_argument("--calibration", action="append", default=[], metavar="FILE", help="[RADAR=]FILE, likewise")
    parser.add_argument("--duration", type=arguments.seconds, metavar="SECONDS", help="end after so long")


def port(text: str) -> int:
    """A TCP port, or 0; argparse.ArgumentTypeError for anything else."""
    if not (text.isascii() and text.isdigit() and int(text) < 1 << 16):
        raise argparse.ArgumentTypeError(f"got {text!r}; allowed: 0..65535")
    return int(text)


def run(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C, SIGTERM or ``--duration``."""
    check_host(args.host, args.port)
    if args.recording is None:
        subscriber.require_keys(args.endpoint, args.keys)
    with ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        end_s = time.monotonic() + args.duration if args.duration else float("inf")

        def stopped() -> bool:
            return interrupts.asked() or time.monotonic() >= end_s

        if args.recording is None:
            client = stack.enter_context(connect(args.endpoint, keys=args.keys))
            page = stack.enter_context(closing(Page(args.port, "RFconstruct, live")))
            _announce(page, args)
            watch_live(page, client, stopped)
        else:
            reader = stack.enter_context(open_recording(args.recording))
            store = stack.enter_context(closing(MessageStore()))
            player = Player(store)
            page = stack.enter_context(closing(Page(args.port, f"RFconstruct, {args.recording.name}", player)))
            _announce(page, args)
            from edge.view.digest import Digest  # it brings the pipeline, which a live view does not need

            digest = Digest(store, _filler(reader, store, args))
            stack.callback(digest.stop)
            watch_recording(page, store, player, args.recording.name, stopped)
            if store.failure and not interrupts.asked():
                raise RecordingError(store.failure)
        return interrupts.exit_code if interrupts.asked() else ExitCode.OK


def check_host(host: str, port_number: int) -> None:
    """ConfigError unless the page stays on this machine: it has no password and no encryption."""
    try:
        here = host == "localhost" or ipaddress.ip_address(host) == ipaddress.ip_address(HOST)
    except ValueError:
        here = False
    if not here:
        raise ConfigError(
            "the page is served to this machine only: it has no password and no encryption",
            value=host,
            allowed=HOST,
            action=f"on the other machine: ssh -L {port_number}:{HOST}:{port_number} USER@THIS_MACHINE, "
            f"then open http://{HOST}:{port_number} there",
        )


def open_recording(path: Path) -> RecordingReader:
    """RecordingError when there is no such recording, or nothing in it to show."""
    if not path.is_file():
        raise RecordingError(f"{path}: no such recording", action="give an .mcap file, or none to watch a live stream")
    reader = RecordingReader(path)
    if not (reader.has_results or reader.has_frames):
        reader.close()
        raise RecordingError(f"{path}: holds neither results nor raw frames")
    return reader


def watch_live(page: Page, client: Client, stopped: Callable[[], bool], scene: Scene | None = None) -> None:
    """Show what comes until ``stopped``.

    Args:
        page: open.
        client: subscribed to everything.
        stopped: asked ten times a second.
        scene: to fill; None: a new one.
    """
    scene = scene or Scene()
    while not stopped():
        due_s = time.monotonic() + PERIOD_S
        for _ in range(MOST_MESSAGES):
            message = client.recv(max(0.0, due_s - time.monotonic()))
            if message is None:
                break
            scene.add(message, time.monotonic())
            if time.monotonic() >= due_s:
                break
        now_s = time.monotonic()
        figures = _own_figures(scene) | {
            "messages lost on the way": str(sum(client.lost.values())),
            "malformed": str(client.malformed),
            "refused by the publisher": str(client.refused),
            "stream": client.endpoint,
        }
        shown_s = now_s if scene.health.stopped_s is None else scene.health.stopped_s
        banner = scene.health.banner(now_s, client.endpoint, STALE_S)
        if banner.state in ("WAITING", "STALE") and (why := subscriber.why_refused(client)):
            banner = Banner("REFUSED", "error", why, banner.reasons)
        page.update(scene, banner, figures, shown_s)


def watch_recording(
    page: Page, store: MessageStore, player: Player, name: str, stopped: Callable[[], bool], scene: Scene | None = None
) -> None:
    """Play until ``stopped``.

    Args:
        page: with this player's scrubber.
        store: being filled.
        player: of the store.
        name: of the recording.
        stopped: asked ten times a second.
        scene: to fill; None: a new one.
    """
    scene = scene or Scene()
    while not stopped():
        due_s = time.monotonic() + PERIOD_S
        empty_first, messages = player.step(time.monotonic())
        if empty_first:
            scene.reset()
        for message in messages:
            scene.add(message, message_wall_s(message.header.t_ns, player.clock_s))
        figures = _own_figures(scene) | {
            "recording read": f"{100 * store.progress:.0f} %" + (", the rest does not fit" if store.full else ""),
            "damaged messages": str(player.damaged),
        }
        page.update(scene, _recording_banner(scene, store, name, player), figures, player.clock_s)
        time.sleep(max(0.0, due_s - time.monotonic()))


def message_wall_s(t_ns: int, clock_s: float) -> float:
    """When a message counts as having come: at its measurement, so that a jump ages objects as playing does."""
    return min(t_ns / 1e9, clock_s) if abs(t_ns / 1e9 - clock_s) < 600.0 else clock_s


def _recording_banner(scene: Scene, store: MessageStore, name: str, player: Player) -> Banner:
    if store.failure:
        return Banner("FAULT", "error", store.failure)
    if not len(store):
        return Banner("READING", "warn", f"{name}: kernels and model are being loaded")
    inner = scene.health.banner(player.clock_s, name, None)
    return Banner("PLAYING" if player.playing else "PAUSED", inner.level, f"{name}: {inner.state}", inner.reasons)


def _own_figures(scene: Scene) -> dict[str, str]:
    counts = scene.counts
    return {
        "late messages dropped": str(counts.late),
        "new starts": str(counts.resets),
        "cloud points thinned out": str(counts.thinned),
    }


def _filler(
    reader: RecordingReader, store: MessageStore, args: argparse.Namespace
) -> Callable[[Callable[[], bool]], None]:
    """The work that fills the store: recorded results, or the pipeline when there are raw frames only."""

    def fill(stopped: Callable[[], bool]) -> None:
        from edge.view.digest import copy_results, run_pipeline

        if reader.has_results and args.rig is None and not args.calibration:
            copy_results(reader, store, stopped)
            return
        from edge.commands.session import load_model
        from edge.pipeline import Pipeline
        from edge.warm import warm_up

        rig = calibrated(load_rig(args.rig) if args.rig else reader.read_rig(), args.calibration)
        pipeline = Pipeline(rig, load_model(rig)[0], [])
        warm_up(rig, pipeline)
        run_pipeline(reader, pipeline, store, stopped)

    return fill


def _announce(page: Page, args: argparse.Namespace) -> None:
    if args.json:
        print(json.dumps({"url": page.url, "port": page.port}), flush=True)
    else:
        print(f"viewer: {page.url} (Ctrl-C ends)", flush=True)
