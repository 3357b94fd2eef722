# SPDX-License-Identifier: Apache-2.0
"""The page in a real browser (Chromium, software WebGL) that cannot reach the internet: it loads, draws, obeys."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from view_samples import block, drive

pytest.importorskip("viser", reason="the viewer needs viser: pip install 'rfconstruct[view]'")
pytest.importorskip("PIL", reason="the viewer needs Pillow: pip install 'rfconstruct[view]'")

import browser
from PIL import Image

from edge.recording import schema
from edge.recording.writer import RecordingWriter
from edge.view.canvas import Picture

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(browser.PROGRAM is None, reason="no browser here: apt-get install chromium"),
]
WIDTH, HEIGHT = 1280, 720
MIDDLE = (slice(0, HEIGHT), slice(405, WIDTH - 355))
WAIT_S = 240.0


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[str]:
    """Address of a viewer of a scripted recording of results."""
    recording = tmp_path / "drive.mcap"
    with RecordingWriter(recording, None) as writer:
        for draft in drive(2.0):
            writer.message(schema.result_topic(draft.topic.encode()), block(draft), draft.t_ns)
    command = [sys.executable, "-m", "edge", "view", str(recording), "--port", "0", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield json.loads(process.stdout.readline())["url"]
    finally:
        process.terminate()
        process.wait(60)
        process.stdout.close()


def pixels(tab: browser.Browser, folder: Path) -> Picture:
    with Image.open(tab.picture(folder / "page.png")) as image:
        return np.asarray(image.convert("RGB"))


def share(picture: Picture, colour: tuple[int, int, int]) -> int:
    """Pixels of the canvas whose hue is that of a class, shaded or not."""
    part = picture[MIDDLE].astype(np.float64)
    length = np.linalg.norm(part, axis=2)
    cosine = part @ (np.array(colour) / np.linalg.norm(colour)) / np.maximum(length, 1e-6)
    return int(((cosine > 0.995) & (length > 60)).sum())


def test_the_page_draws_without_the_internet_and_obeys(viewer: str, tmp_path: Path) -> None:
    from edge.view.colours import CLASS_COLOURS

    with browser.browser(tmp_path, WIDTH, HEIGHT) as tab:
        tab.call("Page.navigate", url=viewer)
        assert tab.wait_for("document.body && document.body.innerText.includes('drive.mcap: RUN')", WAIT_S)
        assert tab.wait_for("document.querySelectorAll('img').length >= 4", WAIT_S)
        deadline = time.monotonic() + WAIT_S
        drawn = dict.fromkeys(("car", "bicycle", "pedestrian"), 0)
        while min(drawn.values()) < 60 and time.monotonic() < deadline:
            picture = pixels(tab, tmp_path)
            drawn = {name: share(picture, CLASS_COLOURS[name]) for name in drawn}
        assert min(drawn.values()) >= 60, drawn
        text = tab.evaluate("document.body.innerText")
        assert "PAUSED" in text  # two seconds have passed long since
        assert "late messages dropped: 0" in text
        click = "[...document.querySelectorAll('label')].find(l => l.innerText == 'shapes')"
        tab.evaluate(f"document.getElementById({click}.htmlFor).click()")
        deadline = time.monotonic() + WAIT_S
        while share(picture, CLASS_COLOURS["car"]) > drawn["car"] / 2 and time.monotonic() < deadline:
            picture = pixels(tab, tmp_path)
        assert share(picture, CLASS_COLOURS["car"]) <= drawn["car"] / 2  # box and legend are left
        outside = [url for url in tab.requested if "//127.0.0.1:" not in url]
        assert outside == []
        assert [error for error in tab.errors if "blob:" not in error] == []
