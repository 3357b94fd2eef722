# SPDX-License-Identifier: Apache-2.0
"""Associator: pairs the detections of both radars by range and level, and places the pairs in space.

Geometry. The horizontal radar at ``a`` measures (r_h, u), the vertical one at ``b`` measures (r_v, w), some
milliseconds apart. A rig that travels with v sees a static point from ``b + v dt`` in the rig frame of the horizontal
burst, so the travel between the bursts only moves the vertical board. The four numbers give the point in closed form
(``_locate`` in kernels_association.py): y from u, z from w, x from either range.

Ranges. Each range is moved to a common origin that has the vertical board's lateral and the horizontal board's
vertical coordinate: r^2 = r_h^2 + 2 r_h (d . o) + |o|^2, o the board's place from the origin, d the direction. The
component of d along the own array is measured; the forward one, sqrt(1 - u^2) for want of w, only matters for boards
that are not side by side.

Levels. Either radar compensates the gain along its own array. Across it the horizontal radar loses 2 L(w) and the
vertical one 2 L(u), known only for a pair: P_h + 2 L(w) against P_v + 2 L(u). This difference is that of P_h - 2 L(u)
and P_v - 2 L(w), each known to its own radar: these levels are equal for one target.

Sidelobes. A reflector is detected again in its sidelobes, at its own range and other cosines, and those of both radars
would pair. What is weaker by more than ``sidelobe_db`` than a detection of the same radar at the same range (within
``SIDELOBE_BINS``) is left out.

Rule "optimal". What a pair is worth is its log-likelihood over that of a pair at the gate's edge with equal levels:
(g^2 - dr^2) / 2 sigma^2 - 2 ln cosh(dL / 2 s) - dv^2 / 2 sigma_v^2. Range differences dr are Gaussian, the gate g is
3 sigma; so are differences dv of radial speed, where both radars measured it: beside a moving rig every lateral
direction has its own, which tells the vertical radar's detections apart. Powers of a
reflector that fades independently for both boards (Swerling I) are exponential, so the difference dL of its levels is
logistic, of scale s = 10 / ln 10 dB; partly common fading makes s less. Pairs that cannot be a point of the kept region
(u^2 + w^2 > 1, below ground, too high) are worth nothing. Of all one-to-one assignments the worthiest is taken
(kernels_assignment.py): a detection that fits two partners goes to the one that leaves the better choice to the others.
The level term is convex: among equal ranges the worthiest assignment is that by rank, as the paper has it.

Rule "paper". Detections in order of the common range are cut wherever no pair of both radars within the gate spans the
gap; a part that still holds a pair beyond the gate is cut at its widest gap (of equals the nearest), and so on. Thus
every two detections of different radars in one bin agree within the gate, and neither radar and no grid is preferred.
In every bin with equal numbers of detections they are paired by level rank; with unequal numbers strongest first, until
the discrepancy exceeds ``max_discrepancy_db``. Equal levels go by range, then by the detector's order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from edge.config import RigGeometry
from edge.errors import CaptureError, ConfigError, PoseError
from edge.frames import RADARS, Detections, Float32, Float64, PointCloud
from edge.fusion import kernels_assignment as assignment
from edge.fusion import kernels_association as kernels

if TYPE_CHECKING:
    from edge.rig import Rig

NS_PER_S = 1_000_000_000
SIDELOBE_BINS = 1.0
"""Sidelobes in angle are local maxima on the ridge of the reflector's range, off it by a third of a bin in noise."""
RANGE_SIGMAS = 3.0
"""The range gate in standard deviations of the range difference (rule "optimal")."""
CANDIDATES = 16384
"""Pairs within the range gate that need no larger buffer."""


@dataclass(frozen=True, slots=True)
class AssociationReport:
    """What became of one frame's detections; both sums hold always.

    ``horizontal + vertical = invalid + fov + sidelobe + unmatched + power + 2 pairs`` and
    ``pairs = points + geometry + ground + height``.

    Args:
        horizontal, vertical: detections given.
        invalid: detections that are not finite or not in front of the board.
        fov: detections beyond the field of view.
        sidelobe: detections that may be sidelobes of a stronger one at the same range.
        bins: range bins with detections of both radars (optimal: groups of detections that compete for partners).
        unmatched: detections for which the bin has none of the other radar, or no further one (optimal: detections
            without any possible partner).
        power: detections left over when the discrepancy became too large (optimal: those whose possible partners are
            better off with others).
        pairs: pairs by the rule.
        geometry: pairs with u^2 + w^2 > 1 (optimal: never paired, so 0; so are the next two).
        ground: pairs below ground.
        height: pairs above the largest height.
        points: pairs that became points.
    """

    horizontal: int = 0
    vertical: int = 0
    invalid: int = 0
    fov: int = 0
    sidelobe: int = 0
    bins: int = 0
    unmatched: int = 0
    power: int = 0
    pairs: int = 0
    geometry: int = 0
    ground: int = 0
    height: int = 0
    points: int = 0


