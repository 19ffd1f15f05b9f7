"""The camera and the stage behind the set-up page: each in a thread of its own, never waited for.

The camera's thread takes frame after frame while somebody looks; wishes (exposure, gain) are
carried out between two frames. The stage's thread carries out one move at a time; stopping it
goes past that thread, so that it works in the middle of a move.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from queue import Empty, Queue
from typing import Any

from drivers.camera import Camera
from drivers.errors import DriverError, NotHomedError
from drivers.raw import RawFrame
from drivers.stage import Stage
from emmc_rig.errors import AppError
from emmc_rig.live.alignment import measure
from emmc_rig.pages.frame_view import frame_figures, histogram

IDLE_S = 10.0
"""Without anybody who asks for this long, no frame is taken."""
RETRY_S = 1.0
FASTEST_S = 0.04
"""Frames are not taken faster than this: a page cannot show more."""
POLL_S = 0.2
PATIENCE_S = 10.0
"""For the threads to end. A move under way is stopped first."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A frame with its number and figures."""

    number: int
    frame: RawFrame
    figures: Mapping[str, Any]


class Watch:
    """What the page shows and asks for; every method may be called by any thread.

    stage: None where there is none. look: changes what a simulated bench shows, None otherwise;
    targets: what it takes. centre_um: where each axis centres the mask and opens the aperture.
    Raises nothing of the devices: their errors become `state`'s "trouble".
    """

    def __init__(
        self,
        camera: Camera,
        stage: Stage | None = None,
        look: Callable[[str], None] | None = None,
        targets: tuple[str, ...] = (),
        centre_um: Mapping[str, float] | None = None,
    ) -> None:
        self._camera, self._stage = camera, stage
        self._look, self.targets = look, targets
        self._centre_um = dict(centre_um or {})
        self._news = threading.Condition()
        self._shown: Shown | None = None
        self._reference: RawFrame | None = None
        self._settings = self._read_settings()
        self._axes: dict[str, dict[str, Any]] = {}
        self._busy = ""
        self._trouble = {"camera": "", "setting": "", "stage": ""}
        self._version = 0
        self._asked_s = time.monotonic()
        self._ending = threading.Event()
        self._wishes: Queue[Callable[[], object]] = Queue()
        self._moves: Queue[tuple[str, Callable[[Stage], object]]] = Queue()
        self._threads = [threading.Thread(target=self._watch, name="live camera", daemon=True)]
        if stage is not None:
            self._threads.append(
                threading.Thread(target=self._drive, args=(stage,), name="live stage", daemon=True)
            )

    def start(self) -> None:
        """Begin to take frames."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop the stage, and end both threads; the devices stay open."""
        self._ending.set()
        self.stop()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(PATIENCE_S)
        with self._news:
            self._news.notify_all()

    def frame(self) -> RawFrame | None:
        """Return the newest frame; None before the first."""
        with self._news:
            self._asked_s = time.monotonic()
            return self._shown.frame if self._shown is not None else None

    def state(self, after: int = 0, patience_s: float = 0.0) -> dict[str, Any]:
        """Return what is known, when it is newer than version `after` or patience ends."""
        with self._news:
            self._asked_s = time.monotonic()
            self._news.wait_for(
                lambda: self._version > after or self._ending.is_set(), timeout=patience_s
            )
            shown = self._shown
            return {
                "version": self._version,
                "frame": shown.number if shown is not None else 0,
                "figures": shown.figures if shown is not None else None,
                "settings": self._settings,
                "axes": self._axes,
                "busy": self._busy,
                "trouble": dict(self._trouble),
                "reference": self._reference is not None,
                "targets": list(self.targets),
                "centre_um": self._centre_um,
            }

    def set_exposure_s(self, exposure_s: float) -> None:
        """Let the frames that follow be exposed for so long."""
        self._wishes.put(lambda: self._camera.set_exposure_s(exposure_s))

    def set_gain(self, gain: float) -> None:
        """Let the frames that follow have this gain."""
        self._wishes.put(lambda: self._camera.set_gain(gain))

    def look_at(self, target: str) -> None:
        """Let a simulated bench show the scene or the whiteboard; raises AppError."""
        if self._look is None or target not in self.targets:
            raise AppError(f"cannot look at {target!r} here")
        look = self._look
        self._wishes.put(lambda: look(target))

    def take_reference(self, taken: bool = True) -> None:
        """Measure shifts from the present frame on; or no more."""
        with self._news:
            self._reference = self._shown.frame if taken and self._shown is not None else None
        self._tell()

    def home(self, axes: list[str] | None = None) -> None:
        """Home axes, all by default; raises AppError as `jog`."""
        self._move("homing", lambda stage: stage.home(axes))

    def jog(self, axis: str, distance_um: float) -> None:
        """Move an axis by a distance; raises AppError without a stage, or while it moves."""
        self._require_axis(axis)
        self._move(
            f"moving {axis} by {distance_um:g} um",
            lambda stage: stage.move_by_um({axis: distance_um}),
        )

    def go(self, axis: str, place_um: float) -> None:
        """Move an axis to a place; raises AppError as `jog`."""
        self._require_axis(axis)
        self._move(
            f"moving {axis} to {place_um:g} um", lambda stage: stage.move_to_um({axis: place_um})
        )

    def centre(self) -> None:
        """Bring masks and aperture to where they are centred, homing first what is not homed."""
        if not self._centre_um:
            raise AppError("it is not known where the masks are centred: name zero_um in the rig")

        def call(stage: Stage) -> None:
            unknown = [axis for axis in self._centre_um if not stage.is_homed(axis)]
            if unknown:
                stage.home(unknown)
            stage.move_to_um(self._centre_um)

        self._move("centring", call)

    def stop(self) -> None:
        """Stop all axes now, in the middle of a move too."""
        if self._stage is None:
            return
        try:
            self._stage.stop()
        except DriverError as fault:
            self._tell(stage=str(fault))

    def _require_axis(self, axis: str) -> None:
        if self._stage is not None and axis not in self._stage.axes:
            raise AppError(f"no axis {axis!r}: the stage has {', '.join(self._stage.axes)}")

    def _move(self, what: str, call: Callable[[Stage], object]) -> None:
        if self._stage is None:
            raise AppError("no stage here: name one with --stage or --rig")
        with self._news:
            if self._busy:
                raise AppError(f"the stage is busy ({self._busy}): wait, or stop it")
            self._busy = what
        self._moves.put((what, call))
        self._tell()

    def _tell(self, **trouble: str) -> None:
        with self._news:
            self._trouble.update(trouble)
            self._version += 1
            self._news.notify_all()

    def _read_settings(self) -> dict[str, Any]:
        camera = self._camera
        return {
            "camera": camera.identity.model or "camera",
            "cfa": camera.cfa,
            "shape": list(camera.shape),
            "exposure_s": camera.exposure_s,
            "exposure_limits_s": list(camera.exposure_limits_s),
            "gain": camera.gain,
            "gain_limits": list(camera.gain_limits),
        }

    def _watch(self) -> None:
        stream = None
        while not self._ending.is_set():
            started_s = time.monotonic()
            with self._news:
                watched = started_s - self._asked_s < IDLE_S
            try:
                if not self._wishes.empty() and stream is not None:
                    stream.close()
                    stream = None
                self._carry_out_wishes()
                if not watched:
                    self._ending.wait(POLL_S)
                    continue
                if stream is None and hasattr(self._camera, "stream"):
                    stream = self._camera.stream()  # pyright: ignore[reportAttributeAccessIssue]
                frame = next(stream) if stream is not None else self._camera.snap()
                self._show(frame)
                self._ending.wait(max(0.0, FASTEST_S - (time.monotonic() - started_s)))
            except (DriverError, StopIteration, ValueError) as fault:
                stream = None
                told = str(fault) or "the camera sends no more frames"
                self._tell(camera=told)
                self._ending.wait(RETRY_S)
        if stream is not None:
            with suppress(DriverError):
                stream.close()

    def _carry_out_wishes(self) -> None:
        done = False
        while True:
            try:
                wish = self._wishes.get_nowait()
            except Empty:
                break
            try:
                wish()
                done = True
            except (ValueError, DriverError) as fault:
                self._tell(setting=str(fault))
        if done:
            self._settings = self._read_settings()
            self._tell(setting="")

    def _show(self, frame: RawFrame) -> None:
        with self._news:
            reference = self._reference
            number = self._shown.number + 1 if self._shown is not None else 1
        figures = frame_figures(frame)
        told = {
            **asdict(figures),
            "histogram": {name: row.tolist() for name, row in histogram(frame).items()},
            "alignment": asdict(measure(frame, reference)),
            "exposure_s": frame.exposure_s,
        }
        with self._news:
            self._shown = Shown(number, frame, told)
        self._tell(camera="")

    def _drive(self, stage: Stage) -> None:
        self._read_axes(stage)
        while not self._ending.is_set():
            try:
                _, call = self._moves.get(timeout=POLL_S)
            except Empty:
                continue
            told = ""
            try:
                call(stage)
            except (DriverError, ValueError) as fault:
                told = str(fault)
            with self._news:
                self._busy = ""
            self._read_axes(stage, told)

    def _read_axes(self, stage: Stage, told: str = "") -> None:
        axes: dict[str, dict[str, Any]] = {}
        for axis in stage.axes:
            position = None
            try:
                limits_um = stage.limits_um(axis)
                with suppress(NotHomedError):
                    position = stage.position_um(axis)
                axes[axis] = {"position_um": position, "limits_um": list(limits_um)}
            except DriverError as fault:
                axes[axis] = {"position_um": None, "limits_um": None}
                told = told or str(fault)
        with self._news:
            self._axes = axes
        self._tell(stage=told)
