# SPDX-License-Identifier: Apache-2.0
"""Who receives anything from an address that other machines reach: every row of the table of CURVE's pitfalls."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq
from stream_samples import pose
from stream_sockets import WAIT_S, publisher

from edge import connect
from edge.config import StreamSettings
from edge.errors import ConfigError
from edge.stream.client import Client
from edge.stream.keys import KeyFolder, create_client, read_secret
from edge.stream.messages import PoseMessage
from edge.stream.outlet import Outlet
from edge.stream.publisher import AUTHENTICATOR_DIED, Publisher

ENOUGH = 40
"""Messages given to a subscriber that must not get one of them."""


@pytest.fixture
def keys(tmp_path: Path) -> KeyFolder:
    """An appliance's keys, and the files of two clients beside them: ``right`` is let in, ``wrong`` is not."""
    folder = KeyFolder(tmp_path / "keys")
    server = folder.create()
    folder.allow("right", create_client("right", tmp_path, server.public).public)
    create_client("wrong", tmp_path, server.public)
    return folder


@pytest.fixture
def remote(keys: KeyFolder) -> Iterator[Publisher]:
    settings = StreamSettings(("tcp://127.0.0.1:*", "tcp://0.0.0.0:*"), key_folder=str(keys.path))
    with publisher(settings) as sender:
        yield sender


def reached(sender: Publisher) -> str:
    """The encrypted address as a client on this machine reaches it."""
    return sender.endpoints[1].replace("0.0.0.0", "127.0.0.1")


def until(condition: Callable[[], bool], sender: Publisher) -> bool:
    """Publish until something holds, twenty seconds at most."""
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        sender.pose(pose())
        if condition():
            return True
        time.sleep(0.005)
    return False


def receives(client: Client) -> Callable[[], bool]:
    return lambda: isinstance(client.recv(0.0), PoseMessage)


def counted(sender: Publisher, at_least: int) -> Callable[[], bool]:
    return lambda: sender.auth_failures >= at_least


def test_the_right_key_receives(remote: Publisher, tmp_path: Path) -> None:
    with connect(reached(remote), ("pose",), keys=tmp_path / "right.key_secret") as client:
        assert until(receives(client), remote)
    assert remote.auth_failures == 0
    assert not remote.fault


def test_a_wrong_key_receives_nothing_and_is_counted(remote: Publisher, tmp_path: Path) -> None:
    with connect(reached(remote), ("pose",), keys=tmp_path / "wrong.key_secret") as client:
        assert until(counted(remote, 1), remote)
        for _ in range(ENOUGH):
            remote.pose(pose())
        assert client.recv(0.1) is None


def test_a_plain_client_receives_nothing_and_is_counted(remote: Publisher) -> None:
    with connect(reached(remote), ("pose",)) as client:
        assert until(counted(remote, 1), remote)
        assert client.recv(0.1) is None


def test_a_client_of_another_appliance_receives_nothing(remote: Publisher, tmp_path: Path) -> None:
    other = KeyFolder(tmp_path / "other").create()
    remote_keys = KeyFolder(tmp_path / "keys")
    remote_keys.allow("lost", create_client("lost", tmp_path, other.public).public)
    with connect(reached(remote), ("pose",), keys=tmp_path / "lost.key_secret") as client:
        for _ in range(ENOUGH):
            remote.pose(pose())
        assert client.recv(0.3) is None


def test_without_authenticator_nobody_receives(keys: KeyFolder, tmp_path: Path) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    outlet = Outlet(context, 32, keys.server())
    outlet.bind(("tcp://127.0.0.1:*",))
    with connect(outlet.endpoints[0], keys=tmp_path / "right.key_secret") as client:
        for _ in range(ENOUGH):
            outlet.send([b"1/hb/", b"x"])
            time.sleep(0.005)
        assert client.recv(0.1) is None
        assert client.malformed == 0
        assert outlet.subscriptions() == []
    outlet.close()
    context.term()


def test_when_the_authenticator_dies_nobody_new_comes_in_and_the_address_is_closed(
    remote: Publisher, tmp_path: Path
) -> None:
    endpoint, local = reached(remote), remote.endpoints[0]
    assert remote._authenticator is not None
    remote._authenticator.stop()
    assert not remote._authenticator.alive
    with connect(endpoint, ("pose",), keys=tmp_path / "right.key_secret") as client, connect(local, ("pose",)) as near:
        assert until(lambda: bool(remote.fault), remote)
        assert remote.fault == AUTHENTICATOR_DIED
        assert remote.endpoints == (local,)
        assert until(receives(near), remote)
        assert client.recv(0.1) is None
    host, port = endpoint.removeprefix("tcp://").split(":")
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex((host, int(port))) != 0:
                break
        time.sleep(0.02)
    else:
        pytest.fail("the address still answers")


