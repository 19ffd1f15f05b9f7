"""USB3 Vision timings: unpacking on one core, and whole frames from the simulated camera.

Part of `emmc-rig devices bench`. Gigabytes count the camera's bytes, not the pixels
made of them. The simulated stream includes everything but the cable: packets into the host's
buffer, the frame put together, its SHA-256 and its mosaic.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial

import numpy as np

from drivers.pixel_formats import BY_NAME, KERNELS, image_bytes, unpack
from drivers.u3v import open_u3v
from emmc_rig.study.benchmarks.timing import Figures, median_s
from simulators.clock import ManualClock
from simulators.u3v import U3vCameraSimulator
from simulators.usb import SimulatedUsb

SIZE_24MP = (4000, 6000)
UNPACKED = ("BayerRG12p", "BayerRG12Packed", "BayerRG10p", "BayerRG10Packed", "Mono8", "Mono16")


@dataclass(frozen=True)
class U3vTiming(Figures):
    """What was timed, the camera's bytes in it, and the median of its seconds."""

    name: str
    gigabytes: float
    seconds: float

    @property
    def gigabytes_per_s(self) -> float:
        """Camera bytes per second."""
        return self.gigabytes / self.seconds


def unpacking_timings(size: tuple[int, int] = SIZE_24MP, repeats: int = 9) -> Iterator[U3vTiming]:
    """Yield each packing twice: its kernel into memory at hand, and with a new mosaic made.

    A new mosaic's pages come from the system one by one, which takes longer than the kernel.
    """
    for name in UNPACKED:
        form = BY_NAME[name]
        data = np.random.default_rng(0).bytes(image_bytes(form, size))
        packed = np.frombuffer(data, np.uint8)
        kernel = KERNELS[form.stored_bits, form.bits, form.packing][2]
        mosaic = np.zeros(size[0] * size[1], np.uint16)
        gigabytes = len(data) / 1e9
        for what, call in (
            ("kernel", partial(kernel, packed, mosaic)),
            ("new mosaic", partial(unpack, data, form, size)),
        ):
            yield U3vTiming(f"{name}, {what}", gigabytes, median_s(call, repeats))


def stream_timing(size: tuple[int, int] = SIZE_24MP, frames: int = 9) -> U3vTiming:
    """Return the time of one 12p frame in a simulated stream."""
    scene = np.random.default_rng(0).integers(0, 4096, size, dtype=np.uint16)
    clock = ManualClock()
    camera = U3vCameraSimulator(lambda exposure_s: scene, clock, size)
    opened = open_u3v(backend=SimulatedUsb(clock, camera), clock=clock, pixel_format="BayerRG12p")
    with closing(opened), closing(opened.stream()) as stream:
        first = next(stream)
        seconds = median_s(lambda: next(stream), frames)
    return U3vTiming("simulated stream, one frame", len(first.original) / 1e9, seconds)


def command_timing(count: int = 500) -> U3vTiming:
    """Return the time that the driver takes to read one register on a wire without delay."""
    clock = ManualClock()
    shape = (4, 4)
    camera = U3vCameraSimulator(lambda exposure_s: np.zeros(shape, np.uint16), clock, shape)
    with closing(open_u3v(backend=SimulatedUsb(clock, camera), clock=clock)) as opened:
        seconds = median_s(lambda: opened.features.number("WidthMax"), count)
    return U3vTiming("read one register", 4 / 1e9, seconds)


def u3v_timings() -> Iterator[U3vTiming]:
    """Yield all of them."""
    yield from unpacking_timings()
    yield stream_timing()
    yield command_timing()
