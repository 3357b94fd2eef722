# SPDX-License-Identifier: Apache-2.0
"""The wire format: everything comes back as it was sent, and bad bytes raise WireError only."""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stream_samples import (
    BOOT,
    STAMP,
    detections,
    fused_cloud,
    heatmap,
    object_cloud,
    point_cloud,
    pose,
    shape,
    status,
)

from edge.errors import WireError
from edge.stream import convert
from edge.stream.decode import decode
from edge.stream.messages import (
    CloudMessage,
    DetectionsMessage,
    HeartbeatMessage,
    HeatmapMessage,
    Message,
    PoseMessage,
    ShapeMessage,
    StatusMessage,
)
from edge.stream.wire import FLAG_CUT_WINDOW, FLAG_FEW_FRAMES, Draft, join, pack, split

DRAFTS: dict[str, Draft] = {
    "shape": convert.encode_shape(shape()),
    "cloud": convert.encode_cloud(fused_cloud()),
    "heat": convert.encode_heatmap(heatmap()),
    "det": convert.encode_detections(detections("horizontal"), detections("vertical"), point_cloud()),
    "pose": convert.encode_pose(pose()),
    "status": convert.encode_status(status(), 99),
    "hb": convert.encode_heartbeat("RUN", 99),
}


def sent(draft: Draft) -> Message:
    """The draft after a trip over the wire."""
    message = decode(split(join(pack(draft, STAMP))))
    assert message is not None
    return message


def assert_same(actual: Any, expected: Any) -> None:
    """Equal dataclasses, arrays included, dtypes included."""
    assert type(actual) is type(expected)
    for entry in fields(expected):
        mine, theirs = getattr(actual, entry.name), getattr(expected, entry.name)
        if is_dataclass(theirs):
            assert_same(mine, theirs)
        elif isinstance(theirs, np.ndarray):
            assert mine.dtype == theirs.dtype
            np.testing.assert_array_equal(mine, theirs)
        else:
            assert mine == theirs


def test_shape_comes_back() -> None:
    original, message = shape(), sent(DRAFTS["shape"])
    assert isinstance(message, ShapeMessage)
    np.testing.assert_array_equal(message.fine_m, original.fine_m)
    assert message.input_m is not None
    np.testing.assert_array_equal(message.input_m, original.input.xyz_m)
    assert_same(message.pose, original.input.pose)
    np.testing.assert_allclose(message.size_m, [1.5, 2.0, 1.5])
    assert (message.identity, message.class_name, message.confidence) == (5, "car", 0.5)
    assert message.class_probability == original.class_probability
    assert (message.input_points, message.frames, message.travel_m) == (1, 36, 3.0)
    assert (message.t_start_ns, message.t_end_ns) == (400_000_000, 1_000_000_000)
    assert (message.model, message.latency_us) == ("0123456789abcdef", {"nn": 7000})
    header = message.header
    assert (header.topic, header.frame, header.flags) == ("1/shape/car/", "object", FLAG_FEW_FRAMES)
    assert (header.boot, header.sequence, header.t_ns) == (BOOT, 7, 1_000_000_000)
    assert (header.t_pub_ns, header.utc_ns, header.utc_ok) == (1_000_500_000, 1_800_000_000_000_000_000, True)
    assert (header.source, header.config_hash, header.calibration_hash) == ("sim", b"configur", b"calibrat")


def test_stray_points_do_not_enlarge_a_shape_and_only_seen_points_count() -> None:
    points = np.zeros((16384, 3), np.float32)
    points[:, 0], points[:, 1] = np.linspace(-2, 2, 16384), 0.25
    points[:8] = [[9, -9, 9]] * 4 + [[-9, 9, -9]] * 4
    stray = replace(shape(), fine_m=points, input=object_cloud(3000), seen_points=2048)
    message = sent(convert.encode_shape(stray))
    assert isinstance(message, ShapeMessage)
    np.testing.assert_allclose(message.size_m, [0.98 * 4, 0.0, 0.0], atol=2e-3)
    assert message.input_m is not None
    assert (message.input_points, len(message.input_m)) == (2048, 3000)


def test_frame_numbers_beyond_32_bits_are_refused_not_wrapped() -> None:
    numbers = fused_cloud().frame_number
    largest = sent(convert.encode_cloud(replace(fused_cloud(), frame_number=numbers + (2**32 - 1 - numbers.max()))))
    assert isinstance(largest, CloudMessage)
    assert largest.cloud.frame_number.max() == 2**32 - 1
    for shift in (2**32, -1):
        with pytest.raises(WireError, match="frame number"):
            convert.encode_cloud(replace(fused_cloud(), frame_number=numbers + shift))


