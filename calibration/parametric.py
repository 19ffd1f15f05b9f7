"""Psi from the placement of the mask: coefficients, how sure they are, at any stage position."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.defects import Defects
from emmc_rig.calibration.fit import Fit
from emmc_rig.calibration.misfit import Misfit
from emmc_rig.calibration.openings import views_open
from emmc_rig.calibration.shadow import ANY_COLOUR, Shadow, ShadowMask
from emmc_rig.model.camera import Camera
from emmc_rig.model.sensing import Psi, PsiLayout

BAND_PIXELS = 2**14
"""Coefficients computed at once: their derivatives by 41 parameters, and by what each of 25 views
sees, take 22 MB."""
Stages = Sequence[tuple[float, float]]
SAMPLED = 3_000
"""Pixels drawn to estimate means over the picture: their error is 1/sqrt(3000) = 2 %."""


@dataclass(frozen=True, eq=False)
class Parametric:
    """What the parametric routes know of the bench: fit and mask, with its defects if sought.

    misfit: of the model at whiteboards of few views, by view; None without any.
    """

    fit: Fit
    mask: ShadowMask
    defects: Defects | None = None
    misfit: Mapping[tuple[int, int], Misfit] | None = None

    @property
    def shadow(self) -> Shadow:
        """The shadow as fitted."""
        return Shadow(self.mask if self.defects is None else self.defects.mask, self.fit.placement)

    def psi(self, layout: PsiLayout, stages: Stages) -> Psi:
        """Return Psi with the mask stage at `stages`, (x, y) in um per shot."""
        return psi_at(self.shadow, layout, stages)


def shot_stages(camera: Camera) -> Stages:
    """Return where the mask stage stands in every shot, x and y in um: as the camera says.

    The stage moves every mask that moves.
    """
    return [next(iter(shot.offset_um.values()), (0.0, 0.0)) for shot in camera.shots]


def _bands(
    layout: PsiLayout, shot: int, stored: int
) -> Iterator[tuple[slice, NDArray[np.int64], NDArray[np.uint8]]]:
    """Yield rows of samples with their indices (n, 2) and colours (n,)."""
    rows, columns = layout.size
    step = max(BAND_PIXELS // columns, 1)
    for first in range(0, rows, step):
        band = slice(first, min(first + step, rows))
        y, x = np.mgrid[band, :columns]
        samples = np.stack([y.ravel(), x.ravel()], axis=1)
        if layout.colour is None:
            channels = np.full(len(samples), stored, dtype=np.uint8)
        else:
            channels = layout.colour[shot, band].ravel()
        yield band, samples, channels


def coefficient_planes(
    shadow: Shadow, layout: PsiLayout, stages: Stages
) -> Iterator[tuple[tuple[int, int, int, int], NDArray[np.float32]]]:
    """Yield ((shot, v, u, stored colour), coefficients (y, x)) of Psi, one plane in memory.

    stages: per shot.
    """
    shots, views_v, views_u, _, stored_colours, _ = layout.weights_shape
    samples_shadow = of_samples(shadow)
    for place in np.ndindex(shots, views_v, views_u, stored_colours):
        yield place, coefficient_plane(samples_shadow, layout, place, stages[place[0]])


def of_samples(shadow: Shadow) -> Shadow:
    """Return the shadow on samples of the light field, whatever the pixels."""
    return Shadow(replace(shadow.mask, binning=1), shadow.placement)


def coefficient_plane(
    samples_shadow: Shadow,
    layout: PsiLayout,
    place: tuple[int, int, int, int],
    stage_um: tuple[float, float],
) -> NDArray[np.float32]:
    """Return the coefficients (y, x) of one place, (shot, v, u, stored colour), of Psi.

    samples_shadow: see `of_samples`.
    """
    shot, v, u, stored = place
    scale = layout.weights_shape[4] * layout.binning**2
    plane = np.empty(layout.size, dtype=np.float32)
    chosen = views_open((layout.weights_shape[1], layout.weights_shape[2]), (v, u))
    for band, samples, channels in _bands(layout, shot, stored):
        read = samples_shadow.readings(samples, channels, chosen, stage_um, shot)
        plane[band] = read.reshape(plane[band].shape) / scale
    return plane


def widening_planes(
    samples_shadow: Shadow,
    layout: PsiLayout,
    place: tuple[int, int, int, int],
    stage_um: tuple[float, float],
    sides: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return `coefficient_plane` through a hole of other sides, and slopes by them, (3, y, x).

    sides: relative width and height, over those of a view.
    """
    shot, v, u, stored = place
    scale = layout.weights_shape[4] * layout.binning**2
    planes = np.empty((3, *layout.size), dtype=np.float32)
    chosen = views_open((layout.weights_shape[1], layout.weights_shape[2]), (v, u))
    for band, samples, channels in _bands(layout, shot, stored):
        how = samples, channels, chosen, stage_um, shot
        read, _, by_sides = samples_shadow.with_widening(*how, sides=sides)
        for plane, values in zip(planes, (read, *by_sides.T), strict=True):
            plane[band] = values.reshape(plane[band].shape) / scale
    return planes


