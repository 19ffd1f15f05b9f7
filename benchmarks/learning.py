"""Learn a dictionary from patches by K-SVD: sparse coding and atom updates, one step at a time.

Aharon, Elad, Bruckstein 2006, "K-SVD: an algorithm for designing overcomplete dictionaries for
sparse representation", with the batch pursuit and the rank-1 updates by alternating projections
of Rubinstein, Zibulevsky, Elad 2008. Patches keep their mean, as they must describe measurements.
With `flat_atoms` the first atoms are flat, one per opponent colour, and never change.

Operations of one step for N patches of n samples, K atoms, k of them per code: 2 N K n + K^2 n +
N K (k^2 + 3 k) for the pursuits, 4 N k n for the residuals, 4 (p + 1) N k n for the updates with p
power iterations. For N = 30,000, n = 6,075, K = 5,120, k = 10, p = 2: 1.9 + 0.16 + 0.02, 0.007 and
0.02 TFLOP, nearly all of it matrix products. Memory: patches and residuals 4 N n bytes each, two
dictionaries 4 K n, the Gram matrix 4 K^2: 1.8 GB there. Bytes of the updates: 8 N k n (15 GB).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from batch_omp import NO_ATOM, Array, batch_omp
from numpy.typing import NDArray
from pydantic import Field
from scipy.sparse import csr_array

from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.errors import DictionaryError

_ROWS_AT_ONCE = 2048


class LearningSettings(Settings):
    """Settings of a dictionary's training."""

    atoms: int = Field(default=1024, ge=1)
    sparsity: int = Field(default=8, ge=1, description="atoms per patch at most")
    iterations: int = Field(default=15, ge=1)
    flat_atoms: bool = Field(default=True, description="keep one flat atom per opponent colour")
    power_iterations: int = Field(
        default=2, ge=1, description="alternating projections of each atom's rank-1 update"
    )
    least_use: float = Field(
        default=0.1, ge=0, lt=1, description="atoms used less, of the mean use, are replaced"
    )
    largest_coherence: float = Field(
        default=0.98, gt=0, le=1, description="of two atoms nearer than this one is replaced"
    )
    seed: int = Field(default=0, ge=0)


@dataclass(frozen=True)
class Iteration:
    """One step: atoms put anew, then errors per sample after coding and the atoms' update.

    The errors are root mean squares; updated_rmse is None where the method does not evaluate it.
    """

    step: int
    replaced: int
    coded_rmse: float
    updated_rmse: float | None


@dataclass(frozen=True, eq=False)
class LearningState:
    """All that a step needs and changes: what a checkpoint holds.

    atoms: (atom, sample). indices, coefficients: (patch, k), the codes; NO_ATOM where unused.
    """

    atoms: Array
    indices: NDArray[np.int32]
    coefficients: Array
    history: tuple[Iteration, ...] = ()


def flat_atoms(patch_shape: tuple[int, ...]) -> Array:
    """Return constant atoms (colour, sample), one per opponent colour, of unit norm."""
    colours = patch_shape[-1]
    mixes = OPPONENT if colours == 3 else np.eye(colours)
    atoms = np.broadcast_to(mixes[:, None], (colours, int(np.prod(patch_shape[:-1])), colours))
    atoms = atoms.reshape(colours, -1)
    return (atoms / np.linalg.norm(atoms, axis=1, keepdims=True)).astype(np.float32)


def fixed_atoms(settings: LearningSettings, patch_shape: tuple[int, ...]) -> Array:
    """Return the atoms that training leaves alone, none of them without `flat_atoms`."""
    flat = flat_atoms(patch_shape)
    return flat if settings.flat_atoms else flat[:0]


def first_state(
    patches: Array, settings: LearningSettings, patch_shape: tuple[int, ...]
) -> LearningState:
    """Return the fixed atoms and random patches less their share of them, and empty codes.

    patches: (patch, sample). Raises DictionaryError for patches too few, of another size, not
    finite, or with too few that differ from the fixed atoms.
    """
    check_patches(patches, settings, patch_shape)
    fixed = fixed_atoms(settings, patch_shape)
    wanted = settings.atoms - len(fixed)
    order = np.random.default_rng(settings.seed).permutation(len(patches))
    chosen = np.empty((wanted, patches.shape[1]), np.float32)
    filled = 0
    for start in range(0, len(order), _ROWS_AT_ONCE):
        rows = patches[order[start : start + _ROWS_AT_ONCE]]
        left = rows - (rows @ fixed.T) @ fixed
        norms = np.linalg.norm(left, axis=1)
        good = np.flatnonzero(norms > 1e-3 * np.linalg.norm(rows, axis=1))[: wanted - filled]
        chosen[filled : filled + len(good)] = left[good] / norms[good, None]
        filled += len(good)
        if filled == wanted:
            break
    if filled < wanted:
        raise DictionaryError(
            f"only {filled} of {len(patches)} patches are not flat, too few to start "
            f"{settings.atoms} atoms: give more patches or ask for fewer atoms"
        )
    codes = len(patches), settings.sparsity
    return LearningState(
        np.concatenate([fixed, chosen]), np.full(codes, NO_ATOM, np.int32), np.zeros(codes, "f4")
    )


