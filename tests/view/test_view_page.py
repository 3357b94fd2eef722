# SPDX-License-Identifier: Apache-2.0
"""The page: served on loopback, filled by a scripted publisher, seen through viser's own handles and its websocket."""

from __future__ import annotations

import contextlib
import itertools
import re
import socket
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from view_samples import block, cloud_draft, drive, heatmap_draft, message, pose_draft, shape_draft, status_draft

pytest.importorskip("viser", reason="the viewer needs viser: pip install 'rfconstruct[view]'")

sys.path.append(str(Path(__file__).resolve().parents[1] / "stream"))

import zstandard
from stream_samples import STAMP
from stream_sockets import Raw
from websockets.sync.client import connect as websocket

from edge import connect
from edge.commands.view_command import check_host, watch_live
from edge.errors import ConfigError
from edge.stream.wire import Stamp, pack
from edge.view.page import HOST, Page
from edge.view.playback import Player
from edge.view.scene import Scene
from edge.view.store import MessageStore

WAIT_S = 30.0


@pytest.fixture
def page() -> Iterator[Page]:
    one = Page(0, "test")
    yield one
    one.close()


def shown(page: Page) -> set[str]:
    """Names of the nodes that the page draws."""
    return set(page.server.scene._handle_from_node_name)


def nodes(url: str, wanted: set[str]) -> set[str]:
    """Names of the nodes that a browser is told of, until all ``wanted`` have come."""
    import viser

    seen: set[str] = set()
    address = url.replace("http", "ws")
    with websocket(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None, compression=None) as link:  # type: ignore[list-item]
        deadline = time.monotonic() + WAIT_S
        while not wanted <= seen and time.monotonic() < deadline:
            data = link.recv(timeout=WAIT_S)
            assert isinstance(data, bytes)
            seen |= {name for name in wanted if name.encode() in _plain(data)}
    return seen


def _plain(data: bytes) -> bytes:
    """A websocket message of viser as msgpack: its parts may be compressed."""
    plain = data
    start = data.find(zstandard.FRAME_HEADER)
    while start >= 0:
        with contextlib.suppress(zstandard.ZstdError):
            plain += zstandard.ZstdDecompressor().decompressobj().decompress(data[start:])
        start = data.find(zstandard.FRAME_HEADER, start + 1)
    return plain


def fill(scene: Scene) -> None:
    for draft in (
        pose_draft(1.0),
        cloud_draft(1.0),
        shape_draft(1, 1.0),
        status_draft(1.0),
        heatmap_draft("vertical", 1.0),
    ):
        scene.add(message(draft), 10.0)


def test_the_page_comes_from_this_machine_only(page: Page) -> None:
    with urllib.request.urlopen(page.url, timeout=WAIT_S) as answer:
        text = answer.read().decode()
    assert "<html" in text
    listening = {line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:] if " 0A " in line}
    assert f"0100007F:{page.port:04X}" in listening
    assert f"00000000:{page.port:04X}" not in listening


def test_a_taken_port_is_refused_and_not_replaced() -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        with pytest.raises(ConfigError, match="--port"):
            Page(taken.getsockname()[1])


def test_a_page_never_asks_the_internet_for_a_public_address(page: Page) -> None:
    assert page.server.request_share_url() is None
    assert page.server._share_tunnel is None


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "::", "example.org"])
def test_another_host_is_refused_with_the_way_to_do_it(host: str) -> None:
    with pytest.raises(ConfigError, match=re.escape("ssh -L 8080:127.0.0.1:8080")):
        check_host(host, 8080)


def test_what_is_in_the_scene_is_on_the_page_and_goes_with_it(page: Page) -> None:
    scene = Scene()
    fill(scene)
    page.update(scene, scene.health.banner(10.0, "x"), {"late": "0"}, 10.0)
    drawn = {"/world/things/1/shape", "/world/things/1/box", "/world/things/1/label", "/world/windows/1", "/world/rig"}
    assert drawn <= shown(page)
    assert nodes(page.url, drawn) == drawn
    page.look.show_boxes = False
    page.update(scene, scene.health.banner(10.0, "x"), {}, 10.0)
    assert "/world/things/1/box" not in shown(page)
    assert "/world/things/1/shape" in shown(page)
    page.update(scene, scene.health.banner(99.0, "x"), {}, 99.0)
    assert not any(name.startswith(("/world/things/1/", "/world/windows/")) for name in shown(page))