def psi_at(shadow: Shadow, layout: PsiLayout, stages: Stages) -> Psi:
    """Return Psi with the mask stage at `stages`, one (x, y) in um per shot."""
    weights = np.empty(layout.weights_shape, dtype=np.float32)
    for (shot, v, u, stored), plane in coefficient_planes(shadow, layout, stages):
        weights[shot, v, u, :, stored] = plane
    return layout.psi(weights)


def psi_deviation(
    shadow: Shadow,
    layout: PsiLayout,
    stages: Stages,
    covariance: NDArray[np.float64],
    astray2: Sequence[float] = (),
) -> NDArray[np.float32]:
    """Return the standard deviation of every coefficient, shaped as Psi's weights.

        deviation^2 = s^T C s + sum over kinds k of  astray2_k t_k^2

    s: the coefficient's derivatives by the placement's parameters, C: their covariance. t: by the
    view's own displacements and softenings, see `Shadow.slopes_by_view`; astray2: their variances.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(np.maximum(values, 0)))[:, values > 0]
    samples_shadow = of_samples(shadow)
    deviation = np.empty(layout.weights_shape, dtype=np.float32)
    shots, views_v, views_u, _, stored_colours, _ = layout.weights_shape
    scale = stored_colours * layout.binning**2
    for shot, v, u, stored in np.ndindex(shots, views_v, views_u, stored_colours):
        chosen = views_open((views_v, views_u), (v, u))
        for band, samples, channels in _bands(layout, shot, stored):
            how = samples, channels, chosen, stages[shot], shot
            if len(astray2):
                slopes, by_view = samples_shadow.slopes_by_view(*how)
                by_view = by_view.reshape(len(slopes), -1, len(astray2)).sum(axis=1)
                squares = np.square(slopes @ root).sum(axis=1) + by_view**2 @ np.asarray(astray2)
            else:
                slopes = samples_shadow.with_slopes(*how)[1]
                squares = np.square(slopes @ root).sum(axis=1)
            target = deviation[shot, v, u, band, stored]
            target[...] = (np.sqrt(squares) / scale).reshape(target.shape)
    return deviation


def drawn_pixels(mask: ShadowMask) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return SAMPLED pixels (n, 2) drawn at random, and the one colour that each sees."""
    rng = np.random.default_rng(0)
    rows, columns = mask.pixel_shape()
    chosen = np.stack([rng.integers(rows, size=SAMPLED), rng.integers(columns, size=SAMPLED)], 1)
    return chosen, rng.integers(ANY_COLOUR, size=SAMPLED).astype(np.uint8)


def psi_information(shadow: Shadow) -> tuple[NDArray[np.float64], float]:
    """Return G, (parameter, parameter), and |Psi|^2, both per pixel.

        G = mean over pixels of  sum over coefficients of  s s^T
        trace(G C): expected squared Frobenius error of Psi per pixel, C the placement's covariance

    s: a coefficient's derivatives. Of SAMPLED pixels drawn at random, each seeing one colour.
    """
    mask = shadow.mask
    chosen, channels = drawn_pixels(mask)
    size = len(shadow.placement.vector())
    matrix, squares = np.zeros((size, size)), 0.0
    for v, u in np.ndindex(mask.views):
        values, slopes = shadow.with_slopes(chosen, channels, views_open(mask.views, (v, u)))
        matrix += slopes.T @ slopes
        squares += float(values @ values)
    return matrix / SAMPLED, squares / SAMPLED
