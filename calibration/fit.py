"""The parametric route: the placement of a known mask from a few whiteboards, robust and weighted.

Levenberg-Marquardt on the posterior of readings weighed by the noise, Tukey's biweight (dust, bad
pixels) and a wide prior (the bench's tolerances). Time and memory are linear in the pixels drawn:
the slopes of 100 000 pixels by 44 parameters are 35 MB. The fit begins on the middle of the
picture, registered by correlation, and widens: a small turn or stretch that moves the corner by
pixels moves the middle by little.

Through a real lens every view sees the mask a little displaced and a little softer than the
placement has it (aberrations). Neighbouring views are coded nearly alike, so that a displacement of
one reads like weight moved between its neighbours: where whiteboards open several views at once it
biases the aperture's weights, alike over the whole picture, which no residual shows. Displacements
and softenings are taken as normal, of variances tau^2 that the whiteboards' residuals show (random
effects: Searle, Casella, McCulloch 1992, chapter 6); the placement's covariance C then grows by
C N diag(tau^2) N^T C, N the information between its parameters and the views' own.

What all pixels of one whiteboard share is no noise of single pixels: shutter and lamp change its
brightness, and the mask stands a little elsewhere. Each whiteboard has these three of its own,
normal about 0, of the covariance that the causes have which the readings show (see `causes`);
brightness in addition by what repeats of a whiteboard differ among themselves, over their number.

Source of the loss: Holland & Welsch 1977; of the steps: Marquardt 1963.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from emmc_rig.calibration.boards import Board, Opening, Sample, unsteadiness2
from emmc_rig.calibration.causes import (
    BLUR,
    CREEP,
    EXPOSURE,
    HANDS,
    HOLES,
    LAMP,
    LEAST_LIGHT,
    LEAST_MOVED_UM,
    LEAST_OWN,
    LENS,
    OF_HOLES,
    OF_LIGHT,
    OF_PLATE,
    OWN,
    PLATE,
    SHIFTING,
    SIZE,
    STAGE,
    Cause,
    FoundCause,
    Geometry,
    OwnInformation,
    covariance_of,
    doubt_lone_move,
    find_causes,
    log_evidence,
    pinholes_found,
    possible_causes,
    through_pinhole,
    with_lens,
    with_sizes,
)
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.locator import register, starting_placement
from emmc_rig.calibration.placement import (
    PUPIL_X,
    RIM_SHARE,
    RIM_SHIFT,
    SCALARS,
    Placement,
    Tolerances,
    labels,
    with_aperture_mean_one,
)
from emmc_rig.calibration.pupil_shape import (
    CLEARLY_ROUND,
    LightGrowth,
    ViewLight,
    likeliest_pupil,
    likeliest_rim,
    measured_light,
)
from emmc_rig.calibration.robust import (
    correlation,
    deviation_of,
    tukey_curvatures,
    tukey_loss,
    tukey_weights,
)
from emmc_rig.calibration.shadow import (
    ANY_COLOUR,
    OF_VIEW,
    PUPIL_PARAMETERS,
    Shadow,
    ShadowMask,
    far_shares,
    light_slopes,
    openings,
)
from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.camera import Camera
from emmc_rig.model.pupil import Pupil

Array = NDArray[np.floating]
PIXELS, FIRST_PIXELS = 100_000, 12_000
"""At most so many of all whiteboards together, alike of each, drawn at random over the window; and
while the window widens. More make the placement surer than the mask is like its model."""
MOST_STEPS, SMALLEST_STEP = 40, 0.02
"""Steps of a fit, and the last one's size in standard deviations."""
CHUNK = 4096
"""Pixels whose slopes by view are held at once: by 25 views 4 MB."""
FIRST_WINDOW_PX = 64
"""Half a side: a turn of half a degree moves the window's corner by less than a pixel."""
FEWEST_PIXELS = 400
"""Of a whiteboard, however many there are."""
MOST_OF_PRIOR = 0.7
"""Of the prior's deviation: a parameter known no better stays at the design."""
LEAST_CHANGE, CHANGE_PIXELS = 1e-3, 500
"""Of Psi, by a parameter that the prior decides: less is of no account. By so many pixels."""
LEAST_GAIN = 0.01
"""Of the log posterior, in a last step: that of a move by a seventh of a standard deviation."""
FIRST_GAIN = 2.0
"""The same, before the last fit: of a move by two standard deviations, which later steps make."""
LEAST_CURVATURE = 0.3
"""Of the loss, over that of its weights: below it most pixels are outliers, and steps too long."""
MOST_MORE_BOARDS = 200
LEAST_FIT_CORRELATION = 0.7
"""Of readings and fitted shadow."""
SIDES = slice(3, 5)
"""Where the hole's width and height lie in a whiteboard's own parameters."""
OFFSETS = slice(0, 2)
"""Where offset_x_um and offset_y_um lie in the placement's vector."""
PUPIL, RIM = slice(PUPIL_X, RIM_SHARE), slice(RIM_SHARE, RIM_SHIFT + 1)
"""Where the parameters of pupil and rim lie there."""
STEPS_TO_PUPIL = 4
"""Of the fit, before the views' light is looked at: the mask is then about where it stands."""
HELD = 1e-6
"""Of the tolerance of parameters that nothing depends on."""
LOOSE_UM = 0.5
"""By which a hand's pinhole seems to move the mask, at first: 0.2 mm of 50 mm at 0.12 mm."""
OF_LOOSE = 0.05
"""Of the width of the prior of glass, which a displaced pinhole imitates."""
CLEAR_GAIN = 50.0
"""Of the log evidence by holes of other sizes: less does not bear to be looked at again."""
CAUSE_GAINS = (FIRST_GAIN, LEAST_GAIN, LEAST_GAIN)
"""The causes depend on the fit and the fit on the causes: in turn, to these last gains; the third
time where pinholes stand off their holes."""
LEAST_POWER, SURE_POWER = 5e-3, 10.0
"""Least difference of a response's power from 1, and how many deviations it must be."""
MOSTLY = 0.4
"""Of the residuals beyond the noise: what explains less is imitated by another fault."""
SURE_MOVE = 5.0
"""Deviations of a whiteboard's own move from which on it is no chance."""
KINDS = (0, 0, 1, 1, 2)
"""Of a view's own derivatives: displacement, softening along an axis, softening across both."""
TAUS_UM = np.geomspace(0.001, 1.0, 7)
"""Of each kind: from far less than any whiteboard shows to a tenth of a pixel."""
TAU_UM = 0.1
"""Beforehand tau is a half-t of 3 degrees of freedom and this scale (Gelman 2006, Bayesian Analysis
1:515): there are too few views to determine it well. Uniform up to 1 um, whiteboards of nine views
left a distance that was 12 % off undecided."""


