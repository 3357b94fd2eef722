# SPDX-License-Identifier: Apache-2.0
"""``replay`` of a recording of results: published again as they were, at any speed."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from edge.commands.interrupts import Interrupts
from edge.config import StreamSettings
from edge.digest import ResultDigest
from edge.errors import ConfigError, ExitCode
from edge.recording.playback import Part
from edge.recording.reader import RecordingReader
from edge.recording.republish import Republisher, ResultsPlayback
from edge.version import version

QUEUE = 1000
"""Messages that may wait for a subscriber: without a pace they leave in one burst."""
JOIN_S = 1.2
"""Subscribers that wait for the address look for it every second at most."""


def replay_results(reader: RecordingReader, part: Part, args: argparse.Namespace) -> int:
    """Play; exit code 3 when the recording is cut or damaged or holds what is no message.

    Raises:
        ConfigError: options that only raw frames can serve.
    """
    for option in ("plot", "rig", "calibration"):
        if getattr(args, option):
            raise ConfigError(f"--{option} needs raw frames; this recording holds results", value=str(reader.path))
    interrupts, digest = Interrupts(), ResultDigest() if args.digest else None
    with ExitStack() as stack:
        publisher: Republisher | None = None
        if not args.no_publish:
            settings = StreamSettings(send_high_water_mark=QUEUE)
            if args.endpoint:
                settings = replace(settings, endpoints=tuple(args.endpoint))
            publisher = Republisher(settings)
            stack.callback(publisher.close)
            if not args.json:
                print(f"publishing on {', '.join(publisher.endpoints)}", flush=True)
        playback = ResultsPlayback(reader, part, publisher, digest)
        stack.enter_context(interrupts)
        if publisher is not None:
            publisher.invite(JOIN_S, interrupts.asked)
        with _bar(args.json) as bar:
            playback.run(args.speed, interrupts.asked, bar.update)
        if publisher is not None:
            publisher.end(version())
    _report(reader, playback, digest, args.json)
    if interrupts.asked():
        return interrupts.exit_code
    damaged = reader.truncated or reader.report.bytes_lost or playback.unreadable or not playback.sent
    return ExitCode.DEGRADED if damaged else ExitCode.OK


def _report(reader: RecordingReader, playback: ResultsPlayback, digest: ResultDigest | None, as_json: bool) -> None:
    notes = list(reader.notes)
    if reader.truncated:
        notes.append(f"{reader.path}: its end is missing; played up to the last whole record")
    if reader.report.damaged_chunks:
        notes.append(f"{reader.path}: damaged chunks left out: {reader.report.damaged_chunks}")
    if playback.unreadable:
        notes.append(
            f"not sent, since they do not follow the wire format: {playback.unreadable} ({playback.last_fault})"
        )
    content: dict[str, Any] = {"messages": dict(playback.sent), "passes": playback.passes}
    if digest is not None:
        content["digest"] = digest.hexdigest()
    if as_json:
        print(json.dumps({**content, "notes": notes}, indent=2))
        return
    print("messages: " + (", ".join(f"{kind} {count}" for kind, count in playback.sent.items()) or "none"))
    if digest is not None:
        print(f"digest: {digest.hexdigest()}")
    for note in notes:
        print(f"note: {note}")


def _bar(hidden: bool) -> Any:
    from tqdm import tqdm

    hidden = hidden or sys.stderr is None or not sys.stderr.isatty()
    return tqdm(unit="message", desc="publishing", disable=hidden, leave=False)
