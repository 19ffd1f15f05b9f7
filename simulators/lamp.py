"""A lamp on an Arduino, which restarts when its port is opened, and answers late."""

import math
from collections import deque
from collections.abc import Callable

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.lights import COLOURS
from emmc_rig.simulators.firmware import SimulatedController, earliest_s
from emmc_rig.simulators.wire import MemoryTransport

BOOT_S = 1.6
"""An Uno's bootloader listens so long after the DTR line has reset it, and loses other bytes."""
ANSWER_S = 0.4
"""From a command to its answer: the sketch fades the lamp before it confirms."""
STROBE_S, PULSE_S = 0.1, 0.01
"""Period and length of the pulses on the trigger output, which runs as long as the sketch does."""
READY = "lamp ready"
LAMP_EXCHANGES = {colour: {"send": f"{colour}\n", "expect": f"ok {colour}"} for colour in COLOURS}
"""By colour: the text that sets it, and the answer, as in a rig's file."""


class ArduinoLamp(SimulatedController):
    """The sketch: a line with a colour sets the lamp, then comes `ok COLOUR`, or `error LINE`.

    on_change: gets the colour whenever the lamp changes. The lamp is off after a restart. Faults:
    those of the wire, and `lost_pulse`, of the trigger output.
    """

    def __init__(
        self, clock: Clock, on_change: Callable[[str], None] = lambda colour: None
    ) -> None:
        super().__init__(clock, ("lost_pulse",))
        self._on_change = on_change
        self.restart()

    def transport(self, timeout_s: float = 3.0) -> MemoryTransport:
        """Return a wire in memory; opening it restarts the Arduino."""
        return _ResettingWire(self, self._clock, timeout_s)

    def restart(self) -> None:
        """Reset by the DTR line, or by power: dark, deaf for BOOT_S, then ready."""
        with self._lock:
            self._ready_s: float | None = self._clock.now_s() + BOOT_S
            self._line = b""
            self._commands: deque[tuple[float, str]] = deque()
            self._outbox.clear()
            self._on_change("off")

    def next_edge_s(self, after_s: float, rising: bool = True) -> float:
        """Return when, at or after a time, the trigger output next rises, or falls."""
        later_s = 0.0 if rising else PULSE_S
        edge_s = math.ceil((after_s - later_s) / STROBE_S - 1e-6) * STROBE_S + later_s
        while self.faults.strikes("lost_pulse", edge_s):
            edge_s += STROBE_S
        return edge_s

    def power_cycle(self) -> None:
        """Switch off and on."""
        self.restart()

    def _receive(self, data: bytes) -> None:
        if self._ready_s is not None:
            return
        *lines, self._line = (self._line + data).split(b"\n")
        for line in lines:
            if not self._dropped(line):
                self._commands.append(
                    (self._clock.now_s() + ANSWER_S, line.decode("ascii", "replace").strip())
                )

    def _advance(self) -> None:
        now_s = self._clock.now_s()
        if self._ready_s is not None and self._ready_s <= now_s:
            self._ready_s = None
            self._send(f"{READY}\r\n".encode())
        while self._commands and self._commands[0][0] <= now_s:
            _, word = self._commands.popleft()
            known = word in LAMP_EXCHANGES
            if known:
                self._on_change(word)
            self._send(f"{'ok' if known else 'error'} {word}\r\n".encode())

    def _next_event_s(self) -> float | None:
        return earliest_s([self._ready_s, *(due_s for due_s, _ in self._commands)])


class _ResettingWire(MemoryTransport):
    """The wire of a board whose reset hangs on DTR, which rises when a port is opened."""

    def __init__(self, lamp: ArduinoLamp, clock: Clock, timeout_s: float) -> None:
        super().__init__(lamp, clock, timeout_s)
        self._lamp = lamp
        lamp.restart()

    def reopen(self) -> None:
        """Open the wire again."""
        super().reopen()
        self._lamp.restart()