@dataclass(frozen=True)
class BoardCheck:
    """How one whiteboard agrees with the fit of all: brightness and where its mask stood.

    brightness: over that of the other whiteboards. moved_um: (x, y) of the mask, from its place;
    moved_deviation_um: of either axis. taken_s: on the clock of the capture. chi2: mean squared
    residual over the noise, of the pixels that are no outliers. outliers: their share.
    """

    name: str
    brightness: float
    brightness_deviation: float
    moved_um: tuple[float, float]
    moved_deviation_um: float
    taken_s: float
    chi2: float
    outliers: float


@dataclass(frozen=True)
class Power:
    """The power 1 + size of the light that readings seem to go with; 1 of a linear sensor.

    explained: share of what the residuals exceed the noise by. error: relative, of Psi.
    """

    size: float = 0.0
    deviation: float = 1.0
    explained: float = 0.0
    error: float = 0.0

    @property
    def sure(self) -> bool:
        """Whether the power is not 1, and explains more of the residuals than another fault."""
        large = abs(self.size) > max(LEAST_POWER, SURE_POWER * self.deviation)
        return large and self.explained > MOSTLY


@dataclass(frozen=True, eq=False)
class Fit:
    """The placement fitted, how sure it is, and how well it explains the whiteboards.

    covariance: (parameter, parameter), in the order of `placement.vector()`.
    correlation: of the readings with the fitted shadow.
    chi2: mean squared residual over the noise without outliers. outliers: share of the pixels.
    undecided: names of parameters that the prior decides more than the whiteboards, and Psi shows.
    more_boards: how many more of the same kinds would decide them; MOST_MORE_BOARDS: no number.
    own, own_deviation: (board, OWN), brightness over 1, place of the mask, um, and width and
        height of the hole over 1, by which whiteboards differ, as the causes let them.
    causes: why whiteboards differ, the strongest first. A lamp that is not steady makes references
        differ likewise, which the covariance does not count.
    moved_um: how far the mask stands from its place; so it may in the shots of a scene, which the
        covariance counts.
    astray2: (OF_VIEW,), variances of the views' own displacements and softenings, um^2.
    power: of the light that readings go with.
    """

    placement: Placement
    covariance: NDArray[np.float64]
    correlation: float
    chi2: float
    outliers: float
    steps: int
    status: str
    undecided: tuple[str, ...]
    more_boards: int
    boards: tuple[BoardCheck, ...]
    own: NDArray[np.float64]
    own_deviation: NDArray[np.float64]
    causes: tuple[FoundCause, ...] = ()
    moved_um: float = 0.0
    astray2: tuple[float, ...] = ()
    power: Power = Power()

    @property
    def brightness_spread(self) -> float:
        """Standard deviation of all whiteboards' brightness, relative; 0: a steady lamp."""
        return self.width(LAMP)

    def width(self, cause: str) -> float:
        """Return the width of a cause by name, 0 of those that were not found."""
        return next((found.width for found in self.causes if found.name == cause), 0.0)

    def deviation(self, name: str) -> float:
        """Return the standard deviation of a parameter by name."""
        index = labels(np.shape(self.placement.aperture)).index(name)  # type: ignore[arg-type]
        return float(np.sqrt(self.covariance[index, index]))


FIRST_WIDTHS = {LAMP: 2e-3, STAGE: 0.2, HOLES: 2e-3, EXPOSURE: 2e-3}
"""Of what whiteboards have of their own, before their causes are known; hands beside: LOOSE_UM.
Holes of wider spread would take what a round pupil makes of the views."""


@dataclass(frozen=True, eq=False)
class _State:
    """The placement, and each whiteboard's own: (board, OWN).

    widening: whether holes of the pinhole may be larger than views.
    """

    placement: Placement
    own: NDArray[np.float64]
    widening: bool = False

    def vector(self) -> NDArray[np.float64]:
        """Return all parameters as one vector: of the placement, then of each whiteboard."""
        return np.concatenate([self.placement.vector(), self.own.ravel()])

    def moved(self, step: Array) -> _State:
        """Return the state after a step, within what is possible."""
        size = len(step) - self.own.size
        own = self.own + step[size:].reshape(self.own.shape)
        return _State(self.placement.moved(step[:size]), own, self.widening)

    def opening(self, board: Board, index: int) -> Opening:
        """Return parameters of the mask's shadow, at the mask position of one whiteboard."""
        views_open, (x, y), shot = board.opening
        return views_open, (x + float(self.own[index, 1]), y + float(self.own[index, 2])), shot

    def brightness(self, index: int) -> float:
        """Return the factor on the readings of one whiteboard."""
        return float(1 + self.own[index, 0])

    def places(self, index: int) -> NDArray[np.int64]:
        """Return where the placement's and one whiteboard's own parameters lie in the vector."""
        size = len(self.placement.vector())
        return np.concatenate([np.arange(size), size + index * OWN + np.arange(OWN)])


@dataclass(frozen=True, eq=False)
class _Prior:
    """Precision (all, all) and centre (all,) of all parameters, in the order of `_State.vector`."""

    precision: NDArray[np.float64]
    centre: NDArray[np.float64]

    def loss(self, state: _State) -> float:
        """Return what the prior adds to the loss."""
        off = state.vector() - self.centre
        return 0.5 * float(off @ self.precision @ off)

    def pull(self, state: _State) -> NDArray[np.float64]:
        """Return the gradient by which the prior draws the parameters to their centre, (all,)."""
        return np.asarray(self.precision @ (self.centre - state.vector()), np.float64)


