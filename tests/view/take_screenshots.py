# SPDX-License-Identifier: Apache-2.0
"""Takes the pictures of docs/pictures: starts the viewer on a recording, or beside ``rfconstruct demo``, and a browser.

``python tests/view/take_screenshots.py OUT [RECORDING.mcap]``; without a recording the demo runs live.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from browser import browser
from PIL import Image

COMMAND = (sys.executable, "-m", "edge")


@contextmanager
def running(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """An rfconstruct command that is ended afterwards."""
    process = subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(30)


def main() -> int:
    """Three pictures, a few seconds apart."""
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    recording = sys.argv[2:3]
    with (
        tempfile.TemporaryDirectory() as folder,
        running("view", *recording, "--port", "0", "--json") as viewer,
        browser(Path(folder)) as tab,
    ):
        assert viewer.stdout is not None
        url = json.loads(viewer.stdout.readline())["url"]
        tab.call("Page.navigate", url=url)
        if not recording:
            demo = subprocess.Popen([*COMMAND, "demo", "--speed", "0.2"], stdout=subprocess.DEVNULL)
        sign = "recording read: 100" if recording else "horizontal"  # the account of the first status
        print(f"{url}: {tab.wait_for(f'document.body.innerText.includes({sign!r})', 90.0)}")
        tab.evaluate("document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())")
        for number in range(1, 4):
            time.sleep(3.0)
            path = tab.picture(out / f"viewer_{number}.png")
            with Image.open(path) as picture:  # steps of four: nobody sees them, and the file is a third smaller
                levels = np.asarray(picture.convert("RGB"), np.int16)
            Image.fromarray(np.clip((levels + 2) // 4 * 4, 0, 255).astype(np.uint8)).save(path, optimize=True)
            print(f"{path}: {path.stat().st_size} bytes")
        if not recording:
            demo.wait(120)
    return 0


if __name__ == "__main__":
    sys.exit(main())
