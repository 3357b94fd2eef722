# SPDX-License-Identifier: Apache-2.0
"""How two boards are mounted against each other, from a reflector at several places that both of them saw.

A stop at p gives four numbers: each board's range and its direction cosine along its own array. Three of them place the
reflector, the fourth tells about the mounting: r_v - r_h = -d . (b - a) + offset to first order, d the direction. So
without a survey only the boards' relative position across the line of sight and the difference of their range offsets
can be seen; forward distance and range offset look alike (d_x is nearly 1), tilts do not show at all. Surveyed places
show all of it. Every unknown is estimated by Gauss-Newton from the closed-form places; the covariance says what was
seen, and what was not is held at the rig's value and named.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge.config import Mounting
from edge.dsp.antenna import across_loss_db
from edge.errors import CalibrationError, ConfigError
from edge.frames import RADARS, Float64, RadarId
from edge.reflector_stops import Stop
from edge.rig import Rig

LEAST_STOPS = 3
LARGEST_SIGMA = {"m": 0.010, "rad": math.radians(0.3)}
PRIOR_SIGMA = {"m": 0.3, "rad": math.radians(10.0)}
DEFAULT_SURVEY_SIGMA_M = 0.005
STEPS = 12
DIFFERENCE = 1e-6

RELATIVE = ("vertical y_m", "vertical z_m", "vertical range_offset_m")
SURVEYED = ("horizontal y_m", "horizontal z_m", "horizontal range_offset_m")
OPTIONAL = ("vertical x_m", "horizontal x_m", "horizontal turn_x_rad", "horizontal turn_z_rad", "vertical turn_x_rad",
            "vertical turn_y_rad")  # fmt: skip


@dataclass(frozen=True, slots=True)
class Estimate:
    """One unknown: correction to what the rig states, and its standard error."""

    name: str
    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Alignment:
    """Result of ``align``.

    Args:
        mounting: radar -> mounting with the corrections applied.
        estimates: what was estimated, as corrections of the rig's values; ``turn`` is a rotation of the array about a
            rig axis that ``rig.toml`` cannot hold: turn the board back by it.
        held: unknowns that these stops do not show, held at the rig's values.
        power_offset_db, power_sigma_db: what makes the vertical board's powers equal the horizontal one's.
        residual_rms: of all measurements, in their standard errors; about 1 when model and errors are right.
        stops: how many.
        surveyed: whether places were given.
    """

    mounting: dict[RadarId, Mounting]
    estimates: tuple[Estimate, ...]
    held: tuple[str, ...]
    power_offset_db: float
    power_sigma_db: float
    residual_rms: float
    stops: int
    surveyed: bool

    def sigma(self, name: str) -> float | None:
        """Standard error of an unknown; None when it was held."""
        return next((e.sigma for e in self.estimates if e.name == name), None)

    def toml(self) -> str:
        """Tables for ``rig.toml``."""
        lines = [f"# rfconstruct calibrate --align: {self.stops} stops, {'' if self.surveyed else 'not '}surveyed"]
        lines += [f"# not shown by these stops, held at the rig's value: {', '.join(self.held) or 'nothing'}"]
        for radar in RADARS:
            if radar == "horizontal" and not self.surveyed:
                continue
            mounting = self.mounting[radar]
            errors = [self.sigma(f"{radar} {axis}_m") for axis in "xyz"]
            place = ", ".join(f"{value:.4f}" for value in mounting.position_m)
            lines += [
                f"[radars.{radar}.mounting]",
                f"position_m = [{place}]  # +- {', '.join(_error_mm(e) for e in errors)}",
                f"power_offset_db = {mounting.power_offset_db:.2f}"
                + (f"  # +- {self.power_sigma_db:.2f} dB" if radar == "vertical" else ""),
                f"array_sign = {mounting.array_sign}",
                f"range_offset_m = {mounting.range_offset_m:.4f}"
                f"  # +- {_error_mm(self.sigma(f'{radar} range_offset_m'))}",
            ]
        return "\n".join(lines) + "\n"


def _error_mm(sigma_m: float | None) -> str:
    return "held" if sigma_m is None else f"{1e3 * sigma_m:.1f} mm"


def align(rig: Rig, stops: Sequence[Stop], survey_sigma_m: float = DEFAULT_SURVEY_SIGMA_M) -> Alignment:
    """Mounting of the two boards.

    Args:
        rig: two radars with their mounting as measured by hand.
        stops: at least three; all surveyed or none.
        survey_sigma_m: standard error of the surveyed places.
    Raises:
        ConfigError: the rig has not two radars.
        CalibrationError: too few stops, or degenerate ones: the along-array position or the range offset stays open.
    """
    if len(rig.radars) != len(RADARS):
        raise ConfigError(f"rig {rig.name} has one radar: there is nothing to align", allowed="a rig of two radars")
    if len(stops) < LEAST_STOPS:
        raise CalibrationError("too few stops", value=len(stops), allowed=f"{LEAST_STOPS} or more")
    surveyed = all(stop.survey_m is not None for stop in stops)
    needed = RELATIVE + (SURVEYED if surveyed else ())
    names = needed + tuple(n for n in OPTIONAL if surveyed or n == "vertical x_m")
    problem = _Problem(rig, stops, survey_sigma_m)
    held: list[str] = []
    while True:
        free = [name for name in names if name not in held]
        value, sigma, rms = problem.solve(free)
        over = {n: s / LARGEST_SIGMA[_unit(n)] for n, s in zip(free, sigma, strict=True) if n not in needed}
        worst = max(over, key=lambda name: over[name], default="")
        bad = [n for n, s in zip(free, sigma, strict=True) if n in needed and s > LARGEST_SIGMA[_unit(n)]]
        if worst and (over[worst] > 1.0 or bad):
            held.append(worst)
            continue
        if bad:
            _refuse(stops, free, sigma, bad)
        break
    estimates = tuple(Estimate(n, float(v), float(s)) for n, v, s in zip(free, value, sigma, strict=True))
    offset_db, error_db = _power_offset_db(rig, stops, problem.places_m)
    return Alignment(
        *(_corrected(rig, estimates, offset_db), estimates, tuple(held), offset_db, error_db, rms, len(stops), surveyed)
    )


def _unit(name: str) -> str:
    return name.rpartition("_")[2]


def _refuse(stops: Sequence[Stop], free: Sequence[str], sigma: Float64, bad: Sequence[str]) -> None:
    spans = [np.ptp([getattr(stop, radar).cosine for stop in stops]) for radar in RADARS]
    errors = dict(zip(free, sigma, strict=True))
    raise CalibrationError(
        "the stops are degenerate: they leave the mounting open",
        value=f"{', '.join(f'{n} +- {1e3 * errors[n]:.0f} mm' for n in bad)}; {len(stops)} stops, direction cosines "
        f"spread over {spans[0]:.2f} sideways and {spans[1]:.2f} in height",
        allowed=f"+- {1e3 * LARGEST_SIGMA['m']:.0f} mm",
        action="place the reflector left, right, high and low as well, at least 20 degrees apart",
    )


class _Problem:
    """Least squares over the unknown mounting and the stops' places.

    Args:
        rig, stops, survey_sigma_m: as for ``align``.
    """

    def __init__(self, rig: Rig, stops: Sequence[Stop], survey_sigma_m: float) -> None:
        self._base = {r: np.array(rig.radars[r].mounting.position_m, dtype=np.float64) for r in RADARS}
        sights = [[getattr(stop, radar) for stop in stops] for radar in RADARS]
        self._measured = np.array([[(s.range_m, s.cosine) for s in row] for row in sights])
        self._sigma = np.array([[(s.range_sigma_m, s.cosine_sigma) for s in row] for row in sights])
        self._survey = None
        if all(stop.survey_m is not None for stop in stops):
            self._survey = np.array([stop.survey_m for stop in stops], dtype=np.float64)
        self._survey_sigma_m = survey_sigma_m
        self._start = self.places_m = self._closed_form()

    def _closed_form(self) -> Float64:
        """Places [stop, 3] from horizontal range and both cosines, with the rig's mounting."""
        (r_h, u), (r_v, w) = self._measured[0].T, self._measured[1].T
        y, z = self._base["horizontal"][1] + r_h * u, self._base["vertical"][2] + r_v * w
        across = np.square(r_h * u) + np.square(z - self._base["horizontal"][2])
        x = self._base["horizontal"][0] + np.sqrt(np.maximum(np.square(r_h) - across, 0.01 * np.square(r_h)))
        return np.stack((x, y, z), axis=1)

    def solve(self, names: Sequence[str]) -> tuple[Float64, Float64, float]:
        """Corrections and standard errors of ``names``, and the rms residual in standard errors."""
        unknown = np.concatenate((np.zeros(len(names)), self._start.ravel()))
        for _ in range(STEPS):
            residual = self._residual(unknown, names)
            slope = np.empty((len(residual), len(unknown)))
            for k in range(len(unknown)):
                step = np.zeros(len(unknown))
                step[k] = DIFFERENCE
                ahead, behind = self._residual(unknown + step, names), self._residual(unknown - step, names)
                slope[:, k] = (ahead - behind) / (2.0 * DIFFERENCE)
            change = np.linalg.lstsq(slope, -residual)[0]
            unknown = unknown + change
            if np.abs(change).max() < 1e-9:
                break
        self.places_m = unknown[len(names) :].reshape(-1, 3)
        residual = self._residual(unknown, names)
        freedom = max(len(residual) - len(unknown), 1)
        rms = math.sqrt(float(residual @ residual) / freedom)
        sigma = np.sqrt(np.diag(np.linalg.pinv(slope.T @ slope)))[: len(names)] * max(1.0, rms)
        return unknown[: len(names)], sigma, rms

    def _residual(self, unknown: Float64, names: Sequence[str]) -> Float64:
        """All measurements, survey and priors, in standard errors."""
        value = dict(zip(names, unknown[: len(names)], strict=True))
        places = unknown[len(names) :].reshape(-1, 3)
        parts = [np.array([value[name] / PRIOR_SIGMA[_unit(name)] for name in names])]
        for index, radar in enumerate(RADARS):
            moved = np.array([value.get(f"{radar} {axis}_m", 0.0) for axis in "xyz"])
            sight = places - (self._base[radar] + moved)
            range_m = np.linalg.norm(sight, axis=1)
            cosine = sight @ _array_axis(radar, value) / range_m
            expected = np.stack((range_m - value.get(f"{radar} range_offset_m", 0.0), cosine), axis=1)
            parts.append(((self._measured[index] - expected) / self._sigma[index]).ravel())
        if self._survey is not None:
            parts.append(((places - self._survey) / self._survey_sigma_m).ravel())
        return np.concatenate(parts)


