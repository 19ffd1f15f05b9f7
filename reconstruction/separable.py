"""An ensemble of separable dictionaries, learnt: every patch is coded in the best of a few pairs.

A patch is a matrix, views x (pixels and colours). A pair of orthonormal bases V, W turns it into
V^T patch W, of which the `sparsity` largest values are kept; every patch belongs to the pair that
leaves the least error, and every pair is fitted to its patches, V and W in turn, each by an
orthogonal Procrustes problem (Miandji, Kronander, Unger 2013, "Learning based compression of
surface light fields for real-time rendering of global illumination scenes"; the paper's [31] uses
such an ensemble of 2D separable dictionaries). Each of the three never raises the error.

Operations of one step for N patches of a x s (a views, s samples per view) and m pairs:
2 N m a s (a + s) to code, 2 N a s (a + s) to fit, m singular value decompositions of size s.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.compiling import njit
from emmc_rig.model.settings import Settings
from reconstruction.batch_omp import Array, bands
from reconstruction.dictionary import Dictionary
from reconstruction.errors import DictionaryError
from reconstruction.learning import Iteration, squared_norms

_AT_ONCE = 1024
_START_PATCHES = 200


class SeparableSettings(Settings):
    """Settings of an ensemble's training."""

    atoms: int = Field(default=1024, ge=1, description="the most used products of all pairs")
    pairs: int = Field(default=8, ge=1)
    sparsity: int = Field(default=8, ge=1, description="values kept per patch")
    iterations: int = Field(default=15, ge=1)
    seed: int = Field(default=0, ge=0)


@dataclass(frozen=True, eq=False)
class SeparableState:
    """view_bases (pair, view, column), sample_bases (pair, sample, column), orthonormal."""

    view_bases: Array
    sample_bases: Array
    history: tuple[Iteration, ...] = ()


@njit(cache=True, nogil=True)
def _keep_largest_rows(values, count, energies):
    """Set all but the `count` largest values of every row to 0; set energies to what is left."""
    largest = np.empty(count, values.dtype)
    for row in range(len(values)):
        line = values[row]
        largest[:] = -1
        for i in range(line.size):
            size = abs(line[i])
            if size > largest[0]:
                # Ascending, so that the first is the one to beat.
                place = 0
                while place + 1 < count and largest[place + 1] < size:
                    largest[place] = largest[place + 1]
                    place += 1
                largest[place] = size
        least, total = largest[0], 0.0
        equal = np.sum(largest == least)
        for i in range(line.size):
            size = abs(line[i])
            if size > least or (size == least and equal > 0):
                equal -= size == least
                total += np.float64(line[i]) * line[i]
            else:
                line[i] = 0
        energies[row] = total


def _codes(
    state: SeparableState, patches: Array, count: int
) -> tuple[NDArray[np.intp], Array, NDArray[np.float64]]:
    """Return every patch's best pair, its kept values (patch, view column, sample column), energy.

    patches: (patch, view, sample).
    """
    views, samples = patches.shape[1:]
    rows = patches.reshape(-1, samples)
    best = np.full(len(patches), -1.0)
    member = np.zeros(len(patches), np.intp)
    codes = np.empty_like(patches)
    for pair in range(len(state.view_bases)):
        turned = (rows @ state.sample_bases[pair]).reshape(patches.shape)
        turned = np.ascontiguousarray(state.view_bases[pair].T @ turned).reshape(len(patches), -1)
        energy = np.empty(len(patches))

        def keep(band: tuple[int, int], turned: Array = turned, energy: NDArray = energy) -> None:
            _keep_largest_rows(turned[slice(*band)], count, energy[slice(*band)])

        with ThreadPoolExecutor(get_num_threads()) as pool:
            list(pool.map(keep, bands(len(patches))))
        better = energy > best
        best[better], member[better] = energy[better], pair
        codes[better] = turned[better].reshape(-1, views, samples)
    return member, codes, best


