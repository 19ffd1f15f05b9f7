"""The page to set up by: camera and stage behind it, and figures of the newest frame.

The camera's thread takes frame after frame while somebody looks; wishes (exposure, gain) are
carried out between two frames. Levels, mask and light field have a thread each, which takes the
newest frame and skips older ones: a slow thread does not delay a quick one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from queue import Empty, Queue
from typing import Any, NamedTuple

import numpy as np

from emmc_rig.bench.hardware import FOCUS
from emmc_rig.bench.registration import LEAST_LIKENESS, registered
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.captures.focus import FocusMeter, Sharpness, focused, sharpness
from emmc_rig.drivers.camera import Camera
from emmc_rig.drivers.errors import DriverError, ExposureStoppedError
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.drivers.stage import Stage
from emmc_rig.errors import AppError
from emmc_rig.live.alignment import MaskGauge
from emmc_rig.live.driving import Driving
from emmc_rig.live.light_field import LiveLightField, field_pictures
from emmc_rig.live.picture import View, encoded, picture
from emmc_rig.live.save import Files, Found
from emmc_rig.live.served_page import (
    COMMON_FILES,
    Number,
    Order,
    PageState,
    Picture,
    Pictured,
    Query,
    Switch,
)
from emmc_rig.live.steps import (
    AWAY_UM,
    LONGEST_UNASKED_S,
    NO_FOCUS,
    exposure_hint,
    hint_of,
    steps,
)
from emmc_rig.model.camera import Camera as Design
from emmc_rig.model.errors import CameraError
from emmc_rig.model.settings import validated
from emmc_rig.report.frame_view import brightest, histogram
from emmc_rig.session.brightness import (
    GOOD_LEVELS,
    OVEREXPOSED,
    UNDEREXPOSED,
    figures,
    is_dark,
    is_well_exposed,
    level_of,
    next_exposure_s,
    thinned,
)

IDLE_S = 10.0
"""No frame is taken when nobody has looked at the page for so long."""
RETRY_S = 1.0
FASTEST_S = 0.04
"""Frames are not taken faster than this: a page cannot show more."""
POLL_S = 0.2
PATIENCE_S = 10.0
"""For the threads to end. A move under way is stopped first."""
LEVEL_PIXELS = 1 << 18
"""Of a frame, evenly spread, for its histogram."""
SHIFT_PX = 1024
SEEK_S = 10.0
"""Between two searches for a mask that is not seen while nothing changes: each takes seconds."""
DARK = "the picture is dark"
AT_SHOT_UM = 2.0
"""From where a shot has the mask, it still stands there."""
LONG_S = 1.0
"""An exposure that takes longer is counted down, and broken off for what is set meanwhile."""
COUNT_S = 0.5
EXPOSURE_TRIES = 8


@dataclass(frozen=True, eq=False)
class Shown:
    """A frame with its number, and the time of its arrival (monotonic clock).

    moves: number of moves that the stage had made; None for a frame that a move may blur: the stage
    moved during its exposure, or, of a camera that streams, since the frame before.
    """

    number: int
    frame: RawFrame
    at_s: float
    moves: int | None


class LongExposure(NamedTuple):
    """An exposure under way that is counted down; begun_s: on the monotonic clock."""

    begun_s: float
    exposure_s: float

    def left_s(self) -> float:
        """Return the seconds until its end."""
        return self.begun_s + self.exposure_s - time.monotonic()


class Watch:
    """The page, a `served_page.Page`; every method may be called by any thread.

    stage: None for a bench without. look: changes the target of a simulated bench; targets: the
    names that it takes. centre_um: place of each axis that centres the mask and opens the aperture.
    design: the camera whose mask is in. light_field: reconstructs while the camera watches. saved:
    files into which the page may write. following: the command to go on with once a plan was
    saved; "": none is known. wants: options that saving needs beside those given, in words; "" for
    none. Errors of the devices are not raised: they are "trouble" of `state`.
    """

    files: tuple[str, ...] = ("page.html", "page.js", *COMMON_FILES)

    def __init__(
        self,
        camera: Camera,
        stage: Stage | None = None,
        look: Callable[[str], None] | None = None,
        targets: tuple[str, ...] = (),
        centre_um: Mapping[str, float] | None = None,
        design: Design | None = None,
        light_field: LiveLightField | None = None,
        saved: Files | None = None,
        following: str = "",
        wants: str = "",
    ) -> None:
        self._camera, self._look, self.targets = camera, look, targets
        axes = () if stage is None else stage.axes
        self._centre_um = {a: um for a, um in (centre_um or {}).items() if a in axes}
        self._design = design
        self.light_field = light_field
        self._saved, self._following, self._wants = saved or Files(), following, wants
        self._found = Found()
        self._written: list[str] = []
        self._shown: Shown | None = None
        self._reference: RawFrame | None = None
        self._focus = FocusMeter()
        self._exposing, self._dimmest_s, self._longest_s = 0, 0.0, LONGEST_UNASKED_S
        self._unexposed = ""
        self._long_exposure: LongExposure | None = None
        self._seek_at_s = 0.0
        self._gauge: MaskGauge | None = None
        self._drawn, self._latency_s = 0, 0.0
        self.state = PageState(self._first_parts(), self._advice)
        self.pictures: Mapping[str, Pictured] = {
            "picture.jpg": self._picture,
            **field_pictures(lambda: light_field and light_field.pictures()),
        }
        self.orders: Mapping[str, Order] = self._order_table()
        self._asked_s = time.monotonic()
        self._ending = threading.Event()
        self._wishes: Queue[Callable[[], object]] = Queue()
        self._driving = None if stage is None else Driving(stage, self.state.publish)
        threads = {
            "live camera": self._take,
            "live levels": self._each(self._show_levels),
            "live countdown": self._count_down,
        }
        if design is not None:
            threads["live mask"] = self._each(self._show_mask)
        if light_field is not None:
            threads["live light field"] = self._each(self._show_light_field)
        self._threads = [
            threading.Thread(target=work, name=name, daemon=True) for name, work in threads.items()
        ]

    def _first_parts(self) -> dict[str, Any]:
        """Return the state before the first frame."""
        return {
            "frame": 0,
            "figures": None,
            "mask": None,
            "settings": self._read_settings(),
            "axes": {},
            "busy": "",
            "stopped": False,
            "trouble": {"camera": "", "setting": "", "stage": "", "light field": ""},
            "exposing": None,
            "reference": False,
            "targets": list(self.targets),
            "centre_um": self._centre_um,
            "light_field": None,
            "hint": None,
            "steps": [],
            "takes": self._saved.takes,
            "next": self._following,
            "wants": self._wants,
        }

    def _order_table(self) -> dict[str, Order]:
        """Return the orders of the page by name."""
        return {
            "exposure": Order(self.set_exposure_s, seconds=Number),
            "gain": Order(self.set_gain, factor=Number),
            "autoexpose": Order(self.auto_expose, longest_s=(Number, LONGEST_UNASKED_S)),
            "cancel": Order(self.cancel, urgent=True),
            "jog": Order(self.jog, axis=str, distance_um=Number),
            "home": Order(self.home),
            "centre": Order(self.centre),
            "stop": Order(self.stop, urgent=True),
            "look": Order(self.look_at, target=str),
            "reference": Order(self.take_reference, taken=Switch),
            "refocus": Order(self._focus.forget),
            "autofocus": Order(self.autofocus, span_um=Number),
            "preview": Order(self.preview, what=list[str]),
            "save": Order(self.save),
        }

    def start(self) -> None:
        """Begin to take frames."""
        for thread in self._threads:
            thread.start()
        if self._driving is not None:
            self._driving.start()

    def close(self) -> None:
        """Stop the stage, and end the threads; the devices stay open."""
        self._ending.set()
        with self.state.changed:
            self.state.changed.notify_all()
        if self._driving is not None:
            self._driving.close()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(PATIENCE_S)
        if self.light_field is not None:
            self.light_field.close()
        self.state.publish()

    def newest(self) -> Shown | None:
        """Return the newest frame and its number; None before the first."""
        with self.state.changed:
            self._asked_s = time.monotonic()
            return self._shown

    def touch(self) -> None:
        """Let frames be taken."""
        self._asked_s = time.monotonic()

    def _picture(self, query: Query) -> Picture | None:
        view = validated(View, dict(query), "the picture", AppError)
        newest = self.newest()
        if newest is None:
            return None

        key = view.model_dump_json()
        return Picture(key, newest.number, lambda: encoded(picture(newest.frame, view)))

    def set_exposure_s(self, seconds: float) -> None:
        """Let the frames that follow be exposed for so long."""
        self._exposing, self._unexposed = 0, ""
        self._wishes.put(lambda: self._camera.set_exposure_s(seconds))

    def set_gain(self, factor: float) -> None:
        """Let the frames that follow have this gain, a factor."""
        self._wishes.put(lambda: self._camera.set_gain(factor))

    def auto_expose(self, longest_s: float = LONGEST_UNASKED_S) -> None:
        """Let exposures follow until the brightest thousandth lies within GOOD_LEVELS.

        None of them takes more than `longest_s`; a picture that stays dark is not exposed on.
        """
        exposure_s, (shortest_s, _) = self._exposure_s, self.state["settings"]["exposure_limits_s"]
        self._longest_s = max(longest_s, shortest_s)
        self._dimmest_s = min(exposure_s, self._longest_s)
        if self._dimmest_s < exposure_s:
            self.set_exposure_s(self._dimmest_s)
        self._exposing, self._unexposed = EXPOSURE_TRIES, ""

    def cancel(self) -> None:
        """Break off a long exposure, and go on as before it, LONGEST_UNASKED_S at most.

        Raises AppError where this camera has to finish it first.
        """
        newest = self.newest()
        before_s = LONGEST_UNASKED_S if newest is None else newest.frame.exposure_s
        shortest_s, longest_s = self.state["settings"]["exposure_limits_s"]
        under_way = self._long_exposure
        self._exposing = 0
        if shortest_s < longest_s:
            chosen_s = min(before_s or LONGEST_UNASKED_S, self._exposure_s, LONGEST_UNASKED_S)
            self.set_exposure_s(max(chosen_s, shortest_s))
        if under_way is not None and not self._break_off():
            left_s = under_way.left_s()
            raise AppError(f"this camera does nothing else while it exposes: wait {left_s:.0f} s")

    @property
    def _exposure_s(self) -> float:
        return self.state["settings"]["exposure_s"]

    def _break_off(self) -> bool:
        """Let the camera break off its exposure; False where it cannot."""
        stop = getattr(self._camera, "stop_exposure", None)
        return stop is not None and stop()

    def _count_down(self) -> None:
        """Show how long the exposure under way still takes, and break it off for a new setting."""
        while not self._ending.wait(COUNT_S):
            if (under_way := self._long_exposure) is None:
                if self.state["exposing"] is not None:
                    self.state.publish(exposing=None)
                continue
            left_s = under_way.left_s()
            if not self._wishes.empty() and left_s > LONG_S:
                self._break_off()
            # A camera that has its frames at once is not counted down.
            elif (
                time.monotonic() - under_way.begun_s >= COUNT_S
                or self.state["exposing"] is not None
            ):
                left = {"exposure_s": under_way.exposure_s, "left_s": max(0.0, left_s)}
                self.state.publish(exposing=left)
        self._break_off()

    def look_at(self, target: str) -> None:
        """Let a simulated bench show the scene or the whiteboard; raises AppError."""
        if self._look is None or target not in self.targets:
            raise AppError(f"cannot look at {target!r} here")
        look = self._look
        self._wishes.put(lambda: look(target))
        self._start_anew()

    def take_reference(self, taken: bool) -> None:
        """Measure shifts from the present frame on; or no more."""
        with self.state.changed:
            self._reference = self._shown.frame if taken and self._shown is not None else None
        self.state.publish(reference=self._reference is not None)

    def home(self) -> None:
        """Home all axes; raises AppError as `jog`."""
        self._move("homing", lambda stage: stage.home())

    def jog(self, axis: str, distance_um: float) -> None:
        """Move an axis by a distance; raises AppError without a stage, or while it moves."""
        if self._driving is not None and axis not in self._driving.stage.axes:
            names = ", ".join(self._driving.stage.axes)
            raise AppError(f"no axis {axis!r}: the stage has {names}")
        self._move(
            f"moving {axis} by {distance_um:g} um",
            lambda stage: stage.move_by_um({axis: distance_um}),
        )

    def centre(self) -> None:
        """Bring masks and aperture to where they are centred, homing first what is not homed."""
        if not self._centre_um:
            raise AppError(
                "it is not known where the mask is centred: name zero_um in the rig's file"
            )

        def home(stage: Stage) -> None:
            unknown = [axis for axis in self._centre_um if not stage.is_homed(axis)]
            if unknown:
                stage.home(unknown)

        self._move("centring", home, lambda stage: stage.move_to_um(self._centre_um))

    def autofocus(self, span_um: float) -> None:
        """Bring the focus axis to where the picture is sharpest, within so far from here.

        Raises AppError where there is no such axis.
        """
        if self._driving is None or FOCUS not in self._driving.stage.axes:
            raise AppError(NO_FOCUS)
        driving = self._driving

        def focus(stage: Stage) -> None:
            if not stage.is_homed(FOCUS):
                stage.home([FOCUS])
            found = focused(stage, FOCUS, span_um, self._sharpness, lambda: driving.stopped)
            if found is not None:
                self._found = replace(self._found, focus=found)

        self._move("focusing", focus)

    def _sharpness(self) -> Sharpness | None:
        """Return the sharpness of two frames that are exposed from now on."""
        newest = self.newest()
        number = 0 if newest is None else newest.number
        frames = []
        # The next one may have been exposed while the axis moved.
        for skipped in (1, 0):
            shown = self._after(number + skipped)
            if shown is None:
                return None
            frames.append(shown.frame)
            number = shown.number
        return sharpness(frames[1], frames[0])

    def preview(self, what: list[str]) -> dict[str, str]:
        """Return what saving some of exposure, centre, mask and focus would change, as a diff."""
        exposure_s = self._exposure_s
        zero_um = None
        place = self._found.mask
        if place is not None and place.offset_um is not None and not place.ambiguity:
            axes = zip(("mask_x", "mask_y"), place.offset_um, strict=True)
            zero_um = {a: self._centre_um[a] - um for a, um in axes if a in self._centre_um}
        self._found = replace(self._found, exposure_s=exposure_s, zero_um=zero_um)
        return {"diff": self._saved.preview(self._found, what)}

    def save(self) -> dict[str, Any]:
        """Write what was previewed, and return the files and the next command; raises AppError."""
        self._written = self._saved.save()
        self.state.publish()
        return {"written": self._written, "next": self._following}

    def stop(self) -> None:
        """Stop all axes now, in the middle of a move too."""
        if self._driving is not None:
            self._driving.stop()

    def _move(self, what: str, *steps: Callable[[Stage], object]) -> None:
        if self._driving is None:
            raise AppError("no stage here: start the page with a stage or a rig")
        self._driving.ask(what, *steps)
        self._start_anew()

    def _start_anew(self) -> None:
        """Something else will be seen: look for the mask again, compare with no older picture."""
        self._focus.forget()
        self._seek_at_s = 0.0
        self._forget_unexposed()

    def _forget_unexposed(self) -> None:
        """Say no more why an automatic exposure ended: it was of another picture."""
        if self._unexposed and self.state["trouble"]["setting"] == self._unexposed:
            self.state.publish({"setting": ""})
        self._unexposed = ""

    def _advice(self) -> dict[str, Any]:
        """Return the hint for the newest picture, and the steps from an unpacked box to a plan."""
        hint = self._hint()
        axes = () if self._driving is None else self._driving.stage.axes
        listed = steps(
            self.state["figures"], self.state["mask"], self._off_um(), axes, self._found,
            self._saved.takes, self._written, hint, self._wants,
        )  # fmt: skip
        return {"hint": hint, "steps": listed}

    def _off_um(self) -> dict[str, float | None]:
        """Return by axis how far it stands from centred; None: not homed."""
        driving = self._driving
        if driving is None:
            return {}
        at_um = {axis: driving.position_um(axis) for axis in self._centre_um}
        return {a: None if um is None else um - self._centre_um[a] for a, um in at_um.items()}

    def _away(self) -> list[str]:
        """Return the axes that stand elsewhere than centred, or not homed."""
        return [a for a, um in self._off_um().items() if um is None or abs(um) > AWAY_UM]

    def _hint(self) -> dict[str, Any] | None:
        """Return the hint for the newest picture; None where it is well exposed.

        None also for a picture that was taken before the last move of the stage.
        """
        figures = self.state["figures"]
        if figures is None or figures["moves"] is None or figures["moves"] != self._moved():
            return None
        away = self._away()
        level = figures["level"]
        if figures["dark"] and away:
            names = ", ".join(away)
            return hint_of(f"The picture is dark: {names} away from the centre.", "centre")
        if figures["dark"]:
            return hint_of("The picture is dark: switch the lamp on, open the aperture.")
        if figures["saturated"] > OVEREXPOSED:
            return hint_of("Part of the picture is saturated.", "autoexpose")
        if level < UNDEREXPOSED:
            exposure_s = figures["exposure_s"] or self._exposure_s
            longest_s = self.state["settings"]["exposure_limits_s"][1]
            return exposure_hint(level, exposure_s, longest_s)
        return None

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

    def _take(self) -> None:
        stream, stood, streams = None, None, hasattr(self._camera, "stream")
        while not self._ending.is_set():
            started_s = time.monotonic()
            with self.state.changed:
                watched = started_s - self._asked_s < IDLE_S
            try:
                if not self._wishes.empty() and stream is not None:
                    stream.close()
                    stream = None
                self._carry_out_wishes()
                if not watched:
                    self._ending.wait(POLL_S)
                    continue
                if stream is None and streams:
                    stream = self._camera.stream()  # pyright: ignore[reportAttributeAccessIssue]
                moved = self._moved()
                if self._exposure_s > LONG_S:
                    self._long_exposure = LongExposure(time.monotonic(), self._exposure_s)
                try:
                    frame = next(stream) if stream is not None else self._camera.snap()
                finally:
                    self._long_exposure = None
                moves = moved if moved == self._moved() else None
                still = moves if moves == stood or not streams else None
                with self.state.changed:
                    number = self._shown.number + 1 if self._shown is not None else 1
                    self._shown = Shown(number, frame, time.monotonic(), still)
                stood = moves
                self.state.publish({"camera": ""}, frame=number)
                self._ending.wait(max(0.0, FASTEST_S - (time.monotonic() - started_s)))
            except ExposureStoppedError:
                stream = None
            except (DriverError, StopIteration, ValueError) as fault:
                stream = None
                why = str(fault) or "the camera sends no more frames"
                self.state.publish({"camera": why})
                self._ending.wait(RETRY_S)
        if stream is not None:
            with suppress(DriverError):
                stream.close()

    def _moved(self) -> int | None:
        """Return how many moves were begun; None while one is under way."""
        if self._driving is None:
            return 0
        return None if self._driving.moves else self._driving.begun

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
                self.state.publish({"setting": str(fault)})
        if done:
            self._seek_at_s = 0.0
            self.state.publish({"setting": self._unexposed}, settings=self._read_settings())

    def _each(self, work: Callable[[Shown], None]) -> Callable[[], None]:
        """Return a thread's work: `work` on the newest frame, again when there is a newer one."""

        def go_on() -> None:
            newest = self._after(0)
            while newest is not None:
                work(newest)
                newest = self._after(newest.number)

        return go_on

    def _after(self, number: int) -> Shown | None:
        """Return the newest frame when it is a later one than `number`; None at the end."""
        with self.state.changed:
            self.state.changed.wait_for(
                lambda: (
                    self._ending.is_set()
                    or (self._shown is not None and self._shown.number > number)
                )
            )
            return None if self._ending.is_set() else self._shown

    def _show_levels(self, newest: Shown) -> None:
        frame, dark = newest.frame, is_dark(newest.frame)
        some = replace(frame, mosaic=thinned(frame.mosaic, LEVEL_PIXELS))
        found = figures(frame)
        level = level_of(frame, found)
        with self.state.changed:
            reference = self._reference
        self.state.publish(
            figures={
                "frame": newest.number,
                "level": level,
                "brightest": brightest(some),
                "saturated": found.saturated,
                "dark": dark,
                "moves": newest.moves,
                "histogram": {name: row.tolist() for name, row in histogram(some).items()},
                "focus": self._focus.add(frame, time.monotonic()),
                "shift": _shift(frame, reference),
                "exposure_s": frame.exposure_s,
            }
        )
        if self._exposing and newest.moves is not None:
            self._expose_better(frame, level, dark)
        elif not dark and is_well_exposed(level, found.saturated):
            self._forget_unexposed()

    def _give_up_exposing(self, why: str) -> None:
        self._exposing, self._unexposed = 0, why
        self.state.publish({"setting": why})

    def _expose_better(self, frame: RawFrame, level: float, dark: bool) -> None:
        """Choose the next exposure by a frame that was taken at the present one."""
        exposure_s = self._exposure_s
        if frame.exposure_s and abs(frame.exposure_s / exposure_s - 1) > 0.05:
            return
        if dark and (away := self._away()):
            where = f"{', '.join(away)} away from the centre"
            self._give_up_exposing(f"{DARK}, {where}: centre the mask first")
            return
        self._exposing -= 1
        shortest_s, longest_s = self.state["settings"]["exposure_limits_s"]
        limits_s = shortest_s, min(longest_s, self._longest_s)
        next_s = next_exposure_s(exposure_s, level, limits_s)
        if next_s is not None:
            self._wishes.put(lambda: self._camera.set_exposure_s(next_s))
        elif GOOD_LEVELS[0] <= level <= GOOD_LEVELS[1]:
            self._exposing = 0
        elif dark:
            self._give_up_exposing(
                f"dark at {exposure_s:g} s too: switch the lamp on, open the aperture"
            )
            self._wishes.put(lambda: self._camera.set_exposure_s(self._dimmest_s))
        elif 0.99 * limits_s[1] < exposure_s < 0.99 * longest_s:
            self._give_up_exposing("")  # the hint says how long an exposure is needed
        else:
            self._give_up_exposing(f"no better exposure within {shortest_s:g} to {longest_s:g} s")

    def _show_mask(self, newest: Shown) -> None:
        assert self._design is not None
        if time.monotonic() < self._seek_at_s or newest.moves is None:
            self._ending.wait(POLL_S)
            return
        if is_dark(newest.frame):
            self.state.publish(mask={"place": None, "why": DARK})
            return
        if self.state["mask"] == {"place": None, "why": DARK}:
            self.state.publish(mask=None)  # what is measured now takes seconds
        try:
            if self._gauge is None:
                self._gauge = MaskGauge(self._design, newest.frame.mosaic.shape)
            place = self._gauge.measure(newest.frame, self._mask_stands_um())
            mask = {"place": asdict(place), "why": ""}
            self._found = replace(self._found, mask=place)
        except (CalibrationError, CameraError) as fault:
            mask = {"place": None, "why": str(fault)}
            self._seek_at_s = time.monotonic() + SEEK_S
        self.state.publish(mask=mask)

    def _mask_stands_um(self) -> tuple[float, float]:
        """Return where the mask stage stands from its centre, x and y; 0 where it is not known."""
        assert self._design is not None
        if self._driving is None or not self._design.moving_masks:
            return 0.0, 0.0
        off_um = self._off_um()
        return off_um.get("mask_x") or 0.0, off_um.get("mask_y") or 0.0

    def _show_light_field(self, newest: Shown) -> None:
        assert self.light_field is not None
        if newest.moves is None:
            self._ending.wait(POLL_S)
            return
        try:
            shown = self.light_field.update(newest.frame, self._shot(), newest.number)
        except AppError as fault:
            self.state.publish({"light field": str(fault)})
            self._ending.wait(RETRY_S)
            return
        drawn = (shown["pictures"] or {}).get("number", 0)
        if drawn != self._drawn:
            self._drawn, self._latency_s = drawn, time.monotonic() - newest.at_s
        latest = {"frame": newest.number, "latency_s": self._latency_s, **shown}
        self.state.publish({"light field": ""}, light_field=latest)

    def _shot(self) -> int | None:
        """Return the shot of the light field's Psi at which the mask stands; None: at none."""
        assert self.light_field is not None
        psi, design = self.light_field.psi, self._design
        if psi.shots == 1 or design is None or not design.moving_masks:
            return 0 if psi.shots == 1 else None
        x_um, y_um = self._mask_stands_um()
        (name, *_) = design.moving_masks
        for number, shot in enumerate(design.shots[: psi.shots]):
            there_x, there_y = shot.offset_um.get(name, (0.0, 0.0))
            if np.hypot(x_um - there_x, y_um - there_y) < AT_SHOT_UM:
                return number
        return None


def _shift(frame: RawFrame, reference: RawFrame | None) -> dict[str, float] | None:
    """Return how a frame lies over the reference, in sensor pixels; None where they differ."""
    if reference is None or (reference.mosaic.shape, reference.cfa) != (
        frame.mosaic.shape,
        frame.cfa,
    ):
        return None
    shift = registered(frame, reference, SHIFT_PX)
    return asdict(shift) if shift.likeness >= LEAST_LIKENESS else None
