"""Lights of the bench: a text over a serial line, a program, or Micro-Manager for each colour.

Every driver sets the light and reads it back: it returns once the light has confirmed the colour,
or raises a `LightError`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import DriverError, LightError, PortError, TransportTimeoutError
from emmc_rig.drivers.micromanager import LoadedCore, calling
from emmc_rig.drivers.program import run_program
from emmc_rig.drivers.transport import Transport, repeated

COLOURS = ("off", "white", "red", "green", "blue")
OPEN, CLOSED = "open", "closed"
ATTEMPTS = 2
"""Of a command to the lights. Switching twice is harmless, and a controller that restarts when its
port opens loses the first."""


class Lights(ABC):
    """Lights of one bench. colours: names of the colours, with `off`.

    Plug-ins derive from this class: they implement `_switch`, `_reconnect` and `close`.
    """

    def __init__(self, name: str, colours: Iterable[str]) -> None:
        self.name, self.colours = name, tuple(colours)

    def set(self, colour: str) -> str:
        """Switch on this colour alone, or nothing for `off`; return what the lights answered.

        Raises `LightError` if the lights lack the colour, or do not confirm it.
        """
        if colour not in self.colours:
            raise LightError(
                f"the lights have no {colour}, only {', '.join(self.colours)}",
                "name it under lights: in the rig's file",
            )
        try:
            return self._switch(colour)
        except LightError as fault:
            raise LightError(f"the lights ({self.name}) {fault.what}", fault.advice) from fault
        except DriverError as fault:
            raise self._lost(f"be set to {colour}", fault) from fault

    def reconnect(self) -> None:
        """Connect again after a fault; raises `LightError`."""
        try:
            self._reconnect()
        except DriverError as fault:
            raise self._lost("be reached again", fault) from fault

    def _lost(self, what: str, fault: DriverError) -> LightError:
        """Return a fault as one of the lights; a port's own advice is to home a stage."""
        text = f"the lights ({self.name}) cannot {what}, {fault.what}"
        advice = fault.advice
        if isinstance(fault, PortError):
            advice = "check their cable and power"
        if isinstance(fault, TransportTimeoutError):
            advice = "check their power and baud rate, or raise limit_s in the rig's file"
        return LightError(text, advice)

    @abstractmethod
    def _switch(self, colour: str) -> str:
        """Set a colour of `colours`, and return the answer; raises a `DriverError`.

        The text of a `LightError` continues the words "the lights".
        """

    @abstractmethod
    def _reconnect(self) -> None:
        """Connect again; raises a `DriverError`."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the lights, which stay as they are; closing twice is allowed."""


@dataclass(frozen=True)
class Exchange:
    """What is sent to set a colour, line end included, and the line that confirms it."""

    send: str
    expect: str


def decode_line(line: bytes) -> str:
    """Return the text of a line from the lights, without blanks and line end around it."""
    return line.decode("ascii", "replace").strip()


class TextLights(Lights):
    """Lights that take a text for each colour, and answer with a line.

    transport: its timeout is the limit on an answer. exchanges: by colour. ready: the line that the
    controller sends once it has started, "" for none. An Arduino restarts when its port is opened,
    and loses bytes sent meanwhile. A controller that does not restart sends no such line, and the
    driver goes on after the timeout.
    end: the last byte of every answer. Raises a `PortError`.
    """

    def __init__(
        self,
        transport: Transport,
        exchanges: Mapping[str, Exchange],
        clock: Clock,
        ready: str = "",
        end: str = "\n",
    ) -> None:
        super().__init__(transport.port, exchanges)
        self._transport, self._exchanges, self._clock = transport, exchanges, clock
        self._ready, self._end = ready, end.encode()
        self._wait_until_started()

    def _wait_until_started(self) -> None:
        if self._ready:
            with suppress(TransportTimeoutError, LightError):
                self._await(self._ready)

    def _switch(self, colour: str) -> str:
        exchange, transport = self._exchanges[colour], self._transport

        def switched() -> str:
            transport.discard_input()
            transport.write(exchange.send.encode())
            return self._await(exchange.expect)

        with transport.lock:
            return repeated(
                switched,
                f"{colour} light",
                transport.discard_until_quiet,
                (TransportTimeoutError, LightError),
                ATTEMPTS,
            )

    def _await(self, expected: str) -> str:
        """Return the expected line; others before it, as a late answer, are passed over.

        Raises `TransportTimeoutError` for silence, `LightError` for other lines alone.
        """
        began_s, others = self._clock.now_s(), list[str]()
        while self._clock.now_s() - began_s <= self._transport.timeout_s:
            try:
                line = decode_line(self._transport.read_until(self._end))
            except TransportTimeoutError:
                if not others:
                    raise
                break
            if line == expected:
                return line
            others.append(line)
        raise LightError(
            f"answered {others[-1]!r} instead of {expected!r}",
            "check the texts under lights: in the rig's file, and the lights themselves",
        )

    def _reconnect(self) -> None:
        """Open the port again, wherever it is now."""
        self._transport.reopen()
        self._wait_until_started()

    def close(self) -> None:
        """Close the port."""
        self._transport.close()


