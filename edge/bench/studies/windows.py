# SPDX-License-Identifier: Apache-2.0
"""Study of the windows: two reflectors of unequal strength side by side, and drives past objects from end to end.

``python -m edge.bench.studies.windows [--plot DIR]`` prints the tables of docs/signal_path.md, "Angle windows", and
draws them; under a minute on one core. Everything is seeded.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import edge
from edge.bench.studies.association_scenes import person
from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.frames import RADARS, Detections, Float64, RadarFrame, RadarId
from edge.fusion.association import Associator
from edge.plot.figure import BOTH, COARSE, HORIZONTAL, INPUT, MUTED, VERTICAL, dress, new_figure, prepare_folder, write
from edge.reference.drive_by import DriveBy, DriveByScene, place, sample_surface, visible
from edge.reference.point_targets import make_frame
from edge.rig import Rig, load_rig

ANGLE: dict[str, dict[str, Any]] = {
    "rectangular": {"angle_window": "rectangular"},
    "Taylor 25 dB": {"angle_window": "taylor", "taylor_sidelobe_db": 25.0, "taylor_nbar": 3},
    "Taylor 30 dB": {"angle_window": "taylor", "taylor_sidelobe_db": 30.0, "taylor_nbar": 4},
    "Taylor 35 dB": {"angle_window": "taylor", "taylor_sidelobe_db": 35.0, "taylor_nbar": 5},
    "Taylor 45 dB": {"angle_window": "taylor", "taylor_sidelobe_db": 45.0, "taylor_nbar": 8},
    "Hann": {"angle_window": "hann"},
}
"""Windows under study, as the angle axis has them."""
RANGE = {name: both["angle_window"] for name, both in ANGLE.items() if name in ("rectangular", "Taylor 30 dB", "Hann")}
COLOURS = dict(zip(ANGLE, (INPUT, VERTICAL, COARSE, HORIZONTAL, MUTED, BOTH), strict=True))
KINDS: tuple[Any, ...] = ("ca", "os")
SEPARATIONS_DEG = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0)
SEPARATIONS_BINS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)
WEAKER_DB = (0.0, 10.0, 20.0, 30.0)
TRIALS = 24
AMPLITUDE_LSB, NOISE_LSB = 80.0, 25.0
"""The stronger reflector has 52 dB over the noise of a Hann window's cell."""
P_FA = 1e-5
NEAR_M, COVERED_M, SAMPLES = 0.15, 0.2, 1500
SEEDS = 3
"""Sets of four drives, each with scatterers and noise of its own."""
BEST = "Taylor 30 dB"


@dataclass(frozen=True, slots=True)
class Pairs:
    """Two reflectors, one window and one CFAR.

    Args:
        both: float64 [separation, weaker], share of trials in which both were found.
        false: detections of neither, a frame.
    """

    both: Float64
    false: float


def two_reflectors(rig: Rig, axis: str) -> dict[tuple[str, str], Pairs]:
    """Two reflectors at 4 to 8 m, within 30 degrees of boresight, side by side in angle or one behind the other."""
    radar = rig.radars["horizontal"]
    separations = SEPARATIONS_DEG if axis == "angle" else SEPARATIONS_BINS
    settings = ANGLE if axis == "angle" else {name: {"range_window": window} for name, window in RANGE.items()}
    plain = HeatmapSettings(range_window="hann", angle_window="hann")
    imagers = {n: Imager(radar, replace(plain, **s), AntennaSettings()) for n, s in settings.items()}
    keys = [(name, kind) for name in imagers for kind in KINDS]
    detectors = {(n, k): Detector(radar, replace(CfarSettings(), kind=k, p_fa=P_FA)) for n, k in keys}
    both, false = {k: np.zeros((len(separations), len(WEAKER_DB))) for k in keys}, dict.fromkeys(keys, 0)
    for i, j, trial in np.ndindex(len(separations), len(WEAKER_DB), TRIALS):
        rng = np.random.default_rng((i, j, trial))
        truth, apart = _pair(rng, axis, separations[i], radar.schedule.profile.range_bin_m)
        points = np.stack([truth[:, 0] * np.sqrt(1 - truth[:, 1] ** 2), truth[:, 0] * truth[:, 1], [0.0, 0.0]], axis=1)
        levels = AMPLITUDE_LSB * 10.0 ** (np.array([0.0, -WEAKER_DB[j]]) / 20.0) * np.exp(2j * np.pi * rng.random(2))
        points += np.array(radar.mounting.position_m)
        frame = make_frame(radar, points, levels, 0, 0, noise_lsb=NOISE_LSB, rng=rng)
        for name, imager in imagers.items():
            heatmap = imager.process(frame)
            for kind in KINDS:
                found, wrong = _matched(detectors[name, kind].process(heatmap), truth, apart)
                both[name, kind][i, j] += found / TRIALS
                false[name, kind] += wrong
    frames = len(separations) * len(WEAKER_DB) * TRIALS
    return {k: Pairs(both[k], false[k] / frames) for k in keys}


