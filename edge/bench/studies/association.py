# SPDX-License-Identifier: Apache-2.0
"""Study of the association: precision and recall of 3-D points by rule, on scenes with known truth.

``python -m edge.bench.studies.association [--plot DIR] [--update FILE]`` prints the tables of docs/signal_path.md,
"Association", in about two minutes on one core, or renews them there. Everything is seeded.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.bench.measure import Timing, measure, processor
from edge.bench.studies.association_scenes import (
    LEVELS,
    MOVING,
    RAWS,
    Drive,
    Scene,
    detection_scene,
    detections,
    drives,
    raw_scenes,
)
from edge.bench.studies.association_shapes import completed, distance_cm
from edge.frames import RADARS, Float64
from edge.fusion.association import Associator, up_in_rig
from edge.plot.figure import BOTH, INK, INPUT, MUTED, dress, new_figure, prepare_folder, write
from edge.reference.association import Region, gathered, located, values, worthiest
from edge.rig import Rig, load_rig

Rule = Callable[[Scene], Float64]
Pairs = list[tuple[int, int]]
KEPT_DB = 200.0
"""``sidelobe_db`` that leaves nothing out."""
REFLECTORS = 1200
"""Of every level, in scenes of so many reflectors each."""
RAW_SCENES = 20
NEAR_M, FAR_M, COVERED_M, SUPPORT_M = 0.1, 0.2, 0.15, 0.1
PRODUCTION = ("paper", "paper, sidelobes out", "optimal, sidelobes kept", "optimal")
MARGIN = 1.5
AMBIGUOUS = f"optimal, ambiguous pairs (< {MARGIN} nats) dropped"


@dataclass(slots=True)
class Score:
    """Sums over frames.

    Args:
        frames, points: frames and points in them.
        near, far: points within 10 and 20 cm of a true reflector or surface.
        found, sought: true reflectors with a point within 20 cm; all that could have one.
    """

    frames: int = 0
    points: int = 0
    near: int = 0
    far: int = 0
    found: int = 0
    sought: int = 0

    def add(self, xyz: Float64, truth: Float64, sought: NDArray[np.bool_]) -> None:
        """One frame."""
        distance_m = np.linalg.norm(xyz[:, None] - truth[None], axis=2)
        nearest_m = distance_m.min(axis=1, initial=np.inf)
        self.frames += 1
        self.points += len(xyz)
        self.near += int(np.sum(nearest_m <= NEAR_M))
        self.far += int(np.sum(nearest_m <= FAR_M))
        self.found += int(np.sum(distance_m.min(axis=0, initial=np.inf)[sought] <= FAR_M))
        self.sought += int(sought.sum())

    def merge(self, other: Score) -> None:
        """Add another's sums."""
        for name in Score.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def per_frame(self) -> float:
        """Points a frame."""
        return self.points / max(self.frames, 1)

    @property
    def precision(self) -> tuple[float, float]:
        """Share of points within 10 and within 20 cm."""
        return self.near / max(self.points, 1), self.far / max(self.points, 1)

    @property
    def recall(self) -> float:
        """Share of the sought reflectors that have a point within 20 cm."""
        return self.found / max(self.sought, 1)


def production(rig: Rig) -> dict[str, Rule]:
    """The associator as it runs, by rule, with and without the sidelobe gate."""

    def rule(name: str) -> Rule:
        kept_db = rig.settings.association.sidelobe_db if name in ("paper, sidelobes out", "optimal") else KEPT_DB
        chosen: Any = name.split(",")[0]
        association = replace(rig.settings.association, rule=chosen, sidelobe_db=kept_db)
        associator = Associator(replace(rig, settings=replace(rig.settings, association=association)))
        return lambda scene: associator.process(scene.horizontal, scene.vertical, scene.velocity_rig_m_s).xyz_m.astype(
            np.float64
        )

    return {name: rule(name) for name in PRODUCTION}


