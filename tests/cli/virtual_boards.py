# SPDX-License-Identifier: Apache-2.0
"""A virtual rig in this process, without a board's delays, and the file that says where its boards are."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from edge.rig import Rig, load_rig
from train.simulate.boards_file import data_targets, write_boards
from train.simulate.faults import Faults
from train.simulate.rig import VirtualRig, VirtualRigSettings
from train.simulate.supplies import straight_poses, targets


@dataclass(frozen=True)
class Virtual:
    """What runs, and where the file is that says so."""

    rig: Rig
    boards: Path
    parts: VirtualRig
    faults: Faults

    @property
    def violations(self) -> list[str]:
        return [text for texts in self.parts.violations().values() for text in texts]


@contextmanager
def virtual_boards(name: str, folder: Path, frames: int = 4, segment_frames: int = 0) -> Iterator[Virtual]:
    """Boards of a shipped rig on loopback.

    Args:
        name: of the rig.
        folder: for the file and the disks.
        frames: different ones, repeated.
        segment_frames: cascades: of a segment; 0: as shipped.
    """
    rig, faults = load_rig(name), Faults(seed=1)
    settings = VirtualRigSettings(data_targets=data_targets(rig))
    demo = replace(settings.demo, start_s=0.0, restart_s=0.0, boot_s=0.0)
    settings = replace(settings, demo=demo, card=replace(settings.card, deaf_s=0.0))
    with VirtualRig(rig, targets(rig, frames), folder / "disks", straight_poses(rig), settings, faults) as parts:
        boards = folder / "boards.toml"
        write_boards(boards, parts)
        if segment_frames:
            text = boards.read_text(encoding="utf-8")
            text = text.replace('fetch = "folder"', f'fetch = "folder"\nsegment_frames = {segment_frames}')
            boards.write_text(text, encoding="utf-8")
        yield Virtual(rig, boards, parts, faults)
