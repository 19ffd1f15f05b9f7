"""A Micro-Manager configuration as our camera and stage: any device that has an adapter there.

Needs the extra `micromanager`, and Micro-Manager's adapters for real devices. One core is loaded
for each configuration file, whoever opens camera or stage of it. Source: MMCore API (CMMCore) and
MMDevice, interface version 75: exposures in ms, places in um.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from emmc_rig.drivers.camera import CameraIdentity, Limits, check_setting
from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.dng import BAYER_PATTERNS, SMALLEST_SIDE_PX, frame_of_array
from emmc_rig.drivers.errors import (
    CameraClosedError,
    CameraSettingError,
    CaptureError,
    DriverError,
    MicroManagerError,
    PortGoneError,
    SpeedFixedError,
)
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.drivers.stage import (
    DEFAULT_SETTINGS,
    HostStage,
    Reading,
    StageIdentity,
    StageSettings,
)
from emmc_rig.drivers.trigger import begin_by_line, show_exposure

if TYPE_CHECKING:
    from pymmcore_plus import CMMCorePlus

SHORTEST_S, LONGEST_S = 1e-6, 3600.0
FRAME_GRACE_S = 2.0
POLL_S = 0.001
SPEED_UM_S = 100.0
"""Of a stage that does not state its own: slow, so that no time limit is too short."""

PropertyValue = str | int | float


class LoadedCore:
    """A core with a configuration loaded; `lock` is held for what takes several calls.

    Raises `MicroManagerError` when the configuration cannot be loaded.
    """

    def __init__(self, core: CMMCorePlus, config: str) -> None:
        self.port = config
        self.lock = threading.RLock()
        self.users = 0
        self._on_load: list[Callable[[], None]] = []
        self._core: CMMCorePlus | None = core
        try:
            self._load()
        except BaseException:
            core.unloadAllDevices()
            raise

    @property
    def core(self) -> CMMCorePlus:
        """The core; raises `PortGoneError` once it is closed."""
        if self._core is None:
            raise PortGoneError(self.port)
        return self._core

    def check_loaded(
        self,
        label: str,
        kind: str,
        where: str = "",
        error: type[DriverError] = MicroManagerError,
    ) -> None:
        """Raise an error that names the devices there are, unless a device has this label.

        kind: of the device. where: in which file the label is to be mended.
        """
        known = self.core.getLoadedDevices()
        if label not in known:
            advice = f"name one of {', '.join(known)}{where}"
            raise error(f"{self.port} has no {kind} {label!r}", advice)

    def whenever_loaded(self, apply: Callable[[], None]) -> None:
        """Apply settings now, and again after every reload until `forget`."""
        with self.lock:
            apply()
            self._on_load.append(apply)

    def forget(self, apply: Callable[[], None]) -> None:
        """Apply these settings no more."""
        with self.lock:
            self._on_load.remove(apply)

    def reopen(self) -> None:
        """Load the configuration again: devices that were unplugged are looked for anew."""
        with self.lock:
            self._load()
            for apply in self._on_load:
                apply()

    def close(self) -> None:
        """Release the core; the last user unloads the devices."""
        with _loading:
            self.users -= 1
            if self.users <= 0 and self._core is not None:
                _loaded.pop(self.port, None)
                with self.lock, calling("unload"):
                    core, self._core = self._core, None
                    core.unloadAllDevices()

    def _load(self) -> None:
        try:
            with calling("load the configuration"):
                # Not every file begins by unloading what an earlier one left.
                self.core.unloadAllDevices()
                self.core.loadSystemConfiguration(self.port)
        except MicroManagerError:
            raise
        except OSError as error:
            raise MicroManagerError(
                f"{self.port} cannot be loaded ({_one_line(error)})",
                "name a configuration that Micro-Manager itself loads; its adapters are looked "
                "for where MICROMANAGER_PATH says",
            ) from error


_loaded: dict[str, LoadedCore] = {}
_loading = threading.Lock()


def load_core(config: str) -> LoadedCore:
    """Return the core of a configuration file, loading it for the first who asks.

    Whoever gets it must close it. Raises `MicroManagerError`, also when the extra is missing.
    """
    try:
        from pymmcore_plus import CMMCorePlus
    except ImportError as error:
        raise MicroManagerError(
            "pymmcore-plus is not installed", 'pip install "emmc-rig[micromanager]"'
        ) from error
    logging.getLogger("pymmcore-plus").setLevel(logging.WARNING)
    with _loading:
        if config not in _loaded:
            _loaded[config] = LoadedCore(CMMCorePlus(), config)
        _loaded[config].users += 1
        return _loaded[config]


@contextmanager
def calling(what: str) -> Iterator[None]:
    """Turn the core's `RuntimeError` into a `MicroManagerError` about `what`."""
    try:
        yield
    except RuntimeError as error:
        raise MicroManagerError(f"Micro-Manager could not {what} ({_one_line(error)})") from error


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


