"""Whether Psi still fits, from scene captures alone; what has moved, by how much, and the repair.

The drift (shift, rotation, scale, distance, tilt; crosstalk of the colour filters; brightness of
later shots against the first) that makes the evidence of blocks of the captures greatest (see
`evidence`). Where to begin follows from the correlation of the open aperture's shadow with the
captures over their local mean, at every shift and at turns and scales on a grid; from the best of
these, and from where the mask was, Gauss-Newton steps on the blocks' scores climb, on the middle of
the picture first. Its covariance is the sandwich of curvature and scores (White 1982), since the
prior of the scene is but a model; a drift is reported only where it is far outside that, and large
enough to matter. A place that explains the captures no better than places where the mask cannot be
is no place of the mask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import chdtrc

from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.colours import mixing
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.evidence import Prior, averaged, log_evidence, plane_prior
from emmc_rig.calibration.locator import over_local_level, search
from emmc_rig.calibration.parametric import Stages
from emmc_rig.calibration.placement import Placement
from emmc_rig.calibration.shadow import ANY_COLOUR, Shadow, ShadowMask
from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.frames import Frames
from emmc_rig.model.settings import Settings

Array = NDArray[np.floating]


class Kind(NamedTuple):
    """A kind of drift of the mask."""

    parameter: str
    """Of the placement; values are in its unit."""
    spread: float
    """Standard deviation of the prior, around where a search begins."""
    words: str


KINDS = {
    "shift_x_um": Kind("offset_x_um", 30.0, "a shift in x"),
    "shift_y_um": Kind("offset_y_um", 30.0, "a shift in y"),
    "rotation_rad": Kind("rotation_rad", 0.006, "a turn"),
    "scale": Kind("scale", 0.005, "a change of scale"),
    "distance_share": Kind("distance_share", 0.05, "a change of distance"),
    "tilt_x_rad": Kind("tilt_x_rad", 0.003, "a tilt in x"),
    "tilt_y_rad": Kind("tilt_y_rad", 0.003, "a tilt in y"),
}
CROSSTALK_SPREAD, BRIGHTNESS_SPREAD = 0.05, 0.1
"""Standard deviations of the priors: of the light in other colours, and of a later shot's."""
MOST_STEPS = 12
"""Gauss-Newton steps of a climb."""
WIDENING = 2
"""The part of the picture that steps are taken on, from one climb to the next."""
LOCAL_PX = 3.0
"""Deviation of the local mean: twice a cell, whose shadow is to be left."""
START_PX = 96
"""Side of the middle of the picture where a search begins."""
TURN_STEP_DEG, SCALE_STEP = 1.0, 0.015
"""Of which a half moves the rim of START_PX by less than half a pixel."""
SPARE = 1.5
"""Times the range: shifts looked at, to know one beyond it."""
DARK_SHARE = 0.05
"""Of the bright pixels' reading: a darker block is mostly noise."""
DECOYS = 12
LEAST_SURE = 6.0
"""Standard deviations of the decoys' evidence: chosen from hundreds of places, noise reaches 4."""


class DriftSettings(Settings):
    """Settings of the search.

    block_px: side of a block. blocks: so many, spread over the picture. candidates: disparities
    kept per block after a first look at all. search_px, search_deg, search_scale: how far is
    searched, along either axis. starts: from so many places, beside where the mask was.
    false_alarms: chance of one on a Psi that fits. harmless_px: root mean square displacement of
    the shadow below which a drift does not matter.
    """

    block_px: int = Field(default=8, ge=4, le=16)
    blocks: int = Field(default=160, ge=8)
    coarse_blocks: int = Field(default=48, ge=8)
    disparity_px: float = Field(default=2.0, gt=0)
    disparity_steps: int = Field(default=9, ge=1)
    candidates: int = Field(default=2, ge=1)
    search_px: float = Field(default=8.0, gt=0)
    search_deg: float = Field(default=2.0, ge=0)
    search_scale: float = Field(default=0.03, ge=0)
    starts: int = Field(default=3, ge=1)
    false_alarms: float = Field(default=1e-4, gt=0, lt=1)
    harmless_px: float = Field(default=0.05, ge=0)
    tolerance: float = Field(default=0.3, gt=0, description="of a last step, in deviations")
    seed: int = Field(default=0, ge=0)


