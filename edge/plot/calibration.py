# SPDX-License-Identifier: Apache-2.0
"""Picture of a calibration: phases and gains of the channels, range profile, heatmap before and after."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.calibration import Calibration
from edge.calibration_capture import PADDING, CaptureMean
from edge.calibration_fit import channel_name
from edge.calibration_make import MadeCalibration
from edge.calibration_quality import Bool
from edge.dsp.imager import Imager
from edge.frames import Float64, Heatmap, RadarFrame, RadarId
from edge.plot.figure import COARSE, HORIZONTAL, INK, MUTED, VERTICAL, dress, new_figure, write
from edge.reference.point_targets import pack
from edge.rig import Radar, Rig

SHOWN_M = 1.5
NEAR_M = 0.2
DYNAMIC_RANGE_DB = 40.0
SHOWN_COSINE = 0.75
FULL_SCALE = 30000.0


def calibration_picture(
    path: Path, made: MadeCalibration, mean: CaptureMean, rig: Rig, radar: RadarId, subtitle: str
) -> Path:
    """Write the picture.

    Args:
        path: of the PNG.
        made: calibration, profile and residuals.
        mean: the capture it was made from, for the heatmaps.
        rig, radar: whose.
        subtitle: what was captured, in one line.
    """
    figure = new_figure(13.0, 8.4, "Calibration from a corner reflector", subtitle)
    (phase, profile, level), (residual, before, after) = figure.subplots(2, 3)
    _channels(phase, _phase_deg(made.calibration), "Phase that is removed", "deg", "twilight", figure)
    _channels(level, made.level_db, "Gain of the channels", "dB", "viridis", figure)
    _residuals(residual, made, rig.radars[radar])
    _profile(profile, made, rig.radars[radar])
    heatmaps = _heatmaps(made, mean, rig, radar)
    peaks_db = [_reflector_db(heatmap, made.calibration.reference_range_m) for heatmap in heatmaps]
    titles = ("Heatmap before", f"Heatmap after: reflector {peaks_db[1] - peaks_db[0]:+.1f} dB")
    for axes, heatmap, title in zip((before, after), heatmaps, titles, strict=True):
        _heatmap(axes, heatmap, title, max(peaks_db), made)
    return write(figure, path)


def _channels(axes: Any, values: Float64, title: str, unit: str, colours: str, figure: Any) -> None:
    turns = {"vmin": -180.0, "vmax": 180.0} if unit == "deg" else {}
    image = axes.imshow(values, aspect="auto", cmap=colours, interpolation="nearest", **turns)
    dress(axes, f"{title} ({unit})", "receiver, capture order", "slot, firing order")
    axes.grid(False)
    figure.colorbar(image, ax=axes, shrink=0.8, pad=0.02).ax.tick_params(labelsize=8, colors=INK)


def _phase_deg(calibration: Calibration) -> Float64:
    """Phase in the middle of the chirp."""
    return np.asarray(np.degrees(np.angle(calibration.gain * np.exp(-1j * np.pi * calibration.range_shift_bins))))


def _residuals(axes: Any, made: MadeCalibration, radar: Radar) -> None:
    slots, receivers = made.residual_deg.shape
    for slot in range(slots):
        at = slot + np.linspace(-0.35, 0.35, receivers)
        axes.plot(at, made.residual_deg[slot], "o", ms=3, color=HORIZONTAL)
    for slot, receiver in np.ndindex(slots, receivers):
        if channel_name(radar.schedule, slot, receiver) in made.quality.repaired:
            axes.plot(slot, 0.0, "x", ms=7, color=VERTICAL)
    rms, repaired = made.quality.separability_rms_deg, len(made.quality.repaired)
    dress(axes, f"Phase beside TX + RX: {rms:.1f} deg rms\n{repaired} channels repaired (crosses)", "", "deg")
    axes.set_xticks(range(slots), [f"TX{number}" for number in radar.schedule.transmitters], rotation=60, fontsize=7)
    axes.set_ylim(-20.0, 20.0)


def _profile(axes: Any, made: MadeCalibration, radar: Radar) -> None:
    range_m = np.arange(len(made.profile)) / PADDING * radar.schedule.profile.range_bin_m
    peak_m = made.peak.range_bin * radar.schedule.profile.range_bin_m
    axes.plot(range_m, 10.0 * np.log10(np.maximum(made.profile, 1e-12)), color=HORIZONTAL, linewidth=0.9)
    axes.axhline(made.peak.floor_db, color=MUTED, linewidth=0.8, linestyle=":")
    axes.axvline(made.calibration.reference_range_m, color=COARSE, linewidth=0.9, linestyle="--")
    axes.plot(peak_m, made.peak.power_db, "v", color=VERTICAL, ms=8)
    stated_m = made.calibration.reference_range_m
    title = f"Range profile, mean over channels\nreflector at {peak_m:.3f} m, stated {stated_m:g} m"
    dress(axes, title, "range (m)", "dB over 1 LSB²")


def _heatmaps(made: MadeCalibration, mean: CaptureMean, rig: Rig, radar: RadarId) -> list[Heatmap]:
    """The averaged capture as one loop, scaled up to full scale, through the rig's imager without and with it."""
    one = replace(rig.radars[radar], schedule=replace(rig.radars[radar].schedule, loops=1))
    layout = one.schedule.layout
    largest = max(np.abs(mean.samples.real).max(), np.abs(mean.samples.imag).max())
    adc = pack(mean.samples[None] * (FULL_SCALE / largest), layout)
    frame = RadarFrame(radar, 0, 0, adc, layout)
    heatmaps = []
    for calibration in (Calibration.identity(layout), made.calibration):
        imager = Imager(replace(one, calibration=calibration), rig.settings.heatmap, rig.settings.antenna)
        heatmaps.append(imager.process(frame))
    return heatmaps


def _near(heatmap: Heatmap, centre_m: float) -> tuple[slice, Bool]:
    first, last = np.searchsorted(heatmap.range_m, (centre_m - SHOWN_M, centre_m + SHOWN_M))
    return slice(int(first), int(last)), np.abs(heatmap.direction_cosine) <= SHOWN_COSINE


def _reflector_db(heatmap: Heatmap, range_m: float) -> float:
    """Strongest cell near the reflector's range, any direction."""
    return float(_db(heatmap)[:, np.abs(heatmap.range_m - range_m) <= NEAR_M].max())


def _db(heatmap: Heatmap) -> Float64:
    return np.asarray(10.0 * np.log10(np.maximum(heatmap.power, 1e-6)))


def _heatmap(axes: Any, heatmap: Heatmap, title: str, top_db: float, made: MadeCalibration) -> None:
    ranges, angles = _near(heatmap, made.calibration.reference_range_m)
    axes.pcolormesh(
        *(heatmap.direction_cosine[angles], heatmap.range_m[ranges], _db(heatmap)[angles, ranges].T),
        cmap="magma",
        vmin=top_db - DYNAMIC_RANGE_DB,
        vmax=top_db,
        shading="nearest",
        rasterized=True,
    )
    dress(axes, title, "direction cosine", "range (m)")
    axes.grid(False)
