"""Draw the pictures of docs/adaptive.md: `python docs/pictures/draw_adaptive.py`, half a minute.

One coded frame of a built-in scene, and what the default method makes of it, step by step.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

import emmc_rig as emmc
from emmc_rig.reconstruction.adaptive.fits import averaged, fitted_models
from emmc_rig.reconstruction.adaptive.search import Volume, moments_per_pixel
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.adaptive.survey import checked, surveyed
from emmc_rig.reconstruction.adaptive.uncertainty import disparity_deviation

SCENE, CAMERA, SIZE = "deep-occlusions", "scenario-ii-cfa", (96, 128)
MODELS = ("surfaces, looser fit", "surfaces, closer fit", "no surfaces (total variation)")
INCH_WIDE, DOTS_PER_INCH = 7.0, 150

Array = NDArray[np.floating]


def _pictures(titles: tuple[str, ...]) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(INCH_WIDE, 4.6 / len(titles) + 0.4), layout="constrained")
    axes = [figure.add_subplot(1, len(titles), number + 1) for number in range(len(titles))]
    for axis, title in zip(axes, titles, strict=True):
        axis.set(xticks=[], yticks=[])
        axis.set_title(title, fontsize=11)
    return figure, axes


def _map(figure: Figure, axes: Axes, values: Array, unit: str, **how: object) -> None:
    figure.colorbar(axes.imshow(values, **how), ax=axes, label=unit, shrink=0.8)  # pyright: ignore


def _patches(volume: Volume) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return row and column of a patch of median decisiveness, and of the least decisive."""
    finite = np.where(np.isfinite(volume.evidence), volume.evidence, np.nan)
    sure = np.nanmax(finite, axis=-1) - np.nanmean(finite, axis=-1)
    order = np.argsort(sure, axis=None)
    middle = order[np.searchsorted(np.sort(sure, axis=None), np.median(sure[volume.decisive]))]
    usual, least = (np.unravel_index(at, sure.shape) for at in (middle, order[0]))
    return (int(usual[0]), int(usual[1])), (int(least[0]), int(least[1]))


def _evidence(volume: Volume, truth: Array) -> Figure:
    figure = Figure(figsize=(INCH_WIDE, 2.9), layout="constrained")
    for number, (patch, title) in enumerate(
        zip(_patches(volume), ("a patch with texture", "a patch without"), strict=True)
    ):
        axes = figure.add_subplot(1, 2, number + 1)
        evidence = volume.evidence[patch]
        known = np.isfinite(evidence)
        at = tuple(round(float(volume.centres[axis][patch[axis]])) for axis in (0, 1))
        axes.plot(volume.disparities[known], evidence[known] - evidence[known].max(), lw=2)
        axes.axvline(truth[at], color="C3", ls="--", label="true disparity")
        axes.set(xlabel="disparity, pixels per view", title=title, ylim=(-25, 2))
        if not number:
            axes.set_ylabel("log-likelihood, 0 at the best")
        axes.legend(loc="lower right", fontsize=9)
    return figure


def figures(size: tuple[int, int] = SIZE) -> dict[str, Figure]:
    """Return the page's pictures by name, of a capture of so many rows and columns."""
    camera, scene = emmc.camera(CAMERA), emmc.scene(SCENE, size=size)
    psi, truth = camera.psi(scene.size), np.asarray(scene)
    frames = camera.expose(scene, seed=0, psi=psi)
    settings = AdaptiveSettings()
    given = checked(psi, frames.of_one_deviation())
    survey = surveyed(given, settings, None, lambda step: None)
    fits = fitted_models(survey, settings, lambda step: None)
    believed = moments_per_pixel(survey.volume, psi.size, psi.binning)
    disparity = fits.scene.centre
    mean = averaged(survey, fits, np.sqrt(believed.variance))
    assert mean.sigma is not None
    assert scene.disparity_px is not None

    begun, (left, right) = _pictures(
        ("the frame: one number a pixel", "the centre view, at the end")
    )
    left.imshow(frames.readings[0], cmap="gray")
    right.imshow(np.clip(mean.light_field[2, 2], 0, 1) ** (1 / 2.2))

    depth, (left, right) = _pictures(("disparity found", "how uncertain it is"))
    _map(depth, left, disparity, "pixels per view")
    unsure = disparity_deviation(disparity, [believed])
    _map(depth, right, unsure, "pixels per view", cmap="magma", vmax=1)

    chosen, axes = _pictures(MODELS)
    for axis, share in zip(axes, mean.shares, strict=True):
        shown = axis.imshow(share, cmap="viridis", vmin=0, vmax=1)
    chosen.colorbar(shown, ax=axes, label="share of the mean", shrink=0.7)

    sure, (left, right) = _pictures(("deviation stated", "true error"))
    error = np.sqrt(np.square(mean.light_field[2, 2] - truth[2, 2]).mean(axis=-1))
    for item, values in ((left, mean.sigma[2, 2]), (right, error)):
        _map(sure, item, values, "of white", cmap="magma", vmin=0, vmax=0.2)
    return {
        "frame": begun, "evidence": _evidence(survey.volume, scene.disparity_px),
        "disparity": depth, "models": chosen, "deviation": sure,
    }  # fmt: skip


if __name__ == "__main__":
    for name, figure in figures().items():
        path = Path(__file__).parent / f"adaptive-{name}.webp"
        figure.savefig(path, dpi=DOTS_PER_INCH)