def _pair(rng: np.random.Generator, axis: str, separation: float, bin_m: float) -> tuple[Float64, Float64]:
    """Range and cosine [2, 2] of both reflectors; how far a detection may be off in either."""
    range_m, angle_deg = rng.uniform(4.0, 8.0), rng.uniform(-30.0, 30.0)
    if axis == "angle":
        angles, ranges = np.array([angle_deg, angle_deg + separation]), np.array([range_m, range_m])
        off_deg = min(0.4 * separation, 0.75)
        off = np.array([1.5 * bin_m, np.radians(off_deg) * np.cos(np.radians(angle_deg))])
    else:
        angles, ranges = np.array([angle_deg, angle_deg]), np.array([range_m, range_m + separation * bin_m])
        off = np.array([min(0.4 * separation, 0.75) * bin_m, np.radians(1.5)])
    return np.stack([ranges, np.sin(np.radians(angles))], axis=1), off


def _matched(detections: Detections, truth: Float64, off: Float64) -> tuple[bool, int]:
    """Whether either reflector has its own detection, and how many detections have no reflector."""
    rows = np.stack([detections.range_m, detections.direction_cosine], axis=1).astype(np.float64)
    near = np.all(np.abs(rows[:, None] - truth[None]) <= off, axis=2)
    own = near.any(axis=0).all() and near.any(axis=1).sum() >= 2
    return bool(own), int(np.sum(~near.any(axis=1)))


@dataclass(frozen=True, slots=True)
class Drive:
    """Frame pairs of a drive past one object.

    Args:
        name: of the row.
        frames: raw pairs.
        velocity_rig_m_s: float64 [3].
        axes, shift_m: a point p of frame k lies at p @ axes + shift_m[k] in the odometry frame.
        surface_m, seen_m: samples of the whole surface and of what can be seen from the track.
    """

    name: str
    frames: list[dict[RadarId, RadarFrame]]
    velocity_rig_m_s: Float64
    axes: Float64
    shift_m: Float64
    surface_m: Float64
    seen_m: Float64


