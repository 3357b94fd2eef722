# SPDX-License-Identifier: Apache-2.0
"""What a host can do wrong with a cascade that no single chip notices: looked at when the master's frames start.

Source: hardware notes 1.5 (order of the chips, chirp table: chirp i fires TX 12 - i alone) and 1.6.
"""

from __future__ import annotations

from collections.abc import Sequence

from train.simulate.cascade_chip import CascadeChip
from train.simulate.chip_commands import MASTER
from train.simulate.tda2_recorder import Recorder

PERIOD_LSB_MS = 5e-6
TX_OF_A_CHIP, TRANSMITTERS = 3, 12


def start_notes(chips: Sequence[CascadeChip], recorder: Recorder) -> list[str]:
    """Everything that is not right about a start of the master's frames, in words.

    Args:
        chips: those of the device map, the master first.
        recorder: of the board.
    """
    master, frame = chips[0], chips[0].frame
    if frame is None:
        return ["master without frame"]
    notes: list[str] = []
    waiting = [chip.number for chip in chips[1:] if not chip.running]
    if waiting:
        notes.append(f"master started before slaves {waiting}: they miss its frames")
    free = [chip.number for chip in chips[1:] if chip.running and chip.frame and chip.frame.trigger == MASTER]
    if free:
        notes.append(f"slaves {free} run by software trigger: their frames are not the master's")
    told_ms, period_ms = recorder.settings.period_ms, frame.period * PERIOD_LSB_MS
    if told_ms is not None and told_ms != int(period_ms):
        notes.append(f"recorder was told {told_ms} ms, frames come every {period_ms:g} ms")
    if not recorder.recording:
        notes.append("frames were started before the recorder")
    for chip in chips[1:]:
        if chip.frame and (chip.frame.loops, chip.frame.period) != (frame.loops, frame.period):
            notes.append(f"chip {chip.number} has other loops or another period than the master")
        if chip.profiles != master.profiles:
            notes.append(f"chip {chip.number} has other profiles than the master")
    return notes + _chirp_notes(chips, range(frame.first_chirp, frame.last_chirp + 1))


def _chirp_notes(chips: Sequence[CascadeChip], chirps: range) -> list[str]:
    """Chirps that do not fire the one transmitter that the frames of a cascade show in their place."""
    notes: list[str] = []
    for index in chirps:
        masks = {chip.number: chip.chirps[index].tx_enable for chip in chips if index in chip.chirps}
        fired = [
            TX_OF_A_CHIP * number + bit + 1
            for number, mask in masks.items()
            for bit in range(TX_OF_A_CHIP)
            if mask >> bit & 1
        ]
        if fired != [TRANSMITTERS - index]:
            notes.append(f"chirp {index} fires TX {fired or 'none'}, the frames show TX {TRANSMITTERS - index}")
    return notes
