# SPDX-License-Identifier: Apache-2.0
"""Association from its definition in float64: plain loops over pairs, the paper's rule and the optimal assignment."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edge.config import AntennaSettings, AssociationSettings, Mounting
from edge.frames import Detections, Float64

SIDELOBE_BINS = 1.0


@dataclass(frozen=True, slots=True)
class Seen:
    """One detection.

    Args:
        horizontal: of the horizontal radar.
        index: place in its columns.
        range_m, cosine, power_db: as detected, power with the mounting's offset.
        common_m: range from the common origin.
        level_db: power less the other radar's two-way loss at this cosine.
        speed_m_s: radial speed, NaN: not measured.
    """

    horizontal: bool
    index: int
    range_m: float
    cosine: float
    power_db: float
    common_m: float
    level_db: float
    speed_m_s: float


@dataclass(frozen=True, slots=True)
class Region:
    """What is kept.

    Args:
        up: [3], unit vector up in the rig frame.
        height_m: rig origin above ground.
        lowest_m, highest_m: above ground.
    """

    up: Float64
    height_m: float
    lowest_m: float
    highest_m: float

    def holds(self, xyz: Float64 | None) -> bool:
        """Whether there is such a point, and inside."""
        return xyz is not None and self.lowest_m <= float(self.up @ xyz) + self.height_m <= self.highest_m


def loss_db(cosine: float, antenna: AntennaSettings) -> float:
    """One-way loss across an array, dB."""
    angle_deg = math.degrees(math.asin(max(-1.0, min(1.0, cosine))))
    return min(antenna.across_loss_db * (angle_deg / antenna.across_edge_deg) ** 2, antenna.max_loss_db)


def described(
    detections: Detections,
    board_m: Float64,
    origin_m: Float64,
    offset_db: float,
    antenna: AntennaSettings,
    settings: AssociationSettings,
    range_bin_m: float,
) -> list[Seen]:
    """Detections inside the field of view that are no sidelobes, with range from the common origin and level."""
    horizontal = detections.radar == "horizontal"
    all_m, all_db = detections.range_m.astype(np.float64), detections.power_db.astype(np.float64)
    seen = []
    for index in range(len(detections)):
        r, c = float(detections.range_m[index]), float(detections.direction_cosine[index])
        p = float(detections.power_db[index])
        if not (math.isfinite(r + c + p) and r > 0.0) or abs(c) > math.sin(math.radians(settings.fov_deg)):
            continue
        same_range = np.abs(all_m - all_m[index]) <= SIDELOBE_BINS * range_bin_m
        if np.any(same_range & np.isfinite(all_db) & (all_db > all_db[index] + settings.sidelobe_db)):
            continue
        direction = np.array([math.sqrt(1 - c * c), c, 0.0] if horizontal else [math.sqrt(1 - c * c), 0.0, c])
        off = board_m - origin_m
        off[2 if horizontal else 1] = 0.0
        common, speed = float(np.linalg.norm(off + r * direction)), float(detections.doppler_m_s[index])
        level = p + offset_db - 2.0 * loss_db(c, antenna)
        seen.append(Seen(horizontal, index, r, c, p + offset_db, common, level, speed))
    return seen


def _within(left: list[Seen], right: list[Seen], gate_m: float) -> bool:
    """Whether any pair of both radars, one on either side, agrees within the gate."""
    return any(a.horizontal != b.horizontal and b.common_m - a.common_m <= gate_m for a in left for b in right)


def range_bins(seen: list[Seen], gate_m: float) -> list[list[Seen]]:
    """Range bins of detections in order of range: cut gaps without link, then the widest gap of what is too wide."""
    for k in range(1, len(seen)):
        if not _within(seen[:k], seen[k:], gate_m):
            return range_bins(seen[:k], gate_m) + range_bins(seen[k:], gate_m)
    if all(a.horizontal == b.horizontal or abs(a.common_m - b.common_m) <= gate_m for a in seen for b in seen):
        return [seen]
    gaps = [seen[k].common_m - seen[k - 1].common_m for k in range(1, len(seen))]
    k = gaps.index(max(gaps)) + 1
    return range_bins(seen[:k], gate_m) + range_bins(seen[k:], gate_m)


def paired(members: list[Seen], max_discrepancy_db: float) -> list[tuple[Seen, Seen]]:
    """The paper's rule in one range bin: by rank; unequal counts stop at the first discrepancy that is too large."""
    ranked = sorted(members, key=lambda s: (-s.level_db, s.common_m, s.index))
    horizontal, vertical = [s for s in ranked if s.horizontal], [s for s in ranked if not s.horizontal]
    pairs = []
    for h, v in zip(horizontal, vertical, strict=False):
        if len(horizontal) != len(vertical) and abs(h.level_db - v.level_db) > max_discrepancy_db:
            break
        pairs.append((h, v))
    return pairs


