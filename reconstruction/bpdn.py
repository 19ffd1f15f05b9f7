"""Sparse codes of a patch's measurements in its sensed dictionary: six solvers, one loop.

Notation: I (measurement,) the patch's readings; a_j (measurement,) the sensed atom j, a column of
A = Psi D; beta (atom,) the code. `admm`, `lars`, `ista` and `fista` minimise

    F(beta) = 1/2 |A beta - I|^2 + eta |beta|_1                                   (eq. 8).

`omp` and `sl0` look for few atoms that explain the measurements. The penalty eta and the tolerance
follow from the noise unless the settings give them.

Arrays hold A^T: `atoms` (atom, measurement) float32, one atom a row. Each step of a solver
correlates all atoms with a vector and sums the atoms in use: 4 atoms measurements operations.

The duality gap certifies the minimisers. For any r with |a_j . r| <= eta for all j, the dual value
1/2 (|I|^2 - |I - r|^2) lies below every F. A residual is scaled down until it is such an r.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

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
Method = Literal["admm", "omp", "lars", "ista", "fista", "sl0"]
SL0_RIDGE = 0.03
"""Of A A^T, relative to its largest block: what readings hold beyond noise and atoms is not forced
into directions that they hardly see. On 48x64 middles of four scenes of group A, three shots, 1e-5
loses 2.5 to 17.6 dB, and is worse than one shot; 0.01 loses 1.1 dB in the mean, 0.1 gains 0.2 and
loses 0.4 with one shot."""
LARS_GAP = 0.05
"""A path that ends further from the minimiser went wrong by rounding: status not converged."""
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
DEPENDENT = 1e-3
"""An atom adds nothing if chosen atoms explain all but this share of its norm."""
CHOICE_RIDGE = 0.7
"""Ridge of OMP's choice, over the square of the median norm of sensed atoms.

