"""Learn a dictionary online: every mini-batch of patches is coded, then the atoms are moved.

Mairal, Bach, Ponce, Sapiro 2009, "Online dictionary learning for sparse coding", algorithms 1 and
2 with mini-batches and forgetting (section 3.4), on codes by orthogonal matching pursuit as K-SVD
has them. The past is kept in two sums, codes x codes and codes x patches; the atoms are moved
towards the best ones for these by one descent over all atoms per mini-batch, in blocks, so that
nearly all of it is matrix products.

Operations of one pass over N patches of n samples in batches of b, K atoms: 6 N K n (correlations
and sums) + (N / b) 3 K^2 n (Gram matrix and descent). Memory: 4 N n + 16 K n + 12 K^2 bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reconstruction.batch_omp import Array, batch_omp
from reconstruction.errors import DictionaryError
from reconstruction.learning import (
    Iteration,
    LearningSettings,
    check_patches,
    doubled_atoms,
    first_state,
    fixed_atoms,
    squared_norms,
)

MINI_BATCH = 1024
_BLOCK = 32
_FORGETTING = 2.0
_UNUSED = 1e-4


@dataclass(frozen=True, eq=False)
class OnlineState:
    """atoms (atom, sample); the sums codes^T codes (atom, atom), codes^T patches (atom, sample)."""

    atoms: Array
    code_sums: Array
    patch_sums: Array
    history: tuple[Iteration, ...] = ()


def online_step(
    state: OnlineState, patches: Array, settings: LearningSettings, fixed: int
) -> OnlineState:
    """Return the state after one pass over all patches, in an order drawn from seed and pass.

    The error of a step is that of every mini-batch when it is coded, so before it is learnt from.
    """
    atoms, code_sums, patch_sums = (
        state.atoms.copy(),
        state.code_sums.copy(),
        state.patch_sums.copy(),
    )
    passes = len(state.history)
    order = np.random.default_rng([settings.seed, passes]).permutation(len(patches))
    batches = np.array_split(order, -(-len(order) // MINI_BATCH))
    total = 0.0
    residuals, errors = patches[:0], squared_norms(patches[:0])
    for i, batch in enumerate(batches):
        rows = patches[batch]
        indices, coefficients = batch_omp(atoms, rows, settings.sparsity)
        codes = np.zeros((len(rows), len(atoms) + 1), np.float32)
        # NO_ATOM is -1: what has no atom goes into the spare last column.
        np.put_along_axis(codes, indices.astype(np.intp), coefficients, axis=1)
        codes = codes[:, :-1]
        residuals = (rows - codes @ atoms).astype(np.float32, copy=False)
        errors = squared_norms(residuals)
        total += float(errors.sum())
        kept = np.float32((1 - 1 / (passes * len(batches) + i + 1)) ** _FORGETTING)
        code_sums *= kept
        code_sums += codes.T @ codes
        patch_sums *= kept
        patch_sums += codes.T @ rows
        _descend(atoms, code_sums, patch_sums, fixed)
    replaced = _replace_atoms(atoms, code_sums, patch_sums, residuals, errors, settings, fixed)
    done = Iteration(passes + 1, float(np.sqrt(total / patches.size)), None, replaced)
    return OnlineState(atoms, code_sums, patch_sums, (*state.history, done))


def learn_online(
    patches: Array,
    patch_shape: tuple[int, ...],
    settings: LearningSettings,
    start: OnlineState | None = None,
    on_step: Callable[[OnlineState], None] | None = None,
) -> OnlineState:
    """Return the state after `settings.iterations` passes in all; arguments as `learn_ksvd`."""
    check_patches(patches, settings, patch_shape)
    if start is None:
        atoms = first_state(patches, settings, patch_shape).atoms
        sums = np.zeros((len(atoms), len(atoms)), np.float32), np.zeros_like(atoms)
        start = OnlineState(atoms, *sums)
    if start.atoms.shape != (settings.atoms, patches.shape[1]):
        raise DictionaryError("the state to resume from is of other patches or settings")
    state, fixed = start, len(fixed_atoms(settings, patch_shape))
    while len(state.history) < settings.iterations:
        state = online_step(state, patches, settings, fixed)
        if on_step is not None:
            on_step(state)
    return state


def _descend(atoms: Array, code_sums: Array, patch_sums: Array, fixed: int) -> None:
    """Move every used atom to its best place for the sums, one after another, in place."""
    used = _uses_enough(code_sums)
    for begin in range(fixed, len(atoms), _BLOCK):
        block = slice(begin, min(begin + _BLOCK, len(atoms)))
        slopes = patch_sums[block] - code_sums[block] @ atoms
        for row, atom in enumerate(range(block.start, block.stop)):
            if not used[atom]:
                continue
            moved = atoms[atom] + slopes[row] / code_sums[atom, atom]
            length = np.linalg.norm(moved)
            if length == 0:
                continue
            moved /= length
            slopes[row + 1 :] -= np.outer(
                code_sums[atom + 1 : block.stop, atom], moved - atoms[atom]
            )
            atoms[atom] = moved


def _uses_enough(code_sums: Array) -> np.ndarray:
    strength = np.diagonal(code_sums)
    return strength > _UNUSED * float(strength.mean())


def _replace_atoms(
    atoms: Array,
    code_sums: Array,
    patch_sums: Array,
    residuals: Array,
    errors: np.ndarray,
    settings: LearningSettings,
    fixed: int,
) -> int:
    """Put residuals of the worst patches in place of unused and doubled atoms; return the count."""
    poor = ~_uses_enough(code_sums)
    poor |= doubled_atoms(atoms, np.diagonal(code_sums), settings.largest_coherence)
    poor[:fixed] = False
    worst = np.argsort(-errors, kind="stable")
    worst = worst[errors[worst] > 0]
    places = np.flatnonzero(poor)[: len(worst)]
    worst = worst[: len(places)]
    atoms[places] = residuals[worst] / np.sqrt(errors[worst])[:, None]
    code_sums[places] = 0
    code_sums[:, places] = 0
    patch_sums[places] = 0
    return len(places)
