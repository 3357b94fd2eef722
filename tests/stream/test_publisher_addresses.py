# SPDX-License-Identifier: Apache-2.0
"""What a publisher binds and what it refuses: addresses, settings, hashes."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from stream_samples import pose
from stream_sockets import LOCAL, poses, publisher, subscribed

from edge.config import StreamSettings
from edge.errors import ConfigError, ExitCode
from edge.stream.addresses import checked_endpoint
from edge.stream.publisher import Publisher


@pytest.mark.parametrize(
    "endpoint", ["tcp://127.0.0.1:5600", "tcp://[::1]:1", "tcp://127.0.0.9:*", "ipc:///run/rfc/pub"]
)
def test_addresses_of_this_machine(endpoint: str) -> None:
    assert checked_endpoint(endpoint) == endpoint
    assert checked_endpoint("tcp://localhost:5600") == "tcp://127.0.0.1:5600"


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp://0.0.0.0:5600",
        "tcp://*:5600",
        "tcp://192.168.0.2:5600",
        "tcp://[::]:5600",
        "tcp://eth0:5600",
        "tcp://127.0.0.1",
        "tcp://127.0.0.1:99999",
        "tcp://127.0.0.1:5600;tcp://0.0.0.0:1",
        "tcp://localhost.example.org:5600",
        "tcp://[::ffff:10.0.0.1]:5600",
        "udp://127.0.0.1:5600",
        "inproc://x",
        "ipc://",
        "ipc://" + "x" * 108,
        "",
    ],
)
def test_other_addresses_are_refused(endpoint: str) -> None:
    with pytest.raises(ConfigError, match=r"stream\.endpoints") as caught:
        publisher(StreamSettings((endpoint,)))
    assert caught.value.exit_code == ExitCode.BAD_CONFIG


@pytest.mark.parametrize("transport", ["tcp", "ipc", "abstract"])
def test_an_address_in_use_is_refused_and_stays_with_its_owner(transport: str, tmp_path: Path) -> None:
    named = {"tcp": LOCAL.endpoints[0], "ipc": f"ipc://{tmp_path}/pub", "abstract": f"ipc://@rfc-{os.getpid()}"}
    with publisher(StreamSettings((named[transport],))) as owner:
        taken = owner.endpoints[0] if transport == "tcp" else named[transport]
        with pytest.raises(ConfigError, match="stop the other publisher"):
            publisher(StreamSettings((taken,)))
        with subscribed(owner, "pose") as client:
            owner.pose(pose())
            assert poses(client, 1) == [0]


def test_a_folder_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="folder"):
        publisher(StreamSettings((f"ipc://{tmp_path}/none/pub",)))


@pytest.mark.parametrize("values", [{"endpoints": ()}, {"send_high_water_mark": 0}, {"shape_encoding": "f8"}])
def test_settings_are_checked(values: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(values))):
        replace(LOCAL, **values)  # type: ignore[arg-type]


def test_hashes_and_source_are_checked() -> None:
    with pytest.raises(ConfigError, match="config_hash"):
        Publisher(LOCAL, b"short", b"calibration", "sim")
    with pytest.raises(ConfigError, match="source"):
        Publisher(LOCAL, bytes(8), bytes(8), "dream")  # type: ignore[arg-type]
