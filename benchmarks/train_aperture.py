"""Makes the camera `learned-aperture`: transmittances learned with the best linear decoder.

    python benchmarks/train_aperture.py --out mine.yaml

A monochrome pixel behind masks in the plane of the lens reads y_s = sum over views of a_sv l_v, the
same for every pixel. Of patches with mean m and covariance C the best linear decoder misses, at the
middle pixel, trace(C) - trace(C A' (A C A' + N)^-1 A C), where N is the variance of readings of the
mean. Patches are of the ray caster's random worlds, which hide surfaces behind others, so the
decoder cannot profit from views that are left out. [34] learns the decoder as a network instead.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from random_worlds import DARKEST, with_pattern, world
from scipy.optimize import minimize
from training_patches import cut_patches

from emmc_rig.errors import ERRORS, AppError
from emmc_rig.formats.cameras import camera_file
from emmc_rig.model.camera import Camera, load_camera, pixel_light
from emmc_rig.model.masks import Parameters
from emmc_rig.model.reading import read_yaml
from emmc_rig.store.folders import new_file
from emmc_rig.store.results import command_line

Array = NDArray[np.float64]
PATCH_PX = 5
PATCHES = 400
"""Of each world."""
STARTS = 3
"""Random ones, besides the camera's own cells; that all end alike says that the least is found."""
ALIKE = 1e-3
"""Relative variation of Psi over its pixels, from which on a mask is not in the lens plane."""


