# SPDX-License-Identifier: Apache-2.0
"""The manifest of a model folder: read strictly, every file checked against its SHA-256.

A folder holds ``manifest.json``, one ONNX file per precision and ``golden.npz``: a known input, each file's answer.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args

from edge.completion.confidence import ConfidenceModel
from edge.errors import ModelError
from edge.resources import shipped_dir

SCHEMA = 2
InputFrame = Literal["object", "line_of_sight", "box"]
INPUT_FRAMES: tuple[InputFrame, ...] = get_args(InputFrame)
FILE_LIMIT_BYTES = 256 * 2**20
"""Larger files are refused before they are read."""

_KEYS: dict[str, dict[str, type | tuple[type, ...]]] = {
    "": {
        "schema": int,
        "name": str,
        "created": str,
        "files": list,
        "default_file": str,
        "classes": list,
        "input": dict,
        "output": dict,
        "rigs": list,
        "golden": dict,
        "confidence": (dict, NoneType),
        "training": dict,
    },
    "files": {"file": str, "sha256": str, "precision": str, "bytes": int},
    "input": {"min_points": int, "max_points": int, "columns": int, "frame": str},
    "output": {"coarse": int, "fine": int},
    "golden": {"file": str, "tolerance_m": dict},
}


@dataclass(frozen=True, slots=True)
class ModelFile:
    """One ONNX file of the folder.

    Args:
        file: plain file name.
        sha256: 64 lower-case hex digits.
        precision: "fp32" or "int8".
        size: bytes.
    """

    file: str
    sha256: str
    precision: str
    size: int


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a model folder promises.

    Args:
        name: of the model.
        files: ONNX files, by name.
        default_file: the one that is run.
        classes: names in the order of the network's probabilities; none: it has no classifier.
        min_points, max_points: input sizes the network was trained on.
        columns: of an input point: x, y, z in metres, and power in dB about the cloud's median if there are four.
        input_frame: frame of its input and output: that of ``edge.completion.sight``, the object frame as the tracker
            gives it, or the object's own box (centre and heading known, lengths in its diagonals).
        coarse_points, fine_points: sizes of the two output clouds.
        rigs: rigs whose clouds the training data are like.
        golden_file: file with the known answers.
        tolerance_m: file name -> largest coordinate difference from the known answer.
        confidence: calibrated confidence and the threshold of "unknown"; None: not calibrated.
    """

    name: str
    files: dict[str, ModelFile]
    default_file: str
    classes: tuple[str, ...]
    min_points: int
    max_points: int
    columns: int
    input_frame: InputFrame
    coarse_points: int
    fine_points: int
    rigs: tuple[str, ...]
    golden_file: str
    tolerance_m: dict[str, float]
    confidence: ConfidenceModel | None = None


def find_model(model: str) -> Path:
    """Folder of a model.

    Args:
        model: name of a folder in ``models/``, or a path to one (``CompletionSettings.model``).
    Returns:
        The folder.
    Raises:
        ModelError: there is none.
    """
    for folder in (shipped_dir("models") / model, Path(model)):
        if (folder / "manifest.json").is_file():
            return folder
    shipped = sorted(path.parent.name for path in shipped_dir("models").glob("*/manifest.json"))
    raise ModelError(
        "setting completion.model names no model folder",
        value=model,
        allowed=f"{', '.join(shipped)}, or the path of a folder with a manifest.json",
    )


def read_manifest(directory: Path) -> Manifest:
    """Read ``manifest.json`` strictly.

    Args:
        directory: model folder.
    Returns:
        The manifest; files are not read yet.
    Raises:
        ModelError: absent, no JSON, another schema, or a key that is unknown, missing or of another type (named).
    """
    path = directory / "manifest.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ModelError(f"{directory}: no manifest.json", action="name a model folder") from error
    except (OSError, ValueError, RecursionError) as error:
        raise _refused(path, "content", str(error), "a JSON object") from error
    if isinstance(content, dict) and content.get("schema") != SCHEMA:
        raise _refused(path, "schema", content.get("schema"), str(SCHEMA))
    top = _section(path, content, "")
    golden, sizes, output = (_section(path, top[key], key) for key in ("golden", "input", "output"))
    entries = [_section(path, entry, "files") for entry in top["files"]]
    manifest = Manifest(
        name=top["name"],
        files={e["file"]: ModelFile(e["file"], e["sha256"], e["precision"], e["bytes"]) for e in entries},
        default_file=top["default_file"],
        classes=tuple(top["classes"]),
        min_points=sizes["min_points"],
        max_points=sizes["max_points"],
        columns=sizes["columns"],
        input_frame=sizes["frame"],
        coarse_points=output["coarse"],
        fine_points=output["fine"],
        rigs=tuple(top["rigs"]),
        golden_file=golden["file"],
        tolerance_m=golden["tolerance_m"],
        confidence=None if top["confidence"] is None else ConfidenceModel.from_dict(top["confidence"]),
    )
    if len(manifest.files) != len(entries):
        raise _refused(path, "files.file", [entry["file"] for entry in entries], "different names")
    _check(path, manifest)
    return manifest


