# SPDX-License-Identifier: Apache-2.0
"""The list of known answers names only tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_every_named_test_exists() -> None:
    document = (ROOT / "docs" / "known_answers.md").read_text(encoding="utf-8")
    files = list((ROOT / "tests").rglob("test_*.py"))
    functions = {name for path in files for name in re.findall(r"def (test_\w+)", path.read_text(encoding="utf-8"))}
    stems = {path.stem for path in files}
    named = set(re.findall(r"\btest_[a-z0-9_]+", document))
    assert len(named) > 30
    assert named <= functions | stems, sorted(named - functions - stems)
    for folder, stem in re.findall(r"`(\w+)/(test_\w+)\.py", document):
        assert (ROOT / "tests" / folder / f"{stem}.py").is_file(), f"{folder}/{stem}.py"