@dataclass(frozen=True, eq=False)
class Drift:
    """What has drifted since the calibration.

    values, deviations: by KINDS, then "crosstalk", the share of other colours that the filters pass
        beyond the calibration's (where pixels see one colour), and "brightness_2", ... of the later
        shots (relative).
    displacement_px: of the shadow, root mean square over the picture. by_kind_px: by each kind.
    chi2: the drift squared over its covariance. probability: of more on a Psi that fits.
    placement: the mask's, corrected.
    beyond_search: the mask is farther off than was asked to search.
    recognised: the place explains the captures better than places where the mask cannot be, by so
        many standard deviations.
    """

    values: dict[str, float]
    deviations: dict[str, float]
    displacement_px: float
    by_kind_px: dict[str, float]
    chi2: float
    probability: float
    drifted: bool
    placement: Placement
    steps: int
    status: str
    searched: str
    beyond_search: bool
    recognised: float

    @property
    def refused(self) -> bool:
        """Whether where the mask is now is not known, so that no Psi is known to fit."""
        return self.beyond_search or self.recognised < LEAST_SURE

    @property
    def words(self) -> str:
        """The result in one line, for the user."""
        if self.recognised < LEAST_SURE:
            return (
                f"the mask's shadow is not recognised in these captures ({self.searched}): the "
                "mask has moved farther, is another one, or the scene shows too little of it; "
                "capture one whiteboard and calibrate again"
            )
        if self.beyond_search:
            return (
                f"the mask has moved by about {self.displacement_px:.1f} pixels, farther than "
                f"searched ({self.searched}): Psi is not corrected; capture one whiteboard and "
                "calibrate again"
            )
        if not self.drifted:
            return f"Psi still fits the captures ({self.searched})"
        largest = max(self.by_kind_px, key=lambda kind: self.by_kind_px[kind])
        return (
            f"Psi no longer fits: the shadow has moved by {self.displacement_px:.2f} pixels, most "
            f"of it {KINDS[largest].words} ({self.by_kind_px[largest]:.2f} pixels); use the "
            f"corrected Psi, or calibrate again ({self.searched})"
        )


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Blocks of the captures.

    pixels: (block, side^2, 2), row and column. colours, readings, noise: (block, shot, side^2): the
    colour that a pixel sees or ANY_COLOUR, its reading, and the variance of that.
    """

    pixels: NDArray[np.int64]
    colours: NDArray[np.uint8]
    readings: Array
    noise: Array

    def some(self, chosen: NDArray[np.intp]) -> _Blocks:
        """Return the blocks of these indices."""
        return _Blocks(
            self.pixels[chosen], self.colours[chosen], self.readings[chosen], self.noise[chosen]
        )


def _blocks(
    frames: Frames,
    channels: NDArray[np.uint8],
    side: int,
    count: int,
    rng: np.random.Generator,
    half_px: float = np.inf,
) -> _Blocks:
    """Return blocks on a jittered grid whose pixels are all usable and not dark.

    channels: the colour that each pixel sees, or ANY_COLOUR, (shot, pixel_y, pixel_x). count: about
    so many. half_px: from the middle of the picture, along either axis.
    """
    corners = _block_corners(frames, side, count, rng, half_px)
    if len(corners) < 8:
        raise CalibrationError(
            f"only {len(corners)} blocks of {side} x {side} pixels are lit, unsaturated and "
            "without bad pixels: these captures cannot show a drift"
        )
    inside = np.moveaxis(np.mgrid[:side, :side], 0, -1).reshape(-1, 2)
    pixels = np.array(corners)[:, None, :] + inside
    y, x = pixels[..., 0], pixels[..., 1]
    colours, readings, deviation = (
        array[:, y, x].transpose(1, 0, 2) for array in (channels, frames.readings, frames.deviation)
    )
    return _Blocks(
        pixels, colours, readings.astype(np.float64), np.square(deviation, dtype=np.float64)
    )


def _block_corners(
    frames: Frames, side: int, count: int, rng: np.random.Generator, half_px: float
) -> list[tuple[int, int]]:
    """Return the first row and column of each block, even numbers: colour filters repeat by 2.

    In each part of the grid four places are tried.
    """
    whole = frames.shape[1:]
    rows, columns = (min(n, max(int(2 * half_px), 4 * side)) if half_px < n else n for n in whole)
    above, before = (whole[0] - rows) // 4 * 2, (whole[1] - columns) // 4 * 2
    across = max(int(np.sqrt(count * columns / rows)), 1)
    down = max(count // across, 1)
    corners = []
    darkest = DARK_SHARE * float(np.percentile(frames.readings[frames.usable], 90))
    for i, j in np.ndindex(down, across):
        for _ in range(4):
            top = above + int((i + rng.random()) * (rows - side) / down) // 2 * 2
            left = before + int((j + rng.random()) * (columns - side) / across) // 2 * 2
            place = (slice(None), slice(top, top + side), slice(left, left + side))
            if frames.usable[place].all() and frames.readings[place].mean() > darkest:
                corners.append((top, left))
                break
    return corners


class _Unknowns(NamedTuple):
    """What is searched: the drift by KINDS, the crosstalk, and the brightness of later shots."""

    names: list[str]
    spreads: Array
    """Standard deviations of the prior."""
    steps: Array
    """Of differences, in each unknown's unit."""


