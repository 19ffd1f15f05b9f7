"""The stage behind the page: a thread for moves, one at a time, and another thread for `stop`.

A stop passes the thread that moves, and is repeated until the move has ended: a move of several
legs may be about to begin the next leg. Positions are read while an axis moves.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from queue import Empty, Queue
from typing import Any

from emmc_rig.drivers.errors import DriverError, NotHomedError
from emmc_rig.drivers.stage import Stage
from emmc_rig.errors import AppError

POLL_S = 0.1
"""Between two readings of positions, and between two stops while a move has not ended."""
PATIENCE_S = 10.0
Step = Callable[[Stage], object]


class Driving:
    """Carries out moves; every method may be called by any thread.

    begun: how many moves were. publish: is given by name what changed: `axes`, `busy` (what is
    under way), `stopped` (whether the last move was stopped by hand), `stage` (what went wrong).
    """

    def __init__(self, stage: Stage, publish: Callable[..., None]) -> None:
        self.stage, self._publish = stage, publish
        self._lock, self._reading = threading.Lock(), threading.Lock()
        self._busy = ""
        self.begun = 0
        self._idle = threading.Event()
        self._idle.set()
        self._ending, self._closed = threading.Event(), threading.Event()
        self._stop_wanted = threading.Event()
        self._stop_sent = threading.Event()
        self._stopped_by_hand = False
        self._moves: Queue[Sequence[Step]] = Queue()
        self._positions_um: dict[str, float | None] = dict.fromkeys(stage.axes)
        self._limits_um: dict[str, tuple[float, float] | None] = dict.fromkeys(stage.axes)
        self._threads = [
            threading.Thread(target=call, name=name, daemon=True)
            for name, call in (
                ("live stage", self._carry_out),
                ("live stop", self._stop_when_wanted),
                ("live positions", self._follow),
            )
        ]

    def start(self) -> None:
        """Begin to serve."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop all axes, and end the threads; the stage stays open."""
        self._ending.set()
        if self._threads[0].ident is not None:
            self.stop()
            self._closed.set()
            for thread in self._threads:
                thread.join(PATIENCE_S)

    def position_um(self, axis: str) -> float | None:
        """Return the last reading of an axis's position; None before the first."""
        return self._positions_um.get(axis)

    @property
    def moves(self) -> bool:
        """Whether a move is under way."""
        return not self._idle.is_set()

    @property
    def stopped(self) -> bool:
        """Whether the move under way, or the last one, was stopped by hand."""
        return self._stopped_by_hand

    def ask(self, what: str, *steps: Step) -> None:
        """Begin a move of one step or several; raises AppError while another one is under way."""
        with self._lock:
            if self._busy:
                raise AppError(f"the stage is busy ({self._busy}): wait, or stop it")
            self._busy = what
            self.begun += 1
            self._stopped_by_hand = False
            self._idle.clear()
        self._publish({"stage": ""}, busy=what, stopped=False)
        self._moves.put(steps)

    def stop(self) -> None:
        """Stop all axes now, during a move too; returns when the stage has the command."""
        self._stopped_by_hand = True
        self._stop_sent.clear()
        self._stop_wanted.set()
        self._stop_sent.wait(PATIENCE_S)

    def _stop_when_wanted(self) -> None:
        while True:
            if not self._stop_wanted.wait(POLL_S):
                if self._closed.is_set():  # not before the last stop was sent
                    return
                continue
            self._stop_wanted.clear()
            while True:
                try:
                    self.stage.stop()
                except (DriverError, ValueError) as fault:
                    self._stopped_by_hand = False
                    self._publish({"stage": f"not stopped: {fault}"})
                    self._stop_sent.set()
                    break
                self._stop_sent.set()
                if self._idle.wait(POLL_S):
                    break

    def _carry_out(self) -> None:
        for axis in self.stage.axes:
            with suppress(DriverError):
                self._limits_um[axis] = self.stage.limits_um(axis)
        with self._reading:
            self._publish({"stage": self._read_positions()}, axes=self._axes())
        while not self._ending.is_set():
            try:
                steps = self._moves.get(timeout=POLL_S)
            except Empty:
                continue
            fault_of_move = ""
            try:
                for step in steps:
                    if not self._stopped_by_hand:
                        step(self.stage)
            except (AppError, DriverError, ValueError) as fault:
                fault_of_move = str(fault)
            with self._reading:  # whoever sees that it ended sees where it ended, and how
                unread = self._read_positions()
                stopped = self._stopped_by_hand
                with self._lock:
                    self._busy = ""
                    self._idle.set()
                trouble = {"stage": unread if stopped else fault_of_move or unread}
                self._publish(trouble, busy="", stopped=stopped, axes=self._axes())

    def _follow(self) -> None:
        """Read positions while an axis moves; what goes wrong is the move's to report."""
        while not self._ending.is_set():
            with self._reading:
                if not self._idle.is_set():
                    for axis in self.stage.axes:
                        with suppress(DriverError):
                            self._positions_um[axis] = self.stage.position_um(axis)
                    self._publish(axes=self._axes())
            self._ending.wait(POLL_S)

    def _read_positions(self) -> str:
        """Read where every axis is; returns why one cannot be read, "" where none or not homed."""
        trouble = ""
        for axis in self.stage.axes:
            self._positions_um[axis] = None
            try:
                self._positions_um[axis] = self.stage.position_um(axis)
            except NotHomedError:
                continue
            except DriverError as fault:
                trouble = trouble or str(fault)
        return trouble

    def _axes(self) -> Mapping[str, Any]:
        return {
            axis: {"position_um": self._positions_um[axis], "limits_um": self._limits_um[axis]}
            for axis in self.stage.axes
        }
