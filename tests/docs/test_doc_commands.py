# SPDX-License-Identifier: Apache-2.0
"""Every command, option, file and link that the documents name is real; the cheap commands run, in their order."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from doc_commands import PAGES, ROOT, Command, anchors, commands, links, spans
from doc_fates import fate
from doc_parsers import PROJECT_FILE, options_of, parse

sys.path += [str(ROOT / "tests" / name) for name in ("cli", "stream", "view")]

from cli_run import rfconstruct, write_recording
from stream_sockets import Raw
from view_samples import BOOT, block, drive

from edge.recording.writer import RecordingWriter
from edge.stream.wire import Stamp, pack
from train.cli import main as train_main

ALL = [command for page in PAGES for command in commands(page)]
TOPICS = {"det": "detections", "heat": "heatmap", "pose": "rig_pose"}
BOARDS = '[pose]\nkind = "none"\n'


def test_every_command_is_accepted_by_its_program() -> None:
    assert len(ALL) > 130
    wrong = []
    for command in ALL:
        try:
            parse(command)
            test = fate(command)
            assert not test.startswith("tests/") or (ROOT / test.split(";")[0]).is_file(), test
        except ValueError as error:
            wrong.append(str(error))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "words",
    ["rfconstruct replay x.mcap --sped 2", "rfconstruct play x.mcap", "rfconstruct-train fit", "make all",
     "pip install 'rfconstruct[gpu]'", "python examples/nothing.py", "rfconstruct info firmware_cfg/nothing"],
)  # fmt: skip
def test_wrong_commands_are_noticed(words: str) -> None:
    with pytest.raises(ValueError, match=words.split()[0]):
        parse(Command("page", tuple(words.replace("'", "").split())))


def test_commands_of_the_running_text_have_these_options() -> None:
    wrong = []
    for page in PAGES:
        for span in spans(page):
            words = span.removeprefix("sudo ").split()
            if words[0] not in ("rfconstruct", "rfconstruct-train") or len(words) == 1 or not words[1].islower():
                continue
            known = options_of(words)
            given = {word.split("=")[0].rstrip(",") for word in words if word.startswith("--") and word != "--help"}
            if known is None or not given <= known | {"--json"}:
                wrong.append(f"{page.name}: {span}")
    assert not wrong, "\n".join(wrong)


def test_files_and_links_are_there() -> None:
    dead = []
    for page in PAGES:
        dead += [f"{page.name}: {to}" for to in links(page) if not reached(page, to)]
        files = [span for span in spans(page) if PROJECT_FILE.fullmatch(span) and "." in span]
        dead += [f"{page.name}: {file}" for file in files if not (ROOT / file).exists()]
    for example in (ROOT / "examples").glob("*.py"):
        told = re.findall(r"python (\S+\.py)", ast.get_docstring(ast.parse(example.read_text(encoding="utf-8"))) or "")
        dead += [f"{example.name}: {told}"] if told != [f"examples/{example.name}"] else []
    assert not dead, "\n".join(dead)


def reached(page: Path, to: str) -> bool:
    """Whether a link leads to a file, and to a heading in it."""
    file, _, heading = to.partition("#")
    target = page.parent / file if file else page
    return target.exists() and (not heading or heading in anchors(target))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the commands find: recordings of frames and of results, boards, meshes, the project's folders."""
    import trimesh

    here = tmp_path_factory.mktemp("reader")
    (here / "models").mkdir()
    for link, target in (("firmware_cfg", "firmware_cfg"), ("examples", "examples"), ("models/own", "models/default")):
        (here / link).symlink_to(ROOT / target)
    write_recording(here / "raw.mcap")
    with RecordingWriter(here / "recorded.mcap", None) as writer:
        for draft in drive(0.5):
            kind = draft.topic.split("/")[1]
            writer.message(f"/{TOPICS.get(kind, kind)}", block(draft), draft.t_ns)
    for name in ("my.toml", "b.toml"):
        (here / name).write_text(BOARDS)
    for name, extents in (("car", (4.3, 1.8, 1.5)), ("pedestrian", (0.4, 0.5, 1.7))):
        (here / "meshes" / name).mkdir(parents=True)
        trimesh.creation.box(extents).export(here / "meshes" / name / "one.obj")
    return here


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """Address of a publisher that repeats a short drive."""
    sender, done, sent = Raw(), threading.Event(), Counter[str]()

    def publish() -> None:
        while not done.wait(0.05):
            for draft in drive(0.5):
                stamp = Stamp(BOOT, sent[draft.topic], draft.t_ns, 0, True, "sim", bytes(8), bytes(8))
                sender.send(pack(draft, stamp))
                sent[draft.topic] += 1
            sender.heartbeat()

    thread = threading.Thread(target=publish)
    thread.start()
    yield sender.endpoints[0]
    done.set()
    thread.join()
    sender.close()


def limited(words: tuple[str, ...], endpoint: str) -> tuple[str, ...]:
    """The command with an address of its own and an end."""
    match words[:3]:
        case ("rfconstruct", "listen", *_):
            return (*words, "--endpoint", endpoint, "--count", "1", "--timeout", "20")
        case ("rfconstruct", "record", *_):
            return (*words, "--endpoint", endpoint, "--seconds", "0.7", "--timeout", "20")
        case ("rfconstruct", "replay", *_) if "--no-publish" not in words:
            return (*words, "--endpoint", "tcp://127.0.0.1:*", "--speed", "max")
    return words


def pages_that_run() -> list[str]:
    return sorted({command.page for command in ALL if fate(command) == "here"})


@pytest.mark.parametrize("page", pages_that_run())
def test_cheap_commands_run(page: str, folder: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("RFCONSTRUCT_DATA", str(folder / "own"))
    mine = [command for command in ALL if command.page == page and fate(command) == "here"]
    (folder / "results.mcap").unlink(missing_ok=True)
    if not any(command.words[1] == "record" for command in mine):
        (folder / "results.mcap").symlink_to(folder / "recorded.mcap")
    for command in mine:
        words = limited(command.words, endpoint)
        if words[0] == "rfconstruct":
            outcome = rfconstruct(*words[1:])
            port_taken = words == ("rfconstruct", "doctor") and re.search(r"^fails port", outcome.out, re.MULTILINE)
            assert outcome.code == (3 if port_taken else 0), (command, outcome.out, outcome.err)
        elif words[0] == "rfconstruct-train":
            assert train_main(words[1:]) == 0, command
        else:
            subprocess.run(words, check=True, timeout=20)
