"""Sparse codes of a patch's measurements in its sensed dictionary, by ADMM.

Notation: I (measurement,) the patch's readings; a_j (measurement,) the sensed atom j, a column of
A = Psi D; beta (atom,) the code. It minimises

    F(beta) = 1/2 |A beta - I|^2 + eta |beta|_1                                   (eq. 8).

The penalty eta follows from the noise unless the settings give it.

Arrays hold A^T: `atoms` (atom, measurement) float32, one atom a row. Each step correlates all atoms
with a vector and sums the atoms in use: 4 atoms measurements operations.

The duality gap certifies the minimiser. For any r with |a_j . r| <= eta for all j, the dual value
1/2 (|I|^2 - |I - r|^2) lies below every F. A residual is scaled down until it is such an r.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import get_lapack_funcs

from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction import bpdn_kernels as kernels
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.patches import grouped

Array = NDArray[np.floating]
Array32 = NDArray[np.float32]
FIRST_STEPS = 20
"""Steps of ADMM on all atoms, which determine the working set."""
FEW, FIRST_STEPS_OF_FEW = 8, 60
"""Atoms per measurement up to which a working set saves little, and the steps on all atoms then."""
FEWEST_TOGETHER = 8
"""Patches from which ADMM on all atoms at once, by products of matrices, is the faster."""
CHECKED = 5
"""Number of steps between tests of which patches have converged."""
STEPS_TOGETHER = 100
"""Steps on all atoms, of many patches together; what is left is solved patch by patch."""
INNER_SHARE = 0.5
"""Share of the tolerance to which ADMM solves a working set."""


_CHOLESKY, _INVERSE_OF_FACTOR = get_lapack_funcs(("potrf", "potri"), dtype=np.float64)


class BPDNSettings(Settings):
    """The penalty, and when ADMM stops; None lets noise and data choose."""

    removed: ClassVar[tuple[str, ...]] = (
        "method", "atoms", "tolerance_factor", "sl0_shrink", "sl0_inner_steps", "sl0_narrowest"
    )  # fmt: skip

    penalty: float | None = Field(
        default=None, gt=0, description="eta, in units of readings times a sensed atom's norm"
    )
    penalty_factor: float = Field(
        default=0.2, gt=0, description="of sigma |a| sqrt(2 log atoms), which sets eta"
    )
    smallest_penalty: float = Field(
        default=5e-4, gt=0, lt=1, description="eta against |data| |a|, where noise says less"
    )
    rtol: float = Field(
        default=1e-3, gt=0, description="relative duality gap; float32 certifies about 1e-5"
    )
    max_steps: int = Field(default=3000, ge=1)
    relaxation: float = Field(default=1.8, ge=1, lt=2)
    threshold: float = Field(
        default=0.04, gt=0, description="eta / rho, against the size of the data"
    )


@dataclass(frozen=True, eq=False)
class Code:
    """The sparse code of one patch.

    weights: beta, (atom,). steps: passes over all atoms. penalty: eta. gap: (F - dual) / F.
    """

    weights: Array32
    steps: float
    converged: bool
    penalty: float = 0.0
    gap: float = 0.0


@dataclass(frozen=True, eq=False)
class Begun:
    """ADMM after some steps on all atoms: its state w, (atom,), and how many steps these were."""

    state: Array32
    steps: float


EMPTY = Code(np.zeros(0, np.float32), 0.0, True)
"""Of a patch without a usable reading."""


@dataclass(frozen=True, eq=False)
class SensedDictionary:
    """A sensed dictionary, with the norm and the inverse that all its patches share.

    atoms: (atom, padded measurement) float32, C-contiguous. data: (patch, padded measurement), the
    readings of all patches that will be coded. noise_sigma: standard deviation of a reading.
    """

    atoms: Array32
    data: Array32
    noise_sigma: float
    settings: BPDNSettings

    def code(self, data: Array32, begun: Begun | None = None) -> Code:
        """Return the code of a patch, by ADMM on a growing working set S (`kernels.split`).

        Begin: FIRST_STEPS steps on all atoms, or FIRST_STEPS_OF_FEW on few, from w = 0, or those
        that were made together; S = the 2 m largest |w_j| of m measurements. A step:

            w_S = ADMM on the atoms of S alone, from w_S, to a gap of `inner`
            r   = its dual point, g_j = |a_j . r| over all atoms
            gap = that of the whole problem, by r and max g
            S   = S and the m largest g_j >= eta outside S; if there is none, inner is halved

        Result: beta = soft(w, eta / rho).

        data: (padded measurement,). begun: to go on from. Raises ReconstructionError where
        A A^T + rho 1 is singular.
        """
        settings, atoms = self.settings, self.atoms
        if not self.typical_norm * self.typical_data > 0:
            return Code(np.zeros(len(atoms), np.float32), 0, True)
        eta, dual_point = self.penalty(data), np.empty(len(data), np.float32)

        def split(
            atoms: Array32, inverse: Array32, rtol: float, most: int, w: Array32
        ) -> kernels.SplitRun:
            """Run ADMM in place on some atoms and their state w; set the dual point."""
            weights = np.float32(eta), np.float32(self.rho), np.float32(settings.relaxation)
            return kernels.split(atoms, inverse, data, *weights, rtol, most, w, dual_point)

        if begun is None:
            w = np.zeros(len(atoms), np.float32)
            few = len(atoms) <= FEW * len(data)
            first = min(settings.max_steps, FIRST_STEPS_OF_FEW if few else FIRST_STEPS)
            run = split(atoms, self.inverse, settings.rtol, first, w)
            steps, gap = float(run.steps), run.gap
        else:
            w, steps, gap = begun.state, begun.steps, np.inf
        working, inner = _largest(np.abs(w), 2 * len(data)), INNER_SHARE * settings.rtol
        while gap > settings.rtol and working.any() and steps < settings.max_steps:
            share = working.sum() / len(atoms)
            w[~working] = 0
            part, chosen = w[working], atoms[working]
            most = int((settings.max_steps - steps) / share) + 1
            run = split(chosen, ridge_inverse(chosen, self.rho), inner, most, part)
            w[working] = part
            steps += run.steps * share + 1
            correlation = np.abs(atoms @ dual_point)
            dual = _dual(data, dual_point, eta, float(correlation.max()))
            gap = (run.objective - dual) / run.objective if run.objective > 0 else 0.0
            outside = np.where(working, 0, correlation)
            joining = _largest(outside, len(data)) & (outside >= eta)
            if not joining.any():
                inner *= INNER_SHARE
            working |= joining
        kept = np.float32(eta / self.rho)
        return Code(w - np.clip(w, -kept, kept), steps, gap <= settings.rtol, eta, gap)

    @cached_property
    def typical_norm(self) -> float:
        """|a|, the median norm of the atoms."""
        return float(np.median(np.sqrt(np.einsum("am,am->a", self.atoms, self.atoms))))

    @cached_property
    def typical_data(self) -> float:
        """Root mean square of |I| over the patches."""
        return float(np.sqrt(np.mean(np.sum(np.square(self.data, dtype=np.float64), axis=1))))

    def penalty(self, data: Array32) -> float:
        """Return eta of a patch."""
        size = float(np.linalg.norm(data))
        return float(
            _penalty(self.settings, self.noise_sigma, len(self.atoms), self.typical_norm, size)
        )

    @cached_property
    def rho(self) -> float:
        """ADMM's weight of the splitting, by the median eta of the patches."""
        eta = np.array([self.penalty(patch) for patch in self.data])
        return _splitting_weight(self.settings, eta, self.typical_data, self.typical_norm)

    @cached_property
    def inverse(self) -> Array32:
        """(A A^T + rho 1)^-1."""
        return ridge_inverse(self.atoms, self.rho)