def test_an_authenticator_that_fails_inside_is_noticed_too(remote: Publisher, tmp_path: Path) -> None:
    assert remote._authenticator is not None

    def broken() -> dict[bytes, str]:
        raise OSError("disk gone")

    remote._authenticator._allowed = broken
    with connect(reached(remote), ("pose",), keys=tmp_path / "right.key_secret") as client:
        for _ in range(ENOUGH):
            remote.pose(pose())
            time.sleep(0.005)
        assert client.recv(0.1) is None
    assert remote._authenticator.alive
    assert remote._authenticator.errors >= 1


GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00"
READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"
FOUR_GB = b"\x00\x00\x00\x01\x00\x00\x00\x00"


@pytest.mark.parametrize("address", [0, 1], ids=["this machine", "others"])
@pytest.mark.parametrize(
    "content",
    [
        os.urandom(100_000),
        GREETING + b"NULL" + bytes(48) + READY + b"\x02" + FOUR_GB + bytes(10_000),
        GREETING + b"CURVE" + bytes(47) + b"\x06" + FOUR_GB + bytes(10_000),
    ],
    ids=["random", "4 GB message", "4 GB command"],
)
def test_hostile_bytes_are_harmless(remote: Publisher, tmp_path: Path, content: bytes, address: int) -> None:
    host, port = remote.endpoints[address].replace("0.0.0.0", "127.0.0.1").removeprefix("tcp://").split(":")
    before_kb = _peak_kb()
    for _ in range(3):
        hostile = socket.create_connection((host, int(port)), timeout=WAIT_S)
        with hostile, contextlib.suppress(ConnectionError, TimeoutError):
            hostile.sendall(content)
            hostile.settimeout(0.2)
            while hostile.recv(4096):
                pass
    with connect(reached(remote), ("pose",), keys=tmp_path / "right.key_secret") as client:
        assert until(receives(client), remote)
    assert _peak_kb() - before_kb < 64 * 1024
    assert remote.auth_failures == 0 or address == 1


def test_revoked_clients_are_refused_at_their_next_connection(
    remote: Publisher, keys: KeyFolder, tmp_path: Path
) -> None:
    keys.revoke("right")
    with connect(reached(remote), ("pose",), keys=tmp_path / "right.key_secret") as client:
        assert until(counted(remote, 1), remote)
        assert client.recv(0.1) is None
    keys.allow("right", read_secret(tmp_path / "right.key_secret").public)
    with connect(reached(remote), ("pose",), keys=tmp_path / "right.key_secret") as client:
        assert until(receives(client), remote)


def test_latest_addresses_are_guarded_too(keys: KeyFolder, tmp_path: Path) -> None:
    settings = StreamSettings(("tcp://127.0.0.1:*",), latest_endpoints=("tcp://0.0.0.0:*",), key_folder=str(keys.path))
    with publisher(settings) as sender:
        endpoint = sender.latest_endpoints[0].replace("0.0.0.0", "127.0.0.1")
        with connect(endpoint, ("pose",), conflate=True, keys=tmp_path / "right.key_secret") as client:
            assert until(receives(client), sender)
        assert sender.auth_failures == 0
        with connect(endpoint, ("pose",), conflate=True) as client:
            assert until(counted(sender, 1), sender)
            assert client.recv(0.1) is None


def test_other_machines_need_keys_that_are_in_order(keys: KeyFolder, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="rfconstruct keys"):
        publisher(StreamSettings(("tcp://0.0.0.0:*",)))
    settings = StreamSettings(("tcp://0.0.0.0:*",), key_folder=str(keys.path))
    secret = keys.path / "server.key_secret"
    secret.chmod(0o640)
    with pytest.raises(ConfigError, match="open to others"):
        publisher(settings)
    secret.chmod(0o600)
    keys.clients.chmod(0o770)
    with pytest.raises(ConfigError, match="open to others"):
        publisher(settings)
    keys.clients.chmod(0o700)
    secret.unlink()
    with pytest.raises(ConfigError, match="does not exist"):
        publisher(settings)
    with pytest.raises(ConfigError, match="number"):
        publisher(StreamSettings(("tcp://eth0:*",), key_folder=str(keys.path)))


def test_a_client_checks_its_own_keys(keys: KeyFolder, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="which appliance"):
        connect("tcp://127.0.0.1:1", keys=keys.path / "server.key_secret")
    path = tmp_path / "right.key_secret"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="open to others"):
        connect("tcp://127.0.0.1:1", keys=path)


def _peak_kb() -> int:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])