def ksvd_step(
    state: LearningState, patches: Array, settings: LearningSettings, fixed: int
) -> LearningState:
    """Return the state after replacements, sparse coding, and the update of every atom.

    fixed: how many of the first atoms stay. A patch keeps its old code where the new one is no
    better, so that the error never rises in the coding; it never rises in the update either. A
    replaced atom leaves the codes that used it, so only a replacement may raise the error.
    """
    state, replaced = _replace_atoms(state, patches, settings, fixed)
    indices, coefficients = batch_omp(state.atoms, patches, settings.sparsity)
    residuals = np.empty_like(patches)
    errors = _keep_better(state, patches, indices, coefficients, residuals)
    coded_rmse = float(np.sqrt(errors.sum() / patches.size))
    atoms = state.atoms.copy()
    _update_atoms(atoms, indices, coefficients, residuals, settings.power_iterations, fixed)
    updated_rmse = float(np.sqrt(squared_norms(residuals).sum() / patches.size))
    done = Iteration(len(state.history) + 1, replaced, coded_rmse, updated_rmse)
    return LearningState(atoms, indices, coefficients, (*state.history, done))


def learn_ksvd(
    patches: Array,
    patch_shape: tuple[int, ...],
    settings: LearningSettings,
    start: LearningState | None = None,
    on_step: Callable[[LearningState], None] | None = None,
) -> LearningState:
    """Return the state after `settings.iterations` steps in all.

    Args:
        patches: (patch, sample) float32, samples in the order of `patch_shape`.
        patch_shape: (v, u, y, x, c).
        settings: what to learn.
        start: where an earlier run of the same patches and settings stopped; the result is then
            the one of an undisturbed run.
        on_step: called with the state after every step.

    Raises:
        DictionaryError: as `first_state`; or a `start` of other patches or settings.
    """
    check_patches(patches, settings, patch_shape)
    state = start or first_state(patches, settings, patch_shape)
    shapes = (settings.atoms, patches.shape[1]), (len(patches), settings.sparsity)
    if (state.atoms.shape, state.indices.shape) != shapes:
        raise DictionaryError("the state to resume from is of other patches or settings")
    fixed = len(fixed_atoms(settings, patch_shape))
    while len(state.history) < settings.iterations:
        state = ksvd_step(state, patches, settings, fixed)
        if on_step is not None:
            on_step(state)
    return state


def check_patches(patches: Array, settings: LearningSettings, patch_shape: tuple[int, ...]) -> None:
    """Raise DictionaryError for patches that cannot be learnt from with these settings."""
    if patches.ndim != 2 or patches.shape[1] != np.prod(patch_shape):
        raise DictionaryError(
            f"training patches of shape {patches.shape}: needs (patch, {np.prod(patch_shape)})"
        )
    if patches.dtype != np.float32:
        raise DictionaryError(f"training patches are {patches.dtype}: needs float32")
    if len(patches) < settings.atoms:
        raise DictionaryError(
            f"{len(patches)} patches for {settings.atoms} atoms: give at least as many patches"
        )
    if settings.sparsity > settings.atoms:
        raise DictionaryError(f"a sparsity of {settings.sparsity}, but {settings.atoms} atoms")
    if settings.flat_atoms and settings.atoms <= patch_shape[-1]:
        raise DictionaryError(f"{settings.atoms} atoms: more than the {patch_shape[-1]} flat ones")
    if not np.isfinite(squared_norms(patches)).all():
        raise DictionaryError("training patches hold values that are not finite: leave them out")


def _parts(count: int) -> list[slice]:
    """Return slices over `count` patches, short enough for one copy in memory beside them."""
    return [slice(first, first + _ROWS_AT_ONCE) for first in range(0, count, _ROWS_AT_ONCE)]


def _residuals(atoms: Array, patches: Array, indices: NDArray, coefficients: Array) -> Array:
    """Return patches less their codes (patch, sample)."""
    starts = np.arange(len(indices) + 1) * indices.shape[1]
    columns = np.where(indices >= 0, indices, 0).ravel()
    weights = np.where(indices >= 0, coefficients, np.float32(0)).ravel()
    codes = csr_array((weights, columns, starts), shape=(len(indices), len(atoms)))
    return patches - codes @ atoms


def _keep_better(
    state: LearningState,
    patches: Array,
    indices: NDArray[np.int32],
    coefficients: Array,
    residuals: Array,
) -> NDArray[np.float64]:
    """Put a patch's old code back where the new one is no better; set residuals, return squares."""
    errors = np.empty(len(patches))
    for part in _parts(len(patches)):
        new = _residuals(state.atoms, patches[part], indices[part], coefficients[part])
        old_code = state.indices[part], state.coefficients[part]
        old = _residuals(state.atoms, patches[part], *old_code)
        after, before = squared_norms(new), squared_norms(old)
        worse = before <= after
        residuals[part] = np.where(worse[:, None], old, new)
        indices[part][worse], coefficients[part][worse] = (code[worse] for code in old_code)
        errors[part] = np.minimum(before, after)
    return errors


