# SPDX-License-Identifier: Apache-2.0
"""Shards: what is written comes back to a millimetre, any changed byte is noticed, a cut file never counts."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.errors import ConfigError
from train.simulate import shards
from train.simulate.shards import Cloud, ObjectInfo, Shard, ShardError, check_cloud, decode, encode, read_shard

INFO = {"car/one": ObjectInfo("train", "someone", "CC-BY-4.0", "by someone", (4.0, 1.8, 1.5))}


def cloud(n: int, variation: int = 0, seed: int = 1) -> Cloud:
    rng = np.random.default_rng(seed)
    return Cloud(
        "car/one",
        "simulated",
        variation,
        seed,
        rng.normal(0, 2, (n, 3)).astype(np.float32),
        rng.normal(90, 8, n).astype(np.float32),
        np.sort(rng.integers(0, 360, n)),
        np.array([1.0, -4.0, 0.8]),
        np.linalg.qr(rng.normal(size=(3, 3)))[0],
        np.array([0.1, -0.2, 0.0]),
        120,
        2.5,
        {"within_10cm": 0.9},
    )


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 300), min_size=1, max_size=6))
def test_what_is_written_comes_back(counts: list[int]) -> None:
    clouds = tuple(cloud(n, variation, seed=n) for variation, n in enumerate(counts))
    back = decode(encode(Shard("identity", 7, INFO, clouds)), "x")
    assert (back.identity, back.number, back.objects) == ("identity", 7, INFO)
    for before, after in zip(clouds, back.clouds, strict=True):
        assert np.abs(after.xyz_m - before.xyz_m).max(initial=0) <= 0.5e-3 + 1e-6
        assert np.abs(after.power_db - before.power_db).max(initial=0) <= 0.5 + 1e-4
        np.testing.assert_array_equal(after.frame_number, before.frame_number)
        np.testing.assert_allclose(after.rotation, before.rotation, atol=1e-9)
        np.testing.assert_allclose(after.translation_m, before.translation_m, atol=1e-6)
        np.testing.assert_allclose(after.sensor_m, before.sensor_m, atol=1e-4)
        assert after.record() == before.record()


def test_points_are_put_in_the_order_of_their_frames() -> None:
    mixed = cloud(50)
    turned = replace(mixed, **{k: getattr(mixed, k)[::-1] for k in ("xyz_m", "power_db", "frame_number")})
    back = decode(encode(Shard("i", 0, INFO, (turned,))), "x").clouds[0]
    np.testing.assert_array_equal(back.frame_number, mixed.frame_number)


def test_a_point_takes_at_most_eight_bytes() -> None:
    clouds = tuple(cloud(500, k, seed=k) for k in range(16))
    assert len(encode(Shard("i", 0, INFO, clouds))) / sum(map(len, clouds)) <= 8.0


def test_any_changed_byte_and_any_cut_is_noticed() -> None:
    data = encode(Shard("identity", 0, INFO, (cloud(40),)))
    for position in range(len(data)):
        changed = bytearray(data)
        changed[position] ^= 0x10
        with pytest.raises(ShardError):
            decode(bytes(changed), "x")
    for length in range(0, len(data), 7):
        with pytest.raises(ShardError):
            decode(data[:length], "x")


def test_a_failed_cloud_keeps_its_reason() -> None:
    failed = Cloud.failed("car/one", "simulated", 3, 9, "ValueError: no")
    back = decode(encode(Shard("i", 0, INFO, (failed, cloud(5)))), "x").clouds
    assert (back[0].error, len(back[0]), len(back[1])) == ("ValueError: no", 0, 5)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"xyz_m": np.full((5, 3), 40.0, np.float32)}, "xyz_m"),
        ({"xyz_m": np.full((5, 3), np.nan, np.float32)}, "xyz_m"),
        ({"power_db": np.array([0, 0, 0, 0, 300], np.float32)}, "power_db"),
        ({"power_db": np.full(5, np.nan, np.float32)}, "power_db"),
        ({"frame_number": np.array([-3, 0, 1, 2, 3])}, "frame_number"),
        ({"travel_m": float("nan")}, "truth"),
        ({"sensor_m": np.full(3, np.inf)}, "truth"),
        ({"statistics": {"coverage": float("nan")}}, "statistics"),
    ],
)
def test_what_the_format_cannot_hold_is_refused(changes: dict[str, object], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        check_cloud(replace(cloud(5), **changes))  # type: ignore[arg-type]


def test_a_write_that_is_cut_leaves_the_file_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "one.clouds"
    shards.write_whole(path, b"before")

    def no_space(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(OSError, match="No space"):
        shards.write_whole(path, b"after")
    assert path.read_bytes() == b"before"


def test_a_file_that_is_not_there_is_an_error_of_its_own(tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="cannot be read"):
        read_shard(tmp_path / "none.clouds")
