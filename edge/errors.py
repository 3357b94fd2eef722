# SPDX-License-Identifier: Apache-2.0
"""The errors of the runtime: few, typed, and each carries what was measured, what is allowed and what to do."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of every command."""

    OK = 0
    FAILURE = 1
    USAGE = 2
    DEGRADED = 3
    NO_HARDWARE = 4
    BAD_CONFIG = 5
    BAD_MODEL = 6


class RfconstructError(Exception):
    """Root of all errors that the runtime raises on purpose.

    Args:
        what: what is wrong, in one sentence, naming the file, field or device.
        value: the offending value, or None when there is none to show.
        allowed: what would have been accepted.
        action: what the reader should do next.
    """

    exit_code = ExitCode.FAILURE

    def __init__(self, what: str, *, value: object = None, allowed: str = "", action: str = "") -> None:
        self.what = what
        self.value = value
        self.allowed = allowed
        self.action = action
        super().__init__(self._message())

    def _message(self) -> str:
        parts = [self.what]
        if self.value is not None:
            parts.append(f"got {self.value!r}")
        if self.allowed:
            parts.append(f"allowed: {self.allowed}")
        if self.action:
            parts.append(self.action)
        return "; ".join(parts)


class ConfigError(RfconstructError):
    """A setting, rig file or schedule that cannot work."""

    exit_code = ExitCode.BAD_CONFIG


class CaptureError(RfconstructError):
    """Raw radar data that contradicts the configuration or cannot be read."""


class CalibrationError(RfconstructError):
    """A calibration file that is a dummy, foreign or inconsistent."""

    exit_code = ExitCode.BAD_CONFIG


class PoseError(RfconstructError):
    """A pose that is not a pose: non-unit quaternion, NaN, backwards time."""


class RecordingError(RfconstructError):
    """A recording that cannot be read or written."""


class ModelError(RfconstructError):
    """A completion model that is absent, altered, or gives other numbers than its manifest states."""

    exit_code = ExitCode.BAD_MODEL


class WireError(RfconstructError):
    """A message that does not follow the wire format."""


class DeviceError(RfconstructError):
    """A board, card or sensor that does not do what it was asked."""

    exit_code = ExitCode.NO_HARDWARE


class LinkError(DeviceError):
    """A device that does not answer, answers too late or half, or whose connection broke."""


class RefusalError(DeviceError):
    """A device that answered no: a NACK, an error code, an error line."""


class FirmwareError(DeviceError):
    """A firmware image that is absent, or is not the one it should be; or a board that runs another."""

    exit_code = ExitCode.BAD_CONFIG


class DependencyError(RfconstructError):
    """A command needs an optional package that is not installed."""

    exit_code = ExitCode.USAGE
