# SPDX-License-Identifier: Apache-2.0
"""Commands of the documents: those in fenced blocks, word by word, and those in running text."""

from __future__ import annotations

import re
import shlex
import textwrap
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", ROOT / "firmware_cfg" / "README.md", *sorted((ROOT / "docs").glob("*.md")))
SHELLS = ("sh", "bash", "console")
"""Kinds of blocks that hold commands and nothing else."""
PROGRAMS = frozenset(
    {"rfconstruct", "rfconstruct-train", "make", "python", "pytest", "pip", "torchrun", "g++", "./subscriber", "ssh"}
    | {"sudo", "curl", "echo", "ls", "cp", "mkdir", ".", "export", "systemctl", "systemd-analyze", "journalctl", "find"}
    | {"packaging/build_deb.sh"}
)
"""First words that make a block without a kind one of commands."""
FENCE = re.compile(r"^([ ]*)```(\w*)\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
ASSIGNMENT = re.compile(r"[A-Z_]+=")
SEPARATORS = frozenset({"&&", "|", ";", "&"})


@dataclass(frozen=True)
class Command:
    """One command of a page.

    Args:
        page: relative to the project.
        words: program first; without sudo, prompt, folder of the virtual environment and the shell's variables.
        as_root: stood behind sudo.
    """

    page: str
    words: tuple[str, ...]
    as_root: bool = False

    def __str__(self) -> str:
        return f"{self.page}: {shlex.join(self.words)}"


def commands(page: Path) -> list[Command]:
    """Every command in the fenced blocks of a page, in order. ValueError: a block of a shell holds something else."""
    text, found = page.read_text(encoding="utf-8"), list[Command]()
    for indent, kind, body in FENCE.findall(text):
        lines = _lines(textwrap.dedent(body) if indent else body, kind)
        variables: dict[str, str] = {}
        for line in lines:
            for words in _split(_expanded(line, variables)):
                found += _command(page.relative_to(ROOT).as_posix(), words, variables)
    return found


def spans(page: Path) -> list[str]:
    """Every piece of code in the running text of a page."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]


def links(page: Path) -> list[str]:
    """Targets of a page's links and pictures, those of other sites left out."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    return [to for to in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in to]


def anchors(page: Path) -> set[str]:
    """Names that a page's headings can be reached by."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def _lines(body: str, kind: str) -> list[str]:
    """Whole lines of commands; none when the block shows something else. With prompts, the lines behind them."""
    lines = [line for line in body.replace("\\\n", " ").splitlines() if line.strip()]
    if kind not in ("", *SHELLS) or not lines:
        return []
    if lines[0].startswith("$ "):
        return [line[2:] for line in lines if line.startswith("$ ")]
    return lines if kind in SHELLS or _first(lines[0]) in PROGRAMS or ASSIGNMENT.match(lines[0]) else []


def _first(line: str) -> str:
    return line.split()[0].removeprefix(".venv/bin/")


def _expanded(line: str, variables: dict[str, str]) -> str:
    """The line with the block's own variables put in; the environment's stay."""
    return re.sub(r"\$(\w+)", lambda name: variables.get(name[1], name[0]), line)


def _split(line: str) -> list[list[str]]:
    """The commands of a line, which ``&&``, ``|``, ``;`` and ``&`` separate, as words."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;")
    lexer.whitespace_split = True
    lists: list[list[str]] = [[]]
    for word in lexer:
        if word in SEPARATORS:
            lists.append([])
        else:
            lists[-1].append(word)
    return [words for words in lists if words]


def _command(page: str, words: list[str], variables: dict[str, str]) -> list[Command]:
    """None for an assignment, which is kept; ValueError for a word that is no program known here."""
    while words and ASSIGNMENT.match(words[0]):
        name, _, value = words.pop(0).partition("=")
        variables[name] = value
    as_root = bool(words) and words[0] == "sudo"
    if as_root:
        words = words[3:] if words[1] == "-u" else words[1:]
    if not words:
        return []
    program = words[0].removeprefix(".venv/bin/")
    if not as_root and program not in PROGRAMS:
        raise ValueError(f"{page}: a block of commands holds {shlex.join(words)}")
    return [Command(page, (program, *words[1:]), as_root)]