def _unknowns(mask: ShadowMask, sees_one_colour: bool, shots: int) -> _Unknowns:
    """Return the unknowns; a step of the mask's moves its shadow by 0.02 pixels at most."""
    step_um = 0.02 * mask.pitch_um * mask.binning
    half_um = max(mask.size) / 2 * mask.pitch_um
    far_um = max(max(mask.views) - 1, 1) / 2 * mask.aperture_cell_um
    # A tilt moves the corner of the outermost view by tilt half_um far_um / lens_um.
    tilt = min(step_um * mask.lens_um / (far_um * half_um), 1e-3)
    names, spreads = list(KINDS), [kind.spread for kind in KINDS.values()]
    steps = [step_um, step_um, step_um / half_um, step_um / half_um, 0.02, tilt, tilt]
    if sees_one_colour:
        names, spreads, steps = [*names, "crosstalk"], [*spreads, CROSSTALK_SPREAD], [*steps, 0.01]
    later = range(1, shots)
    return _Unknowns(
        names + [f"brightness_{shot + 1}" for shot in later],
        np.array(spreads + [BRIGHTNESS_SPREAD for _ in later]),
        np.array(steps + [0.005 for _ in later]),
    )


class _Search:
    """Evidence of the blocks as a function of the drift, and the prior of that.

    The drift is normal about `origin`, with the inverse covariance `penalty`. steps: of
    differences. farthest: of a step of the climb.
    """

    def __init__(
        self,
        mask: ShadowMask,
        placement: Placement,
        stages: Stages,
        prior: Prior,
        unknowns: _Unknowns,
    ) -> None:
        self.mask, self.placement, self.stages, self.prior = mask, placement, stages, prior
        self.steps, self.origin = unknowns.steps, np.zeros(len(unknowns.spreads))
        self.penalty = np.diag(1 / np.square(unknowns.spreads))
        self.farthest = 3 * unknowns.spreads

    def begin(self, blocks: _Blocks, origin: Array, candidates: int | None = None) -> None:
        """Take these blocks, each with the disparities that explain it best at the origin.

        candidates: so many of them (None: all).
        """
        self.blocks, self.origin = blocks, origin
        every = np.arange(len(self.prior.disparities_px))
        self.chosen = np.tile(every, (len(blocks.pixels), 1))
        if candidates is not None:
            self.chosen = np.argsort(-self.evidence(origin), axis=1)[:, :candidates]

    def coefficients(self, drift: Array) -> NDArray[np.float64]:
        """Return (block, stored, shot, side^2, v, u): of a pixel's own colour, or of all three."""
        blocks, rest = self.blocks, drift[len(KINDS) :]
        mask, every = self.mask, blocks.colours[0, 0, 0] == ANY_COLOUR
        if not every:
            # As much of either other colour.
            mask = mixing(mask, np.eye(3) * (1 - 1.5 * rest[0]) + rest[0] / 2)
            rest = rest[1:]
        shadow = Shadow(mask, drifted(self.placement, drift))
        count, area, _ = blocks.pixels.shape
        flat = blocks.pixels.reshape(-1, 2)
        shots = blocks.readings.shape[1]
        stored = range(3 if every else 1)
        found = np.empty((count, len(stored), shots, area, *self.mask.views))
        for shot, c in product(range(shots), stored):
            gain = (1.0 if shot == 0 else 1.0 + rest[shot - 1]) / len(stored)
            colours = blocks.colours[:, shot].ravel()
            colours = np.full_like(colours, c) if every else colours
            each = shadow.coefficients(flat, colours, self.stages[shot], shot)
            found[:, c, shot] = gain * each.reshape(count, area, *self.mask.views)
        return found

    def evidence(self, drift: Array) -> NDArray[np.float64]:
        """Return every block's log evidence at its candidates, (block, candidate)."""
        blocks = self.blocks
        return log_evidence(
            self.prior,
            self.coefficients(drift),
            blocks.colours,
            blocks.readings,
            blocks.noise,
            self.chosen,
        )

    def total(self, drift: Array) -> float:
        """Return the log evidence of all blocks."""
        return float(averaged(self.evidence(drift)).sum())

    def posterior(self, drift: Array) -> float:
        """Return the same with the prior's."""
        off = drift - self.origin
        return self.total(drift) - 0.5 * float(off @ self.penalty @ off)

    def pull(self, drift: Array) -> Array:
        """Return the slope of minus the log prior."""
        return self.penalty @ (drift - self.origin)

    def scores(self, drift: Array, central: bool) -> Array:
        """Return the derivatives of the blocks' evidence (block, kind), by differences."""
        here = None if central else averaged(self.evidence(drift))
        slopes = np.empty((len(self.blocks.pixels), len(drift)))
        for k, step in enumerate(self.steps):
            move = np.zeros(len(drift))
            move[k] = step
            ahead = averaged(self.evidence(drift + move))
            behind = averaged(self.evidence(drift - move)) if here is None else here
            slopes[:, k] = (ahead - behind) / (step * (2 if here is None else 1))
        return slopes