@dataclass(frozen=True, eq=False)
class _BenchPrior:
    """What is known before the fit.

    precision, centre: of the placement, (parameter,). own2: (own,), variances beside those of the
    causes: brightness as repeats show it. causes: those possible; always: those that act.
    """

    precision: NDArray[np.float64]
    centre: NDArray[np.float64]
    own2: NDArray[np.float64]
    causes: Mapping[str, Cause]
    always: tuple[str, ...]
    geometry: Geometry
    own: NDArray[np.float64]
    """(own,): the middle of the causes' prior, of pinholes as `about` has them."""

    def holes(
        self, found: Sequence[FoundCause], state: _State, boards: Sequence[Board]
    ) -> NDArray[np.float64]:
        """Return the pinholes by the causes found, (board, 3), see `Geometry.light`."""
        own = state.own
        known = [cause for cause in found if cause.name in self.causes]
        causes, none = list(self.causes.values()), np.zeros((own.size, own.size))
        sized = with_sizes(known, causes, own.ravel() - self.own, none, self.own2)
        return pinholes_found(sized, boards, self.geometry.cell_um)

    def about(self, holes: Array, state: _State, boards: Sequence[Board]) -> _BenchPrior:
        """Return the prior with causes about the pinholes as they are, (board, 3)."""
        geometry = replace(self.geometry, pupil=state.placement.fitted_pupil())
        again = possible_causes(boards, geometry, holes)
        own = np.zeros((len(boards), OWN))
        for index, board in enumerate(boards):
            if through_pinhole(board):
                here, slopes = geometry.about(board, holes[index])
                own[index] = here - slopes @ holes[index]
        return replace(
            self,
            causes={cause.name: cause for cause in again},
            geometry=geometry,
            own=own.ravel(),
        )

    def causes_at(self, point: _Point) -> list[Cause]:
        """Return the possible causes, each with the least width that a fit there tells."""
        least = LEAST_LIGHT * float(np.sqrt(point.normal.spread**2 - 1))
        return [
            replace(cause, least=least) if cause.name in OF_LIGHT else cause
            for cause in self.causes.values()
        ]

    def with_widths(self, widths: Mapping[str, float], aberrant: bool = False) -> _Prior:
        """Return the prior of all parameters; widths: of the causes, by name, possible or not.

        aberrant: whether aberrations displace the views.
        """
        possible = {name: width for name, width in widths.items() if name in self.causes}
        # In units of what is known beside the causes: their widths are millions of it.
        unit = np.sqrt(np.outer(self.own2, self.own2))
        own = np.linalg.inv(covariance_of(self.causes, possible, self.own2) / unit) / unit
        size = len(self.centre)
        precision = np.zeros((size + len(own), size + len(own)))
        of_placement = self.precision.copy()
        if aberrant:
            # Views that are displaced look like glass before the mask.
            of_placement[SCALARS.index("glass_um")] /= OF_LOOSE**2
        precision[:size, :size] = np.diag(of_placement)
        precision[size:, size:] = own
        return _Prior(precision, np.concatenate([self.centre, self.own]))

    def softened(self, found: Sequence[FoundCause], placement: Placement) -> _BenchPrior:
        """Return the prior with a hole of its own to every view that the lens blurs by its own.

        A box of side a has the variance a^2 / 12: a blur of sigma that grows by b is a side of 12
        sigma b / a^2 more. Light is none the more.
        """
        blur_um = next((cause.width for cause in found if cause.name == BLUR), 0.0)
        side_um = self.geometry.ratio * self.geometry.cell_um
        own2 = self.own2.reshape(-1, OWN).copy()
        own2[:, SIDES] += (12 * placement.blur_um * blur_um / side_um**2) ** 2
        return replace(self, own2=own2.ravel())

    def first_widths(self, ratio: float) -> dict[str, float]:
        """Return the widths before the causes are known."""
        return FIRST_WIDTHS | dict.fromkeys((HANDS, PLATE), LOOSE_UM / ratio)


def _bench_prior(
    boards: Sequence[Board], camera: Camera, mask: ShadowMask, placement: Placement
) -> _BenchPrior:
    """Return the prior about the design, with the mask's offset where it was registered."""
    centre = starting_placement(camera, mask).vector()
    # A stage sits where it was found; the prior is for what whiteboards do not determine.
    centre[OFFSETS] = placement.vector()[OFFSETS]
    deviations = Tolerances().deviations(camera.views)
    if placement.pupil is None:
        deviations[PUPIL] *= HELD
    if placement.pupil is None or placement.pupil.rim is None:
        deviations[RIM] *= HELD
    loose = any(board.loose for board in boards)
    if loose:
        # Pinholes a little off their holes look like glass before the mask.
        deviations[SCALARS.index("glass_um")] *= OF_LOOSE
    own2 = np.tile(np.square(LEAST_OWN), (len(boards), 1))
    own2[:, 0] += unsteadiness2(boards) / np.array([board.repeats for board in boards])
    ratio = mask.distance_um / mask.lens_um
    pupil = placement.fitted_pupil()
    geometry = Geometry(ratio, mask.aperture_cell_um, mask.views, pupil)
    known = {cause.name: cause for cause in possible_causes(boards, geometry)}
    always = (HANDS,) if loose else ()
    own = np.zeros(own2.size)
    return _BenchPrior(1 / deviations**2, centre, own2.ravel(), known, always, geometry, own)


def _robust_spread(residuals: Sequence[Array]) -> float:
    """Return the robust deviation of the residuals in units of the noise, at least 1."""
    return max(1.0, deviation_of(np.concatenate(residuals)))


class _Linear(NamedTuple):
    """Readings of a whiteboard's sample, linear in the parameters around a state."""

    residual: Array
    """(n,), in deviations."""
    slope: Array
    """(n, parameter + OWN), of the reading, over its deviation: by the placement, the whiteboard's
    brightness, and the mask's move in x and y."""

    def read(self, sample: Sample) -> Array:
        """Return the readings of the shadow, (n,): the slope by the whiteboard's brightness."""
        return self.slope[:, -OWN] * sample.deviation


def _linear_readings(
    mask: ShadowMask, state: _State, samples: Sequence[Sample]
) -> tuple[_Linear, ...]:
    """Return every whiteboard's readings and slopes at a state.

    reading = (1 + brightness) (shadow, with the mask moved, + wider d(shadow)/d(width) + ...)
    """
    shadow, found = Shadow(mask, state.placement), []
    for index, sample in enumerate(samples):
        opening, brightness = state.opening(sample.board, index), state.brightness(index)
        where = sample.pixels, sample.channels, *opening
        if state.widening and sample.board.views_open.sum() == 1:
            read, slope, by_sides = shadow.with_widening(*where, sides=state.own[index, SIDES])
        else:
            read, slope = shadow.with_slopes(*where)
            by_sides = np.zeros((len(read), 2))
        # In one pass over memory, which takes as long as the arithmetic.
        count, factor = slope.shape[1], brightness / sample.deviation
        slopes = np.empty((len(read), count + OWN))
        np.multiply(slope, factor[:, None], out=slopes[:, :count])
        slopes[:, count] = read / sample.deviation
        slopes[:, count + 1 : count + 3] = slopes[:, OFFSETS]
        slopes[:, count + 3 :] = factor[:, None] * by_sides
        found.append(_Linear((sample.reading - brightness * read) / sample.deviation, slopes))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """Gauss-Newton normal equations, and what the residuals are like.

    spread: robust deviation of the residuals, in deviations. curvature: of Tukey's loss, over
    that of the weighted squares, mean of all pixels. squares: sum of squared residuals of the
    `kept` pixels that are no outliers, of `count`.
    """

    matrix: NDArray[np.float64]
    gradient: NDArray[np.float64]
    spread: float
    curvature: float
    squares: float
    kept: int
    count: int


def _normal_equations(state: _State, linear: Sequence[_Linear]) -> _NormalEquations:
    """Return the normal equations of all whiteboards.

    With r residuals over the spread, J their slopes, and w Tukey's weights of r,

        matrix = J^T diag(w) J,    gradient = J^T (w r)
    """
    spread = _robust_spread([each.residual for each in linear])
    size = len(state.vector())
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    squares, kept, weights, curvatures = 0.0, 0, 0.0, 0.0
    for index, (residual, slope) in enumerate(linear):
        places = state.places(index)
        weight = tukey_weights(residual / spread)
        rooted = slope * (np.sqrt(weight) / spread)[:, None]
        matrix[np.ix_(places, places)] += rooted.T @ rooted
        gradient[places] += slope.T @ (weight * residual) / spread**2
        inside = weight > 0
        squares += float((residual[inside] ** 2).sum())
        kept += int(inside.sum())
        weights += float(weight.sum())
        curvatures += float(tukey_curvatures(residual / spread).sum())
    count = sum(len(each.residual) for each in linear)
    curvature = curvatures / max(weights, 1e-300)
    return _NormalEquations(matrix, gradient, spread, curvature, squares, kept, count)