class CommandLights(Lights):
    """Lights that a program switches, without a shell: exit code 0 confirms the colour.

    commands: the program and its arguments, by colour. limit_s: longest that it may take.
    """

    def __init__(self, commands: Mapping[str, Sequence[str]], limit_s: float) -> None:
        super().__init__("command", commands)
        self._commands, self._limit_s = commands, limit_s

    def _switch(self, colour: str) -> str:
        words = self._commands[colour]
        try:
            run_program(words, self._limit_s)
        except (OSError, ValueError) as fault:  # a TimeoutError is an OSError
            reason = getattr(fault, "strerror", None) or fault
            raise LightError(
                f"cannot be set to {colour} by {' '.join(words)}: {reason}",
                "run that command by hand",
            ) from fault
        return "exit code 0"

    def _reconnect(self) -> None:
        """Do nothing: every command stands for itself."""

    def close(self) -> None:
        """Do nothing."""


class MicroManagerLights(Lights):
    """A shutter, a state device, or both of a Micro-Manager configuration, whose core it closes.

    shutter: label, open for every colour but `off`; "" for none. device: label of the state device,
    "" for none; states: its position, or the name of one, by colour. The core no longer opens a
    shutter by itself when a frame is exposed: darks would be lit. Raises `LightError` for labels
    that the configuration lacks.
    """

    def __init__(
        self, loaded: LoadedCore, shutter: str, device: str, states: Mapping[str, int | str]
    ) -> None:
        super().__init__(loaded.port, states)
        self._loaded, self._shutter, self._device, self._states = loaded, shutter, device, states
        self._closed = False
        try:
            for label in filter(None, (shutter, device)):
                loaded.check_loaded(label, "device", " under lights: in the rig's file", LightError)
            loaded.whenever_loaded(self._keep_shutter)
        except BaseException:
            loaded.close()
            raise

    def _keep_shutter(self) -> None:
        with calling("leave the shutter to the plan"):
            self._loaded.core.setAutoShutter(False)

    def _switch(self, colour: str) -> str:
        wanted, found = [], []
        with self._loaded.lock, calling(f"set the lights to {colour}"):
            core = self._loaded.core
            if self._device:
                state = self._states[colour]
                name = "Label" if isinstance(state, str) else "State"
                core.setProperty(self._device, name, state)
                core.waitForDevice(self._device)
                wanted.append(str(state))
                found.append(core.getProperty(self._device, name))
            if self._shutter:
                core.setShutterOpen(self._shutter, colour != "off")
                core.waitForDevice(self._shutter)
                wanted.append(OPEN if colour != "off" else CLOSED)
                found.append(OPEN if core.getShutterOpen(self._shutter) else CLOSED)
        if found != wanted:
            raise LightError(
                f"are {', '.join(found)} instead of {', '.join(wanted)}", "check their controller"
            )
        return ", ".join(found)

    def _reconnect(self) -> None:
        """Do nothing: to load the configuration again would restart its stage, too."""

    def close(self) -> None:
        """Release the core."""
        if not self._closed:
            self._closed = True
            self._loaded.forget(self._keep_shutter)
            self._loaded.close()
