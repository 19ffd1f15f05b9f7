"""Methods of other libraries on the same Psi and frames (extra `peers`), for comparison."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.study.benchmarks.variational import PeerProblem, peer_module
from reconstruction.choices import choose_mu, choose_primal_step, contrast, smooth_guess
from reconstruction.dictionary import Dictionary
from reconstruction.differences import norm_squared
from reconstruction.errors import ReconstructionError
from reconstruction.patches import (
    overlap_add,
    pixel_of_sample,
    regular_grid,
    selected_atoms,
    sense_atoms,
    sense_patches,
)
from reconstruction.result import Reconstruction, Status

STEPS, ATOMS, STRIDE = 100, 20, 5


@dataclass(frozen=True)
class Peer:
    """Another library's method. modules: what must be installed."""

    title: str
    modules: tuple[str, ...]
    solve: Callable[[ImagingMatrix, Frames, Dictionary | None], Reconstruction]
    needs_dictionary: bool = False

    def check(self) -> None:
        """Raise AppError saying how to install what is missing."""
        for module in self.modules:
            peer_module(module)


def _without_unusable(
    psi: ImagingMatrix, frames: Frames
) -> tuple[ImagingMatrix, NDArray[np.float32]]:
    """Return Psi and readings with zeros where a pixel is not usable, which leaves it out."""
    k = psi.binning
    kept = frames.usable.repeat(k, axis=1).repeat(k, axis=2)[:, None, None, :, None, :]
    weights = np.ascontiguousarray(psi.weights * kept.astype(psi.weights.dtype))
    return replace(psi, weights=weights), np.where(frames.usable, frames.readings, 0)


def pyproximal_tv(
    psi: ImagingMatrix, frames: Frames, _: Dictionary | None = None
) -> Reconstruction:
    """Return the light field after 100 steps of pyproximal's primal-dual total variation.

    It takes our weight mu, first picture, steps' sizes and exact data step, but neither opponent
    colours nor over-relaxation: DV_1 as in the paper.
    """
    started = time.perf_counter()
    guess = smooth_guess(psi, frames.readings, frames.usable)
    mu = choose_mu(psi, frames.readings[frames.usable], frames.noise_sigma)
    psi, readings = _without_unusable(psi, frames)
    primal_step = choose_primal_step(contrast(guess), mu, 1.0)
    views = psi.light_field_shape[:2]
    dual_step = 1 / (norm_squared(1, (*views, None, None)) * primal_step)
    start = np.broadcast_to(guess, psi.light_field_shape).astype(np.float32)
    problem = PeerProblem(psi, readings.astype(np.float32), mu)
    found = problem.solve(start, primal_step, STEPS, dual_step)
    return _result("pyproximal-tv", found, STEPS, started)


def sklearn_omp(
    psi: ImagingMatrix, frames: Frames, dictionary: Dictionary | None
) -> Reconstruction:
    """Return the light field from patches coded by scikit-learn's OMP in our dictionary.

    Patches, sensed dictionaries and averaging are ours. It takes 20 atoms a patch, always, as it
    stops at a number or at a residual, and ours at whichever comes first.
    """
    if dictionary is None:
        raise ReconstructionError("sklearn-omp needs a dictionary")
    pursuit = peer_module("sklearn.linear_model").orthogonal_mp
    started = time.perf_counter()
    shape = dictionary.patch_shape[2:4]
    stride = max(STRIDE // psi.binning, 1) * psi.binning
    grid = regular_grid(psi.size, shape, stride, psi.binning)
    pixel = pixel_of_sample(shape, psi.binning)
    pixels = int(pixel.max()) + 1
    total = np.zeros(psi.light_field_shape, dtype=np.float32)
    weight = np.zeros(psi.size, dtype=np.float32)
    share = np.ones((1, *shape), dtype=np.float32)
    count = min(ATOMS, dictionary.size)
    selections: dict[bytes, NDArray[np.float32]] = {}
    with warnings.catch_warnings():
        # Its warnings about degenerate regressors are about duplicate atoms, which do no harm.
        warnings.simplefilter("ignore")
        for corner in grid.corners:
            corners = corner[None]
            sensing = sense_patches(psi, frames.readings, frames.usable, corners, shape)
            sensed = np.zeros((1, dictionary.size, sensing.data.shape[1]), dtype=np.float32)
            for shot in range(psi.shots):
                colours = None if sensing.colours is None else sensing.colours[0, shot]
                key = b"" if colours is None else colours.tobytes()
                if key not in selections:
                    selections[key] = selected_atoms(dictionary.atoms, colours)
                weights = np.ascontiguousarray(sensing.weights[:, shot])
                sense_atoms(selections[key], weights, pixel, pixels, shot, sensed)
            columns = np.asfortranarray(sensed[0].T)
            size = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
            code = pursuit(columns / size, sensing.data[0], n_nonzero_coefs=count) / size
            patch = (code.astype(np.float32) @ dictionary.matrix).reshape(
                1, *dictionary.patch_shape
            )
            overlap_add(corners, patch, share, total, weight)
    total /= np.where(weight > 0, weight, 1)[:, :, None]
    return _result("sklearn-omp", total, ATOMS, started)


def _result(method: str, light_field: NDArray, steps: int, started: float) -> Reconstruction:
    clipped = np.clip(light_field, 0, 1).astype(np.float32)
    seconds = time.perf_counter() - started
    return Reconstruction(
        method, np.ascontiguousarray(clipped), Status.CONVERGED, "", steps, (), seconds, {}
    )


PEERS = {
    "pyproximal-tv": Peer(
        "pyproximal's primal-dual total variation, 100 steps",
        ("pyproximal", "pylops"),
        pyproximal_tv,
    ),
    "sklearn-omp": Peer(
        "scikit-learn's OMP on our dictionary, 20 atoms", ("sklearn",), sklearn_omp, True
    ),
}
