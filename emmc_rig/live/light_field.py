"""The light field while the camera watches: coarse at once, then as `reconstruct` gives it.

A preview follows every frame (`reconstruction.preview`), until a reconstruction that runs beside it
takes its place. Methods that take films, with a Psi of one shot, reconstruct while the scene moves:
when a frame is done, the newest one is the next of the film, and those between are left out. After
a cut the preview is shown again, and the new scene is begun at once. Other methods begin once the
scene has stood still; a change of the scene ends their reconstruction. A scene that stands still is
reconstructed once.
"""

from __future__ import annotations

import json
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.scale import Scale, exposure_of
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.formats.format import Export
from emmc_rig.live.served_page import Picture, Pictured, Query
from emmc_rig.model.errors import SensingError
from emmc_rig.model.frames import Frames, even_frames
from emmc_rig.model.sensing import Psi
from emmc_rig.model.view_axes import ANGLES, ViewAxes, shows_parallax
from emmc_rig.reconstruction.adaptive.film import Film
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.methods import DEFAULT_METHOD, find_method
from emmc_rig.reconstruction.preview import Preview
from emmc_rig.reconstruction.result import Progress, Reconstruction
from emmc_rig.reconstruction.verdict.kept import missed_readings
from emmc_rig.reconstruction.verdict.rules import Verdict
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.report.display import PART_PIXELS
from emmc_rig.report.viewer import viewer_data
from emmc_rig.session.brightness import is_dark
from emmc_rig.session.measured_psi import open_scale, session_scale
from emmc_rig.session.session import Session
from emmc_rig.store.folders import is_session

Array = NDArray[np.floating]
FACTOR = 4
"""Samples along each axis that the preview takes as one: quarter size."""
STEPS = 3
"""Of the preview for each frame."""
STILL_S = 1.5
"""How long nothing changes before a scene is taken to stand still."""
SETTLING = 15
"""Frames of a scene that stands still after which its preview is final: STILL_S at 10 frames/s."""
RECENT = 5
"""Reconstructions whose median time is stated: one of them, a first frame's, takes longer."""
CHANGED = 4.0
"""Mean square of the difference of two frames in a block, over its variance, from which on the
scene changed: 1 of noise alone, with a deviation of 0.09 over BLOCK_PX^2 pixels."""
CUT = 0.5
"""Variance of the difference of two frames' blocks, over the sum of their variances, from which on
they are not of one scene: 1 for uncorrelated frames. `panning-desk` comes to 0.01 within
0.1 s and 0.25 within 0.5 s, different built-in scenes to 0.65 and more (96x128)."""
CUT_S = 0.5
"""Frames farther apart may differ as much because the scene moves."""
BLOCK_PX = 16
ANOTHER_BRIGHTNESS = 1.2
COMPILING_S = 5.0
"""From when on the page says what the next light field is at; without a step, why."""

Solve = Callable[..., tuple[Reconstruction, Verdict]]
SURE_PX = 0.15
"""Deviation of a disparity, coarse pixels per view step, above which it is not shown."""
WINDOW_PX = 7
DARK = "the picture is dark: no light field to see"


class _ChangedError(Exception):
    """The scene changed during its reconstruction."""


