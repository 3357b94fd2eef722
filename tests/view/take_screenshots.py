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

from browser import browser

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
            demo = subprocess.Popen([*COMMAND, "demo", "--speed", "0.5"], stdout=subprocess.DEVNULL)
        found = tab.wait_for("document.body.innerText.includes('car')", 60.0)
        print(f"{url}: {'an object' if found else 'no object'} after the wait")
        tab.evaluate("document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())")
        for number in range(1, 4):
            time.sleep(4.0)
            print(tab.picture(out / f"viewer_{number}.png"), tab.errors)
        print(sorted(set(tab.requested)))
        if not recording:
            demo.wait(60)
    return 0


if __name__ == "__main__":
    sys.exit(main())
