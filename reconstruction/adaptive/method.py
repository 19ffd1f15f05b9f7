"""The adaptive method: disparities by evidence, then the texture of the surfaces they make.

Edges that views do not reach are left out of what follows, and given back at the end (`edges`).

1. The disparity of a patch has a likelihood, given its readings (`evidence`, `search`), and
   patches agree with their neighbours.
2. Contrast, disparities and weights are decided once for the whole picture (`survey`).
3. The centre view's disparity is carried to all views (`visibility`), so that the frames are
   linear in the surfaces' texture (`rays`).
4. The texture is fitted to all frames at once, from total variation's centre view, with what
   repeats in the scene as prior, and the disparity is sharpened per pixel on the way (`joint`,
   `shrinkage`, `refine`, `sweep`).
5. Where disparities are wide they are searched a second time, less sure (`survey`).
6. Textures that follow the readings more or less closely, and sparse patches from two shots on or
   total variation, are averaged by how well they predict readings kept from all of them (`fits`,
   `mixture`), which also calibrate the standard deviation of the result (`uncertainty`).

Nothing is trained: a mask, sensor or number of shots enters through Psi alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.compiling import running_s
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive import mixture, search
from emmc_rig.reconstruction.adaptive.edges import DarkEdges, dark_edges, faded
from emmc_rig.reconstruction.adaptive.evidence import TexturePrior
from emmc_rig.reconstruction.adaptive.film import Film, followed
from emmc_rig.reconstruction.adaptive.fits import Fits, Patches, averaged, fitted_models
from emmc_rig.reconstruction.adaptive.resting import WHOLE, Before, Window, covered, windows
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.adaptive.survey import (
    CONTRAST,
    Plain,
    checked,
    checked_disparity,
    plain_of,
    searched_again,
    surveyed,
)
from emmc_rig.reconstruction.adaptive.times import (
    OtherTime,
    moved,
    of_present,
    of_samples,
    surveyed_together,
)
from emmc_rig.reconstruction.adaptive.uncertainty import disparity_deviation, within_db
from emmc_rig.reconstruction.inputs import Readings
from emmc_rig.reconstruction.result import WITHIN, Progress, Reconstruction, Status

Array = NDArray[np.floating]
_converged = partial(
    Reconstruction, method="adaptive", status=Status.CONVERGED, advice="", objective=()
)
TEXTURED = 0.01
"""Variance of a patch's texture, over its squared brightness, from which it counts as textured. On
middles of group A (96x96, one CFA shot) 11 to 100 % of such patches decide, of weaker ones 0 to
25 %, whatever the mask: with them antinous was doubted."""


def reconstruct_adaptive(
    psi: Psi,
    frames: Frames,
    settings: AdaptiveSettings | None = None,
    on_step: Callable[[Progress], None] | None = None,
    disparity: Array | None = None,
    patches: Patches | None = None,
    film: Film | None = None,
) -> Reconstruction:
    """Return the light field of the surfaces and textures that the frames speak for.

    disparity: of the centre view (y, x), where it is known, in place of the one searched. patches:
    see `Patches`; they are asked for from `settings.patches` shots on, or where surfaces fail
    (`survey`). film: that this is a frame of, see `reconstruction.result.Reconstruction.film`.
    Raises ReconstructionError for inputs of shapes that disagree.
    """
    settings = settings or AdaptiveSettings()
    known = None if disparity is None else checked_disparity(disparity, psi)
    return _reconstructed(checked(psi, frames), settings, on_step, film, patches, known=known)


def reconstruct_next(
    psi: Psi,
    frames: Frames,
    film: Film,
    settings: AdaptiveSettings,
    on_step: Callable[[Progress], None] | None = None,
) -> Reconstruction | Film:
    """Return the light field of the next frame of a film, from what the frames before showed.

    frames: of one shot. film: after the frame before. If earlier frames do not predict this frame,
    or mislead its fit, returns a film that begins with this frame.
    """
    started = running_s()
    whole = checked(psi, frames)
    if shown := film.shown(whole.psi):
        return _reconstructed(whole, settings, on_step, film, shown=shown)
    given, edges = _without_edges(whole, settings)
    if film.known is not None and edges is None:
        changed = film.known.rest.changed(given)
        places = windows(changed)
        if covered(places) < WHOLE * changed.size:
            return _resting(film, given, changed, places, settings, on_step, started)
    total = film.settings.texture.steps + 1

    def report(step: int) -> None:
        if on_step is not None:
            on_step(Progress(step, None, None, total))

    found = followed(film, given, settings, report)
    known = film.known
    if found is None or known is None:
        return Film(film.settings)
    beliefs = found.beliefs
    result = _result_of(found.plain, found.fits, beliefs, beliefs, edges, whole, total, started)
    if found.worse(known, result.light_field):
        return film
    report(total)
    if not found.slow:
        seen = found.plain, found.fits.scene, result, beliefs
        film = film.after(*seen, known.missed, found.earlier)
    return replace(result, parameters=result.parameters | found.parameters, film=film)


def _resting(
    film: Film,
    given: Readings,
    changed: NDArray[np.bool_],
    places: Sequence[Window],
    settings: AdaptiveSettings,
    on_step: Callable[[Progress], None] | None,
    started: float,
) -> Reconstruction:
    """Return the light field of a frame of a camera at rest: only what changed is fitted.

    changed: (pixel_y, pixel_x), within the windows `places`.
    """
    known, psi, k = film.known, given.psi, given.psi.binning
    assert known is not None
    settings = settings.model_copy(update={"contrast": CONTRAST * known.scale})
    rest = known.rest.after(given, changed)
    mean, everything = rest.mean(given), (slice(0, changed.shape[0]), slice(0, changed.shape[1]))
    due = rest.due()
    if due:
        places = [everything]
    steps = 0
    for number, window in enumerate(places):
        rows, columns = (slice(at.start * k, at.stop * k) for at in window)
        part, at = mean, (slice(None), *window)
        if not due:
            part = Readings(
                psi.window(rows, columns),
                np.ascontiguousarray(mean.frames[at]),
                mean.typical,
                np.ascontiguousarray(mean.noise[at]),
                np.ascontiguousarray(mean.usable[at]),
            )
        disparity = rest.disparity[rows, columns]
        seen = rest.picture[rows, columns]
        before = Before(seen, disparity, of_samples(changed[window], disparity))

        def report(of: Progress, number: int = number) -> None:
            if on_step is not None:
                total = of.total or of.step
                done = number * total + of.step
                on_step(Progress(done, None, None, len(places) * total))

        found = _reconstructed(part, settings, report, before=None if due else before)
        rest, steps = rest.with_fit(found, window, k), steps + found.steps
    rest = replace(rest, whole=rest.whole + due)
    light_field = mixture.values(rest.light_field)
    residual = (given.frames - psi.forward(light_field)).astype(np.float32)
    figures = dict(rest.figures)
    figures |= misfit(residual, given.noise, given.usable)
    figures |= {"still_share": float(1 - changed.mean())}
    if on_step is not None and not places:
        on_step(Progress(1, None, None, 1))
    return _converged(
        light_field=light_field,
        steps=steps,
        seconds=running_s() - started,
        parameters=figures,
        maps=rest.maps,
        film=replace(film, known=replace(known, rest=rest)),
    )


def reconstruct_moving(
    psi: Psi,
    frames: Frames,
    settings: AdaptiveSettings,
    on_step: Callable[[Progress], None] | None = None,
    patches: Patches | None = None,
) -> Reconstruction:
    """Return the light field at the time of the first of several shots, of a scene that moves.

    The light field is carried to the times of the other shots; their readings count where it
    explains them. patches: of the first shot.
    """
    present, *others = (
        checked(psi.of_shots([n]), frames.cut(np.s_[n : n + 1,])) for n in range(psi.shots)
    )
    nothing, steps = np.zeros(psi.size), settings.start_steps
    shown = [(readings, plain_of(readings, 1.0, nothing, steps).picture) for readings in others]
    return _reconstructed(present, settings, on_step, patches=patches, shown=shown)


def _reconstructed(
    whole: Readings,
    settings: AdaptiveSettings,
    on_step: Callable[[Progress], None] | None,
    film: Film | None = None,
    patches: Patches | None = None,
    shown: Sequence[tuple[Readings, Array]] = (),
    known: Array | None = None,
    before: Before | None = None,
) -> Reconstruction:
    """Return the light field of a frame.

    shown: frames of other times, see `others_of`. known: disparity of the centre view (y, x).
    before: what the place showed in the frame before, of a place where something changed.
    """
    started = running_s()
    searched_s = 0.0
    total = len(settings.misfits) * settings.texture.steps + 3

    def report(step: int) -> None:
        nonlocal searched_s
        if step == 2:
            searched_s = running_s() - started
        if on_step is not None:
            on_step(Progress(step, None, None, total))

    given, edges = _without_edges(whole, settings)
    others: list[OtherTime] = []
    if shown:
        together, others = surveyed_together(given, shown, settings, report)
        survey = of_present(together, given)
    else:
        together = survey = surveyed(given, settings, known, report)
    second = searched_again(together, settings) if known is None else None
    if second is not None:
        total = 2 * settings.texture.steps + 3
    was = None if before is None else before.carried(survey.picture)
    fits = fitted_models(
        survey, settings, lambda step: report(2 + step), patches, second, others, was
    )
    beliefs, scene = survey.volume if second is None else second, fits.scene
    result = _result_of(survey, fits, survey.volume, beliefs, edges, whole, total, started)
    report(total)
    if before is not None:
        result = replace(result, maps={**result.maps, "picture": survey.picture})
    left = result.parameters["misfit"]
    of_others = moved(others) if others else {}
    return replace(
        result,
        parameters=result.parameters | {"search_seconds": searched_s} | of_others,
        film=film and film.after(survey, scene, result, beliefs, left, others),
    )


def _without_edges(
    whole: Readings, settings: AdaptiveSettings
) -> tuple[Readings, DarkEdges | None]:
    """Return the readings without dark edges, and these; None without any."""
    edges = dark_edges(whole.psi, whole.frames, whole.usable, settings.edges)
    if edges is None:
        return whole, None
    return replace(whole, usable=whole.usable & ~edges.within), edges


def _result_of(
    survey: Plain,
    fits: Fits,
    searched: search.Volume,
    believed: search.Volume,
    edges: DarkEdges | None,
    whole: Readings,
    steps: int,
    started: float,
) -> Reconstruction:
    """Return the mean of fits, with its maps.

    believed: the less sure of two searches, which knows better how sure to be. whole: the readings
    with dark edges. started: by `running_s`.
    """
    given, psi = survey.given, survey.given.psi
    size, k = psi.size, psi.binning
    volumes = [believed] if believed is searched else [believed, searched]
    moments = [search.moments_per_pixel(volume, size, k) for volume in volumes]
    mean = averaged(survey, fits, np.sqrt(moments[0].variance))
    residual = (given.frames - psi.forward(mean.light_field)).astype(np.float32)
    centre = fits.scene.centre
    if len(fits.centres) > 1:
        shares = mean.shares[: len(fits.centres)].repeat(k, axis=1).repeat(k, axis=2)
        centre = np.take_along_axis(np.stack(fits.centres), shares.argmax(axis=0)[None], 0)[0]
    maps = {
        "disparity": centre,
        "disparity_sigma": disparity_deviation(centre, moments),
        "texture": _texture_map(searched, size, k),
        **({} if mean.sigma is None else {"sigma": mean.sigma}),
    }
    light_field = mean.light_field
    if edges is not None:
        light_field = faded(edges, psi, light_field, whole.frames, whole.usable)
    decided = _decided(searched)
    return _converged(
        light_field=light_field,
        steps=steps,
        seconds=running_s() - started,
        parameters={
            "noise_sigma": given.typical,
            "lowest_px": float(fits.scene.centre.min()),
            "highest_px": float(fits.scene.centre.max()),
            "disparities": len(searched.disparities),
            "held_readings": int(survey.held.sum()),
            "at_end": searched.at_end,
            **({} if edges is None else {"dark_edge_px": float(max(edges.widths))}),
            **misfit(residual, given.noise, given.usable & ~survey.held),
            **({} if decided is None else {"decided": decided}),
            **({} if mean.over_plain is None else {"over_plain": mean.over_plain}),
            **mean.reported,
            **({} if mean.sigma is None else {WITHIN: within_db(decided)}),
        },
        maps=maps,
    )


def _texture_map(volume: search.Volume, size: tuple[int, int], binning: int) -> NDArray[np.uint8]:
    """Return the kind of texture, as TexturePrior counts them, of the patch next to each sample."""
    nearest = [
        np.abs(((np.arange(length) + 0.5) / binning - 0.5)[:, None] - at[None]).argmin(axis=1)
        for at, length in zip(volume.centres, size, strict=True)
    ]
    return volume.kind[np.ix_(*nearest)].astype(np.uint8)


def misfit(residual: Array, noise: Array, fitted: NDArray[np.bool_]) -> dict[str, float]:
    """Return the readings' root mean square residual over their noise, and where it is largest.

    residual: the frames less what is predicted; noise: variance of the readings; fitted: those that
    count, all (shot, pixel_y, pixel_x).
    """
    relative = np.where(fitted, np.square(residual) / np.maximum(noise, 1e-20), 0)
    around = cv2.GaussianBlur(relative.sum(axis=0, dtype=np.float64), (0, 0), mixture.WINDOW_PX)
    row, column = np.unravel_index(around.argmax(), around.shape)
    times = float(np.sqrt(relative.sum(dtype=np.float64) / max(int(fitted.sum()), 1)))
    return {"misfit": times, "misfit_row": float(row), "misfit_column": float(column)}


def _decided(volume: search.Volume) -> float | None:
    """Return the share of the textured patches that prefer some disparity; None without any."""
    textured = np.array([size >= TEXTURED for size, _ in TexturePrior().kinds])[volume.kind]
    return float(volume.decisive[textured].mean()) if textured.any() else None
