"""The parametric route: the placement of a known mask from a few whiteboards, robust and weighted.

Levenberg-Marquardt on the posterior of readings weighed by the noise, Tukey's biweight (dust, bad
pixels) and a wide prior (the bench's tolerances). The normal equations are summed over chunks of
pixels: time is linear in the pixels, memory is that of one chunk. The fit begins on the middle of
the picture, registered by correlation, and widens: a small turn or stretch that moves the corner
by pixels moves the middle by little.

Through a real lens every view sees the mask a little displaced and a little softer than the
placement has it (aberrations). Neighbouring views are coded nearly alike, so that a displacement of
one reads like weight moved between its neighbours: where whiteboards open several views at once it
biases the aperture's weights, alike over the whole picture, which no residual shows. Displacements
and softenings are taken as normal, of variances tau^2 that the whiteboards' residuals show (random
effects: Searle, Casella, McCulloch 1992, chapter 6); the placement's covariance C then grows by
C N diag(tau^2) N^T C, N the information between its parameters and the views' own.

What all pixels of one whiteboard share is no noise of single pixels: shutter and lamp change its
brightness, and the mask stands a little elsewhere. Each whiteboard has these three of its own,
normal about 0, of the widths that make the readings likeliest; brightness in addition by what
repeats of a whiteboard differ among themselves, over their number.

Source of the loss: Holland & Welsch 1977; of the steps: Marquardt 1963; of the widths (evidence):
MacKay 1992.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import correlate1d

from emmc_rig.calibration.boards import Board, Opening, Sample, unsteadiness2
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.locator import register, starting_placement
from emmc_rig.calibration.placement import (
    SCALARS,
    Placement,
    Tolerances,
    labels,
    with_aperture_mean_one,
)
from emmc_rig.calibration.robust import correlation, deviation_of, tukey_loss, tukey_weights
from emmc_rig.calibration.shadow import ANY_COLOUR, OF_VIEW, Shadow, ShadowMask
from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.camera import Camera
from emmc_rig.model.settings import Settings

Array = NDArray[np.floating]
CHUNK = 4096
FIRST_WINDOW_PX = 64
FEWEST_PIXELS = 400
"""Of a whiteboard, however many there are."""
MOST_OF_PRIOR = 0.7
"""Of the prior's deviation: a parameter known no better stays at the design."""
LEAST_GAIN = 0.01
"""Of the log posterior, in a last step: that of a move by a seventh of a standard deviation."""
MOST_MORE_BOARDS = 200
LEAST_FIT_CORRELATION = 0.7
OFFSETS = slice(0, 2)
OWN = 3
"""Parameters of one whiteboard: relative brightness, and by how much the mask moved (x, y), um."""
FIRST_BRIGHTNESS, FIRST_MOVED_UM = 2e-3, 0.2
BRIGHTNESSES = np.geomspace(2e-5, 0.05, 12)
MOVES_UM = np.geomspace(0.002, 10.0, 12)
"""Widths of the whiteboards' own that are tried."""
LOOSE_UM = 0.5
"""Width of where a hand puts a pinhole, as a move of the mask: 0.2 mm of 50 mm at 0.12 mm."""
OF_LOOSE = 0.05
"""Of the width of the prior of glass, which a displaced pinhole imitates."""
LEAST_MOVED_UM = 0.25
"""Moves below it are taken for what the model misses of neighbouring pixels alike: a bench of 256
rays a pixel leaves three times the noise, which as moves were 0.05 to 0.2 um."""
CLEARLY_LIKELIER = 0.5
"""Difference of log evidence: less than this tells nothing."""
WIDTH_ROUNDS = 2
SURE_ROWS = 3.0
"""Deviations from which on rows that err alike are no chance."""
MOST_ALIKE, ROWS_ALIKE = 0.95, 64
"""Correlation of neighbouring rows, and beyond how many it is 0."""
SURE_MOVE = 5.0
"""Deviations of a whiteboard's own move from which on it is no chance."""
KINDS = (0, 0, 1, 1, 2)
"""Of a view's own derivatives: displacement, softening along an axis, softening across both."""
TAUS_UM = np.geomspace(0.003, 1.0, 6)
"""Of each kind: from far less than any whiteboard shows to a tenth of a pixel."""
TAU_UM = 0.1
"""Beforehand tau is a half-t of 3 degrees of freedom and this scale (Gelman 2006, Bayesian Analysis
1:515): there are too few views to determine it well. Uniform up to 1 um, whiteboards of nine views
left a distance that was 12 % off undecided."""


