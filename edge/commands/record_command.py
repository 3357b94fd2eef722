# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct record``: a rig's raw frames, a running publisher's results, or a part of another recording."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from edge.commands import arguments, subscriber
from edge.commands.interrupts import Interrupts
from edge.commands.listen_command import topic
from edge.commands.record_live import LiveRecording
from edge.commands.record_progress import Progress
from edge.errors import ConfigError, ExitCode, RecordingError
from edge.recording.copying import copy_part
from edge.recording.playback import Part
from edge.recording.recorder import Recorder
from edge.recording.subscribing import RecordingClient
from edge.recording.writer import RecordingWriter
from edge.stream.client import DEFAULT_ENDPOINT

POLL_S = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.usage = "%(prog)s OUT --results | --rig NAME | --from FILE [options]"
    parser.add_argument("out", type=Path, help="recording to make; must not exist")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--results", action="store_true", help="what a running pipeline publishes")
    what.add_argument("--rig", metavar="NAME", help="raw frames of its boards (name or folder)")
    what.add_argument("--from", dest="source", type=Path, metavar="FILE", help="another recording, or a part of it")
    parser.add_argument("--seconds", type=arguments.seconds, metavar="S", help="end after this time (default: Ctrl-C)")
    parser.add_argument("--endpoint", default=DEFAULT_ENDPOINT, metavar="ADDRESS", help="results: of the publisher")
    parser.add_argument("--topics", nargs="+", type=topic, metavar="TOPIC", help="results: not all of them")
    parser.add_argument("--keys", metavar="FILE", help="results: secret key, for another machine")
    parser.add_argument("--timeout", type=arguments.seconds, metavar="S", help="results: end after such a silence")
    parser.add_argument("--boards", type=Path, metavar="FILE", help="raw: where boards and poses are reached")
    parser.add_argument("--start", type=arguments.moment, default=0.0, metavar="S", help="--from: first second")
    parser.add_argument("--end", type=arguments.moment, metavar="S", help="--from: last second")
    parser.add_argument("--note", action="append", default=[], metavar="TEXT", help="kept with the data")


def run(args: argparse.Namespace) -> int:
    """Record; Ctrl-C and SIGTERM are the usual end of it and no failure.

    Exit code 3 when nothing came, when frames or messages were lost, or the other recording is damaged; 1 when the disk
    is full or fails: what was recorded before is readable.
    """
    if args.out.suffix != ".mcap":
        raise ConfigError("recordings end in .mcap", value=str(args.out), action="choose such a name")
    if args.source is not None:
        return _copy(args)
    with Interrupts() as interrupts:
        return (_results if args.results else _live)(args, interrupts)


def _results(args: argparse.Namespace, interrupts: Interrupts) -> int:
    subscriber.require_keys(args.endpoint, args.keys)
    notes = [f"results of {args.endpoint}", *args.note]
    client = RecordingClient(args.endpoint, args.topics or (), keys=args.keys)
    with client:
        recorder = Recorder(RecordingWriter(args.out, None, notes))
        client.record_to(recorder)
        _say(args, f"recording results of {args.endpoint} to {args.out}; Ctrl-C ends it")
        with _closing(args, recorder), Progress(args.json, recorder) as progress:
            _listen(client, args, lambda: interrupts.asked() or recorder.failure is not None, progress)
        account = _account(recorder)
        account |= {"lost": client.lost, "malformed": client.malformed, "publisher restarts": client.restarts}
    return _report(args, account, bool(client.lost or client.malformed))


def _listen(client: RecordingClient, args: argparse.Namespace, stopped: Callable[[], bool], progress: Progress) -> None:
    """Until the time is over (from the first message), silence lasts too long, or ``stopped``."""
    heard_s = start_s = time.monotonic()
    begun = False
    while not stopped():
        seen = client.recorded
        client.recv(POLL_S)
        now_s = time.monotonic()
        if client.recorded != seen:
            heard_s = now_s
            start_s, begun = (start_s, True) if begun else (now_s, True)
        progress.update()
        over = args.seconds is not None and begun and now_s - start_s >= args.seconds
        if over or (args.timeout is not None and now_s - heard_s >= args.timeout):
            return


def _live(args: argparse.Namespace, interrupts: Interrupts) -> int:
    live = LiveRecording(args, interrupts.asked)
    recorder = Recorder(RecordingWriter(args.out, live.rig, args.note))
    _say(args, f"recording rig {live.rig.name} to {args.out}; Ctrl-C ends it")
    with _closing(args, recorder), Progress(args.json, recorder) as progress:
        live.run(recorder, progress)
    account = _account(recorder)
    account |= {"lost": {radar: dict(causes) for radar, causes in live.lost.items()}, "notes": live.notes}
    return _report(args, account, bool(live.faults or any(live.lost.values())))


def _copy(args: argparse.Namespace) -> int:
    if args.end is None and args.seconds is not None:
        args.end = args.start + args.seconds
    report = copy_part(args.source, args.out, Part(args.start, args.end), args.note)
    account = {"recording": str(args.out), "bytes": args.out.stat().st_size, "written": dict(report.written)}
    return _report(args, account | {"notes": report.notes}, report.damaged)


@contextmanager
def _closing(args: argparse.Namespace, recorder: Recorder) -> Iterator[None]:
    """Close it whatever happens; a recording without any message is no recording, and its name stays free."""
    try:
        yield
    finally:
        try:
            recorder.close()
        except RecordingError:
            _say(args, f"written before: {_counts(recorder.written)}; dropped since: {_counts(recorder.dropped)}")
            raise
        finally:
            if not recorder.written:
                recorder.path.unlink(missing_ok=True)


def _account(recorder: Recorder) -> dict[str, Any]:
    account: dict[str, Any] = {"recording": str(recorder.path), "bytes": recorder.bytes_written}
    return account | {"written": dict(recorder.written), "dropped": dict(recorder.dropped)}


def _counts(counts: Mapping[str, object]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "nothing"


def _report(args: argparse.Namespace, account: dict[str, Any], degraded: bool) -> int:
    if args.json:
        print(json.dumps(account, indent=2))
    else:
        size = f"{args.out.stat().st_size / 1e6:.1f} MB" if args.out.exists() else "nothing came, no file was made"
        print(f"{args.out}: {size}")
        for key in ("written", "dropped", "lost"):
            print(f"{key}: {_counts(account.get(key, {}))}")
        for note in account.get("notes", []):
            print(f"note: {note}")
    return ExitCode.DEGRADED if degraded or account.get("dropped") or not account["written"] else ExitCode.OK


def _say(args: argparse.Namespace, text: str) -> None:
    if not args.json:
        print(text, flush=True)
