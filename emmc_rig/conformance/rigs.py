"""Stages for the conformance suite: a stage opened by name, or one over simulated firmware."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from drivers.stage import DEFAULT_SETTINGS, HostStage, Stage, StageSettings
from drivers.transport import SerialTransport, Transport
from simulators.clock import JumpingClock, ManualClock
from simulators.firmware import Occasion, SimulatedController
from simulators.wire import PtyServer, TcpServer

WIRES = ("memory", "pty", "tcp")
MEMORY_TIMEOUT_S = 0.5
WIRE_TIMEOUT_S = 0.05
"""Replies over a pseudo-terminal or TCP really take time: far less than this."""
WIRE_PACE = 5.0
WIRE_POLL_S = 0.1


class NamedStage:
    """The stage that a name opens, as `--stage` takes it, opened anew with other settings."""

    def __init__(self, spec: str) -> None:
        self._spec = spec
        self._stage: Stage | None = None

    def make_stage(self, **settings: Any) -> Stage:
        """Open the stage; one opened before is closed first."""
        from emmc_rig.bench.hardware import open_stage

        self.close()
        self._stage = open_stage(self._spec, settings=settings)
        return self._stage

    def close(self) -> None:
        """Close the stage."""
        if self._stage is not None:
            self._stage.close()
            self._stage = None


class StageRig(ABC):
    """One stage: simulated firmware, the wire to it, and where its axes really are.

    wire: one of `WIRES`. opened: closes what is opened.
    `senses_stalls`: the controller reports them; `replies_are_numbered`: a late one is
    recognised.
    """

    senses_stalls = True
    replies_are_numbered = False

    @abstractmethod
    def make_device(self) -> SimulatedController:
        """Return the firmware, on `self.clock`."""

    @abstractmethod
    def make_from(self, settings: StageSettings) -> HostStage:
        """Return the driver over `self.transport`."""

    @abstractmethod
    def true_um(self, axis: str) -> float:
        """Return where the axis really is, in the driver's coordinates."""

    @abstractmethod
    def is_move(self, occasion: Occasion) -> bool:
        """Return whether the command under way starts a move."""

    @abstractmethod
    def is_question(self, occasion: Occasion) -> bool:
        """Return whether the command under way asks for a position."""

    def __init__(self, wire: str, opened: ExitStack, tmp_path: Path) -> None:
        self.wire = wire
        self.clock: Any = ManualClock() if wire == "memory" else JumpingClock(WIRE_PACE)
        self.timeout_s = MEMORY_TIMEOUT_S if wire == "memory" else WIRE_TIMEOUT_S
        self.timeout_on_clock_s = self.timeout_s * (1.0 if wire == "memory" else WIRE_PACE)
        self.device: Any = self.make_device()
        self.device.late_by_s = 1.5 * self.timeout_on_clock_s
        self.server: PtyServer | TcpServer | None = None
        self.link = tmp_path / "stage"
        if wire == "pty":
            self.server = opened.enter_context(PtyServer(self.device, self.link))
        elif wire == "tcp":
            self.server = opened.enter_context(TcpServer(self.device))
        self.transport = self.make_transport()
        opened.callback(self.transport.close)

    def make_transport(self) -> Transport:
        """Return the wire to the firmware."""
        if self.server is None:
            return self.device.transport(self.timeout_s)
        port = f"{self.link}*" if self.wire == "pty" else self.server.port
        return SerialTransport(port, timeout_s=self.timeout_s, flow_control=False)

    def let_bytes_arrive(self) -> None:
        """On a real wire bytes are under way for a while; jumps of the clock must not pass them."""
        if self.server is not None:
            time.sleep(0.03)

    def replug(self, power_lost: bool = False) -> None:
        """Plug the cable in again, and wait until the port is there."""
        self.device.replug(power_lost)
        deadline_s = time.monotonic() + 5.0
        while self.server is not None and not self.server.is_open:
            assert time.monotonic() < deadline_s
            time.sleep(0.001)

    def make_stage(self, **settings: Any) -> HostStage:
        """Open the stage with settings of `StageSettings`."""
        poll_s = DEFAULT_SETTINGS.poll_s if self.server is None else WIRE_POLL_S
        return self.make_from(replace(DEFAULT_SETTINGS, poll_s=poll_s, **settings))
