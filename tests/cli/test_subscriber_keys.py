# SPDX-License-Identifier: Apache-2.0
"""``listen``, ``view`` and ``record`` subscribe with keys to an encrypted address, and say what is wrong with keys."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from cli_run import Outcome, rfconstruct

from edge.commands.subscriber import require_keys, why_refused
from edge.commands.view_command import watch_live
from edge.config import StreamSettings
from edge.errors import ConfigError, ExitCode
from edge.frames import Pose
from edge.stream.client import connect
from edge.stream.keys import KeyFolder, create_client
from edge.stream.publisher import Publisher
from edge.view.health import Banner

FAR = "tcp://192.0.2.1:5600"
POSE = Pose(1, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


@pytest.fixture
def appliance(tmp_path: Path) -> Iterator[str]:
    """An encrypted address that publishes without end; a client ``right`` that is let in, and one ``wrong``."""
    folder = KeyFolder(tmp_path / "keys")
    server = folder.create()
    folder.allow("right", create_client("right", tmp_path, server.public).public)
    create_client("wrong", tmp_path, server.public)
    settings, done = StreamSettings(("tcp://0.0.0.0:*",), key_folder=str(folder.path)), threading.Event()
    with Publisher(settings, bytes(8), bytes(8), "sim") as sender:

        def publish() -> None:
            while not done.wait(0.02):
                sender.pose(POSE)
                sender.heartbeat("RUN")

        thread = threading.Thread(target=publish)
        thread.start()
        yield sender.endpoints[0].replace("0.0.0.0", "127.0.0.1")
        done.set()
        thread.join()


def listen(endpoint: str, *options: object) -> Outcome:
    return rfconstruct("listen", "--endpoint", endpoint, "--topic", "pose", "--json", *options)


def test_listen_receives_with_the_right_keys(appliance: str, tmp_path: Path) -> None:
    outcome = listen(appliance, "--keys", tmp_path / "right.key_secret", "--count", 2, "--timeout", 20)
    assert outcome.code == ExitCode.OK, outcome.err
    assert outcome.out.count('"type": "pose"') == 2
    assert "refuses" not in outcome.err


@pytest.mark.parametrize(("name", "reason"), [("wrong", "not let in"), (None, "wants keys")])
def test_listen_says_that_it_is_refused(appliance: str, tmp_path: Path, name: str | None, reason: str) -> None:
    keys = [] if name is None else ["--keys", tmp_path / f"{name}.key_secret"]
    outcome = listen(appliance, *keys, "--count", 1, "--timeout", 1)
    assert (outcome.code, outcome.out) == (ExitCode.DEGRADED, "")
    assert outcome.err.count("refuses") == 1
    assert reason in outcome.err


def test_keys_at_an_address_without_keys(tmp_path: Path, appliance: str) -> None:
    with (
        Publisher(StreamSettings(("tcp://127.0.0.1:*",)), bytes(8), bytes(8), "sim") as plain,
        connect(plain.endpoints[0], keys=tmp_path / "right.key_secret") as client,
    ):
        assert client.recv(0.5) is None
        assert "without keys" in why_refused(client)


def test_record_receives_with_the_right_keys(appliance: str, tmp_path: Path) -> None:
    out = tmp_path / "results.mcap"
    options = ("--endpoint", appliance, "--keys", tmp_path / "right.key_secret", "--seconds", 0.2)
    outcome = rfconstruct("record", out, "--results", *options, "--timeout", 20, "--json")
    assert outcome.code == ExitCode.OK, outcome.err
    assert outcome.json["written"]["/rig_pose"] > 0


def test_view_receives_with_the_right_keys(
    appliance: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="the viewer needs viser: pip install 'rfconstruct[view]'")
    from edge.commands import view_command

    heard: list[object] = []

    def watch(page: object, client: view_command.Client, stopped: object) -> None:
        heard.append(client.recv(20.0))

    monkeypatch.setattr(view_command, "watch_live", watch)
    options = ("--endpoint", appliance, "--keys", tmp_path / "right.key_secret", "--port", 0)
    outcome = rfconstruct("view", *options)
    assert outcome.code == ExitCode.OK, outcome.err
    assert heard
    assert heard[0] is not None


def test_the_viewer_shows_that_it_is_refused(appliance: str, tmp_path: Path) -> None:
    shown: list[Banner] = []

    class Page:
        def update(self, scene: object, banner: Banner, *rest: object) -> None:
            shown.append(banner)

    end_s = time.monotonic() + 20.0
    with connect(appliance, keys=tmp_path / "wrong.key_secret") as client:

        def stopped() -> bool:
            return bool(shown and shown[-1].state == "REFUSED") or time.monotonic() > end_s

        watch_live(Page(), client, stopped)  # type: ignore[arg-type]
    assert (shown[-1].state, shown[-1].level) == ("REFUSED", "error")
    assert "not let in" in shown[-1].text


@pytest.mark.parametrize("verb", ["listen", "view", "record"])
def test_what_is_wrong_with_keys_is_said_before_anything_is_opened(tmp_path: Path, verb: str) -> None:
    call = ("record", tmp_path / "out.mcap", "--results") if verb == "record" else (verb,)
    secret = tmp_path / "viewer.key_secret"
    absent = rfconstruct(*call, "--endpoint", FAR)
    assert absent.code == ExitCode.BAD_CONFIG
    assert "only with keys" in absent.err
    assert "rfconstruct keys client" in absent.err
    missing = rfconstruct(*call, "--endpoint", FAR, "--keys", secret)
    assert missing.code == ExitCode.BAD_CONFIG
    assert f"{secret} does not exist" in missing.err
    create_client("viewer", tmp_path, KeyFolder(tmp_path / "keys").create().public)
    secret.chmod(0o644)
    opened = rfconstruct(*call, "--endpoint", FAR, "--keys", secret, "--json")
    assert opened.code == ExitCode.BAD_CONFIG
    assert "open to others (mode 0644)" in opened.json["error"]["what"]
    assert f"chmod 600 {secret}" in opened.json["error"]["action"]
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("endpoint", [FAR, "tcp://appliance:5600", "tcp://[2001:db8::1]:5600"])
def test_other_machines_want_keys(endpoint: str) -> None:
    with pytest.raises(ConfigError, match="only with keys"):
        require_keys(endpoint, None)
    require_keys(endpoint, "viewer.key_secret")


@pytest.mark.parametrize("endpoint", ["tcp://127.0.0.1:5600", "tcp://[::1]:1", "tcp://localhost:9", "ipc:///run/x/pub"])
def test_this_machine_wants_none(endpoint: str) -> None:
    require_keys(endpoint, None)