def read_files(directory: Path, manifest: Manifest) -> dict[str, bytes]:
    """Read every ONNX file once and check it; what was checked is what gets loaded.

    Args:
        directory: model folder.
        manifest: of that folder.
    Returns:
        File name -> content.
    Raises:
        ModelError: a file is absent, of another size, or has another SHA-256.
    """
    contents: dict[str, bytes] = {}
    for entry in manifest.files.values():
        path = directory / entry.file
        try:
            size = path.stat().st_size
            content = path.read_bytes() if size == entry.size else b""
        except OSError as error:
            raise ModelError(f"{path}: unreadable model file ({error})", action="install the model again") from error
        if size != entry.size:
            raise _refused(path, "size", f"{size} bytes", f"{entry.size} bytes")
        digest = hashlib.sha256(content).hexdigest()
        if digest != entry.sha256:
            raise _refused(path, "SHA-256", digest, entry.sha256)
        contents[entry.file] = content
    return contents


def _refused(path: Path, what: str, value: object, allowed: str) -> ModelError:
    return ModelError(f"{path}: wrong {what}", value=value, allowed=allowed, action="install the model again")


def _section(path: Path, content: Any, name: str) -> dict[str, Any]:
    """One object of the manifest with exactly its keys, each of its type."""
    if not isinstance(content, dict):
        raise _refused(path, name or "content", type(content).__name__, "a JSON object")
    keys = _KEYS[name]
    prefix = f"{name}." if name else ""
    for label, names in (("unknown", content.keys() - keys.keys()), ("missing", keys.keys() - content.keys())):
        if names:
            raise ModelError(
                f"{path}: {label} key {', '.join(prefix + key for key in sorted(names))}",
                allowed=", ".join(keys),
                action="install the model again",
            )
    for key, kind in keys.items():
        if not isinstance(content[key], kind) or isinstance(content[key], bool):
            raise _refused(path, f"key {prefix}{key}", content[key], str(getattr(kind, "__name__", kind)))
    return content


def _check(path: Path, manifest: Manifest) -> None:
    """Values that contradict each other; each rule with the offending value."""
    names = [*manifest.files, manifest.golden_file]
    sizes = (manifest.min_points, manifest.max_points, manifest.coarse_points, manifest.fine_points)
    hashes = [entry.sha256 for entry in manifest.files.values()]
    texts = [*manifest.classes, *manifest.rigs]
    tolerances = manifest.tolerance_m
    rules: list[tuple[bool, str, object, str]] = [
        (all(re.fullmatch(r"\w[\w.-]*", name) for name in names), "file name", names, "plain file names"),
        (all(re.fullmatch("[0-9a-f]{64}", text) for text in hashes), "files.sha256", hashes, "64 hex digits"),
        (
            all(0 < entry.size <= FILE_LIMIT_BYTES for entry in manifest.files.values()),
            "files.bytes",
            [entry.size for entry in manifest.files.values()],
            f"1..{FILE_LIMIT_BYTES}",
        ),
        (manifest.default_file in manifest.files, "default_file", manifest.default_file, ", ".join(manifest.files)),
        (all(isinstance(t, str) and t for t in texts), "classes and rigs", texts, "names"),
        (
            all(re.fullmatch(r"[a-z0-9_-]{1,32}", str(name)) for name in manifest.classes),
            "classes",
            manifest.classes,
            "lower-case names that can stand in a topic",
        ),
        (
            len(set(map(str, manifest.classes))) == len(manifest.classes),
            "classes",
            manifest.classes,
            "different names",
        ),
        (manifest.input_frame in INPUT_FRAMES, "input.frame", manifest.input_frame, ", ".join(INPUT_FRAMES)),
        (manifest.columns in (3, 4), "input.columns", manifest.columns, "3 or 4"),
        (min(sizes) > 0 and sizes[0] <= sizes[1], "input and output", sizes, "positive, min_points <= max_points"),
        (
            tolerances.keys() == manifest.files.keys()
            and all(isinstance(t, float) and 0 < t < 1 for t in tolerances.values()),
            "golden.tolerance_m",
            tolerances,
            "one number of metres below 1 for every model file",
        ),
    ]
    for holds, what, value, allowed in rules:
        if not holds:
            raise _refused(path, what, value, allowed)
