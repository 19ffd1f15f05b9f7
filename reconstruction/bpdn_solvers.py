"""The sparse solvers for one patch, as their papers write them; all but ADMM's inner loop in NumPy.

`atoms` is A^T, the sensed dictionary, one atom a row: (atom, measurement) float32; data, pull and
residuals are (measurement,), codes (atom,). Each step of a solver correlates the atoms with a
vector and sums those in use: 4 atoms measurements operations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emmc_rig.reconstruction import bpdn_kernels as kernels

Array = NDArray[np.floating]
Array32 = NDArray[np.float32]
FIRST_STEPS = 20
"""Of ADMM on all atoms, which find the working set."""
INNER_SHARE = 0.5
"""Of the tolerance, to which a working set is solved."""
DEPENDENT = 1e-3
"""An atom adds nothing if chosen atoms explain all but this share of its norm."""
FRESH = 0.7
"""LARS: once the level fell to this share, correlations are computed anew: they are 32 bits."""
DARKEST = 1e-6
"""Sensed atoms weaker than this, against the strongest, are dark and never chosen."""


def norms(atoms: Array) -> Array:
    """Return the atoms' Euclidean norms."""
    return np.sqrt(np.einsum("am,am->a", atoms, atoms))


def ridge_inverse(atoms: Array32, ridge: float) -> Array32:
    """Return (A A^T + ridge 1)^-1, (measurement, measurement); raises LinAlgError if singular."""
    count, length = atoms.shape
    # Of few atoms the sum alone has no inverse, and its rounding would count.
    exact = atoms if count >= length else atoms.astype(np.float64)
    gram = (exact.T @ exact).astype(np.float64)
    gram[np.diag_indices(length)] += ridge
    return np.linalg.inv(gram).astype(np.float32)


def _objective(data: Array, fitted: Array, eta: float, code: Array) -> float:
    """Return the value of eq. 8."""
    left = data.astype(np.float64) - fitted
    return float(0.5 * left @ left + eta * np.abs(code).sum())


def _dual(data: Array, point: Array, eta: float, largest: float) -> float:
    """Return the value of eq. 8's dual at a point, shrunk until no atom correlates by over eta."""
    shrunk = point.astype(np.float64) * min(1.0, eta / max(largest, 1e-30))
    left = data - shrunk
    return float(0.5 * (data.astype(np.float64) @ data - left @ left))


def _relative(objective: float, dual: float) -> float:
    return (objective - dual) / objective if objective > 0 else 0.0


def _soft(values: Array, threshold: float) -> Array:
    return values - np.clip(values, np.float32(-threshold), np.float32(threshold))


def _largest(values: Array, wanted: int) -> NDArray[np.bool_]:
    """Return which of the values, none negative, are the `wanted` largest, and not 0."""
    least = np.partition(values, -wanted)[-wanted] if wanted < len(values) else 0
    return (values >= least) & (values > 0)


def admm(
    atoms: Array32,
    data: Array32,
    eta: float,
    rtol: float,
    max_steps: int,
    inverse: Array32,
    rho: float,
    relax: float,
) -> tuple[Array32, float, float]:
    """Return the code of eq. 8 by ADMM on a growing working set, passes and relative gap.

    A few steps on all atoms find which matter. ADMM then runs on this working set alone. Outside
    atoms whose correlation with the dual point exceeds eta join the set, and ADMM continues from
    its state. The gap is that of the whole problem. inverse: (A A^T + rho 1)^-1.
    """
    count, length = atoms.shape
    state, dual_point = np.zeros(count, np.float32), np.empty(length, np.float32)
    steps = np.float32(eta), np.float32(rho), np.float32(relax)
    taken, objective, gap = kernels.split(
        atoms, inverse, data, *steps, rtol, min(max_steps, FIRST_STEPS), state, dual_point
    )
    passes, inner = float(taken), INNER_SHARE * rtol
    chosen = _largest(np.abs(state), 2 * length)
    while gap > rtol and passes < max_steps and chosen.any():
        share = chosen.sum() / count
        state[~chosen] = 0
        part, compact = state[chosen], atoms[chosen]
        most = int((max_steps - passes) / share) + 1
        taken, objective, _ = kernels.split(
            compact, ridge_inverse(compact, rho), data, *steps, inner, most, part, dual_point
        )
        state[chosen] = part
        passes += taken * share + 1
        correlation = np.abs(atoms @ dual_point)
        gap = _relative(objective, _dual(data, dual_point, eta, float(correlation.max())))
        outside = np.where(chosen, 0, correlation)
        joining = _largest(outside, length) & (outside >= eta)
        if not joining.any():
            inner *= INNER_SHARE
        chosen |= joining
    return _soft(state, eta / rho).astype(np.float32), passes, gap