def alternatives(rig: Rig) -> dict[str, Rule]:
    """Rules that were considered, in float64 on what every pair is worth (edge/reference/association.py)."""
    mountings = (rig.radars["horizontal"].mounting, rig.radars["vertical"].mounting)
    bin_m = rig.radars["horizontal"].schedule.profile.range_bin_m
    kept = rig.settings.association
    region = Region(up_in_rig(rig.geometry), rig.geometry.height_m, kept.ground_margin_m, kept.max_height_m)

    def rule(choose: Callable[[Float64], Pairs], **changed: float) -> Rule:
        settings: Any = replace(kept, **changed)  # type: ignore[arg-type]

        def points(scene: Scene) -> Float64:
            seen, a, b = gathered(
                *(scene.horizontal, scene.vertical, scene.velocity_rig_m_s, mountings),
                range_bin_m=bin_m,
                settings=settings,
                antenna=rig.settings.antenna,
            )
            rows, columns, value = values(seen, a, b, region, bin_m, settings)
            placed = [located(rows[i], columns[j], a, b) for i, j in choose(value)]
            return np.array([p for p in placed if p is not None], dtype=np.float64).reshape(-1, 3)

        return points

    return {
        "greedy, worthiest pair first": rule(greedy),
        "mutual best": rule(lambda value: sure(value, 0.0)),
        f"mutual best by {MARGIN} nats": rule(lambda value: sure(value, MARGIN)),
        AMBIGUOUS: rule(lambda value: sorted(set(worthiest(value)) & set(sure(value, MARGIN)))),
        "optimal, by range alone": rule(worthiest, level_scale_db=1e6),
        "optimal, Swerling I level scale (4.34 dB)": rule(worthiest, level_scale_db=10.0 / np.log(10.0)),
        "optimal, level scale 2 dB": rule(worthiest, level_scale_db=2.0),
        "optimal, range gate 1 bin": rule(worthiest, range_gate_bins=1.0),
    }


def greedy(value: Float64) -> Pairs:
    """The worthiest pair first, then the worthiest of the rest."""
    left, pairs = value.copy(), []
    while left.size and left.max() > 0.0:
        i, j = np.unravel_index(int(left.argmax()), left.shape)
        pairs.append((int(i), int(j)))
        left[i], left[:, j] = 0.0, 0.0
    return sorted(pairs)


def sure(value: Float64, margin: float) -> Pairs:
    """Pairs that are worth more, by ``margin``, than any other pair of either detection."""
    pairs = []
    for i, j in np.argwhere(value > 0.0).tolist():
        others = np.concatenate([np.delete(value[i], j), np.delete(value[:, j], i), [-np.inf]])
        if value[i, j] >= others.max() + margin:
            pairs.append((i, j))
    return pairs


def scored(rules: Mapping[str, Rule], scenes: Iterable[Scene]) -> dict[str, Score]:
    """Every rule on the same scenes."""
    scores = {name: Score() for name in rules}
    for scene in scenes:
        for name, rule in rules.items():
            scores[name].add(rule(scene), scene.truth_m, scene.sought)
    return scores


@dataclass(frozen=True, slots=True)
class Window:
    """A whole drive under one rule.

    Args:
        xyz_m: float64 [n, 3], all points, odometry frame.
        distance_m: float64 [n], to the surface.
        covered: share of the surface with a point within 15 cm.
        support: int64 [n], other frames with a point within 10 cm.
        frames: of the drive.
    """

    xyz_m: Float64
    distance_m: Float64
    covered: float
    support: NDArray[np.int64]
    frames: int


def window(drive: Drive, rule: Rule) -> Window:
    """Fuse the points of a drive with the true poses."""
    clouds = [rule(scene) @ drive.axes + shift for scene, shift in zip(drive.scenes, drive.shift_m, strict=True)]
    xyz, frame = np.concatenate(clouds), np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    distance = np.array([np.linalg.norm(drive.surface_m - p, axis=1).min() for p in xyz])
    gaps = np.array([np.linalg.norm(xyz - p, axis=1).min() for p in drive.surface_m[::10]])
    support = [len(set(frame[np.linalg.norm(xyz - p, axis=1) <= SUPPORT_M].tolist())) - 1 for p in xyz]
    return Window(xyz, distance, float(np.mean(gaps <= COVERED_M)), np.array(support), len(clouds))


def speed(rig: Rig, seconds: float = 3.0) -> dict[str, Timing]:
    """Both rules on 107 and 90 detections over 12 m of range, and within 3 m."""
    rng, calls = np.random.default_rng(0), {}
    for name, span in (("over 12 m", (1.0, 13.0)), ("within 3 m", (4.0, 7.0))):
        found = []
        for radar, count in zip(RADARS, (107, 90), strict=True):
            columns = (rng.uniform(*span, count), rng.uniform(-0.7, 0.7, count), rng.uniform(0.0, 24.0, count))
            found.append(detections(radar, np.stack(columns, axis=1)))
        scene = Scene(found[0], found[1], np.zeros(3), np.zeros((0, 3)), np.zeros(0, dtype=np.bool_))
        for rule, call in production(rig).items():
            if rule in ("paper", "optimal"):
                calls[f"{rule}, 107 x 90 {name}"] = partial(call, scene)
    return measure(calls, seconds)


