"""Veiling glare: light that scatters behind the mask and spreads over the whole picture.

In front of the colour filters a pixel gets of the mean of all light of its filter's colour, behind
them of the mean of all electrons. With t what the mask passes to a pixel, n the electrons of a
clear pixel, means over the picture, g and a the shares that scatter:

    t1 = (1 - g) t + g mean(t of the same filter)
    e  = (1 - a) n t1 + a mean(n t1)
    reading = e / white,    white = (1 - a) n + a mean(n)

The references show neither: they are as bright everywhere. Where the mask is dark the readings
show both; g much like a mask that leaks, a more where filters pass little. Under a coloured lamp,
glare behind the filters is bright in pixels of other colours like crosstalk, but carries no
picture of the mask. The readings of a fitted shadow are linear in small g and a; they are fitted
with the placement p, and with what whiteboards have of their own, by least squares:

    residual = slopes dp + d reading/dg g + d reading/da a + noise

Source of the selection: the evidence, as in `emmc_rig.calibration.causes`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.placement import OFFSET_X, Placement, Tolerances
from emmc_rig.calibration.shadow import Shadow, ShadowMask

Array = NDArray[np.floating]
SAMPLED = 60_000
"""Pixels of all whiteboards together: glare of 1 % is then known to a hundredth of it."""
LEAST_GLARE, SURE = 1e-3, 5.0
"""Least share of the light, and deviations, of glare: 0.1 % makes Psi 0.05 % wrong."""
OUTLIER = 5.0
"""Deviations from which on a residual is a defect's or dust's."""
OWN_BRIGHTNESS, OWN_MOVE_UM, OTHER_COLOURS = 0.02, 1.0, 0.05
"""Prior deviations of a whiteboard's brightness and move, and of crosstalk without references."""
IN_FRONT_MISS = 1e-3
"""Standard deviation of the share in front that the model's own errors leave: beside a mask that
leaks it shows only in what the colours' means differ by, of 1e-4 of the light at 1 % of glare; on
benches of 1 %, of 32x40 pixels, it was found 0.06 and 0.13 % short."""
IN_FRONT_LEAST = 3 * IN_FRONT_MISS
"""What is less a mask that leaks describes as well."""
STEP = 0.01
"""Of the glare, for derivatives: of the size that lenses have."""
IN_FRONT, BEHIND = 0, 1
"""Columns of the two kinds."""


@dataclass(frozen=True, eq=False)
class Glare:
    """How much of the light is spread over the picture: shares in front of and behind the filters.

    covariance: (2, 2) of these. response: (parameter of the placement, 2), by how much the
    placement's fit changes with each. white: (pixel_y, pixel_x), DN per second of the reference.
    filters: (pixel_y, pixel_x), the colour each pixel sees.
    """

    in_front: float
    behind: float
    covariance: NDArray[np.float64]
    response: NDArray[np.float64]
    white: NDArray[np.float64]
    filters: NDArray[np.uint8]

    @property
    def total(self) -> float:
        """The share of the light that is spread over the picture."""
        return self.in_front + self.behind

    @property
    def deviation(self) -> float:
        """Its standard deviation."""
        return float(np.sqrt(self.covariance.sum()))

    def changed(self, step: NDArray[np.float64]) -> Glare:
        """Return glare larger by these shares, (2,), in front and behind."""
        in_front, behind = self.in_front + float(step[0]), self.behind + float(step[1])
        return replace(self, in_front=in_front, behind=behind)

    def taken_out(self, board: Board) -> Board:
        """Return a whiteboard as it would be without glare."""
        a, use = self.behind, board.usable
        clear = self.white - a * self.white.mean()
        everywhere = float((board.reading * self.white)[use].mean())
        reading = (board.reading * self.white - a * everywhere) / clear
        reading = reading - self.in_front * _means(reading, self.filters, use)
        scale = self.white / clear / (1 - self.in_front)
        return replace(
            board,
            reading=(reading / (1 - self.in_front)).astype(np.float32),
            variance=(board.variance * scale**2).astype(np.float32),
        )

    def put_in(self, weights: Array, binning: int = 1) -> Array:
        """Return coefficients (..., y, stored colour, x) with the glare; given without."""
        white = self.white.repeat(binning, 0).repeat(binning, 1)
        filters = self.filters.repeat(binning, 0).repeat(binning, 1)
        found = np.empty_like(weights)
        clear = white - self.behind * white.mean()
        every = np.ones(white.shape, dtype=bool)
        for place in np.ndindex(*weights.shape[:-3], weights.shape[-2]):
            index = (*place[:-1], slice(None), place[-1])
            plane = np.asarray(weights[index], np.float64)
            plane = plane + self.in_front * (_means(plane, filters, every) - plane)
            electrons = clear * plane
            spread = self.behind / (1 - self.behind) * electrons.mean()
            found[index] = (electrons + spread) / white
        return found