def main() -> None:
    """Train as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--camera", default="learned-aperture", help="a name or a file")
    parser.add_argument("--out", type=Path, default=Path("aperture.yaml"))
    parser.add_argument("--worlds", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smallest", action="store_true", help="one world")
    options = parser.parse_args()
    train(options.camera, options.out, 1 if options.smallest else options.worlds, options.seed)


@dataclass(frozen=True)
class Moments:
    """Of grey patches: mean (view,) of the middle pixel, covariance (view, pixel, view, pixel)."""

    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Aperture:
    """A camera whose masks lie in the plane of the lens, as a linear function of their cells.

    masks: of each shot. shapes: rows and columns of each mask's cells. basis: (shot, cell, view),
    cells of all masks in one row. light: of a pixel, see `pixel_light`.
    """

    camera: Camera
    masks: tuple[str, ...]
    shapes: tuple[tuple[int, int], ...]
    basis: Array
    light: float

    def cells(self) -> Array:
        """Return the transmittances as the camera has them, (cell,)."""
        return np.concatenate([np.ravel(_pattern(self.camera, name).cells) for name in self.masks])

    def split(self, cells: Array) -> dict[str, list[list[float]]]:
        """Return rows of transmittances by mask, rounded to what a file needs."""
        ends = np.cumsum([rows * columns for rows, columns in self.shapes])[:-1]
        parts = zip(self.masks, self.shapes, np.split(cells, ends), strict=True)
        return {name: part.reshape(shape).round(3).tolist() for name, shape, part in parts}

    def error(self, cells: Array, moments: Moments) -> float:
        """Return the mean squared error of the best linear decoder at the middle of a patch."""
        weights = np.einsum("c,scv->sv", cells, self.basis)
        exposures_s = self.camera.exposures_s()
        noise = self.camera.sensor.noise.variance(weights @ moments.mean, exposures_s, self.light)
        covariance, middle = moments.covariance, moments.covariance.shape[1] // 2
        count = len(weights) * covariance.shape[1]
        seen = np.einsum("sv,vpwq,tw->sptq", weights, covariance, weights, optimize=True)
        of_readings = seen.reshape(count, count) + np.diag(np.repeat(noise, covariance.shape[1]))
        with_target = np.einsum("sv,vpw->spw", weights, covariance[:, :, :, middle])
        with_target = with_target.reshape(count, -1)
        explained = np.sum(with_target * np.linalg.solve(of_readings, with_target))
        total = np.einsum("vv->", covariance[:, middle, :, middle])
        return float(total - explained) / len(moments.mean)


def _pattern(camera: Camera, name: str) -> Parameters:
    pattern = camera.masks[name].pattern
    if not isinstance(pattern, Parameters):
        raise AppError(
            f"mask '{name}' is of kind '{pattern.kind}': only cells that are given one by one, "
            "`kind: parameters`, are learned"
        )
    return pattern


def aperture_of(camera: Camera) -> Aperture:
    """Return what can be learned of a camera; raises AppError with the reason where nothing can."""
    if camera.sensor.cfa != "mono":
        raise AppError(
            f"sensor `cfa: {camera.sensor.cfa_name}`: apertures are learned of `cfa: mono`"
        )
    if any(len(camera.shot_masks(shot)) != 1 for shot in range(len(camera.shots))):
        raise AppError("a shot has no mask, or several: apertures are learned of one in each shot")
    masks = tuple(camera.shot_masks(shot)[0] for shot in range(len(camera.shots)))
    if len(set(masks)) != len(masks):
        raise AppError("two shots share a mask: each needs one of its own to be learned")
    shapes = []
    for name in masks:
        cells = np.asarray(_pattern(camera, name).cells, dtype=np.float64)
        if cells.ndim != 2:
            raise AppError(f"mask '{name}' has coloured cells: apertures are learned in greys")
        shapes.append(cells.shape)
    ends = np.cumsum([0, *(rows * columns for rows, columns in shapes)])
    basis = np.zeros((len(masks), ends[-1], math.prod(camera.views)))
    for shot, (name, shape) in enumerate(zip(masks, shapes, strict=True)):

        def passing(cells: Array, shot: int = shot, name: str = name) -> Array:
            """Return the weights (view, pixel) that one shot has with these cells."""
            psi = with_pattern(camera, name, cells=cells.tolist()).psi((PATCH_PX, PATCH_PX))
            return psi.weights[shot].astype(np.float64).sum(axis=3).reshape(-1, PATCH_PX**2)

        whole = passing(np.ones(shape))
        for at in range(shape[0] * shape[1]):
            closed = np.ones(shape)
            closed.flat[at] = 0
            by_cell = whole - passing(closed)
            if np.ptp(by_cell, axis=1).max() > ALIKE * whole.max():
                raise AppError(
                    f"mask '{name}' codes each pixel differently: apertures are learned of masks "
                    f"in the plane of the lens, `distance_mm: {camera.lens.distance_mm:g}`"
                )
            basis[shot, ends[shot] + at] = by_cell.mean(axis=1)
    light = float(pixel_light(camera, (PATCH_PX, PATCH_PX)).flat[0])
    return Aperture(camera, masks, tuple(shapes), basis, light)


def patch_moments(worlds: int, seed: int, views: tuple[int, int]) -> Moments:
    """Return mean and covariance of grey patches of random worlds, mirrored at random."""
    rng = np.random.default_rng([seed, 2])
    patches = []
    for number in range(worlds):
        grey = world(seed, number, views).mean(axis=-1, keepdims=True)
        light = np.exp(rng.uniform(np.log(DARKEST), 0))
        corners = rng.integers(np.array(grey.shape[2:4]) - PATCH_PX + 1, size=(PATCHES, 2))
        symmetries = rng.integers(8 if views[0] == views[1] else 4, size=PATCHES)
        cut = cut_patches(grey, corners, symmetries, (PATCH_PX, PATCH_PX))
        patches.append(light * cut.reshape(PATCHES, math.prod(views), PATCH_PX**2))
    every = np.concatenate(patches).astype(np.float64)
    mean = every.mean(axis=0)
    flat = (every - mean).reshape(len(every), -1)
    covariance = (flat.T @ flat / len(flat)).reshape(2 * mean.shape)
    return Moments(mean[:, PATCH_PX**2 // 2], covariance)


def learned_cells(aperture: Aperture, moments: Moments, seed: int) -> tuple[Array, list[float]]:
    """Return the cells of least error, and the error that every start ends at, the best first."""
    rng = np.random.default_rng([seed, 3])
    own = np.clip(aperture.cells(), 0, 1)
    ends = []
    for start in (own, *(rng.uniform(0, 1, own.size) for _ in range(STARTS))):
        # The logarithm, for errors of 1e-4 would be below the minimiser's tolerance.
        least = minimize(
            lambda cells: math.log(aperture.error(cells, moments)),
            start,
            method="L-BFGS-B",
            bounds=[(0, 1)] * own.size,
        )
        ends.append((math.exp(least.fun), least.x))
    ends.sort(key=lambda end: end[0])
    return ends[0][1], [error for error, _ in ends]


def train(camera_name: str, out: Path, worlds: int, seed: int) -> None:
    """Learn a camera's aperture and write the camera with it to `out`.

    Raises AppError for cameras of which nothing can be learned and files in the way, CameraError.
    """
    if out.suffix not in (".yaml", ".yml"):
        raise AppError(f"--out {out}: a camera's file ends in .yaml")
    if out.exists():
        raise AppError(f"{out}: exists already; choose another name")
    path = camera_file(camera_name)
    camera = load_camera(path)
    aperture = aperture_of(camera)
    moments = patch_moments(worlds, seed, camera.views)
    cells, errors = learned_cells(aperture, moments, seed)
    own = aperture.error(aperture.cells(), moments)
    before, after, *others = (-10 * math.log10(error) for error in (own, *errors))
    text: Any = read_yaml(path, AppError)
    for name, rows in aperture.split(cells).items():
        text["masks"][name]["pattern"]["cells"] = rows
    with new_file(out) as written:
        written.write_text(
            f"# Cells learned by: {command_line()}\n"
            + yaml.safe_dump(text, sort_keys=False, default_flow_style=None),
            encoding="utf-8",
        )
    print(
        f"wrote {out}: the best linear decoder makes {after:.2f} dB, {before:.2f} dB before; from "
        f"other starts {', '.join(f'{end:.2f}' for end in others)}"
    )


if __name__ == "__main__":
    try:
        main()
    except ERRORS as fault:
        sys.exit(str(fault))
