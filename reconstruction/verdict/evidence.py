"""The figures of a capture and its light field from which a verdict follows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, astuple, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.frames import Frames
from emmc_rig.model.lightfield import centre_view, sum_of_squares
from emmc_rig.model.sensing import Psi
from emmc_rig.model.view_axes import ANGLES, ViewAxes, shows_parallax
from emmc_rig.reconstruction.colour import unseen_colour
from emmc_rig.reconstruction.result import SCALE, Reconstruction
from emmc_rig.reconstruction.verdict.bands import mask_shift_px
from emmc_rig.reconstruction.verdict.displaced import displaced
from emmc_rig.reconstruction.verdict.kept import compare_held_out, over_baselines
from emmc_rig.reconstruction.verdict.orientation import WEAK, seen_masks
from emmc_rig.reconstruction.verdict.readings import blockiness, pixel_figures, quantised
from emmc_rig.reconstruction.verdict.shadow import (
    Relief,
    cross_strength,
    measured_relief,
    shadow,
)
from emmc_rig.reconstruction.verdict.shots import Motion, brightness

Array = NDArray[np.floating]
CLIPPED = 0.5
"""Share of a shot's largest reading, from which on an unusable reading counts as saturated: divided
by a flat field the white level differs from pixel to pixel."""


@dataclass(frozen=True)
class Evidence:
    """Figures of a capture and of a light field found from it; None stands for an unknown figure.

    Shares are of all readings, places are (row, column) of pixels, rms is root mean square.
    """

    method: str
    status: str  #: of the reconstruction
    left_out: tuple[int, ...]  #: shots that screening left out, dark or repeating others
    noise: float  #: deviation of the readings over their mean
    relief: float  #: root mean square of what the masks add to the readings, over them
    strengths: tuple[float | None, ...]  #: of the masks' shadow in each shot, 1 where Psi is right
    strength_errors: tuple[float | None, ...]  #: their standard deviations
    other_strengths: tuple[tuple[float | None, ...], ...]  #: (read, said), see `cross_strength`
    displaced_px: float | None  #: root mean square displacement of the shadow
    changes: dict[str, tuple[float | None, ...]]  #: fields of `displaced.Change`, by cause
    brightness: tuple[float | None, ...]  #: of each shot, over the shots' mean
    bad: float  #: share of the pixels that screening left out
    unusable: float
    saturated: float
    blind: float  #: share of the pixels that lie far from any that a shot sees
    hole_px: float  #: radius of the largest hole
    hole_at: tuple[int, int]  #: its centre
    kept: int  #: readings kept from the fit
    #: share of the smooth picture's squared residual of these, less noise, that the light field
    #: removes
    explained: float | None
    noise_share: float | None  #: of noise in the light field's squared residual of these
    parameters: dict[str, float]  #: REPORTED_PARAMETERS of the result
    colour_error: float | None = None  #: rms by colours that frames do not show, over brightness
    motion: float | None = None  #: ratio of `Motion`, above 1 where shots saw different scenes
    moved_at: tuple[int | None, int, int] | None = None  #: shot (None: any), row, column
    moved_px: tuple[int, int] | None = None  #: rows and columns of that place
    moved: float = 0.0  #: share left out for motion
    short: float = 0.0  #: share that only gives a lower bound of the light, and is needed
    gains: tuple[float, ...] = ()  #: by which the shots' brightness was evened
    over_flat: float | None = None  #: see `over_baselines`
    over_neighbours: float | None = None
    parallax: float | None = None  #: rms by which views differ from the middle one, over it
    blockiness: float | None = None  #: see `blockiness`
    steps: float | None = None  #: noise by quantisation, over the noise stated
    stated: float | None = None  #: deviation by held-out readings, rms, over the light field's mean
    view_axes: ViewAxes = ANGLES
    #: from band to band: of the light field, and of Psi's masks, without a sign
    shifts_px: tuple[float, float] | None = None
    #: fields of `orientation.Seen`, where the masks stand clearly otherwise than in Psi
    masks_seen: tuple[Any, ...] | None = None

    def as_dict(self) -> dict:
        """Return the figures as plain data."""
        return asdict(self)

    @classmethod
    def from_dict(cls, figures: Mapping[str, Any]) -> Evidence:
        """Return evidence from what `as_dict` gave, also through JSON, or by an earlier version."""
        known = cls.__dataclass_fields__
        return cls(**{key: _tupled(value) for key, value in figures.items() if key in known})


REPORTED_PARAMETERS = (
    "decided", "at_end", "over_plain", "misfit", "misfit_row", "misfit_column", "moved_px"
)  # fmt: skip
"""Parameters of a result that bear on whether it can be trusted."""


@dataclass(frozen=True, eq=False)
class FittedFrames:
    """Screened frames, of which some readings are kept from the fit.

    kept, excluded: (shot, pixel_y, pixel_x); which are kept, and the readings of pixels that were
    not usable before screening, 0 elsewhere. left_out: shots that screening left out, for being
    dark or for repeating others. bad: share of the pixels that it left out, for differing from
    their neighbours. short: share of the readings that are saturated, above the prediction of a
    light field fitted without them. gains: by which screening divided the shots.
    """

    frames: Frames
    kept: NDArray[np.bool_]
    excluded: Array
    left_out: tuple[int, ...] = ()
    bad: float = 0.0
    short: float = 0.0
    gains: tuple[float, ...] = ()

    def of_first_shot(self) -> FittedFrames:
        """Return the same of the first shot alone."""
        left_out = tuple(shot for shot in self.left_out if shot == 0)
        return replace(
            self, frames=self.frames.cut(np.s_[:1,]), kept=self.kept[:1],
            excluded=self.excluded[:1], left_out=left_out, gains=self.gains[:1],
        )  # fmt: skip

    @property
    def shown(self) -> Array:
        """The readings (shot, pixel_y, pixel_x), 0 where they are not usable."""
        return np.where(self.frames.usable, self.frames.readings, 0)

    @property
    def clipped(self) -> NDArray[np.bool_]:
        """Saturated readings: excluded, and as large as the usable ones."""
        most = self.shown.max(axis=(1, 2), keepdims=True)
        return (self.excluded > 0) & (self.excluded >= CLIPPED * most)


def gathered(
    psi: Psi,
    fitted: FittedFrames,
    result: Reconstruction,
    relief: Relief | None = None,
    moved: Motion | None = None,
) -> Evidence:
    """Return the figures of a light field that was fitted without the readings kept.

    relief: of the usable readings, where it is known. moved: the largest difference between the
    scenes of several shots.
    """
    frames, usable, noise_sigma = fitted.shown, fitted.frames.usable, fitted.frames.noise_sigma
    if relief is None:
        relief = measured_relief(psi, frames, noise_sigma, usable)
    masks = shadow(relief)
    seen = seen_masks(psi, relief) if np.nanmin([1, *masks.strength]) < WEAK else None
    residual = frames - psi.forward(result.light_field)
    with ThreadPoolExecutor(1) as beside:  # the two that take long
        given = psi, frames, residual, noise_sigma, usable, fitted.kept
        baselines = beside.submit(over_baselines, *given)
        off = displaced(psi, relief)
    mean = max(float(np.mean(frames[usable], dtype=np.float64)), 1e-12)
    step = quantised(frames, usable)
    return Evidence(
        method=result.method,
        status=result.status,
        left_out=fitted.left_out,
        noise=noise_sigma / mean,
        relief=masks.relief,
        strengths=_plain(masks.strength),
        strength_errors=_plain(masks.error),
        other_strengths=tuple(_plain(row) for row in cross_strength(relief)),
        displaced_px=off.size_px,
        changes={name: _plain(astuple(change)) for name, change in off.changes.items()},
        brightness=_plain(brightness(relief)),
        **({} if moved is None else moved.figures()),
        bad=fitted.bad,
        **pixel_figures(fitted.excluded, relief, usable),
        **compare_held_out(frames, residual, noise_sigma, fitted.kept & usable, relief),
        colour_error=_colour_error(psi, frames, usable, relief),
        parameters={
            key: result.parameters[key] for key in REPORTED_PARAMETERS if key in result.parameters
        },
        short=fitted.short,
        gains=fitted.gains,
        parallax=_parallax(result.light_field, psi.view_axes),
        **baselines.result(),
        blockiness=blockiness(frames, usable),
        steps=None if step is None else step / np.sqrt(12) / max(noise_sigma, 1e-12),
        stated=_stated(result),
        view_axes=psi.view_axes,
        shifts_px=_shifts_px(psi, result),
        masks_seen=None if seen is None else tuple(seen),
    )


def _shifts_px(psi: Psi, result: Reconstruction) -> tuple[float, float] | None:
    """Return `Evidence.shifts_px`."""
    if "band" not in psi.view_axes or "shift" not in result.maps:
        return None
    of_masks = mask_shift_px(psi)
    return None if of_masks is None else (abs(float(np.median(result.maps["shift"]))), of_masks)


def _colour_error(psi: Psi, frames: Array, usable: NDArray[np.bool_], relief: Relief) -> float:
    """Return `Evidence.colour_error`."""
    unseen = unseen_colour(psi, frames, usable, relief.picture)
    square = np.square(relief.picture.mean(axis=-1, dtype=np.float64)).mean()
    return float(np.sqrt(unseen.mean() / max(square, 1e-12)))


def _stated(result: Reconstruction) -> float | None:
    """Return `Evidence.stated`: the scale that held-out readings gave the deviation is undone."""
    if "sigma" not in result.maps:
        return None
    sigma = result.maps["sigma"]
    views = np.ndindex(sigma.shape[:2])
    square = sum(sum_of_squares(sigma[view]) for view in views) / sigma.size
    square /= 10 ** (result.parameters.get(SCALE, 0.0) / 10)
    return float(np.sqrt(square) / max(float(result.light_field.mean(dtype=np.float64)), 1e-12))


def _parallax(light_field: Array, view_axes: ViewAxes) -> float | None:
    """Return `Evidence.parallax`; bands and times are no angles, and show none."""
    if not shows_parallax(view_axes) or light_field.shape[0] * light_field.shape[1] == 1:
        return None
    middle = centre_view(light_field)
    square = sum_of_squares(middle) / middle.size
    views = (light_field[v, u] - middle for v, u in np.ndindex(light_field.shape[:2]))
    apart = sum(sum_of_squares(view) for view in views) / light_field.size
    return float(np.sqrt(apart / max(square, 1e-30)))


def _plain(values: Iterable[float]) -> tuple[float | None, ...]:
    """Return plain numbers, None in place of infinity and NaN."""
    return tuple(float(value) if np.isfinite(value) else None for value in values)


def _tupled(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tupled(item) for key, item in value.items()}
    return tuple(map(_tupled, value)) if isinstance(value, (list, tuple)) else value
