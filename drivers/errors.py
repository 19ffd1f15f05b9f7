"""Errors of the drivers: their data, and a message of one line with the cause and advice."""

from pathlib import Path
from typing import Self

SHOWN_BYTES = 48
UDEV_RULE = Path(__file__).with_name("99-emmc-rig.rules")
"""The udev rule that lets users of Linux open the devices of the bench."""
LET_IN = (
    f"copy {UDEV_RULE} to /etc/udev/rules.d/, run `sudo udevadm control --reload-rules`, and plug "
    "the device in again"
)
"""What helps against a device that the user may not open."""
ALL_AXES = "every axis"
"""The `axis` of an error of a controller as a whole."""


def _shown(raw: bytes) -> str:
    """Return bytes for a message: all of a few, the beginning and the number of many."""
    if len(raw) <= SHOWN_BYTES:
        return repr(raw)
    return f"{raw[:SHOWN_BYTES]!r}... ({len(raw)} bytes)"


class DriverError(OSError):
    """Root of the drivers' errors; shown to the user as one line.

    An error of a value that the caller chose is a ValueError, too; one of time a TimeoutError.

    `axis`, `command` and `reply` are what the error is about, `stage` how the stage was named when
    it was opened; "" where unknown.
    `loses_position`: the axis no longer knows where it is.
    """

    loses_position = False

    def __init__(
        self, what: str, advice: str = "", *, axis: str = "", command: str = "", reply: str = ""
    ) -> None:
        super().__init__(what)
        self.what = what
        self.advice = advice
        self.axis = axis
        self.command = command
        self.reply = reply
        self.stage = ""

    def about(self, *, axis: str = "", command: str = "", reply: str = "", stage: str = "") -> Self:
        """Fill in what was unknown where the error arose; returns the same error."""
        self.stage = self.stage or stage
        self.axis = self.axis or axis
        self.command = self.command or command
        self.reply = self.reply or reply
        return self

    def __str__(self) -> str:
        facts = []
        if self.axis and self.axis not in self.what:
            facts.append(f"axis {self.axis}")
        if self.command and repr(self.command) not in self.what:
            facts.append(f"command {self.command!r}")
        if self.reply and self.reply not in self.what:
            facts.append(f"reply {self.reply!r}")
        text = self.what + (f" ({', '.join(facts)})" if facts else "")
        return f"{text}: {self.advice}" if self.advice else text


class PortError(DriverError):
    """Something is wrong with a port, not with the device behind it."""

    def __init__(self, port: str, what: str, advice: str) -> None:
        super().__init__(f"serial port {port} {what}", advice)


class PortNotFoundError(PortError, FileNotFoundError):
    """The name matches no serial port, or several."""

    def __init__(self, port: str, what: str = "does not exist") -> None:
        super().__init__(port, what, "check the cable, power and port name")


class PortBusyError(PortError):
    """The serial port exists, but another program holds it; `holder` is "" where it is unknown."""

    def __init__(self, port: str, reason: str, holder: str = "") -> None:
        what = f"is held by {holder}" if holder else f"cannot be opened ({reason})"
        super().__init__(port, what, "close the program that holds it, then try again")
        self.reason = reason
        self.holder = holder


class PortPermissionError(PortError, PermissionError):
    """The serial port exists, but this user may not open it."""

    def __init__(self, port: str) -> None:
        super().__init__(port, "may not be opened by this user", LET_IN)


class PortGoneError(PortError, ConnectionError):
    """The port went away while it was open."""

    loses_position = True

    def __init__(self, port: str) -> None:
        super().__init__(port, "went away", "plug it in, reconnect, then home the axes")


class TransportTimeoutError(DriverError, TimeoutError):
    """No complete answer arrived in time; `partial` is what did arrive."""

    def __init__(self, port: str, timeout_s: float, partial: bytes = b"") -> None:
        got = f"only {_shown(partial)}" if partial else "nothing"
        super().__init__(
            f"{port} answered {got} within {timeout_s:g} s", "check power, baud rate and address"
        )
        self.partial = partial


