"""Still cameras through libgphoto2, which knows the release of some 2,500 models; extra `gphoto2`.

Its settings have the same names for most makers (`shutterspeed`, `iso`) and values in words, such
as 1/125 or 0.0080s. Source: python-gphoto2 2.5, libgphoto2 2.5.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from emmc_rig.drivers.camera import CameraIdentity, Limits, ShapeFromFrames, check_setting
from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import CameraClosedError, CameraSettingError, CaptureError, GphotoError
from emmc_rig.drivers.raw import RawFrame, has_raw_suffix

PTP_IP = "PTP/IP Camera"
PAIR_LIMIT_S = 2.0
"""How long to wait for a RAW file once another file of the same exposure came."""
SHUTTER, ISO = "shutterspeed", "iso"
TARGET, CARD = "capturetarget", "Memory card"
"""Where frames go. Otherwise it is what libgphoto2 last stored in this user's home, else the
camera's memory, which not every EOS takes.
"""
IDENTITY = ("manufacturer", "cameramodel", "serialnumber", "deviceversion")
SECONDS = re.compile(r'(?:(\d+)/)?(\d+(?:\.\d+)?) ?(?:s|sec|")?')
ADVICE = {
    -1: "look at the camera's display; without a memory card, set capturetarget: Internal RAM",
    -7: "check cable and power; switch the camera off and on",
    -10: "check cable and power; switch the camera off and on",
    -52: "plug it in, then switch the camera on",
    -53: "another program has the camera, often the desktop's file manager: eject it there",
    -105: "plug it in, then switch the camera on; or name its model as gphoto2 --list-cameras does",
    -110: "wait until it is ready",
}


@dataclass(frozen=True)
class GphotoSetup:
    """How a camera is found and set.

    model: libgphoto2's name of it; "" where libgphoto2 finds that out. settings: by libgphoto2's
    names, set at the start; frames go to the memory card unless `capturetarget` says otherwise.
    delete: each RAW file from the card once it has arrived; a JPEG beside it stays.
    """

    model: str = ""
    settings: Mapping[str, str | int | float] = field(default_factory=dict)
    delete: bool = False


OPTIONS = GphotoSetup


def open_camera(address: str, clock: Clock, backend: object, setup: GphotoSetup) -> GphotoCamera:
    """Open the camera at a port of libgphoto2's, "" for the first; see `drivers.cameras`."""
    return GphotoCamera(address, setup.model, setup.settings, setup.delete, clock)


def seconds_of(choice: str) -> float | None:
    """Return the exposure that a choice's words mean, None for bulb, auto and the like."""
    match = SECONDS.fullmatch(choice.strip())
    if match is None:
        return None
    over, under = match.groups()
    value = float(under) if over is None else float(over) / float(under) if float(under) else 0.0
    return value if value > 0 else None


