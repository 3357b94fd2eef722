# SPDX-License-Identifier: Apache-2.0
"""Holds a command of the documents against the program's own parser, without running it."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import re
import tomllib
from functools import cache
from itertools import pairwise

from doc_commands import ROOT, Command

from edge.cli import VERBS
from train.cli import _parser as train_parser

FOREIGN = frozenset(
    {"ssh", "curl", "echo", "ls", "mkdir", "cp", ".", "export", "./subscriber"}
    | {"systemctl", "systemd-analyze", "journalctl", "find"}
)
"""Programs of the system: only files of the project that they name are looked at."""
PROJECT_FILE = re.compile(r"(?:edge|train|tests|examples|docs|systemd|packaging|firmware_cfg|requirements)/[\w/.\-]+")


@cache
def verb_parser(verb: str) -> argparse.ArgumentParser:
    """Of ``rfconstruct VERB``, as ``edge.cli`` builds it, but without abbreviations."""
    parser = argparse.ArgumentParser(prog=f"rfconstruct {verb}", allow_abbrev=False)
    importlib.import_module(f"edge.commands.{verb}_command").add_arguments(parser)
    parser.add_argument("--json", action="store_true")
    return parser


@cache
def training_parser() -> argparse.ArgumentParser:
    """Of ``rfconstruct-train``."""
    return train_parser()


@cache
def targets() -> frozenset[str]:
    """Of the Makefile."""
    return frozenset(re.findall(r"^([\w\-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


@cache
def extras() -> frozenset[str]:
    """That the package offers to pip."""
    return frozenset(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])


def parse(command: Command) -> None:
    """ValueError that says what the program would refuse, or which file or module is not there."""
    words = list(command.words)
    for word in words:
        named = PROJECT_FILE.fullmatch(word.rstrip("/"))
        if named and not (ROOT / named[0]).exists() and not made_by(command, word):
            raise ValueError(f"{command}: no {word}")
    program, rest = words[0], words[1:]
    if program == "rfconstruct":
        _rfconstruct(command, rest)
    elif program == "rfconstruct-train":
        _accepted(command, training_parser(), rest)
    elif program == "torchrun":
        _accepted(command, training_parser(), rest[rest.index("train.cli") + 1 :])
    elif program == "make":
        _require(command, {word for word in rest if "=" not in word} <= targets(), f"targets: {sorted(targets())}")
    elif program == "pip":
        lists = re.findall(r"rfconstruct\[([\w,]+)\]", " ".join(rest))
        _require(command, rest[0] == "install" and set(",".join(lists).split(",")) <= extras(), f"{sorted(extras())}")
    elif program == "python":
        _python(command, rest)
    elif program == "pytest":
        _options_in(command, rest, (ROOT / rest[0] / "conftest.py").read_text(encoding="utf-8"))
    elif program == "packaging/build_deb.sh":
        _options_in(command, rest, (ROOT / program).read_text(encoding="utf-8"))
    elif program != "g++" and not command.as_root:
        _require(command, program in FOREIGN, "a program that this test knows")


def made_by(command: Command, word: str) -> bool:
    """Whether the command makes what the word names."""
    made = ("--out", "--markdown", "--update", "--pictures")
    return any(option in made and value == word for option, value in pairwise(command.words))


def _rfconstruct(command: Command, rest: list[str]) -> None:
    if rest and rest[0] in ("--version", "--help"):
        return
    _require(command, bool(rest) and rest[0] in VERBS, f"verbs: {', '.join(VERBS)}")
    _accepted(command, verb_parser(rest[0]), rest[1:])


def _accepted(command: Command, parser: argparse.ArgumentParser, words: list[str]) -> None:
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            parser.parse_args(words)
    except SystemExit as end:
        if end.code:
            raise ValueError(f"{command}: {said.getvalue().splitlines()[-1]}") from end


def _python(command: Command, rest: list[str]) -> None:
    """A module of the project, or a script whose path was looked at already; its options stand in its text."""
    module = rest[0] == "-m"
    path = ROOT / (rest[1].replace(".", "/") + ".py" if module else rest[0])
    if not path.is_file():
        path = path.with_suffix("") / "__main__.py"
    _require(command, path.is_file(), "a module or script of the project")
    _options_in(command, rest[1 + module :], path.read_text(encoding="utf-8"))


def _options_in(command: Command, words: list[str], text: str) -> None:
    missing = [word for word in words if word.startswith("--") and word.split("=")[0] not in text]
    _require(command, not missing, f"options that the program's text names, not {missing}")


def _require(command: Command, good: bool, allowed: str) -> None:
    if not good:
        raise ValueError(f"{command}; allowed: {allowed}")


def options_of(words: list[str]) -> set[str] | None:
    """Every option that a command of the running text may have; None: no program or verb of ours."""
    if words[0] == "rfconstruct" and words[1] in VERBS:
        return set(verb_parser(words[1])._option_string_actions)
    parser = training_parser()
    for word in words[1:] if words[0] == "rfconstruct-train" else []:
        inner = next((a for a in parser._actions if isinstance(a, argparse._SubParsersAction)), None)
        if inner is None:
            break
        if word not in inner.choices:
            return None
        parser = inner.choices[word]
    return set(parser._option_string_actions) if words[0] == "rfconstruct-train" else None