class GarbledReplyError(DriverError):
    """Bytes arrived that are not a valid message, or contradict each other.

    on_the_line: whether the bytes show that they were changed on the line, as a wrong checksum
    does; None: no text has them.
    """

    def __init__(self, raw: bytes, reason: str, on_the_line: bool | None = None) -> None:
        if on_the_line is None:
            on_the_line = not (
                raw.isascii() and all(byte >= 32 or byte in b"\r\n\t" for byte in raw)
            )
        advice = "check the cable and the baud rate"
        if not on_the_line:
            advice = "check the device's model and protocol, and the version of its firmware"
        what = f"garbled reply {_shown(raw)}" if raw else "no valid reply"
        super().__init__(f"{what} ({reason})", advice)
        self.raw = raw
        self.reason = reason


class FirmwareError(DriverError):
    """The controller's firmware is unsupported, or does not state a setting that is needed."""


class CommandRefusedError(DriverError):
    """The device understood the command and said no."""

    def __init__(self, command: str, reply: str, axis: str, advice: str) -> None:
        super().__init__(
            f"{axis} refused {command!r} with {reply}",
            advice,
            axis=axis,
            command=command,
            reply=reply,
        )


class UnknownAxisError(DriverError, ValueError):
    """The stage has no axis of that name."""

    def __init__(self, axis: str, known: tuple[str, ...]) -> None:
        super().__init__(
            f"no axis {axis!r} on this stage", f"use one of {', '.join(known)}", axis=axis
        )


class LimitExceededError(DriverError, ValueError):
    """A target outside the limits; nothing was sent to the device."""

    def __init__(self, axis: str, target_um: float, limits_um: tuple[float, float]) -> None:
        low_um, high_um = limits_um
        super().__init__(
            f"{axis} cannot go to {target_um:g} um",
            f"choose {low_um:g} to {high_um:g} um",
            axis=axis,
        )
        self.limits_um = limits_um


class SpeedLimitError(DriverError, ValueError):
    """A speed that the axis cannot have; nothing was sent to the device."""

    def __init__(self, axis: str, speed_um_s: float, top_speed_um_s: float) -> None:
        super().__init__(
            f"{axis} cannot move at {speed_um_s:g} um/s",
            f"choose a speed above 0, up to {top_speed_um_s:g} um/s",
            axis=axis,
        )


class SpeedFixedError(DriverError, ValueError):
    """The axis has one speed, which cannot be chosen; nothing was sent to the device."""

    def __init__(self, axis: str, advice: str) -> None:
        super().__init__(f"the speed of {axis} cannot be chosen", advice, axis=axis)


class ScaleError(DriverError):
    """The length of an axis's step is unknown or contradicted; nothing was moved."""

    def __init__(self, axis: str, what: str, advice: str) -> None:
        super().__init__(f"{axis} must not move, {what}", advice, axis=axis)


class NotHomedError(DriverError):
    """The axis does not know where it is; nothing was sent to the device."""

    def __init__(self, axis: str, why: str = "") -> None:
        super().__init__(
            f"{axis} does not know where it is{f', {why}' if why else ''}",
            "home it first",
            axis=axis,
        )
        self.why = why


class AxisFaultError(DriverError):
    """The axis reports a fault."""

    loses_position = True
    usual_fault = "unnamed"
    usual_advice = "clear the fault, then home the axis"

    def __init__(self, axis: str, fault: str = "", advice: str = "") -> None:
        what = f"{axis} reports a fault, {fault or self.usual_fault}"
        super().__init__(what, advice or self.usual_advice, axis=axis)


class StalledError(AxisFaultError):
    """The motor was blocked during a move."""

    usual_fault = "stalled"
    usual_advice = "clear the obstacle, then home the axis"


class EmergencyStopError(AxisFaultError):
    """The emergency stop was pressed, or the motor driver is off."""

    usual_fault = "emergency stop"
    usual_advice = "make the bench safe, release the stop, then home the axis"


class LimitSwitchError(AxisFaultError):
    """The axis ran into the end of its travel."""

    usual_fault = "limit switch reached"
    usual_advice = "check the limits and what is in the way, then home the axis"