@dataclass(frozen=True)
class CameraSetup:
    """Facts on frames that Micro-Manager does not state, and the settings of the camera.

    label: of the camera; "" takes the configuration's. cfa: a Bayer phase of the whole sensor, or
    "mono". black_level_dn: a whole number. bit_depth, binning: None leaves them. roi: left, top,
    width and height in pixels after binning. properties: by name, set in this order.
    """

    label: str = ""
    cfa: Annotated[str, Field(pattern="^(mono|rggb|grbg|gbrg|bggr)$")] = "mono"
    black_level_dn: Annotated[int, Field(ge=0)] = 0
    bit_depth: Annotated[int, Field(gt=0, le=16)] | None = None
    binning: Annotated[int, Field(gt=0)] | None = None
    roi: tuple[int, int, int, int] | None = None
    properties: Mapping[str, PropertyValue] = field(default_factory=dict)


OPTIONS = CameraSetup


def open_camera(
    address: str, clock: Clock, backend: object, setup: CameraSetup
) -> MicroManagerCamera:
    """Open the camera of a configuration file; see `drivers.cameras`."""
    return MicroManagerCamera(load_core(address), setup, clock)


class MicroManagerCamera:
    """A `drivers.camera.StreamingCamera` of a loaded core, which it closes.

    The frame is kept as a DNG, since what comes from the core is an array. Gain has no common
    unit among adapters: it is 1 here, and set as a property. The constructor raises
    `CameraSettingError` for what the camera cannot be set to.
    """

    gain: float = 1.0
    gain_limits: Limits = (1.0, 1.0)

    def __init__(
        self,
        loaded: LoadedCore,
        setup: CameraSetup | None = None,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._loaded = loaded
        self._clock = clock
        self._setup = setup = setup or CameraSetup()
        self._exposure_s: float | None = None
        # Properties of trigger and exposure output, in order, to set again after a reload.
        self._lines: list[tuple[str, str]] = []
        self._trigger_limit_s = 0.0
        self._closed = False
        try:
            self.label = setup.label or loaded.core.getCameraDevice()
            loaded.check_loaded(self.label, "camera")
            loaded.whenever_loaded(self._apply)
        except BaseException:
            loaded.close()
            raise

    @property
    def identity(self) -> CameraIdentity:
        """The adapter, the camera's name and number as far as it states them."""
        core = self._loaded.core
        with calling("describe the camera"):
            known = {
                name: core.getProperty(self.label, name)
                for name in ("CameraName", "CameraID")
                if core.hasProperty(self.label, name)
            }
            maker = core.getDeviceLibrary(self.label)
            model = known.get("CameraName") or core.getDeviceName(self.label)
            return CameraIdentity(maker, model, known.get("CameraID", ""))

    @property
    def exposure_s(self) -> float:
        """Exposure of the next frame, read from the core."""
        with calling("read the exposure"):
            return self._loaded.core.getExposure(self.label) / 1e3

    @property
    def exposure_limits_s(self) -> Limits:
        """Shortest and longest exposure: of the property Exposure where it has limits."""
        core = self._loaded.core
        with calling("read the limits of the exposure"):
            has = core.hasProperty(self.label, "Exposure")
            if not (has and core.hasPropertyLimits(self.label, "Exposure")):
                return SHORTEST_S, LONGEST_S
            low = core.getPropertyLowerLimit(self.label, "Exposure")
            high = core.getPropertyUpperLimit(self.label, "Exposure")
        return max(low / 1e3, SHORTEST_S), min(high / 1e3, LONGEST_S)

    def details(self) -> dict[str, str]:
        """Return every property of the camera, by name."""
        core = self._loaded.core
        with calling("list the properties"):
            return {
                name: core.getProperty(self.label, name)
                for name in core.getDevicePropertyNames(self.label)
            }

    def temperatures_c(self) -> dict[str, float]:
        """Return the properties of the camera that are called temperatures and are numbers."""
        found = {}
        for name, shown in self.details().items():
            if "temperature" in name.lower():
                with suppress(ValueError):
                    found[name] = float(shown)
        return found

    def set_exposure_s(self, exposure_s: float) -> None:
        """Choose the exposure of the frames that follow.

        Raises `ValueError` unless positive, `CameraSettingError` outside the limits,
        `MicroManagerError` when the device refuses.
        """
        check_setting("exposure in seconds", exposure_s, self.exposure_limits_s)
        with calling("set the exposure"):
            self._loaded.core.setExposure(self.label, 1e3 * exposure_s)
        self._exposure_s = exposure_s

    def set_gain(self, gain: float) -> None:
        """Accept a gain of 1; raises as `set_exposure_s`."""
        check_setting("gain", gain, self.gain_limits)

    def set_trigger(self, source: str, edge: str, limit_s: float) -> None:
        """As `drivers.u3v.U3vCamera.set_trigger`, where the adapter has GenICam's properties."""
        begin_by_line(self, source, edge)
        self._trigger_limit_s = limit_s

    def set_exposure_output(self, line: str) -> None:
        """As `drivers.u3v.U3vCamera.set_exposure_output`, where the adapter has the properties."""
        show_exposure(self, line)

    def choices(self, name: str) -> tuple[str, ...]:
        """As `drivers.trigger.Choices`."""
        core = self._loaded.core
        with calling(f"list the choices of {name}"):
            has = core.hasProperty(self.label, name)
            return tuple(core.getAllowedPropertyValues(self.label, name)) if has else ()

    def choose(self, name: str, value: str) -> None:
        """As `drivers.trigger.Choices`."""
        with calling(f"set {name}"):
            self._set_property(name, value)
        self._lines.append((name, value))

    def snap(self) -> RawFrame:
        """Expose and return one frame; raises `MicroManagerError` or `CameraClosedError`."""
        with self._alone() as core, calling("take a frame"):
            core.snapImage()
            return self._frame(core.getImage(), {})

    def stream(self) -> Generator[RawFrame, None, None]:
        """Yield frames as they come; closing the generator stops the acquisition.

        Raises `CaptureError` when the core's buffer ran over or no frame comes.
        """
        with calling("stream frames"):
            with self._alone() as core:
                core.startContinuousSequenceAcquisition(0)
            try:
                while True:
                    yield self._next(core)
            finally:
                core.stopSequenceAcquisition()

    def close(self) -> None:
        """Release the core; closing twice is allowed."""
        if not self._closed:
            self._closed = True
            self._loaded.forget(self._apply)
            self._loaded.close()

    def _apply(self) -> None:
        """Set the camera as the configuration says, and read what frames it gives now."""
        core, setup = self._loaded.core, self._setup
        wanted: dict[str, PropertyValue] = dict(setup.properties)
        if setup.bit_depth is not None:
            wanted["BitDepth"] = setup.bit_depth
        if setup.binning is not None:
            wanted["Binning"] = setup.binning
        with calling("set the camera"):
            for name, value in wanted.items():
                self._set_property(name, value)
            for name, value in self._lines:
                self._set_property(name, value)
            core.setCameraDevice(self.label)
            core.clearROI()
            if setup.roi is not None:
                core.setROI(self.label, *setup.roi)
            if self._exposure_s is not None:
                core.setExposure(self.label, 1e3 * self._exposure_s)
            left, top, width, height = core.getROI(self.label)
            components, depth = core.getNumberOfComponents(), core.getImageBitDepth()
        if setup.roi is not None and setup.roi != (left, top, width, height):
            raise CameraSettingError("ROI", f"became {left}, {top}, {width}, {height}")
        if components != 1 or depth > 16:
            raise CameraSettingError(
                "pixels", f"are {components} x {depth} bits: set PixelType to 8 or 16 bits of grey"
            )
        if min(width, height) < SMALLEST_SIDE_PX:
            raise CameraSettingError("frame", f"is smaller than {SMALLEST_SIDE_PX} pixels")
        if setup.cfa != "mono" and wanted.get("Binning", 1) != 1:
            raise CameraSettingError("binning", "would add pixels of different colours")
        self.shape = (height, width)
        self.cfa = _shifted(setup.cfa, top, left)
        self.white_level_dn = (1 << depth) - 1

    def _set_property(self, name: str, value: PropertyValue) -> None:
        core = self._loaded.core
        if not core.hasProperty(self.label, name):
            known = ", ".join(core.getDevicePropertyNames(self.label))
            raise CameraSettingError(name, f"does not exist; it has {known}")
        try:
            core.setProperty(self.label, name, value)
        except RuntimeError as error:
            allowed = ", ".join(core.getAllowedPropertyValues(self.label, name))
            hint = f"; it takes {allowed}" if allowed else ""
            raise CameraSettingError(
                name, f"cannot become {value} ({_one_line(error)}){hint}"
            ) from error

    @contextmanager
    def _alone(self) -> Iterator[CMMCorePlus]:
        """Yield the core with this camera chosen; other threads wait for its release."""
        if self._closed:
            raise CameraClosedError(self.label)
        with self._loaded.lock:
            core = self._loaded.core
            with calling("choose the camera"):
                if core.isSequenceRunning():
                    raise CameraSettingError("acquisition", "runs already: close its stream first")
                if core.getCameraDevice() != self.label:
                    core.setCameraDevice(self.label)
            yield core

    def _next(self, core: CMMCorePlus) -> RawFrame:
        wait_s = self.exposure_s + FRAME_GRACE_S + self._trigger_limit_s
        deadline_s = self._clock.now_s() + wait_s
        while not core.getRemainingImageCount():
            if core.isBufferOverflowed():
                raise CaptureError("the core's buffer ran over", "take frames more slowly")
            if self._clock.now_s() > deadline_s:
                raise CaptureError("no frame came from the camera")
            self._clock.sleep(POLL_S)
        image, tags = core.popNextImageAndMD()
        metadata = {str(name): str(value) for name, value in dict(tags).items()}
        return self._frame(image, metadata)

    def _frame(self, image: np.ndarray, metadata: Mapping[str, str]) -> RawFrame:
        """Return an image of the core as a frame, at the times that its metadata state."""
        arrived_s = self._clock.now_s()
        mosaic = np.asarray(image, dtype=np.uint16)
        if mosaic.shape != self.shape:
            raise CaptureError(f"it has {mosaic.shape} pixels instead of {self.shape}")
        levels_dn = self._setup.black_level_dn, self.white_level_dn
        about = self.exposure_s, self.identity, arrived_s, metadata
        times = _captured(metadata), _elapsed_s(metadata)
        return frame_of_array(mosaic, self.cfa, *levels_dn, *about, *times)


def _elapsed_s(metadata: Mapping[str, str]) -> float | None:
    """Return when the adapter had an image, s from the beginning of its sequence.

    The core states it for adapters that do not, when the image reached it (MMCore, CircularBuffer).
    """
    try:
        elapsed_s = float(metadata["ElapsedTime-ms"]) / 1e3
    except (KeyError, ValueError):
        return None
    return elapsed_s if math.isfinite(elapsed_s) else None


def _captured(metadata: Mapping[str, str]) -> datetime | None:
    """Return the time of day when the core received an image."""
    try:
        return datetime.fromisoformat(metadata["TimeReceivedByCore"]).astimezone()
    except (KeyError, ValueError):
        return None


def _shifted(cfa: str, top: int, left: int) -> str:
    """Return the Bayer phase of a frame that begins at that row and column of the sensor."""
    if cfa not in BAYER_PATTERNS:
        return cfa
    rows = cfa[:2], cfa[2:]
    return "".join(rows[(top + i) % 2][(left + j) % 2] for i in (0, 1) for j in (0, 1))


@dataclass(frozen=True)
class StageSetup:
    """What a Micro-Manager stage cannot say of itself.

    axes: our names, and where they are: `XY.x`, `XY.y`, or the label of a one-axis stage; None
    takes all, by those names. travel_um: lowest and highest place, by our names. homes: True homes
    by the adapter; False is for absolute encoders and for stages homed in Micro-Manager: homing
    such a stage, after an unplug, moves nothing. speed_property,
    speed_unit_um_s: the property that holds the speed, and its unit. speed_um_s: what the axes
    move at where there is none, for time limits.
    """

    axes: Mapping[str, str] | None
    travel_um: Mapping[str, tuple[float, float]]
    homes: bool = True
    speed_property: str = ""
    speed_unit_um_s: float = 1.0
    speed_um_s: float = SPEED_UM_S


class MicroManagerStage(HostStage):
    """Stages of a loaded core, which it closes; raises `MicroManagerError` for a wrong axis.

    An adapter states neither whether it was homed nor its travel: homing is done once after
    every connection, and the limits are those of the configuration.
    """

    def __init__(
        self,
        loaded: LoadedCore,
        setup: StageSetup,
        clock: Clock = SYSTEM_CLOCK,
        settings: StageSettings = DEFAULT_SETTINGS,
    ) -> None:
        self._closed = False
        try:
            found = stage_axes(loaded)
            self._places = setup.axes or {place: place for place in found}
            super().__init__(self._places, (loaded,), clock, settings)
            self._loaded = loaded
            self._setup = setup
            self._homed: set[str] = set()
            for axis, place in self._places.items():
                if place not in found:
                    raise MicroManagerError(
                        f"{loaded.port} has no axis {place!r} for {axis}",
                        f"name one of {', '.join(found)}",
                    )
                if axis not in setup.travel_um:
                    raise MicroManagerError(
                        f"Micro-Manager does not state the travel of {axis}",
                        f"state travel_um: {{{axis}: [LOWEST, HIGHEST]}} in a YAML file",
                    )
            self._start_up()
        except BaseException:
            loaded.close()
            raise

    def close(self) -> None:
        """Release the core; closing twice is allowed."""
        if not self._closed:
            self._closed = True
            super().close()

    def _identity(self, axis: str) -> StageIdentity:
        """Return adapter and device, and the property that holds a serial number, if any."""
        (label, _), core, serial = self._place(axis), self._loaded.core, ""
        with calling("describe the stage"):
            for name in core.getDevicePropertyNames(label):
                if "serialnumber" in "".join(filter(str.isalnum, name)).lower():
                    serial = core.getProperty(label, name)
                    break
            return StageIdentity(core.getDeviceLibrary(label), core.getDeviceName(label), serial)

    def speed_um_s(self, axis: str) -> float:
        """Return the speed of a move: the device's where a property holds it."""
        label, _ = self._place(axis)
        setup = self._setup
        if not setup.speed_property:
            return setup.speed_um_s
        with calling(f"read {setup.speed_property}"):
            shown = self._loaded.core.getProperty(label, setup.speed_property)
        return float(shown) * setup.speed_unit_um_s

    def _top_speed_um_s(self, axis: str) -> float:
        """Return the property's upper limit; one without limits is refused by the core itself."""
        label, _ = self._place(axis)
        setup = self._setup
        if not setup.speed_property:
            return setup.speed_um_s
        with calling(f"read the limits of {setup.speed_property}"):
            core = self._loaded.core
            if not core.hasPropertyLimits(label, setup.speed_property):
                return math.inf
            return core.getPropertyUpperLimit(label, setup.speed_property) * setup.speed_unit_um_s

    def set_speed_um_s(self, axis: str, speed_um_s: float) -> None:
        """As every stage; raises `SpeedFixedError` where no property holds the speed."""
        if not self._setup.speed_property:
            raise SpeedFixedError(axis, "name the property that holds it: speed_property")
        super().set_speed_um_s(axis, speed_um_s)

    def _apply_speed(self, axis: str, speed_um_s: float) -> None:
        setup = self._setup
        label, _ = self._place(axis)
        with calling(f"set {setup.speed_property}"):
            shown = speed_um_s / setup.speed_unit_um_s
            self._loaded.core.setProperty(label, setup.speed_property, shown)

    def _configure(self) -> None:
        self._homed.clear()

    def _read(self, axis: str) -> Reading:
        label, coordinate = self._place(axis)
        core = self._loaded.core
        with calling(f"read the place of {axis}"):
            if coordinate is None:
                place_um = core.getPosition(label)
            else:
                place_um = core.getXYPosition(label)[coordinate]
            moving = core.deviceBusy(label)
        return Reading(place_um, not self._setup.homes or axis in self._homed, moving)

    def _readings_are_checked(self, axis: str) -> bool:
        return True

    def _start_home(self, axes: tuple[str, ...]) -> None:
        if not self._setup.homes:
            return
        labels = {self._place(axis)[0] for axis in axes}
        together = {axis for axis in self._axes if self._place(axis)[0] in labels}
        if together != set(axes):
            raise MicroManagerError(
                f"{', '.join(sorted(labels))} homes both its axes",
                f"home {' and '.join(sorted(together))} together",
            )
        for label in sorted(labels):
            with calling(f"home {label}: set homes: false for an absolute encoder"):
                self._loaded.core.home(label)
        self._homed.update(axes)

    def _start_moves(self, targets_um: Mapping[str, float], start_um: Mapping[str, float]) -> None:
        core = self._loaded.core
        pairs: dict[str, list[float]] = {}
        with calling("move"):
            for axis, target_um in targets_um.items():
                label, coordinate = self._place(axis)
                if coordinate is None:
                    core.setPosition(label, target_um)
                else:
                    pairs.setdefault(label, list(core.getXYPosition(label)))[coordinate] = target_um
            for label, (x_um, y_um) in pairs.items():
                core.setXYPosition(label, x_um, y_um)

    def _stop_axis(self, axis: str) -> None:
        label, _ = self._place(axis)
        try:
            with calling(f"stop {axis}"):
                self._loaded.core.stop(label)
        except MicroManagerError:
            # Many one-axis adapters cannot: their moves are over when the call returns.
            if self._is_moving(axis):
                raise

    def _is_moving(self, axis: str) -> bool:
        label, _ = self._place(axis)
        with calling(f"ask whether {axis} moves"):
            return self._loaded.core.deviceBusy(label)

    def _travel_um(self, axis: str) -> tuple[float, float]:
        return self._setup.travel_um[axis]

    def _place(self, axis: str) -> tuple[str, int | None]:
        """Return the device's label, and the coordinate of a stage with two."""
        self._require_axis(axis)
        place = self._places[axis]
        for coordinate, ending in enumerate((".x", ".y")):
            if place.endswith(ending):
                return place.removesuffix(ending), coordinate
        return place, None


def stage_axes(loaded: LoadedCore) -> tuple[str, ...]:
    """Return the axes of a configuration: `XY.x` and `XY.y` of a stage with two, else its label."""
    from pymmcore_plus import DeviceType

    core = loaded.core
    two = [
        f"{label}.{c}" for label in core.getLoadedDevicesOfType(DeviceType.XYStage) for c in "xy"
    ]
    return (*two, *core.getLoadedDevicesOfType(DeviceType.Stage))
