# SPDX-License-Identifier: Apache-2.0
"""How long the host waits for the capture board and the radar chips, and how often it tries again."""

from __future__ import annotations

from dataclasses import dataclass

CONNECT_TRIES = 2
"""A board may still hold the connection of a host that vanished."""
CONFIGURE_TRIES = 3
"""RF initialisation now and then does not answer; a reset helps (logs of two boards)."""
NACK_TRIES = 3
"""A chip that answers NACK is sent the command again with the next sequence number, this often (TI's host)."""


@dataclass(frozen=True, slots=True)
class TimeOuts:
    """Waits in seconds. Sources: TI's host (TI), logs of two real boards (logs), ours where none is known (own).

    Args:
        connect_s: TCP connection, and the board's answer to any order not named here (TI).
        create_s: CREATE_APP (TI).
        stop_record_s: STOP_RECORD (TI).
        spi_s: the board's answer to SPI_WRITE and SPI_READ (TI).
        answer_s: a chip's interrupt after a command (TI).
        power_up_s: reset to the power-up event (TI).
        radar_power_up_s: RF power-up to its event (TI).
        calibration_s: RF initialisation to the event with its result (own).
        frame_started_s, frame_ended_s: start and stop of frames to their events (TI, own).
        after_sop_s: pause between SOP lines and reset (TI).
        after_map_s: pause after the device map (TI).
        after_request_s: pause between the interrupt's acknowledgement and reading (TI).
        after_record_s: pause between record start and the first frame start (TI: 1 to 2 s).
        before_reconnect_s: pause before a broken connection is made again (own).
        before_close_s: pause between trace stop and the end of the connection (TI).
    """

    connect_s: float = 3.0
    create_s: float = 9.0
    stop_record_s: float = 6.0
    spi_s: float = 1.0
    answer_s: float = 1.0
    power_up_s: float = 2.0
    radar_power_up_s: float = 1.0
    calibration_s: float = 3.0
    frame_started_s: float = 1.0
    frame_ended_s: float = 1.0
    after_sop_s: float = 1.0
    after_map_s: float = 0.05
    after_request_s: float = 1e-3
    after_record_s: float = 1.5
    before_reconnect_s: float = 0.5
    before_close_s: float = 1.0
