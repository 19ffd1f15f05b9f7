"""Speed of the camera drivers on pictures in memory, as ratios to rawpy alone."""

from __future__ import annotations

import io
import statistics
import time
import tracemalloc
from dataclasses import dataclass

import numpy as np
import rawpy
from numpy.typing import NDArray

from drivers.ptp import PtpSession, is_raw
from drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from drivers.raw import RawFrame, decode_raw
from drivers.usb import open_device
from emmc_rig.study.benchmarks.timing import Figures
from simulators.clock import ManualClock
from simulators.ptp import PtpCameraSimulator, PtpUsbFunction
from simulators.usb import SimulatedUsb

SHAPE = (4000, 6000)
"""24 megapixels: a DNG of 48 MB."""


@dataclass(frozen=True)
class PictureTiming(Figures):
    """Median seconds from a picture on the simulated bus to its mosaic, and rawpy's alone.

    download_s: USB transfers to bytes. decode_s: bytes to a checked and hashed `RawFrame`.
    rawpy_s: rawpy on the same bytes, to a mosaic of its own. peak_pictures: the most memory that
    Python and NumPy held at once, in pictures: 1 where the mosaic lies in the bytes.
    """

    megabytes: float
    download_s: float
    decode_s: float
    rawpy_s: float
    ratio: float
    peak_pictures: float


def picture_timing(shape: tuple[int, int] = SHAPE, repeats: int = 9) -> PictureTiming:
    """Time a PTP download over simulated USB with its decoding, in turn with rawpy alone."""
    mosaic = np.random.default_rng(0).integers(0, 4096, shape, dtype=np.uint16)
    clock = ManualClock()
    bus = SimulatedUsb(clock, PtpUsbFunction(PtpCameraSimulator(lambda exposure_s: mosaic, clock)))
    session = PtpSession(PtpUsb(open_device(PTP_INTERFACE, backend=bus), clock), clock)
    taken = session.capture(0.01, is_raw)
    rows: list[tuple[float, float, float]] = []
    ratios = []
    data = b""
    for _ in range(repeats + 1):
        started = time.perf_counter()
        data = session.download(taken.handle, taken.info)
        downloaded = time.perf_counter()
        frame: RawFrame | None = decode_raw(data, shape)
        decoded = time.perf_counter()
        frame = None
        again = time.perf_counter()
        alone: NDArray[np.uint16] | None = _by_rawpy(data)
        ended = time.perf_counter()
        alone = None
        rows.append((downloaded - started, decoded - downloaded, ended - again))
        ratios.append((decoded - started) / (ended - again))
    assert frame is None
    assert alone is None
    download_s, decode_s, rawpy_s = (
        statistics.median(column[1:]) for column in zip(*rows, strict=True)
    )
    size = len(data)
    del data
    tracemalloc.start()
    try:
        decode_raw(session.download(taken.handle, taken.info), shape)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    session.close()
    ratio = statistics.median(ratios[1:])
    return PictureTiming(size / 1e6, download_s, decode_s, rawpy_s, ratio, peak / size)


def _by_rawpy(data: bytes) -> NDArray[np.uint16]:
    with rawpy.imread(io.BytesIO(data)) as raw:
        return raw.raw_image_visible.copy()