def test_cloud_comes_back() -> None:
    message = sent(DRAFTS["cloud"])
    assert isinstance(message, CloudMessage)
    assert_same(message.cloud, fused_cloud())
    unknown = replace(fused_cloud(), sensor_m=np.full(3, np.nan))
    silent = sent(convert.encode_cloud(unknown))
    assert isinstance(silent, CloudMessage)
    assert np.isnan(silent.cloud.sensor_m).all()
    assert message.header.flags == FLAG_CUT_WINDOW


def test_heatmap_comes_back_within_half_a_step() -> None:
    original, message = heatmap("vertical"), sent(convert.encode_heatmap(heatmap("vertical")))
    assert isinstance(message, HeatmapMessage)
    assert (message.radar, message.number, message.header.topic) == ("vertical", 3, "1/heat/vertical/")
    expected_db = 10 * np.log10(original.power)
    assert np.abs(message.power_db - expected_db).max() <= 0.25 + 1e-4
    assert message.power_db.max() == pytest.approx(expected_db.max(), abs=1e-4)
    np.testing.assert_allclose(message.direction_cosine, original.direction_cosine, atol=1e-6)
    np.testing.assert_allclose(message.range_m, original.range_m, atol=1e-6)


def test_heatmap_without_power_is_the_lowest_level_and_nan_is_refused() -> None:
    dark = replace(heatmap(), power=np.zeros((8, 12), np.float32))
    half = dark.power.copy()
    half[0, 0] = 1.0
    message = sent(convert.encode_heatmap(replace(dark, power=half)))
    assert isinstance(message, HeatmapMessage)
    assert message.power_db[0, 0] == 0.0
    assert set(np.unique(message.power_db[1:])) == {-127.5}
    for bad in (np.nan, np.inf, -1.0):
        half[2, 2] = bad
        with pytest.raises(WireError, match="no power"):
            convert.encode_heatmap(replace(dark, power=half))


@pytest.mark.parametrize("empty", [False, True])
def test_detections_come_back(empty: bool) -> None:
    horizontal, vertical = detections("horizontal", 0 if empty else 3), detections("vertical", 5)
    points = point_cloud(0 if empty else 4)
    message = sent(convert.encode_detections(horizontal, vertical, points))
    assert isinstance(message, DetectionsMessage)
    assert_same(message.horizontal, horizontal)
    assert_same(message.vertical, vertical)
    assert_same(message.points, points)


def test_detections_of_one_radar() -> None:
    message = sent(convert.encode_detections(None, detections("vertical")))
    assert isinstance(message, DetectionsMessage)
    assert message.horizontal is None
    assert message.points is None
    assert_same(message.vertical, detections("vertical"))
    with pytest.raises(WireError, match="no radar"):
        convert.encode_detections(None, None)


def test_point_fields_of_detections_are_spherical_coordinates() -> None:
    draft, cloud = DRAFTS["det"], point_cloud()
    records = np.frombuffer(draft.payloads[0], "<f4").reshape(4, 9).astype(float)
    names = [entry[0] for entry in draft.fields["pts"]["fields"]]
    assert names == ["x", "y", "z", "r", "az", "el", "power", "r_h", "r_v"]
    r, az, el = records[:, 3], records[:, 4], records[:, 5]
    back = np.stack([r * np.cos(el) * np.cos(az), r * np.cos(el) * np.sin(az), r * np.sin(el)], axis=1)
    np.testing.assert_allclose(back, cloud.xyz_m, atol=1e-5)


def test_pose_status_and_heartbeat_come_back() -> None:
    message = sent(DRAFTS["pose"])
    assert isinstance(message, PoseMessage)
    assert_same(message.pose, pose())
    state = sent(DRAFTS["status"])
    assert isinstance(state, StatusMessage)
    assert state.status == status()
    beat = sent(DRAFTS["hb"])
    assert isinstance(beat, HeartbeatMessage)
    assert beat.state == "RUN"


