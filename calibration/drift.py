"""Whether Psi still fits, from scene captures alone; what has moved, by how much, and the repair.

The drift (shift, rotation, scale, distance; brightness of later shots against the first) that
makes the evidence of blocks of the captures greatest (see `evidence`), by Gauss-Newton steps on
the blocks' scores, after a coarse search of shifts. Its covariance is the sandwich of curvature and
scores (White 1982), since the prior of the scene is but a model; a drift is told only where it is
far outside that, and large enough to matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import chdtrc

from calibration.errors import CalibrationError
from calibration.evidence import Prior, averaged, log_evidence, plane_prior
from calibration.parametric import Stages
from calibration.placement import Placement
from calibration.shadow import Shadow, ShadowMask
from emmc_rig.model.settings import Settings

Array = NDArray[np.floating]
KINDS = ("shift_x_um", "shift_y_um", "rotation_rad", "scale", "distance_share")
ATTRIBUTES = ("offset_x_um", "offset_y_um", "rotation_rad", "scale", "distance_share")
SPREADS = (30.0, 30.0, 0.004, 0.003, 0.05)
"""Of the prior of a drift between calibration and capture."""
MOST_STEPS = 12
RIM = 0.95
"""Of the shifts searched: a drift beyond it may be larger than what is found."""


class DriftSettings(Settings):
    """Settings of the search.

    block_px: side of a block. blocks: so many, spread over the picture. candidates: disparities
    kept per block after a first look at all. false_alarms: chance of one on a Psi that fits.
    harmless_px: root mean square displacement of the shadow below which a drift does not matter.
    """

    block_px: int = Field(default=8, ge=4, le=16)
    blocks: int = Field(default=160, ge=8)
    coarse_blocks: int = Field(default=48, ge=8)
    disparity_px: float = Field(default=2.0, gt=0)
    disparity_steps: int = Field(default=9, ge=1)
    candidates: int = Field(default=2, ge=1)
    search_px: float = Field(default=1.2, ge=0)
    false_alarms: float = Field(default=1e-4, gt=0, lt=1)
    harmless_px: float = Field(default=0.05, ge=0)
    tolerance: float = Field(default=0.3, gt=0, description="of a last step, in deviations")
    seed: int = Field(default=0, ge=0)


@dataclass(frozen=True, eq=False)
class Drift:
    """What has drifted since the calibration.

    values, deviations: by KINDS, then the brightness of shots 2, 3, ... (relative). displacement:
    of the shadow, root mean square over the picture, pixels; by kind likewise. chi2: the drift
    squared over its covariance; probability: of more on a Psi that fits. beyond_search: what was
    found lies at the rim of what was searched, so that the real drift may be larger.
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
    beyond_search: bool = False

    @property
    def words(self) -> str:
        """What to tell the user in one line."""
        if self.beyond_search:
            return (
                f"the shadow has moved by {self.displacement_px:.1f} pixels or more, as far as was "
                "searched: Psi is not repaired; take one whiteboard and calibrate again"
            )
        if not self.drifted:
            return "Psi still fits the captures"
        largest = max(self.by_kind_px, key=lambda kind: self.by_kind_px[kind])
        return (
            f"Psi no longer fits: the shadow has moved by {self.displacement_px:.2f} pixels, most "
            f"of it {largest} ({self.by_kind_px[largest]:.2f} pixels); use the repaired Psi or "
            "take one whiteboard"
        )


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Blocks of the captures: pixels (block, side^2, 2), and per shot what they read."""

    pixels: NDArray[np.int64]
    colours: NDArray[np.uint8]
    readings: Array
    noise: Array

    def some(self, chosen: NDArray[np.intp]) -> _Blocks:
        return _Blocks(
            self.pixels[chosen], self.colours[chosen], self.readings[chosen], self.noise[chosen]
        )


def _blocks(
    readings: Array,
    variance: Array,
    usable: NDArray[np.bool_],
    colour: NDArray[np.uint8],
    side: int,
    count: int,
    rng: np.random.Generator,
) -> _Blocks:
    """Return blocks on a jittered grid whose pixels are all usable and not dark."""
    _, rows, columns = readings.shape
    across = max(int(np.sqrt(count * columns / rows)), 1)
    down = max(count // across, 1)
    found = []
    floor = 0.05 * float(np.percentile(readings[usable], 90))
    for i in range(down):
        for j in range(across):
            for _ in range(4):
                top = int((i + rng.random()) * (rows - side) / down) // 2 * 2
                left = int((j + rng.random()) * (columns - side) / across) // 2 * 2
                place = (slice(None), slice(top, top + side), slice(left, left + side))
                if usable[place].all() and readings[place].mean() > floor:
                    found.append((top, left))
                    break
    if len(found) < 8:
        raise CalibrationError(
            f"only {len(found)} blocks of {side} x {side} pixels are lit, unsaturated and without "
            "bad pixels: a drift cannot be told from these captures"
        )
    inside = np.moveaxis(np.mgrid[:side, :side], 0, -1).reshape(-1, 2)
    pixels = np.array(found)[:, None, :] + inside
    y, x = pixels[..., 0], pixels[..., 1]

    def taken(array: NDArray) -> NDArray:
        return array[:, y, x].transpose(1, 0, 2)

    return _Blocks(
        pixels,
        taken(colour),
        taken(readings).astype(np.float64),
        taken(variance).astype(np.float64),
    )


class _Search:
    """Evidence of the blocks as a function of the drift."""

    def __init__(
        self,
        mask: ShadowMask,
        placement: Placement,
        stages: Stages,
        blocks: _Blocks,
        prior: Prior,
    ) -> None:
        self.mask, self.placement, self.stages = mask, placement, stages
        self.blocks, self.prior = blocks, prior
        every = np.arange(len(prior.disparities_px))
        self.chosen = np.tile(every, (len(blocks.pixels), 1))

    def coefficients(self, drift: Array) -> NDArray[np.float64]:
        """Return (block, shot, side^2, v, u)."""
        shadow = Shadow(self.mask, drifted(self.placement, drift))
        count, area, _ = self.blocks.pixels.shape
        flat = self.blocks.pixels.reshape(-1, 2)
        shots = self.blocks.readings.shape[1]
        found = np.empty((count, shots, area, *self.mask.views))
        for shot in range(shots):
            gain = 1.0 if shot == 0 else 1.0 + drift[len(KINDS) + shot - 1]
            colours = self.blocks.colours[:, shot].ravel()
            each = shadow.coefficients(flat, colours, self.stages[shot], shot)
            found[:, shot] = gain * each.reshape(count, area, *self.mask.views)
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

    def scores(self, drift: Array, steps: Array, central: bool) -> tuple[Array, Array]:
        """Return the blocks' evidence and their derivatives (block, kind), by differences."""
        here = averaged(self.evidence(drift))
        slopes = np.empty((len(here), len(drift)))
        for k, step in enumerate(steps):
            move = np.zeros(len(drift))
            move[k] = step
            ahead = averaged(self.evidence(drift + move))
            behind = averaged(self.evidence(drift - move)) if central else here
            slopes[:, k] = (ahead - behind) / (step * (1 + central))
        return here, slopes

    def keep_best(self, drift: Array, count: int) -> None:
        """Keep the disparities that explain each block best."""
        evidence = self.evidence(drift)
        best = np.argsort(-evidence, axis=1)[:, :count]
        self.chosen = np.take_along_axis(self.chosen, best, axis=1)