class GphotoCamera(ShapeFromFrames):
    """A still camera set to RAW and manual exposure, found by libgphoto2.

    address: a port such as `usb:001,007` or `ptpip:192.168.1.5`; "" takes the first camera found.
    The rest as in `GphotoSetup`. The size of a frame is known from the first one, which asking for
    it takes. Raises `GphotoError`, `CameraSettingError`.
    """

    def __init__(
        self,
        address: str = "",
        model: str = "",
        settings: Mapping[str, str | int | float] | None = None,
        delete: bool = False,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        try:
            import gphoto2
        except ImportError as error:
            raise GphotoError(
                "be loaded", 0, "not installed", 'pip install "emmc-rig[gphoto2]"'
            ) from error
        self._gp: Any = gphoto2
        self._library = _loaded(Path(gphoto2.__file__).parent)
        self._clock = clock
        self._delete = delete
        self._lock = threading.RLock()
        self._closed = False
        with self._asking("open the camera"):
            self._camera: Any = self._gp.Camera()
            self._choose(address, model)
            self._camera.init()
        try:
            on_card = {TARGET: CARD} if CARD in self._choices(TARGET) else {}
            for name, value in (on_card | dict(settings or {})).items():
                self._set(name, str(value))
            self._shutters = self._numbers(SHUTTER, seconds_of)
            self._isos = self._numbers(ISO, lambda word: float(word) if word.isdecimal() else None)
            self.identity = CameraIdentity(*(self._text(name) for name in IDENTITY))
        except BaseException:
            self.close()
            raise

    @property
    def exposure_s(self) -> float:
        """Exposure of the next frame, as the camera states it."""
        seconds = seconds_of(self._text(SHUTTER))
        if seconds is None:
            raise CameraSettingError("exposure", "is not known: turn its mode dial to M")
        return seconds

    @property
    def exposure_limits_s(self) -> Limits:
        """Shortest and longest exposure; equal where it cannot be chosen."""
        if not self._shutters:
            return self.exposure_s, self.exposure_s
        return min(self._shutters), max(self._shutters)

    @property
    def gain(self) -> float:
        """Gain of the next frame: ISO over the lowest ISO."""
        text = self._text(ISO)
        return float(text) / min(self._isos) if self._isos and text.isdecimal() else 1.0

    @property
    def gain_limits(self) -> Limits:
        """Lowest and highest gain; equal where it cannot be chosen."""
        if not self._isos:
            return self.gain, self.gain
        return 1.0, max(self._isos) / min(self._isos)

    def details(self) -> dict[str, str]:
        """Return the camera's settings by libgphoto2's names."""
        with self._asking("read the settings"):
            return dict(self._values(self._camera.get_config()))

    def set_exposure_s(self, exposure_s: float) -> None:
        """Choose the exposure of the frames that follow: the nearest that the camera has.

        Raises `ValueError` unless positive, `CameraSettingError` outside the limits.
        """
        check_setting("exposure in seconds", exposure_s, self.exposure_limits_s)
        if self._shutters:
            self._set_nearest(SHUTTER, self._shutters, exposure_s)

    def set_gain(self, gain: float) -> None:
        """Choose the gain of the frames that follow: the nearest ISO; raises as the exposure."""
        check_setting("gain", gain, self.gain_limits)
        if self._isos:
            self._set_nearest(ISO, self._isos, gain * min(self._isos))

    def snap(self) -> RawFrame:
        """Expose and return one frame; raises `GphotoError`, `CaptureError`, `RawFrameError`."""
        with self._lock:
            exposure_s, gain = self.exposure_s, self.gain
            with self._asking("take a picture"):
                # Events of an earlier exposure: no file of it may pass for the next.
                while self._camera.wait_for_event(1)[0] != self._gp.GP_EVENT_TIMEOUT:
                    pass
                first = self._camera.capture(self._gp.GP_CAPTURE_IMAGE)
                name, data = self._raw_file(first)
            return self._decoded(name, data, exposure_s, gain, self._clock.now_s())

    def close(self) -> None:
        """Close the camera; closing twice is allowed."""
        with self._lock:
            if not self._closed:
                self._closed = True
                # It may be unplugged or off: then there is nothing to let go of.
                with suppress(self._gp.GPhoto2Error):
                    self._camera.exit()

    def _choose(self, address: str, model: str) -> None:
        """Pass model and port to libgphoto2, which searches for a camera without an address."""
        gp = self._gp
        if address.startswith("ptpip:"):
            model = model or PTP_IP
        if model:
            known = gp.CameraAbilitiesList()
            known.load()
            self._camera.set_abilities(known[known.lookup_model(model)])
        if address:
            ports = gp.PortInfoList()
            ports.load()
            self._camera.set_port_info(ports[ports.lookup_path(address)])

    def _raw_file(self, first: Any) -> tuple[str, bytes]:
        """Return name and bytes of the RAW file of an exposure, the first file or a later one."""
        gp, camera = self._gp, self._camera
        paths = [first]
        deadline_s = self._clock.now_s() + PAIR_LIMIT_S
        while not (raw := [path for path in paths if has_raw_suffix(path.name)]):
            left_s = deadline_s - self._clock.now_s()
            if left_s <= 0:
                names = ", ".join(path.name for path in paths)
                raise CaptureError(
                    f"the camera gave {names}", "set its image quality to RAW, or RAW with JPEG"
                )
            kind, path = camera.wait_for_event(max(1, round(1e3 * left_s)))
            if kind == gp.GP_EVENT_FILE_ADDED:
                paths.append(path)
        (path,) = raw
        # The file's memory goes with the object: it must outlive the copy.
        file = camera.file_get(path.folder, path.name, gp.GP_FILE_TYPE_NORMAL)
        data = bytes(file.get_data_and_size())
        if self._delete:
            camera.file_delete(path.folder, path.name)
        return path.name, data

    def _numbers(self, name: str, number: Any) -> dict[float, str]:
        """Return the choices of a setting that are numbers above 0, {} where it has none."""
        found = {number(word): word for word in self._choices(name)}
        return {value: word for value, word in found.items() if value}

    def _choices(self, name: str) -> list[str]:
        """Return the choices of a setting as words, [] for a setting without choices."""
        with self._lock, suppress(self._gp.GPhoto2Error):
            widget = self._camera.get_single_config(name)
            if widget is not None and not widget.get_readonly():
                return list(widget.get_choices())
        return []

    def _text(self, name: str) -> str:
        """Return a setting's value, "" where the camera has none such."""
        with self._lock:
            if self._closed:
                raise CameraClosedError(self.identity.model)
            try:
                return self._value(self._camera.get_single_config(name)) or ""
            except self._gp.GPhoto2Error:
                return ""

    def _set_nearest(self, name: str, words: Mapping[float, str], wanted: float) -> None:
        nearest = min(words, key=lambda value: abs(value / wanted - 1))
        self._set(name, words[nearest])

    def _set(self, name: str, word: str) -> None:
        """Set a setting; raises `CameraSettingError`."""
        with self._lock:
            if self._closed:
                raise CameraClosedError(self.identity.model)
            try:
                widget = self._camera.get_single_config(name)
                if widget is None:
                    raise CameraSettingError(name, f"cannot become {word}: the camera has none")
                widget.set_value(word)
                self._camera.set_single_config(name, widget)
            except self._gp.GPhoto2Error as error:
                raise CameraSettingError(name, f"cannot become {word} ({error.string})") from error

    def _values(self, widget: Any) -> Iterator[tuple[str, str]]:
        """Yield name and value of every setting below a widget; buttons have no value."""
        for child in widget.get_children():
            yield from self._values(child)
            with suppress(self._gp.GPhoto2Error):
                value = None if child.count_children() else self._value(child)
                if value is not None:
                    yield child.get_name(), value

    def _value(self, widget: Any) -> str | None:
        """Return a setting's value; None for a missing setting, or a setting without a value.

        A camera whose value is none of its own choices leaves the setting without, and
        python-gphoto2 2.6 ends the process when it is asked for a word that is not there.
        """
        gp = self._gp
        if widget is None:
            return None
        if widget.get_type() in (gp.GP_WIDGET_TEXT, gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU):
            word = ctypes.c_void_p()
            here = ctypes.c_void_p(int(widget.this))
            self._library.gp_widget_get_value(here, ctypes.byref(word))
            if not word.value:
                return None
        return str(widget.get_value())

    @contextmanager
    def _asking(self, what: str) -> Iterator[None]:
        """Hold the lock, and turn libgphoto2's errors into a `GphotoError` about `what`."""
        with self._lock:
            if self._closed:
                raise CameraClosedError(self.identity.model)
            try:
                yield
            except self._gp.GPhoto2Error as error:
                advice = ADVICE.get(error.code, "switch the camera off and on, then try again")
                raise GphotoError(what, error.code, error.string, advice) from error


def _loaded(package: Path) -> ctypes.CDLL:
    """Return the libgphoto2 that python-gphoto2 uses: in its wheel, or else the system's."""
    inside = sorted((package / "libgphoto2").glob("libgphoto2.*"))
    return ctypes.CDLL(str(inside[0]) if inside else ctypes.util.find_library("gphoto2"))
