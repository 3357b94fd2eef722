# SPDX-License-Identifier: Apache-2.0
"""docs/troubleshooting.md quotes what the software says, and leaves out no state, reason, cause or exit code."""

from __future__ import annotations

import ast
import re
from functools import cache
from typing import get_args

from doc_commands import FENCE, ROOT

from edge.errors import ExitCode
from edge.frames import LossCause
from edge.service.states import Code
from edge.stream.messages import State

PAGE = FENCE.sub("", (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8"))
FOREIGN = {"Watchdog timeout", "NAME"}
"""Words of systemd."""


@cache
def said() -> str:
    """Every text in the sources, one a line; … for each value put in."""
    texts = [ROOT.joinpath("Makefile").read_text(encoding="utf-8")]
    for folder in ("edge", "train"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            texts += [_text(node) for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    return "\n".join(text for text in texts if text)


def _text(node: ast.AST) -> str:
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=values):
            parts = [str(part.value) if isinstance(part, ast.Constant) else "…" for part in values]
            return re.sub("…+", "…", "".join(parts))
    return ""


def symptoms() -> list[str]:
    """Quotations in the first column of the tables that begin with "you see"."""
    found: list[str] = []
    for table in re.findall(r"^\| you see .*\n\|[-| ]+\n((?:\|.*\n)+)", PAGE, re.MULTILINE):
        for row in table.splitlines():
            found += re.findall(r"`([^`]+)`", row.split("|")[1])
    return found


def test_messages_are_the_softwares_own() -> None:
    quoted = [text for text in symptoms() if text not in FOREIGN and not re.search(r"0\.69|whole False|^rig$", text)]
    assert len(quoted) > 70
    names = {code.lower() for code in Code} | {"info", "record", "client.lost", "--what", "--host", "shed_"}
    missing = [text for text in quoted if text.lower() not in names and text.strip("… ") not in said()]
    assert not missing, "\n".join(missing)


def test_nothing_is_left_out() -> None:
    words = set(re.findall(r"`(\w+)`", PAGE))
    assert {code.name for code in ExitCode} <= words
    assert {str(code) for code in Code} | {str(cause) for cause in LossCause} | set(get_args(State)) <= words