def test_points_stand_where_the_scene_says(page: Page) -> None:
    scene = Scene()
    fill(scene)
    page.look.follow = False
    page.update(scene, scene.health.banner(10.0, "x"), {}, 10.0)
    handle = page.server.scene._handle_from_node_name["/world/things/1/shape"]
    ((one, _),) = scene.drawables(10.0).things
    np.testing.assert_allclose(handle.position, one.box.center_m, atol=1e-5)
    np.testing.assert_allclose(np.asarray(handle.points, np.float32), one.points_m, atol=0.002)


def test_nothing_is_sent_again_that_has_not_changed(page: Page) -> None:
    scene = Scene()
    fill(scene)
    page.update(scene, scene.health.banner(10.0, "x"), {}, 10.0)
    before = {name: id(handle) for name, handle in page.server.scene._handle_from_node_name.items()}
    for _ in range(5):
        page.update(scene, scene.health.banner(10.0, "x"), {}, 10.0)
    assert {name: id(handle) for name, handle in page.server.scene._handle_from_node_name.items()} == before


def test_shapes_change_their_colour_with_the_switch(page: Page) -> None:
    scene = Scene()
    fill(scene)
    colours = []
    for choice in ("class", "confidence"):
        page.look.shapes = choice  # type: ignore[assignment]
        page.update(scene, scene.health.banner(10.0, "x"), {}, 10.0)
        colours.append(page.server.scene._handle_from_node_name["/world/things/1/shape"].colors.copy())
    assert (colours[0] != colours[1]).any()


def test_a_scripted_publisher_fills_the_page_and_a_new_start_empties_it(page: Page) -> None:
    sender, scene = Raw(), Scene()
    end_s = time.monotonic() + WAIT_S
    sent, restart = iter([(draft, bytes(16)) for draft in drive(0.5)]), iter([(pose_draft(0.1), b"another boot id.")])
    counts: dict[str, int] = {}
    objects = 0

    def stopped() -> bool:
        nonlocal objects
        objects = max(objects, len(scene.drawables(0.0).things))
        if scene.health.heard_s is None:
            sender.heartbeat()
            return time.monotonic() > end_s
        for draft, boot in [*itertools.islice(sent, 20), *(restart if objects == 3 else ())]:
            number = counts[draft.topic] = counts.get(draft.topic, -1) + 1
            sender.send(pack(draft, Stamp(boot, number, draft.t_ns, 0, True, "sim", bytes(8), bytes(8))))
        return scene.counts.resets >= 2 or time.monotonic() > end_s

    with connect(sender.endpoints[0]) as client:
        watch_live(page, client, stopped, scene)
    sender.close()
    assert objects == 3
    assert STAMP.boot != bytes(16)
    assert scene.counts.resets == 2  # after the heartbeats that called, and at the end
    assert not any(name.startswith("/world/things/1/") for name in shown(page))


def test_the_scrubber_follows_and_the_switches_command_the_player() -> None:
    store = MessageStore()
    for draft in drive(2.0):
        store.add(draft.topic, draft.t_ns, block(draft))
    store.ended = True
    player = Player(store)
    page = Page(0, "test", player)
    scene = Scene()
    player.step(0.0)
    player.step(0.5)
    page.update(scene, scene.health.banner(0.5, "x", None), {}, 0.5)
    assert page._scrubber.value == pytest.approx(0.5, abs=0.05)
    assert page._scrubber.max == pytest.approx(2.0)
    assert player.step(0.6)[0] is False  # the server's own change of the scrubber was no jump
    page.close()
    store.close()
