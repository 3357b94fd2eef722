# SPDX-License-Identifier: Apache-2.0
"""Chains made of the public functions of other radar packages; each is imported when its chain is made.

Their windows, FFTs, beamformers and detectors run as published; what none of them has comes from ``edge.bench.peer``:
reading the cascade's raw words, the virtual row, local maxima in two dimensions, association of two radars.
"""

from __future__ import annotations

import importlib
from importlib import metadata
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from edge.bench.peer import Cells, Peer, Row, peaks, samples
from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.errors import DependencyError
from edge.frames import Float32, RadarFrame

if TYPE_CHECKING:
    from edge.rig import Radar


def _package(module: str, distribution: str) -> tuple[ModuleType, str]:
    """The module and its version; DependencyError when it is not there or cannot be imported."""
    try:
        return importlib.import_module(module), metadata.version(distribution)
    except (ImportError, metadata.PackageNotFoundError) as error:
        raise DependencyError(
            f"peer {distribution} is not installed", value=str(error), action="pip install 'rfconstruct[peers]'"
        ) from error


class OpenRadarPeer(Peer):
    """OpenRadar: complex128 range FFT, Bartlett beamformer as a matrix product, cell averaging along either axis."""

    distribution = "openradar"
    differences = "complex128; Hann in range; means along either axis instead of a ring, of logarithms; whole bins"

    def __init__(self, radar: Radar, heatmap: HeatmapSettings, antenna: AntennaSettings, cfar: CfarSettings) -> None:
        super().__init__(radar, heatmap, antenna, cfar)
        self._dsp, version = _package("mmwave.dsp", self.distribution)
        self.name = f"OpenRadar {version}"
        self._window = importlib.import_module("mmwave.dsp.utils").Window.HANNING
        self._row = Row(self.imager)
        element = np.arange(self._row.count)
        turn = (np.arange(self.bins) - self.bins // 2) / self.bins
        self._steering = np.exp(-2j * np.pi * turn[:, None] * element)
        self._train = (cfar.train_range - cfar.guard_range, cfar.train_angle - cfar.guard_angle)

    def image(self, frame: RadarFrame) -> Any:
        """Received power float64 [angle, range]."""
        codes = samples(frame).astype(np.complex128).transpose(1, 0, 3, 2)
        cube = self._dsp.range_processing(codes.reshape(codes.shape[0], -1, codes.shape[3]), self._window)
        row = self._row.fill(cube[self._row.slot, self._row.receiver])
        return self._dsp.aoa_bartlett(self._steering, row[None], axis=1)[0]

    def cells(self, image: Any) -> tuple[Cells, Float32]:
        """Above the means of both axes: ``ca_`` line by line, as the package's demos call it."""
        level = np.log2(image)
        bound, cfar = float(np.log2(self.tables.factor[self.points // 2])), self.cfar
        along = {"guard_len": cfar.guard_range, "noise_len": self._train[0], "l_bound": bound, "mode": "nearest"}
        across = {"guard_len": cfar.guard_angle, "noise_len": self._train[1], "l_bound": bound}
        in_range = np.apply_along_axis(lambda line: self._dsp.ca_(line, **along)[0], 1, level)
        in_angle = np.apply_along_axis(lambda line: self._dsp.ca_(line, **across)[0], 0, level)
        decided = (level > in_range) & (level > in_angle)
        decided[:, : self.first] = False
        return peaks(decided, image), image


class OpenRadarRankPeer(OpenRadarPeer):
    """The same with ordered statistics along either axis."""

    differences = "complex128; Hann in range; ranks along either axis, guard cells left out on one side; whole bins"

    def cells(self, image: Any) -> tuple[Cells, Float32]:
        """Above the ranks of both axes: ``os_`` line by line."""
        factor, cfar = float(self.tables.factor[self.points // 2]), self.cfar
        decided = np.ones(image.shape, dtype=np.bool_)
        for axis, (guard, train) in enumerate(((cfar.guard_angle, self._train[1]), (cfar.guard_range, self._train[0]))):
            rank = round(2 * train * cfar.os_quantile)
            options = {"guard_len": guard, "noise_len": train, "k": rank, "scale": factor}
            decided &= image > np.apply_along_axis(self._threshold, axis, image, options)
        decided[:, : self.first] = False
        return peaks(decided, image), image

    def _threshold(self, line: Any, options: dict[str, Any]) -> Any:
        return self._dsp.os_(line, **options)[0]


class XwrPeer(Peer):
    """xwr: FFTW, pad, FFT and shift over the row, ring mean by ``scipy.signal.convolve2d``."""

    distribution = "xwr"
    differences = "Hann in range; angle axis not periodic in the CFAR; adds 1 to the power; whole bins"

    def __init__(self, radar: Radar, heatmap: HeatmapSettings, antenna: AntennaSettings, cfar: CfarSettings) -> None:
        super().__init__(radar, heatmap, antenna, cfar)
        package, version = _package("xwr.rsp.numpy", self.distribution)
        self.name = f"xwr {version}"
        row = self._row = Row(self.imager, backwards=True)

        class Cascade(package.RSPNumpy):  # type: ignore[misc, name-defined]
            """The package's extension point for antenna arrays."""

            def mimo_virtual_array(self, rd: Any) -> Any:
                """Row [batch, doppler, elevation 1, azimuth, range]."""
                cube = rd.reshape(rd.shape[2], -1, rd.shape[4])
                return row.fill(cube[row.slot, row.receiver])[None, None, None]

        self._rsp = Cascade(window={"range": True}, size={"azimuth": self.bins})
        self._cfar = package.CACFAR(
            guard=(cfar.guard_range, cfar.guard_angle),
            train=(cfar.train_range - cfar.guard_range, cfar.train_angle - cfar.guard_angle),
            snr_thresh=float(self.tables.factor[self.points // 2]),
            discard_range=(self.first, 0),
        )

    def image(self, frame: RadarFrame) -> Any:
        """Amplitude float32 [batch 1, angle as Doppler, range]."""
        codes = np.ascontiguousarray(samples(frame).transpose(1, 0, 3, 2))
        cube = codes.reshape(1, 1, codes.shape[0], -1, codes.shape[3])
        spectrum = self._rsp.elevation_azimuth(self._rsp.doppler_range(cube))
        return np.abs(spectrum[:, 0, 0])

    def cells(self, image: Any) -> tuple[Cells, Float32]:
        """``CACFAR`` over range and angle."""
        found = self._cfar(image)
        power = found.signal[0].T
        return peaks(found.mask[0].T, power), power


class MmwcorePeer(Peer):
    """mmwcore: decoding, windowed FFTs and a two-dimensional ring in Rust."""

    distribution = "mmwcore"
    differences = (
        "Hann in range; square ring 17 x 17 - 5 x 5 on amplitudes, cells within 8 of an edge never tested; whole bins"
    )
    GUARD, TRAIN = 2, 6

    def __init__(self, radar: Radar, heatmap: HeatmapSettings, antenna: AntennaSettings, cfar: CfarSettings) -> None:
        super().__init__(radar, heatmap, antenna, cfar)
        _, version = _package("mmwcore._native", self.distribution)
        self.name = f"mmwcore {version}"
        self._core = importlib.import_module("mmwcore.core")
        self._adc, self._range, self._aoa, self._detect = (
            importlib.import_module(f"mmwcore.dsp.{part}") for part in ("adc", "range", "aoa", "cfar")
        )
        self._row = Row(self.imager, backwards=True)
        core, layout = self._core, radar.schedule.layout
        self._raw = core.ADCFrameSpec(layout.devices * layout.slots, layout.samples, layout.rx)
        self._first_fft = core.RangeFFTSpec(n_fft=self.points, window=core.FFTWindow.HANN)
        self._second_fft = core.AngleFFTSpec(n_fft=self.bins, input_axis="virtual_rx", output_axis="doppler_bin")
        scale = float(np.sqrt(self.tables.factor[self.points // 2]))
        self._spec = core.CFARDetectionSpec(self.TRAIN, self.GUARD, scale)

    def image(self, frame: RadarFrame) -> Any:
        """Cube complex64 [frame 1, angle as Doppler, rx 1, range]; its decoder's last two axes are sample and rx."""
        cube, layout = self._core.RadarCube, frame.layout
        codes = self._adc.organize_adc_samples(frame.adc.reshape(-1), self._raw).data
        spectra = self._range.range_fft(cube(codes, ("frame", "chirp", "sample", "rx")), self._first_fft).data
        spectra = spectra.reshape(layout.devices, layout.slots, self.points, layout.rx)
        row = self._row.fill(spectra[self._row.device, self._row.slot, :, self._row.rx])
        beams = self._aoa.angle_fft(cube(row[None], ("frame", "virtual_rx", "range_bin")), self._second_fft)
        return cube(beams.data[:, :, None], ("frame", "doppler_bin", "rx", "range_bin"))

    def cells(self, image: Any) -> tuple[Cells, Float32]:
        """``detect_cfar``, then local maxima of the power."""
        found = self._detect.detect_cfar(image, self._spec)
        beams = image.data[0, :, 0]
        power = beams.real**2 + beams.imag**2
        decided = np.zeros(power.shape, dtype=np.bool_)
        column = {name: found.detections[:, n].astype(np.intp) for n, name in enumerate(found.channels)}
        decided[column["doppler_bin"], column["range_bin"]] = True
        decided[:, : self.first] = False
        return peaks(decided, power), power