def row(name: str, *cells: str) -> str:
    """One line of a Markdown table."""
    return f"| {name} | " + " | ".join(cells) + " |"


def head(*names: str) -> list[str]:
    """First lines of a Markdown table."""
    return ["", row(*names), "|---|" + "---:|" * (len(names) - 1)]


def triple(score: Score) -> str:
    """Points a frame, precision within 20 cm, recall."""
    return f"{score.per_frame:.1f} / {score.precision[1]:.3f} / {score.recall:.3f}"


def level_tables(rig: Rig) -> tuple[list[str], dict[str, dict[str, Score]]]:
    """Detection-level scenes: all rules pooled over the levels, then paper and optimal by level."""
    rules = production(rig) | alternatives(rig)
    pooled, by_level = {name: Score() for name in rules}, {}
    for level in LEVELS:
        rng = np.random.default_rng(1)
        scenes = (detection_scene(rng, level, rig) for _ in range(REFLECTORS // level.targets))
        by_level[level.name] = scored(rules, scenes)
        for name, score in by_level[level.name].items():
            pooled[name].merge(score)
    lines = head("rule, all detection-level scenes", "points a frame", "within 10 cm", "within 20 cm", "recall")
    for name, score in pooled.items():
        near, far = score.precision
        lines.append(row(name, f"{score.per_frame:.1f}", f"{near:.3f}", f"{far:.3f}", f"{score.recall:.3f}"))
    lines += head("scene (points / precision within 20 cm / recall)", "paper", "optimal")
    lines += [row(name, triple(scores["paper"]), triple(scores["optimal"])) for name, scores in by_level.items()]
    return lines, by_level


def raw_table(rig: Rig) -> list[str]:
    """Point reflectors from raw frames."""
    lines = head("raw frames (points / precision within 20 cm / recall)", *PRODUCTION)
    for raw in RAWS:
        scores = scored(production(rig), raw_scenes(np.random.default_rng(2), raw, rig, RAW_SCENES))
        lines.append(row(raw.name, *(triple(scores[name]) for name in PRODUCTION)))
    return lines


def moving_table() -> list[str]:
    """Point reflectors from raw frames of 8 loops beside a moving rig, Doppler kept."""
    rig = load_rig("cascade_pair")
    kept = replace(rig.settings, heatmap=replace(rig.settings.heatmap, doppler="fft"))
    blind = replace(kept, association=replace(kept.association, doppler_sigma_m_s=1e6))
    rules = {
        "paper": production(replace(rig, settings=kept))["paper"],
        "optimal, Doppler not used": production(replace(rig, settings=blind))["optimal"],
        "optimal": production(replace(rig, settings=kept))["optimal"],
    }
    lines = head("moving rig, 8 loops, Doppler kept (points / precision within 20 cm / recall)", *rules)
    for raw in MOVING:
        scenes = raw_scenes(np.random.default_rng(3), raw, replace(rig, settings=kept), RAW_SCENES)
        lines.append(row(raw.name, *map(triple, scored(rules, scenes).values())))
    return lines


def drive_table(rig: Rig) -> tuple[list[str], list[tuple[str, dict[str, Window]]]]:
    """Surfaces from raw frames, fused over 3 m of travel."""
    names = ("points a frame", "within 10 cm", "within 20 cm", "mean distance cm", "surface covered")
    lines = head("drive, rule", *names, "supported", "supported: within 10 cm", "shape CD cm")
    results = []
    for drive in drives(rig):
        rules = production(rig) | {AMBIGUOUS: alternatives(rig)[AMBIGUOUS]}
        windows = {name: window(drive, rule) for name, rule in rules.items()}
        results.append((drive.name, windows))
        for name, w in windows.items():
            good, held = w.distance_m <= NEAR_M, w.support >= 1
            cells = [f"{len(w.xyz_m) / w.frames:.1f}", f"{good.mean():.3f}", f"{np.mean(w.distance_m <= FAR_M):.3f}"]
            cells += [f"{100 * w.distance_m.mean():.1f}", f"{w.covered:.3f}"]
            cells += [f"{held.mean():.2f}", f"{good[held].mean():.3f}"]
            shape = completed(drive, rules[name], rig)
            cells.append("none" if shape is None else f"{distance_cm(shape, drive):.1f}")
            lines.append(row(f"{drive.name}, {name}", *cells))
    return lines, results


def speed_table(rig: Rig) -> list[str]:
    """Both rules on crowded frames."""
    lines = head("time of one frame", f"median ms, one thread of {processor()}", "p99 ms")
    return lines + [row(name, f"{t.median_ms:.3f}", f"{t.p99_ms:.3f}") for name, t in speed(rig).items()]


def picture(path: Path, by_level: Mapping[str, Mapping[str, Score]], drive: tuple[str, dict[str, Window]]) -> Path:
    """Left: precision and recall of every level under both rules. Right: the fused points of a drive from the side."""
    title = "Association: the paper's rule (red) and the optimal assignment (green)"
    figure = new_figure(
        14.0, 5.4, title, "simulated scenes with known truth; points within 20 cm of a reflector are right"
    )
    left, right = figure.subfigures(1, 2)
    names = list(by_level)[::-1]
    measures: dict[str, Callable[[Score], float]] = {
        "precision": lambda s: s.precision[1],
        "recall": lambda s: s.recall,
    }
    for axes, (name, of) in zip(left.subplots(1, 2, sharey=True), measures.items(), strict=True):
        old, new = ([of(by_level[level][rule]) for level in names] for rule in ("paper", "optimal"))
        places = np.arange(len(names))
        axes.hlines(places, old, new, color=MUTED, lw=1.0)
        axes.plot(old, places, "o", color=INPUT, ms=5)
        axes.plot(new, places, "o", color=BOTH, ms=5)
        dress(axes, name, "", "")
        axes.set_yticks(places, names)
    for axes, rule, colour in zip(right.subplots(2, 1), ("paper", "optimal"), (INPUT, BOTH), strict=True):
        w = drive[1][rule]
        good = w.distance_m <= NEAR_M
        axes.plot(*w.xyz_m[good][:, [0, 2]].T, ".", color=colour, ms=4)
        axes.plot(*w.xyz_m[~good][:, [0, 2]].T, "x", color=INK, ms=4, mew=0.8)
        label = f"{drive[0]}, {rule}: {len(good)} points of {w.frames} frames, {int(np.sum(~good))} (x) beyond 10 cm"
        dress(axes, label, "along the track (m)", "height (m)")
        axes.set_aspect("equal")
        axes.set_xlim(-1.5, 4.5)
        axes.set_ylim(0.0, 1.9)
    return write(figure, path)


def report(rig: Rig, folder: Path | None) -> Iterator[str]:
    """Lines of the study, as they become known."""
    lines, by_level = level_tables(rig)
    yield from lines
    yield from raw_table(rig)
    yield from moving_table()
    lines, results = drive_table(rig)
    yield from lines
    yield from speed_table(rig)
    if folder is not None:
        yield f"\npicture: {picture(folder / 'association.png', by_level, results[0])}"


def renewed(text: str, lines: Iterable[str]) -> str:
    """A document with its tables replaced by those in ``lines`` that have the same first heading."""
    old = text.split("\n")
    for table in "\n".join(lines).split("\n\n"):
        new = table.strip().split("\n")
        heading = new[0].split("|")[:2]
        starts = [n for n, line in enumerate(old) if line.startswith("|") and line.split("|")[:2] == heading]
        for start in starts[:1]:
            end = next((n for n in range(start, len(old)) if not old[n].startswith("|")), len(old))
            old[start:end] = new
    return "\n".join(old)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rig", default="cascade_demo", help="rig with two cascade radars (default: %(default)s)")
    parser.add_argument("--plot", type=Path, metavar="DIR", help="write a picture there")
    parser.add_argument("--update", type=Path, metavar="FILE", help="renew the tables of this document")
    args = parser.parse_args()
    if args.plot is not None:
        prepare_folder(args.plot)
    lines = []
    for line in report(load_rig(args.rig), args.plot):
        print(line, flush=True)
        lines += line.split("\n")
    if args.update is not None:
        args.update.write_text(renewed(args.update.read_text(encoding="utf-8"), lines), encoding="utf-8")


if __name__ == "__main__":
    main()
