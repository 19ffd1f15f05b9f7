"""The example's firmware, simulated: it answers on the same wire as the real one."""

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import GarbledReplyError
from emmc_rig.drivers.stage import HostStage, StageSettings
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.firmware import SimulatedController
from emmc_rig.simulators.motion import AxisSpec, End, Motor
from emmc_rig_example.codec import END, STEP_UM, seal, unseal
from emmc_rig_example.stage import TOP_SPEED_UM_S, TRAVEL_UM, ExampleStage

SPEC = AxisSpec(travel_um=TRAVEL_UM[1], max_speed_um_s=TOP_SPEED_UM_S)


def open_simulated(address: str, settings: StageSettings, clock: Clock) -> HostStage:
    """Open a stage over simulated firmware, whose time passes at once."""
    clock = ManualClock()
    return ExampleStage(ExampleController(clock).transport(), clock, settings)


class ExampleController(SimulatedController):
    """An axis whose position is unknown after power-up, until it is homed."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self._unread = b""
        self._power_up(Motor(SPEC, clock))

    def position_um(self) -> float:
        """Return where the carriage really is."""
        self._advance()
        return self._motor.nut_um

    def power_cycle(self) -> None:
        """Switch off and on."""
        with self._lock:
            self._power_up(self._motor.restarted())

    def _power_up(self, motor: Motor) -> None:
        self._motor = motor
        self._speed_um_s = TOP_SPEED_UM_S
        self._homed = self._homing = self._stalled = False

    def _advance(self) -> None:
        end = self._motor.advance()
        if end is None:
            return
        if end in (End.STALLED, End.AT_END_OF_TRAVEL):
            self._stalled, self._homed = True, False
        elif end is End.ARRIVED and self._homing:
            self._motor.count_from_here()
            self._homed = True

    def _next_event_s(self) -> float | None:
        return self._motor.ends_s

    def _receive(self, data: bytes) -> None:
        *lines, self._unread = (self._unread + data).split(END)
        for line in lines:
            try:
                number, verb, *values = unseal(line)
            except (GarbledReplyError, ValueError):
                continue
            word = "ok" if self._obey(verb, [int(value) for value in values]) else "no"
            self._answer(number, word)

    def _obey(self, verb: str, values: list[int]) -> bool:
        motor, acceleration_um_s2 = self._motor, SPEC.acceleration_um_s2
        if verb == "home":
            self._homing, self._homed, self._stalled = True, False, False
            motor.seek(0.0, self._speed_um_s, acceleration_um_s2)
        elif verb == "move" and self._homed and 0 <= values[0] * STEP_UM <= SPEC.travel_um:
            self._homing = False
            motor.go(values[0] * STEP_UM, self._speed_um_s, acceleration_um_s2)
        elif verb == "stop":
            motor.brake(acceleration_um_s2)
        elif verb == "speed":
            self._speed_um_s = values[0] * STEP_UM
        elif verb != "status":
            return False
        return True

    def _answer(self, number: str, word: str) -> None:
        state = "moving" if self._motor.moving else "idle" if self._homed else "lost"
        if self._stalled:
            state = "stalled"
        steps, speed = round(self._motor.counted_um / STEP_UM), round(self._speed_um_s / STEP_UM)
        self._send(seal(f"{number} {word} {steps} {speed} {state}"))