class PressedSwitchError(LimitSwitchError):
    """The axis stands on a limit switch: homing could drive it deeper, and was not begun.

    away: "up" or "down", the direction that leads off the switch; "" where it is unknown.
    """

    def __init__(self, axis: str, away: str = "", reply: str = "") -> None:
        way = f"{away}wards" if away else "away from the end of the travel at which it stands"
        super().__init__(
            axis,
            "it stands on its limit switch",
            f"move it off the switch, {way}, before it is homed",
        )
        self.away = away
        self.reply = reply


class LostPositionError(AxisFaultError):
    """The axis no longer knows where it is."""

    usual_fault = "position lost"
    usual_advice = "home the axis, and repeat what was done since it was last homed"


class MoveTimeoutError(DriverError, TimeoutError):
    """An axis was still moving when it should long have arrived."""

    def __init__(self, axis: str, time_limit_s: float) -> None:
        super().__init__(
            f"{axis} still moves after {time_limit_s:.3g} s",
            "check the axis's speed, and its load",
            axis=axis,
        )
        self.time_limit_s = time_limit_s


class PositionMismatchError(DriverError):
    """The axis stands still, but not where it was sent."""

    def __init__(self, axis: str, commanded_um: float, read_um: float, tolerance_um: float) -> None:
        super().__init__(
            f"{axis} was sent to {commanded_um:.3f} um but reads {read_um:.3f} um "
            f"(tolerance {tolerance_um:g} um)",
            "see that nothing blocks it, then home the axis",
            axis=axis,
        )
        self.commanded_um = commanded_um
        self.read_um = read_um


class _WordedError(DriverError):
    """Root of errors that differ in their words alone, which their classes state.

    says: the message, with a place for `reason`: what happened, or the device's name.
    """

    _says, _advice = "", ""

    def __init_subclass__(cls, says: str = "", advice: str = "") -> None:
        cls._says, cls._advice = says or cls._says, advice or cls._advice

    def __init__(self, reason: str, advice: str = "") -> None:
        super().__init__(self._says.format(reason), advice or self._advice)
        self.reason = reason


class RawFrameError(
    _WordedError, ValueError, says="unusable RAW frame, {}", advice="capture it again"
):
    """Camera bytes that are not the RAW frame they should be."""


class UsbUnavailableError(
    _WordedError,
    says="USB cannot be used here ({})",
    advice="reinstall libusb-package, and in a container pass /dev/bus/usb through",
):
    """USB cannot be used on this computer at all."""


class UsbPermissionError(
    _WordedError,
    PermissionError,
    says="{} may not be opened by this user",
    advice=LET_IN,
):
    """The device is there but this user may not open it."""


class UsbGoneError(
    _WordedError,
    ConnectionError,
    says="{} went away",
    advice="plug it in, switch it on, then open the device again",
):
    """The device was unplugged, or lost its power, while it was open."""


class CardFullError(
    _WordedError, says="the card of {} is full or missing", advice="empty or insert it"
):
    """The memory card has no room for another picture."""


class CaptureError(_WordedError, says="no frame, {}", advice="capture it again"):
    """The camera was released but gave no usable frame; the next may be taken."""


class NoFrameError(CaptureError, TimeoutError, advice="check the trigger and the cable"):
    """No frame began within its time."""


class ExposureStoppedError(
    _WordedError, says="{}: the exposure was broken off; take the frame again"
):
    """An exposure was broken off because somebody asked for it."""


class CameraClosedError(_WordedError, says="{} was closed", advice="open it again"):
    """The camera was closed by this program."""


class CameraDescriptionError(
    _WordedError,
    says="unusable camera description, {}",
    advice="update the camera's firmware, or use another camera",
):
    """The camera's own description of its features (GenICam) cannot be used."""


class GenicamMissingError(DriverError):
    """EMVA's library, which follows the descriptions of USB3 Vision cameras, is not installed."""

    def __init__(self) -> None:
        super().__init__("USB3 Vision cameras need genicam", 'pip install "emmc-rig[u3v]"')


