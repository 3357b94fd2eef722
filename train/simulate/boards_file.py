# SPDX-License-Identifier: Apache-2.0
"""Says in a file for ``rfconstruct run --boards`` where the boards of a virtual rig are."""

from __future__ import annotations

import json
import os
import socket
import zlib
from collections.abc import Mapping
from pathlib import Path

from edge.frames import RADARS, RadarId
from edge.rig import Rig
from train.simulate.rig import VirtualRig

HOSTS: Mapping[RadarId, str] = {"horizontal": "127.0.0.30", "vertical": "127.0.0.31"}
"""Where the host waits for samples: the last number as on a real network, one address for each card."""
IMAGE_BYTES = 7936
"""Of a patch image of the cascade's radar chips."""


def data_targets(rig: Rig) -> dict[RadarId, tuple[str, int]]:
    """A free UDP port for each capture card to send to."""
    found: dict[RadarId, tuple[str, int]] = {}
    for radar in RADARS:
        if radar in rig.radars and not rig.radars[radar].schedule.is_cascade:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((HOSTS[radar], 0))
                found[radar] = probe.getsockname()
    return found


def write_boards(path: Path, rig: VirtualRig) -> None:
    """Write the tables ``[radars.<id>.board]`` and ``[pose]``; the file is there at once or not at all.

    A cascade's firmware image stands beside it: bytes of no meaning, which the virtual boards do not look into.

    Args:
        path: of the file.
        rig: its cards send to ``data_targets``.
    """
    tables: dict[str, Mapping[str, str | int | float]] = {}
    for radar, board in rig.boards.items():
        image = path.with_suffix(".firmware.bin")
        image.write_bytes(stand_in_image())
        board.recorder.root.mkdir(parents=True, exist_ok=True)
        tables[f"radars.{radar}.board"] = {
            "address": board.address[0],
            "control_port": board.address[1],
            "firmware": str(image.resolve()),
            "fetch": "folder",
            "folder": str(board.recorder.root.resolve()),
        }
    for radar, card in rig.cards.items():
        target = card.data_target or (HOSTS[radar], 4098)
        tables[f"radars.{radar}.board"] = {
            "card_address": card.address[0],
            "host_address": target[0],
            "command_port": card.address[1],
            "data_port": target[1],
            "port": str(rig.radars[radar].settings.link or rig.radars[radar].port),
        }
    if rig.pose_stream is not None:
        endpoint = rig.pose_stream.address
        tables["pose"] = {"kind": "zmq", "endpoint": endpoint, "poses_of": "rig", "clock": "monotonic"}
    text = "\n".join(
        f"[{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in table.items())
        for name, table in tables.items()
    )
    draft = path.with_suffix(".part")
    draft.write_text("# Boards of a virtual rig; good as long as it runs.\n\n" + text, encoding="utf-8")
    os.replace(draft, path)


def stand_in_image() -> bytes:
    """Bytes of the form of TI's image: begin, size and CRC-32 are right, nothing else is."""
    image = b"MSTR".ljust(IMAGE_BYTES, b"\0")
    return image + zlib.crc32(image).to_bytes(4, "little")
