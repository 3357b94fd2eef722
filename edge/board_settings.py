# SPDX-License-Identifier: Apache-2.0
"""Where the hardware of a rig is reached: capture boards, capture cards, pose sensor. Nothing here changes a sample.

``[radars.<id>.board]`` and ``[pose]`` of a rig's file fill these; a second file with the same tables may override them
for one vehicle, so that the rig's own file stays what was calibrated. Defaults are those of the boards as delivered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from edge.config import require

FetchKind = Literal["ssh", "folder"]
PoseKind = Literal["none", "oak", "zmq", "recorded", "constant"]
PoseOf = Literal["sensor", "rig"]
OdometryNode = Literal["basalt", "rtabmap"]
SenderClock = Literal["fit", "monotonic", "realtime", "tai", "utc"]
LARGEST_PORT = 65535


def require_port(key: str, port: int) -> None:
    """ConfigError unless ``port`` is one that a host can connect to."""
    require(1 <= port <= LARGEST_PORT, key, port, f"1..{LARGEST_PORT}")


@dataclass(frozen=True, slots=True)
class CascadeBoard:
    """A capture board with its SSD (TI MMWCAS-DSP-EVM), which sets up its cascade and records segments.

    Args:
        address: of the board; a second one needs another address than the delivered one.
        control_port: TCP.
        firmware: file of TI's radar patch image for the AWR2243 (7940 bytes), which cannot be shipped; relative paths
            start at the rig's folder.
        storage: folder of captures on the board.
        fetch: how segments come here: by the system's OpenSSH, or through a folder that this machine sees.
        folder: fetch "folder": where ``storage`` is seen here.
        ssh_user, ssh_port: of the board.
        trace: send the trace order before the others, as TI's host does.
        segment_frames: frames of one segment.
    """

    address: str = "192.168.33.180"
    control_port: int = 5001
    firmware: str = ""
    storage: str = "/mnt/ssd"
    fetch: FetchKind = "ssh"
    folder: str = ""
    ssh_user: str = "root"
    ssh_port: int = 22
    trace: bool = True
    segment_frames: int = 360

    def __post_init__(self) -> None:
        require(bool(self.address), "board.address", self.address, "an address")
        require_port("board.control_port", self.control_port)
        require_port("board.ssh_port", self.ssh_port)
        require(self.storage.startswith("/"), "board.storage", self.storage, "an absolute path on the board")
        require(not self.ssh_user.startswith("-"), "board.ssh_user", self.ssh_user, "a user name")
        require(not self.address.startswith("-"), "board.address", self.address, "a host name or address")
        require(
            self.fetch == "ssh" or bool(self.folder), "board.folder", self.folder, 'a folder, with fetch = "folder"'
        )
        require(1 <= self.segment_frames <= LARGEST_PORT, "board.segment_frames", self.segment_frames, "1..65535")


@dataclass(frozen=True, slots=True)
class CaptureCardBoard:
    """A single-chip radar on a capture card (DCA1000): samples by UDP, the radar's command line on a serial port.

    Args:
        card_address, host_address: of the card and of the interface it sends to.
        command_port, data_port: UDP, of the card and of the host.
        serial_number: of the radar board's debugger (XDS110) or USB bridge (CP2105): the port is found by it.
        port: path of the serial port instead.
        baud_rate: of the command line.
        receive_buffer_bytes: asked of the kernel for the sample socket; two frames at least.
    """

    card_address: str = "192.168.33.180"
    host_address: str = "192.168.33.30"
    command_port: int = 4096
    data_port: int = 4098
    serial_number: str = ""
    port: str = ""
    baud_rate: int = 115200
    receive_buffer_bytes: int = 16 << 20

    def __post_init__(self) -> None:
        for key in ("card_address", "host_address"):
            require(bool(getattr(self, key)), f"board.{key}", getattr(self, key), "an address")
        require_port("board.command_port", self.command_port)
        require_port("board.data_port", self.data_port)
        require(1200 <= self.baud_rate <= 4_000_000, "board.baud_rate", self.baud_rate, "1200..4000000")
        size = self.receive_buffer_bytes
        require(1 << 16 <= size <= 1 << 30, "board.receive_buffer_bytes", size, "65536..1073741824")


@dataclass(frozen=True, slots=True)
class PoseSettings:
    """Where the vehicle's poses come from.

    Args:
        kind: "oak": visual-inertial odometry of a Luxonis OAK; "zmq": another process publishes poses; "recorded": a
            file; "constant": straight ahead at ``speed_m_s``; "none": no poses, so nothing is fused.
        device_id: of the OAK; empty: the only one.
        endpoint: "zmq": where the publisher is.
        file: "recorded": CSV or JSON lines; relative paths start at the rig's folder.
        speed_m_s: "constant".
        rate_hz: poses a second that are asked for ("oak", "constant").
        imu_rate_hz: of the OAK.
        max_turn_rate_deg_s: above it the odometry is marked as doubtful (BasaltVIO drifts beyond 15 deg/s).
        position_m, roll_deg, pitch_deg, yaw_deg: of the sensor's frame (x forward, y left, z up) in the vehicle frame.
        timeout_s: without a pose for so long the source is said to be dead and, where it can be, restarted.
        poses_of: "zmq" and "recorded": poses are of the sensor, mounted as above, or already of the rig.
        vio: odometry node of the OAK.
        clock: "zmq": clock of the sender's time stamps. "fit": its own, mapped to ours by a line fitted to arrivals;
            "monotonic", "realtime", "tai": this host's clock of that name, which the sender shares (it runs here, or
            PTP or GPS keeps the two together); "utc": its own, with the UTC that each message carries.
    """

    kind: PoseKind = "none"
    device_id: str = ""
    endpoint: str = "tcp://127.0.0.1:5610"
    file: str = ""
    speed_m_s: float = 1.0
    rate_hz: float = 60.0
    imu_rate_hz: float = 200.0
    max_turn_rate_deg_s: float = 15.0
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    timeout_s: float = 1.0
    poses_of: PoseOf = "sensor"
    vio: OdometryNode = "basalt"
    clock: SenderClock = "fit"

    def __post_init__(self) -> None:
        require(self.kind != "oak" or self.poses_of == "sensor", "pose.poses_of", self.poses_of, '"sensor" for an OAK')
        require(self.kind != "recorded" or bool(self.file), "pose.file", self.file, 'a file, with kind = "recorded"')
        require(self.kind != "zmq" or bool(self.endpoint), "pose.endpoint", self.endpoint, "a ZeroMQ address")
        require(abs(self.speed_m_s) <= 60.0, "pose.speed_m_s", self.speed_m_s, "-60..60")
        require(1.0 <= self.rate_hz <= 1000.0, "pose.rate_hz", self.rate_hz, "1..1000")
        require(25.0 <= self.imu_rate_hz <= 1000.0, "pose.imu_rate_hz", self.imu_rate_hz, "25..1000")
        turn = self.max_turn_rate_deg_s
        require(0.0 < turn <= 600.0, "pose.max_turn_rate_deg_s", turn, "above 0, at most 600")
        require(0.05 <= self.timeout_s <= 60.0, "pose.timeout_s", self.timeout_s, "0.05..60")


BoardSettings = CascadeBoard | CaptureCardBoard