def proximal_gradient(
    atoms: Array32, data: Array32, eta: float, rtol: float, max_steps: int, accelerate: bool
) -> tuple[Array32, float, float]:
    """Return the code of eq. 8 by ISTA, or by FISTA with adaptive restart, steps and relative gap.

    Beck and Teboulle 2009; the restart is that of O'Donoghue and Candes 2015. The step is 1 over
    the largest eigenvalue of A A^T.
    """
    curvature = float(np.linalg.eigvalsh((atoms.T @ atoms).astype(np.float64))[-1])
    older = code = np.zeros(len(atoms), np.float32)
    fitted, residual = np.zeros_like(data), data
    t, momentum, gap, best_dual = 1.0, np.float32(0), 1.0, -np.inf
    for taken in range(1, max_steps + 1):
        gain = atoms @ residual
        best_dual = max(best_dual, _dual(data, residual, eta, float(np.abs(gain).max())))
        ahead = code + momentum * (code - older)
        new = _soft(ahead + gain / curvature, eta / curvature)
        restart = (ahead - new) @ (new - code) > 0
        older, code = code, new
        before, fitted = fitted, code @ atoms
        gap = _relative(_objective(data, fitted, eta, code), best_dual)
        if gap <= rtol:
            return code, taken, gap
        if accelerate:
            before_t = 1.0 if restart else t
            t = (1 + (1 + 4 * before_t**2) ** 0.5) / 2
            momentum = np.float32((before_t - 1) / t)
        residual = data - (fitted + momentum * (fitted - before))
    return code, max_steps, gap


def omp(atoms: Array32, data: Array32, most: int, tolerance: float) -> tuple[Array32, int, float]:
    """Return a code by orthogonal matching pursuit, its number of atoms and the residual's norm.

    The atom that best explains the residual (by the cosine) joins, all coefficients are fitted
    anew; until `most` atoms, or the residual's norm is at most the tolerance (Pati 1993).
    """
    code = np.zeros(len(atoms), np.float32)
    size = norms(atoms)
    lit = size > DARKEST * size.max()
    inverse = np.where(lit, 1 / np.where(lit, size, 1), 0).astype(np.float32)
    basis = np.empty((min(most, *atoms.shape), data.size))
    chosen: list[int] = []
    residual = data.astype(np.float64)
    while len(chosen) < len(basis) and np.linalg.norm(residual) > tolerance:
        cosine = np.abs(atoms @ residual.astype(np.float32)) * inverse
        best = int(cosine.argmax())
        if cosine[best] == 0:
            break
        span, new = basis[: len(chosen)], atoms[best].astype(np.float64)
        for _ in range(2):  # Twice is enough for orthogonality to rounding.
            new -= (span @ new) @ span
        left = np.linalg.norm(new)
        independent = left * inverse[best] > DEPENDENT
        inverse[best] = 0
        if independent:
            basis[len(chosen)] = new / left
            residual -= (new @ residual) / left**2 * new
            chosen.append(best)
    span = basis[: len(chosen)]
    code[chosen] = np.linalg.solve(span @ atoms[chosen].T.astype(np.float64), span @ data)
    return code, len(chosen), float(np.linalg.norm(residual))


