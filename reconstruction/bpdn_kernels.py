"""ADMM's inner loop for one patch, the hottest of the sparse solvers.

`atoms` is the sensed dictionary Psi D, one atom a row: (atom, measurement) float32, C-contiguous.
A step passes over it once, correlates every atom with a vector and sums the atoms that stay in use:
4 atoms measurements operations, and that many bytes, which stay in a core's second-level cache
(5,000 atoms of 81 measurements: 1.6 MB). The interpreter's lock is released.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emmc_rig.model.compiling import njit


@njit(forceinline=True, fastmath=True)
def combine(atoms, code, out):
    """Set out (measurement,) to the atoms weighted by the code."""
    out[:] = 0
    for j in range(code.size):
        weight = code[j]
        if weight != 0:
            a = atoms[j]
            for k in range(out.size):
                out[k] += weight * a[k]


@njit(forceinline=True, fastmath=True)
def _values(data, fitted, dual_point, shrink, eta, size):
    """Return the values of eq. 8, |code|_1 being `size`, and of its dual at the shrunk point."""
    fit = 0.0
    dual = 0.0
    for k in range(data.size):
        value = np.float64(data[k])
        fit += (value - fitted[k]) ** 2
        dual += value**2 - (value - np.float64(shrink) * dual_point[k]) ** 2
    return 0.5 * fit + eta * size, 0.5 * dual


@njit(forceinline=True, fastmath=True)
def _soft(value, threshold):
    zero = np.float32(0)
    return max(value - threshold, zero) + min(value + threshold, zero)


@njit(forceinline=True, fastmath=True)
def _splitting_pass(atoms, pull, threshold, relax, state, fitted):
    """Do one step of every atom's state; set fitted to A z; return max |A^T pull|, |z|_1."""
    count, length = atoms.shape
    fitted[:] = 0
    largest = np.float32(0)
    size = np.float32(0)
    for j in range(count):
        a = atoms[j]
        gain = np.float32(0)
        for k in range(length):
            gain += a[k] * pull[k]
        largest = max(largest, abs(gain))
        value = state[j]
        value += relax * (_soft(value, threshold) - value + gain)
        state[j] = value
        kept = _soft(value, threshold)
        if kept != 0:
            size += abs(kept)
            for k in range(length):
                fitted[k] += kept * a[k]
    return largest, size


class SplitRun(NamedTuple):
    """steps: of ADMM on the given atoms. objective: eq. 8's value. gap: relative, to the dual."""

    steps: int
    objective: float
    gap: float


@njit(cache=True, fastmath=True, nogil=True)
def split(atoms, inverse, data, eta, rho, relax, rtol, max_steps, state, dual_point):
    """Run ADMM on `atoms` from its state w (atom,), in place.

    inverse: G = (A A^T + rho 1)^-1. dual_point: (measurement,), set to the last dual point.

    Scaled ADMM with over-relaxation, in Douglas-Rachford's one variable w = x + u per atom:

        z = soft(w, eta / rho),  u = w - z,  q = z - u
        x = q + A^T s,  s = G (I - A q)         (the quadratic step, by Woodbury)
        w = w + relax (x - z)

    A step passes over the atoms once: A q = 2 A z - A w, and A w has a recursion of its own,

        A w = A w + relax (A z - A w + (I - A q) - rho s).

    rho s, scaled down until no atom correlates with it by more than eta, is a dual point at no
    cost.
    """
    length = data.size
    threshold = np.float32(eta / rho)
    fitted = np.zeros(length, np.float32)
    carried = np.zeros(length, np.float32)
    miss = np.empty(length, np.float32)
    pull = np.empty(length, np.float32)
    kept = np.empty(state.size, np.float32)
    for j in range(state.size):
        kept[j] = _soft(state[j], threshold)
    combine(atoms, kept, fitted)
    combine(atoms, state, carried)
    objective = np.inf
    gap = 1.0
    for step in range(max_steps):
        for k in range(length):
            miss[k] = data[k] - 2 * fitted[k] + carried[k]
        for i in range(length):
            total = np.float32(0)
            row = inverse[i]
            for k in range(length):
                total += row[k] * miss[k]
            pull[i] = total
        for k in range(length):
            carried[k] += relax * (fitted[k] - carried[k] + miss[k] - rho * pull[k])
        largest, size = _splitting_pass(atoms, pull, threshold, relax, state, fitted)
        shrink = rho
        if rho * largest > eta:
            shrink = eta / largest
        objective, dual = _values(data, fitted, pull, shrink, eta, size)
        gap = (objective - dual) / objective if objective > 0 else 0.0
        if gap <= rtol or step + 1 == max_steps:
            for k in range(length):
                dual_point[k] = shrink * pull[k]
            return SplitRun(step + 1, objective, gap)
    return SplitRun(max_steps, objective, gap)


@njit(cache=True, fastmath=True, nogil=True)
def split_together(gain, thresholds, relax, states, codes):
    """Do one step of every atom's state, (patch, atom), in place; set codes to soft(state).

    gain: A^T pull, (patch, atom). thresholds: eta / rho of each patch. Returns max |gain| and
    |code|_1 of each patch.
    """
    patches, atoms = gain.shape
    largest, size = np.zeros(patches, np.float32), np.zeros(patches, np.float32)
    for p in range(patches):
        threshold, state, code, pulled = thresholds[p], states[p], codes[p], gain[p]
        most, total = np.float32(0), np.float32(0)
        for j in range(atoms):
            value = state[j]
            value += relax * (_soft(value, threshold) - value + pulled[j])
            state[j] = value
            kept = _soft(value, threshold)
            code[j] = kept
            most = max(most, abs(pulled[j]))
            total += abs(kept)
        largest[p], size[p] = most, total
    return largest, size