def drifted(placement: Placement, drift: Array) -> Placement:
    """Return the placement after a drift (in the order of KINDS; what follows is ignored)."""
    changes = {
        kind.parameter: getattr(placement, kind.parameter) + float(value)
        for kind, value in zip(KINDS.values(), drift, strict=False)
    }
    return replace(placement, **changes)


def displacement_px(mask: ShadowMask, placement: Placement, drift: Array) -> float:
    """Return the root mean square displacement of the shadow over picture and views, pixels.

    A ray from x to the lens point u meets the mask at xi = (1 - rho) x + rho u. To first order

        displacement = shift + turn (-xi_y, xi_x) + scale xi - farther (u - x)
        farther = (distance_share d + tilt . x) / D

    drift: in the order of KINDS, missing values 0; values beyond KINDS are ignored.
    """
    ratio = mask.distance_um * (1 + placement.distance_share) / mask.lens_um
    y, x = ((np.linspace(0, 1, 9) - 0.5) * count * mask.pitch_um for count in mask.size)
    v, u = ((np.arange(n) - (n - 1) / 2) * mask.aperture_cell_um for n in mask.views)
    yy, xx, vv, uu = np.meshgrid(y, x, v, u, indexing="ij")
    xi_x, xi_y = (1 - ratio) * xx + ratio * uu, (1 - ratio) * yy + ratio * vv
    shift_x, shift_y, turn, scale, distance, tilt_x, tilt_y = np.resize(
        [*drift, *[0.0] * len(KINDS)], len(KINDS)
    )
    farther = (distance * mask.distance_um + tilt_x * xx + tilt_y * yy) / mask.lens_um
    moved_x = shift_x - turn * xi_y + scale * xi_x - farther * (uu - xx)
    moved_y = shift_y + turn * xi_x + scale * xi_y - farther * (vv - yy)
    pixel_um = mask.pitch_um * mask.binning
    return float(np.sqrt(np.mean(moved_x**2 + moved_y**2))) / pixel_um


@one_blas_thread()
def find_drift(
    frames: Frames,
    colour: NDArray[np.uint8] | None,
    mask: ShadowMask,
    placement: Placement,
    stages: Stages,
    settings: DriftSettings | None = None,
) -> Drift:
    """Return how the mask has moved between the calibration and the frames of a scene.

    colour: the one that each pixel sees, (shot, pixel_y, pixel_x); None: each sees all. placement,
    mask: as calibrated. stages: (x, y) in um per shot. Raises CalibrationError where too few of the
    readings can be used.
    """
    settings = settings or DriftSettings()
    shots = frames.shape[0]
    channels = np.full(frames.shape, ANY_COLOUR, np.uint8) if colour is None else colour
    rng = np.random.default_rng(settings.seed)
    # The evidence of a block costs the cube of its readings.
    side = settings.block_px if shots < 3 else max(settings.block_px - 2, 4)
    disparities = np.linspace(
        -settings.disparity_px, settings.disparity_px, settings.disparity_steps
    )
    unknowns = _unknowns(mask, colour is not None, shots)
    prior = plane_prior(mask.views, side, disparities)
    search = _Search(mask, placement, stages, prior, unknowns)

    def blocks_within(half_px: float) -> _Blocks:
        return _blocks(frames, channels, side, settings.coarse_blocks, rng, half_px)

    half_px = START_PX / 2
    blocks = blocks_within(half_px)
    starts = _starting_drifts(
        frames, channels[0], mask, placement, stages, settings, len(unknowns.names)
    )
    tried = [_climb(search, blocks, start, settings).drift for start in starts]
    search.begin(blocks, starts[0])
    drift = max(tried, key=search.total)
    while WIDENING * half_px < max(frames.shape[1:]) / 2:
        half_px *= WIDENING
        drift = _climb(search, blocks_within(half_px), drift, settings).drift
    blocks = _blocks(frames, channels, side, settings.blocks, rng)
    climb = _climb(search, blocks, drift, settings)
    drift, covariance = _newton_step(search, climb.drift)
    recognised = _margin_over_decoys(search, blocks, drift, settings, rng)
    return _describe(search, unknowns, drift, covariance, climb, recognised, settings)


