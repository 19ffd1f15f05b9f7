"""How uneven the white board is over the directions into the aperture, from the board turned.

What the camera lets through of a view stays when the board is turned in its plane; what the board
sends into it turns. With the board's radiance 1 + sum_k c_k t_k(u, v), t the gradients and the
saddles over the aperture, the same open whiteboard after the turn reads
sum_j psi_j (1 + sum_k c_k (t_k(turned u_j) - t_k(u_j))): linear in c, and the views' shadows show
the terms apart. Which way a board was turned is not taken on trust: half a turn reads alike both
ways, and with it a quarter turn shows its sense. The mask may have moved meanwhile: its place is
fitted beside. An error of Psi looks alike in all boards: the board before it was turned shows it.

What no turn changes, a lamp from one side, gloss, a board that does not fill the aperture, looks as
if the aperture let so much through. `leaning` measures the lopsided part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.choice import white_by_view
from emmc_rig.calibration.fit import Fit
from emmc_rig.calibration.placement import SCALARS
from emmc_rig.calibration.robust import deviation_of
from emmc_rig.calibration.shadow import Shadow, ShadowMask, far_shares
from emmc_rig.calibration.whiteboard import Calibration
from emmc_rig.model.sensing import Psi

Array = NDArray[np.floating]
SIGNIFICANT = 4.0
"""Standard deviations, from which on a board counts as uneven: by chance once in 16 000."""
LEAST_UNEVENNESS = 1e-3
"""Relative, of the board over angle: less is left alone."""
ROUNDS = 4
CLIP = 4.0
"""Robust deviations at which residuals are clipped: pixels of normal noise keep theirs."""
SAMPLED = 500_000
"""Pixels at most: of more the board's unevenness is known to 1e-5."""
CLEARLY = 12.0
"""Difference of the squared misfits, in deviations, that decides the sense of turning."""
LEAST_LEANING, LEANS = 5e-3, 5.0
"""The least share of the light, peak to peak over the views, and its least deviations to count."""
NATURAL = 2.0
"""Times what the cosine law makes of the outermost views: more is said."""


@dataclass(frozen=True, eq=False)
class BoardAngle:
    """The board's radiance into every view, (v, u), mean 1, and its relative deviation.

    sense: 1 the boards were turned as the sensor's rows and columns run (from right to down), -1
    the other way, 0 it cannot be told: both are counted. moved_um: by how many degrees turned, how
    far the mask stood from where it stood before, (x, y), and the deviation of that. disagreement:
    of the boards' unevenness among themselves, peak to peak, and in deviations.
    """

    radiance: NDArray[np.float64]
    deviation: NDArray[np.float64]
    significance: float
    sense: int
    moved_um: Mapping[float, tuple[float, float, float]]
    disagreement: tuple[float, float]

    @property
    def uneven(self) -> bool:
        """Whether the board is uneven beyond its deviation, and enough to matter."""
        return self.significance > SIGNIFICANT and float(np.ptp(self.radiance)) > LEAST_UNEVENNESS


def _radiance_terms(views: tuple[int, int], turn_deg: float) -> NDArray[np.float64]:
    """Return the gradients and saddles over the aperture of a board turned so, (term, v, u)."""
    v, u = (np.linspace(-1, 1, count) if count > 1 else np.zeros(1) for count in views)
    turn = np.deg2rad(turn_deg)
    down = np.cos(turn) * v[:, None] - np.sin(turn) * u
    across = np.sin(turn) * v[:, None] + np.cos(turn) * u
    return np.stack([across, down, across**2 - down**2, across * down])


@dataclass(frozen=True, eq=False)
class _TurnedBoard:
    """What one turned board says: change of the radiance by term, its information, the mask's move.

    squares: mean squared residual, over the noise.
    """

    change: NDArray[np.float64]
    information: NDArray[np.float64]
    moved_um: tuple[float, float, float]
    squares: float


