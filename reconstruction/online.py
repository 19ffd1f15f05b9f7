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
    first_state,
    fixed_atoms,
    poor_atoms,
    squared_norms,
)

_SMALLEST_BATCH = 256
_BLOCK = 32
_FORGETTING = 5.0
_UNUSED = 1e-6


@dataclass(frozen=True, eq=False)
class OnlineState:
    """atoms (atom, sample), and sums over the past, the recent counting more.

    code_sums: codes^T codes (atom, atom). patch_sums: codes^T patches (atom, sample). uses: (atom,)
    """

    atoms: Array
    code_sums: Array
    patch_sums: Array
    uses: Array
    history: tuple[Iteration, ...] = ()


def mini_batch(atoms: int) -> int:
    """Return how many patches are coded at once: more where moving the atoms costs more."""
    return max(_SMALLEST_BATCH, atoms // 4)


def online_step(
    state: OnlineState, patches: Array, settings: LearningSettings, fixed: int
) -> OnlineState:
    """Return the state after one pass over all patches, in an order drawn from seed and pass.

    The error of a step is that of every mini-batch when it is coded, so before it is learnt from.
    """
    atoms, uses = state.atoms.copy(), state.uses.copy()
    code_sums, patch_sums = state.code_sums.copy(), state.patch_sums.copy()
    passes = len(state.history)
    order = np.random.default_rng([settings.seed, passes]).permutation(len(patches))
    batches = np.array_split(order, -(-len(order) // mini_batch(settings.atoms)))
    total, replaced = 0.0, 0
    for i, batch in enumerate(batches):
        rows = patches[batch]
        indices, coefficients = batch_omp(atoms, rows, settings.sparsity)
        codes = np.zeros((len(rows), len(atoms) + 1), np.float32)
        # NO_ATOM is -1: what has no atom goes into the spare last column.
        np.put_along_axis(codes, indices.astype(np.intp), coefficients, axis=1)
        codes = codes[:, :-1]
        left = (rows - codes @ atoms).astype(np.float32, copy=False)
        errors = squared_norms(left)
        total += float(errors.sum())
        kept = np.float32((1 - 1 / (passes * len(batches) + i + 1)) ** _FORGETTING)
        code_sums *= kept
        patch_sums *= kept
        uses *= kept
        if passes and i == 0:
            poor = poor_atoms(atoms, uses, settings, fixed)
            worst = np.argsort(-errors, kind="stable")[: len(poor)]
            worst = worst[errors[worst] > 0]
            poor = poor[: len(worst)]
            replaced = len(poor)
            atoms[poor] = left[worst] / np.sqrt(errors[worst])[:, None]
            for gone in (code_sums, code_sums.T, patch_sums, uses, codes.T):
                gone[poor] = 0
        code_sums += codes.T @ codes
        patch_sums += codes.T @ rows
        uses += np.count_nonzero(codes, axis=0)
        _descend(atoms, code_sums, patch_sums, fixed)
    done = Iteration(passes + 1, replaced, float(np.sqrt(total / patches.size)), None)
    return OnlineState(atoms, code_sums, patch_sums, uses, (*state.history, done))


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
        count = len(atoms)
        code_sums, uses = np.zeros((count, count), np.float32), np.zeros(count, np.float32)
        start = OnlineState(atoms, code_sums, np.zeros_like(atoms), uses)
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
    strengths = np.diagonal(code_sums)
    used = strengths > _UNUSED * float(strengths.mean())
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
