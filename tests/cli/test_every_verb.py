# SPDX-License-Identifier: Apache-2.0
"""Every verb of both programs: help that fits a screen, ``--json``, exit codes that are written down."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator

import numpy as np
import pytest
from cli_run import rfconstruct

from edge import cli
from edge.cli import VERBS
from edge.errors import ExitCode
from train.cli import EXIT_CODES, _parser, main
from train.objects import commands
from train.output import emit

SCREEN_LINES = 40
EDGE_SCREEN_LINES = 32
NOT_A_FLAG = {
    "fit": "its result is a checkpoint, and log.jsonl beside it",
    "rig": "runs until Ctrl-C; --write-boards writes what a machine reads",
    "evaluate": "--json FILE writes all figures beside the table",
}


def verbs(parser: argparse.ArgumentParser, name: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Verbs that run something, those inside others too."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    for action in inner:
        for word, verb in action.choices.items():
            yield from verbs(verb, f"{name} {word}".strip())
    if not inner:
        yield name, parser


TRAIN = dict(verbs(_parser()))


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


@pytest.mark.parametrize("verb", VERBS)
def test_rfconstruct(verb: str) -> None:
    text = rfconstruct(verb, "--help").out
    assert text.count("\n") <= EDGE_SCREEN_LINES
    assert "--json" in text


@pytest.mark.parametrize("name", TRAIN)
def test_rfconstruct_train(name: str) -> None:
    text = TRAIN[name].format_help()
    assert text.count("\n") <= SCREEN_LINES
    flags = [action for action in TRAIN[name]._actions if "--json" in action.option_strings and action.nargs == 0]
    assert bool(flags) is (name not in NOT_A_FLAG)


def test_exit_codes_are_in_the_help() -> None:
    text = rfconstruct("--help").out
    for code in ExitCode:
        assert f"{int(code)} " in text.partition("exit codes:")[2]
    assert "exit codes: 0 ok" in EXIT_CODES
    assert "130 interrupted" in " ".join(_parser().format_help().split())


def test_errors_are_documents_too(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["objects", "list", "--objects", "/nonexistent", "--json"])
    error = json.loads(capsys.readouterr().out)
    assert code == error["exit_code"] != 0
    assert error["error"]["what"]


@pytest.mark.parametrize(("error", "code", "told"), [
    (KeyboardInterrupt(), 130, "rfconstruct-train: interrupted\n"),
    (BrokenPipeError(), 0, ""),
    (OSError(28, "Disk full", "/disk/file"), 1, "rfconstruct-train: /disk/file: Disk full\n"),
    (OSError(28, "Disk full"), 1, "rfconstruct-train: output: Disk full\n"),
])  # fmt: skip
def test_what_the_system_refuses_is_no_traceback(
    error: BaseException, code: int, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(commands, "_chosen", fail)
    monkeypatch.setattr(cli, "_silence_stdout", lambda: None)
    assert main(["objects", "list"]) == code
    assert capsys.readouterr() == ("", told)
    if type(error) is OSError:
        assert main(["objects", "list", "--json"]) == code
        document = json.loads(capsys.readouterr().out)
        assert document["exit_code"] == code
        assert f"rfconstruct-train: {document['error']['what']}\n" == told


def test_what_a_machine_reads_is_strict_json(capsys: pytest.CaptureFixture[str]) -> None:
    content = {"spacing_m": float("nan"), "rows": (np.int64(1), np.float32(0.5)), "ok": True, "none": None}
    emit(argparse.Namespace(json=True), content, ["for people"])
    text = capsys.readouterr().out
    assert json.loads(text, parse_constant=lambda name: 1 / 0) == {
        "spacing_m": None, "rows": [1, 0.5], "ok": True, "none": None
    }  # fmt: skip
    emit(argparse.Namespace(json=False), content, ["for people"])
    assert capsys.readouterr().out == "for people\n"
