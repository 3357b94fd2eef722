# SPDX-License-Identifier: Apache-2.0
"""Settings from TOML: units, unknown keys, refused values; processing settings on a rig."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.errors import ConfigError
from edge.rig import load_rig
from train.simulate.settings import ProcessingSettings, SimulationSettings, read_settings


def write(folder: Path, text: str) -> Path:
    path = folder / "drive.toml"
    path.write_text(text)
    return path


def test_every_group_can_be_set_and_units_named(tmp_path: Path) -> None:
    text = """
        [track]
        frames = 300
        every = 3
        frame_period_ms = 20.0
        [scene]
        side_m = 5.5
        neighbours = 2
        [surface]
        phong = 0.5
        [surface.car]
        reflection = [0.5, 0.9]
        largest_reflection = [0.8, 0.9]
        roughness_m = [1e-5, 2e-5]
        diffuse = [0.001, 0.01]
        edge = [0.2, 0.4]
        point_dbsm = [-20.0, -5.0]
        points = [3, 5]
        imbalance_db = 1.0
        [optics.ground]
        enabled = false
        [link]
        noise_figure_db = 14.0
        [antenna]
        across_edge_deg = 25.0
        [front_end]
        noise_lsb = 10.0
        [odometry]
        time_offset_ms = 5.0
        walk_mm = 8.0
        [processing]
        window = "hann"
    """
    settings = read_settings(write(tmp_path, text))
    assert (settings.track.frames, settings.track.every, settings.track.frame_period_s) == (300, 3, 0.02)
    assert settings.surface.car.points == (3, 5)
    assert not settings.optics.ground.enabled
    assert settings.odometry.time_offset_s == pytest.approx(0.005)
    assert settings.odometry.walk_m == pytest.approx(0.008)
    assert settings.front_end.noise_lsb == 10.0
    assert read_settings(write(tmp_path, "")) == SimulationSettings()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[track]\nframe = 3", "track.frame"),
        ("[track]\nspeed = 0.5", "track.speed"),
        ("[scene]\nneighbours = 1.5", "scene.neighbours"),
        ("[track]\nevery = 0", "track.every"),
        ("[scene]\nside_m = 0.1", "scene.side_m"),
        ("[nothing]\na = 1", "nothing"),
    ],
)
def test_what_cannot_be_is_refused_by_file_and_key(tmp_path: Path, text: str, named: str) -> None:
    with pytest.raises(ConfigError, match=r"drive\.toml") as refused:
        read_settings(write(tmp_path, text))
    assert named in str(refused.value)


def test_processing_changes_the_rig_only_where_it_says() -> None:
    rig = load_rig("cascade_demo")
    assert ProcessingSettings().applied(rig) == rig
    changed = ProcessingSettings("rectangular", 1e-3, False).applied(rig)
    assert changed.settings.heatmap.range_window == changed.settings.heatmap.angle_window == "rectangular"
    assert (changed.settings.cfar.p_fa, changed.settings.heatmap.focus) == (1e-3, False)
    assert changed.settings.fusion == rig.settings.fusion
