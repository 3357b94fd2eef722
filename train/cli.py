# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train``: simulate data, fit a network, evaluate a model, export a checkpoint to a model folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from edge.cli import reported, survived
from train.bench_completion import add_verb as add_completion_bench_verb
from train.evaluate_command import add_verb as add_evaluate_verb
from train.export_command import add_verb as add_export_verb
from train.fit_command import add_verb as add_fit_verb
from train.objects.commands import add_verbs as object_verbs
from train.simulate.bench_command import add_verb as add_bench_verb
from train.simulate.command import add_verb
from train.simulate.look_command import add_verbs as add_look_verbs
from train.simulate.rig_command import add_verb as add_rig_verb
from train.simulate.street_command import add_verb as add_street_verb

EXIT_CODES = (
    "exit codes: 0 ok, 1 failure, 2 usage, 3 degraded (something is missing from the result), 5 bad configuration, "
    "6 bad model, 130 interrupted"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns an exit code of ``edge.errors.ExitCode``."""
    return survived("rfconstruct-train", lambda: _dispatch(arguments))


def _dispatch(arguments: Sequence[str] | None) -> int:
    options = _parser().parse_args(arguments)
    options.own_process = arguments is None
    return reported("rfconstruct-train", getattr(options, "json", None) is True, lambda: options.run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="rfconstruct-train", description=__doc__, epilog=EXIT_CODES)
    verbs = parser.add_subparsers(required=True, metavar="verb")
    add_fit_verb(verbs)
    add_verb(verbs)
    add_rig_verb(verbs)
    add_street_verb(verbs)
    add_bench_verb(verbs)
    add_look_verbs(verbs)
    add_evaluate_verb(verbs)
    add_export_verb(verbs)
    add_completion_bench_verb(verbs)
    object_verbs(verbs)
    return parser


if __name__ == "__main__":
    sys.exit(main())