class LiveLightField:
    """Follows frames; `update` is called by one thread, all else by any.

    scale: Psi, and what turns frames into its readings. method: of the reconstruction. preview:
    what the last frame moved on; None before the first.
    """

    def __init__(
        self,
        scale: Scale,
        method: str = DEFAULT_METHOD,
        solve: Solve = reconstruct_judged,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._scale, self._method, self._solve, self._clock = scale, method, solve, clock
        white = scale.white_dn_per_s
        usable = (white > 0) & scale.good
        self._reading_per_rate = np.divide(1, white, where=usable, out=np.zeros(white.shape))
        self._reading_per_rate = self._reading_per_rate.astype(np.float32)
        self._held: dict[int, RawFrame] = {}
        self._shots = 0
        self._since_s, self._seen_s, self._unsettled = clock(), clock(), SETTLING
        self.preview: Preview | None = None
        self._level = 0.0
        self._pictures: Pictures | None = None
        self._numbers = 0
        films = scale.psi.shots == 1 and find_method(method).films
        self._film = Film() if films else None
        self._run: _Refinement | None = None
        self._done: dict[int, RawFrame] = {}
        self._refined: tuple[Reconstruction, Verdict] | None = None
        self._fault = ""
        self._periods: deque[tuple[float, float]] = deque(maxlen=RECENT)

    @property
    def psi(self) -> Psi:
        """Of all shots."""
        return self._scale.psi

    def close(self) -> None:
        """Give up a reconstruction under way."""
        if self._run is not None:
            self._run.given_up.set()

    def pictures(self) -> Pictures | None:
        """Return what was drawn last; None before the first."""
        return self._pictures

    def refined(self) -> tuple[Reconstruction, Verdict] | None:
        """Return the reconstruction that is shown; None while it is the preview."""
        return self._refined

    def update(self, frame: RawFrame, shot: int | None = 0, number: int = 0) -> dict[str, Any]:
        """Take a frame of a shot (None: of no shot of Psi), and return what there is to say.

        number: of the frame among all that the camera sent. Raises AppError for frames that do not
        fit Psi.
        """
        expected = self.psi.frames_shape[1:]
        if frame.mosaic.shape != expected:
            raise AppError(
                f"the Psi is for frames of {expected[0]}x{expected[1]} pixels, but the camera "
                f"sends {frame.mosaic.shape[0]}x{frame.mosaic.shape[1]}: name the Psi "
                "of this camera"
            )
        if shot is None:
            return self._report("the mask is at the place of no shot of this Psi")
        if not frame.exposure_s:
            return self._report("the camera does not state how long its frames were exposed")
        quick, self._seen_s = self._clock() - self._seen_s < CUT_S, self._clock()
        known, dark = shot in self._held, is_dark(frame)
        if not known or self._changed(shot, frame):
            begins_anew = self._film is None or dark or (known and quick and self._cut(frame))
            if known:
                self._held.clear()
            self._held[shot] = frame
            self._since_s, self._unsettled = self._clock(), SETTLING
            if begins_anew:
                self.close()
                self._run, self._refined, self._fault = None, None, ""
        if dark:
            return self._report(DARK)
        if self._run is not None and self._run.ended:
            self._take(self._run, number)
        try:
            if self._refined is None and self._unsettled:
                self._go_on()
                self._unsettled -= 1
            begins = self._film is not None or self._still()
            if self._run is None and self._done != self._held and begins:
                scale, held = self._scale_of_held(), dict(self._held)
                places = {shot: place for place, shot in enumerate(self._scale.shots)}
                frames = scale.frames(lambda shot: [held[places[shot]]])
                self._run = _Refinement(
                    scale.psi, frames, self._method, self._solve, self._film, held, self._clock(),
                    number,
                )  # fmt: skip
        except (SensingError, ReconstructionError, CalibrationError) as fault:
            return self._report(str(fault))
        return self._report(self._fault)

    def _still(self) -> bool:
        return self._clock() - self._since_s >= STILL_S

    def _take(self, run: _Refinement, number: int) -> None:
        """Show the result of a reconstruction, from which the next one goes on."""
        self._run, self._done = None, run.of
        self._refined, self._fault = run.result, run.fault
        if run.result is None:
            return
        found, frames = run.result[0], run.frames
        self._film = found.film
        if self._film is not None:
            self._periods.append((self._clock() - run.begun_s, number - run.number))
        missed = missed_readings(
            run.psi, found.light_field, frames.readings, frames.noise_sigma, frames.usable
        )
        self._draw(export_of(found.light_field, found.maps, missed, self.psi.view_axes))

    def _changed(self, shot: int, frame: RawFrame) -> bool:
        """Return whether a frame differs from the held one of its shot by more than noise."""
        held = self._held[shot]
        scale = self._scale
        rate, held_rate = scale.rate(frame), scale.rate(held)
        mean = np.maximum((rate + held_rate) / 2, 0)
        variance = sum(scale.rate_variance(mean, exposure_of(of)) for of in (frame, held))
        square = np.where(scale.good, (rate - held_rate) ** 2 / variance, 1.0)
        return bool(cv2.blur(square, (BLOCK_PX, BLOCK_PX)).max() > CHANGED)

    def _cut(self, frame: RawFrame) -> bool:
        """Return whether a frame shows another scene than the one held, not the same in motion."""
        now, then = (
            cv2.blur(self._scale.rate(of) * self._reading_per_rate[0], (BLOCK_PX, BLOCK_PX))
            for of in (frame, self._held[0])
        )
        return bool((now - then).var() > CUT * (now.var() + then.var()))

    def _scale_of_held(self) -> Scale:
        """Return the scale of the shots of which a frame is held."""
        return self._scale.of_shots([self._scale.shots[place] for place in sorted(self._held)])

    def _go_on(self) -> None:
        """Move the preview on by the frames held."""
        shots = sorted(self._held)
        # 0 where a pixel is not to be used, so that nothing is chosen among the readings.
        share = self._reading_per_rate[shots]
        readings = np.stack([self._scale.rate(self._held[shot]) for shot in shots])
        readings *= share
        seen = share > 0
        level = float(readings.mean() / max(seen.mean(), 1e-12))
        if level <= 0:
            raise ReconstructionError(DARK)
        factor = max(self._level / level, level / max(self._level, 1e-12))
        if self.preview is None or factor > ANOTHER_BRIGHTNESS or len(shots) != self._shots:
            scale = self._scale_of_held()
            psi = scale.psi
            self._shots, self._level = len(shots), level
            step = FACTOR // np.gcd(FACTOR, psi.binning) * psi.binning
            noise = self._noise(scale, readings)
            self.preview = Preview(psi, int(step), even_frames(readings, noise, seen))
        self.preview.follow(readings, STEPS)
        coarse = self.preview.light_field
        block = max(1, self.psi.size[1] // coarse.shape[3])
        axes = self.psi.view_axes
        maps = {"disparity": disparity_of(coarse)} if shows_parallax(axes) else {}
        self._draw(export_of(coarse, maps, view_axes=axes), block)

    def _noise(self, scale: Scale, readings: Array) -> float:
        """Return the typical deviation of the readings of the frames held."""
        variances = [
            scale.rate_variance(np.maximum(reading, 0) * white, exposure_of(self._held[place]))
            / np.where(white > 0, white, np.inf) ** 2
            for place, reading, white in zip(
                sorted(self._held), readings, scale.white_dn_per_s, strict=True
            )
        ]
        return float(np.sqrt(np.mean(variances)))

    def _draw(self, export: Export, block: int = 1) -> None:
        self._numbers += 1
        self._pictures = Pictures(self._numbers, export, block)

    def _report(self, why: str) -> dict[str, Any]:
        """Return what the page says: what is shown, how far a reconstruction is, the verdict."""
        pictures, run = self._pictures, self._run
        stage, verdict = "preview", None
        if self._refined is not None:
            found, judged = self._refined
            stage = f"{found.method}: {found.status} in {found.seconds:.1f} s, as by reconstruct"
            verdict = {"level": judged.level, "words": judged.words}
        seconds = 0 if run is None else self._clock() - run.begun_s
        if run is not None and (verdict is None or seconds > COMPILING_S):
            at_work = self._method if verdict is None else "the next one"
            stage += f"; {at_work} at work for {seconds:.0f} s, step {run.step}"
            if run.step == 0 and seconds > COMPILING_S:
                stage += ": the first time on a computer it is compiled, for up to a minute or two"
        if len(self._periods) > 1 and not self._still():
            every_s = statistics.median_low(took_s for took_s, _ in self._periods)
            sent = sum(sent for _, sent in self._periods) / sum(took for took, _ in self._periods)
            stage += (
                f"; a light field every {every_s:.1f} s ({1 / every_s:.2g} frames/s); the camera "
                f"sends {sent:.2g}"
            )
        return {
            "stage": stage,
            "why": why,
            "shots": [len(self._held), self.psi.shots],
            "pictures": None if pictures is None else pictures.facts(),
            "verdict": verdict,
        }


@dataclass(eq=False)
class _Refinement:
    """A reconstruction in a thread of its own, which can be given up between two steps.

    film: that the frames are the next of, None: of none. of: the frames by shot. begun_s, number:
    time of the begin, and the number of the newest frame then.
    """

    psi: Psi
    frames: Frames
    method: str
    solve: Solve
    film: Film | None
    of: dict[int, RawFrame]
    begun_s: float
    number: int
    result: tuple[Reconstruction, Verdict] | None = None
    fault: str = ""
    step: int = 0
    given_up: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        threading.Thread(target=self._run, name="live reconstruction", daemon=True).start()

    @property
    def ended(self) -> bool:
        """Whether there is a result, or a fault."""
        return self.result is not None or self.fault != ""

    def _run(self) -> None:
        try:
            self.result = self.solve(
                self.method, self.psi, self.frames, None, None, self._on_step, self.film
            )
        except _ChangedError:
            return
        except (ReconstructionError, SensingError) as fault:
            self.fault = str(fault)

    def _on_step(self, progress: Progress) -> None:
        if self.given_up.is_set():
            raise _ChangedError
        self.step = progress.step


@dataclass(frozen=True, eq=False)
class Pictures:
    """A light field and its maps; each has another number.

    block: how many of the camera's samples, along each axis, one of the light field is.
    """

    number: int
    export: Export
    block: int = 1

    def facts(self) -> dict[str, Any]:
        """Return what the page needs before it asks for them, as plain data."""
        return {"number": self.number, "views": list(self.export.light_field.shape[:2])}

    def encoded(self) -> bytes:
        """Return what the viewer reads, JSON."""
        data = viewer_data(self.export, most_pixels=PART_PIXELS)
        data["scale"] = float(str(data["scale"])) / self.block
        data["no_depth"] = ""  # live light fields are to set up by
        return json.dumps(data, allow_nan=False, separators=(",", ":")).encode()


def export_of(
    light_field: Array,
    maps: Mapping[str, NDArray],
    misfit: Array | None = None,
    view_axes: ViewAxes = ANGLES,
) -> Export:
    """Return a light field with those of a method's maps that the viewer shows."""
    disparity, sigma = (maps.get(name) for name in ("disparity", "sigma"))
    return Export("", "", light_field, None, disparity, sigma, misfit, view_axes=view_axes)


def field_pictures(
    newest: Callable[[], Pictures | None],
) -> dict[str, Pictured]:
    """Return what a `served_page.Page` serves of a light field."""

    def light_field(query: Query) -> Picture | None:
        shown = newest()
        return shown and Picture("light field", shown.number, shown.encoded, "application/json")

    return {"light-field.json": light_field}


def disparity_of(light_field: Array) -> NDArray[np.float32]:
    """Return the disparity of small views, (y, x), pixels per view step; NaN where not decided.

    light_field: (v, u, y, x, c). Where views are shifted by less than a pixel, brightness stays
    along lines of slope d: L_u = -d L_x and L_v = -d L_y, solved by least squares over a window
    and all views (Bolles, Baker and Marimont 1987; as Lucas and Kanade 1981 for flow).
    """
    grey = light_field @ np.full(light_field.shape[-1], 1 / light_field.shape[-1], np.float32)
    by_v, by_u, by_y, by_x = (
        np.gradient(grey, axis=axis) if grey.shape[axis] > 1 else np.zeros_like(grey)
        for axis in range(4)
    )

    def gathered(*products: tuple[Array, Array]) -> Array:
        summed = sum(np.einsum("vuyx,vuyx->yx", left, right) for left, right in products)
        return np.asarray(cv2.blur(np.asarray(summed), (WINDOW_PX, WINDOW_PX)), np.float32)

    power = gathered((by_x, by_x), (by_y, by_y))
    product = gathered((by_u, by_x), (by_v, by_y))
    change = gathered((by_u, by_u), (by_v, by_v))
    safe = np.maximum(power, 1e-12)
    found = -product / safe
    left = np.maximum(change - product**2 / safe, 0)
    # Views that differ by interpolation are no independent witnesses: one window of pixels counts.
    deviation = np.sqrt(left / safe / WINDOW_PX)
    sure = (deviation < SURE_PX) & (power > 1e-4 * float(power.max() + 1e-12))
    return np.where(sure, found, np.nan).astype(np.float32)


def live_scale(place: Path) -> Scale:
    """Return the scale of a session, of a folder of `emmc-rig calibrate`, or of the file of a Psi.

    Raises AppError, ModelError or CalibrationError.
    """
    return session_scale(Session(place)) if is_session(place) else open_scale(place)