class FitSettings(Settings):
    """Settings of the fit.

    pixels: at most so many of all whiteboards together, alike of each, drawn at random over the
    window; more make the placement surer than the mask is like its model.
    """

    pixels: int = Field(default=100_000, ge=500)
    first_pixels: int = Field(default=12_000, ge=500, description="while the window widens")
    max_steps: int = Field(default=40, ge=1)
    tolerance: float = Field(
        default=0.02, gt=0, description="of a last step, in standard deviations"
    )
    seed: int = Field(default=0, ge=0)


@dataclass(frozen=True)
class BoardCheck:
    """How one whiteboard agrees with the fit of all: brightness and where its mask stood.

    taken_s: when, on the clock of the capture. chi2: mean squared residual over the noise, of the
    pixels that are no outliers. outliers: their share.
    """

    name: str
    brightness: float
    brightness_deviation: float
    moved_um: tuple[float, float]
    moved_deviation_um: float
    taken_s: float
    chi2: float
    outliers: float


@dataclass(frozen=True, eq=False)
class Fit:
    """The placement fitted, how sure it is, and how well it explains the whiteboards.

    covariance: (parameter, parameter), in the order of `placement.vector()`. chi2: mean squared
    residual over the noise without outliers. undecided: names of parameters that the prior decides
    more than the whiteboards; more_boards: how many more of the same kinds would decide them
    (MOST_MORE_BOARDS: no number of them). brightness_spread: by
    which whiteboards differ among themselves, beyond what their repeats do; so do the references,
    which the covariance does not count. moved_um: how far the mask stands from its place; so it
    may in the shots of a scene, which the covariance counts. astray2: variances of the views' own
    displacements and softenings.
    """

    placement: Placement
    covariance: NDArray[np.float64]
    correlation: float
    chi2: float
    outliers: float
    steps: int
    status: str
    advice: str
    undecided: tuple[str, ...]
    more_boards: int
    boards: tuple[BoardCheck, ...]
    brightness_spread: float = 0.0
    moved_um: float = 0.0
    astray2: tuple[float, ...] = ()

    def deviation(self, name: str) -> float:
        """Return the standard deviation of a parameter by name."""
        index = labels(np.shape(self.placement.aperture)).index(name)  # type: ignore[arg-type]
        return float(np.sqrt(self.covariance[index, index]))


@dataclass(frozen=True, eq=False)
class _State:
    """The placement, and each whiteboard's own: (board, OWN)."""

    placement: Placement
    own: NDArray[np.float64]

    def vector(self) -> NDArray[np.float64]:
        """Return all parameters as one vector."""
        return np.concatenate([self.placement.vector(), self.own.ravel()])

    def moved(self, step: Array) -> _State:
        """Return the state after a step, within what is possible."""
        size = len(step) - self.own.size
        own = self.own + step[size:].reshape(self.own.shape)
        return _State(self.placement.moved(step[:size]), own)

    def opening(self, board: Board, index: int) -> Opening:
        """Return parameters of the mask's shadow, at the mask position of one whiteboard."""
        views_open, (x, y), shot = board.opening
        return views_open, (x + float(self.own[index, 1]), y + float(self.own[index, 2])), shot


@dataclass(frozen=True, eq=False)
class _Prior:
    """Precisions and centres of all parameters."""

    precision: NDArray[np.float64]
    centre: NDArray[np.float64]

    def loss(self, at: _State) -> float:
        """Return what the prior adds to the loss."""
        return 0.5 * float(np.sum(self.precision * (at.vector() - self.centre) ** 2))


def _prior(
    placement: Array, centre: Array, widths: tuple[float, float], own2: NDArray[np.float64]
) -> _Prior:
    """Return the prior of a placement (precisions, centre) and of the whiteboards' own.

    own2: (board, OWN), variances beside the widths of all, see `_own_variances`.
    """
    own2 = own2 + np.square([widths[0], widths[1], widths[1]])
    precision = np.concatenate([placement, 1 / own2.ravel()]).astype(np.float64)
    return _Prior(precision, np.concatenate([centre, np.zeros(own2.size)]).astype(np.float64))