def squared_norms(rows: Array) -> NDArray[np.float64]:
    """Return the squared norm of every row, summed in float64 in small parts."""
    parts = [
        np.einsum("ij,ij->i", part, part, dtype=np.float64)
        for part in np.array_split(rows, max(1, len(rows) // _ROWS_AT_ONCE))
    ]
    return np.concatenate(parts)


def uses_of_atoms(
    indices: NDArray[np.int32], atoms: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the places (flat, in `indices`) of every atom's uses, and where each atom's begin."""
    flat = indices.ravel()
    order = np.argsort(flat, kind="stable")
    return order, np.searchsorted(flat[order], np.arange(atoms + 1))


def _update_atoms(
    atoms: Array,
    indices: NDArray[np.int32],
    coefficients: Array,
    residuals: Array,
    power_iterations: int,
    fixed: int,
) -> None:
    """Fit every atom and its coefficients to the residuals of its patches, in place.

    With residuals E of an atom's patches (others' and its own share removed), the best atom is
    the leading right singular vector of E + g d^T. It is found by alternating projections from
    the present atom, each the best for the other's value, so the error cannot rise.
    """
    order, begins = uses_of_atoms(indices, len(atoms))
    weights = coefficients.reshape(-1)
    for atom in range(fixed, len(atoms)):
        places = order[begins[atom] : begins[atom + 1]]
        users = places // indices.shape[1]
        rows, old_atom, old_weights = residuals[users], atoms[atom].copy(), weights[places]
        new_atom, new_weights = old_atom, old_weights
        for _ in range(power_iterations):
            total = (new_weights @ old_weights) * old_atom + new_weights @ rows
            length = np.linalg.norm(total)
            if length == 0:  # also where no patch uses the atom
                break
            new_atom = total / length
            new_weights = (old_atom @ new_atom) * old_weights + rows @ new_atom
        change = np.stack([old_atom, -new_atom])
        residuals[users] = rows + np.stack([old_weights, new_weights]).T @ change
        atoms[atom], weights[places] = new_atom, new_weights


def _replace_atoms(
    state: LearningState, patches: Array, settings: LearningSettings, fixed: int
) -> tuple[LearningState, int]:
    """Put what is left of the worst patches in place of poor atoms; return how many."""
    used = state.indices >= 0
    if not used.any():
        return state, 0
    uses = np.bincount(state.indices[used], minlength=len(state.atoms))
    poor = poor_atoms(state.atoms, uses, settings, fixed)
    if not poor.size:
        return state, 0
    codes = state.indices, state.coefficients
    errors = np.concatenate(
        [
            squared_norms(_residuals(state.atoms, patches[part], *(code[part] for code in codes)))
            for part in _parts(len(patches))
        ]
    )
    worst = np.argsort(-errors, kind="stable")[: len(poor)]
    worst = worst[errors[worst] > 0]
    poor = poor[: len(worst)]
    atoms = state.atoms.copy()
    for place, row in zip(poor, worst, strict=True):
        taken = used[row]
        left = (
            patches[row] - state.coefficients[row, taken] @ state.atoms[state.indices[row, taken]]
        )
        atoms[place] = left / np.linalg.norm(left)
    gone = np.isin(state.indices, poor)
    indices = np.where(gone, np.int32(NO_ATOM), state.indices)
    coefficients = np.where(gone, np.float32(0), state.coefficients)
    return LearningState(atoms, indices, coefficients, state.history), len(poor)


def poor_atoms(
    atoms: Array, uses: NDArray[Any], settings: LearningSettings, fixed: int
) -> NDArray[np.intp]:
    """Return the places of atoms hardly used, and of those a more used one makes superfluous."""
    poor = uses < settings.least_use * uses.mean()
    poor |= doubled_atoms(atoms, uses, settings.largest_coherence)
    poor[:fixed] = False
    return np.flatnonzero(poor)


def doubled_atoms(atoms: Array, uses: NDArray[Any], largest_coherence: float) -> NDArray[np.bool_]:
    """Say of every atom whether a more used one (of equals the earlier) is nearly the same."""
    rank = np.empty(len(atoms), np.int64)
    rank[np.argsort(-uses, kind="stable")] = np.arange(len(atoms))
    doubled = np.zeros(len(atoms), bool)
    for start in range(0, len(atoms), _ROWS_AT_ONCE):
        part = slice(start, start + _ROWS_AT_ONCE)
        near = np.abs(atoms[part] @ atoms.T) > largest_coherence
        doubled[part] = (near & (rank[None, :] < rank[part, None])).any(axis=1)
    return doubled
