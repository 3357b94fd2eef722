# SPDX-License-Identifier: Apache-2.0
"""Settings of every stage as frozen dataclasses: units in the names, working defaults, values checked on construction.

``edge/rig.py`` fills them from TOML. A stage takes exactly its own group and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from edge.errors import ConfigError

WindowName = Literal["rectangular", "hann", "taylor"]
CfarKind = Literal["ca", "go", "so", "os"]
DopplerChoice = Literal["auto", "sum", "steer", "fft", "single"]
PointEncoding = Literal["f4", "f2", "i2"]
AssociationRule = Literal["optimal", "paper"]
WINDOWS: tuple[WindowName, ...] = ("rectangular", "hann", "taylor")
CFAR_KINDS: tuple[CfarKind, ...] = ("ca", "go", "so", "os")
DOPPLER_CHOICES: tuple[DopplerChoice, ...] = ("auto", "sum", "steer", "fft", "single")
POINT_ENCODINGS: tuple[PointEncoding, ...] = ("f4", "f2", "i2")
ASSOCIATION_RULES: tuple[AssociationRule, ...] = ("optimal", "paper")


def require(condition: bool, key: str, value: object, allowed: str, action: str = "") -> None:
    """Raise ConfigError for setting ``key`` unless ``condition`` holds."""
    if not condition:
        raise ConfigError(f"setting {key} cannot work", value=value, allowed=allowed, action=action)


@dataclass(frozen=True, slots=True)
class HeatmapSettings:
    """Raw samples to range-angle power.

    Args:
        range_window, angle_window: tapers before the range and the angle FFT.
        taylor_sidelobe_db, taylor_nbar: level of a Taylor window's sidelobes below its peak and how many on either
            side, the main lobe included, keep it; the others fall off.
        angle_bins: length of the angle FFT over the filled array (one period of the direction cosine).
        focus: compensate the spherical wavefront at every range bin (needed below 2 D^2 / lambda = 14 m).
        loops: loops used at most; 0 = all.
        doppler: what becomes of the loops: "sum" adds as many as cannot cancel at the ego speed, "steer" undoes the ego
            motion towards every direction and adds all, "fft" keeps one map per Doppler bin, "single" uses one loop;
            "auto" chooses and says why.
        read_elevation: transform the chirps of the transmitters beside the row too (saturation, elevation check);
            false spares their time.
        max_saturated_share: share of samples at the ADC's rails above which a frame is refused.
    """

    range_window: WindowName = "hann"
    angle_window: WindowName = "hann"
    taylor_sidelobe_db: float = 30.0
    taylor_nbar: int = 4
    angle_bins: int = 256
    focus: bool = True
    loops: int = 0
    doppler: DopplerChoice = "auto"
    read_elevation: bool = True
    max_saturated_share: float = 0.01

    def __post_init__(self) -> None:
        require(self.range_window in WINDOWS, "heatmap.range_window", self.range_window, ", ".join(WINDOWS))
        require(self.angle_window in WINDOWS, "heatmap.angle_window", self.angle_window, ", ".join(WINDOWS))
        sidelobe_db = self.taylor_sidelobe_db
        require(15.0 <= sidelobe_db <= 80.0, "heatmap.taylor_sidelobe_db", sidelobe_db, "15..80")
        require(2 <= self.taylor_nbar <= 20, "heatmap.taylor_nbar", self.taylor_nbar, "2..20")
        power_of_two = self.angle_bins > 0 and self.angle_bins & (self.angle_bins - 1) == 0
        require(
            power_of_two and 64 <= self.angle_bins <= 4096,
            "heatmap.angle_bins",
            self.angle_bins,
            "power of two, 64..4096",
        )
        require(self.loops >= 0, "heatmap.loops", self.loops, ">= 0 (0 = all)")
        require(self.doppler in DOPPLER_CHOICES, "heatmap.doppler", self.doppler, ", ".join(DOPPLER_CHOICES))
        require(0 < self.max_saturated_share <= 1, "heatmap.max_saturated_share", self.max_saturated_share, "0..1")


@dataclass(frozen=True, slots=True)
class CfarSettings:
    """2-D constant false-alarm rate detection on the periodic angle axis.

    Args:
        kind: cell averaging ("ca"), ordered statistic ("os"), or the greatest ("go") or smallest ("so") of the means of
            the ring's nearer and farther half in range; the cells at the tested range belong to neither half.
        p_fa: designed false-alarm probability per cell, on exponentially distributed power.
        correlated: thresholds count the ring's effective number of independent cells, known from the heatmap's
            windows; false takes all cells as independent and lets more false alarms through than designed.
        guard_range, guard_angle: half widths of the guard box in bins; in angle it must cover the main lobe (defaults
            for 86 elements on 256 bins, Hann's lobe being the widest), or a strong target counts as its own noise.
        train_range, train_angle: half widths of the training box in bins; the ring between them is the neighbourhood.
        os_quantile: rank of the ordered statistic as a share of the ring's cells.
        sidelobe_guard: leave out detections that the windows' sidelobes of a stronger detection explain.
        sidelobe_margin_db: how far above those sidelobes a detection must stand; 6 dB is what two equal ones add up to.
        min_range_m: cells nearer are not tested (transmit leakage).
        max_range_m: cells farther hold no detections; 0: the range that the IF filter passes, 0.9 of the largest. What
            lies beyond is mostly leakage that wraps round the range axis.
        max_detections: strongest kept per radar and frame.
    """

    kind: CfarKind = "ca"
    p_fa: float = 1e-6
    correlated: bool = True
    guard_range: int = 2
    guard_angle: int = 6
    train_range: int = 8
    train_angle: int = 14
    os_quantile: float = 0.75
    sidelobe_guard: bool = True
    sidelobe_margin_db: float = 6.0
    min_range_m: float = 0.6
    max_range_m: float = 0.0
    max_detections: int = 512

    def __post_init__(self) -> None:
        require(self.kind in CFAR_KINDS, "cfar.kind", self.kind, ", ".join(CFAR_KINDS))
        require(0.0 < self.p_fa < 0.5, "cfar.p_fa", self.p_fa, "0 < p_fa < 0.5")
        for axis in ("range", "angle"):
            guard, train = getattr(self, f"guard_{axis}"), getattr(self, f"train_{axis}")
            require(
                0 <= guard < train <= 32,
                f"cfar.guard_{axis}, cfar.train_{axis}",
                (guard, train),
                "0 <= guard < train <= 32",
            )
        require(0.0 < self.os_quantile < 1.0, "cfar.os_quantile", self.os_quantile, "between 0 and 1")
        require(0 <= self.sidelobe_margin_db <= 30, "cfar.sidelobe_margin_db", self.sidelobe_margin_db, "0..30")
        require(self.min_range_m >= 0, "cfar.min_range_m", self.min_range_m, ">= 0")
        farther = self.max_range_m == 0 or self.max_range_m > self.min_range_m
        require(farther, "cfar.max_range_m", self.max_range_m, "0 or more than cfar.min_range_m")
        require(self.max_detections > 0, "cfar.max_detections", self.max_detections, "> 0")


@dataclass(frozen=True, slots=True)
class AntennaSettings:
    """One-way element pattern, loss in dB = loss_db * (angle / edge)^2, at most max_loss_db; no board has confirmed it.

    Args:
        along_edge_deg, along_loss_db: in the plane of the radar's own array.
        across_edge_deg, across_loss_db: in the other plane.
        max_loss_db: one-way cap.
    """

    along_edge_deg: float = 70.0
    along_loss_db: float = 6.0
    across_edge_deg: float = 20.0
    across_loss_db: float = 6.0
    max_loss_db: float = 15.0


@dataclass(frozen=True, slots=True)
class AssociationSettings:
    """Pairing of both radars' detections and the region that is kept.

    Args:
        rule: "optimal", one-to-one assignment by range and level, or the paper's, by power rank inside a range bin.
        range_gate_bins: largest difference of the two corrected ranges of a pair, in range bins.
        level_scale_db: rule "optimal": scale of the logistic distribution of a pair's level difference; 4.34 when both
            boards see a reflector fade independently (Swerling I), less when they partly agree.
        doppler_sigma_m_s: rule "optimal": standard deviation of a pair's difference of radial speeds, where both radars
            measured them.
        max_discrepancy_db: rule "paper": unequal counts: pair strongest first and stop beyond this (paper: 3 dB).
        sidelobe_db: detections weaker by more than another one of the radar at the same range are its sidelobes.
        fov_deg: largest angle off boresight along each array (paper: 45).
        max_height_m: points higher above the ground are removed (paper: 3).
        ground_margin_m: points lower than this above the ground are removed; negative keeps some below.
    """

    rule: AssociationRule = "optimal"
    range_gate_bins: float = 0.5
    level_scale_db: float = 3.0
    doppler_sigma_m_s: float = 0.2
    max_discrepancy_db: float = 3.0
    sidelobe_db: float = 25.0
    fov_deg: float = 45.0
    max_height_m: float = 3.0
    ground_margin_m: float = 0.0

    def __post_init__(self) -> None:
        require(self.rule in ASSOCIATION_RULES, "association.rule", self.rule, ", ".join(ASSOCIATION_RULES))
        require(self.level_scale_db > 0, "association.level_scale_db", self.level_scale_db, "> 0")
        require(self.doppler_sigma_m_s > 0, "association.doppler_sigma_m_s", self.doppler_sigma_m_s, "> 0")
        require(self.sidelobe_db > 0, "association.sidelobe_db", self.sidelobe_db, "> 0")
        require(self.max_discrepancy_db > 0, "association.max_discrepancy_db", self.max_discrepancy_db, "> 0")
        require(self.range_gate_bins > 0, "association.range_gate_bins", self.range_gate_bins, "> 0")
        require(0 < self.fov_deg < 90, "association.fov_deg", self.fov_deg, "between 0 and 90")


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """Accumulation over travel.

    Args:
        travel_m: path length of a window (paper: about 3).
        max_time_s: longest window.
        capacity: points the ring buffer holds; the oldest are overwritten and counted.
        max_pose_gap_s: poses further apart are not interpolated; frames inside are counted as lost. Frames further
            apart end a window, so it must exceed the frame period of a slow source.
        min_frames: fewer frames in a window mark it as incomplete.
        hop_m: travel from the start of a window to the start of the next; 0: half of travel_m.
        max_speed_m_s, max_turn_deg_s: a step between two frames that is faster is a jump of the odometry.
    """

    travel_m: float = 3.0
    max_time_s: float = 6.5
    capacity: int = 32768
    max_pose_gap_s: float = 0.1
    min_frames: int = 60
    hop_m: float = 0.0
    max_speed_m_s: float = 20.0
    max_turn_deg_s: float = 180.0

    def __post_init__(self) -> None:
        require(self.travel_m > 0, "fusion.travel_m", self.travel_m, "> 0")
        require(self.max_time_s > 0, "fusion.max_time_s", self.max_time_s, "> 0")
        require(self.capacity >= 1024, "fusion.capacity", self.capacity, ">= 1024")
        require(self.max_pose_gap_s > 0, "fusion.max_pose_gap_s", self.max_pose_gap_s, "> 0")
        require(0 <= self.hop_m <= self.travel_m, "fusion.hop_m", self.hop_m, "0..travel_m (0 = half of it)")
        require(self.max_speed_m_s > 0, "fusion.max_speed_m_s", self.max_speed_m_s, "> 0")
        require(self.max_turn_deg_s > 0, "fusion.max_turn_deg_s", self.max_turn_deg_s, "> 0")


@dataclass(frozen=True, slots=True)
class ObjectSettings:
    """Clustering of a fused cloud and identities.

    Args:
        neighbour_m: points closer than this on the ground plane are of one object.
        core_points: a point with at least this many neighbours (itself included) grows its object.
        min_points: smaller clusters are clutter.
        ground_clearance_m: points lower than this take no part in clustering; they join the nearest object after it.
        max_extent_m: longer clusters are not road users. They are clustered again with links shorter by a quarter, down
            to ``least_neighbour_m``: neighbours along a kerb come apart; what stays too long is dropped (and counted).
        match_m: an object this close to one of the window before keeps its identity.
        forget_s: an identity unseen for longer is retired.
    """

    neighbour_m: float = 0.8
    core_points: int = 4
    min_points: int = 24
    ground_clearance_m: float = 0.15
    max_extent_m: float = 8.0
    least_neighbour_m: float = 0.3
    match_m: float = 1.5
    forget_s: float = 5.0

    def __post_init__(self) -> None:
        require(0 < self.neighbour_m <= 10, "objects.neighbour_m", self.neighbour_m, "0 < neighbour_m <= 10")
        require(self.core_points >= 1, "objects.core_points", self.core_points, ">= 1")
        require(self.min_points >= 1, "objects.min_points", self.min_points, ">= 1")
        require(0 <= self.ground_clearance_m <= 1, "objects.ground_clearance_m", self.ground_clearance_m, "0..1")
        require(self.max_extent_m > 0, "objects.max_extent_m", self.max_extent_m, "> 0")
        least_m = self.least_neighbour_m
        require(0 < least_m <= 10, "objects.least_neighbour_m", least_m, "0 < least_neighbour_m <= 10")
        require(self.match_m >= 0, "objects.match_m", self.match_m, ">= 0")
        require(0 <= self.forget_s <= 3600, "objects.forget_s", self.forget_s, "0..3600")


@dataclass(frozen=True, slots=True)
class CompletionSettings:
    """The network at run time.

    Args:
        model: name of a folder in models/, or a path to one.
        min_points: fewer input points give no shape.
        max_points: more are thinned at random (seeded), never padded.
        intra_op_threads: ONNX Runtime threads.
        min_confidence: below it the class is published as "unknown".
    """

    model: str = "default"
    min_points: int = 64
    max_points: int = 2048
    intra_op_threads: int = 1
    min_confidence: float = 0.5

    def __post_init__(self) -> None:
        require(self.min_points >= 1, "completion.min_points", self.min_points, ">= 1")
        require(self.max_points >= self.min_points, "completion.max_points", self.max_points, ">= min_points")
        require(1 <= self.intra_op_threads <= 64, "completion.intra_op_threads", self.intra_op_threads, "1..64")
        require(0 <= self.min_confidence <= 1, "completion.min_confidence", self.min_confidence, "0..1")


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """Where results are published.

    Args:
        endpoints: ZeroMQ addresses to bind: ipc:// and loopback; with ``key_folder`` others too, under CURVE.
        send_high_water_mark: messages queued per subscriber before the newest are dropped for it; a window and
            its shapes leave in one burst, and a queue of 4 drops some of it even for a subscriber that keeps up.
        shape_encoding: number format of a shape's points: f4, f2 (0.5 mm within 2 m) or i2 (0.5 mm within 32 m).
        latest_endpoints: addresses, of the same kind, of single-frame messages for subscribers that want only the
            newest (ZMQ_CONFLATE).
        key_folder: keys of the appliance and of the clients that may come in (``rfconstruct keys``); "": none.
    """

    endpoints: tuple[str, ...] = ("tcp://127.0.0.1:5600",)
    send_high_water_mark: int = 32
    shape_encoding: PointEncoding = "f4"
    latest_endpoints: tuple[str, ...] = ()
    key_folder: str = ""

    def __post_init__(self) -> None:
        require(len(self.endpoints) > 0, "stream.endpoints", self.endpoints, "at least one address")
        require(
            1 <= self.send_high_water_mark <= 1000, "stream.send_high_water_mark", self.send_high_water_mark, "1..1000"
        )
        known = ", ".join(POINT_ENCODINGS)
        require(self.shape_encoding in POINT_ENCODINGS, "stream.shape_encoding", self.shape_encoding, known)


@dataclass(frozen=True, slots=True)
class PipelineSettings:
    """All processing groups together."""

    heatmap: HeatmapSettings = field(default_factory=HeatmapSettings)
    cfar: CfarSettings = field(default_factory=CfarSettings)
    antenna: AntennaSettings = field(default_factory=AntennaSettings)
    association: AssociationSettings = field(default_factory=AssociationSettings)
    fusion: FusionSettings = field(default_factory=FusionSettings)
    objects: ObjectSettings = field(default_factory=ObjectSettings)
    completion: CompletionSettings = field(default_factory=CompletionSettings)
    stream: StreamSettings = field(default_factory=StreamSettings)


@dataclass(frozen=True, slots=True)
class Mounting:
    """One board on the rig.

    Args:
        position_m: phase centre of its array in the rig frame (x, y, z).
        power_offset_db: added to the board's powers before association.
        array_sign: +1 when antenna positions grow towards +y (horizontal) or +z (vertical), -1 when turned round.
        range_offset_m: added to the board's ranges (cables, delays).
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    power_offset_db: float = 0.0
    array_sign: Literal[1, -1] = 1
    range_offset_m: float = 0.0

    def __post_init__(self) -> None:
        require(self.array_sign in (1, -1), "mounting.array_sign", self.array_sign, "1 or -1")


@dataclass(frozen=True, slots=True)
class RigGeometry:
    """How the rig stands on the vehicle.

    Args:
        height_m: rig origin above the ground.
        yaw_deg, pitch_deg, roll_deg: rig axes in the vehicle (base_link) frame; yaw 90 looks to the left.
        offset_m: rig origin in the vehicle frame.
    """

    height_m: float = 0.8
    yaw_deg: float = 90.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.8)
