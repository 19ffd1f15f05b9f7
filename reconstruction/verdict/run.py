"""A reconstruction with its verdict: readings kept from the fit are predicted afterwards.

A saturated reading is a lower bound of the light. The light field is first fitted without saturated
readings. Bounds that it does not reach join the readings, and it is fitted again (an active set of
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
from emmc_rig.model.compiling import compiling_s
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.view_axes import shows_parallax
from reconstruction.adaptive.film import Film
from reconstruction.choices import choose_mu
from reconstruction.dictionary import Dictionary
from reconstruction.inputs import checked_inputs
from reconstruction.methods import MethodSettings, find_method, reconstruct
from reconstruction.result import Progress, Reconstruction
from reconstruction.screening import screened
from reconstruction.tv import few_steps
from reconstruction.verdict.evidence import FittedFrames, gathered
from reconstruction.verdict.kept import kept_readings
from reconstruction.verdict.rules import MOTION, Verdict, verdict_from
from reconstruction.verdict.shadow import relief
from reconstruction.verdict.shots import Motion, motion

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
    psi: ImagingMatrix,
    frames: Frames,
    dictionary: Dictionary | None = None,
    settings: MethodSettings | None = None,
    on_step: Callable[[Progress], None] | None = None,
    film: Film | None = None,
) -> tuple[Reconstruction, Verdict]:
    """Return the result of `reconstruct`, given the same, and whether to trust it.

    frames: the reading of a pixel that is not usable is the least that it can be, see
    `FittedFrames.clipped`; 0 says nothing. The light field is that of all readings but the few
    kept, which costs it next to nothing. Where every pixel sees the same colour, its three colours
    are alike. film: see `reconstruct`.
    """
    settings, compiling = settings or MethodSettings(), compiling_s()
    read, notes = _as_fitted(psi, frames.of_one_deviation(), settings.screening)
    typical = read.frames.noise_sigma
    unscreened = settings.model_copy(update={"screening": False})

    def solved(frames: Frames, before: float = 0.0, moving: bool = False) -> Reconstruction:
        result = reconstruct(
            name, psi, frames, dictionary, unscreened, on_step, film=film, moving=moving
        )
        return dataclasses.replace(result, seconds=result.seconds + before)

    fitted = dataclasses.replace(read.frames, usable=read.frames.usable & ~read.kept)
    shown = read.shown
    seen = relief(psi, shown, typical, read.frames.usable)

    def differing(light_field: NDArray[np.floating]) -> Motion | None:
        return motion(seen, shown - psi.forward(light_field), typical)

    can_carry, moving = _can_carry(name, psi, fitted.usable), False
    if can_carry:
        mu = choose_mu(psi, fitted.readings[fitted.usable], typical)
        coarse = few_steps(psi, fitted.readings, fitted.usable, mu, COARSE_STEPS)
        moving = _moved(differing(coarse), CLEARLY_MOVED)
    result = solved(fitted, moving=moving)
    short = _short(psi, read, result)
    if short is not None:
        took = result.seconds
        del result
        bounded = np.where(short, read.excluded, fitted.readings)
        fitted = dataclasses.replace(fitted, readings=bounded, usable=fitted.usable | short)
        result = solved(fitted, took, moving)
        read = dataclasses.replace(read, short=float(short.mean()))
        notes = (
            *notes,
            f"{read.short:.1%} of the readings are saturated, and taken as lower bounds",
        )
    found = None
    if psi.shots > 1 and not moving:
        found = differing(result.light_field)
        if can_carry and _moved(found, MOTION.doubt):
            took, moving = result.seconds, True
            del result
            result = solved(fitted, took, moving)
    if moving:
        moved_px, share = (result.parameters[key] for key in ("moved_px", "seen_share"))
        notes = (
            *notes,
            f"the scene moved by up to {moved_px:.1f} pixels between the shots: the light field is "
            f"that of shot 1, to whose time {share:.0%} of the other shots are carried",
        )
        psi, read, shown, found = psi.of_shots([0]), read.of_first_shot(), shown[:1], None
        seen = relief(psi, shown, typical, read.frames.usable)
    elif found is not None and found.moved.any():
        took = result.seconds
        del result
        at_rest = dataclasses.replace(fitted, usable=fitted.usable & ~found.moved)
        result = solved(at_rest, took)
        read = dataclasses.replace(read, kept=read.kept & ~found.moved)
        notes = (
            *notes,
            f"excluded {found.moved.mean():.1%} of the readings, where one shot saw another scene "
            "than the others",
        )
    result = dataclasses.replace(
        result, screening=notes, maps=named_maps(result.maps, psi),
        compiling_seconds=compiling_s() - compiling,
    )  # fmt: skip
    verdict = verdict_from(gathered(psi, read, result, seen, found))
    psi.even_unseen_colours(result.light_field)
    # A mean of values in [0, 1] may round to just above 1.
    np.clip(result.light_field, 0, 1, out=result.light_field)
    return result, verdict


def _can_carry(name: str, psi: ImagingMatrix, fitted: NDArray[np.bool_]) -> bool:
    """Return whether a method can carry shots to the time of the first one, which sees all."""
    colours = psi.colour is None or len(np.unique(psi.colour[0])) == COLOURS
    return psi.shots > 1 and find_method(name).films and colours and bool(fitted[0].any())


def _moved(found: Motion | None, least: float) -> bool:
    """Return whether a scene moved in nobody knows which shots."""
    return found is not None and found.shot is None and found.ratio > least


def named_maps(maps: Mapping[str, NDArray], psi: ImagingMatrix) -> dict[str, NDArray]:
    """Return a method's maps; what it calls disparity is a shift where views are no angles."""
    if shows_parallax(psi.view_axes):
        return dict(maps)
    return {name.replace("disparity", "shift"): values for name, values in maps.items()}


def _short(
    psi: ImagingMatrix, read: FittedFrames, result: Reconstruction
) -> NDArray[np.bool_] | None:
    """Return which saturated readings a light field falls short of; None where hardly any."""
    clipped = read.clipped
    if clipped.mean() <= FEWEST_SHORT:
        return None
    short = clipped & (psi.forward(result.light_field) < read.excluded)
    return short if short.mean() > FEWEST_SHORT else None


def _as_fitted(
    psi: ImagingMatrix, frames: Frames, screening: bool
) -> tuple[FittedFrames, tuple[str, ...]]:
    """Return the frames as a method gets them, and what was done to them before, in words."""
    checked, excluded = checked_inputs(psi, frames), np.where(frames.usable, 0, frames.readings)
    if not screening:
        return FittedFrames(checked, kept_readings(checked.usable), excluded), ()
    seen = screened(psi, checked)
    left_out = tuple(sorted((*seen.dark, *seen.double)))
    kept, bad = kept_readings(seen.frames.usable), float(seen.bad.mean())
    excluded = (excluded / seen.gains[:, None, None]).astype(excluded.dtype)
    gains = tuple(seen.gains.tolist())
    return FittedFrames(seen.frames, kept, excluded, left_out, bad, gains=gains), seen.notes
