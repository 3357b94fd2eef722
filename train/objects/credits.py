# SPDX-License-Identifier: Apache-2.0
"""Licence, attribution and source group of a mesh file, from what lies beside it or inside it."""

from __future__ import annotations

import csv
import json
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_LICENCE_FILES = ("LICENSE*", "LICENCE*", "COPYING*", "license*", "licence*")
_TAG = re.compile(r"SPDX-License-Identifier:\s*(?P<licence>[^\s*#/<>]+)")
_HOLDER = re.compile(r"(?:SPDX-FileCopyrightText:|Copyright(?: \(c\)| ©)?)\s*(?P<holder>.+)", re.IGNORECASE)
_KNOWN = (
    ("CC0 1.0", "CC0-1.0"), ("Attribution-ShareAlike 4.0", "CC-BY-SA-4.0"), ("Attribution-NonCommercial", "CC-BY-NC"),
    ("Attribution 4.0", "CC-BY-4.0"), ("Attribution 3.0", "CC-BY-3.0"), ("Apache License", "Apache-2.0"),
    ("MIT License", "MIT"), ("GNU GENERAL PUBLIC LICENSE", "GPL"),
)  # fmt: skip
UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Credit:
    """What redistribution of a derived work owes.

    Args:
        licence: SPDX name where it is known, else the source's own words.
        attribution: author, title or copyright line.
        group: author or project, "" = not stated.
        sidecar: the file that says so, None = nothing found.
        grade: how sure that is: A explicit, B an uploader's tag, C nothing found, or what a manifest says.
    """

    licence: str = UNKNOWN
    attribution: str = ""
    group: str = ""
    sidecar: Path | None = None
    grade: str = "C"


def find_credit(path: Path, root: Path, manifest: dict[str, dict[str, str]]) -> Credit:
    """The most specific statement there is: manifest line, ``<file>.license``, glTF asset, LICENSE file further up.

    Args:
        path: the mesh. root: folder of the import; nothing above it is looked at.
        manifest: of ``read_credit_manifest``.
    """
    row = manifest.get(path.relative_to(root).as_posix())
    if row:
        licence, attribution = row.get("licence") or row.get("license") or UNKNOWN, row.get("attribution") or ""
        return Credit(
            licence,
            attribution,
            row.get("source_group") or "",
            root / "manifest.csv",
            row.get("provenance_grade") or "A",
        )
    own = path.with_name(path.name + ".license")
    if own.is_file():
        return _from_text(own)
    asset = gltf_asset(path)
    if asset.get("copyright") or asset.get("license"):
        author = str(asset.get("author") or asset.get("copyright") or "")
        words = (asset.get("title"), author, asset.get("source"))
        attribution = ", ".join(str(word) for word in words if word)
        return Credit(_spdx(str(asset.get("license") or asset.get("copyright"))), attribution, author, path, "B")
    for folder in [path.parent, *path.parent.parents]:
        for pattern in _LICENCE_FILES:
            for file in sorted(folder.glob(pattern)):
                if file.is_file():
                    return _from_text(file)
        if folder == root:
            break
    return Credit()


def read_credit_manifest(root: Path) -> dict[str, dict[str, str]]:
    """Lines of ``manifest.csv`` in the folder, if there is one, by their column ``file`` (path below the folder)."""
    manifest = root / "manifest.csv"
    if not manifest.is_file():
        return {}
    with manifest.open(newline="", encoding="utf-8") as lines:
        return {row["file"]: row for row in csv.DictReader(lines) if row.get("file")}


def gltf_asset(path: Path) -> dict[str, Any]:
    """``asset`` of a GLTF or GLB file with its ``extras`` (author, license, title, source); empty for anything else."""
    suffix = path.suffix.lower()
    if suffix not in (".gltf", ".glb"):
        return {}
    try:
        raw = path.read_bytes()
        if suffix == ".glb":
            (length,) = struct.unpack_from("<I", raw, 12)
            raw = raw[20 : 20 + length]
        asset = json.loads(raw).get("asset", {})
        return {**asset, **(asset.get("extras") or {})}
    except (OSError, ValueError, TypeError, AttributeError, struct.error):
        return {}  # the reader of the mesh says what is wrong with the file


def _from_text(file: Path) -> Credit:
    text = file.read_text(encoding="utf-8", errors="replace")
    holder = _HOLDER.search(text)
    attribution = holder["holder"].strip() if holder else ""
    return Credit(_spdx(text), attribution, "", file, "A")


def _spdx(text: str) -> str:
    tag = _TAG.search(text)
    if tag:
        return tag["licence"]
    for words, name in _KNOWN:
        if words.lower() in text.lower():
            return name
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[0][:80] if lines else UNKNOWN