def up_in_rig(geometry: RigGeometry) -> Float64:
    """Unit vector up [3] in the rig frame: last row of Rz(yaw) Ry(pitch) Rx(roll), so positive pitch looks down."""
    pitch, roll = math.radians(geometry.pitch_deg), math.radians(geometry.roll_deg)
    return np.array(
        [-math.sin(pitch), math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)], dtype=np.float64
    )


def _columns(detections: Detections) -> tuple[Float32, Float32, Float32]:
    return detections.range_m, detections.direction_cosine, detections.power_db


class Associator:
    """3-D points from the detections of both radars by the rule of the settings (equations: the module's docstring).

    Args:
        rig: with a horizontal and a vertical radar.
    Raises:
        ConfigError: a radar is missing.
    """

    def __init__(self, rig: Rig) -> None:
        missing = [radar for radar in RADARS if radar not in rig.radars]
        if missing:
            raise ConfigError(
                "association needs both radars", value=f"without {missing[0]}", allowed=" and ".join(RADARS)
            )
        radars = [rig.radars[radar] for radar in RADARS]
        antenna, self.settings = rig.settings.antenna, rig.settings.association
        self.last_report = AssociationReport()
        """Of the last frame."""
        bin_m = max(radar.schedule.profile.range_bin_m for radar in radars)
        self._gate_m = self.settings.range_gate_bins * bin_m
        self._sidelobe = np.array([self.settings.sidelobe_db, SIDELOBE_BINS * bin_m])
        self._period_ns = round(max(radar.schedule.frame_period_s for radar in radars) * NS_PER_S)
        self._sine_fov = math.sin(math.radians(self.settings.fov_deg))
        self._mounted_m = np.array([radar.mounting.position_m for radar in radars], dtype=np.float64)
        self._offset_db = np.array([radar.mounting.power_offset_db for radar in radars], dtype=np.float64)
        pattern = (antenna.across_edge_deg, antenna.across_loss_db, antenna.max_loss_db)
        self._pattern = np.array(pattern, dtype=np.float64)
        self._up = np.append(up_in_rig(rig.geometry), rig.geometry.height_m)
        self._limits = np.array([self.settings.ground_margin_m, self.settings.max_height_m], dtype=np.float64)
        spreads = (self._gate_m / RANGE_SIGMAS, self.settings.level_scale_db, self.settings.doppler_sigma_m_s)
        self._scales = np.array([*spreads, 0.5 * RANGE_SIGMAS**2])
        self._weight = np.zeros(CANDIDATES)
        self._counts = np.zeros(11, dtype=np.int64)
        self._board_m = np.zeros((2, 3))
        self._reserve(2 * rig.settings.cfar.max_detections)

    def process(
        self, horizontal: Detections, vertical: Detections, velocity_rig_m_s: Float64 | None = None
    ) -> PointCloud:
        """Points of one frame pair, nearest first (paper: strongest first inside a range bin); see ``last_report``.

        Args:
            horizontal, vertical: detections of one frame number; the imager has put the mounting's range offset in.
            velocity_rig_m_s: float64 [3], rig over ground in rig axes; none: standing still. Turning is neglected.
        Returns:
            PointCloud at the horizontal burst's first chirp; its arrays are the caller's to keep.
        Raises:
            CaptureError: swapped radars, other frame numbers, or bursts more than one frame period apart.
            PoseError: a velocity that is not finite.
        """
        delay_s = self._delay_s(horizontal, vertical)
        self._place_boards(delay_s, velocity_rig_m_s)
        if len(horizontal) + len(vertical) > len(self._common):
            self._reserve(len(horizontal) + len(vertical))
        self._counts[:] = 0
        found = self._pair(horizontal, vertical)
        points = int(
            kernels.solve(
                *(self._pairs, found, self._source, _columns(horizontal), _columns(vertical)),
                *(self._board_m, self._offset_db, self._pattern, self._up, self._limits),
                *(self._xyz, self._out, self._counts),
            )
        )
        self._counts[kernels.PAIRS], self._counts[kernels.POINTS] = found, points
        self.last_report = AssociationReport(len(horizontal), len(vertical), *self._counts.tolist())
        columns = self._out[:, :points].copy()
        return PointCloud(
            *(horizontal.number, horizontal.t_first_chirp_ns, self._xyz[:points].copy()),
            *(columns[0], columns[1], columns[2]),
        )

    def _pair(self, horizontal: Detections, vertical: Detections) -> int:
        split = self._describe(horizontal, 0, 1, 0)
        total = self._describe(vertical, 1, 2, split)
        self._order[:total] = self._indices[:total]
        if self.settings.rule == "optimal":
            return self._assign(horizontal, vertical, split, total)
        kernels.sort(self._order, 0, total, self._common, self._level)
        bins = kernels.divide(
            *(self._order, self._common, total, split, self._gate_m),
            *(self._previous, self._following, self._scratch, self._bound),
        )
        found = kernels.pair(
            *(self._order, self._common, self._level, split, bins, self._bound, self.settings.max_discrepancy_db),
            *(self._key, self._scratch, self._pairs, self._counts),
        )
        return int(found)

    def _assign(self, horizontal: Detections, vertical: Detections, split: int, total: int) -> int:
        kernels.sort(self._order, 0, split, self._common, self._level)
        kernels.sort(self._order, split, total, self._common, self._level)
        candidates = assignment.windows(self._order, split, total, self._common, self._gate_m, self._first, self._start)
        if candidates > len(self._weight):
            self._weight = np.zeros(2 * candidates)
        assignment.weigh(
            *(self._order, split, self._common, self._level, self._source, _columns(horizontal), _columns(vertical)),
            horizontal.doppler_m_s,
            vertical.doppler_m_s,
            self._board_m,
            self._up,
            self._limits,
            self._scales,
            self._first,
            self._start,
            self._weight,
        )
        found = assignment.assign(
            *(self._order, split, total, self._first, self._start, self._weight, self._price, self._assignment),
            *(self._pairs, self._counts),
        )
        return int(found)

    def _describe(self, detections: Detections, row: int, axis: int, start: int) -> int:
        """Fill one radar's detections in from ``start``; returns the end."""
        board = self._relative
        board[0] = 0.5 * (self._board_m[row, 0] - self._board_m[1 - row, 0])
        board[1] = self._board_m[row, axis] - self._board_m[1 - row, axis]
        board[2] = self._offset_db[row]
        end = kernels.describe(
            *(_columns(detections), board, self._pattern, self._sine_fov, self._sidelobe, start),
            *(self._source, self._common, self._level, self._counts),
        )
        return int(end)

    def _delay_s(self, horizontal: Detections, vertical: Detections) -> float:
        """Vertical burst after the horizontal one."""
        given = (horizontal.radar, vertical.radar)
        if given != RADARS or horizontal.number != vertical.number:
            raise CaptureError(
                "detections do not belong together",
                value=f"{given[0]} frame {horizontal.number}, {given[1]} frame {vertical.number}",
                allowed="horizontal, then vertical, of one frame number",
            )
        delay_ns = vertical.t_first_chirp_ns - horizontal.t_first_chirp_ns
        if abs(delay_ns) > self._period_ns:
            raise CaptureError(
                f"bursts of frame {horizontal.number} are too far apart in time",
                value=f"{delay_ns / 1e6:.3f} ms",
                allowed=f"at most one frame period, {self._period_ns / 1e6:.3f} ms",
                action="check both radars' time stamps and the pairing by frame number",
            )
        return delay_ns / NS_PER_S

    def _place_boards(self, delay_s: float, velocity: Float64 | None) -> None:
        """Phase centres at the horizontal burst: travel until the vertical burst moves the vertical board."""
        self._board_m[:] = self._mounted_m
        if velocity is None:
            return
        if velocity.shape != (3,) or not np.isfinite(velocity).all():
            raise PoseError("velocity of the rig is no velocity", value=velocity.tolist(), allowed="[3], finite, m/s")
        self._board_m[1] += velocity * delay_s

    def _reserve(self, total: int) -> None:
        """Buffers for ``total`` detections of both radars together."""
        self._indices = np.arange(total, dtype=np.int64)
        self._source, self._order = np.zeros(total, dtype=np.int64), np.zeros(total, dtype=np.int64)
        self._scratch, self._bound = np.zeros(total + 1, dtype=np.int64), np.zeros(total + 1, dtype=np.int64)
        self._common, self._level, self._key = np.zeros(total), np.zeros(total), np.zeros(total)
        self._previous = np.zeros((2, total), dtype=np.int64)
        self._following = np.zeros((2, total), dtype=np.int64)
        self._first, self._start = np.zeros(total, dtype=np.int64), np.zeros(total + 1, dtype=np.int64)
        self._price, self._assignment = np.zeros((3, total)), np.zeros((4, total), dtype=np.int64)
        self._pairs = np.zeros((2, total // 2), dtype=np.int64)
        self._xyz = np.zeros((total // 2, 3), dtype=np.float32)
        self._out = np.zeros((3, total // 2), dtype=np.float32)
        self._relative = np.zeros(3)
