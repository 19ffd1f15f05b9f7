"""Errors of the drivers: each carries its data and says in one line what happened, what to do."""


class DriverError(Exception):
    """Root of the drivers' errors; shown to the user as one line."""


class PortNotFoundError(DriverError):
    """No such serial port."""

    def __init__(self, port: str) -> None:
        super().__init__(f"serial port {port} does not exist: check the cable, power and port name")
        self.port = port


class PortBusyError(DriverError):
    """The serial port exists but cannot be opened."""

    def __init__(self, port: str, reason: str) -> None:
        super().__init__(
            f"serial port {port} cannot be opened ({reason}): close the program that holds it, "
            "or ask for permission to use it"
        )
        self.port = port
        self.reason = reason


class PortGoneError(DriverError):
    """The port went away while it was open."""

    def __init__(self, port: str) -> None:
        super().__init__(
            f"serial port {port} went away: plug it in, open a new transport and home the axes"
        )
        self.port = port


class TransportTimeoutError(DriverError):
    """No complete answer arrived in time; `partial` is what did arrive."""

    def __init__(self, port: str, timeout_s: float, partial: bytes = b"") -> None:
        got = f"only {partial!r}" if partial else "nothing"
        super().__init__(
            f"{port} answered {got} within {timeout_s:g} s: check power, baud rate and address"
        )
        self.port = port
        self.timeout_s = timeout_s
        self.partial = partial


class GarbledReplyError(DriverError):
    """Bytes arrived that are not a valid message."""

    def __init__(self, raw: bytes, reason: str) -> None:
        super().__init__(f"garbled reply {raw!r} ({reason}): check the cable and the baud rate")
        self.raw = raw
        self.reason = reason


class CommandRefusedError(DriverError):
    """The device understood the command and said no."""

    def __init__(self, command: str, reply: str, axis: str, advice: str) -> None:
        super().__init__(f"{axis} refused {command!r} with {reply}: {advice}")
        self.command = command
        self.reply = reply
        self.axis = axis


class UnknownAxisError(DriverError):
    """The stage has no axis of that name."""

    def __init__(self, axis: str, known: tuple[str, ...]) -> None:
        super().__init__(f"no axis {axis!r} on this stage: use one of {', '.join(known)}")
        self.axis = axis
        self.known = known


class LimitExceededError(DriverError):
    """A target outside the limits; nothing was sent to the device."""

    def __init__(self, axis: str, target_um: float, limits_um: tuple[float, float]) -> None:
        low_um, high_um = limits_um
        super().__init__(
            f"{axis} cannot go to {target_um:g} um: choose {low_um:g} to {high_um:g} um"
        )
        self.axis = axis
        self.target_um = target_um
        self.limits_um = limits_um


class NotHomedError(DriverError):
    """The axis does not know where it is; nothing was sent to the device."""

    def __init__(self, axis: str) -> None:
        super().__init__(f"{axis} does not know where it is: home it first")
        self.axis = axis


class StalledError(DriverError):
    """The motor was blocked during a move."""

    def __init__(self, axis: str) -> None:
        super().__init__(f"{axis} stalled and lost its position: clear the obstacle, then home it")
        self.axis = axis


class AxisFaultError(DriverError):
    """The axis reports a fault other than a stall."""

    def __init__(self, axis: str, fault: str) -> None:
        super().__init__(f"{axis} reports a fault, {fault}: resolve it, then home the axis")
        self.axis = axis
        self.fault = fault


class MoveTimeoutError(DriverError):
    """An axis was still moving when it should long have arrived."""

    def __init__(self, axis: str, time_limit_s: float) -> None:
        super().__init__(
            f"{axis} still moves after {time_limit_s:.3g} s: check its speed and that nothing drags"
        )
        self.axis = axis
        self.time_limit_s = time_limit_s


class PositionMismatchError(DriverError):
    """The axis stands still, but not where it was sent."""

    def __init__(self, axis: str, commanded_um: float, read_um: float, tolerance_um: float) -> None:
        super().__init__(
            f"{axis} was sent to {commanded_um:.3f} um but reads {read_um:.3f} um "
            f"(tolerance {tolerance_um:g} um): check the cable, then move again or home it"
        )
        self.axis = axis
        self.commanded_um = commanded_um
        self.read_um = read_um
        self.tolerance_um = tolerance_um


class RawFrameError(DriverError):
    """Camera bytes that are not the RAW frame they should be."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"unusable RAW frame, {reason}: capture it again")
        self.reason = reason