def _means(plane: Array, filters: NDArray[np.uint8], use: NDArray[np.bool_]) -> Array:
    """Return at every pixel the mean over the used pixels of the same filter, (y, x)."""
    found = np.zeros(plane.shape)
    for colour in np.unique(filters):
        same = filters == colour
        if (same & use).any():
            found[same] = plane[same & use].mean()
    return found


class _Terms(NamedTuple):
    """A whiteboard's sampled readings, linear in all parameters, over their deviations."""

    residual: Array
    """(n,)."""
    by_placement: Array
    """(n, parameter)."""
    own: Array
    """(n, 3): brightness, and moves of the mask, x and y."""
    by_glare: Array
    """(n, 2 or 3): in front, behind; crosstalk, where it was not measured."""


def measure_glare(
    placement: Placement,
    boards: Sequence[Board],
    white: Array,
    filters: NDArray[np.uint8],
    masks: Callable[[float], ShadowMask],
    others: ShadowMask | None,
    known: Glare | None = None,
) -> Glare | None:
    """Return the glare that these whiteboards show beside the shadow fitted to them, or None.

    placement: as fitted to `boards`, which are settled. white, filters: see `Glare`. masks: returns
    the mask as filters show it that pass what coloured references leave if so much more of the
    light is glare behind the filters. others: the mask with STEP of crosstalk; None: crosstalk is
    measured. known: glare that the boards no longer have; the result is the sum of it and the rest.
    """
    rng = np.random.default_rng(0)
    mask, mixed = masks(0.0), masks(STEP)
    shadow, with_glare = Shadow(mask, placement), Shadow(mixed, placement)
    crossed = None if others is None else Shadow(others, placement)
    limit = max(SAMPLED // max(len(boards), 1), 200)
    terms = []
    for board in boards:
        sample = board.sampled(np.inf, limit, rng)
        how = sample.pixels, sample.channels, *board.opening
        read, slopes = shadow.with_slopes(*how)
        y, x = sample.pixels.T
        use = board.usable
        means = _means(board.reading, filters, use)[y, x]
        level = white[y, x]
        everywhere = float((board.reading * white)[use].mean())
        in_front = means - read
        behind = (everywhere - white.mean() * read) / level
        if mixed is not mask:
            behind = behind + (with_glare.readings(*how) - read) / STEP
        by_glare = [in_front, behind]
        if crossed is not None:
            by_glare.append((crossed.readings(*how) - read) / STEP)
        own = np.stack([read, *slopes[:, [OFFSET_X, OFFSET_X + 1]].T], axis=1)
        over = sample.deviation[:, None]
        terms.append(
            _Terms(
                (sample.reading - read) / sample.deviation,
                slopes / over,
                own / over,
                np.stack(by_glare, axis=1) / over,
            )
        )
    return _best_kind(terms, mask, white, filters, known)


def _best_kind(
    terms: Sequence[_Terms],
    mask: ShadowMask,
    white: Array,
    filters: NDArray[np.uint8],
    known: Glare | None,
) -> Glare | None:
    """Return glare in front of the filters, behind them or both, as the evidence is; or None.

    Where some is known its kinds stay, and their shares are corrected.
    """
    size = terms[0].by_placement.shape[1]
    matrix, right, squares, count = _normal_equations(terms, mask)
    kinds = [(BEHIND,)] if len(np.unique(filters)) == 1 else [(BEHIND,), (IN_FRONT,), (0, 1)]
    shares_known = np.zeros(2)
    if known is not None:
        shares_known[:] = known.in_front, known.behind
        kinds = [tuple(np.flatnonzero(shares_known).tolist())]
    nuisances = list(range(size + 2, size + terms[0].by_glare.shape[1]))
    rest = [*range(size), *nuisances, *range(size + terms[0].by_glare.shape[1], len(matrix))]
    plain = np.linalg.solve(matrix[np.ix_(rest, rest)], right[rest])
    noise2 = max((squares - right[rest] @ plain) / count, 1.0)
    best, found = 0.0, None
    for kind in kinds:
        columns = [size + k for k in kind]
        cross = np.linalg.solve(matrix[np.ix_(rest, rest)], matrix[np.ix_(rest, columns)])
        # What is left of the glare's columns beside all other parameters.
        information = matrix[np.ix_(columns, columns)] - matrix[np.ix_(columns, rest)] @ cross
        pull = right[columns] - cross.T @ right[rest]
        shares = np.linalg.solve(information, pull) + shares_known[list(kind)]
        gain = 0.5 * float(shares @ information @ shares) / noise2 - 0.5 * SURE**2 * len(kind)
        least = [IN_FRONT_LEAST if k == IN_FRONT else LEAST_GLARE for k in kind]
        if gain <= best or (shares < least).any():
            continue
        covariance = noise2 * np.linalg.inv(information)
        covariance += np.diag([IN_FRONT_MISS**2 * (k == IN_FRONT) for k in kind])
        both, response = np.zeros((2, 2)), np.zeros((size, 2))
        both[np.ix_(kind, kind)] = covariance
        response[:, list(kind)] = -cross[:size]
        of_kind = np.zeros(2)
        of_kind[list(kind)] = shares
        best = gain
        in_front, behind = of_kind.tolist()
        found = Glare(in_front, behind, both, response, white.astype(np.float64), filters)
    return found


def _normal_equations(
    terms: Sequence[_Terms], mask: ShadowMask
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, int]:
    """Return matrix and right side for placement, glare, then each whiteboard's own, with priors.

    And the sum of the squared residuals, and their number, without outliers.
    """
    shared = terms[0].by_placement.shape[1] + terms[0].by_glare.shape[1]
    total = shared + 3 * len(terms)
    matrix, right, squares, count = np.zeros((total, total)), np.zeros(total), 0.0, 0
    prior = 1 / Tolerances().deviations(mask.views) ** 2
    matrix[range(len(prior)), range(len(prior))] = prior
    if terms[0].by_glare.shape[1] > 2:
        matrix[shared - 1, shared - 1] = 1 / OTHER_COLOURS**2
    for index, term in enumerate(terms):
        spread = max(float(np.median(np.abs(term.residual))) * 1.4826, 1.0)
        inside = np.abs(term.residual) < OUTLIER * spread
        columns = [part[inside] for part in (term.by_placement, term.by_glare, term.own)]
        design, residual = np.concatenate(columns, axis=1), term.residual[inside]
        own = shared + 3 * index + np.arange(3)
        places = np.concatenate([np.arange(shared), own])
        matrix[np.ix_(places, places)] += design.T @ design
        matrix[own, own] += 1 / np.square([OWN_BRIGHTNESS, OWN_MOVE_UM, OWN_MOVE_UM])
        right[places] += design.T @ residual
        squares += float(residual @ residual)
        count += len(residual)
    return matrix, right, squares, count