class UsbNotFoundError(DriverError, FileNotFoundError):
    """No device that matches is plugged in; `present` names those that are."""

    def __init__(self, wanted: str, present: tuple[str, ...] = ()) -> None:
        seen = ", ".join(present) if present else "no device of that kind"
        super().__init__(
            f"no {wanted} on USB ({seen} found): check cable, power and the device's USB mode"
        )


class UsbClaimedError(DriverError):
    """Another program holds the device; `holders` are its name and process id, where known."""

    def __init__(self, device: str, holders: tuple[str, ...], advice: str) -> None:
        by = ", ".join(holders) if holders else "another program"
        super().__init__(f"{device} is claimed by {by}: {advice}")
        self.holders = holders


class UsbStalledError(DriverError):
    """The device halted an endpoint: it did not accept the host's data or request."""

    def __init__(self, device: str, endpoint: int) -> None:
        super().__init__(
            f"{device} stalled endpoint {endpoint:#04x}: clear the halt and try again, "
            "or switch the device off and on"
        )


class UsbTimeoutError(DriverError, TimeoutError):
    """A transfer did not finish in time; `done` is how many bytes of it passed."""

    def __init__(self, device: str, timeout_s: float, done: int = 0) -> None:
        got = f"stopped after {done} bytes" if done else "was silent"
        super().__init__(
            f"{device} {got} for {timeout_s:g} s: check power and the device's sleep mode"
        )
        self.done = done


class UsbTransferError(DriverError):
    """The transfer failed in any other way; `reason` is what libusb says."""

    def __init__(self, device: str, reason: str, advice: str) -> None:
        super().__init__(f"{device}: transfer failed ({reason}): {advice}")
        self.reason = reason


class CameraSettingError(DriverError, ValueError):
    """The camera cannot be set to that; nothing was sent to it."""

    def __init__(self, setting: str, reason: str) -> None:
        super().__init__(f"the camera's {setting} {reason}")
        self.reason = reason


class CameraFormatError(DriverError):
    """Bytes from a camera that are no message of its protocol, or an unexpected message."""

    def __init__(self, raw: bytes, reason: str) -> None:
        shown = raw[:24].hex(" ") + (" ..." if len(raw) > 24 else "")
        super().__init__(
            f"the camera's answer is garbled, {reason} ({shown or 'nothing'}): "
            "open the camera again"
        )
        self.reason = reason


class CameraRefusedError(DriverError):
    """The camera understood the request and said no."""

    def __init__(self, operation: str, answer: str, advice: str) -> None:
        super().__init__(f"the camera refused {operation} with {answer}: {advice}")


class CameraBusyError(DriverError, TimeoutError):
    """The camera answered "busy", or asked for more time, for too long."""

    def __init__(self, operation: str, waited_s: float) -> None:
        super().__init__(
            f"the camera was busy for {waited_s:.3g} s when asked {operation}: wait until its "
            "pictures are stored, check battery and menus, or switch the camera off and on"
        )


class DownloadError(DriverError):
    """A picture is on the card but could not be fetched whole."""

    def __init__(self, name: str, got: int, size: int, reason: str) -> None:
        super().__init__(
            f"{name} came only in part, {got} of {size} bytes ({reason}): "
            "the picture is still on the card, fetch it again"
        )
        self.reason = reason


class FolderCameraError(DriverError):
    """A folder of recorded frames has none to give."""

    def __init__(self, folder: str, reason: str) -> None:
        super().__init__(f"no frame from {folder}, {reason}: name a folder of RAW files")
        self.reason = reason


class LightError(DriverError):
    """The lights did not confirm the colour that was sent to them."""


class MicroManagerError(DriverError):
    """Micro-Manager's core, or a device behind it, said no."""

    def __init__(
        self, what: str, advice: str = "see the adapter's page at micro-manager.org"
    ) -> None:
        super().__init__(what, advice)


class GphotoError(DriverError):
    """libgphoto2, or the camera behind it, said no; `code` is its number."""

    def __init__(self, what: str, code: int, meaning: str, advice: str) -> None:
        super().__init__(f"libgphoto2 could not {what} ({meaning})", advice)
        self.code = code
