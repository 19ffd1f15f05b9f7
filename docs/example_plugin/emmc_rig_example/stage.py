"""The example's stage: one axis, over any transport."""

from collections.abc import Mapping
from itertools import cycle

from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import (
    CommandRefusedError,
    DriverError,
    GarbledReplyError,
    StalledError,
    TransportTimeoutError,
)
from emmc_rig.drivers.stage import DEFAULT_SETTINGS, HostStage, Reading, StageSettings
from emmc_rig.drivers.transport import SerialTransport, Transport
from emmc_rig_example.codec import END, STEP_UM, Status, decode_status, seal

AXIS = "x"
TRAVEL_UM = (0.0, 25_000.0)
TOP_SPEED_UM_S = 5_000.0
ATTEMPTS = 3
STRAY_LINES = 8


def open_stage(address: str, settings: StageSettings, clock: Clock) -> HostStage:
    """Open the stage on a serial port: the factory that the entry point names."""
    return ExampleStage(SerialTransport(address), clock, settings)


class ExampleStage(HostStage):
    """One axis; construction asks for its state and moves nothing."""

    def __init__(
        self,
        transport: Transport,
        clock: Clock = SYSTEM_CLOCK,
        settings: StageSettings = DEFAULT_SETTINGS,
    ) -> None:
        super().__init__((AXIS,), (transport,), clock, settings)
        self._transport = transport
        self._numbers = cycle(range(1, 1000))
        self._start_up()

    def speed_um_s(self, axis: str) -> float:
        """Return the speed of a move, as the device last said it."""
        self._require_axis(axis)
        return self._speed_um_s

    def _configure(self) -> None:
        self._ask_again("status")

    def _read(self, axis: str) -> Reading:
        status = self._ask_again("status")
        if status.state == "stalled":
            raise StalledError(axis)
        return Reading(status.steps * STEP_UM, status.state != "lost", status.state == "moving")

    def _readings_are_checked(self, axis: str) -> bool:
        return True

    def _start_home(self, axes: tuple[str, ...]) -> None:
        self._ask_again("home")

    def _start_moves(self, targets_um: Mapping[str, float], start_um: Mapping[str, float]) -> None:
        for target_um in targets_um.values():
            self._ask("move", round(target_um / STEP_UM))

    def _stop_axis(self, axis: str) -> None:
        self._ask_again("stop")

    def _is_moving(self, axis: str) -> bool:
        return self._read(axis).moving

    def _travel_um(self, axis: str) -> tuple[float, float]:
        return TRAVEL_UM

    def _top_speed_um_s(self, axis: str) -> float:
        return TOP_SPEED_UM_S

    def _apply_speed(self, axis: str, speed_um_s: float) -> None:
        self._ask_again("speed", max(1, round(speed_um_s / STEP_UM)))

    def _ask_again(self, verb: str, value: int | None = None) -> Status:
        """Exchange a command that does no harm twice."""
        for _ in range(ATTEMPTS - 1):
            try:
                return self._ask(verb, value)
            except (TransportTimeoutError, GarbledReplyError):
                continue
        return self._ask(verb, value)

    def _ask(self, verb: str, value: int | None = None) -> Status:
        """Exchange a command once; a late reply to an earlier one is known by its number."""
        number = next(self._numbers)
        command = f"{number} {verb}" if value is None else f"{number} {verb} {value}"
        try:
            status = self._exchange(number, command)
        except DriverError as error:
            error.about(axis=AXIS, command=command)
            raise
        if not status.accepted:
            raise CommandRefusedError(command, "no", AXIS, "see the manual")
        self._speed_um_s = status.speed * STEP_UM
        return status

    def _exchange(self, number: int, command: str) -> Status:
        with self._transport.lock:
            self._transport.discard_input()
            self._transport.write(seal(command))
            for _ in range(STRAY_LINES):
                status = decode_status(self._transport.read_until(END))
                if status.number == number:
                    return status
            raise GarbledReplyError(b"", "only replies to other commands came")
