"""The page of a running capture: its frames, time left, pauses, the light field so far."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from emmc_rig.bench.hands import hole_name
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.scale import Scale
from emmc_rig.captures.control import Control
from emmc_rig.captures.until import METHOD, light_field_so_far
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.live.light_field import Pictures, export_of, field_pictures
from emmc_rig.live.picture import View, encoded, picture
from emmc_rig.live.served_page import (
    COMMON_FILES,
    Count,
    Order,
    PageState,
    Picture,
    Pictured,
    Query,
)
from emmc_rig.model.errors import SensingError
from emmc_rig.progress import Event, Watcher
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.result import Progress, Reconstruction
from emmc_rig.report.session_sheet import HEADINGS, small_jpeg, stored_jpeg
from emmc_rig.session.measured_psi import session_scale
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session
from emmc_rig.store.results import stated_words

SHOWN_FRAMES, SHOWN_MESSAGES = 300, 12
PATIENCE_S = 10.0


class _EndedError(Exception):
    """The capture is over, and nobody waits for its light field any more."""


class SessionPage(Watcher):
    """A `served_page.Page`, and the watcher of the capture that it shows.

    folder: of the session. computes: reconstructs the light field after each shot, from the frames
    on the disk; without, the light field of the capture itself (`--until`) is shown.
    """

    files: tuple[str, ...] = ("session.html", "session.js", *COMMON_FILES)

    def __init__(self, folder: Path, control: Control, computes: bool = True) -> None:
        self._folder, self._control, self._computes = folder, control, computes
        self._frames: dict[str, dict[str, Any]] = {}
        self._small: dict[str, bytes] = {}
        self._newest: tuple[int, RawFrame] | None = None
        self._shots: set[int] = set()
        self._scale: Scale | None = None
        self._wanted, self._retaken = False, 0
        self._attended: PlannedFrame | None = None
        self._views: tuple[int, int] = (1, 1)
        self._refusal, self._wishes = "", 0
        self._pictures: Pictures | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(
            target=self._reconstruct, name="page light field", daemon=True
        )
        parts = {
            "title": folder.name,
            "step": "",
            "paused": None,
            "held": False,
            "wish": "",
            "asked": None,
            "last_hole": None,
            "by_hand": False,
            "headings": HEADINGS,
            "done": 0,
            "planned": 0,
            "left": None,
            "frame": 0,
            "frames": [],
            "taken": 0,
            "messages": [],
            "verdict": None,
            "end": None,
            "ended": False,
            "why": "",
            "light_field": None,
        }
        self.state = PageState(parts)
        self.pictures: Mapping[str, Pictured] = {
            "newest.jpg": self._newest_picture,
            "frame.jpg": self._small_picture,
            **field_pictures(lambda: self._pictures),
        }
        pausing, stopping = "pausing after this frame", "stopping after this frame"
        self.orders: Mapping[str, Order] = {
            "pause": Order(lambda: self._steer(control.pause, pausing), urgent=True),
            "resume": Order(lambda: self._steer(control.resume, "")),
            "stop": Order(lambda: self._steer(control.stop, stopping), urgent=True),
            "retake": Order(self._retake, ids=list[str]),
            "done": Order(self._answer, urgent=True, number=Count),
        }

    def start(self) -> None:
        """Begin to reconstruct."""
        self._thread.start()

    def close(self, why: str = "") -> None:
        """Let those who look know that the capture is over; why: what ended it early."""
        self._ending.set()
        self.state.publish(ended=True, why=why, step="", wish="")
        with self.state.changed:
            self.state.changed.notify_all()
        self._thread.join(PATIENCE_S)

    def touch(self) -> None:
        """Take no notice: the capture goes on whether somebody looks or not."""

    def event(self, event: Event) -> None:
        """Show an event of the capture."""
        if event.name == "light field":
            self._show_result(event.facts["shots"], event.objects["result"])
            return
        small = small_jpeg(event.objects["frame"]) if event.name == "frame.taken" else b""
        with self.state.changed:
            self._take_note(event, dict(event.facts), small)

    def _ask(self, what: str) -> dict[str, Any]:
        """Return what the page asks for: the work, the hole on the plate, and why once more."""
        self._wishes += 1
        self._control.answered = False
        return {"number": self._wishes, "text": what, **self._asked_hole(what)}

    def _asked_hole(self, what: str) -> dict[str, Any]:
        """Return the hole (v, u) that is asked for, the plate's, and what was wrong before."""
        view, views = self._attended and self._attended.view, self._views
        wrong = self._wrong_hole()
        if view is None or hole_name(view, views) not in what:
            return {"hole": None, "views": None, "refusal": "" if wrong else self._refusal}
        refusal = f"That was {hole_name(wrong, views)}." if wrong else self._refusal
        return {"hole": list(view), "views": list(views), "refusal": refusal}

    def _wrong_hole(self) -> tuple[int, int] | None:
        """Return the hole through which the last frame that was refused shows the shadow."""
        every = np.ndindex(self._views)
        return next(
            (v for v in every if f"through {hole_name(v, self._views)}" in self._refusal), None
        )

    def _show_result(self, shots: Sequence[int], result: Reconstruction) -> None:
        """Show the light field that these shots give."""
        number = 1 if self._pictures is None else self._pictures.number + 1
        self._pictures = Pictures(number, export_of(result.light_field, result.maps))
        stated = stated_words(result.stated)
        words = f", estimated accuracy {stated}" if stated else ""
        self._show_field(f"{result.method}: {result.status}{words}", shots)

    def _take_note(self, event: Event, facts: dict[str, Any], small: bytes) -> None:
        """Change the state by an event; small: the picture of a frame that was taken."""
        more: dict[str, Any] = {}
        match event.name:
            case "begin":
                self._begin(facts)
            case "step":
                planned = event.objects["planned"]
                if facts["step"] == "attend" and planned is not self._attended:
                    self._attended, self._refusal = planned, ""
                if facts["step"] != "write":
                    self.state.publish(step=f"{planned.id}: {facts['step']}")
            case "frame.taken":
                number = self.state["frame"] + 1
                self._small[facts["id"]] = small
                self._newest = number, event.objects["frame"]
                self._frames[facts["id"]] = {**facts, "number": number, "stored": False}
                self._publish_frames(frame=number)
            case "frame.written":
                self._frames[facts["id"]]["stored"] = True
                if facts["kind"] != "shot":
                    self._scale = None
                self._publish_frames(planned=facts["planned"] - self._retaken)
            case "shot.done":
                self._shots.add(facts["shot"])
                self._wanted = self._computes
                self.state.changed.notify_all()
            case "pause":
                if what := event.objects.get("asked"):
                    more = {"asked": self._ask(what), "by_hand": True}
                self.state.publish(paused=facts, wish="", step="", **more)
            case "resume":
                if before := self.state["asked"]:
                    more = {"asked": None}
                    if before["hole"]:
                        more["last_hole"] = before["hole"]
                self.state.publish(paused=None, wish="", step="", **more)
            case "left" | "verdict" | "end":
                self.state.publish(**{event.name: facts})
            case "message":
                if self._attended and facts["text"].startswith(f"{self._attended.id}, try "):
                    self._refusal = facts["text"].partition(": ")[2]
                    if wrong := self._wrong_hole():
                        more["last_hole"] = list(wrong)
                lines = [*self.state["messages"], facts["text"]]
                self.state.publish(messages=lines[-SHOWN_MESSAGES:], **more)

    def _begin(self, facts: dict[str, Any]) -> None:
        """Show what is there already."""
        session = Session(self._folder)
        rows, columns = session.camera["views"]
        self._views = rows, columns
        for frame in session.frames:
            entry = session.stored.get(frame.id)
            if entry is not None and frame.id not in self._frames:
                self._frames[frame.id] = {
                    "id": frame.id,
                    "kind": frame.kind,
                    "shot": frame.bench.shot,
                    "exposure_s": entry.exposure_s,
                    "level": entry.level,
                    "saturated": entry.figures.saturated,
                    "number": 0,
                    "stored": True,
                }
        missing = {frame.bench.shot for frame in session.missing() if frame.is_still_shot}
        taken = {frame.bench.shot for frame in session.needed if frame.is_still_shot} - missing
        self._shots |= taken
        self._wanted = bool(taken) and self._computes
        self.state.changed.notify_all()
        self._retaken = 0
        self._publish_frames(title=session.header["title"], planned=facts["planned"])

    def _publish_frames(self, **more: Any) -> None:
        known = list(self._frames.values())
        self.state.publish(
            frames=[dict(frame) for frame in known[-SHOWN_FRAMES:]],
            taken=len(known),
            done=sum(frame["stored"] for frame in known),
            **more,
        )

    def _steer(self, request: Callable[[], None], words: str) -> None:
        """Pass a request on to the capture; words: on the page until it is carried out."""
        request()
        self.state.publish(wish=words, held=self._control.paused)

    def _answer(self, number: int) -> None:
        """Go on, unless the page asks for another work by now; number: of the work answered."""
        with self.state.changed:
            asked = self.state["asked"]
            if asked is not None and asked["number"] == number:
                self._control.answered = True

    def _retake(self, ids: list[str]) -> None:
        for name in ids:
            known = self._frames.get(name)
            if known is None or not known["stored"]:
                raise AppError(f"frame {name!r} is not on the disk, so it cannot be taken again")
            if known["kind"] == "metering":
                raise AppError(f"frame {name}: others were exposed by it; begin another session")
        if not ids:
            raise AppError("choose the frames to take once more")
        with self.state.changed:
            for name in ids:
                self._frames[name]["stored"] = False
                if self._frames[name]["kind"] == "shot":
                    self._shots.discard(self._frames[name]["shot"])
            self._retaken += len(ids)
            self._control.take_again(ids)
            self._publish_frames()

    def _newest_picture(self, query: Query) -> Picture | None:
        newest = self._newest
        if newest is None:
            return None
        number, frame = newest
        return Picture("newest", number, lambda: encoded(picture(frame, View(px=1200))))

    def _small_picture(self, query: Query) -> Picture | None:
        name = query.get("id", "")
        known = self._frames.get(name)
        if known is None:
            raise AppError(f"no frame {name!r}")

        def make() -> bytes:
            if name not in self._small:
                self._small[name] = stored_jpeg(Session(self._folder), name)
            return self._small[name]

        return Picture(name, known["number"], make)

    def _reconstruct(self) -> None:
        while True:
            with self.state.changed:
                self.state.changed.wait_for(lambda: self._wanted or self._ending.is_set())
                if self._ending.is_set():
                    return
                self._wanted, shots = False, sorted(self._shots)
            if not shots:
                continue
            try:
                session = Session(self._folder)
                self._scale = scale = self._scale or session_scale(session)
                self._show_field(f"{METHOD} at work", shots)
                self._show_result(shots, light_field_so_far(session, scale, shots, self._go_on))
            except _EndedError:
                return
            except (AppError, CalibrationError, ReconstructionError, SensingError) as fault:
                self._show_field("no light field yet", shots, str(fault))

    def _go_on(self, progress: Progress) -> None:
        if self._ending.is_set():
            raise _EndedError

    def _show_field(self, stage: str, shots: Sequence[int], why: str = "") -> None:
        shown = None if self._pictures is None else self._pictures.facts()
        frames = self._frames.values()
        of = {frame["shot"] for frame in frames if frame["kind"] == "shot"}
        self.state.publish(
            light_field={
                "stage": stage,
                "why": why,
                "shots": [len(shots), max(len(shots), len(of))],
                "pictures": shown,
            }
        )