def ridge_inverse(atoms: Array32, ridge: float) -> Array32:
    """Return (A A^T + ridge 1)^-1, (measurement, measurement).

    Raises ReconstructionError if it is singular.
    """
    count, length = atoms.shape
    # The sum over few atoms alone has no inverse, so its rounding would count.
    exact = atoms if count >= length else atoms.astype(np.float64)
    gram = (exact.T @ exact).astype(np.float64)
    gram[np.diag_indices(length)] += ridge
    # By Cholesky factors: two thirds of the operations of a general inverse.
    factor, singular = _CHOLESKY(gram.T, lower=1, clean=0)
    if singular:
        raise ReconstructionError("a sensed dictionary is singular: raise the penalty")
    lower = np.tril(_INVERSE_OF_FACTOR(factor, lower=1, overwrite_c=1)[0]).astype(np.float32)
    lower[np.diag_indices(length)] /= 2
    return lower + lower.T


def _penalty(
    settings: BPDNSettings,
    noise_sigma: float,
    count: int,
    typical_norm: Array | float,
    size: Array | float,
) -> Array:
    """Return eta: as set, or c sigma |a| sqrt(2 log n) of n atoms of median norm |a|.

    The second is the largest correlation that noise alone reaches (Donoho and Johnstone 1994 for
    the form). Never below a small share of |I| |a|; size: |I|.
    """
    if settings.penalty is not None:
        return np.full(np.shape(size), settings.penalty)
    universal = noise_sigma * np.sqrt(2 * np.log(max(count, 2)))
    size = np.asarray(size)
    least = np.maximum(settings.penalty_factor * universal, settings.smallest_penalty * size)
    return least * typical_norm