def drives(rig: Rig, seed: int, count: int = 20) -> Iterator[Drive]:
    """A car at 3 m, one turned by 30 degrees at 6 m, one turned by 70 degrees at 4 m, and a person at 4 m."""
    with np.load(Path(edge.__file__).parent / "reference" / "demo_car.npz", allow_pickle=False) as mesh:
        car = mesh["vertices"].astype(np.float64), mesh["faces"].astype(np.int32)
    base = DriveBy(frames=count, frame_period_s=6.0 / count, seed=seed)
    for name, mesh_, scene, yaw_deg in (
        ("car at 3 m", car, base, 0.0),
        ("car at 6 m, 30 deg", car, replace(base, lateral_m=6.0), 30.0),
        ("car at 4 m, 70 deg", car, replace(base, lateral_m=4.0), 70.0),
        ("person at 4 m", person(), replace(base, lateral_m=4.0, scatterers=200), 20.0),
    ):
        vertices, faces = place(mesh_[0], scene, yaw_deg), mesh_[1]
        world = DriveByScene(rig.radars, rig.geometry, rig.settings.antenna, vertices, faces, scene)
        frames: list[dict[RadarId, RadarFrame]] = [{r: world.frame(r, n) for r in RADARS} for n in range(count)]
        along_m = np.arange(count) * scene.frame_period_s * scene.speed_m_s
        shift_m = np.stack([along_m, np.zeros(count), np.full(count, rig.geometry.height_m)], axis=1)
        yaw = np.radians(rig.geometry.yaw_deg)
        axes = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        rng = np.random.default_rng(0)
        surface, asked = sample_surface(vertices, faces, 20_000, rng), sample_surface(vertices, faces, SAMPLES, rng)
        seen = np.any([visible(asked, surface, eye) for eye in shift_m[:: count // 4]], axis=0)
        yield Drive(name, frames, world.velocity_rig_m_s, axes, shift_m, surface.points_m, asked.points_m[seen])


@dataclass(frozen=True, slots=True)
class Score:
    """End to end over all drives.

    Args:
        detections, points: a frame; detections of both radars.
        precision: share of points within 15 cm of the surface.
        recall: share of the visible surface with a point within 20 cm, mean over drives.
        by_seed: the recall of each seed's drives.
    """

    detections: float
    points: float
    precision: float
    recall: float
    by_seed: tuple[float, ...]


def end_to_end(rig: Rig, all_drives: list[Drive]) -> Score:
    """Imager, detector and association as the rig sets them, all frames of a drive together."""
    imagers = {r: Imager(rig.radars[r], rig.settings.heatmap, rig.settings.antenna) for r in RADARS}
    detectors = {r: Detector(rig.radars[r], rig.settings.cfar) for r in RADARS}
    associator = Associator(rig)
    found, points, near, recall, frames = 0, 0, 0, [], 0
    for drive in all_drives:
        cloud = []
        for number, pair in enumerate(drive.frames):
            seen = [detectors[r].process(imagers[r].process(pair[r], drive.velocity_rig_m_s)) for r in RADARS]
            xyz = associator.process(seen[0], seen[1], drive.velocity_rig_m_s).xyz_m.astype(np.float64)
            cloud.append(xyz @ drive.axes + drive.shift_m[number])
            found += len(seen[0]) + len(seen[1])
        xyz, frames = np.concatenate(cloud), frames + len(drive.frames)
        points += len(xyz)
        near += int(np.sum(_nearest_m(xyz, drive.surface_m) <= NEAR_M))
        recall.append(float(np.mean(_nearest_m(drive.seen_m, xyz) <= COVERED_M)))
    by_seed = tuple(float(np.mean(part)) for part in np.array_split(recall, SEEDS))
    return Score(found / frames, points / frames, near / max(points, 1), float(np.mean(recall)), by_seed)


def _nearest_m(xyz: Float64, others: Float64) -> Float64:
    """Distance [n] of every point to the nearest of the others; infinite without any."""
    nearest = [
        np.sqrt(np.square(xyz[n : n + 64, None] - others[None]).sum(axis=2).min(axis=1, initial=np.inf))
        for n in range(0, len(xyz), 64)
    ]
    return np.concatenate(nearest) if nearest else np.zeros(0)


def changed(rig: Rig, heatmap: dict[str, Any], cfar: dict[str, Any]) -> Rig:
    """The rig with other windows and another CFAR."""
    settings = rig.settings
    return replace(
        rig,
        settings=replace(settings, heatmap=replace(settings.heatmap, **heatmap), cfar=replace(settings.cfar, **cfar)),
    )


def scores(rig: Rig) -> dict[tuple[str, str], Score]:
    """End to end: angle windows with a Hann range window, one window on both axes, other CFARs, no sidelobe guard."""
    all_drives = [drive for seed in range(1, SEEDS + 1) for drive in drives(rig, seed)]

    def score(window: dict[str, Any], **cfar: Any) -> Score:
        return end_to_end(changed(rig, window, cfar), all_drives)

    table = {}
    for name, window in ANGLE.items():
        across = {"range_window": "hann", **window}
        for kind in KINDS:
            table[name, kind.upper()] = score(across, kind=kind)
        if name != "Hann":
            table[f"{name}, range too", "OS"] = score(both_axes(window), kind="os")
    for kind in ("ca", "go", "so"):
        table[f"{BEST}, range too", kind.upper()] = score(both_axes(ANGLE[BEST]), kind=kind)
    for name in ("rectangular", BEST, "Hann"):
        table[f"{name}, range too", "OS, no guard"] = score(both_axes(ANGLE[name]), kind="os", sidelobe_guard=False)
    return table


def both_axes(window: dict[str, Any]) -> dict[str, Any]:
    """The angle window on the range axis as well."""
    return {**window, "range_window": window["angle_window"]}


def resolved(pairs: Pairs, separations: tuple[float, ...], weaker: int) -> str:
    """Smallest separation from which on nine of ten trials find both."""
    good = pairs.both[:, weaker] >= 0.9
    first = len(good) - int(np.argmin(good[::-1])) if not good.all() else 0
    return f"{separations[first]:g}" if first < len(good) else "none"


def pair_table(title: str, table: dict[tuple[str, str], Pairs], separations: tuple[float, ...]) -> str:
    """Markdown: resolution by level difference, lost pairs, false detections."""
    head = ["window", "CFAR", *(f"{title}, {level:g} dB" for level in WEAKER_DB), "pairs lost %", "false/frame"]
    rows = [head, ["---"] * len(head)]
    for (name, kind), pairs in table.items():
        best = [resolved(pairs, separations, j) for j in range(len(WEAKER_DB))]
        rows.append([name, kind.upper(), *best, f"{100 * (1 - pairs.both.mean()):.0f}", f"{pairs.false:.2f}"])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def score_table(table: dict[tuple[str, str], Score]) -> str:
    """Markdown: end-to-end figures."""
    head = ["window", "CFAR", "detections/frame", "points/frame", "precision %", "recall %", "by seed"]
    rows = [head, ["---"] * len(head)]
    for (name, kind), s in table.items():
        by_seed = ", ".join(f"{100 * recall:.1f}" for recall in s.by_seed)
        figures = [f"{s.detections:.1f}", f"{s.points:.1f}", f"{100 * s.precision:.1f}", f"{100 * s.recall:.1f}"]
        rows.append([name, kind, *figures, by_seed])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def draw(folder: Path, pairs: dict[tuple[str, str], Pairs], table: dict[tuple[str, str], Score]) -> Path:
    """Share of pairs found over separation by level difference, and recall over precision; one PNG."""
    subtitle = "86-element row: two reflectors side by side at 52 dB, and four drives past objects from end to end"
    figure = new_figure(13.0, 6.4, "Angle windows", subtitle)
    axes = figure.subplots(2, 4, width_ratios=[1, 1, 1, 1])
    for row, kind in enumerate(KINDS):
        for column, j in enumerate((0, 2, 3)):
            panel = axes[row, column]
            for name in ANGLE:
                panel.plot(SEPARATIONS_DEG, 100 * pairs[name, kind].both[:, j], color=COLOURS[name], lw=1.4, label=name)
            panel.set_ylim(-3, 103)
            title = f"{kind.upper()}, second one {WEAKER_DB[j]:g} dB weaker"
            _label(panel, title, "separation, degrees", "both found, %")
        panel = axes[row, 3]
        for name in ANGLE:
            score = table[name, kind.upper()]
            panel.plot(100 * score.recall, 100 * score.precision, "o", color=COLOURS[name], label=name)
        _label(panel, f"{kind.upper()}, drives end to end", "recall, %", "precision, %")
    axes[0, 0].legend(fontsize=7, frameon=False)
    return write(figure, folder / "windows.png")


def _label(panel: Any, title: str, x_label: str, y_label: str) -> None:
    dress(panel, title, x_label, y_label)
    panel.set_aspect("auto")


def main() -> None:
    """Print the tables; draw them when a folder is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plot", type=Path, metavar="DIR", help="folder of the picture")
    folder = parser.parse_args().plot
    if folder is not None:
        prepare_folder(folder)
    rig = load_rig("cascade_demo")
    in_angle = two_reflectors(rig, "angle")
    print(pair_table("degrees apart", in_angle, SEPARATIONS_DEG), end="\n\n")
    print(pair_table("bins apart", two_reflectors(rig, "range"), SEPARATIONS_BINS), end="\n\n")
    table = scores(rig)
    print(score_table(table))
    if folder is not None:
        print(draw(folder, in_angle, table))


if __name__ == "__main__":
    main()