def drifted(placement: Placement, drift: Array) -> Placement:
    """Return the placement after a drift (in the order of KINDS; what follows is ignored)."""
    changes = {
        name: getattr(placement, name) + float(value)
        for name, value in zip(ATTRIBUTES, drift, strict=False)
    }
    return replace(placement, **changes)


def displacement_px(mask: ShadowMask, placement: Placement, drift: Array) -> float:
    """Return the root mean square displacement of the shadow over picture and views, pixels."""
    ratio = mask.distance_um * (1 + placement.distance_share) / mask.lens_um
    y, x = ((np.linspace(0, 1, 9) - 0.5) * count * mask.pitch_um for count in mask.size)
    v, u = ((np.arange(n) - (n - 1) / 2) * mask.aperture_cell_um for n in mask.views)
    yy, xx, vv, uu = np.meshgrid(y, x, v, u, indexing="ij")
    xi_x, xi_y = (1 - ratio) * xx + ratio * uu, (1 - ratio) * yy + ratio * vv
    shift_x, shift_y, turn, scale, distance = (float(value) for value in drift[: len(KINDS)])
    more = distance * mask.distance_um / mask.lens_um
    moved_x = shift_x - turn * xi_y + scale * xi_x - more * (uu - xx)
    moved_y = shift_y + turn * xi_x + scale * xi_y - more * (vv - yy)
    pixel_um = mask.pitch_um * mask.binning
    return float(np.sqrt(np.mean(moved_x**2 + moved_y**2))) / pixel_um