class _Point(NamedTuple):
    """A state, and the readings around it."""

    state: _State
    linear: tuple[_Linear, ...]
    """Of each whiteboard."""
    normal: _NormalEquations

    def loss(self, spread: float, prior: _Prior) -> float:
        """Return the loss of the residuals, at a spread, and of the prior."""
        of_readings = sum(tukey_loss(each.residual / spread) for each in self.linear)
        return of_readings + prior.loss(self.state)


def _point(mask: ShadowMask, state: _State, samples: Sequence[Sample]) -> _Point:
    linear = _linear_readings(mask, state, samples)
    return _Point(state, linear, _normal_equations(state, linear))


class _Descent(NamedTuple):
    """The end of Levenberg-Marquardt steps."""

    point: _Point
    steps: int
    converged: bool


def _descend(
    mask: ShadowMask,
    point: _Point,
    samples: Sequence[Sample],
    prior: _Prior,
    least_gain: float = LEAST_GAIN,
    most_steps: int = MOST_STEPS,
) -> _Descent:
    """Return the point after Levenberg-Marquardt steps on these samples.

        loss(p) = sum rho(r(p) / spread) + 1/2 (p - centre)^T P (p - centre)
        H = curvature matrix + P,    (H + damping diag H) step = gradient + P (centre - p)

    rho is Tukey's loss, P the prior's precision, the others as in `_normal_equations`: rho'' is
    less than the weights, and taken as the same share of them for all pixels. The damping grows
    until the loss falls. The last step is small in standard deviations, or gains less than
    least_gain.
    """
    damping = 1e-3
    for step in range(most_steps):
        state, normal = point.state, point.normal
        pull = prior.pull(state)
        loss = point.loss(normal.spread, prior)
        while True:
            matrix = max(normal.curvature, LEAST_CURVATURE) * normal.matrix + prior.precision
            matrix[np.diag_indices_from(matrix)] *= 1 + damping
            moved = _step_within_limits(state, matrix, normal.gradient + pull)
            # With its slopes: nearly every trial is the next point.
            trial = _point(mask, moved, samples)
            trial_loss = trial.loss(normal.spread, prior)
            if trial_loss <= loss or damping > 1e6:
                break
            damping *= 8
        damping = max(damping / 5, 1e-7)
        deviations = 1 / np.sqrt(np.diag(normal.matrix + prior.precision))
        size = float(np.max(np.abs(moved.vector() - state.vector()) / deviations))
        if trial_loss <= loss:
            point = trial
        if size < SMALLEST_STEP or loss - trial_loss < least_gain:
            return _Descent(point, step + 1, True)
    return _Descent(point, most_steps, False)


def _step_within_limits(state: _State, matrix: Array, gradient: Array) -> _State:
    """Return the state after a step; parameters at a limit are held, the others solved again."""
    here = state.vector()
    move = np.linalg.solve(matrix, gradient)
    trial = state.moved(move)
    held = np.abs(trial.vector() - here - move) > 1e-12
    if not held.any():
        return trial
    free = ~held
    move[held] = (trial.vector() - here)[held]
    rest = gradient[free] - matrix[np.ix_(free, held)] @ move[held]
    move[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest)
    return state.moved(move)


class _ViewTerms(NamedTuple):
    """Normal equations of the views' own displacements and softenings, see `Shadow.slopes_by_view`.

    all: placement and whiteboards' own. view: number of views times OF_VIEW.
    """

    mixed: NDArray[np.float64]
    """(all, view x OF_VIEW): information between both kinds of parameters."""
    own: NDArray[np.float64]
    """(view x OF_VIEW, view x OF_VIEW): information of the views' own."""
    pull: NDArray[np.float64]
    """(view x OF_VIEW,): gradient of the log likelihood by the views' own."""


def _view_terms(mask: ShadowMask, point: _Point, samples: Sequence[Sample]) -> _ViewTerms:
    """Return the normal equations of the views' own, at a fit; weights as in the placement's."""
    shadow, state, spread = Shadow(mask, point.state.placement), point.state, point.normal.spread
    size, own_size = len(state.vector()), OF_VIEW * mask.views[0] * mask.views[1]
    terms = _ViewTerms(
        np.zeros((size, own_size)), np.zeros((own_size, own_size)), np.zeros(own_size)
    )
    for index, (sample, (residual, slope)) in enumerate(zip(samples, point.linear, strict=True)):
        opening, places = state.opening(sample.board, index), state.places(index)
        weight = tukey_weights(residual / spread) / spread**2
        # Views that are closed have no part in the readings.
        parts = np.flatnonzero(np.repeat(sample.board.views_open.ravel(), OF_VIEW))
        for first in range(0, len(residual), CHUNK):
            part = slice(first, first + CHUNK)
            _, by_view = shadow.slopes_by_view(sample.pixels[part], sample.channels[part], *opening)
            by_view = by_view[:, parts] / sample.deviation[part, None]
            weighted = by_view * weight[part, None]
            terms.mixed[np.ix_(places, parts)] += slope[part].T @ weighted
            terms.own[np.ix_(parts, parts)] += by_view.T @ weighted
            terms.pull[parts] += weighted.T @ residual[part]
    return terms


def _bias_covariance(
    covariance: Array, terms: _ViewTerms, held: Array
) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    """Return what the views' own displacements and softenings add to a covariance C.

    Beside it, their variances tau^2, (OF_VIEW,), um^2.

        left = own - mixed^T C mixed         information that the placement leaves to the views' own
        rest = pull - mixed^T C held         and what pulls them
        evidence(tau) = 1/2 q^T (1 + T left T)^-1 q - 1/2 log|1 + T left T|,    q = T rest
        tau^2 = mean over the grid TAUS_UM, weighed by exp(evidence) and the half-t prior
        added = C mixed diag(tau^2) mixed^T C

    T is diag(tau), a tau of each kind (see KINDS). covariance: without the views' own. held:
    gradient by all other parameters. Only a parameter at its limit has a gradient: without `held`,
    a mask without any blur seems blurred view by view.
    """
    mixed, own, pull = terms
    left = own - mixed.T @ covariance @ mixed
    pull = pull - mixed.T @ (covariance @ held)
    kind = np.resize(KINDS, len(pull))
    assert len(pull) % OF_VIEW == 0
    evidence, squares = [], []
    for taus in product(TAUS_UM, repeat=max(KINDS) + 1):
        tau = np.array(taus)[kind]
        factor = np.linalg.cholesky(np.eye(len(pull)) + tau[:, None] * left * tau)
        seen = solve_triangular(factor, tau * pull, lower=True, check_finite=False)
        likelihood = 0.5 * float(seen @ seen) - float(np.log(np.diag(factor)).sum())
        # Steps of the grid grow with tau.
        beforehand = np.log(taus) - 2 * np.log1p(np.square(taus) / TAU_UM**2 / 3)
        evidence.append(likelihood + float(beforehand.sum()))
        squares.append(np.square(taus))
    share = np.exp(np.array(evidence) - max(evidence))
    expected = share @ np.array(squares) / share.sum()
    moved = covariance @ mixed
    added = np.asarray((moved * expected[kind]) @ moved.T, np.float64)
    return added, tuple(float(expected[place]) for place in KINDS)