@pytest.mark.parametrize(("encoding", "error_m", "step"), [("f4", 0.0, 12), ("f2", 0.5e-3, 6), ("i2", 0.5e-3, 6)])
def test_encodings_of_shapes(encoding: str, error_m: float, step: int) -> None:
    original = shape(16384)
    original.fine_m[:] = np.clip(original.fine_m, -1.99, 1.99)
    draft = convert.encode_shape(original, encoding)
    assert draft.fields["pts"]["step"] == step
    assert len(draft.payloads[0]) == 16384 * step
    message = sent(draft)
    assert isinstance(message, ShapeMessage)
    assert np.abs(message.fine_m - original.fine_m).max() <= error_m * 1.001


@pytest.mark.parametrize(("encoding", "value"), [("f4", np.nan), ("f4", np.inf), ("i2", 32.8), ("f2", 7e4)])
def test_points_that_cannot_be_sent_are_refused(encoding: str, value: float) -> None:
    original = shape()
    original.fine_m[0, 1] = value
    with pytest.raises(WireError, match="does not fit"):
        convert.encode_shape(original, encoding)


def test_coordinates_that_are_no_numbers_are_refused_by_the_receiver() -> None:
    frames = pack(replace(DRAFTS["shape"], payloads=[np.full(6, np.nan, "<f4").tobytes(), bytes(12)]), STAMP)
    with pytest.raises(WireError, match="not finite"):
        decode(frames)
    with pytest.raises(WireError, match="not finite"):
        decode(changed("heat", lambda h: h["axes"][0].update(step=1e300)))


def test_numbers_that_are_none_are_refused_by_the_sender() -> None:
    with pytest.raises(WireError, match="not finite"):
        pack(convert.encode_status(replace(status(), uptime_s=float("nan")), 1), STAMP)
    with pytest.raises(WireError, match="cannot be packed"):
        pack(Draft("1/hb/", "hb", 1, fields={"state": object()}), STAMP)
    with pytest.raises(WireError, match="topic"):
        pack(convert.encode_shape(shape(class_name="a car/#")), STAMP)
    numpy_scalars = Draft("1/hb/", "hb", 1, fields={"state": "RUN", "a": np.float32(1), "b": np.int64(2)})
    assert isinstance(sent(numpy_scalars), HeartbeatMessage)


def changed(name: str, change: Callable[[dict[str, Any]], object]) -> list[bytes]:
    """The frames of a sample whose header was changed."""
    frames = pack(DRAFTS[name], STAMP)
    header = msgpack.unpackb(frames[1])
    change(header)
    return [frames[0], msgpack.packb(header), *frames[2:]]


def test_unknown_keys_fields_and_types_are_ignored() -> None:
    frames = changed("shape", lambda h: h.update(new_key={"deep": [1, 2]}, v=[1, 9]))
    message = decode(frames)
    assert isinstance(message, ShapeMessage)
    assert message.header.minor == 9
    assert decode(changed("shape", lambda h: h.update(type="weather"))) is None
    frames = changed("shape", lambda h: h["pts"]["fields"].append(["mystery", 0, 77, 3]))
    assert isinstance(decode(frames), ShapeMessage)
    assert isinstance(decode(changed("shape", lambda h: h.pop("in"))), ShapeMessage)


@pytest.mark.parametrize(
    ("name", "change", "named"),
    [
        ("hb", lambda h: h.update(v=[2, 0]), "major"),
        ("hb", lambda h: h.update(v=[1]), "major"),
        ("hb", lambda h: h.update(boot=b"short"), "boot"),
        ("hb", lambda h: h.update(seq=-1), "seq"),
        ("hb", lambda h: h.update(seq=True), "seq"),
        ("hb", lambda h: h.pop("t_ns"), "t_ns"),
        ("hb", lambda h: h.update(src="dream"), "src"),
        ("hb", lambda h: h.update(flags=2**32), "flags"),
        ("hb", lambda h: h.update(state="HAPPY"), "state"),
        ("hb", lambda h: h.update(pl=[{"len": 1, "crc32": 0}]), "payloads"),
        ("shape", lambda h: h["pl"][0].update(crc32=1), "check sum"),
        ("shape", lambda h: h["pl"][0].update(len=1), "length"),
        ("shape", lambda h: h.update(conf=float("nan")), "conf"),
        ("shape", lambda h: h.update(cls_p=[1.0]), "cls_p"),
        ("shape", lambda h: h["pose"].update(q=[0.0, 0.0, 0.0, 2.0]), "pose"),
        ("shape", lambda h: h["pts"].update(n=3), "payload is not n"),
        ("shape", lambda h: h["pts"].update(n=2**40), "key n"),
        ("shape", lambda h: h["pts"].update(step=0), "key step"),
        ("shape", lambda h: h["pts"]["fields"].pop(), "no field z"),
        ("shape", lambda h: h["pts"]["fields"][0].__setitem__(1, 10), "does not fit"),
        ("shape", lambda h: h["pts"]["fields"][0].__setitem__(2, 77), "does not fit"),
        ("shape", lambda h: h["pts"]["fields"][0].__setitem__(3, 2), "count"),
        ("heat", lambda h: h["axes"][0].update(n=9), "axes"),
        ("heat", lambda h: h["axes"].pop(), "axes"),
        ("heat", lambda h: h.update(radar="diagonal"), "radar"),
        ("status", lambda h: h.update(level=4), "level"),
        ("status", lambda h: h["radars"]["horizontal"].update(frames_in="many"), "frames_in"),
    ],
)
def test_contradictions_are_named(name: str, change: Callable[[dict[str, Any]], object], named: str) -> None:
    with pytest.raises(WireError, match=named):
        decode(changed(name, change))