def lars(
    atoms: Array32, data: Array32, eta: float, rtol: float, max_steps: int
) -> tuple[Array32, int, float]:
    """Return the minimiser of eq. 8, followed from the largest penalty to eta, steps and gap.

    The Lasso path of least angle regression (Efron 2004): every step ends where an atom joins or
    leaves. At the step limit the code is that of a larger penalty than eta. rtol: not used, as the
    path ends at the minimiser.
    """
    residual = data.astype(np.float64)
    correlation = atoms @ data
    weights, signs = np.zeros((2, len(atoms)))
    chosen: list[int] = []
    dependent: list[int] = []  # They add nothing to those chosen, until one of these leaves.
    resting: list[int] = []  # They left at this level, and must not join before it falls.
    tiny = np.float32(1e-9)
    joining: int | None = int(np.abs(correlation).argmax())
    level = fresh = float(np.abs(correlation).max())
    steps = 0
    while level > eta and steps < max_steps:
        if joining is not None and _is_independent(atoms, chosen, joining):
            chosen.append(joining)
            signs[joining] = np.sign(correlation[joining])
        elif joining is not None:
            dependent.append(joining)
        inside = atoms[chosen].astype(np.float64)
        direction = np.linalg.solve(inside @ inside.T, signs[chosen])
        toward = direction @ inside
        slope = atoms @ toward.astype(np.float32)
        up = (np.float32(level) - correlation) / np.maximum(1 - slope, tiny)
        down = (np.float32(level) + correlation) / np.maximum(1 + slope, tiny)
        joins = np.minimum(up, down)
        joins[[*chosen, *dependent, *resting]] = np.inf
        # By sign, not by weight: of two atoms reaching 0 together, rounding may carry the second
        # past 0.
        falling = np.maximum(signs[chosen] * weights[chosen], 0)
        leaves = np.full(len(chosen), np.inf)
        shrinking = signs[chosen] * direction < 0
        leaves[shrinking] = falling[shrinking] / np.abs(direction[shrinking])
        reach = min(level - eta, max(float(joins.min()), 0.0), leaves.min(initial=np.inf))
        leaving = chosen[int(leaves.argmin())] if reach in leaves else None
        joining = None
        if leaving is None and reach < level - eta:
            joining = int(joins.argmin())
        level -= reach
        weights[chosen] += reach * direction
        residual -= reach * toward
        correlation -= np.float32(reach) * slope
        if level < FRESH * fresh:
            fresh, correlation = level, atoms @ residual.astype(np.float32)
        steps += 1
        resting = [] if reach > 0 else resting
        if leaving is not None:
            resting.append(leaving)
            dependent = []
            chosen.remove(leaving)
            weights[leaving] = 0
    code = weights.astype(np.float32)
    fitted = code @ atoms
    residual = data - fitted
    dual = _dual(data, residual, eta, float(np.abs(atoms @ residual).max()))
    return code, steps, _relative(_objective(data, fitted, eta, code), dual)


def _is_independent(atoms: Array32, chosen: list[int], further: int) -> bool:
    """Return whether the chosen atoms leave more of a further one than rounding."""
    if len(chosen) >= atoms.shape[1]:
        return False
    inside, atom = atoms[chosen].astype(np.float64), atoms[further].astype(np.float64)
    shared = inside @ atom
    left = atom @ atom - shared @ np.linalg.solve(inside @ inside.T, shared)
    return bool(left > DEPENDENT**2 * (atom @ atom))


def sl0(
    atoms: Array32,
    data: Array32,
    tolerance: float,
    shrink: float,
    inner_steps: int,
    narrowest: float,
    ridge: float,
) -> tuple[Array32, int, float]:
    """Return a code by smoothed l0 (Mohimani 2009), the passes and the residual's norm.

    From the least-squares code, sum(1 - exp(-code^2 / 2 width^2)) is lowered by a few gradient
    steps for ever smaller widths (by `shrink`, down to `narrowest` times the largest
    coefficient); after each the code is projected back onto the data, where it misses them by
    more than the tolerance. ridge: of A A^T, relative to its largest entry.
    """
    scale = float(np.square(atoms).sum(axis=0).max())
    if scale == 0:
        return np.zeros(len(atoms), np.float32), 0, float(np.linalg.norm(data))
    inverse = ridge_inverse(atoms, ridge * scale)
    nothing = np.zeros_like(data)
    code, pull = atoms @ (inverse @ data), nothing
    width, passes = 2 * np.abs(code).max(), 1
    last = narrowest * width
    while width > last:
        for _ in range(inner_steps):
            code = code + atoms @ pull
            code = code - code * np.exp(np.square(code) / (-2 * width**2))
            missed = data - code @ atoms
            pull = inverse @ missed if np.linalg.norm(missed) > tolerance else nothing
            passes += 1
        width = width * np.float32(shrink)
    code = code + atoms @ pull
    missed = float(np.linalg.norm(data - code @ atoms))
    return np.asarray(code, np.float32), passes, missed
