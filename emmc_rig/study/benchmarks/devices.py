"""Host time of stages and cameras, on simulated wires: commands, frames, pictures, triggers.

A simulated clock counts what the devices take; bytes on a cable take none.
"""

from __future__ import annotations

import statistics
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from drivers.pixel_formats import BY_NAME, KERNELS, image_bytes, unpack
from drivers.ptp import PtpSession, is_raw
from drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from drivers.raw import RawFrame, decode_by_libraw, decode_raw
from drivers.stage import StageSettings
from drivers.u3v import U3vCamera, open_u3v
from drivers.usb import open_device
from drivers.zaber import ZaberStage
from emmc_rig.acquisition.expand import expand
from emmc_rig.acquisition.order import ordered
from emmc_rig.acquisition.plan import Plan, PlannedShot, planned_camera
from emmc_rig.acquisition.sequencer import Sequencer
from emmc_rig.bench.hardware import open_simulated, simulated_rig
from emmc_rig.bench.stage_config import PROTOCOLS
from emmc_rig.bench.trigger import LINE_LATENCY_S, SimulatedTrigger
from emmc_rig.session.session import Frozen, Session
from emmc_rig.study.benchmarks.timing import Figures, median_s
from simulators.clock import ManualClock
from simulators.firmware import SimulatedController
from simulators.ptp import PtpCameraSimulator, PtpUsbFunction
from simulators.u3v import U3vCameraSimulator
from simulators.usb import SimulatedUsb
from simulators.zaber import AxisSpec, ZaberChain


@dataclass(frozen=True)
class StageTiming(Figures):
    """Median time of one command, the simulated firmware's part included.

    exchanges: how often the command wrote to the wire.
    """

    protocol: str
    command: str
    exchanges: float
    milliseconds: float


def stage_timings(repeats: int) -> list[StageTiming]:
    """Return the timings of every protocol's commands."""
    return [one for protocol in PROTOCOLS for one in _timings(protocol, repeats)]


def _timings(protocol: str, repeats: int) -> list[StageTiming]:
    stage, firmware = open_simulated(protocol)
    stage.home()
    axis = stage.axes[0]
    low_um, high_um = stage.limits_um(axis)
    places_um = [(low_um + high_um) / 2 + step_um for step_um in (0.0, 100.0)]
    calls: dict[str, Callable[[int], object]] = {
        "position": lambda turn: stage.position_um(axis),
        "is homed": lambda turn: stage.is_homed(axis),
        "stop": lambda turn: stage.stop([axis]),
        "move 100 um and wait": lambda turn: stage.move_to_um({axis: places_um[turn % 2]}),
    }
    return [_timing(protocol, name, call, firmware, repeats) for name, call in calls.items()]


def _timing(
    protocol: str,
    name: str,
    call: Callable[[int], object],
    firmware: SimulatedController,
    repeats: int,
) -> StageTiming:
    call(0)
    call(1)
    written = firmware.fed
    seconds = []
    for turn in range(repeats):
        start_s = time.perf_counter()
        call(turn)
        seconds.append(time.perf_counter() - start_s)
    exchanges = (firmware.fed - written) / repeats
    return StageTiming(protocol, name, exchanges, float(np.median(seconds)) * 1e3)


LARGE_SHAPE = (4000, 6000)
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


def picture_timing(shape: tuple[int, int] = LARGE_SHAPE, repeats: int = 9) -> PictureTiming:
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
        alone: NDArray[np.uint16] | None = decode_by_libraw(data)[0]
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


EXPOSURE_S = 0.01
STEP_UM = 120.0
MOVE_S = 10.0
"""Longest wait for the edge."""
FRAMES = 25
SHAPE = (24, 32)
SCENE = (5, 5, *SHAPE, 3)
STEPPED = Plan(
    camera="rgbw-bayer-1shot",
    shots=tuple(
        PlannedShot(mask_um=(STEP_UM * number, 0.0), exposure_s=(EXPOSURE_S,))
        for number in range(FRAMES)
    ),
    whiteboards=None,
    darks=None,
)