def board_over_angle(
    psi: Psi, turned: Mapping[float, Board], shadow: Shadow | None = None
) -> BoardAngle:
    """Return the board's radiance from open whiteboards by the degrees it was turned.

    psi: as measured with the board not turned. turned: with the board at 0 degrees, what Psi errs
    by is fitted beside; without it, Psi is taken as true. shadow: of the mask as fitted, which
    shows where it stands (None: it is taken to stand still).
    """
    views = psi.light_field_shape[:2]
    upright = _radiance_terms(views, 0.0)
    size, flat = len(upright), upright.reshape(len(upright), -1)
    seen = {turn: _fit_turned_board(psi, board, flat, shadow) for turn, board in turned.items()}
    noise = max(1.0, float(np.mean([measured.squares for measured in seen.values()])))
    of_psi = np.eye(size)[: size * (0.0 in seen)]

    def solve_for_sense(sense: int) -> tuple[Array, Array, float, Array]:
        """Return terms, covariance, squared misfit and what each board leaves."""
        count = size + len(of_psi)
        matrix, right = np.zeros((count, count)), np.zeros(count)
        maps = {}
        for turn, measured in seen.items():
            change = (_radiance_terms(views, sense * turn) - upright).reshape(size, -1)
            # The change by its own terms, and the error of Psi, which is in every board.
            maps[turn] = np.vstack([change @ np.linalg.pinv(flat), of_psi])
            matrix += maps[turn] @ measured.information @ maps[turn].T
            right += maps[turn] @ measured.information @ measured.change
        inverse = np.linalg.pinv(matrix, rcond=1e-9, hermitian=True)
        found = inverse @ right
        left = np.array([measured.change - maps[turn].T @ found for turn, measured in seen.items()])
        pairs = zip(left, seen.values(), strict=True)
        misfit = sum(float(off @ measured.information @ off) for off, measured in pairs)
        return found[:size], inverse[:size, :size] * noise, misfit / noise, left

    both = {sense: solve_for_sense(sense) for sense in (1, -1)}
    sense = min(both, key=lambda tried: both[tried][2])
    found, covariance, misfit, left = both[sense]
    inverse = np.linalg.pinv(covariance, rcond=1e-9, hermitian=True)
    significance = float(np.sqrt(found @ inverse @ found / size))
    freedom = size * (len(seen) - 1) - len(of_psi)
    if both[-sense][2] - misfit < CLEARLY:
        other = both[-sense][0]
        covariance = covariance + np.outer(found - other, found - other) / 4
        found, sense = (found + other) / 2, 0
    radiance = 1 + np.tensordot(found, upright, 1)
    deviation = np.sqrt(np.einsum("kvu,kl,lvu->vu", upright, covariance, upright))
    apart = max(float(np.ptp(change @ flat)) for change in left)
    return BoardAngle(
        radiance / radiance.mean(),
        deviation.astype(np.float64),
        significance,
        sense,
        {turn: measured.moved_um for turn, measured in seen.items() if turn},
        (apart, float(np.sqrt(misfit / freedom)) if freedom else 0.0),
    )


def _fit_turned_board(psi: Psi, board: Board, flat: Array, shadow: Shadow | None) -> _TurnedBoard:
    """Return what a board says of the change of radiance; flat: the terms, (term, view).

        reading = sum over views j of  psi_j (level_colour + sum over terms t of  c_t flat_tj)
                  + slopes . move + noise

    Least squares for the terms c, the colours' levels, and the mask's move in x and y; residuals
    beyond CLIP deviations are left out, and the shadow is drawn anew after each move.
    """
    sample = board.sampled(np.inf, SAMPLED, np.random.default_rng(0))
    channels, reading, deviation = sample.channels, sample.reading, sample.deviation
    y, x = sample.pixels.T
    by_view = np.stack([plane[y, x] for plane in white_by_view(psi, board.shot)], axis=1)
    even, size = by_view.sum(axis=1), len(flat)
    move = np.zeros(2)
    for _ in range(ROUNDS):
        there, slopes = np.zeros(len(reading)), np.zeros((len(reading), 0))
        if shadow is not None:
            how = sample.pixels, channels, board.views_open
            x_um, y_um = board.stage_um
            at = (x_um + float(move[0]), y_um + float(move[1]))
            moved, by_all = shadow.with_slopes(*how, at, board.shot)
            there = moved - shadow.readings(*how, board.stage_um, board.shot)
            slopes = by_all[:, :2]
        light = even + there
        levels = [np.where(channels == c, light, 0) for c in np.unique(channels)]
        columns = np.column_stack([by_view @ flat.T, slopes, *levels]) / deviation[:, None]
        value = reading / deviation
        weight = np.ones(len(value))
        for _ in range(ROUNDS):
            normal = columns.T @ (columns * weight[:, None])
            solution = np.linalg.lstsq(normal, columns.T @ (weight * value), rcond=None)[0]
            left = value - columns @ solution
            limit = CLIP * deviation_of(left)
            weight = (np.abs(left) < limit).astype(np.float64)
        step = solution[size : size + slopes.shape[1]]
        if not step.size:
            break
        move = move + step
        if np.abs(step).max() < 1e-3:
            break
    squares = float((weight * left**2).sum() / weight.sum())
    # The levels of the colours and the mask's place are free: their Schur complement is left.
    terms, free = slice(0, size), slice(size, None)
    explained = normal[terms, free] @ np.linalg.solve(normal[free, free], normal[free, terms])
    information = normal[terms, terms] - explained
    moved_deviation = 0.0
    if slopes.shape[1]:
        covariance = np.linalg.pinv(normal, rcond=1e-12, hermitian=True) * max(squares, 1.0)
        moved_deviation = float(np.sqrt(np.diag(covariance)[size : size + 2].max()))
    moved_um = float(move[0]), float(move[1]), moved_deviation
    return _TurnedBoard(solution[:size].astype(np.float64), information, moved_um, squares)


