# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct recover``: saves the whole records of a cut or damaged recording into a good one."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from edge.errors import ExitCode, RecordingError
from edge.recording.salvage import SalvageReport, recover


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("recording", type=Path, help="cut or damaged recording; it is not changed")
    parser.add_argument("out", type=Path, help="recording to make; must not exist")


def run(args: argparse.Namespace) -> int:
    """Save what can be saved; exit code 3 when something was lost, 1 when there is nothing to save."""
    if not args.recording.is_file():
        raise RecordingError(f"{args.recording}: no such recording", action="give an .mcap file")
    report = recover(args.recording, args.out)
    print(json.dumps(_as_dict(report, args.out), indent=2) if args.json else "\n".join(_lines(report, args.out)))
    lost = report.bytes_lost or report.unknown or any(report.missing.values()) or not report.has_rig
    return ExitCode.DEGRADED if lost and not report.was_whole else ExitCode.OK


def _as_dict(report: SalvageReport, out: Path) -> dict[str, Any]:
    return {
        "recording": str(out),
        "kept": dict(report.kept),
        "chunks": report.chunks,
        "bytes_lost": report.bytes_lost,
        "unknown": report.unknown,
        "missing_frames": dict(report.missing),
        "has_rig": report.has_rig,
        "was_whole": report.was_whole,
    }


def _lines(report: SalvageReport, out: Path) -> list[str]:
    lines = [f"{out}: {out.stat().st_size / 1e6:.1f} MB"]
    lines += [f"kept {topic:<24}{count:>10}" for topic, count in sorted(report.kept.items())]
    lines.append(f"bytes lost: {report.bytes_lost}; messages of unknown kind: {report.unknown}")
    missing = ", ".join(f"{radar} {count}" for radar, count in report.missing.items())
    lines.append(f"frames missing between the first and the last: {missing or 'there are no frames'}")
    if not report.has_rig and report.missing:
        lines.append("the rig was lost: replay it with --rig NAME")
    if report.was_whole:
        lines.append("the recording was whole; this is a copy")
    return lines