def _find_causes(
    mask: ShadowMask, point: _Point, samples: Sequence[Sample], bench: _BenchPrior
) -> list[FoundCause]:
    """Return why whiteboards differ, at a fit.

    Aberrations displace the shadows of the views as pinholes do that stand off their holes, and
    are tried where something does.
    """
    causes = bench.causes_at(point)
    own = _own_information(point, bench)
    found = find_causes(own, causes, bench.own2, bench.always)
    if not any(cause.name in SHIFTING for cause in found) or bench.always:
        return found
    terms = _view_terms(mask, point, samples)
    displaced = np.resize(KINDS, len(terms.pull)) == KINDS[0]
    own = _own_information(point, bench, terms)
    own2 = np.concatenate([bench.own2, np.full(len(displaced), LEAST_OWN[1] ** 2)])
    return find_causes(own, with_lens(causes, displaced), own2)


def _about_pinholes(
    point: _Point, bench: _BenchPrior, found: Sequence[FoundCause], boards: Sequence[Board]
) -> _BenchPrior:
    """Return the prior about the pinholes' likelier places, by the causes found.

    Either with the areas found, or as if every hole were as large as a view.
    """
    still = _own_information(point, replace(bench, own=np.zeros_like(bench.own)))
    seen = bench.holes(found, point.state, boards)

    def evidence(tried: _BenchPrior) -> float:
        own = OwnInformation(still.information, still.pull - still.information @ tried.own)
        causes = find_causes(own, tried.causes_at(point), tried.own2, tried.always)
        widths = {cause.name: cause.width for cause in causes}
        there = float((still.pull + own.pull) @ tried.own) / 2
        return there + log_evidence(own, covariance_of(tried.causes, widths, tried.own2))

    places = seen, seen * [1, 1, 0]
    return max((bench.about(place, point.state, boards) for place in places), key=evidence)


def _own_widths(found: Sequence[FoundCause], ratio: float) -> dict[str, float]:
    """Return the widths of the causes that act on whiteboards' own parameters, by name.

    Aberrations displace what a single view shows: each whiteboard through the pinhole has the place
    of its view, as if hands had put the pinhole there, and the placement is not bent to follow.
    """
    widths = {cause.name: cause.width for cause in found}
    displaced = widths.pop(LENS, 0.0)
    if displaced:
        widths[HANDS] = float(np.hypot(widths.get(HANDS, 0.0), displaced / ratio))
    return widths


def _own_information(
    point: _Point, bench: _BenchPrior, terms: _ViewTerms | None = None
) -> OwnInformation:
    """Return what the readings say of the whiteboards' own parameters, the placement's taken out.

    With x the parameters from the prior's centre, p those of the placement, o the own ones, and P
    the placement's prior precision,

        g = gradient + matrix x
        S = matrix_oo - matrix_op (matrix_pp + P)^-1 matrix_po
        h = g_o - matrix_op (matrix_pp + P)^-1 g_p

    terms: of the views, whose own parameters count as own as well.
    """
    normal, state = point.normal, point.state
    away = state.vector() - np.concatenate([bench.centre, bench.own])
    matrix, pull = normal.matrix, normal.gradient + normal.matrix @ away
    if terms is not None:
        matrix = np.block([[matrix, terms.mixed], [terms.mixed.T, terms.own]])
        pull = np.concatenate([pull, terms.pull + terms.mixed.T @ away])
    size = len(bench.centre)
    of_placement = matrix[:size, :size] + np.diag(bench.precision)
    across = np.linalg.solve(of_placement, matrix[:size, size:]).T
    return OwnInformation(
        matrix[size:, size:] - across @ matrix[:size, size:], pull[size:] - across @ pull[:size]
    )