def take_out(board: BoardAngle, known: Calibration) -> None:
    """Make a calibration what an even board would have given."""
    weights, deviation = known.psi.weights, known.deviation
    for shot, v, u in np.ndindex(*weights.shape[:3]):
        radiance = board.radiance[v, u]
        even = weights[shot, v, u] / radiance
        spread = np.square(deviation[shot, v, u] / radiance)
        spread += np.square(even * (board.deviation[v, u] / radiance))
        weights[shot, v, u], deviation[shot, v, u] = even, np.sqrt(spread)


@dataclass(frozen=True, eq=False)
class Leaning:
    """What of the views' light lamp or board may make.

    lopsided: over the views, (v, u): 0 where nothing is sure. falling: the share by which the
    outermost views are darker than the middle, alike on every side, if that is more than the
    cosine law makes: lenses vignette so, and so do gloss and a board that is too small.
    """

    lopsided: NDArray[np.float64]
    falling: float


def leaning(fit: Fit, mask: ShadowMask, board: BoardAngle | None) -> Leaning:
    """Return what of the views' light lamp or board may make: that which is smooth over the views.

    board: what the turned boards showed, which is not counted again. Lenses let as much through on
    either side. No lens is known well enough to say that what falls alike on every side is too
    much, and no turn of the board tells it apart.
    """
    views = mask.views
    across, down, *_ = _radiance_terms(views, 0.0)
    far = far_shares(views)
    through = 1 + fit.placement.falloff * far
    sent = board.radiance if board is not None and board.uneven else np.ones(views)
    weights = (np.array(fit.placement.aperture) * through / sent).ravel()
    weights = weights / weights.mean()
    columns = np.stack([(term - term.mean()).ravel() for term in (far, down, across)], axis=1)
    columns = columns[:, np.ptp(columns, axis=0) > 0]
    freedom = weights.size - columns.shape[1] - 1
    if freedom < columns.shape[1] or not columns.shape[1]:
        return Leaning(np.zeros(views), 0.0)
    inverse = np.linalg.pinv(columns.T @ columns, rcond=1e-9, hermitian=True)
    solution = inverse @ columns.T @ (weights - 1)
    rough = float(np.sum((weights - 1 - columns @ solution) ** 2)) / freedom
    # As sure as views differ from their neighbours, and as the fit is.
    slopes = np.zeros((weights.size, len(fit.covariance)))
    slopes[:, len(SCALARS) :] = np.diag(through.ravel())
    slopes[:, SCALARS.index("falloff")] = (np.array(fit.placement.aperture) * far).ravel()
    slopes -= slopes.mean(axis=0)
    of_fit = inverse @ columns.T @ slopes
    covariance = rough * inverse + of_fit @ fit.covariance @ of_fit.T
    half = [(count - 1) / 2 * mask.aperture_cell_um for count in views]
    natural = 2 * float(half[0] ** 2 + half[1] ** 2) / mask.lens_um**2
    deviations = np.sqrt(np.diag(covariance))
    falling = -float(solution[0])
    if falling < max(NATURAL * natural, LEANS * float(deviations[0])):
        falling = 0.0
    sure = np.abs(solution) > LEANS * deviations
    # What rises outward is no lens.
    sure[0] &= solution[0] > 0
    found = columns[:, sure] @ solution[sure]
    found = found if np.ptp(found) > LEAST_LEANING else np.zeros(weights.size)
    return Leaning(found.reshape(views), falling)


def add_error(known: Calibration, relative: Array | float) -> None:
    """Count a relative error, common or by view (v, u), in the deviations of a calibration."""
    weights, deviation = known.psi.weights, known.deviation
    by_view = np.broadcast_to(relative, weights.shape[1:3])
    for shot, v, u in np.ndindex(*weights.shape[:3]):
        more = np.square(by_view[v, u] * weights[shot, v, u])
        deviation[shot, v, u] = np.sqrt(np.square(deviation[shot, v, u]) + more)
