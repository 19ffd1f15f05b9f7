"""Stages for tests: each protocol's simulated firmware on each kind of wire."""

import time
from abc import ABC, abstractmethod
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from serial.urlhandler import protocol_socket
from tcp_server import TcpServer

from emmc_rig.drivers import grbl_codec as codec
from emmc_rig.drivers.apt import ACTUATORS, AptAxis, AptStage
from emmc_rig.drivers.apt_codec import Id
from emmc_rig.drivers.grbl import GrblStage
from emmc_rig.drivers.stage import DEFAULT_SETTINGS, HostStage, StageSettings
from emmc_rig.drivers.transport import SerialTransport, Transport
from emmc_rig.drivers.zaber import ZaberStage
from emmc_rig.simulators.apt import AptController
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.firmware import Occasion, SimulatedController
from emmc_rig.simulators.grbl import GrblController
from emmc_rig.simulators.wire import PtyServer
from emmc_rig.simulators.zaber import AxisSpec, ZaberChain

WIRES = ("memory", "pty", "tcp")
MEMORY_TIMEOUT_S = 0.5
WIRE_TIMEOUT_S = 0.05
"""Replies over a pseudo-terminal or TCP really take time: far less than this."""
WIRE_PACE = 5.0
WIRE_POLL_S = 0.1

Z825_MOTOR = ACTUATORS["z825"]
QUICK_HOMING = {codec.HOMING_SEEK: 6000, codec.HOMING_FEED: 600}
"""mm/min; Grbl is silent while it homes, and on a real wire silence really takes time."""


class JumpingClock(ManualClock):
    """As `ManualClock`, but real time passes too: for wires on which bytes really travel.

    `pace` seconds pass in a real one.
    """

    def __init__(self, pace: float = 1.0) -> None:
        super().__init__()
        self.pace = pace
        self._made_s = time.monotonic()

    def now_s(self) -> float:
        """Return the time in seconds since the clock was made."""
        return super().now_s() + self.pace * (time.monotonic() - self._made_s)


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
        self.server: PtyServer | None = None
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


class ZaberRig(StageRig):
    replies_are_numbered = True
    axes = ("mask_x", "mask_y")
    addresses: ClassVar = {"mask_x": (1, 1), "mask_y": (2, 1)}
    spec = AxisSpec()

    def make_device(self) -> Any:
        return ZaberChain(self.clock, dict.fromkeys(self.addresses.values(), self.spec))

    def make_from(self, settings):
        return ZaberStage(
            self.transport, self.addresses, self.spec.microstep_um, self.clock, settings
        )

    def true_um(self, axis):
        return self.device.position_um(*self.addresses[axis])

    def is_move(self, occasion):
        return b" move " in occasion.command

    def is_question(self, occasion):
        return b" get pos" in occasion.command


class GrblRig(StageRig):
    axes = ("mask_x", "mask_y")
    letters: ClassVar = {"mask_x": "X", "mask_y": "Y"}
    senses_stalls = False

    def make_device(self) -> Any:
        return GrblController(self.clock, settings=QUICK_HOMING)

    def make_from(self, settings):
        return GrblStage(self.transport, self.letters, self.clock, settings)

    def true_um(self, axis):
        letter = self.letters[axis]
        return self.device.position_um(letter) - self.device.axes[letter].travel_um

    def is_move(self, occasion):
        return b"$J=" in occasion.command

    def is_question(self, occasion):
        return b"?" in occasion.command


class AptRig(StageRig):
    axes = ("mask_x",)

    def make_device(self) -> Any:
        return AptController(self.clock)

    def make_from(self, settings):
        return AptStage({"mask_x": AptAxis(self.transport, Z825_MOTOR)}, self.clock, settings)

    def true_um(self, axis):
        return self.device.position_um()

    def is_move(self, occasion):
        return occasion.command[:2] == Id.MOT_MOVE_ABSOLUTE.to_bytes(2, "little")

    def is_question(self, occasion):
        return occasion.command[:2] == Id.MOT_REQ_DCSTATUSUPDATE.to_bytes(2, "little")


RIGS = {"zaber": ZaberRig, "grbl": GrblRig, "apt": AptRig}
SIMULATED = [f"{protocol}-{wire}" for protocol in RIGS for wire in WIRES]
FAULTED = (*(f"{protocol}-memory" for protocol in RIGS), "zaber-pty", "grbl-tcp", "apt-pty")
"""For tests of faults: every protocol, and every wire, but not each on each."""


@pytest.fixture
def opened(monkeypatch):
    """What the other fixtures open; closed after the test."""
    # pyserial pauses 0.3 s in the closing of a socket, for the other side's sake
    monkeypatch.setattr(protocol_socket, "time", SimpleNamespace(sleep=lambda pause_s: None))
    with ExitStack() as stack:
        yield stack


def after_first_sleep(monkeypatch, clock, later_s, act):
    """Let `act` be called once, so long after time has passed for the first time."""
    sleep, acts = clock.sleep, [act]

    def sleep_and_act(duration_s):
        sleep(duration_s)
        if acts:
            act = acts.pop()
            sleep(later_s)
            act()

    monkeypatch.setattr(clock, "sleep", sleep_and_act)


def simulated_rig(name, opened, tmp_path):
    """Return the rig of one of the names in `SIMULATED`."""
    protocol, wire = name.split("-")
    return RIGS[protocol](wire, opened, tmp_path)