def find_drift(
    readings: Array,
    variance: Array,
    usable: NDArray[np.bool_],
    colour: NDArray[np.uint8],
    mask: ShadowMask,
    placement: Placement,
    stages: Stages,
    settings: DriftSettings | None = None,
    on_step: Callable[[float], None] = lambda value: None,
) -> Drift:
    """Return how the mask has moved between the calibration and these captures.

    readings, variance, usable: (shot, pixel_y, pixel_x), normalised. colour: (shot, y, x), the one
    colour that each pixel sees. placement, mask: as calibrated. stages: (x, y) in um per shot.
    Raises CalibrationError where too little of the captures can be used.
    """
    settings = settings or DriftSettings()
    if mask.binning != 1:
        raise CalibrationError("a drift is sought on sensors whose pixels are samples")
    shots = len(readings)
    rng = np.random.default_rng(settings.seed)
    side = settings.block_px if shots < 3 else max(settings.block_px - 2, 4)
    blocks = _blocks(readings, variance, usable, colour, side, settings.blocks, rng)
    disparities = np.linspace(
        -settings.disparity_px, settings.disparity_px, settings.disparity_steps
    )
    prior = plane_prior(mask.views, side, disparities)
    spreads = np.array([*SPREADS, *[0.1] * (shots - 1)])
    pixel_um = mask.pitch_um
    half_um = max(mask.size) / 2 * mask.pitch_um
    step = 0.02 * pixel_um
    steps = np.array([step, step, step / half_um, step / half_um, 0.02, *[0.005] * (shots - 1)])
    drift = np.zeros(len(spreads))
    if settings.search_px > 0:
        drift = _coarse(mask, placement, stages, blocks, prior, drift, settings, rng)
    search = _Search(mask, placement, stages, blocks, prior)
    search.keep_best(drift, settings.candidates)
    penalty = np.diag(1 / spreads**2)
    drift, taken, converged = _climb(search, drift, steps, penalty, settings.tolerance, on_step)
    drift, covariance = _polish(search, drift, steps, penalty)
    count = len(KINDS)
    mask_alone = drift[:count]
    statistic = float(mask_alone @ np.linalg.solve(covariance[:count, :count], mask_alone))
    probability = float(chdtrc(count, statistic))
    moved = displacement_px(mask, placement, drift)
    names = [*KINDS, *(f"brightness_{shot + 1}" for shot in range(1, shots))]
    return Drift(
        dict(zip(names, map(float, drift), strict=True)),
        dict(zip(names, map(float, np.sqrt(np.diag(covariance))), strict=True)),
        moved,
        {
            kind: displacement_px(mask, placement, np.where(np.arange(count) == k, mask_alone, 0))
            for k, kind in enumerate(KINDS)
        },
        statistic,
        probability,
        probability < settings.false_alarms and moved > settings.harmless_px,
        drifted(placement, drift),
        taken,
        "converged" if converged else "step limit reached",
        bool(np.abs(drift[:2]).max() > RIM * settings.search_px * pixel_um > 0),
    )


