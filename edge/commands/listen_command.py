# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct listen``: prints what a running pipeline publishes, one line a message."""

from __future__ import annotations

import argparse
import itertools
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edge.commands import arguments, subscriber
from edge.errors import ExitCode, RfconstructError
from edge.stream.client import Client, connect
from edge.stream.convert import save_shape
from edge.stream.messages import (
    CloudMessage,
    DetectionsMessage,
    HeartbeatMessage,
    HeatmapMessage,
    Message,
    PoseMessage,
    ShapeMessage,
    StatusMessage,
)

TOPICS = ("shape", "cloud", "det", "pose", "heat", "status", "hb")
DEFAULT_TOPICS = ("shape", "cloud", "status")
LOOK_S = 0.5
"""In silence it is looked so often whether the publisher refuses this client."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    subscriber.add_arguments(parser)
    parser.add_argument(
        "--topic", action="append", type=topic, help=f"{', '.join(TOPICS)} (default: {', '.join(DEFAULT_TOPICS)})"
    )
    parser.add_argument("--save", type=Path, metavar="DIR", help="write every shape there as PLY; overwrites nothing")
    parser.add_argument("--count", type=arguments.count, help="end after so many messages")
    parser.add_argument(
        "--timeout",
        type=arguments.seconds,
        metavar="SECONDS",
        help="end after so long a silence; exit code 3 when nothing came at all",
    )


def run(args: argparse.Namespace) -> int:
    """Print until interrupted, until ``--count`` or until the silence of ``--timeout``.

    Exit code 3 when ``--timeout`` passed without any message, or before ``--count`` of them.
    """
    subscriber.require_keys(args.endpoint, args.keys)
    if args.save is not None:
        _make_folder(args.save)
    with connect(args.endpoint, args.topic or DEFAULT_TOPICS, args.timeout, keys=args.keys) as client:
        if not args.json:
            print(f"waiting for {args.endpoint}", file=sys.stderr, flush=True)
        try:
            seen = _print_messages(client, args)
        finally:
            _print_account(client)
    return ExitCode.OK if seen >= (args.count or 1) else ExitCode.DEGRADED


def topic(text: str) -> str:
    """A topic, or one branch of it such as ``shape/car``; argparse.ArgumentTypeError when nothing is published so."""
    if text.strip("/").split("/")[0] not in TOPICS:
        raise argparse.ArgumentTypeError(f"got {text!r}; allowed: {', '.join(TOPICS)}")
    return text


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RfconstructError(f"shapes cannot be saved ({error.strerror})", value=str(folder)) from error


def _print_messages(client: Client, args: argparse.Namespace) -> int:
    seen = 0
    for message in _messages(client, args):
        content = describe(message)
        if args.json:
            print(json.dumps(content), flush=True)
        else:
            kind = content.pop("type")
            print(f"{kind:<11}" + "  ".join(f"{key} {value}" for key, value in content.items()), flush=True)
        if args.save is not None and isinstance(message, ShapeMessage):
            save_shape(free_path(args.save, message), message)
        seen += 1
        if args.count is not None and seen >= args.count:
            break
    return seen


def _messages(client: Client, args: argparse.Namespace) -> Iterator[Message]:
    """What comes, until silence lasts ``--timeout``; says on stderr when the publisher refuses this client."""
    told, silent_s = False, 0.0
    while args.timeout is None or silent_s < args.timeout:
        wait_s = LOOK_S if args.timeout is None else min(LOOK_S, args.timeout - silent_s)
        message = client.recv(wait_s)
        silent_s = silent_s + wait_s if message is None else 0.0
        if message is not None:
            yield message
        elif not told and (why := subscriber.why_refused(client)):
            told = True
            print(why, file=sys.stderr, flush=True)


def free_path(folder: Path, message: ShapeMessage) -> Path:
    """Name of a file that does not exist: start of the publisher, class, identity, instant and number in its topic.

    ``shape_00010203_car_5_1000000000_7.ply``; a number follows when there is such a file (two listeners, one folder).
    """
    head, kind = message.header, re.sub(r"[^A-Za-z0-9-]", "-", message.class_name)[:40]
    name = f"shape_{head.boot.hex()[:8]}_{kind}_{message.identity}_{head.t_ns}_{head.sequence}"
    names = itertools.chain([name], (f"{name}_{copy}" for copy in itertools.count(2)))
    return next(path for name in names if not (path := folder / f"{name}.ply").exists())


def _print_account(client: Client) -> None:
    """What was lost on the way, on stderr."""
    lost = sum(client.lost.values())
    if lost or client.malformed:
        print(f"lost {client.lost}, malformed {client.malformed}", file=sys.stderr)


def describe(message: Message) -> dict[str, Any]:
    """The message's main facts as plain values."""
    kind = type(message).__name__.removesuffix("Message").lower()
    head: dict[str, Any] = {"type": kind, "src": message.header.source}
    match message:
        case ShapeMessage():
            position = [round(float(x), 2) for x in message.pose.position_m]
            facts = {"id": message.identity, "class": message.class_name, "confidence": round(message.confidence, 2)}
            sizes = {"size_m": [round(float(x), 2) for x in message.size_m], "at_m": position}
            return {**head, **facts, **sizes, "points": len(message.fine_m), "from": message.input_points}
        case CloudMessage():
            return {**head, "points": len(message.cloud), "frames": message.cloud.frames,
                    "travel_m": round(message.cloud.travel_m, 2)}  # fmt: skip
        case DetectionsMessage():
            counts = {r: len(d) for r, d in (("h", message.horizontal), ("v", message.vertical)) if d is not None}
            return {**head, "frame": message.number, **counts, "points": len(message.points or ())}
        case HeatmapMessage():
            return {**head, "radar": message.radar, "frame": message.number, "peak_db": float(message.power_db.max())}
        case PoseMessage():
            return {**head, "t_ns": message.pose.t_ns, "at_m": [round(float(x), 3) for x in message.pose.position_m]}
        case StatusMessage():
            radars = {name: f"{r.frames_ok}/{r.frames_in}" for name, r in message.status.radars.items()}
            codes = [reason.code for reason in message.status.reasons]
            return {**head, "state": message.status.state, **radars, "reasons": codes}
        case HeartbeatMessage():
            return {**head, "state": message.state}