def worth(h: Seen, v: Seen, sigma_m: float, scale_db: float, sigma_m_s: float) -> float:
    """Log-likelihood of a pair over that of one at 3 sigma in range: Gaussian ranges and speeds, logistic levels."""
    apart, louder = (h.common_m - v.common_m) / sigma_m, abs(h.level_db - v.level_db) / (2.0 * scale_db)
    log_cosh = louder + math.log1p(math.exp(-2.0 * louder)) - math.log(2.0)
    faster = (h.speed_m_s - v.speed_m_s) / sigma_m_s
    return 0.5 * (3.0**2 - apart**2) - 2.0 * log_cosh - (0.0 if math.isnan(faster) else 0.5 * faster**2)


def worthiest(value: Float64) -> list[tuple[int, int]]:
    """One-to-one assignment of the largest total value: ever better augmenting paths (Bellman-Ford), until none helps.

    Args:
        value: [rows, columns]; what is not positive is no candidate.
    Returns:
        Pairs (row, column) in order of the rows.
    """
    rows, columns = value.shape
    owner: dict[int, int] = {}
    while True:
        free = [i for i in range(rows) if i not in owner.values()]
        gain_row: dict[int, float] = dict.fromkeys(free, 0.0)
        gain_column, before = np.full(columns, -np.inf), np.full(columns, -1)
        changed = True
        while changed:
            changed = False
            for i, gain in list(gain_row.items()):
                candidate = np.where(value[i] > 0.0, gain + value[i], -np.inf)
                for j in np.flatnonzero(candidate > gain_column + 1e-12).tolist():
                    if owner.get(j) == i:
                        continue
                    gain_column[j], before[j], changed = candidate[j], i, True
                    if j in owner:
                        gain_row[owner[j]] = gain_column[j] - value[owner[j], j]
        ends = [(gain_column[j], j, -1) for j in range(columns) if j not in owner]
        ends += [(gain_row[i], j, i) for j, i in owner.items() if i in gain_row]  # row i gives its column up
        best, j, _ = max(ends, default=(0.0, -1, -1))
        if best <= 1e-12:
            return sorted((i, j) for j, i in owner.items())
        while j >= 0:
            i = int(before[j])
            left = next((k for k, row in owner.items() if row == i), -1)
            owner.pop(left, None)
            owner[j] = i
            j = left


def located(h: Seen, v: Seen, a: Float64, b: Float64) -> Float64 | None:
    """Point [3] of a pair, boards at a and b: (r_h, u) meets the plane z, (r_v, w) the plane y; mean of both x."""
    y, z = a[1] + h.range_m * h.cosine, b[2] + v.range_m * v.cosine
    squares = (
        h.range_m**2 - (y - a[1]) ** 2 - (z - a[2]) ** 2,
        v.range_m**2 - (z - b[2]) ** 2 - (y - b[1]) ** 2,
    )
    if min(squares) < 0.0:
        return None
    return np.array([0.5 * (a[0] + math.sqrt(squares[0]) + b[0] + math.sqrt(squares[1])), y, z])


