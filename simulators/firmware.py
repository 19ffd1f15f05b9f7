"""What all simulated controllers share: cable, lock, time, and faults on the wire."""

import heapq
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import NamedTuple

from emmc_rig.drivers.clock import Clock
from emmc_rig.simulators.faults import Faults
from emmc_rig.simulators.motion import Motor
from emmc_rig.simulators.wire import MemoryTransport

WIRE_FAULTS = (
    "drop_command",
    "lose_command_byte",
    "drop_reply",
    "lose_reply_byte",
    "garble_reply",
    "late_reply",
    "duplicate_reply",
    "unplug",
)
MOTION_FAULTS = ("stall", "drift", "busy_forever", "slow_start")


class Occasion(NamedTuple):
    """What a fault's condition is given: the command under way, and the reply to it, if any."""

    command: bytes
    reply: bytes = b""


class SimulatedController(ABC):
    """Firmware on the end of a wire.

    Faults, armed with `faults.inject`: `drop_command` and `drop_reply` lose one message,
    `lose_command_byte` and `lose_reply_byte` the byte in its middle, `garble_reply` flips a bit
    there (another one each time), `late_reply` holds it back for `late_by_s`, `duplicate_reply`
    sends it twice, `unplug` pulls the cable at the next byte from the host. `stall` blocks the
    next move half way, `drift` shifts the axis by `drift_um` unnoticed at the end of the next
    move, after `busy_forever` an axis says for ever that it moves, `slow_start` lets the next move
    begin `slow_by_s` after its command. `plugs` counts how often the cable was plugged in: a port
    opened before the last time is dead.
    """

    def __init__(self, clock: Clock, faults: Iterable[str] = ()) -> None:
        self.faults = Faults((*WIRE_FAULTS, *MOTION_FAULTS, *faults))
        self.late_by_s = 0.7
        self.drift_um = 40.0
        self.slow_by_s = 0.2
        self._clock = clock
        self._lock = threading.RLock()
        self.unplugged = False
        self.plugs = 1
        self._command = b""
        self._outbox: list[tuple[float, int, bytes]] = []
        self._sent = 0
        self._garbled = 0

    def _stalls(self, motor: Motor) -> bool:
        """Arm on the motor the faults that strike its next move; return whether it stalls."""
        if self.faults.strikes("drift", self._command):
            motor.drift_um = self.drift_um
        motor.busy_forever |= self.faults.strikes("busy_forever", self._command)
        return self.faults.strikes("stall", self._command)

    def _start_s(self) -> float:
        """Return when a move that was commanded now begins."""
        slow = self.faults.strikes("slow_start", Occasion(self._command))
        return self._clock.now_s() + (self.slow_by_s if slow else 0.0)

    @abstractmethod
    def power_cycle(self) -> None:
        """Switch off and on: the axes stay in place and lose their reference."""

    @abstractmethod
    def _receive(self, data: bytes) -> None:
        """Take bytes from the host, in pieces of any size, and answer with `_send`."""

    @abstractmethod
    def _advance(self) -> None:
        """Advance to the time of the clock; messages that nobody asked for go out by `_send`."""

    @abstractmethod
    def _next_event_s(self) -> float | None:
        """Return when the firmware's own state will next change, if it will."""

    def transport(self, timeout_s: float = 0.5) -> MemoryTransport:
        """Return a wire in memory that ends in this firmware."""
        return MemoryTransport(self, self._clock, timeout_s)

    def unplug(self) -> None:
        """Pull the cable of the port; the power stays on."""
        with self._lock:
            self.unplugged = True

    def replug(self, power_lost: bool = False) -> None:
        """Plug the cable in again, after a loss of power too if `power_lost`."""
        with self._lock:
            self.unplugged = False
            self.plugs += 1
            self._outbox.clear()
            if power_lost:
                self.power_cycle()

    def feed(self, data: bytes) -> bytes:
        """Take bytes from the host; return those that fell due for the host by now."""
        with self._lock:
            if self.unplugged or self.faults.strikes("unplug", Occasion(data)):
                self.unplugged = True
                return b""
            if self.faults.strikes("lose_command_byte", Occasion(data)):
                data = _without_middle(data)
            self._advance()
            self._receive(data)
            return self._due()

    def due(self) -> bytes:
        """Return the bytes that fell due for the host by now."""
        with self._lock:
            if self.unplugged:
                return b""
            self._advance()
            return self._due()

    def next_due_s(self) -> float | None:
        """Return when something may next fall due, if anything will."""
        with self._lock:
            return earliest_s([self._next_event_s(), *(entry[0] for entry in self._outbox[:1])])

    def _due(self) -> bytes:
        now_s = self._clock.now_s()
        due = b""
        while self._outbox and self._outbox[0][0] <= now_s:
            due += heapq.heappop(self._outbox)[2]
        return due

    def _send(self, message: bytes) -> None:
        """Put a message on the wire to the host, where faults may strike it."""
        occasion = Occasion(self._command, message)
        if self.faults.strikes("drop_reply", occasion):
            return
        if self.faults.strikes("lose_reply_byte", occasion):
            message = _without_middle(message)
        if self.faults.strikes("garble_reply", occasion):
            self._garbled += 1
            bit = 1 << self._garbled % 7
            middle = len(message) // 2
            message = message[:middle] + bytes([message[middle] ^ bit]) + message[middle + 1 :]
        due_s = self._clock.now_s()
        if self.faults.strikes("late_reply", occasion):
            due_s += self.late_by_s
        for _ in range(2 if self.faults.strikes("duplicate_reply", occasion) else 1):
            self._sent += 1
            heapq.heappush(self._outbox, (due_s, self._sent, message))

    def _dropped(self, command: bytes) -> bool:
        """Take note of the command under way; return whether a fault loses it."""
        self._command = command
        return self.faults.strikes("drop_command", Occasion(command))


def earliest_s(times_s: Iterable[float | None]) -> float | None:
    """Return the earliest of the times that are known, None where none is."""
    return min((time_s for time_s in times_s if time_s is not None), default=None)


def _without_middle(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + data[middle + 1 :]
