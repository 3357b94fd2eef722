# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a frame's samples: refusals with their cause, and a report of what was noticed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.errors import CaptureError
from edge.frames import LossCause, RadarFrame


class FrameRejected(CaptureError):  # noqa: N818 - it is a verdict on the frame, named as in the architecture
    """A frame whose samples cannot become a heatmap; ``cause`` is counted by the pipeline.

    Args:
        cause: which counter the loss belongs to.
        what, value, allowed, action: as in RfconstructError.
    """

    def __init__(
        self, cause: LossCause, what: str, *, value: object = None, allowed: str = "", action: str = ""
    ) -> None:
        self.cause = cause
        super().__init__(what, value=value, allowed=allowed, action=action)


@dataclass(frozen=True, slots=True)
class FrameReport:
    """What was noticed while a frame was processed.

    Args:
        loops: loops that were used.
        saturated_share: share of the used I and Q codes at the rails.
        dead: names of channels that gave one constant value: "RX5" (with every transmitter), "TX3" or "TX3 RX5".
        choice: what became of the loops: "sum", "steer", "fft" or "single".
        reason: why, for people.
    """

    loops: int = 0
    saturated_share: float = 0.0
    dead: tuple[str, ...] = ()
    choice: str = ""
    reason: str = ""


def reject_all_zero(frame: RadarFrame) -> FrameRejected:
    """Refusal of a frame without a single non-zero sample."""
    return FrameRejected(
        LossCause.ALL_ZERO,
        f"{frame.radar} frame {frame.number}: every sample is zero",
        action="check that the board was armed and the capture card received data",
    )


def reject_saturated(frame: RadarFrame, share: float, allowed: float) -> FrameRejected:
    """Refusal of a frame with too many codes at the rails."""
    return FrameRejected(
        LossCause.SATURATED,
        f"{frame.radar} frame {frame.number}: ADC saturated",
        value=f"{100.0 * share:.3g} % of the codes at the rails",
        allowed=f"at most {100.0 * allowed:.3g} % (heatmap.max_saturated_share)",
        action="lower the receiver gain of the profile or move strong reflectors away",
    )


def dead_names(dead: NDArray[np.uint8], transmitters: Sequence[int]) -> tuple[str, ...]:
    """Names of dead channels, whole receivers and whole transmitters first.

    Args:
        dead: [slots, receivers], not zero where the channel is dead.
        transmitters: transmitter of each slot, numbered as on the board (``Schedule.transmitters``).
    Returns:
        For example ("RX5", "TX3", "TX1 RX2").
    """
    by_receiver = np.asarray(dead.all(axis=0))
    by_slot = np.asarray(dead.all(axis=1) & (not by_receiver.all()))
    names = [f"RX{r + 1}" for r in np.flatnonzero(by_receiver)]
    names += [f"TX{transmitters[s]}" for s in np.flatnonzero(by_slot).tolist()]
    single = dead.astype(np.bool_) & ~by_receiver[None, :] & ~by_slot[:, None]
    names += [f"TX{transmitters[s]} RX{r + 1}" for s, r in np.argwhere(single).tolist()]
    return tuple(names)