def values(
    seen: list[Seen], a: Float64, b: Float64, region: Region, range_bin_m: float, settings: AssociationSettings
) -> tuple[list[Seen], list[Seen], Float64]:
    """What every pair is worth: 0 beyond the range gate and for what is no point to keep.

    Args:
        seen: detections of both radars.
        a, b: [3], phase centres of the horizontal and the vertical board.
        region: what is kept.
        range_bin_m: of both radars.
        settings: gate, level scale.
    Returns:
        Horizontal detections, vertical ones, float64 [horizontal, vertical].
    """
    horizontal, vertical = [s for s in seen if s.horizontal], [s for s in seen if not s.horizontal]
    gate_m = settings.range_gate_bins * range_bin_m
    value = np.zeros((len(horizontal), len(vertical)))
    for i, h in enumerate(horizontal):
        for j, v in enumerate(vertical):
            if abs(h.common_m - v.common_m) <= gate_m and region.holds(located(h, v, a, b)):
                value[i, j] = worth(h, v, gate_m / 3.0, settings.level_scale_db, settings.doppler_sigma_m_s)
    return horizontal, vertical, value


def gathered(
    horizontal: Detections,
    vertical: Detections,
    velocity_rig_m_s: Float64,
    mountings: tuple[Mounting, Mounting],
    range_bin_m: float,
    settings: AssociationSettings,
    antenna: AntennaSettings,
) -> tuple[list[Seen], Float64, Float64]:
    """Detections of both radars in order of range, both phase centres at the horizontal burst; see ``associate``."""
    delay_s = (vertical.t_first_chirp_ns - horizontal.t_first_chirp_ns) * 1e-9
    a = np.array(mountings[0].position_m)
    b = np.array(mountings[1].position_m) + np.asarray(velocity_rig_m_s) * delay_s
    origin = np.array([0.5 * (a[0] + b[0]), b[1], a[2]])
    seen = []
    for detections, board, mounting in ((horizontal, a, mountings[0]), (vertical, b, mountings[1])):
        seen += described(detections, board, origin, mounting.power_offset_db, antenna, settings, range_bin_m)
    seen.sort(key=lambda s: (s.common_m, s.level_db, not s.horizontal, s.index))
    return seen, a, b


def associate(
    horizontal: Detections,
    vertical: Detections,
    velocity_rig_m_s: Float64,
    mountings: tuple[Mounting, Mounting],
    up: Float64,
    height_m: float,
    range_bin_m: float,
    settings: AssociationSettings,
    antenna: AntennaSettings,
) -> Float64:
    """All points of one frame pair.

    Args:
        horizontal, vertical: detections.
        velocity_rig_m_s: [3], rig over ground.
        mountings: of the horizontal and the vertical board.
        up: [3], unit vector up in the rig frame.
        height_m: rig origin above ground.
        range_bin_m: of both radars.
        settings, antenna: gate, limits, pattern.
    Returns:
        float64 [n, 6]: x, y, z, power dB, horizontal range, vertical range; nearest first (paper: strongest first
        inside a range bin).
    """
    seen, a, b = gathered(horizontal, vertical, velocity_rig_m_s, mountings, range_bin_m, settings, antenna)
    region = Region(up, height_m, settings.ground_margin_m, settings.max_height_m)
    if settings.rule == "paper":
        bins = range_bins(seen, settings.range_gate_bins * range_bin_m)
        pairs = [pair for members in bins for pair in paired(members, settings.max_discrepancy_db)]
    else:
        rows, columns, value = values(seen, a, b, region, range_bin_m, settings)
        pairs = [(rows[i], columns[j]) for i, j in worthiest(value)]
    points = []
    for h, v in pairs:
        xyz = located(h, v, a, b)
        if xyz is None or not region.holds(xyz):
            continue
        compensated = (h.power_db + 2 * loss_db(v.cosine, antenna), v.power_db + 2 * loss_db(h.cosine, antenna))
        points.append([*xyz.tolist(), 0.5 * sum(compensated), h.range_m, v.range_m])
    return np.array(points, dtype=np.float64).reshape(-1, 6)
