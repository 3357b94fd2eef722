# SPDX-License-Identifier: Apache-2.0
"""The ``rfconstruct`` command: finds the verb, imports only its module, turns errors into exit codes."""

from __future__ import annotations

import argparse
import difflib
import errno
import importlib
import io
import json
import os
import sys
from collections.abc import Callable, Sequence
from types import ModuleType

from edge.errors import ExitCode, RfconstructError
from edge.version import version

VERBS = {
    "run": "set up a rig's boards, start them interleaved, run the whole pipeline on their frames",
    "demo": "drive past one object (simulated point scatterers), publish its shape, draw pictures",
    "replay": "play a recording through the whole pipeline and publish what comes out",
    "record": "record a rig's raw frames, a running publisher's results, or a part of a recording",
    "recover": "save the whole records of a cut or damaged recording into a good one",
    "export": "turn results into PLY, PCD, NPZ, or an MCAP file that Foxglove and Lichtblick show",
    "view": "show a running pipeline or a recording on a web page of this machine",
    "listen": "print what a running pipeline publishes",
    "import": "turn a TI capture into a recording, or a TI calibration into ours",
    "calibrate": "make a calibration from a corner-reflector capture; align two boards",
    "info": "describe a recording, a rig or a model; rigs with every hardware rule",
    "keys": "make CURVE keys; let subscribers of other machines in, or refuse them",
    "doctor": "check this machine; --warm compiles the kernels before the first start",
    "bench": "time every stage beside a named peer in the same process",
}
INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point.

    Args:
        argv: arguments without the program's name; None: those of the process.
    Returns:
        Exit code: 0 ok, 1 failure, 2 usage, 3 degraded, 4 no hardware, 5 bad configuration, 6 bad model.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names need not be text
    return survived(" ".join(["rfconstruct", *arguments[:1]]), lambda: _dispatch(arguments))


def survived(program: str, work: Callable[[], int]) -> int:
    """Do the work of a command: Ctrl-C, a reader that went away and what the system refuses are no tracebacks.

    Args:
        program: name for the line on stderr.
        work: gives an exit code.
    Returns:
        The work's exit code; 130 after Ctrl-C, 0 when nobody reads any more, 1 after an OSError.
    """
    try:
        code = work()
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        _silence_stdout()
        return ExitCode.OK
    except OSError as error:
        _silence_stdout()
        print(f"{program}: {_refused(error)}", file=sys.stderr)
        return ExitCode.FAILURE


def reported(program: str, as_json: bool, work: Callable[[], int]) -> int:
    """Do the work of a verb; an error becomes one line on stderr, or with ``as_json`` one document on stdout.

    Args:
        program: name for the line on stderr.
        as_json: whether a machine reads.
        work: gives an exit code.
    Returns:
        The work's exit code, or the error's.
    Raises:
        OSError: for ``survived``; with ``as_json`` only BrokenPipeError.
    """
    try:
        return int(work())
    except RfconstructError as error:
        return _report(program, error, as_json)
    except BrokenPipeError:
        raise
    except OSError as error:
        if not as_json:
            raise
        return _report(program, RfconstructError(_refused(error)), as_json)


def _refused(error: OSError) -> str:
    return f"{error.filename or 'output'}: {error.strerror or error}"


def _dispatch(arguments: Sequence[str]) -> int:
    """Find the verb and run it."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(overview())
        return ExitCode.OK if arguments else ExitCode.USAGE
    if arguments[0] in ("-V", "--version"):
        print(f"rfconstruct {version()}")
        return ExitCode.OK
    verb, rest = arguments[0], arguments[1:]
    if verb not in VERBS:
        close = difflib.get_close_matches(verb, VERBS, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        print(f"rfconstruct: unknown command {verb!r}{hint}\ncommands: {', '.join(VERBS)}", file=sys.stderr)
        return ExitCode.USAGE
    return _run(verb, rest)


def overview() -> str:
    """Help that fits a screen."""
    lines = ["usage: rfconstruct COMMAND [options]", "", "commands:"]
    lines += [f"  {verb:<9} {text}" for verb, text in VERBS.items()]
    lines += ["", "rfconstruct COMMAND --help shows the options of one command."]
    lines += ["exit codes: 0 ok, 1 failure, 2 usage, 3 degraded, 4 no hardware, 5 bad configuration, 6 bad model"]
    return "\n".join(lines)


def _run(verb: str, rest: Sequence[str]) -> int:
    module = _command(verb)
    parser = argparse.ArgumentParser(prog=f"rfconstruct {verb}", description=f"{VERBS[verb]}.")
    module.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="machine-readable output on stdout")
    args = parser.parse_args(rest)
    return reported(f"rfconstruct {verb}", args.json, lambda: module.run(args))


def _command(verb: str) -> ModuleType:
    """The verb's module; imported only now, since most verbs need few of the packages."""
    try:
        return importlib.import_module(f"edge.commands.{verb}_command")
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
        raise OSError(errno.EROFS, "set NUMBA_CACHE_DIR to a writable folder", "cache of compiled kernels") from error


def _report(program: str, error: RfconstructError, as_json: bool) -> int:
    if as_json:
        value = None if error.value is None else str(error.value)
        content = {"what": error.what, "value": value, "allowed": error.allowed, "action": error.action}
        print(json.dumps({"error": content, "exit_code": int(error.exit_code)}))
    else:
        print(f"{program}: {error}", file=sys.stderr)
    return int(error.exit_code)


def _silence_stdout() -> None:
    """Nobody reads stdout any more: the interpreter must not fail to flush it when it ends."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    raise SystemExit(main())