def _describe(
    search: _Search,
    unknowns: _Unknowns,
    drift: Array,
    covariance: NDArray[np.float64],
    climb: _Climb,
    recognised: float,
    settings: DriftSettings,
) -> Drift:
    """Return the result: chi2 = drift^T covariance^-1 drift of the mask's own unknowns."""
    mask, count = search.mask, len(KINDS)
    mask_alone = drift[:count]
    statistic = float(mask_alone @ np.linalg.solve(covariance[:count, :count], mask_alone))
    probability = float(chdtrc(count, statistic))
    moved_px = displacement_px(mask, search.placement, mask_alone)
    farthest_um = settings.search_px * mask.pitch_um * mask.binning
    farthest = [farthest_um, farthest_um, np.deg2rad(settings.search_deg), settings.search_scale]
    deviations = np.sqrt(np.diag(covariance))
    return Drift(
        values=dict(zip(unknowns.names, map(float, drift), strict=True)),
        deviations=dict(zip(unknowns.names, map(float, deviations), strict=True)),
        displacement_px=moved_px,
        by_kind_px={
            kind: displacement_px(mask, search.placement, np.eye(count)[k] * mask_alone)
            for k, kind in enumerate(KINDS)
        },
        chi2=statistic,
        probability=probability,
        drifted=probability < settings.false_alarms and moved_px > settings.harmless_px,
        placement=drifted(search.placement, drift),
        steps=climb.steps,
        status="converged" if climb.converged else "step limit reached",
        searched=f"searched: shifts up to {settings.search_px:g} pixels, turns up to "
        f"{settings.search_deg:g} degrees, scales up to {settings.search_scale:.0%}",
        beyond_search=bool((np.abs(drift[: len(farthest)]) > farthest).any()),
        recognised=recognised,
    )


def _starting_drifts(
    frames: Frames,
    channels: NDArray[np.uint8],
    mask: ShadowMask,
    placement: Placement,
    stages: Stages,
    settings: DriftSettings,
    size: int,
) -> list[Array]:
    """Return where to begin: no drift, and the best places of the open aperture's shadow."""
    reading, usable = frames.readings[0], frames.usable[0]
    flat, variance = over_local_level(reading, usable, channels, LOCAL_PX)
    every = np.ones(mask.views, dtype=bool)
    board = Board("captures", flat, variance, channels, every, stages[0], 0)
    reach_um = SPARE * settings.search_px * mask.pitch_um * mask.binning
    turns = _symmetric_grid(settings.search_deg, TURN_STEP_DEG)
    scales = _symmetric_grid(settings.search_scale, SCALE_STEP)
    found = []
    for turn, scale in product(np.deg2rad(turns), scales):
        trial = np.zeros(size)
        trial[2:4] = turn, scale
        best = search(board, mask, drifted(placement, trial), reach_um, START_PX)
        trial[0] = best.placement.offset_x_um - placement.offset_x_um
        trial[1] = best.placement.offset_y_um - placement.offset_y_um
        found.append((best.correlation, trial))
    middle = replace(mask, size=(START_PX, START_PX))
    chosen: list[Array] = [np.zeros(size)]
    for _, trial in sorted(found, key=lambda place: -place[0]):
        if len(chosen) > settings.starts:
            break
        if all(displacement_px(middle, placement, trial - other) > 1 for other in chosen):
            chosen.append(trial)
    return chosen


def _symmetric_grid(reach: float, step: float) -> Array:
    """Return values from below -reach to above reach, 0 among them."""
    count = int(np.ceil(reach / step)) + 1 if reach else 0
    return np.arange(-count, count + 1) * step