def _own_variances(boards: Sequence[Board]) -> NDArray[np.float64]:
    """Return variances of the whiteboards' own brightness, as repeats show it, and places."""
    own2 = np.zeros((len(boards), OWN))
    own2[:, 0] = unsteadiness2(boards) / np.array([board.repeats for board in boards])
    own2[[board.loose for board in boards], 1:] = LOOSE_UM**2
    return own2


def _all_residuals(mask: ShadowMask, at: _State, samples: Sequence[Sample]) -> list[Array]:
    """Return the residuals of every whiteboard's sample, in deviations."""
    shadow, found = Shadow(mask, at.placement), []
    for index, sample in enumerate(samples):
        opening = at.opening(sample.board, index)
        predicted = shadow.readings(sample.pixels, sample.channels, *opening)
        brighter = 1 + at.own[index, 0]
        found.append((sample.reading - brighter * predicted) / sample.deviation)
    return found


def _join_slopes(read: Array, slope: Array, own: Array) -> NDArray[np.float64]:
    """Return the slopes by the placement and by a whiteboard's own, (n, parameter + OWN)."""
    brighter = 1 + own[0]
    rows = [brighter * slope, read, brighter * slope[:, OFFSETS]]
    return np.column_stack(rows).astype(np.float64, copy=False)


def _parameter_places(at: _State, index: int) -> NDArray[np.int64]:
    """Return where the placement's and one whiteboard's own parameters lie in the vector."""
    size = len(at.placement.vector())
    return np.concatenate([np.arange(size), size + index * OWN + np.arange(OWN)])


def _robust_spread(residuals: Sequence[Array]) -> float:
    """Return the robust deviation of the residuals in units of the noise, at least 1."""
    return max(1.0, deviation_of(np.concatenate(residuals)))


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """Gauss-Newton normal equations, and what the residuals are like."""

    matrix: NDArray[np.float64]
    gradient: NDArray[np.float64]
    spread: float
    squares: float
    kept: int
    count: int


def _pixel_chunks(
    at: _State, sample: Sample, index: int, residual: Array
) -> Iterator[tuple[Any, Array, Array]]:
    """Yield what `Shadow` takes of some pixels, their residuals, and their deviations (n, 1)."""
    opening = at.opening(sample.board, index)
    for first in range(0, len(residual), CHUNK):
        part = slice(first, first + CHUNK)
        how = sample.pixels[part], sample.channels[part], *opening
        yield how, residual[part], sample.deviation[part, None]


def _normal_equations(mask: ShadowMask, at: _State, samples: Sequence[Sample]) -> _NormalEquations:
    shadow = Shadow(mask, at.placement)
    residuals = _all_residuals(mask, at, samples)
    spread = _robust_spread(residuals)
    size = len(at.vector())
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    squares, kept = 0.0, 0
    for index, sample in enumerate(samples):
        places = _parameter_places(at, index)
        for how, residual, deviation in _pixel_chunks(at, sample, index, residuals[index]):
            read, slope = shadow.with_slopes(*how)
            slope = _join_slopes(read, slope, at.own[index]) / (deviation * spread)
            scaled = residual / spread
            weight = tukey_weights(scaled)
            matrix[np.ix_(places, places)] += slope.T @ (slope * weight[:, None])
            gradient[places] += slope.T @ (weight * scaled)
            inside = weight > 0
            squares += float((residual[inside] ** 2).sum())
            kept += int(inside.sum())
    count = sum(map(len, residuals))
    return _NormalEquations(matrix, gradient, spread, squares, kept, count)


