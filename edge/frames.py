# SPDX-License-Identifier: Apache-2.0
"""The data that flow through the pipeline: shapes, axis orders, units and instants.

Frames of reference (REP-103, right-handed, x forward, y left, z up):

* ``rig``: the pair of radars; x is the common boresight, the horizontal array lies along y, the vertical one along z.
  Its origin stands at the vertical board's lateral and the horizontal board's vertical coordinate.
* ``odom``: the odometry frame, fixed to the ground, z up; poses say where the rig is in it.
* ``window``: the rig frame of the first pose of a fused window.
* ``object``: axes of ``odom``, origin at the centre of the object's input points on the ground (z of the ground is 0).

Times are nanoseconds of CLOCK_MONOTONIC unless a name says otherwise; the instant is part of the name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edge.errors import CaptureError, PoseError
from edge.heatmap_parts import BurstMotion as BurstMotion
from edge.heatmap_parts import DopplerMaps as DopplerMaps
from edge.heatmap_parts import PointResponse as PointResponse

Int16 = NDArray[np.int16]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Complex64 = NDArray[np.complex64]

RadarId = Literal["horizontal", "vertical"]
RADARS: tuple[RadarId, RadarId] = ("horizontal", "vertical")

QUATERNION_NORM_TOLERANCE = 1e-3
FULL_WINDOW_FRAMES = 60
"""Frames from which on a window counts as full (one second at 60 frames/s): confidence, flag of the stream."""


class LossCause(StrEnum):
    """Why a frame did not become a result: ``frames_in = frames_ok + sum(lost.values())`` holds always."""

    TRUNCATED = "truncated"
    """Fewer or more bytes than the layout asks for."""
    ALL_ZERO = "all_zero"
    """Every sample is zero."""
    SATURATED = "saturated"
    """More samples at the rails than the configured share."""
    NOT_FINITE = "not_finite"
    """NaN or infinity in data that must be numbers."""
    UNPAIRED = "unpaired"
    """The other radar's frame of the same number never came."""
    NO_POSE = "no_pose"
    """No pose at the frame's instant: outside the recorded poses or inside a pose gap."""
    BACKWARDS_TIME = "backwards_time"
    """Time stamp or number out of order: not later than that of the frame before, or a number absurdly far ahead."""
    OVERFLOW = "overflow"
    """A queue was full and the oldest frame was dropped."""
    GAP = "gap"
    """The source skipped the frame: its number is missing."""
    SHED = "shed"
    """Left out on purpose because the machine is overloaded."""
    FAILED = "failed"
    """A stage raised an error that it should not, or never came back."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Axis order of one radar's raw burst as it was captured; kernels read it directly, nothing is repacked.

    * ``cascade`` (TI MMWCAS, four device files of one frame joined): ``[device, loop, slot, sample, rx, (I, Q)]``.
      Slot s fires TX 12 - s (hardware: chirp table).
    * ``dca1000`` (single chip, channels not interleaved, two LVDS lanes): ``[loop, slot, rx, sample / 2, 4]`` where the
      innermost four are Q0 Q1 I0 I1 (``iq_order="QI"``) or I0 I1 Q0 Q1 (``"IQ"``); ``device`` is 1.
    * ``dca1000_real`` (the same of a chip without a quadrature mixer, AWR2944): ``[loop, slot, rx, sample]``, real
      samples; ``iq_order`` says nothing.

    Args:
        kind: which of the three.
        devices: radar chips (cascade 4, single chip 1).
        loops: repetitions of the chirp table in one burst.
        slots: chirps of one loop = transmitters that take turns.
        samples: ADC samples of one chirp.
        rx: receivers of one device.
        iq_order: "IQ" when I comes first, "QI" when Q does.
    """

    kind: Literal["cascade", "dca1000", "dca1000_real"]
    devices: int
    loops: int
    slots: int
    samples: int
    rx: int
    iq_order: Literal["IQ", "QI"] = "IQ"

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the raw int16 array in the capture's own axis order."""
        if self.kind == "cascade":
            return (self.devices, self.loops, self.slots, self.samples, self.rx, 2)
        if self.kind == "dca1000_real":
            return (self.loops, self.slots, self.rx, self.samples)
        return (self.loops, self.slots, self.rx, self.samples // 2, 4)

    @property
    def parts(self) -> int:
        """int16 values of one sample: I and Q, or 1 of real samples."""
        return 1 if self.kind == "dca1000_real" else 2

    @property
    def channels(self) -> int:
        """Virtual channels: slots x devices x rx."""
        return self.slots * self.devices * self.rx

    @property
    def int16_count(self) -> int:
        """int16 values of one frame."""
        return self.loops * self.channels * self.samples * self.parts

    @property
    def nbytes(self) -> int:
        """Bytes of one frame."""
        return 2 * self.int16_count


@dataclass(frozen=True, slots=True)
class RadarFrame:
    """One burst of one radar as it was captured.

    Args:
        radar: which radar of the rig.
        number: frame number, counted by the source from 0; both radars' frames of one number belong together.
        t_first_chirp_ns: instant of the first chirp of the burst.
        adc: int16, ``layout.shape``, C-contiguous, ADC codes.
        layout: axis order of ``adc``.
    Raises:
        CaptureError: the array contradicts the layout.
    """

    radar: RadarId
    number: int
    t_first_chirp_ns: int
    adc: Int16
    layout: Layout

    def __post_init__(self) -> None:
        if self.adc.dtype != np.int16 or self.adc.shape != self.layout.shape or not self.adc.flags.c_contiguous:
            raise CaptureError(
                f"{self.radar} frame {self.number}: raw array contradicts the layout",
                value=f"{self.adc.dtype}{list(self.adc.shape)}",
                allowed=f"C-contiguous int16{list(self.layout.shape)}",
                action="check loops, samples and devices of the rig's schedule against the capture",
            )


@dataclass(frozen=True, slots=True)
class Heatmap:
    """Range-angle power of one radar.

    Args:
        radar: which radar.
        number: frame number.
        t_first_chirp_ns: instant of the first chirp of the burst.
        power: float32 [angle, range], linear, range innermost; the imager's buffer, valid until its next frame.
        direction_cosine: float32 [angle], uniform over one period, ascending, -1/(2 pitch) .. +1/(2 pitch).
        range_m: float32 [range], from the phase centre of the array.
        response: how a point target appears; None: unknown, detections are interpolated by plain parabolas.
        doppler: maps whose largest value ``power`` holds; None: Doppler was not kept.
        motion: what was steered with; None: the scene is shown as at the first chirp.
        maps: number of maps of different speeds whose largest value ``power`` holds.
        map_correlation: float64 [maps, angle], |rho|^2 of the noise of two cells by the difference of their maps and of
            their angle bins, both upwards; None: one map, or maps of independent noise.
    """

    radar: RadarId
    number: int
    t_first_chirp_ns: int
    power: Float32
    direction_cosine: Float32
    range_m: Float32
    response: PointResponse | None = None
    doppler: DopplerMaps | None = None
    motion: BurstMotion | None = None
    maps: int = 1
    map_correlation: Float64 | None = None


@dataclass(frozen=True, slots=True)
class Detections:
    """Detections of one radar in one frame, columns of equal length n, strongest first.

    Args:
        radar: which radar.
        number: frame number.
        t_first_chirp_ns: instant of the first chirp of the burst.
        range_m: float32 [n], from the board's phase centre, sub-bin.
        direction_cosine: float32 [n], along the radar's own array, sub-bin; rig axis y (horizontal) or z (vertical).
        power_db: float32 [n], compensated for the antenna gain along the radar's own array.
        doppler_m_s: float32 [n], radial speed, positive away; NaN where it was not measured.
        snr_db: float32 [n], power over the CFAR's noise estimate.
    """

    radar: RadarId
    number: int
    t_first_chirp_ns: int
    range_m: Float32
    direction_cosine: Float32
    power_db: Float32
    doppler_m_s: Float32
    snr_db: Float32

    def __len__(self) -> int:
        return len(self.range_m)


@dataclass(frozen=True, slots=True)
class PointCloud:
    """3-D points of one frame pair.

    Args:
        number: frame number.
        t_ns: reference instant of the points: first chirp of the horizontal radar's burst.
        xyz_m: float32 [n, 3] in the rig frame.
        power_db: float32 [n], mean of both radars' compensated powers.
        range_horizontal_m: float32 [n], as the horizontal radar measured it.
        range_vertical_m: float32 [n], as the vertical radar measured it.
    """

    number: int
    t_ns: int
    xyz_m: Float32
    power_db: Float32
    range_horizontal_m: Float32
    range_vertical_m: Float32

    def __len__(self) -> int:
        return len(self.xyz_m)


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the rig is in the odometry frame.

    Args:
        t_ns: instant of the pose.
        position_m: float64 [3], rig origin in the odometry frame.
        quaternion_xyzw: float64 [4], unit, rotates rig vectors into the odometry frame.
    Raises:
        PoseError: not finite, or the quaternion's norm is off 1 by more than 1e-3.
    """

    t_ns: int
    position_m: Float64
    quaternion_xyzw: Float64

    def __post_init__(self) -> None:
        if self.position_m.shape != (3,) or self.quaternion_xyzw.shape != (4,):
            raise PoseError(
                f"pose at {self.t_ns} ns: wrong shape",
                value=(self.position_m.shape, self.quaternion_xyzw.shape),
                allowed="position [3], quaternion [4] as x, y, z, w",
            )
        norm = float(np.linalg.norm(self.quaternion_xyzw))
        if not (np.isfinite(self.position_m).all() and abs(norm - 1.0) <= QUATERNION_NORM_TOLERANCE):
            raise PoseError(
                f"pose at {self.t_ns} ns is no pose",
                value=f"position {self.position_m.tolist()}, quaternion norm {norm:.6g}",
                allowed=f"finite position, norm 1 +- {QUATERNION_NORM_TOLERANCE}",
                action="check the odometry's axis order (x, y, z, w) and units (metres)",
            )


@dataclass(frozen=True, slots=True)
class FusedCloud:
    """Points of one window of travel.

    Args:
        xyz_m: float32 [n, 3] in the window frame (the rig frame of ``reference``).
        power_db: float32 [n].
        frame_number: int64 [n], frame each point came from.
        reference: first pose of the window.
        t_start_ns, t_end_ns: instants of the first and the last frame of the window.
        travel_m: path length covered inside the window.
        frames: frames in the window, those without points included.
        complete: True when the window covers the configured travel; False when time, a pose gap or the end cut it.
        sensor_m: float64 [3], mean position of the rig over the window's frames, window frame; NaN: not known.
        last: pose of the rig at the window's last frame; None: not known.
    """

    xyz_m: Float32
    power_db: Float32
    frame_number: NDArray[np.int64]
    reference: Pose
    t_start_ns: int
    t_end_ns: int
    travel_m: float
    frames: int
    complete: bool
    sensor_m: Float64
    last: Pose | None = None

    def __len__(self) -> int:
        return len(self.xyz_m)


@dataclass(frozen=True, slots=True)
class ObjectCloud:
    """One segmented object of a fused cloud.

    Args:
        identity: lasts from window to window.
        xyz_m: float32 [n, 3] in the object frame.
        power_db: float32 [n].
        pose: object frame in the odometry frame, at ``t_end_ns``.
        t_start_ns, t_end_ns: instants of the window's first and last frame.
        travel_m: travel inside the window.
        frames: frames of the window.
        complete: as in FusedCloud.
        sensor_m: float64 [3], mean position of the rig over the window's frames, object frame; NaN: not known.
        pose_vehicle: object frame in the vehicle frame (base_link) at ``t_end_ns``; None: not known.
        age_s: from the window's end at which the object was first seen to this one's.
        final: the object has left the window; nothing more will be seen of it.
    """

    identity: int
    xyz_m: Float32
    power_db: Float32
    pose: Pose
    t_start_ns: int
    t_end_ns: int
    travel_m: float
    frames: int
    complete: bool
    sensor_m: Float64
    pose_vehicle: Pose | None = None
    age_s: float = 0.0
    final: bool = False

    def __len__(self) -> int:
        return len(self.xyz_m)


@dataclass(frozen=True, slots=True)
class Shape:
    """A completed object.

    Args:
        identity: of the object.
        class_name: most probable class, "unknown" when the model does not say or is not sure.
        class_probability: class name -> probability, sums to 1, contains "unknown".
        confidence: 0..1, how far the shape can be trusted.
        fine_m: float32 [16384, 3] in the object frame.
        coarse_m: float32 [coarse, 3] in the object frame.
        input: the object the shape was made from.
        model: first 16 hex digits of the model file's SHA-256.
        latency_us: stage name -> microseconds spent.
        seen_points: points of ``input`` that the network saw after thinning; None: all.
    """

    identity: int
    class_name: str
    class_probability: dict[str, float]
    confidence: float
    fine_m: Float32
    coarse_m: Float32
    input: ObjectCloud
    model: str
    latency_us: dict[str, int] = field(default_factory=dict)
    seen_points: int | None = None

    @property
    def input_points(self) -> int:
        """Points that the shape was made from."""
        return len(self.input) if self.seen_points is None else self.seen_points

    @property
    def pose_vehicle(self) -> Pose | None:
        """Object frame in the vehicle frame (base_link) at the end of the window; None: not known."""
        return self.input.pose_vehicle