def _splitting_weight(
    settings: BPDNSettings, eta: Array, typical_data: float, typical_norm: float
) -> float:
    """Return rho of ADMM, by the median eta of some patches."""
    return float(np.median(eta)) / (settings.threshold * typical_data / typical_norm)


def codes(
    atoms: Array32,
    data: Array32,
    usable: NDArray[np.bool_],
    noise_sigma: float,
    settings: BPDNSettings,
) -> list[Code]:
    """Return the codes of patches that see the atoms alike, but for readings that are not usable.

    atoms: (atom, padded measurement), C-contiguous. data: (patch, padded measurement), 0 where not
    usable. usable: (patch, measurement). Raises ReconstructionError as `SensedDictionary.code`.
    """
    found: list[Code | Begun | None] = [None] * len(data)
    if len(data) >= FEWEST_TOGETHER:
        found = _coded_together(atoms, data, usable, noise_sigma, settings)
    for patches in grouped(seen.tobytes() for seen in usable).values():
        seen, sensed = usable[patches[0]], None
        for patch in patches if seen.any() else ():
            begun = found[patch]
            if isinstance(begun, Code):
                continue
            if sensed is None:
                shown = atoms.copy()
                shown[:, : seen.size] *= seen
                sensed = SensedDictionary(shown, data[patches], noise_sigma, settings)
            found[patch] = sensed.code(data[patch], begun)
    return [code if isinstance(code, Code) else EMPTY for code in found]