def _view_terms(
    mask: ShadowMask, at: _State, samples: Sequence[Sample], spread: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return what `bias_covariance` takes of the views' own displacements and softenings."""
    shadow = Shadow(mask, at.placement)
    size, own_size = len(at.vector()), OF_VIEW * mask.views[0] * mask.views[1]
    mixed, own = np.zeros((size, own_size)), np.zeros((own_size, own_size))
    pull = np.zeros(own_size)
    residuals = _all_residuals(mask, at, samples)
    for index, sample in enumerate(samples):
        for how, residual, deviation in _pixel_chunks(at, sample, index, residuals[index]):
            slope, by_view = shadow.slopes_by_view(*how)
            slope = _join_slopes(shadow.readings(*how), slope, at.own[index])
            scaled, scale = residual / spread, 1 / (deviation * spread)
            slope, by_view = slope * scale, by_view * scale
            weighted = by_view * tukey_weights(scaled)[:, None]
            mixed[_parameter_places(at, index)] += slope.T @ weighted
            own += by_view.T @ weighted
            pull += weighted.T @ scaled
    return mixed, own, pull


def _rows_covariance(
    mask: ShadowMask, at: _State, samples: Sequence[Sample], spread: float, covariance: Array
) -> NDArray[np.float64]:
    """Return what rows that err alike add to the covariance, as the darks' repeats show it.

    A row's error is its neighbour's to a share (autoregressive). Each whiteboard has its own;
    those of the references and of the darks are in all whiteboards. What whole frames of light do
    alike is counted beside.
    """
    size, height = len(covariance), len(samples[0].board.reading)
    known = [rows for sample in samples if (rows := sample.board.rows) is not None]
    if len(known) < len(samples):
        return np.zeros((size, size))
    own_dn2, next_dn2, noise_dn2, darks = (
        float(np.mean([getattr(rows, name) for rows in known]))
        for name in ("own_dn2", "next_dn2", "noise_dn2", "darks")
    )
    if not own_dn2 > SURE_ROWS * noise_dn2 * np.sqrt(2 / (height * max(darks - 1, 1))):
        return np.zeros((size, size))
    reach = min(ROWS_ALIKE, height - 1)
    share = float(np.clip(next_dn2 / own_dn2, 0.0, MOST_ALIKE))
    alike = share ** np.abs(np.arange(-reach, reach + 1))

    def squared(by_row: Array) -> NDArray[np.float64]:
        product = by_row.T @ correlate1d(by_row, alike, axis=0, mode="constant")
        return np.asarray(product, np.float64)

    def apart(by_row: Array) -> Array:
        return by_row - by_row.mean(axis=0)

    shadow = Shadow(mask, at.placement)
    added, of_references = np.zeros((size, size)), np.zeros((height, size))
    of_darks: dict[float, Array] = defaultdict(lambda: np.zeros((height, size)))
    for index, residual in enumerate(_all_residuals(mask, at, samples)):
        sample, rows = samples[index], known[index]
        by_row, read_by_row = np.zeros((height, size)), np.zeros((height, size))
        for how, left, deviation in _pixel_chunks(at, sample, index, residual):
            read, slope = shadow.with_slopes(*how)
            weight = tukey_weights(left / spread)[:, None] / np.square(deviation * spread)
            pull = _join_slopes(read, slope, at.own[index]) * weight
            where = how[0][:, :1], _parameter_places(at, index)
            np.add.at(by_row, where, pull)
            np.add.at(read_by_row, where, pull * read[:, None])
        by_row, read_by_row = by_row / rows.white_dn[0], read_by_row / rows.white_dn[1]
        added += squared(apart(by_row)) / sample.board.repeats
        of_references += apart(read_by_row) / np.sqrt(rows.references)
        of_darks[rows.exposure_s[0]] += by_row
        of_darks[rows.exposure_s[1]] -= read_by_row
    added += squared(of_references)
    for by_row in of_darks.values():
        added += squared(by_row) / darks
    return np.asarray(own_dn2 * covariance @ added @ covariance, np.float64)


def bias_covariance(
    covariance: Array, mixed: Array, own: Array, pull: Array
) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    """Return what the views' own displacements and softenings add to the placement's covariance.

    Beside it, the variances of these, by `Shadow.slopes_by_view`.

    covariance: of placement and whiteboards without them, (parameter, parameter). mixed:
    information between these and the views' own (see `Shadow.slopes_by_view`). own, pull:
    information of the latter, and the gradient of the log likelihood by them, at the placement
    fitted.
    """
    left = own - mixed.T @ covariance @ mixed
    kind = np.resize(KINDS, len(pull))
    assert len(pull) % OF_VIEW == 0
    evidence, squares = [], []
    for taus in product(TAUS_UM, repeat=max(KINDS) + 1):
        tau = np.array(taus)[kind]
        values, vectors = np.linalg.eigh(tau[:, None] * left * tau)
        values = 1 + np.maximum(values, 0)
        seen = vectors.T @ (tau * pull)
        likelihood = 0.5 * float(np.sum(seen**2 / values - np.log(values)))
        # Steps of the grid grow with tau.
        beforehand = np.log(taus) - 2 * np.log1p(np.square(taus) / TAU_UM**2 / 3)
        evidence.append(likelihood + float(beforehand.sum()))
        squares.append(np.square(taus))
    share = np.exp(np.array(evidence) - max(evidence))
    expected = share @ np.array(squares) / share.sum()
    moved = covariance @ mixed
    added = np.asarray((moved * expected[kind]) @ moved.T, np.float64)
    return added, tuple(float(expected[place]) for place in KINDS)


def _posterior(
    mask: ShadowMask, at: _State, samples: Sequence[Sample], spread: float, prior: _Prior
) -> float:
    residuals = _all_residuals(mask, at, samples)
    return sum(tukey_loss(residual / spread) for residual in residuals) + prior.loss(at)


def _likeliest_widths(
    normal: _NormalEquations, at: _State, placement: Array, centre: Array, own2: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the widths of brightness and place that make the readings likeliest, at a fit.

    placement, centre: precisions and centre of the placement's prior. own2: see `_prior`.
    """
    away = at.vector() - np.concatenate([centre, np.zeros(at.own.size)])
    pull = normal.gradient + normal.matrix @ away

    def evidence(widths: tuple[float, float]) -> float:
        precision = _prior(placement, centre, widths, own2).precision
        factor = np.linalg.cholesky(normal.matrix + np.diag(precision))
        seen = np.linalg.solve(factor, pull)
        own = precision[len(placement) :]
        return float(0.5 * seen @ seen - np.log(np.diag(factor)).sum() + 0.5 * np.log(own).sum())

    found = {widths: evidence(widths) for widths in product(BRIGHTNESSES, MOVES_UM)}
    best = max(found, key=lambda widths: found[widths])
    # A width that is hardly likelier than the smallest counts as 0.
    still = best[1] < LEAST_MOVED_UM
    still = still or found[best[0], MOVES_UM[0]] > found[best] - CLEARLY_LIKELIER
    steady = found[BRIGHTNESSES[0], best[1]] > found[best] - CLEARLY_LIKELIER
    return BRIGHTNESSES[0] if steady else best[0], MOVES_UM[0] if still else best[1]


@one_blas_thread()
def fit_placement(
    boards: Sequence[Board],
    camera: Camera,
    mask: ShadowMask,
    settings: FitSettings | None = None,
    start: Placement | None = None,
) -> Fit:
    """Return the placement that explains the whiteboards.

    start: from an earlier fit, to begin there without registering. Raises CalibrationError
    without whiteboards, for a mask that is not the design's (with the correlation found), and
    where the fit does not explain what it was given. Not converging is a status.
    """
    settings, tolerances = settings or FitSettings(), Tolerances()
    if not boards:
        raise CalibrationError("no whiteboard with the mask in: capture at least one")
    soft = starting_placement(camera, mask)
    placement = start or register(max(boards, key=_contrast), mask, soft).placement
    centre = soft.vector()
    deviations = tolerances.deviations(camera.views)
    if any(board.loose for board in boards):
        # Pinholes a little off their holes look like glass before the mask.
        deviations[SCALARS.index("glass_um")] *= OF_LOOSE
    # A stage sits where it was found; the prior is for what whiteboards do not determine.
    centre[OFFSETS] = placement.vector()[OFFSETS]
    of_placement = 1 / deviations**2
    widths = FIRST_BRIGHTNESS, FIRST_MOVED_UM
    own2 = _own_variances(boards)
    at = _State(placement, np.zeros((len(boards), OWN)))
    rng = np.random.default_rng(settings.seed)
    steps, converged = 0, False
    normal = None
    for half_px, limit in _widening_windows(mask, settings):
        each = max(limit // len(boards), FEWEST_PIXELS)
        samples = [board.sampled(half_px, each, rng) for board in boards]
        prior = _prior(of_placement, centre, widths, own2)
        at, taken, converged, normal = _descend(mask, at, samples, prior, settings)
        steps += taken
    assert normal is not None
    for _ in range(WIDTH_ROUNDS):
        widths = _likeliest_widths(normal, at, of_placement, centre, own2)
        prior = _prior(of_placement, centre, widths, own2)
        at, taken, converged, normal = _descend(mask, at, samples, prior, settings)
        steps += taken
    size = len(of_placement)
    covariance = np.asarray(np.linalg.inv(normal.matrix + np.diag(prior.precision)), np.float64)
    terms = _view_terms(mask, at, samples, normal.spread)
    of_views, astray2 = bias_covariance(covariance, *terms)
    of_rows = _rows_covariance(mask, at, samples, normal.spread, covariance)
    covariance = (covariance + of_views + of_rows)[:size, :size]
    checks = tuple(_check_board(mask, at, sample, index) for index, sample in enumerate(samples))
    alike = _fitted_correlation(mask, at, samples)
    placement = with_aperture_mean_one(at.placement)
    if alike < LEAST_FIT_CORRELATION:
        raise CalibrationError(
            f"the fit does not explain the whiteboards: their correlation with the shadow of the "
            f"design is {alike:.2f} after the fit, at least {LEAST_FIT_CORRELATION} is "
            "needed; check the mask and the camera's description, or use calibration method free"
        )
    undecided, more = _find_undecided(placement, covariance, tolerances, len(boards))
    kept = max(normal.kept, 1)
    # A pinhole that a hand put a little off looks like a mask that moved, and is none.
    firm = [check for check, board in zip(checks, boards, strict=True) if not board.loose]
    moved_um = _farthest_um(widths[1] if len(firm) == len(checks) else 0.0, firm)
    covariance[OFFSETS, OFFSETS] += np.eye(2) * moved_um**2
    return Fit(
        placement,
        covariance,
        alike,
        normal.squares / kept,
        1 - normal.kept / max(normal.count, 1),
        steps,
        "converged" if converged else "step limit reached",
        "" if converged else "raise max_steps, or capture another whiteboard",
        undecided,
        more,
        checks,
        float(widths[0]),
        moved_um,
        astray2,
    )


def _find_undecided(
    placement: Placement, covariance: NDArray[np.float64], tolerances: Tolerances, boards: int
) -> tuple[tuple[str, ...], int]:
    """Return the parameters that the prior decides, and how many more boards would decide them."""
    shares = shares_of_prior(placement, covariance, tolerances)
    rows, columns = np.shape(placement.aperture)
    names = zip(labels((rows, columns)), shares, strict=True)
    # Precision beyond the prior's grows with the number of whiteboards.
    have = np.maximum(1 / np.maximum(shares, 1e-6) ** 2 - 1, 1e-9)
    lacking = float((1 / MOST_OF_PRIOR**2 - 1) / have.min()) - 1
    more = int(np.clip(np.ceil(lacking * boards), 0, MOST_MORE_BOARDS))
    return tuple(name for name, share in names if share > MOST_OF_PRIOR), more


def _farthest_um(width_um: float, checks: Sequence[BoardCheck]) -> float:
    """Return how far from the fitted place the mask may stand, um: 0 where it seems to stand still.

    The largest significant move: the width of all moves takes a single outlier for chance.
    """
    sure = [
        float(np.hypot(*check.moved_um))
        for check in checks
        if np.hypot(*check.moved_um) > max(LEAST_MOVED_UM, SURE_MOVE * check.moved_deviation_um)
    ]
    return max([width_um if width_um > MOVES_UM[0] else 0.0, *sure])


def shares_of_prior(
    placement: Placement, covariance: NDArray[np.float64], tolerances: Tolerances
) -> NDArray[np.float64]:
    """Return every parameter's deviation over that of the prior, by their labels.

    Of the aperture's weights what counts is their share of the light: neither their common level
    nor what a falloff in their place would say is to be decided.
    """
    weights = np.array(placement.aperture)
    views = weights.shape
    prior = tolerances.deviations((views[0], views[1]))
    share = np.sqrt(np.diag(covariance)) / prior
    v, u = ((np.arange(count) - (count - 1) / 2) for count in views)
    far = (v[:, None] ** 2 + u**2).ravel()
    far = far / max(far.max(), 1e-12)
    count, first = weights.size, len(SCALARS)
    slopes = np.zeros((count, len(covariance)))
    slopes[:, first:] = np.diag(1 / weights.ravel())
    slopes[:, SCALARS.index("falloff")] = far / (1 + placement.falloff * far)
    slopes -= slopes.mean(axis=0)
    spread = np.sqrt(np.einsum("ij,jk,ik->i", slopes, covariance, slopes))
    share[first:] = np.minimum(spread / tolerances.aperture, 1.0)
    share[SCALARS.index("falloff")] = 0.0
    return share


def _widening_windows(mask: ShadowMask, settings: FitSettings) -> list[tuple[float, int]]:
    """Return half sides of windows, in pixels, that widen to the picture, and how many pixels."""
    whole = max(mask.pixel_shape()) / 2
    half, found = float(FIRST_WINDOW_PX), []
    while half < whole:
        found.append((half, settings.first_pixels))
        half *= 2
    return [*found, (whole, settings.first_pixels), (whole, settings.pixels)]


def _descend(
    mask: ShadowMask,
    at: _State,
    samples: Sequence[Sample],
    prior: _Prior,
    settings: FitSettings,
) -> tuple[_State, int, bool, _NormalEquations]:
    """Return the state after Levenberg-Marquardt steps on these samples."""
    damping = 1e-3
    normal = _normal_equations(mask, at, samples)
    for step in range(settings.max_steps):
        pull = prior.precision * (prior.centre - at.vector())
        value = _posterior(mask, at, samples, normal.spread, prior)
        while True:
            matrix = normal.matrix + np.diag(prior.precision)
            matrix[np.diag_indices_from(matrix)] *= 1 + damping
            trial = _step_within_limits(at, matrix, normal.gradient + pull)
            found = _posterior(mask, trial, samples, normal.spread, prior)
            if found <= value or damping > 1e6:
                break
            damping *= 8
        damping = max(damping / 5, 1e-7)
        deviations = 1 / np.sqrt(np.diag(normal.matrix) + prior.precision)
        size = float(np.max(np.abs(trial.vector() - at.vector()) / deviations))
        if found <= value:
            at = trial
        normal = _normal_equations(mask, at, samples)
        if size < settings.tolerance or value - found < LEAST_GAIN:
            return at, step + 1, True, normal
    return at, settings.max_steps, False, normal


def _step_within_limits(at: _State, matrix: Array, gradient: Array) -> _State:
    """Return the state after a step; parameters at a limit are held, the others solved again."""
    here = at.vector()
    move = np.linalg.solve(matrix, gradient)
    trial = at.moved(move)
    held = np.abs(trial.vector() - here - move) > 1e-12
    if not held.any():
        return trial
    free = ~held
    move[held] = (trial.vector() - here)[held]
    rest = gradient[free] - matrix[np.ix_(free, held)] @ move[held]
    move[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest)
    return at.moved(move)


def _contrast(board: Board) -> float:
    """Return how far above its noise a board varies."""
    usable = board.usable
    if not usable.any():
        raise CalibrationError(f"{board.name}: no usable pixel")
    return float(np.std(board.reading[usable]) / np.sqrt(np.median(board.variance[usable])))


def _fitted_correlation(mask: ShadowMask, at: _State, samples: Sequence[Sample]) -> float:
    """Return the correlation of readings and fit, every colour of a whiteboard with its level."""
    residuals = np.concatenate(_all_residuals(mask, at, samples))
    reading, deviation = (
        np.concatenate([getattr(sample, name) for sample in samples])
        for name in ("reading", "deviation")
    )
    channels = [
        sample.channels.astype(np.int64) + index * (ANY_COLOUR + 1)
        for index, sample in enumerate(samples)
    ]
    return correlation(reading, reading - residuals * deviation, np.concatenate(channels))


def _check_board(mask: ShadowMask, at: _State, sample: Sample, index: int) -> BoardCheck:
    """Return how far one board's brightness and mask are off, the placement as fitted."""
    shadow = Shadow(mask, at.placement)
    board, own = sample.board, at.own[index]
    opening = at.opening(board, index)
    fitted, slope = shadow.with_slopes(sample.pixels, sample.channels, *opening)
    rows = np.stack([fitted, slope[:, 0], slope[:, 1]], axis=1) / sample.deviation[:, None]
    residual = (sample.reading - (1 + own[0]) * fitted) / sample.deviation
    weight = np.ones(len(residual))
    more = np.zeros(3)
    matrix = np.eye(3)
    for _ in range(8):
        matrix = rows.T @ (rows * weight[:, None])
        more = np.linalg.solve(matrix, rows.T @ (weight * residual))
        left = residual - rows @ more
        weight = tukey_weights(left / _robust_spread([left]))
    found = own + more
    spread = _robust_spread([residual])
    inside = tukey_weights(residual / spread) > 0
    deviation = np.sqrt(np.diag(np.linalg.inv(matrix))) * spread
    return BoardCheck(
        board.name,
        float(1 + found[0]),
        float(deviation[0]),
        (float(found[1]), float(found[2])),
        float(deviation[1:].max()),
        board.taken_s,
        float(np.mean(residual[inside] ** 2)),
        float(1 - inside.mean()),
    )