def _array_axis(radar: RadarId, value: dict[str, float]) -> Float64:
    """Unit vector along the array: rig y or z, turned by small angles about the two other axes."""
    x, y, z = (value.get(f"{radar} turn_{axis}_rad", 0.0) for axis in "xyz")
    axis = np.array([-z, 1.0, x]) if radar == "horizontal" else np.array([y, -x, 1.0])
    return np.asarray(axis / np.linalg.norm(axis))


def _power_offset_db(rig: Rig, stops: Sequence[Stop], places_m: Float64) -> tuple[float, float]:
    """Offset of the vertical board that makes both boards' levels equal on average, and its standard error.

    The gain across each array is taken in the direction in which that board sees the place: it falls so steeply that
    the distance of the boards matters.
    """
    level_db = []
    for radar, across in zip(RADARS, (2, 1), strict=True):
        sight = places_m - np.asarray(rig.radars[radar].mounting.position_m)
        loss_db = across_loss_db(rig.settings.antenna, sight[:, across] / np.linalg.norm(sight, axis=1))
        level_db.append(np.array([getattr(stop, radar).power_db for stop in stops]) + 2.0 * loss_db)
    difference = level_db[0] - level_db[1]
    own = np.array([math.hypot(stop.horizontal.power_sigma_db, stop.vertical.power_sigma_db) for stop in stops])
    spread = max(float(difference.std(ddof=1)), float(np.sqrt(np.mean(own**2))))
    offset = rig.radars["horizontal"].mounting.power_offset_db + float(difference.mean())
    return offset, spread / math.sqrt(len(stops))


def _corrected(rig: Rig, estimates: Sequence[Estimate], offset_db: float) -> dict[RadarId, Mounting]:
    value = {estimate.name: estimate.value for estimate in estimates}
    result = {}
    for radar in RADARS:
        old = rig.radars[radar].mounting
        x, y, z = (p + value.get(f"{radar} {a}_m", 0.0) for p, a in zip(old.position_m, "xyz", strict=True))
        range_offset_m = old.range_offset_m + value.get(f"{radar} range_offset_m", 0.0)
        result[radar] = replace(old, position_m=(x, y, z), range_offset_m=range_offset_m)
    result["vertical"] = replace(result["vertical"], power_offset_db=offset_db)
    return result
