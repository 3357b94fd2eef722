# SPDX-License-Identifier: Apache-2.0
"""DCA1000 files: the real IWR6843 frame with its room, files cut at any byte, sizes that do not fit."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.errors import CaptureError
from edge.frames import Layout, LossCause, RadarFrame
from edge.sources.base import Loss, loops_that_fit
from edge.sources.dca1000_file import Dca1000File

SMALL = Layout("dca1000", 1, 4, 3, 16, 4, "QI")


def rig(layout: Layout, period_s: float = 0.15) -> Any:
    schedule = SimpleNamespace(layout=layout, frame_period_s=period_s)
    return SimpleNamespace(name="small", radars={"vertical": SimpleNamespace(schedule=schedule)})


def samples(frames: int) -> np.ndarray[Any, np.dtype[np.int16]]:
    return np.random.default_rng(1).integers(-900, 900, (frames, *SMALL.shape), dtype=np.int16)


def test_real_room(radar_data: Path) -> None:
    """Desk echo at 1.5 to 1.7 m and wall at 8.45 m at zero Doppler; echoes at positive beat frequencies: I is first."""
    layout = Layout("dca1000", 1, 85, 3, 512, 4, "IQ")
    path = radar_data / "iwr6843_frame" / "iwr6843_adc_data.bin"
    source = Dca1000File(path, rig(layout), "vertical")
    (frame,) = source
    assert isinstance(frame, RadarFrame)
    assert source.total_frames == 1
    pairs = frame.adc.astype(np.float64)
    signal = (pairs[..., :2] + 1j * pairs[..., 2:]).reshape(85, 3, 4, 512).mean(axis=0)
    power = (np.abs(np.fft.fft(signal * np.hanning(512))) ** 2).sum(axis=(0, 1))
    range_m = np.arange(512) * 0.0393
    near = (range_m > 1.0) & (range_m < 3.0)
    assert 1.5 <= range_m[near][power[near].argmax()] <= 1.7
    far = (range_m > 7.5) & (range_m < 9.5)
    assert range_m[far][power[far].argmax()] == pytest.approx(8.45, abs=0.05)
    echoes = slice(12, 256)
    image_db = 10 * np.log10(power[echoes].sum() / power[::-1][slice(11, 255)].sum())
    assert image_db > 10.0, "12.9 dB is published; which bins were left out is not"


def test_other_loops_are_refused_with_those_that_fit(radar_data: Path) -> None:
    path = radar_data / "iwr6843_frame" / "iwr6843_adc_data.bin"
    with pytest.raises(CaptureError, match="loops that fit: 1, 5, 17, 85;"):
        Dca1000File(path, rig(Layout("dca1000", 1, 64, 3, 512, 4, "IQ")), "vertical")


@given(st.integers(0, 3 * SMALL.nbytes), st.integers(0, 3 * SMALL.nbytes))
def test_files_cut_anywhere_are_one_capture(tmp_path_factory: pytest.TempPathFactory, a: int, b: int) -> None:
    folder = tmp_path_factory.getbasetemp()
    adc = samples(3)
    content, paths = adc.astype("<i2").tobytes(), [folder / f"part{k}.bin" for k in range(3)]
    first, second = sorted((a, b))
    for path, part in zip(paths, (content[:first], content[first:second], content[second:]), strict=True):
        path.write_bytes(part)
    frames = list(Dca1000File(paths, rig(SMALL), "vertical", t_start_ns=5))
    assert all(isinstance(f, RadarFrame) and np.array_equal(f.adc, x) for f, x in zip(frames, adc, strict=True))
    assert [f.t_first_chirp_ns for f in frames if isinstance(f, RadarFrame)] == [5, 150_000_005, 300_000_005]


def test_cut_last_frame_is_a_counted_loss(tmp_path: Path) -> None:
    path = tmp_path / "adc_data.bin"
    path.write_bytes(samples(2).tobytes()[:-100])
    source = Dca1000File(path, rig(SMALL), "vertical")
    whole, loss = source
    assert isinstance(whole, RadarFrame)
    assert isinstance(loss, Loss)
    assert (loss.number, loss.cause, loss.t_ns, source.total_frames) == (1, LossCause.TRUNCATED, 150_000_000, 2)
    source.close()
    assert list(source) == []


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "adc_data.bin"
    with pytest.raises(CaptureError, match="cannot be read"):
        Dca1000File(path, rig(SMALL), "vertical")
    path.write_bytes(b"12345")
    with pytest.raises(CaptureError, match="none, so samples or slots differ"):
        Dca1000File(path, rig(SMALL), "vertical")
    with pytest.raises(CaptureError, match="no such radar"):
        Dca1000File(path, rig(SMALL), "horizontal")
    with pytest.raises(CaptureError, match="not captured by a DCA1000"):
        Dca1000File(path, rig(Layout("cascade", 4, 4, 3, 8, 4)), "vertical")


def test_loops_that_fit() -> None:
    assert loops_that_fit(12 * 7, 7) == (1, 2, 3, 4, 6, 12)
    assert loops_that_fit(12 * 7 + 1, 7) == ()
    assert loops_that_fit(0, 7) == ()
    assert max(loops_that_fit(1024, 1)) == 128, "never beyond 255"