def _margin_over_decoys(
    search: _Search,
    blocks: _Blocks,
    drift: Array,
    settings: DriftSettings,
    rng: np.random.Generator,
) -> float:
    """Return by how many standard deviations a drift explains the captures better than decoys do.

    Decoys are displaced by several cells of the mask, where the shadow is unrelated.
    """
    count = min(settings.coarse_blocks, len(blocks.pixels))
    some = blocks.some(np.sort(rng.choice(len(blocks.pixels), count, replace=False)))
    search.begin(some, drift)
    far_um = rng.uniform(4, 10, DECOYS) * search.mask.cell_um
    angle = rng.uniform(0, 2 * np.pi, DECOYS)
    decoys = np.tile(drift, (DECOYS, 1))
    decoys[:, :2] += np.stack([far_um * np.cos(angle), far_um * np.sin(angle)], axis=1)
    evidence = [search.total(decoy) for decoy in decoys]
    return float((search.total(drift) - np.mean(evidence)) / max(np.std(evidence), 1e-9))


class _Climb(NamedTuple):
    """The end of Gauss-Newton steps."""

    drift: Array
    steps: int
    converged: bool


def _climb(search: _Search, blocks: _Blocks, start: Array, settings: DriftSettings) -> _Climb:
    """Return the drift after Gauss-Newton steps on the blocks' scores from a start.

        s_b = d(evidence of block b) / d(drift),    S = sum of the s_b
        H = sum (s_b - mean s)(s_b - mean s)^T + P
        step = H^-1 (S - P (drift - origin)),  halved until the posterior rises

    P the prior's inverse covariance. Centred scores: far from the peak their mean is larger than
    their scatter. The last step is small in standard deviations.
    """
    search.begin(blocks, start, settings.candidates)
    drift, tolerance = start, settings.tolerance
    for taken in range(1, MOST_STEPS + 1):
        scores = search.scores(drift, central=False)
        here = search.posterior(drift)
        centred = scores - scores.mean(axis=0)
        matrix = centred.T @ centred + search.penalty
        move = np.linalg.solve(matrix, scores.sum(axis=0) - search.pull(drift))
        # Far from the peak a step may lead where no mask can be.
        move = np.clip(move, -search.farthest, search.farthest)
        deviations = np.sqrt(np.diag(np.linalg.inv(matrix)))
        while search.posterior(drift + move) <= here:
            move = move / 2
            if np.max(np.abs(move) / deviations) < tolerance / 4:
                return _Climb(drift, taken, True)
        drift = drift + move
        if np.max(np.abs(move) / deviations) < tolerance:
            return _Climb(drift, taken, True)
    return _Climb(drift, MOST_STEPS, False)


def _newton_step(search: _Search, drift: Array) -> tuple[Array, NDArray[np.float64]]:
    """Return the drift after a last step, Newton's own, and its sandwich covariance.

        step = H^-1 (S - P (drift - origin)),    covariance = H^-1 (sum s_b s_b^T + P) H^-1

    H is minus the second derivative of the log posterior, the others as in `_climb`, by central
    differences: without the bias of the one-sided before.
    """
    slopes = search.scores(drift, central=True)
    curvature = _curvature(search, drift)
    move = np.linalg.solve(curvature, slopes.sum(axis=0) - search.pull(drift))
    if search.posterior(drift + move) > search.posterior(drift):
        drift = drift + move
    inverse = np.linalg.inv(curvature)
    return drift, np.asarray(inverse @ (slopes.T @ slopes + search.penalty) @ inverse, np.float64)


def _curvature(search: _Search, drift: Array) -> NDArray[np.float64]:
    """Return minus the second derivatives of the log posterior, at least the prior's."""
    size = len(drift)
    curvature = np.empty((size, size))
    here = search.scores(drift, central=False).sum(axis=0)
    for k, step in enumerate(search.steps):
        move = np.zeros(size)
        move[k] = 2 * step
        ahead = search.scores(drift + move, central=False).sum(axis=0)
        curvature[k] = (here - ahead) / (2 * step)
    curvature = (curvature + curvature.T) / 2 + search.penalty
    scale = np.sqrt(np.diag(search.penalty))
    values, vectors = np.linalg.eigh(curvature / np.outer(scale, scale))
    # A direction that the captures do not determine is held by the prior alone.
    held = (vectors * np.maximum(values, 1.0)) @ vectors.T
    return np.asarray(held * np.outer(scale, scale), dtype=np.float64)
