"""A reconstruction with its verdict: readings kept from the fit are predicted afterwards.

A saturated reading is a lower bound of the light. The light field is first fitted without saturated
readings. Bounds above the fitted light then join the readings for a second fit (an active set of
one round: a second round changed 64x80 crops by 0.0 to 0.4 dB). Readings of a shot that shows
another scene than the others are left out, and the light field is fitted again. Where several shots
do, the scene moved, and all shots are carried to the time of the first.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.camera import measured_views
from emmc_rig.model.compiling import compiling_s
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.model.view_axes import shows_parallax
from emmc_rig.reconstruction.adaptive.film import Film
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.reconstruction.inputs import checked_inputs
from emmc_rig.reconstruction.methods import MethodSettings, find_method, reconstruct
from emmc_rig.reconstruction.problem import choose_mu
from emmc_rig.reconstruction.result import Progress, Reconstruction
from emmc_rig.reconstruction.screening import screened
from emmc_rig.reconstruction.tv import few_steps
from emmc_rig.reconstruction.verdict.evidence import FittedFrames, gathered
from emmc_rig.reconstruction.verdict.kept import kept_readings
from emmc_rig.reconstruction.verdict.rules import MOTION, Verdict, verdict_from
from emmc_rig.reconstruction.verdict.shadow import measured_relief
from emmc_rig.reconstruction.verdict.shots import Motion, motion

FEWEST_SHORT = 1e-3
"""Share of the readings from which on a second fit is worth its time."""
COLOURS = 3
COARSE_STEPS, CLEARLY_MOVED = 15, 1.6
"""Steps of total variation, and the ratio of `Motion` from which on motion is certain: at rest the
ratio is 0.3 to 1.3 (group A at 96x128, two to six shots), with 1 to 5 pixels between three shots it
is 1.5 to 12. Smaller motion is found from the light field, after the first fit."""


@one_blas_thread()
def reconstruct_judged(
    name: str,
    psi: Psi,
    frames: Frames,
    dictionary: Dictionary | None = None,
    settings: MethodSettings | None = None,
    on_step: Callable[[Progress], None] | None = None,
    film: Film | None = None,
) -> tuple[Reconstruction, Verdict]:
    """Return the result of `reconstruct`, given the same, and whether to trust it.

    frames: an unusable pixel's reading is a lower bound, see `FittedFrames.clipped`; 0 says
    nothing. The light field follows from all readings but a few kept for validation, at hardly any
    cost. Where every pixel sees the same colour, its three colours are alike. film: see
    `reconstruct`.
    """
    settings, compiling = settings or MethodSettings(), compiling_s()
    read, notes = _as_fitted(psi, frames.of_one_deviation(), settings.screening)
    unscreened = settings.model_copy(update={"screening": False})

    def solve(frames: Frames, moving: bool) -> Reconstruction:
        return reconstruct(
            name, psi, frames, dictionary, unscreened, on_step, film=film, moving=moving
        )

    capture = _Fitting(name, psi, read, notes, solve)
    capture.fit()
    capture.fit_bounds()
    differing = capture.fit_motion()
    psi, measured = capture.psi, measured_views(psi)
    result = dataclasses.replace(
        capture.result, screening=capture.notes, maps=named_maps(capture.result.maps, psi),
        seconds=capture.seconds, compiling_seconds=compiling_s() - compiling,
        measured=None if measured.all() else measured,
    )  # fmt: skip
    verdict = verdict_from(gathered(psi, capture.read, result, capture.relief, differing))
    psi.even_unseen_colours(result.light_field)
    # A mean of values in [0, 1] may round to just above 1.
    np.clip(result.light_field, 0, 1, out=result.light_field)
    return result, verdict


class _Fitting:
    """A capture that is fitted, and fitted again with other readings where the first fit asks so.

    fitted: the readings of the next fit. result: of the latest fit; seconds: of all fits. relief:
    of all usable readings. moving: whether all shots are carried to the first one's time. psi,
    read: of all shots, of the first one where the scene moved.
    """

    result: Reconstruction

    def __init__(
        self,
        name: str,
        psi: Psi,
        read: FittedFrames,
        notes: tuple[str, ...],
        solve: Callable[[Frames, bool], Reconstruction],
    ) -> None:
        self.psi, self.read, self.notes, self._solve, self.seconds = psi, read, notes, solve, 0.0
        self.fitted = dataclasses.replace(read.frames, usable=read.frames.usable & ~read.kept)
        self.relief = measured_relief(psi, read.shown, read.frames.noise_sigma, read.frames.usable)
        colours = psi.colour is None or len(np.unique(psi.colour[0])) == COLOURS
        # Shots are carried to the time of the first one, which must see all colours.
        self.can_carry = psi.shots > 1 and find_method(name).films and colours
        self.can_carry &= bool(self.fitted.usable[0].any())
        self.moving = self.can_carry and _moved(self._motion(self._coarse()), CLEARLY_MOVED)

    def _coarse(self) -> NDArray[np.float32]:
        """Return the light field of a few steps of total variation."""
        readings, usable = self.fitted.readings, self.fitted.usable
        mu = choose_mu(self.psi, readings[usable], self.read.frames.noise_sigma)
        return few_steps(self.psi, readings, usable, mu, COARSE_STEPS)

    def _motion(self, light_field: NDArray[np.floating]) -> Motion | None:
        """Return the place where shots differ most, given a light field of all of them."""
        residual = self.read.shown - self.psi.forward(light_field)
        return motion(self.relief, residual, self.read.frames.noise_sigma)

    def fit(self) -> None:
        """Fit the readings."""
        self.result = self._solve(self.fitted, self.moving)
        self.seconds += self.result.seconds

    def _refit(self) -> None:
        del self.result  # It is large.
        self.fit()

    def fit_bounds(self) -> None:
        """Fit again with the saturated readings that the light field falls short of."""
        clipped = self.read.clipped
        if clipped.mean() <= FEWEST_SHORT:
            return
        short = clipped & (self.psi.forward(self.result.light_field) < self.read.excluded)
        if short.mean() <= FEWEST_SHORT:
            return
        bounded = np.where(short, self.read.excluded, self.fitted.readings)
        usable = self.fitted.usable | short
        self.fitted = dataclasses.replace(self.fitted, readings=bounded, usable=usable)
        self._refit()
        self.read = dataclasses.replace(self.read, short=float(short.mean()))
        self._note(
            f"{self.read.short:.1%} of the readings are saturated, and taken as lower bounds"
        )

    def fit_motion(self) -> Motion | None:
        """Fit again where shots saw different scenes; return where they differ.

        Readings of a shot that differs from the others are left out. Where no single shot does, all
        are carried to the time of the first, and no difference is left to return.
        """
        differing = None
        if self.psi.shots > 1 and not self.moving:
            differing = self._motion(self.result.light_field)
            if self.can_carry and _moved(differing, MOTION.doubt):
                self.moving = True
                self._refit()
        if self.moving:
            self._keep_first_shot()
            return None
        if differing is not None and differing.moved.any():
            usable = self.fitted.usable & ~differing.moved
            self.fitted = dataclasses.replace(self.fitted, usable=usable)
            self._refit()
            self.read = dataclasses.replace(self.read, kept=self.read.kept & ~differing.moved)
            self._note(
                f"excluded {differing.moved.mean():.1%} of the readings, where one shot saw "
                "another scene than the others"
            )
        return differing

    def _keep_first_shot(self) -> None:
        """Reduce Psi and readings to the shot whose time the light field is of."""
        moved_px, share = (self.result.parameters[key] for key in ("moved_px", "seen_share"))
        self._note(
            f"the scene moved by up to {moved_px:.1f} pixels between the shots: the light field is "
            f"that of shot 1, to whose time {share:.0%} of the other shots are carried"
        )
        typical = self.read.frames.noise_sigma
        self.psi, self.read = self.psi.of_shots([0]), self.read.of_first_shot()
        self.relief = measured_relief(self.psi, self.read.shown, typical, self.read.frames.usable)

    def _note(self, words: str) -> None:
        self.notes = (*self.notes, words)


def _moved(found: Motion | None, least: float) -> bool:
    """Return whether a scene moved, and no single shot differs from the others."""
    return found is not None and found.shot is None and found.ratio > least


def named_maps(maps: Mapping[str, NDArray], psi: Psi) -> dict[str, NDArray]:
    """Return a method's maps; what it calls disparity is a shift where views are no angles."""
    if shows_parallax(psi.view_axes):
        return dict(maps)
    return {name.replace("disparity", "shift"): values for name, values in maps.items()}


def _as_fitted(psi: Psi, frames: Frames, screening: bool) -> tuple[FittedFrames, tuple[str, ...]]:
    """Return the frames for a method, and notes about their preparation."""
    checked, excluded = checked_inputs(psi, frames), np.where(frames.usable, 0, frames.readings)
    if not screening:
        return FittedFrames(checked, kept_readings(psi, checked.usable), excluded), ()
    seen = screened(psi, checked)
    left_out = tuple(sorted((*seen.dark, *seen.double)))
    kept, bad = kept_readings(psi, seen.frames.usable), float(seen.bad.mean())
    excluded = (excluded / seen.gains[:, None, None]).astype(excluded.dtype)
    gains = tuple(seen.gains.tolist())
    return FittedFrames(seen.frames, kept, excluded, left_out, bad, gains=gains), seen.notes
