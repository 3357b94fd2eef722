# SPDX-License-Identifier: Apache-2.0
"""Everything a user can get wrong is one clear line and a documented exit code, never a traceback."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli_run import rfconstruct, write_recording

from edge import cli
from edge.commands import info_command
from edge.errors import ExitCode
from edge.rig import known_rigs

RADAR_VERBS = ("demo", "replay", "record", "recover", "export", "listen", "import", "info", "bench")
USAGE = [
    ("replay",),
    ("replay", "x.mcap", "--speed", "fast"),
    ("replay", "x.mcap", "--speed", "-1"),
    ("replay", "x.mcap", "--speed", "nan"),
    ("replay", "x.mcap", "--speed", "1e-9"),
    ("replay", "x.mcap", "--no-such-option"),
    ("listen", "--timeout", "nan"),
    ("listen", "--timeout", "0"),
    ("listen", "--count", "0"),
    ("listen", "--count", "-3"),
    ("listen", "--topic", "shapes"),
    ("bench", "--seconds", "inf"),
    ("bench", "--seconds", "-1"),
    ("import", "x"),
    ("import", "x", "--rig", "corridor", "--out", "o", "--start-ns", "-1"),
    ("import", "x", "--rig", "corridor", "--out", "o", "--start-ns", "99999999999999999999"),
    ("import", "x", "--rig", "corridor", "--out", "o", "--poses-of", "wheel"),
    ("info",),
]
REFUSED = [
    (("replay", "{tmp}/none.mcap"), 1, "give an .mcap file or a capture folder"),
    (("replay", "/dev/null"), 1, "no such recording"),
    (("replay", "{tmp}/fifo"), 1, "no such recording"),
    (("replay", "{tmp}/empty.mcap"), 1, "no MCAP file"),
    (("replay", "{tmp}/text.mcap"), 1, "no MCAP file"),
    (("replay", "{tmp}"), 5, "--rig"),
    (("replay", "{tmp}", "--rig", "corridor"), 1, "no capture in this folder"),
    (("replay", "{tmp}", "--rig", "cascade_demo"), 1, "rfconstruct import"),
    (("replay", "{tmp}", "--rig", "nowhere"), 5, "cascade_demo"),
    (("replay", "{rec}", "--calibration", "x.npz"), 5, "horizontal=PATH or vertical=PATH"),
    (("replay", "{rec}", "--calibration", "vertical={tmp}/text.mcap"), 5, "not a calibration"),
    (("replay", "{rec}", "--endpoint", "nonsense"), 5, "tcp://127.0.0.1:PORT"),
    (("replay", "{rec}", "--endpoint", "tcp://0.0.0.0:5600"), 5, "only with keys"),
    (("replay", "{rec}", "--endpoint", "ipc://{tmp}/no/folder"), 5, "cannot be bound"),
    (("replay", "{rec}", "--endpoint", "ipc://{tmp}/text.mcap"), 5, "would delete the file"),
    (("replay", "{rec}", "--endpoint", "tcp://127.0.0.1:{port}"), 5, "stop the other publisher"),
    (("replay", "{rec}", "--no-publish", "--plot", "{tmp}/text.mcap"), 1, "writable folder"),
    (("replay", "{rec}", "--no-publish", "--plot", "/proc/pictures"), 1, "writable folder"),
    (("listen", "--endpoint", "nonsense"), 5, "tcp://HOST:PORT"),
    (("listen", "--save", "{tmp}/text.mcap", "--timeout", "0.1"), 1, "cannot be saved"),
    (("import", "{tmp}/none", "--out", "{tmp}/o.mcap"), 5, "--rig"),
    (("import", "{tmp}/none", "--rig", "corridor", "--out", "{tmp}/o.mcap"), 1, "no capture folder"),
    (("import", "a", "b", "--rig", "corridor", "--out", "{tmp}/o.mcap"), 5, "one for each radar"),
    (("import", "a", "--rig", "cascade_demo", "--out", "{tmp}/o.mcap"), 5, "horizontal=PATH"),
    (("import", "horizontal={tmp}", "--rig", "cascade_demo", "--out", "{tmp}/o.mcap"), 1, "one capture for each"),
    (("import", "{tmp}", "--rig", "corridor", "--out", "{tmp}/text.mcap"), 5, "nothing is overwritten"),
    (("import", "{tmp}", "--rig", "corridor", "--poses", "{tmp}/no.csv", "--out", "{tmp}/o.mcap"), 1, "no.csv"),
    (("import", "{tmp}/no.mat", "--rig", "corridor", "--out", "{tmp}/o.npz"), 5, "no such calibration"),
    (("info", "nothing"), 5, "a recording, a capture folder, a rig (awr1843_pair"),
    (("info", "{tmp}/text.mcap"), 1, "no MCAP file"),
    (("info", "{tmp}"), 5, "or a model (default"),
    (("bench", "--rig", "corridor"), 5, "two cascade radars"),
    (("bench", "--rig", "nowhere"), 5, "no rig nowhere"),
]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("errors")
    recording = write_recording(tmp_path_factory.mktemp("recordings") / "drive.mcap")
    (folder / "empty.mcap").write_bytes(b"")
    (folder / "text.mcap").write_text("no recording")
    os.mkfifo(folder / "fifo")
    return {"tmp": str(folder), "rec": str(recording)}


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield taken.getsockname()[1]


@pytest.mark.parametrize("argv", USAGE, ids=" ".join)
def test_what_cannot_be_meant_is_usage(argv: tuple[str, ...]) -> None:
    outcome = rfconstruct(*argv)
    assert (outcome.code, outcome.out) == (ExitCode.USAGE, "")
    assert "error:" in outcome.err.splitlines()[-1]


@pytest.mark.parametrize(
    ("argv", "code", "what"), REFUSED, ids=lambda value: " ".join(value) if isinstance(value, tuple) else str(value)
)
def test_what_cannot_work_is_one_line(
    argv: tuple[str, ...], code: int, what: str, places: dict[str, str], taken_port: int
) -> None:
    filled = [argument.format(**places, port=taken_port) for argument in argv]
    told = rfconstruct(*filled)
    assert told.code == code
    assert told.err.count("\n") == 1
    assert told.err.startswith(f"rfconstruct {argv[0]}: ")
    assert what in told.err
    as_json = rfconstruct(*filled, "--json")
    assert (as_json.code, as_json.err) == (code, "")
    assert as_json.json["exit_code"] == code
    assert what in " ".join(str(part) for part in as_json.json["error"].values())
    assert Path(places["tmp"], "text.mcap").read_text() == "no recording"


def test_unknown_verbs_get_a_proposal() -> None:
    outcome = rfconstruct("repaly", "x.mcap")
    assert outcome.code == ExitCode.USAGE
    assert "did you mean replay?" in outcome.err


@pytest.mark.parametrize("argv", [("--help",), *((verb, "--help") for verb in RADAR_VERBS)], ids=" ".join)
def test_help_fits_a_screen(argv: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    outcome = rfconstruct(*argv)
    assert outcome.code == ExitCode.OK
    assert outcome.out.count("\n") <= 24
    assert max(map(len, outcome.out.splitlines())) <= (100 if len(argv) == 1 else 80)


def test_no_arguments_and_version() -> None:
    assert rfconstruct().code == ExitCode.USAGE
    assert rfconstruct("--version").out.startswith("rfconstruct ")


@pytest.mark.parametrize(("error", "code", "told"), [
    (KeyboardInterrupt(), 130, "rfconstruct info: interrupted\n"),
    (OSError(28, "Disk full", "/disk/file"), 1, "rfconstruct info: /disk/file: Disk full\n"),
])  # fmt: skip
def test_interrupts_and_full_disks(error: BaseException, code: int, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(args: object) -> int:
        raise error

    monkeypatch.setattr(info_command, "run", fail)
    monkeypatch.setattr(cli, "_silence_stdout", lambda: None)
    outcome = rfconstruct("info", "corridor")
    assert (outcome.code, outcome.out, outcome.err) == (code, "", told)


def test_a_read_only_installation_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise RuntimeError("cannot cache function 'f': no locator available for file 'kernels.py'")

    monkeypatch.setattr("importlib.import_module", fail)
    monkeypatch.setattr(cli, "_silence_stdout", lambda: None)
    outcome = rfconstruct("bench")
    assert outcome.code == ExitCode.FAILURE
    assert outcome.err == "rfconstruct bench: cache of compiled kernels: set NUMBA_CACHE_DIR to a writable folder\n"


def test_pictures_without_matplotlib(places: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    outcome = rfconstruct("replay", places["rec"], "--no-publish", "--speed", "max", "--plot", places["tmp"])
    assert outcome.code == ExitCode.USAGE
    assert outcome.err == "rfconstruct replay: pictures need matplotlib; pip install 'rfconstruct[plot]'\n"
    assert rfconstruct("replay", places["rec"], "--no-publish", "--speed", "max").code == ExitCode.OK


@pytest.mark.parametrize(("stdout", "code"), [("closed pipe", 0), ("/dev/full", 1)])
def test_nobody_reads_the_output(stdout: str, code: int) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    full = os.open("/dev/full", os.O_WRONLY)
    command = [sys.executable, "-m", "edge", "info", "corridor"]
    done = subprocess.run(
        command, stdout=writer if stdout == "closed pipe" else full, stderr=subprocess.PIPE, check=False
    )
    os.close(writer)
    os.close(full)
    assert done.returncode == code
    assert b"Traceback" not in done.stderr
    assert b"Exception ignored" not in done.stderr


def test_silence_ends_listening() -> None:
    endpoint = ("--endpoint", "tcp://127.0.0.1:1", "--timeout", "0.1")
    told = rfconstruct("listen", *endpoint)
    assert (told.code, told.out, told.err) == (ExitCode.DEGRADED, "", "waiting for tcp://127.0.0.1:1\n")
    assert rfconstruct("listen", "--count", "1", *endpoint).code == ExitCode.DEGRADED
    as_json = rfconstruct("listen", "--json", *endpoint)
    assert (as_json.code, as_json.out, as_json.err) == (ExitCode.DEGRADED, "", "")


def test_an_address_in_use_is_named_once(taken_port: int, places: dict[str, str]) -> None:
    told = rfconstruct("replay", places["rec"], "--endpoint", f"tcp://127.0.0.1:{taken_port}").err
    assert told.count(f"127.0.0.1:{taken_port}") == 1
    assert "Address already in use" in told


@pytest.mark.parametrize(("verb", "default"), [("replay", "1"), ("demo", "1"), ("listen", "tcp://127.0.0.1:5600")])
def test_defaults_are_called_so(verb: str, default: str) -> None:
    assert f"(default: {default})" in " ".join(rfconstruct(verb, "--help").out.split())


def test_rigs_and_models_are_described() -> None:
    rig = rfconstruct("info", "corridor", "--json").json
    assert rig["rig"] == "corridor"
    assert {rule["severity"] for rule in rig["rules"]} <= {"error", "warning", "info"}
    assert rfconstruct("info", "default", "--json").json["model"] == "default"
    assert "T - slots L Tc" in rfconstruct("info", "corridor").out


@pytest.mark.parametrize("name", known_rigs())
def test_every_shipped_rig_can_be_described(name: str) -> None:
    outcome = rfconstruct("info", name)
    assert outcome.code == ExitCode.OK
    assert ("real samples" in outcome.out) == (name == "awr2944_pair")