@pytest.mark.parametrize(
    "header",
    [
        b"",
        b"\xc1",
        b"\x90",
        b"\xdf\xff\xff\xff\xff",
        b"\x91" * 60_000,
        b"\x81\x01\x02",
        b"\x82\xa1a\x01\xa1a\x02",
        b"\x81\xa1v\xd4\x05\x00",
        b"\x81\xa1v\xd6\xff\x00\x00\x00\x00",
        b"\x81\xa1\xff\x00",
        b"\x80\x00",
        bytes(70_000),
    ],
)
def test_hostile_headers(header: bytes) -> None:
    with pytest.raises(WireError):
        decode([b"1/hb/", header])


@pytest.mark.parametrize("topic", [b"", b"1", b"1/", b"2/hb/", b"1/hb", b"1/HB/", b"1/hb/\n", b"1/a/" * 60, b"\xff/"])
def test_bad_topics(topic: bytes) -> None:
    with pytest.raises(WireError):
        decode([topic, pack(DRAFTS["hb"], STAMP)[1]])


def test_size_limits() -> None:
    payloads = [bytes(3 * 2**20)] * 2
    with pytest.raises(WireError, match="too large"):
        pack(Draft("1/cloud/", "cloud", 0, payloads=payloads), STAMP)
    with pytest.raises(WireError, match="number of frames"):
        pack(Draft("1/cloud/", "cloud", 0, payloads=[b""] * 9), STAMP)


@settings(max_examples=300, deadline=None)
@given(block=st.binary(max_size=200))
def test_random_single_frames(block: bytes) -> None:
    with contextlib.suppress(WireError):
        decode(split(block))


@settings(max_examples=300, deadline=None)
@given(frames=st.lists(st.binary(max_size=100), max_size=4))
def test_random_frames(frames: list[bytes]) -> None:
    for attempt in (frames, [b"1/shape/car/", *frames]):
        with contextlib.suppress(WireError):
            decode(attempt)


SAMPLES = [pack(draft, STAMP) for draft in DRAFTS.values()]


@settings(max_examples=1000, deadline=None)
@given(data=st.data())
def test_mutated_messages(data: st.DataObject) -> None:
    frames = list(data.draw(st.sampled_from(SAMPLES)))
    part = data.draw(st.integers(0, len(frames) - 1))
    mutated = bytearray(frames[part])
    for _ in range(data.draw(st.integers(1, 3))):
        if mutated:
            mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del mutated[data.draw(st.integers(0, len(mutated))) :]
    frames[part] = bytes(mutated)
    with contextlib.suppress(WireError):
        decode(frames)


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=4)
    | st.binary(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


def _paths(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every key and index of a header."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, inner in entries for found in ((*path, key), *_paths(inner, (*path, key)))]


@settings(max_examples=1000, deadline=None)
@given(data=st.data())
def test_any_value_in_any_place_of_a_header(data: st.DataObject) -> None:
    frames = data.draw(st.sampled_from(SAMPLES))
    header = msgpack.unpackb(frames[1])
    *parents, last = data.draw(st.sampled_from(_paths(header)))
    place = header
    for key in parents:
        place = place[key]
    place[last] = data.draw(VALUES)
    with contextlib.suppress(WireError):
        decode([frames[0], msgpack.packb(header), *frames[2:]])


def test_crc_is_the_common_one() -> None:
    assert zlib.crc32(b"123456789") == 0xCBF43926