def settled(fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> list[Board]:
    """Return the whiteboards with the effects of the causes taken out.

    boards: those of the fit, in order. Each has the mask's place as fitted, the brightness of the
    others, and the area of a view; hands no longer count.
    """
    shadow, found = Shadow(mask, fit.placement), []
    for board, own in zip(boards, fit.own, strict=True):
        level = np.float32(1 + own[0])
        stage_um = (board.stage_um[0] + float(own[1]), board.stage_um[1] + float(own[2]))
        reading = board.reading / level
        if own[SIDES].any() and board.views_open.sum() == 1:
            pixels = np.argwhere(np.ones(reading.shape, dtype=bool))
            where = pixels, board.channels.ravel(), board.views_open, stage_um, board.shot
            wider = shadow.with_widening(*where, sides=own[SIDES])[0] - shadow.readings(*where)
            reading = reading - wider.reshape(reading.shape).astype(np.float32)
        variance = (board.variance / level**2).astype(np.float32)
        found.append(
            replace(board, reading=reading, variance=variance, stage_um=stage_um, loose=False)
        )
    return found


@one_blas_thread()
def fit_placement(
    boards: Sequence[Board],
    camera: Camera,
    mask: ShadowMask,
    start: Placement | Fit | None = None,
) -> Fit:
    """Return the placement that explains the whiteboards.

    start: a placement, to begin there without registering; or an earlier fit of these whiteboards,
    to begin where it ended, with the whole picture. Raises CalibrationError without whiteboards,
    for a mask that is not the design's (with the correlation found), and where the fit does not
    explain what it was given. Not converging is a status.
    """
    if not boards:
        raise CalibrationError("no whiteboard with the mask in: capture at least one")
    ratio, steps = mask.distance_um / mask.lens_um, 0
    whole = _drawn(boards, np.inf, PIXELS, np.random.default_rng(0))
    if isinstance(start, Fit):
        state, windows = _State(start.placement, start.own), [whole]
    else:
        state = _State(start or _registered(boards, camera, mask), np.zeros((len(boards), OWN)))
        windows = [*_widening_samples(boards, mask), whole]
    bench = _bench_prior(boards, camera, mask, state.placement)
    widths = bench.first_widths(ratio)
    prior = bench.with_widths(widths)
    for samples in windows:
        point = _point(mask, state, samples)
        if steps == 0 and not isinstance(start, Fit) and state.placement.pupil is None:
            # A pupil that is not known leads the fit astray: it is looked for after a few steps.
            point = _descend(mask, point, samples, prior, FIRST_GAIN, STEPS_TO_PUPIL).point
            seen = likeliest_pupil(_view_light(mask, point, prior), mask)
            point = _likelier(mask, point, samples, prior, seen)
            bench = _bench_prior(boards, camera, mask, point.state.placement)
            prior = bench.with_widths(widths)
        descent = _descend(mask, point, samples, prior, FIRST_GAIN)
        state, steps = descent.point.state, steps + descent.steps
    pupil = descent.point.state.placement.pupil
    if not isinstance(start, Fit) and (pupil is None or pupil.rim is None):
        growth = _light_growth(mask, descent.point, whole, prior)
        light = _view_light(mask, descent.point, prior)
        seen = likeliest_rim(light, growth, mask, descent.point.state.placement.fitted_pupil())
        point = _likelier(mask, descent.point, whole, prior, seen)
        if point is not descent.point:
            # The rim as fitted decides how many knots there are.
            at = point.state.placement
            held = dict.fromkeys(PUPIL_PARAMETERS, 0.0)
            at = replace(at, pupil=at.fitted_pupil(), **held)
            point = _point(mask, replace(point.state, placement=at), whole)
            bench = _bench_prior(boards, camera, mask, point.state.placement)
            prior = bench.with_widths(widths)
            descent = _descend(mask, point, whole, prior, FIRST_GAIN)
            steps += descent.steps
    found, off_plate, unlike = list[FoundCause](), False, False
    for turn, least_gain in enumerate(CAUSE_GAINS):
        if not descent.point.state.widening and any(cause.name in OF_HOLES for cause in found):
            state = replace(descent.point.state, widening=True)
            descent = descent._replace(point=_point(mask, state, whole))
        if unlike:
            # Where pinholes stand decides how much of their light the aperture's edge cuts.
            bench = _about_pinholes(descent.point, bench, found, boards)
        elif turn > 1:
            break
        found = _find_causes(mask, descent.point, whole, bench)
        aberrant = any(cause.name == LENS for cause in found)
        softened = bench.softened(found, descent.point.state.placement)
        prior = softened.with_widths(_own_widths(found, ratio), aberrant)
        descent = _descend(mask, descent.point, whole, prior, least_gain)
        steps += descent.steps
        off_plate = any(cause.name in OF_PLATE for cause in found)
        unlike = off_plate or any(
            cause.name in (HOLES, SIZE) and cause.gain > CLEAR_GAIN for cause in found
        )
    point, state = descent.point, descent.point.state
    checks = tuple(_check_board(point, sample, index) for index, sample in enumerate(whole))
    _refuse_unexplained(alike := _fitted_correlation(point, whole))
    normal, placement = point.normal, with_aperture_mean_one(state.placement)
    everything, astray2 = _covariance(mask, point, whole, prior)
    size = len(placement.vector())
    covariance, own_covariance = everything[:size, :size], everything[size:, size:]
    alone = np.linalg.inv(normal.matrix + prior.precision)
    undecided, more = _find_undecided(mask, placement, alone[:size, :size], len(boards))
    causes = with_sizes(
        found,
        list(bench.causes.values()),
        state.own.ravel() - bench.own,
        own_covariance,
        softened.own2,
    )
    causes = doubt_lone_move(causes, boards)
    moved_um = _astray_um(causes, checks, boards)
    own_deviation = np.sqrt(np.diag(own_covariance)).reshape(state.own.shape)
    if any(cause.name == LENS for cause in causes) and not off_plate:
        own_deviation[[through_pinhole(board) for board in boards], 1:3] = 0.0
    covariance[OFFSETS, OFFSETS] += np.eye(2) * moved_um**2
    return Fit(
        placement=placement,
        covariance=covariance,
        correlation=alike,
        chi2=normal.squares / max(normal.kept, 1),
        outliers=1 - normal.kept / max(normal.count, 1),
        steps=steps,
        status="converged" if descent.converged else "step limit reached",
        undecided=undecided,
        more_boards=more,
        boards=checks,
        causes=tuple(causes),
        own=_without_aberrations(state.own, causes, bench),
        own_deviation=own_deviation,
        moved_um=moved_um,
        astray2=astray2,
        power=_fit_power(point, whole, alone),
    )


def _registered(boards: Sequence[Board], camera: Camera, mask: ShadowMask) -> Placement:
    """Return where the mask is, by the whiteboard of most contrast."""
    soft = starting_placement(camera, mask)
    return register(max(boards, key=_contrast), mask, soft).placement


def _view_light(mask: ShadowMask, point: _Point, prior: _Prior) -> ViewLight:
    """Return the views' shares of the light, without a prior of the aperture's weights."""
    state, normal = point.state, point.normal
    weights = slice(len(SCALARS), len(state.placement.vector()))
    precision = prior.precision.copy()
    precision[weights, weights] = 0
    pull = normal.gradient + precision @ (prior.centre - state.vector())
    through = openings(mask, state.placement).shares(mask.views).ravel()
    through *= 1 + state.placement.falloff * far_shares(mask.views).ravel()
    return measured_light(through, state.vector(), normal.matrix + precision, pull, mask)


def _likelier(
    mask: ShadowMask,
    point: _Point,
    samples: Sequence[Sample],
    prior: _Prior,
    pupil: Pupil | None,
) -> _Point:
    """Return the point fitted behind another pupil where it is clearly likelier, else the point.

    pupil: None where the views' light shows no other.
    """
    if pupil is None:
        return point
    # The weights were of views open as before.
    even = tuple((1.0,) * mask.views[1] for _ in range(mask.views[0]))
    at = point.state.placement
    placement = replace(at, aperture=even, pupil=pupil, **dict.fromkeys(PUPIL_PARAMETERS, 0.0))
    start = replace(point.state, placement=placement)
    precision, deviations = prior.precision.copy(), Tolerances().deviations(mask.views)
    for part in (PUPIL, RIM) if pupil.rim else (PUPIL,):
        precision[part, part] = np.diag(1 / deviations[part] ** 2)
    freed = _Prior(precision, prior.centre)
    other = _descend(mask, _point(mask, start, samples), samples, freed, FIRST_GAIN).point
    likelier = point.loss(point.normal.spread, prior) - other.loss(point.normal.spread, freed)
    return other if likelier > CLEARLY_ROUND else point


def _light_growth(
    mask: ShadowMask, point: _Point, samples: Sequence[Sample], prior: _Prior
) -> LightGrowth:
    """Return how the light of single views grows over the picture, all parameters free.

    By a growth (g_x, g_y) a reading r at the place (x, y) of a whiteboard of the view grows by
    r (g_x x + g_y y), x and y as shares of the corner's distance.
    """
    opened = [np.argwhere(sample.board.views_open).tolist() for sample in samples]
    of_sample = [tuple(views[0]) if len(views) == 1 else None for views in opened]
    views = sorted({view for view in of_sample if view is not None})
    size, count, spread = len(prior.centre), 2 * len(views), point.normal.spread
    matrix, gradient = prior.precision.copy(), prior.pull(point.state)
    mixed, own, pull = np.zeros((size, count)), np.zeros((count, count)), np.zeros(count)
    middle = (np.array(mask.pixel_shape()) - 1) / 2
    corner_px = mask.corner_um / (mask.pitch_um * mask.binning)
    for index, (sample, linear) in enumerate(zip(samples, point.linear, strict=True)):
        residual, slope = linear
        places, view = point.state.places(index), of_sample[index]
        # Light that grows much is no outlier: the whiteboard's own spread decides.
        weight = tukey_weights(residual / _robust_spread([residual])) / spread**2
        weighted = slope * weight[:, None]
        matrix[np.ix_(places, places)] += weighted.T @ slope
        gradient[places] += weighted.T @ residual
        if view is not None:
            at = slice(2 * views.index(view), 2 * views.index(view) + 2)
            grown = (sample.pixels - middle)[:, ::-1] / corner_px * slope[:, -OWN, None]
            own[at, at] += grown.T @ (weight[:, None] * grown)
            mixed[places, at] += weighted.T @ grown
            pull[at] += grown.T @ (weight * residual)
    through = np.linalg.solve(matrix, mixed)
    information = own - mixed.T @ through
    return LightGrowth(np.array(views).reshape(-1, 2), pull - through.T @ gradient, information)


def _contrast(board: Board) -> float:
    """Return how far above its noise a board varies."""
    usable = board.usable
    if not usable.any():
        raise CalibrationError(f"{board.name}: no usable pixel; expose it otherwise")
    return float(np.std(board.reading[usable]) / np.sqrt(np.median(board.variance[usable])))


def _drawn(
    boards: Sequence[Board], half_px: float, pixels: int, rng: np.random.Generator
) -> list[Sample]:
    """Return samples of all whiteboards, alike of each, within `half_px` of the middle."""
    each = max(pixels // len(boards), FEWEST_PIXELS)
    return [board.sampled(half_px, each, rng) for board in boards]


def _widening_samples(boards: Sequence[Board], mask: ShadowMask) -> Iterator[list[Sample]]:
    """Yield samples of FIRST_PIXELS from windows that widen to the picture."""
    rng = np.random.default_rng(0)
    whole_px, half_px = max(mask.pixel_shape()) / 2, float(FIRST_WINDOW_PX)
    while half_px < whole_px:
        yield _drawn(boards, half_px, FIRST_PIXELS, rng)
        half_px *= 2
    yield _drawn(boards, whole_px, FIRST_PIXELS, rng)


def _references_covariance(
    point: _Point, samples: Sequence[Sample], covariance: Array
) -> NDArray[np.float64]:
    """Return what it adds to the covariance C that whiteboards share the noise of a reference.

    A reference's pixel that is brighter by e makes every reading r of the pixel r e darker. With
    g = w J r / (deviation spread^2) of a whiteboard's reading, and all g of a pixel summed first,

        added = C (sum over pixels of var e ((sum g) (sum g)^T - sum g g^T)) C

    The second is counted in C, as if every whiteboard had a reference of its own.
    """
    size, spread = len(covariance), point.normal.spread
    added = np.zeros((size, size))
    of_reference = defaultdict[int, list[int]](list)
    for index, sample in enumerate(samples):
        if sample.board.white2 is not None:
            of_reference[id(sample.board.white2)].append(index)
    for indices in of_reference.values():
        white2 = samples[indices[0]].board.white2
        assert white2 is not None
        flat = [np.ravel_multi_index(tuple(samples[i].pixels.T), white2.shape) for i in indices]
        drawn = np.unique(np.concatenate(flat))
        for first in range(0, len(drawn), CHUNK):
            pixels = drawn[first : first + CHUNK]
            summed = np.zeros((len(pixels), size))
            deviation = np.sqrt(white2.ravel()[pixels].astype(np.float64))
            for index, of_board in zip(indices, flat, strict=True):
                # Drawn pixels are in order.
                part = slice(*np.searchsorted(of_board, [pixels[0], pixels[-1] + 1]))
                at = np.searchsorted(pixels, of_board[part])
                residual, slope = point.linear[index]
                pull = tukey_weights(residual[part] / spread) / spread**2 * deviation[at]
                pull *= slope[part, -OWN]
                alone, places = slope[part] * pull[:, None], point.state.places(index)
                summed[np.ix_(at, places)] += alone
                added[np.ix_(places, places)] -= alone.T @ alone
            added += summed.T @ summed
    return np.asarray(covariance @ added @ covariance, np.float64)


def _covariance(
    mask: ShadowMask, point: _Point, samples: Sequence[Sample], prior: _Prior
) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    """Return the covariance of all parameters, and the variances of the views' own, see `Fit`.

    C = (matrix + P)^-1 of all parameters, and what the views' own and the noise of references add.
    """
    information = point.normal.matrix + prior.precision
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    held = point.normal.gradient + prior.precision @ (prior.centre - point.state.vector())
    of_views, astray2 = _bias_covariance(covariance, _view_terms(mask, point, samples), held)
    return covariance + of_views + _references_covariance(point, samples, covariance), astray2


def _fit_power(point: _Point, samples: Sequence[Sample], covariance: Array) -> Power:
    """Return the power of the light by one step of least squares from the fit.

    All parameters and each whiteboard's level are free: by a power of 1 + b a reading r changes by
    b (r log r - level r). covariance: of the parameters.
    """
    normal, spread = point.normal, point.normal.spread
    mixed, own, pull = np.zeros(len(covariance)), 0.0, 0.0
    change2, light2 = 0.0, 0.0
    for index, (sample, linear) in enumerate(zip(samples, point.linear, strict=True)):
        residual, slope = linear
        weight = tukey_weights(residual / spread) / spread**2
        read = np.maximum(linear.read(sample), 1e-3)
        bent = read * np.log(read)
        # A reading of 1 is that of a reference: whole apertures have their levels about it.
        if not through_pinhole(sample.board):
            change2, light2 = change2 + float(bent @ bent), light2 + float(read @ read)
        rows = (bent - read * float(bent @ read / (read @ read))) / sample.deviation
        mixed[point.state.places(index)] += slope.T @ (weight * rows)
        own += float((weight * rows) @ rows)
        pull += float((weight * rows) @ residual)
    left = max(own - float(mixed @ covariance @ mixed), 1e-12 * own)
    excess = max(normal.squares - normal.kept, 1.0) / spread**2
    error = abs(pull / left) * float(np.sqrt(change2 / max(light2, 1e-12)))
    return Power(pull / left, 1 / float(np.sqrt(left)), pull**2 / left / excess, error)


def _refuse_unexplained(alike: float) -> None:
    """Raise CalibrationError for a correlation of readings and fit that is too low."""
    if alike < LEAST_FIT_CORRELATION:
        raise CalibrationError(
            f"the fit does not explain the whiteboards: their correlation with the shadow of the "
            f"design is {alike:.2f} after the fit, at least {LEAST_FIT_CORRELATION} is "
            "needed; check the mask and the camera's description, or use calibration method free"
        )


def _without_aberrations(
    own: NDArray[np.float64], causes: Sequence[FoundCause], bench: _BenchPrior
) -> NDArray[np.float64]:
    """Return the own parameters, (board, OWN), by what the causes say where the lens has a part.

    What aberrations make of a view is part of Psi, and not to be taken out.
    """
    if not any(cause.name == LENS for cause in causes):
        return own
    explained = bench.own.copy()
    for cause in causes:
        if cause.name in bench.causes:
            explained += bench.causes[cause.name].columns @ np.array(cause.size)
    return explained.reshape(own.shape)


def _find_undecided(
    mask: ShadowMask, placement: Placement, covariance: NDArray[np.float64], boards: int
) -> tuple[tuple[str, ...], int]:
    """Return the parameters that the prior decides, and how many more boards would decide them.

    share^-2 = 1 + have, the precision that `boards` whiteboards have added to the prior's; it grows
    with their number. Decided: a share below MOST_OF_PRIOR, or a deviation that Psi does not show.
    """
    shares = shares_of_prior(mask, placement, covariance, Tolerances())
    names = labels(np.shape(placement.aperture))  # type: ignore[arg-type]
    lacking = [
        index
        for index in np.flatnonzero(shares > MOST_OF_PRIOR)
        if _change_of_psi(mask, placement, covariance[index], index) > LEAST_CHANGE
    ]
    if not lacking:
        return (), 0
    have = max(1 / min(float(shares[lacking].max()), 1.0) ** 2 - 1, 1e-9)
    more = int(
        np.clip(np.ceil(((1 / MOST_OF_PRIOR**2 - 1) / have - 1) * boards), 0, MOST_MORE_BOARDS)
    )
    return tuple(names[index] for index in lacking), more


def _change_of_psi(
    mask: ShadowMask, placement: Placement, covariances: Array, parameter: int
) -> float:
    """Return by how much Psi changes, relative, with a parameter by its deviation.

    covariances: (parameter,), of the parameter with each: the others move as it lets expect.
    """
    rng = np.random.default_rng(0)
    pixels = rng.integers(mask.pixel_shape(), size=(CHANGE_PIXELS, 2))
    channels = rng.integers(mask.cells[0].shape[-1], size=CHANGE_PIXELS).astype(np.uint8)
    step = covariances / np.sqrt(covariances[parameter])
    here, there = (
        Shadow(mask, at).coefficients(pixels, channels) for at in (placement, placement.moved(step))
    )
    return float(np.linalg.norm(there - here) / np.linalg.norm(here))


def _astray_um(
    causes: Sequence[FoundCause], checks: Sequence[BoardCheck], boards: Sequence[Board]
) -> float:
    """Return how far from the fitted place the mask may stand in a shot, um: 0 where it stays.

    The largest of three: the stage's moves by chance, its creep from the middle of the capture to
    the end, and the farthest sure move of a whiteboard, which the width of all takes for chance.
    """
    far_um = [cause.width for cause in causes if cause.name == STAGE]
    far_um += [float(np.hypot(*cause.size)) / 2 for cause in causes if cause.name == CREEP]
    by_name = {cause.name: cause for cause in causes}
    moves = [(*check.moved_um, check.moved_deviation_um) for check in checks]
    if CREEP in by_name:
        # The moves beside the creep are those of the stage.
        if STAGE not in by_name:
            return max(far_um)
        x_um, y_um = np.split(np.array(by_name[STAGE].size), 2)
        moves = list(
            zip(x_um, y_um, np.split(np.array(by_name[STAGE].deviation), 2)[0], strict=True)
        )
    perhaps = HANDS in by_name and STAGE in by_name[HANDS].instead
    far_um += [
        float(np.hypot(x_um, y_um))
        for (x_um, y_um, deviation_um), board in zip(moves, boards, strict=True)
        if (perhaps or not through_pinhole(board))
        and np.hypot(x_um, y_um) > max(LEAST_MOVED_UM, SURE_MOVE * deviation_um)
    ]
    return max([0.0, *far_um])


def shares_of_prior(
    mask: ShadowMask,
    placement: Placement,
    covariance: NDArray[np.float64],
    tolerances: Tolerances,
) -> NDArray[np.float64]:
    """Return every parameter's deviation over that of the prior, by their labels.

    Of the aperture's weights what counts is the views' share of the light: neither their common
    level is to be decided, nor what a falloff or another pupil in their place would say.
    """
    count, first = mask.views[0] * mask.views[1], len(SCALARS)
    share = np.sqrt(np.diag(covariance)) / tolerances.deviations(mask.views)
    opened = openings(mask, placement).shares(mask.views).ravel()
    slopes = light_slopes(mask, placement)
    slopes = opened[:, None] * (slopes - opened @ slopes / opened.sum())
    spread = np.sqrt(np.einsum("ij,jk,ik->i", slopes, covariance, slopes))
    share[first : first + count] = np.minimum(spread / tolerances.aperture, 1.0)
    share[SCALARS.index("falloff")] = 0.0
    share[PUPIL] = share[RIM] = 0.0
    return share


def _fitted_correlation(point: _Point, samples: Sequence[Sample]) -> float:
    """Return the correlation of readings and fit, every colour of a whiteboard with its level."""
    residuals = np.concatenate([each.residual for each in point.linear])
    reading, deviation = (
        np.concatenate([getattr(sample, name) for sample in samples])
        for name in ("reading", "deviation")
    )
    channels = [
        sample.channels.astype(np.int64) + index * (ANY_COLOUR + 1)
        for index, sample in enumerate(samples)
    ]
    return correlation(reading, reading - residuals * deviation, np.concatenate(channels))


def _check_board(point: _Point, sample: Sample, index: int) -> BoardCheck:
    """Return how far one board's brightness and mask are off, the placement as fitted.

    Robust least squares of the board alone, without the prior of its own: the fit's values, of
    which the prior has held back a part, and the steps (brightness, x, y) that are left.
    """
    residual, slope = point.linear[index]
    brightness = point.state.brightness(index)
    # Of the shadow itself, as if the whiteboard had the brightness of all.
    rows = np.stack([slope[:, -OWN], *(slope[:, OFFSETS] / brightness).T], axis=1)
    weight, step, matrix = np.ones(len(residual)), np.zeros(3), np.eye(3)
    for _ in range(8):
        matrix = rows.T @ (rows * weight[:, None])
        step = np.linalg.solve(matrix, rows.T @ (weight * residual))
        left = residual - rows @ step
        weight = tukey_weights(left / _robust_spread([left]))
    brightness, x_um, y_um = map(float, point.state.own[index, :3] + step)
    spread = _robust_spread([residual])
    inside = tukey_weights(residual / spread) > 0
    brightness_deviation, *moved_deviations = np.sqrt(np.diag(np.linalg.inv(matrix))) * spread
    return BoardCheck(
        name=sample.board.name,
        brightness=1 + brightness,
        brightness_deviation=float(brightness_deviation),
        moved_um=(x_um, y_um),
        moved_deviation_um=float(max(moved_deviations)),
        taken_s=sample.board.taken_s,
        chi2=float(np.mean(residual[inside] ** 2)),
        outliers=float(1 - inside.mean()),
    )