@dataclass(frozen=True)
class TriggerTiming(Figures):
    """Mean time for each frame, in ms: the program polls, or the stage triggers the camera.

    vibration_ms: waited after every arrival, by the program or by the camera's trigger delay.
    """

    frames: int
    exposure_ms: float
    vibration_ms: float
    asked_ms: float
    triggered_ms: float

    @property
    def gain_ms(self) -> float:
        """Gained for each frame."""
        return self.asked_ms - self.triggered_ms


class TriggeredRig:
    """A Zaber axis whose first output leads to line 0 of a USB3 Vision camera."""

    def __init__(self, settings: StageSettings, latency_s: float = LINE_LATENCY_S) -> None:
        self.clock = ManualClock()
        self.seen_um: list[float] = []
        self.chain = ZaberChain(self.clock, {(1, 1): AxisSpec()})
        self._camera = U3vCameraSimulator(self._see, self.clock, SHAPE)
        self.chain.on_output = lambda device, output, level, at_s: (
            self._camera.raise_line(at_s + latency_s) if (output, level) == (1, 1) else None
        )
        self.stage = ZaberStage(
            self.chain.transport(), {"x": (1, 1)}, AxisSpec().microstep_um, self.clock, settings
        )

    def open_camera(self) -> U3vCamera:
        """Return the camera, opened; it must be closed."""
        camera = open_u3v(backend=SimulatedUsb(self.clock, self._camera), clock=self.clock)
        camera.set_exposure_s(EXPOSURE_S)
        return camera

    def _see(self, exposure_s: float) -> np.ndarray:
        self.seen_um.append(self.chain.position_um(1, 1))
        return np.full(SHAPE, 100, np.uint16)


def trigger_timing(frames: int = FRAMES, settle_s: float = 0.05) -> TriggerTiming:
    """Take frames at equal steps, once asked for and once triggered by the stage's arrival."""
    asked_s, triggered_s = (_stepped_s(frames, settle_s, by_stage) for by_stage in (False, True))
    ms = 1e3 / frames
    return TriggerTiming(frames, EXPOSURE_S * 1e3, settle_s * 1e3, asked_s * ms, triggered_s * ms)


def _stepped_s(frames: int, settle_s: float, by_stage: bool) -> float:
    """Return how long frames at equal steps take, each triggered by the stage or asked for."""
    rig = TriggeredRig(StageSettings(settle_s=0.0 if by_stage else settle_s))
    rig.stage.home()
    first_um, *places_um = (1_000.0 + STEP_UM * number for number in range(frames + 1))
    with closing(rig.open_camera()) as camera:
        rig.stage.move_to_um({"x": first_um})
        start_s = rig.clock.now_s()
        for place_um in places_um:
            if by_stage:
                with camera.armed(delay_s=settle_s) as receive:
                    rig.stage.move_and_signal_um("x", place_um)
                    receive(MOVE_S)
            else:
                rig.stage.move_to_um({"x": place_um})
                camera.snap()
        return rig.clock.now_s() - start_s


def capture_timing(settle_s: float = 0.05) -> TriggerTiming:
    """Capture shots at equal steps on the simulated rig, asked for and triggered on arrival."""
    # The same camera both times: without an output on the axis that moves nothing is triggered.
    asked_s, triggered_s = (
        _frame_s(SimulatedTrigger(outputs={axis: 1}, delay_s=settle_s))
        for axis in ("aperture_x", "mask_x")
    )
    return TriggerTiming(FRAMES, EXPOSURE_S * 1e3, settle_s * 1e3, asked_s * 1e3, triggered_s * 1e3)


def _frame_s(trigger: SimulatedTrigger) -> float:
    """Return how long the devices take from the end of one frame of a session to the next."""
    camera, clock = planned_camera(STEPPED), ManualClock()
    scene = np.full(SCENE, 0.5, np.float32)
    rig, _ = simulated_rig(camera, scene, SHAPE, 0, clock, rays_per_view=16, trigger=trigger)
    frames = ordered(expand(STEPPED, camera, rig.window_um), STEPPED.order)
    frozen = Frozen("", camera.model_dump(mode="json"), {}, frames)
    with TemporaryDirectory() as folder:
        session = Session.create(Path(folder, "session"), frozen, {"title": "steps"})
        Sequencer(session, STEPPED, rig, timer=clock.now_s).run()
    ends_s = [entry["spans_s"]["check"][1] for entry in session.stored.values()]
    return (ends_s[-1] - ends_s[0]) / (len(ends_s) - 1)