def _nearest_orthonormal(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    left, _, right = np.linalg.svd(matrix)
    return left @ right


def separable_step(
    state: SeparableState, patches: Array, settings: SeparableSettings
) -> SeparableState:
    """Return the state after coding every patch and fitting every pair.

    patches: (patch, view, sample).
    """
    pairs, views, samples = *state.view_bases.shape[:2], state.sample_bases.shape[1]
    sample_fits = np.zeros((pairs, samples, samples))
    members, kept = np.empty(len(patches), np.intp), np.empty_like(patches)
    error = 0.0
    for start in range(0, len(patches), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        members[part], kept[part], energy = _codes(state, patches[part], settings.sparsity)
        for pair in range(pairs):
            mine = start + np.flatnonzero(members[part] == pair)
            seen = (state.view_bases[pair].T @ patches[mine]).reshape(-1, samples)
            sample_fits[pair] += seen.T @ kept[mine].reshape(-1, samples)
        error += float(squared_norms(patches[part].reshape(-1, views * samples)).sum())
        error -= float(energy.sum())
    view_bases, sample_bases = state.view_bases.copy(), state.sample_bases.copy()
    for pair in range(pairs):
        if not (members == pair).any():
            continue
        sample_bases[pair] = _nearest_orthonormal(sample_fits[pair])
        fit = np.zeros((views, views))
        mine = np.flatnonzero(members == pair)
        for start in range(0, len(mine), _AT_ONCE):
            some = mine[start : start + _AT_ONCE]
            seen = (patches[some] @ sample_bases[pair]).transpose(1, 0, 2).reshape(views, -1)
            fit += seen @ kept[some].transpose(1, 0, 2).reshape(views, -1).T
        view_bases[pair] = _nearest_orthonormal(fit)
    rmse = float(np.sqrt(max(error, 0.0) / patches.size))
    done = Iteration(len(state.history) + 1, 0, rmse, None)
    return SeparableState(view_bases, sample_bases, (*state.history, done))


def learn_separable(
    patches: Array,
    patch_shape: tuple[int, ...],
    settings: SeparableSettings,
    start: SeparableState | None = None,
    on_step: Callable[[SeparableState], None] | None = None,
) -> SeparableState:
    """Return the state after `settings.iterations` steps in all; arguments as `learn_ksvd`.

    Raises DictionaryError for patches of another size, too few, or not finite.
    """
    matrices = _matrices(patches, patch_shape, settings)
    if settings.sparsity > patches.shape[1]:
        raise DictionaryError(
            f"a sparsity of {settings.sparsity}, but patches of {patches.shape[1]} samples"
        )
    state = start or _first_state(matrices, settings)
    if (len(state.view_bases), state.sample_bases.shape[1]) != (settings.pairs, matrices.shape[2]):
        raise DictionaryError("the state to resume from is of other patches or settings")
    while len(state.history) < settings.iterations:
        state = separable_step(state, matrices, settings)
        if on_step is not None:
            on_step(state)
    return state


def separable_dictionary(
    state: SeparableState,
    patches: Array,
    patch_shape: tuple[int, ...],
    settings: SeparableSettings,
    provenance: str = "",
) -> Dictionary:
    """Return the products of a view and a sample column that hold most energy of the patches."""
    matrices = _matrices(patches, patch_shape, settings)
    energy = np.zeros((len(state.view_bases), *matrices.shape[1:]))
    for start in range(0, len(matrices), _AT_ONCE):
        members, kept, _ = _codes(state, matrices[start : start + _AT_ONCE], settings.sparsity)
        for pair in range(len(energy)):
            energy[pair] += np.square(kept[members == pair]).sum(axis=0)
    order = np.argsort(-energy, axis=None, kind="stable")[: settings.atoms]
    order = order[energy.ravel()[order] > 0]
    pair, view, sample = np.unravel_index(order, energy.shape)
    atoms = np.einsum(
        "av,as->avs", state.view_bases[pair, :, view], state.sample_bases[pair, :, sample]
    )
    return Dictionary.normalised(atoms.reshape(-1, *patch_shape), "separable", provenance)


def _matrices(patches: Array, patch_shape: tuple[int, ...], settings: SeparableSettings) -> Array:
    views = patch_shape[0] * patch_shape[1]
    if patches.ndim != 2 or patches.shape[1] != np.prod(patch_shape):
        raise DictionaryError(
            f"training patches of shape {patches.shape}: needs (patch, {np.prod(patch_shape)})"
        )
    if len(patches) < settings.pairs:
        raise DictionaryError(
            f"{len(patches)} patches for {settings.pairs} pairs: give at least as many patches"
        )
    if not np.isfinite(squared_norms(patches)).all():
        raise DictionaryError("training patches hold values that are not finite: leave them out")
    return patches.reshape(len(patches), views, -1)


def _first_state(matrices: Array, settings: SeparableSettings) -> SeparableState:
    """Return the principal axes of a few random patches for every pair."""
    rng = np.random.default_rng(settings.seed)
    views, samples = matrices.shape[1:]
    view_bases = np.empty((settings.pairs, views, views), np.float32)
    sample_bases = np.empty((settings.pairs, samples, samples), np.float32)
    for pair in range(settings.pairs):
        some = matrices[rng.permutation(len(matrices))[:_START_PATCHES]].astype(np.float64)
        rows = some.reshape(-1, samples)
        columns = some.transpose(1, 0, 2).reshape(views, -1)
        view_bases[pair] = np.linalg.svd(columns @ columns.T)[0]
        sample_bases[pair] = np.linalg.svd(rows.T @ rows)[0]
    return SeparableState(view_bases, sample_bases)