def _climb(
    search: _Search,
    drift: Array,
    steps: Array,
    penalty: Array,
    tolerance: float,
    on_step: Callable[[float], None],
) -> tuple[Array, int, bool]:
    """Return the drift after Gauss-Newton steps on the blocks' scores, their count, converged."""
    for taken in range(1, MOST_STEPS + 1):
        here, slopes = search.scores(drift, steps, central=False)
        value = float(here.sum() - 0.5 * drift @ penalty @ drift)
        # Without their mean, which far from the peak is larger than what they scatter.
        centred = slopes - slopes.mean(axis=0)
        matrix = centred.T @ centred + penalty
        move = np.linalg.solve(matrix, slopes.sum(axis=0) - penalty @ drift)
        deviations = np.sqrt(np.diag(np.linalg.inv(matrix)))
        found = _posterior(search, drift + move, penalty)
        while found <= value:
            move = move / 2
            if np.max(np.abs(move) / deviations) < tolerance / 4:
                return drift, taken, True
            found = _posterior(search, drift + move, penalty)
        drift = drift + move
        on_step(found)
        if np.max(np.abs(move) / deviations) < tolerance:
            return drift, taken, True
    return drift, MOST_STEPS, False


def _polish(
    search: _Search, drift: Array, steps: Array, penalty: Array
) -> tuple[Array, NDArray[np.float64]]:
    """Return the drift after a last step, Newton's own, and its sandwich covariance.

    Its derivatives are without the bias of the one-sided differences before.
    """
    _, slopes = search.scores(drift, steps, central=True)
    curvature = _curvature(search, drift, steps, penalty)
    move = np.linalg.solve(curvature, slopes.sum(axis=0) - penalty @ drift)
    if _posterior(search, drift + move, penalty) > _posterior(search, drift, penalty):
        drift = drift + move
    inverse = np.linalg.inv(curvature)
    return drift, np.asarray(inverse @ (slopes.T @ slopes + penalty) @ inverse, np.float64)


def _coarse(
    mask: ShadowMask,
    placement: Placement,
    stages: Stages,
    blocks: _Blocks,
    prior: Prior,
    drift: Array,
    settings: DriftSettings,
    rng: np.random.Generator,
) -> Array:
    """Return the shift of greatest evidence on a grid, from some of the blocks."""
    count = min(settings.coarse_blocks, len(blocks.pixels))
    some = blocks.some(np.sort(rng.choice(len(blocks.pixels), count, replace=False)))
    search = _Search(mask, placement, stages, some, prior)
    search.keep_best(drift, settings.candidates)
    reach = settings.search_px * mask.pitch_um
    places = np.arange(-3, 4) * reach / 3
    best, value = drift, -np.inf
    for x in places:
        for y in places:
            trial = drift.copy()
            trial[:2] = x, y
            found = float(averaged(search.evidence(trial)).sum())
            if found > value:
                best, value = trial, found
    return best


def _posterior(search: _Search, drift: Array, penalty: Array) -> float:
    return float(averaged(search.evidence(drift)).sum() - 0.5 * drift @ penalty @ drift)


def _curvature(search: _Search, drift: Array, steps: Array, penalty: Array) -> NDArray[np.float64]:
    """Return minus the second derivatives of the log posterior, at least the prior's."""
    size = len(drift)
    curvature = np.empty((size, size))
    here = search.scores(drift, steps, central=False)[1].sum(axis=0)
    for k, step in enumerate(steps):
        move = np.zeros(size)
        move[k] = 2 * step
        ahead = search.scores(drift + move, steps, central=False)[1].sum(axis=0)
        curvature[k] = (here - ahead) / (2 * step)
    curvature = (curvature + curvature.T) / 2 + penalty
    scale = np.sqrt(np.diag(penalty))
    values, vectors = np.linalg.eigh(curvature / np.outer(scale, scale))
    # A direction that the captures do not tell is held by the prior alone.
    held = (vectors * np.maximum(values, 1.0)) @ vectors.T
    return np.asarray(held * np.outer(scale, scale), dtype=np.float64)
