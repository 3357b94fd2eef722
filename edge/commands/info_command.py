# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct info``: describes a recording, a capture folder, a rig (with every hardware rule) or a model folder."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge.completion.manifest import find_model, read_files, read_manifest
from edge.constraints import format_table
from edge.errors import ConfigError, ExitCode, ModelError
from edge.frames import RADARS
from edge.recording.reader import RecordingReader
from edge.recording.survey import survey
from edge.rig import Rig, known_rigs, load_rig
from edge.sources.ti_capture import describe_capture
from edge.sources.ti_index import Gap, gap_notes
from edge.waveform import Schedule

REMARKS = {"missing_numbers": "numbers missing", "out_of_order": "out of order"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("target", help="recording (.mcap), TI capture folder, rig name or folder, model name or folder")
    parser.add_argument("--quick", action="store_true", help="recordings: only what their end says, nothing is checked")


def run(args: argparse.Namespace) -> int:
    """Find out what the target is and describe it; exit code 3 for a recording that is cut or damaged."""
    path = Path(args.target)
    if path.is_file():
        content = describe_recording(path, args.quick, args.json)
        print(json.dumps(content, indent=2, default=str) if args.json else "\n".join(_recording_lines(content)))
        return ExitCode.OK if content.get("whole", True) else ExitCode.DEGRADED
    if args.target not in known_rigs() and not (path / "rig.toml").is_file():
        content = describe_folder(path)
        if content:
            print(json.dumps(content, indent=2) if args.json else "\n".join(pairs(_with_gaps_in_words(content))))
            return ExitCode.OK
        content = describe_model(_find_model(args.target))
        print(json.dumps(content, indent=2) if args.json else "\n".join(pairs(content)))
        return ExitCode.OK
    rig = load_rig(args.target)
    print(json.dumps(rig_as_dict(rig), indent=2) if args.json else "\n".join(describe_rig(rig)))
    return ExitCode.OK


def describe_recording(path: Path, quick: bool, quiet: bool) -> dict[str, Any]:
    """What a recording holds; unless ``quick`` it is read from end to end, with a bar on a terminal.

    Raises:
        RecordingError: unreadable.
    """
    with RecordingReader(path) as reader:
        return reader.info() if quick else survey(reader, _bar(path, quiet).update)


def _bar(path: Path, quiet: bool) -> Any:
    from tqdm import tqdm

    hidden = quiet or sys.stderr is None or not sys.stderr.isatty()
    return tqdm(total=path.stat().st_size, unit="B", unit_scale=True, desc="reading", disable=hidden, leave=False)


def _recording_lines(content: dict[str, Any]) -> list[str]:
    """One line a topic instead of nested values."""
    streams = content.pop("streams", None)
    if streams is None:
        return list(pairs(content))
    counts = content.pop("topics")
    content = {key: "none" if value in ({}, []) else value for key, value in content.items()}
    lines = [*pairs(content), "", f"{'topic':<24}{'messages':>9}{'MB':>10}{'from s':>9}{'to s':>9}{'Hz':>9}  remarks"]
    for topic, facts in streams.items():
        remarks = [f"{facts['gaps']} gaps, longest {facts['longest_gap']}"] if facts.get("gaps") else []
        remarks += [f"{facts[key]} {text}" for key, text in REMARKS.items() if facts.get(key)]
        figures = (
            f"{facts['megabytes']:>10.2f}{facts['from_s']:>9.2f}{facts['to_s']:>9.2f}{facts.get('rate_hz', 0):>9.2f}"
        )
        lines.append(f"{topic:<24}{facts['messages']:>9}{figures}  {', '.join(remarks)}")
    lines += [f"{topic:<24}{count:>9}" for topic, count in counts.items() if topic not in streams and count]
    return lines


def describe_folder(folder: Path) -> dict[str, Any]:
    """What the capture in a folder is, or those in its folders ``horizontal`` and ``vertical``; empty: none is there.

    Raises:
        CaptureError: an index file that cannot be read.
    """
    found: dict[str, Any] = describe_capture(folder)
    both = {radar: describe_capture(folder / radar) for radar in RADARS}
    return found or {radar: content for radar, content in both.items() if content}


def _with_gaps_in_words(content: dict[str, Any]) -> dict[str, Any]:
    words = dict(content)
    for radar in words.keys() & set(RADARS):
        words[radar] = _with_gaps_in_words(words[radar])
    if "gaps" in words:
        gaps = [Gap(gap["after_frame"], gap["duration_s"], gap["frames_missing"]) for gap in words["gaps"]]
        told = zip(gap_notes(gaps), gaps, strict=True)
        words["gaps"] = [f"{note} ({gap.missing} missing)" for note, gap in told] or "none"
    return words


def _find_model(name: str) -> Path:
    """Folder of the model; ConfigError when nothing at all has this name."""
    try:
        return find_model(name)
    except ModelError as error:
        allowed = f"a recording, a capture folder, a rig ({', '.join(known_rigs())}) or a model ({error.allowed})"
        raise ConfigError("nothing to describe has this name", value=name, allowed=allowed) from error


def describe_model(folder: Path) -> dict[str, Any]:
    """Manifest of a model folder after its files were checked against their hashes."""
    manifest = read_manifest(folder)
    read_files(folder, manifest)
    return {
        "model": manifest.name,
        "files": {f.file: f"{f.precision}, {f.size / 1e6:.2f} MB, sha256 {f.sha256}" for f in manifest.files.values()},
        "default file": manifest.default_file,
        "classes": list(manifest.classes),
        "input frame": manifest.input_frame,
        "rigs": list(manifest.rigs),
    }


def schedule_figures(schedule: Schedule) -> dict[str, tuple[float, str]]:
    """Derived quantities of one radar: name -> (value, unit)."""
    profile = schedule.profile
    return {
        "range bin": (100 * profile.range_bin_m, "cm"),
        "largest range": (profile.max_range_m, "m"),
        "centre frequency": (profile.center_frequency_hz / 1e9, "GHz"),
        "bandwidth": (profile.bandwidth_hz / 1e9, "GHz"),
        "burst": (1e3 * schedule.burst_s, "ms"),
        "frame period": (1e3 * schedule.frame_period_s_actual, "ms"),
        "largest speed": (schedule.max_speed_m_s, "m/s"),
        "speed bin": (schedule.speed_bin_m_s, "m/s"),
        "frame": (schedule.frame_bytes / 1e6, "MB"),
        "data rate": (schedule.data_rate_bytes_s / 1e6, "MB/s"),
    }


def describe_rig(rig: Rig) -> list[str]:
    """Lines for people: radars with derived figures, then every rule with formula, measured value and limit."""
    lines = [f"rig {rig.name}: {rig.description}", ""]
    for name, radar in rig.radars.items():
        chip = radar.schedule.profile.chip
        real = "" if chip.complex_samples else ", real samples"
        lines.append(f"{name}: {chip.name}, {radar.schedule.slots} TX x {chip.chips * chip.rx} RX{real}")
        lines += [f"  {key:<18}{value:10.4g} {unit}" for key, (value, unit) in schedule_figures(radar.schedule).items()]
    lines += ["", format_table(rig.constraints())]
    return lines


def rig_as_dict(rig: Rig) -> dict[str, Any]:
    """The same for machines."""
    figures = {
        radar: {key: {"value": value, "unit": unit} for key, (value, unit) in schedule_figures(r.schedule).items()}
        for radar, r in rig.radars.items()
    }
    rules = [asdict(rule) for rule in rig.constraints()]
    return {"rig": rig.name, "config": rig.config_hash.hex(), "radars": figures, "rules": rules}


def pairs(content: dict[str, Any], indent: int = 0) -> Sequence[str]:
    """``key  value`` lines of nested dictionaries."""
    lines: list[str] = []
    for key, value in content.items():
        if isinstance(value, dict):
            lines += [f"{' ' * indent}{key}:", *pairs(value, indent + 2)]
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list | tuple) else value
            lines.append(f"{' ' * indent}{key:<22} {text}")
    return lines
