# SPDX-License-Identifier: Apache-2.0
"""Frames with bad samples: refused with a cause, or processed with a report."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from dsp_radars import cascade_radar, place, single_chip_radar

from edge.array import array_for
from edge.config import AntennaSettings, HeatmapSettings
from edge.dsp.checks import FrameRejected
from edge.dsp.imager import Imager
from edge.errors import CaptureError
from edge.frames import LossCause
from edge.reference.point_targets import make_frame, pack, unpack

SETTINGS = {"cascade": HeatmapSettings(), "dca1000": HeatmapSettings(angle_bins=64)}


def imager_and_frame(make, amplitude=500.0, **options):
    radar = make(**options)
    frame = make_frame(radar, [place(4.0, 5)], amplitude, 9, 0, noise_lsb=10.0)
    return Imager(radar, SETTINGS[frame.layout.kind], AntennaSettings()), frame


@pytest.fixture(params=[cascade_radar, single_chip_radar])
def ready(request):
    return imager_and_frame(request.param)


def test_good_frame_is_reported_clean(ready):
    imager, frame = ready
    imager.process(frame)
    report = imager.last_report
    assert (report.loops, report.saturated_share, report.dead) == (1, 0.0, ())


def test_all_zero_is_refused(ready):
    imager, frame = ready
    with pytest.raises(FrameRejected, match="frame 9: every sample is zero") as refusal:
        imager.process(dataclasses.replace(frame, adc=np.zeros_like(frame.adc)))
    assert refusal.value.cause is LossCause.ALL_ZERO
    assert isinstance(refusal.value, CaptureError)


@pytest.mark.parametrize("rail", [32767, -32768])
def test_saturation_is_counted_exactly_and_refused_beyond_the_limit(rail):
    imager, frame = imager_and_frame(cascade_radar)
    adc = frame.adc.copy()
    adc[1, 0, 3, :50, 2, 0] = rail
    imager.process(dataclasses.replace(frame, adc=adc))
    assert imager.last_report.saturated_share == pytest.approx(50 / (2 * 12 * 16 * 256), rel=1e-6)
    adc[:, :, 3] = rail
    adc[:, :, 3, 0] = 5
    with pytest.raises(FrameRejected, match="saturated") as refusal:
        imager.process(dataclasses.replace(frame, adc=adc))
    assert refusal.value.cause is LossCause.SATURATED


def test_saturation_of_a_single_chip_is_counted():
    imager, frame = imager_and_frame(single_chip_radar)
    adc = frame.adc.copy()
    adc[0, 0, 1, :8] = 32767
    imager.process(dataclasses.replace(frame, adc=adc))
    assert imager.last_report.saturated_share == pytest.approx(32 / (2 * 3 * 4 * 256), rel=1e-6)


def test_clipped_target_is_refused_by_default():
    imager, frame = imager_and_frame(cascade_radar, amplitude=60000.0)
    with pytest.raises(FrameRejected) as refusal:
        imager.process(frame)
    assert refusal.value.cause is LossCause.SATURATED


@pytest.mark.parametrize("value", [0, 7])
def test_dead_channels_are_named_and_the_frame_is_used(value):
    imager, frame = imager_and_frame(cascade_radar)
    adc = frame.adc.copy()
    adc[2, :, :, :, 1] = value
    adc[:, :, 2] = value
    adc[0, :, 11, :, 0] = value
    heatmap = imager.process(dataclasses.replace(frame, adc=adc))
    assert imager.last_report.dead == ("RX10", "TX10", "TX1 RX1")
    assert abs(heatmap.range_m[heatmap.power.max(axis=0).argmax()] - 4.0) < 0.06
    imager.process(frame)
    assert imager.last_report.dead == ()


def test_dead_receiver_of_a_single_chip_is_named():
    imager, frame = imager_and_frame(single_chip_radar)
    samples = unpack(frame.adc, frame.layout)
    samples[:, :, 2] = 3 - 4j
    samples[:, 1, 0] = 0
    imager.process(dataclasses.replace(frame, adc=pack(samples, frame.layout)))
    assert imager.last_report.dead == ("RX3", "TX3 RX1"), "an AWR1843 fires TX1, TX3, TX2"


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 2, 1), (2, 3, 1)])
def test_dead_transmitters_have_the_numbers_of_the_schedule(order):
    board = single_chip_radar()
    schedule = dataclasses.replace(board.schedule, transmitters=order)
    radar = dataclasses.replace(board, schedule=schedule, array=array_for("AWR1843", order))
    frame = make_frame(radar, [place(4.0, 5)], 500.0, 0, 0, noise_lsb=10.0)
    samples = unpack(frame.adc, frame.layout)
    samples[:, 0] = 0
    samples[:, 2, 1] = 0
    imager = Imager(radar, SETTINGS["dca1000"], AntennaSettings())
    imager.process(dataclasses.replace(frame, adc=pack(samples, frame.layout)))
    assert imager.last_report.dead == (f"TX{order[0]}", f"TX{order[2]} RX2")


def test_a_foreign_layout_is_refused():
    imager, _ = imager_and_frame(cascade_radar)
    other = cascade_radar(loops=2)
    with pytest.raises(CaptureError, match="another layout"):
        imager.process(make_frame(other, [place(4.0, 0)], 10.0, 0, 0))


def test_memory_that_is_read_only_or_unaligned_is_read_alike():
    imager, frame = imager_and_frame(cascade_radar)
    expected = imager.process(frame).power.copy()
    shifted = np.frombuffer(b"\0\0" + frame.adc.tobytes(), dtype=np.int16)[1:].reshape(frame.adc.shape)
    assert not shifted.flags.writeable
    for adc in (np.frombuffer(frame.adc.tobytes(), dtype=np.int16).reshape(frame.adc.shape), shifted):
        assert np.array_equal(imager.process(dataclasses.replace(frame, adc=adc)).power, expected)


def test_only_summed_loops_count():
    imager, frame = imager_and_frame(cascade_radar, loops=4)
    adc = frame.adc.copy()
    adc[:, 3] = 32767
    imager = Imager(imager.radar, HeatmapSettings(loops=2), AntennaSettings())
    imager.process(dataclasses.replace(frame, adc=adc))
    assert (imager.last_report.loops, imager.last_report.saturated_share) == (2, 0.0)


def test_the_other_radars_frame_is_refused():
    imager, frame = imager_and_frame(cascade_radar)
    with pytest.raises(CaptureError, match="vertical frame 9"):
        imager.process(dataclasses.replace(frame, radar="vertical"))