def _coded_together(
    atoms: Array32,
    data: Array32,
    usable: NDArray[np.bool_],
    noise_sigma: float,
    settings: BPDNSettings,
) -> list[Code | Begun | None]:
    """Return the codes of many patches by ADMM on all atoms, see `kernels.split`.

    Begun: of a patch that is not done after STEPS_TOGETHER. None: of a patch of dark readings.

    Both products with the atoms are products of matrices, of all patches at once. Readings H of a
    patch that are not usable, K the others, leave of the inverse G = (A A^T + rho 1)^-1

        (A_K A_K^T + rho 1)^-1 = G_KK - G_KH G_HH^-1 G_HK.
    """
    seen = np.ones_like(data)
    seen[:, : usable.shape[1]] = usable
    measured = usable.any(axis=1)
    norms = np.median(np.sqrt(seen @ np.square(atoms).T), axis=1)
    size = np.linalg.norm(data, axis=1)
    found: list[Code | Begun | None] = [None] * len(data)
    active = np.flatnonzero(measured & (norms * size > 0))
    if not active.size:
        return found
    eta = _penalty(settings, noise_sigma, len(atoms), norms, size)
    typical_data = float(np.sqrt(np.mean(np.square(size[active]))))
    rho = _splitting_weight(settings, eta[active], typical_data, float(np.median(norms[active])))
    inverse = ridge_inverse(atoms, rho)
    hidden, rest = _hidden(inverse, usable)
    eta32 = eta.astype(np.float32)
    relax, ratio = np.float32(settings.relaxation), np.float32(rho)
    state = np.zeros((len(active), len(atoms)), np.float32)
    kept = np.empty_like(state)
    fitted, carried = np.zeros((2, len(active), data.shape[1]), np.float32)
    last = min(STEPS_TOGETHER, settings.max_steps)
    for step in range(1, last + 1):
        of_active = seen[active]
        miss = data[active] - 2 * fitted + carried
        pull = miss @ inverse
        at_hidden = np.take_along_axis(pull, hidden[active], axis=1)
        pull -= (rest[active] @ at_hidden[..., None])[..., 0]
        pull *= of_active
        carried += relax * (fitted - carried + miss - ratio * pull)
        largest, ones = kernels.split_together(
            pull @ atoms.T, eta32[active] / ratio, relax, state, kept
        )
        fitted = (kept @ atoms) * of_active
        gap = _gaps(data[active], fitted, pull, eta[active], rho, largest, ones)
        done = (gap <= settings.rtol) | (step == last)
        if step % CHECKED and not done.all():
            continue
        for place in np.flatnonzero(done):
            patch, converged = active[place], bool(gap[place] <= settings.rtol)
            found[patch] = Begun(state[place].copy(), step)
            if converged or step == settings.max_steps:
                code = kept[place].copy()
                found[patch] = Code(code, step, converged, float(eta[patch]), float(gap[place]))
        left = ~done
        active, state, fitted, carried = active[left], state[left], fitted[left], carried[left]
        kept = kept[: len(active)]
        if not active.size:
            break
    return found


def _hidden(inverse: Array32, usable: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Array32]:
    """Return for each patch the readings H that are not usable, and G_H G_HH^-1.

    inverse: G, (measurement, measurement). Results: (patch, h) and (patch, measurement, h); those
    with fewer than the most, h, have zeros.
    """
    lost = ~usable
    most = int(lost.sum(axis=1).max())
    places = np.zeros((len(usable), most), np.int64)
    rest = np.zeros((len(usable), len(inverse), most), np.float32)
    for patch, of_patch in enumerate(lost):
        at = np.flatnonzero(of_patch)
        places[patch, : at.size] = at
        rest[patch, :, : at.size] = np.linalg.solve(inverse[np.ix_(at, at)], inverse[at]).T
    return places, rest


def _gaps(
    data: Array,
    fitted: Array,
    pull: Array,
    eta: Array,
    rho: float,
    largest: Array,
    ones: Array,
) -> Array:
    """Return the relative duality gap of each patch; pull: a dual point over rho.

    largest: max |a_j . pull|. ones: |code|_1.
    """
    shrink = np.minimum(rho, eta / np.maximum(largest, 1e-30))[:, None]
    exact = data.astype(np.float64)
    objective = 0.5 * np.square(exact - fitted).sum(axis=1) + eta * ones
    dual = 0.5 * (np.square(exact) - np.square(exact - shrink * pull)).sum(axis=1)
    return np.where(objective > 0, (objective - dual) / np.maximum(objective, 1e-300), 0)


def _dual(data: Array, point: Array, eta: float, largest: float) -> float:
    """Return the dual value at a point, scaled down until its largest |a_j . r| is eta."""
    exact = data.astype(np.float64)
    residual = exact - point.astype(np.float64) * min(1.0, eta / max(largest, 1e-30))
    return float(0.5 * (exact @ exact - residual @ residual))


def _largest(values: Array, wanted: int) -> NDArray[np.bool_]:
    """Return which of the values, none negative, are the `wanted` largest, and not 0."""
    least = np.partition(values, -wanted)[-wanted] if wanted < len(values) else 0
    return (values >= least) & (values > 0)