An atom of prior variance s^2 raises the likelihood of a residual r by
(a_j . r)^2 / (|a_j|^2 + noise^2 / s^2). Without the ridge OMP takes atoms that the masks hardly
show: middles of group A (64x80) lose 3.2 dB with one shot of a Bayer camera, 1.2 with three. With
0.5 and 1 they lose 0.2 at most.
"""
FRESH = 0.7
"""LARS: when the level has fallen to this share, correlations are computed anew (32-bit sums)."""
DARKEST = 1e-6
"""Norm of a sensed atom over the largest, below which it is dark and never chosen."""


_CHOLESKY, _INVERSE_OF_FACTOR = get_lapack_funcs(("potrf", "potri"), dtype=np.float64)


class BPDNSettings(Settings):
    """The solver, and when it stops; None lets noise and data choose."""

    method: Method = "admm"
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
    relaxation: float = Field(default=1.8, ge=1, lt=2, description="of ADMM")
    threshold: float = Field(
        default=0.04, gt=0, description="of ADMM: eta / rho, against the size of the data"
    )
    atoms: int = Field(default=20, ge=1, description="most atoms that omp takes")
    tolerance_factor: float = Field(
        default=1.0, ge=0, description="of the noise's norm, at which omp and sl0 rest"
    )
    sl0_shrink: float = Field(default=0.7, gt=0, lt=1, description="of the widths of sl0")
    sl0_inner_steps: int = Field(default=3, ge=1)
    sl0_narrowest: float = Field(default=0.005, gt=0, lt=1)


@dataclass(frozen=True, eq=False)
class Code:
    """The sparse code of one patch.

    weights: beta, (atom,). steps: passes over all atoms. penalty: eta (0 for omp and sl0). gap:
    (F - dual) / F, NaN for omp and sl0.
    """

    weights: Array32
    steps: float
    converged: bool
    penalty: float = 0.0
    gap: float = np.nan


@dataclass(frozen=True, eq=False)
class Begun:
    """ADMM after some steps on all atoms: its state w, (atom,), and how many steps these were."""

    state: Array32
    steps: float


EMPTY = Code(np.zeros(0, np.float32), 0.0, True)
"""Of a patch without a usable reading."""


@dataclass(frozen=True, eq=False)
class SensedDictionary:
    """A sensed dictionary, with the norms and inverses that all its patches share.

    atoms: (atom, padded measurement) float32, C-contiguous. data: (patch, padded measurement), the
    readings of all patches that will be coded. noise_sigma: standard deviation of a reading.
    """

    atoms: Array32
    data: Array32
    noise_sigma: float
    settings: BPDNSettings

    def code(self, data: Array32, measured: int, begun: Begun | None = None) -> Code:
        """Return the code of a patch: begin, then step until done or at the step limit.

        data: (padded measurement,). measured: how many of its readings are usable. begun: for
        `admm`, to go on from. Raises ReconstructionError where A A^T + rho 1 is singular.
        """
        kind = SOLVERS[self.settings.method]
        if issubclass(kind, _Minimiser) and not self.typical_norm * self.typical_data > 0:
            return Code(np.zeros(len(self.atoms), np.float32), 0, True)
        solver = kind(self, data, measured) if begun is None else _Admm(self, data, measured, begun)
        while not solver.done and solver.steps < solver.most_steps:
            solver.step()
        return solver.result()

    @cached_property
    def norms(self) -> Array:
        """The norms |a_j|, (atom,)."""
        return np.sqrt(np.einsum("am,am->a", self.atoms, self.atoms))

    @cached_property
    def typical_norm(self) -> float:
        """|a|, the median norm of the atoms."""
        return float(np.median(self.norms))

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
    def curvature(self) -> float:
        """L, the largest eigenvalue of A A^T."""
        return float(np.linalg.eigvalsh((self.atoms.T @ self.atoms).astype(np.float64))[-1])

    @cached_property
    def inverse(self) -> Array32:
        """(A A^T + ridge 1)^-1: the ridge of ADMM is rho, that of sl0 a share of A A^T."""
        if self.settings.method == "admm":
            return ridge_inverse(self.atoms, self.rho)
        largest = float(np.square(self.atoms).sum(axis=0).max())
        return ridge_inverse(self.atoms, SL0_RIDGE * largest or 1.0)


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
    if settings.method == "admm" and len(data) >= FEWEST_TOGETHER:
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
            found[patch] = sensed.code(data[patch], int(seen.sum()), begun)
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


class _Solver(ABC):
    """The iteration of one patch, from `begin` by `step` to `result`.

    steps: passes over all atoms so far. most_steps: their limit. tolerance: norm of the residual
    that noise leaves.
    """

    done = False
    steps: float = 0

    def __init__(self, sensed: SensedDictionary, data: Array32, measured: int) -> None:
        self.sensed, self.atoms, self.data, self.measured = sensed, sensed.atoms, data, measured
        self.settings = sensed.settings
        self.most_steps: float = self.settings.max_steps
        self.tolerance = self.settings.tolerance_factor * sensed.noise_sigma * np.sqrt(measured)
        self.beta = np.zeros(len(self.atoms), np.float32)
        self.begin()

    @abstractmethod
    def begin(self) -> None:
        """Set the state of the iteration, and `done` where no step is needed."""

    @abstractmethod
    def step(self) -> None:
        """Advance the state and `steps`; set `done` where further steps are needless."""

    def result(self) -> Code:
        """Return the code reached."""
        return Code(self.beta, self.steps, True)


class _Minimiser(_Solver):
    """A solver of eq. 8: done where the relative duality gap is at most `rtol`."""

    gap = np.inf

    def __init__(self, sensed: SensedDictionary, data: Array32, measured: int) -> None:
        self.eta = sensed.penalty(data)
        super().__init__(sensed, data, measured)

    def result(self) -> Code:
        converged = self.gap <= self.settings.rtol
        return Code(self.beta, self.steps, converged, self.eta, self.gap)

    def objective(self, fitted: Array) -> float:
        """Return F of the code; fitted: A beta."""
        residual = self.data.astype(np.float64) - fitted
        return float(0.5 * residual @ residual + self.eta * np.abs(self.beta).sum())

    def dual(self, point: Array, largest: float) -> float:
        """Return the dual value at a point, scaled down until its largest |a_j . r| is eta."""
        shrunk = point.astype(np.float64) * min(1.0, self.eta / max(largest, 1e-30))
        residual = self.data - shrunk
        return float(0.5 * (self.data.astype(np.float64) @ self.data - residual @ residual))

    def set_gap(self, objective: float, dual: float) -> None:
        """Set the gap between F and a dual value, and whether it is small enough."""
        self.gap = (objective - dual) / objective if objective > 0 else 0.0
        self.done = self.gap <= self.settings.rtol


def _soft(values: Array, threshold: float) -> Array:
    """Return sign(w) max(|w| - threshold, 0), the proximal point of threshold |.|_1."""
    return values - np.clip(values, np.float32(-threshold), np.float32(threshold))


def _largest(values: Array, wanted: int) -> NDArray[np.bool_]:
    """Return which of the values, none negative, are the `wanted` largest, and not 0."""
    least = np.partition(values, -wanted)[-wanted] if wanted < len(values) else 0
    return (values >= least) & (values > 0)


class _Admm(_Minimiser):
    """ADMM on a growing working set S; `bpdn_kernels.split` shows the mathematics of its steps.

    Begin: FIRST_STEPS steps on all atoms, or FIRST_STEPS_OF_FEW on few, from w = 0, or those that
    were made together; S = the 2 m largest |w_j| of m measurements.
    Step:
        w_S = ADMM on the atoms of S alone, from w_S, to a gap of `inner`
        r   = its dual point, g_j = |a_j . r| over all atoms
        gap = that of the whole problem, by r and max g
        S   = S and the m largest g_j >= eta outside S; if there is none, inner is halved
    Result: beta = soft(w, eta / rho).
    """

    def __init__(
        self, sensed: SensedDictionary, data: Array32, measured: int, begun: Begun | None = None
    ) -> None:
        self.begun = begun
        super().__init__(sensed, data, measured)

    def begin(self) -> None:
        self.inner = INNER_SHARE * self.settings.rtol
        self.dual_point = np.empty(len(self.data), np.float32)
        if self.begun is not None:
            self.w, self.steps = self.begun.state, self.begun.steps
            self.working = _largest(np.abs(self.w), 2 * len(self.data))
            self.done = not self.working.any()
            return
        self.w = np.zeros(len(self.atoms), np.float32)
        few = len(self.atoms) <= FEW * len(self.data)
        first = min(self.settings.max_steps, FIRST_STEPS_OF_FEW if few else FIRST_STEPS)
        run = self._split(self.atoms, self.sensed.inverse, self.settings.rtol, first, self.w)
        self.steps, self.gap = float(run.steps), run.gap
        self.working = _largest(np.abs(self.w), 2 * len(self.data))
        self.done = self.gap <= self.settings.rtol or not self.working.any()

    def _split(
        self, atoms: Array32, inverse: Array32, rtol: float, most: int, w: Array32
    ) -> kernels.SplitRun:
        """Run ADMM in place on some atoms and their state w; set the dual point."""
        eta, rho = np.float32(self.eta), np.float32(self.sensed.rho)
        relax = np.float32(self.settings.relaxation)
        return kernels.split(
            atoms, inverse, self.data, eta, rho, relax, rtol, most, w, self.dual_point
        )

    def step(self) -> None:
        share = self.working.sum() / len(self.atoms)
        self.w[~self.working] = 0
        w, atoms = self.w[self.working], self.atoms[self.working]
        most = int((self.settings.max_steps - self.steps) / share) + 1
        run = self._split(atoms, ridge_inverse(atoms, self.sensed.rho), self.inner, most, w)
        self.w[self.working] = w
        self.steps += run.steps * share + 1
        correlation = np.abs(self.atoms @ self.dual_point)
        self.set_gap(run.objective, self.dual(self.dual_point, float(correlation.max())))
        outside = np.where(self.working, 0, correlation)
        joining = _largest(outside, len(self.data)) & (outside >= self.eta)
        if not joining.any():
            self.inner *= INNER_SHARE
        self.working |= joining

    def result(self) -> Code:
        self.beta = _soft(self.w, self.eta / self.sensed.rho).astype(np.float32)
        return super().result()


class _Ista(_Minimiser):
    """Proximal gradient steps of length 1/L (Beck and Teboulle 2009).

    Step:
        ahead = beta + theta (beta - before)
        beta' = soft(ahead + A^T (I - A ahead) / L, eta / L)
        gap   = F(beta') against the largest dual value so far, of the residuals I - A ahead
        ISTA:   theta = 0
        FISTA:  theta = (t - 1) / t',  t' = (1 + sqrt(1 + 4 t^2)) / 2, with t = 1 where
                (ahead - beta') . (beta' - beta) > 0 (restart: O'Donoghue and Candes 2015)
    """

    accelerated = False

    def begin(self) -> None:
        self.before = self.beta
        self.fitted, self.residual = np.zeros_like(self.data), self.data
        self.t, self.theta, self.best_dual = 1.0, np.float32(0), -np.inf

    def step(self) -> None:
        gain, curvature = self.atoms @ self.residual, self.sensed.curvature
        dual = self.dual(self.residual, float(np.abs(gain).max()))
        self.best_dual = max(self.best_dual, dual)
        ahead = self.beta + self.theta * (self.beta - self.before)
        new = _soft(ahead + gain / curvature, self.eta / curvature)
        overshot = (ahead - new) @ (new - self.beta) > 0
        self.before, self.beta = self.beta, new
        fitted_before, self.fitted = self.fitted, new @ self.atoms
        self.set_gap(self.objective(self.fitted), self.best_dual)
        self.steps += 1
        if self.accelerated:
            t = 1.0 if overshot else self.t
            self.t = (1 + (1 + 4 * t**2) ** 0.5) / 2
            self.theta = np.float32((t - 1) / self.t)
        # I - A ahead of the next step, from the fits at hand.
        self.residual = self.data - (self.fitted + self.theta * (self.fitted - fitted_before))


class _Fista(_Ista):
    accelerated = True


class _Lars(_Minimiser):
    """The Lasso path of least angle regression (Efron 2004), from the largest penalty to eta.

    On the path, the chosen atoms S correlate with the residual by +-level, all others by less.
    Step:
        an atom joins S, unless S explains it already
        d      = (A_S^T A_S)^-1 sign_S,  slope_j = a_j . A_S d
        reach  = least of: level - eta; the fall of the level until an outside atom correlates by
                 as much; the fall until a weight of S is 0
        beta_S = beta_S + reach d,  residual = residual - reach A_S d,  level = level - reach
        an atom whose weight is 0 leaves S
    At the step limit the code is that of a larger penalty than eta.
    """

    def begin(self) -> None:
        self.residual = self.data.astype(np.float64)
        self.correlation = self.atoms @ self.data
        self.weights, self.signs = np.zeros((2, len(self.atoms)))
        self.chosen: list[int] = []
        # Dependent atoms are combinations of chosen atoms, until a chosen atom leaves.
        self.dependent: list[int] = []
        # Resting atoms left at this level, and must not join before it falls.
        self.resting: list[int] = []
        self.joining: int | None = int(np.abs(self.correlation).argmax())
        self.level = self.fresh = float(np.abs(self.correlation).max())
        self.done = self.level <= self.eta

    def step(self) -> None:
        self._join()
        inside = self.atoms[self.chosen].astype(np.float64)
        direction = np.linalg.solve(inside @ inside.T, self.signs[self.chosen])
        toward = direction @ inside
        slope = self.atoms @ toward.astype(np.float32)
        joins, leaves = self._joins(slope), self._leaves(direction)
        rest = self.level - self.eta
        reach = min(rest, max(float(joins.min()), 0.0), leaves.min(initial=np.inf))
        leaving = self.chosen[int(leaves.argmin())] if reach in leaves else None
        self.joining = int(joins.argmin()) if leaving is None and reach < rest else None
        self.level -= reach
        self.weights[self.chosen] += reach * direction
        self.residual -= reach * toward
        self.correlation -= np.float32(reach) * slope
        if self.level < FRESH * self.fresh:
            self.fresh = self.level
            self.correlation = self.atoms @ self.residual.astype(np.float32)
        self.steps += 1
        self.done = self.level <= self.eta
        if reach > 0:
            self.resting = []
        if leaving is not None:
            self.resting.append(leaving)
            self.dependent = []
            self.chosen.remove(leaving)
            self.weights[leaving] = 0

    def _join(self) -> None:
        """Take the joining atom in, unless the chosen ones leave no more of it than rounding."""
        if self.joining is None:
            return
        independent = len(self.chosen) < self.atoms.shape[1]
        if independent:
            inside = self.atoms[self.chosen].astype(np.float64)
            atom = self.atoms[self.joining].astype(np.float64)
            shared = inside @ atom
            rest = atom @ atom - shared @ np.linalg.solve(inside @ inside.T, shared)
            independent = rest > DEPENDENT**2 * (atom @ atom)
        (self.chosen if independent else self.dependent).append(self.joining)
        if independent:
            self.signs[self.joining] = np.sign(self.correlation[self.joining])

    def _joins(self, slope: Array) -> Array:
        """Return by how much the level falls until each atom outside correlates by as much."""
        tiny, level = np.float32(1e-9), np.float32(self.level)
        up = (level - self.correlation) / np.maximum(1 - slope, tiny)
        down = (level + self.correlation) / np.maximum(1 + slope, tiny)
        joins = np.minimum(up, down)
        joins[[*self.chosen, *self.dependent, *self.resting]] = np.inf
        return joins

    def _leaves(self, direction: Array) -> Array:
        """Return by how much the level falls until the weight of each chosen atom is 0."""
        signs = self.signs[self.chosen]
        # By sign, not by weight: of two atoms reaching 0 together, rounding may carry the second
        # past 0.
        falling = np.maximum(signs * self.weights[self.chosen], 0)
        leaves = np.full(len(self.chosen), np.inf)
        shrinking = signs * direction < 0
        leaves[shrinking] = falling[shrinking] / np.abs(direction[shrinking])
        return leaves

    def result(self) -> Code:
        self.beta = self.weights.astype(np.float32)
        fitted = self.beta @ self.atoms
        residual = self.data - fitted
        dual = self.dual(residual, float(np.abs(self.atoms @ residual).max()))
        self.set_gap(self.objective(fitted), dual)
        limit = LARS_GAP if self.steps < self.most_steps else self.settings.rtol
        return Code(self.beta, self.steps, self.gap <= limit, self.eta, self.gap)


class _Omp(_Solver):
    """Orthogonal matching pursuit (Pati 1993).

    Step:
        j        = the atom of the largest |a_j . residual| / sqrt(|a_j|^2 + ridge)
        q        = a_j less its projection on the basis, normed; it joins the basis
        residual = residual - (q . residual) q
    Done at `atoms` atoms, or where |residual| is at most the tolerance.
    Result: beta fits the data on the chosen atoms by least squares.
    """

    def begin(self) -> None:
        norms = self.sensed.norms
        lit = norms > DARKEST * norms.max()
        self.inverse_norms = np.where(lit, 1 / np.where(lit, norms, 1), 0).astype(np.float32)
        ridge = CHOICE_RIDGE * self.sensed.typical_norm**2
        self.scale = np.where(lit, 1 / np.sqrt(np.square(norms) + ridge), 0).astype(np.float32)
        self.most_steps = min(self.settings.atoms, self.measured, *self.atoms.shape)
        self.basis = np.empty((self.most_steps, self.data.size))
        self.chosen: list[int] = []
        self.residual = self.data.astype(np.float64)
        self.done = bool(np.linalg.norm(self.residual) <= self.tolerance)

    def step(self) -> None:
        gain = np.abs(self.atoms @ self.residual.astype(np.float32)) * self.scale
        best = int(gain.argmax())
        if gain[best] == 0:
            self.done = True
            return
        span, new = self.basis[: len(self.chosen)], self.atoms[best].astype(np.float64)
        for _ in range(2):  # Twice is enough for orthogonality to rounding.
            new -= (span @ new) @ span
        norm = np.linalg.norm(new)
        independent = norm * self.inverse_norms[best] > DEPENDENT
        self.scale[best] = 0
        if independent:
            self.basis[len(self.chosen)] = new / norm
            self.residual -= (new @ self.residual) / norm**2 * new
            self.chosen.append(best)
            self.steps = len(self.chosen)
            self.done = bool(np.linalg.norm(self.residual) <= self.tolerance)

    def result(self) -> Code:
        span, inside = self.basis[: len(self.chosen)], self.atoms[self.chosen].T
        self.beta[self.chosen] = np.linalg.solve(span @ inside.astype(float), span @ self.data)
        return super().result()


class _Sl0(_Solver):
    """Smoothed l0 (Mohimani 2009): few atoms, as the limit of ever narrower wells around 0.

    With G = (A A^T + ridge 1)^-1:
    Begin: beta = A^T G I, the least-squares code; width = 2 max |beta_j|.
    Step: `sl0_inner_steps` times, a gradient step on sum_j (1 - exp(-beta_j^2 / 2 width^2)), and
    back to the data where |I - A beta| exceeds the tolerance,
        beta = beta - beta exp(-beta^2 / 2 width^2),  beta = beta + A^T G (I - A beta);
    then width = sl0_shrink width, down to sl0_narrowest times the first.
    """

    def begin(self) -> None:
        self.most_steps = np.inf
        self.beta = self.atoms @ (self.sensed.inverse @ self.data)
        self.pull = np.zeros_like(self.data)
        self.width, self.steps = 2 * np.abs(self.beta).max(), 1
        self.narrowest = self.settings.sl0_narrowest * self.width
        self.done = not self.width > self.narrowest

    def step(self) -> None:
        for _ in range(self.settings.sl0_inner_steps):
            beta = self.beta + self.atoms @ self.pull
            self.beta = beta - beta * np.exp(np.square(beta) / (-2 * self.width**2))
            missed = self.data - self.beta @ self.atoms
            beyond = np.linalg.norm(missed) > self.tolerance
            self.pull = self.sensed.inverse @ missed if beyond else np.zeros_like(missed)
            self.steps += 1
        self.width = self.width * np.float32(self.settings.sl0_shrink)
        self.done = not self.width > self.narrowest

    def result(self) -> Code:
        self.beta = np.asarray(self.beta + self.atoms @ self.pull, np.float32)
        return super().result()


SOLVERS: dict[Method, type[_Solver]] = {
    "admm": _Admm, "omp": _Omp, "lars": _Lars, "ista": _Ista, "fista": _Fista, "sl0": _Sl0,
}  # fmt: skip
