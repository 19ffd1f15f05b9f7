"""Search the disparities of a capture, from coarse to fine, patch by patch.

The likelihood of disparities is evaluated for wide patches of every third pixel, half a pixel apart
where they are small and one beyond; the range grows while its ends are wanted. Each tile of the
fine search then evaluates only what the coarse one left possible there, so that cost grows with the
disparities a scene really has; it does so in steps of SMOOTH_PX, and in finer ones only beside the
best of a patch that decides.

Where patches lie is arbitrary, and changes the disparities they agree on: shifted by 3 pixels, they
make a 96x96 crop of group A 0.5 dB better or worse (standard deviation). The beliefs of two
interleaved grids of patches are averaged: +0.2 dB (benchmarks/tried.md).

Neighbouring patches agree by belief propagation: their disparities differ as d - d' is Laplace
distributed, or, with a small probability, are not related (another object). Messages are passed
along rows and columns, forth and back, some rounds (sum-product): 8 p L^2 operations a round for p
patches of L disparities.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.evidence import (
    EvidencePatches,
    PatchEvidence,
    TexturePrior,
    patch_evidence,
)
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.inputs import Readings

Array = NDArray[np.floating]
COARSE_STEP_PX = 0.5
"""Between disparities of the coarse search. 2x +0.09, 0.5x -0.11 dB."""
COARSE_SPACING = 3
"""Pixels between those of a coarse patch. 2x -0.10, 0.5x -0.10 dB."""
NEAR_PX, FAR_STEP_PX = 3.0, 1.0
"""Disparities beyond are evaluated this much apart. NEAR_PX: 2x -0.05, 0.5x -0.18 dB; FAR_STEP_PX:
2x -0.02, 0.5x 0.00 dB."""
START_PX = 9.0
"""Disparities searched first, to both sides, and by how much the range grows at a time. 2x +0.05,
0.5x -0.04 dB."""
DECISIVE = 5.0
"""Difference of log-likelihoods that matters. A patch decides if its best disparity exceeds the
mean of its disparities by it. Disparities that lie less below the best contend with it, and are
evaluated exactly: interpolated there instead, they made buttercup's crops 0.3 to 0.5 dB worse.
2x 0.00, 0.5x -0.01 dB."""
POSSIBLE = 0.02
"""Probability above which a disparity is looked at again, and share of the deciding patches at an
end of the range from which the range grows. 2x 0.00, 0.5x +0.05 dB."""
FLOOR = 1e-4
"""Probability that a patch's evidence is worth nothing: its texture is none on a plane."""
RARE_PX = 2.0
"""Disparity that half as many objects have as have none. Without it undecided patches of a smooth
scene agreed on -6.5 px; with it group A loses 0.00 to 0.03 dB on average. 2x -0.01, 0.5x 0.00 dB.
"""

TILE = 16
"""Patches a side. 2x 0.00, 0.5x -0.01 dB."""
SMOOTH_PX = 0.25
"""Disparities at most this much apart are evaluated; between, evidence is interpolated unless it
decides: the log-likelihood of fine textures waves with a period of 0.75 px. 2x +0.02, 0.5x +0.03
dB."""
KEPT = 4
"""Kinds of texture that patches of the fine search compare further after their first probe, where
textures of several lengths are compared: `adaptive-fast`, with a single length, loses 0.04 dB by
it. The coarse search compares all: its disparities, far apart, would lose the right one. 2x +0.03,
0.5x +0.01 dB.
"""


def compatibility(
    disparities: NDArray[np.floating],
    slope_px: float,
    jump: float,
    spacing_px: float | NDArray[np.floating] = 1.0,
) -> Array:
    """Return the joint prior of two neighbours' disparities, (L, L), symmetric, not normalised.

        pairs(d, d') = (1 - jump) exp(-|d - d'| / slope_px) / n + jump L common(d) common(d')
        common(d) ~ spacing_px / (1 + |d| / RARE_PX), which sums to 1

    slope_px: mean difference of neighbours on one object. jump: probability of another object,
    whose disparity is the rarer the larger. spacing_px: between disparities, if it varies.
    """
    apart = np.abs(disparities[:, None] - disparities[None])
    same = np.exp(-apart / slope_px)
    same /= same.sum(axis=1).max()
    common = spacing_px / (1 + np.abs(disparities) / RARE_PX)
    common = common / common.sum()
    return (1 - jump) * same + jump * len(disparities) * np.outer(common, common)


def _normalised(beliefs: Array) -> Array:
    """Return beliefs (..., label) that sum to 1."""
    return beliefs / np.maximum(beliefs.sum(axis=-1, keepdims=True), 1e-30)


PASSES = ((0, 1, False), (1, 1, True), (2, 0, False), (3, 0, True))
"""Of a round of messages: their number, the axis they move along, and whether against its order."""


def posteriors(evidence: Array, pairs: Array, rounds: int = 3) -> Array:
    """Return the probability of each label at each patch, (row, column, L), float32.

    Sum-product belief propagation on the grid of patches, messages m, neighbours p -> q:

        own_p(d)    = (1 - FLOOR) exp(evidence_p(d)) / sum + FLOOR / L
        m_pq(d')    ~ sum_d pairs(d, d') own_p(d) prod_{r != q} m_rp(d)
        belief_p(d) ~ own_p(d) prod_r m_rp(d)

    evidence: (row, column, L) log-likelihoods. pairs: (L, L), see `compatibility`.
    """
    own = np.exp((evidence - evidence.max(axis=-1, keepdims=True)).astype(np.float32))
    own = np.float32(1 - FLOOR) * _normalised(own) + np.float32(FLOOR / own.shape[-1])
    pairs = pairs.astype(np.float32)
    rows, columns, labels = own.shape
    messages = np.ones((4, rows, columns, labels), dtype=np.float32)
    for _ in range(rounds):
        for into, axis, reverse in PASSES:
            length = own.shape[axis]
            order = range(length - 1, 0, -1) if reverse else range(length - 1)
            ahead = -1 if reverse else 1
            back = into ^ 1  # The message from where this one goes: it must not return there.
            for at in order:
                here = (at, slice(None)) if axis == 0 else (slice(None), at)
                there = (at + ahead, slice(None)) if axis == 0 else (slice(None), at + ahead)
                belief = own[here].copy()
                for other in range(4):
                    if other != back:
                        belief *= messages[other][here]
                # Of mean 1: the product of four must not be too small for float32.
                messages[into][there] = labels * _normalised(_normalised(belief) @ pairs)
    return _normalised(own * messages.prod(axis=0))


@dataclass(frozen=True, eq=False)
class SearchData:
    """The data of a search.

    Attributes:
        residual: frames less those of the smooth picture; their noise includes the variance of what
            no model explains.
        brightness: of the smooth picture, (pixel_y, pixel_x).
    """

    residual: Readings
    brightness: Array

    @property
    def psi(self) -> Psi:
        """Psi of the residual."""
        return self.residual.psi


@dataclass(frozen=True, eq=False)
class Volume:
    """Probabilities of disparities on a grid of patches.

    Attributes:
        disparities: the labels, in samples per view step, (disparity,).
        centres: rows and columns of the patches' centres, in pixels.
        probability: (row, column, disparity).
        evidence: log-likelihoods, (row, column, disparity), -inf where excluded.
        kind: of the texture, an index of `TexturePrior.kinds`, (row, column).
        decisive: whether the patch's own evidence prefers any disparity, (row, column).
        at_end: share of deciding patches at the range's ends, the two last disparities of a side.
        between: the same for a second grid, between these patches, of the same disparities.
    """

    disparities: NDArray[np.float64]
    centres: tuple[Array, Array]
    probability: NDArray[np.float32]
    evidence: NDArray[np.float32]
    kind: NDArray[np.int64]
    decisive: NDArray[np.bool_]
    at_end: float = 0.0
    between: Volume | None = None

    @property
    def grids(self) -> tuple[Volume, ...]:
        """This volume and, where there is a second grid, `between`: beliefs are their mean."""
        return (self,) if self.between is None else (self, self.between)


def evidence_at(
    data: SearchData,
    patches: EvidencePatches,
    corners: NDArray[np.int64],
    disparities: Array,
    prior: TexturePrior,
    possible: NDArray[np.bool_] | None = None,
    kinds: NDArray[np.int64] | None = None,
) -> PatchEvidence:
    """Return the evidence of the patches at corners (patch, 2), in pixels; see `patch_evidence`."""
    half = ((patches.side - 1) * patches.spacing) // 2
    bright = data.brightness[corners[:, 0] + half, corners[:, 1] + half]
    places = patches.places(data.psi.shots)
    return patch_evidence(
        data.residual, bright, corners, places, disparities, prior, possible, kinds
    )


def _deciding(evidence: Array) -> NDArray[np.bool_]:
    """Return which patches decide, of evidence (..., disparity), see DECISIVE."""
    mean = evidence.mean(axis=-1, where=np.isfinite(evidence))
    return evidence.max(axis=-1) - mean > DECISIVE


def _at_ends(
    probability: Array,
    disparities: Array,
    deciding: NDArray[np.bool_],
    ends: tuple[float, float],
) -> list[float]:
    """Return the shares of the deciding patches whose likeliest disparity lies at either end.

    ends: the second and the last but one of the disparities searched.
    """
    best = disparities[probability.argmax(axis=-1)][deciding]
    at_ends = best <= ends[0], best >= ends[1]
    return [float(np.mean(there)) if best.size else 0.0 for there in at_ends]


def _steps(first_px: float, last_px: float, step_px: float) -> NDArray[np.float64]:
    """Return the disparities beyond the first, to the last, a step apart."""
    return np.arange(first_px + step_px, last_px + 1e-9, step_px)


def _spacing(disparities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far each disparity lies from the next ones, in the mean."""
    return np.gradient(disparities) if len(disparities) > 1 else np.ones(len(disparities))


def coarse(data: SearchData, prior: TexturePrior, settings: AdaptiveSettings) -> Volume:
    """Return the coarse search over disparities up to `settings.furthest_px` to both sides.

    1. Disparities up to START_PX: COARSE_STEP_PX apart up to NEAR_PX, beyond it FAR_STEP_PX.
    2. Where a share of more than POSSIBLE of the deciding patches prefers the last two disparities
       of a side, that side grows by START_PX; repeated until neither does.
    """
    furthest_px, shots = settings.furthest_px, data.psi.shots
    side = min(8, max(4, round(12 / shots**0.5)))
    room = (min(data.psi.frames_shape[1:]) - 1) // (side - 1)
    patches = EvidencePatches(side, 3 * side // 2, min(COARSE_SPACING, max(room, 1)))
    grid = patches.grid(data.psi.frames_shape[1:])
    shape = len(grid[0]), len(grid[1])
    corners = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 2)

    near = np.append(0.0, _steps(0, min(NEAR_PX, furthest_px), COARSE_STEP_PX))
    beyond = np.concatenate([near, _steps(near[-1], min(START_PX, furthest_px), FAR_STEP_PX)])
    known = np.concatenate([-beyond[:0:-1], beyond])
    first = evidence_at(data, patches, corners, known, prior)
    evidence, kind = first.log_likelihood.reshape(*shape, -1), first.kind.reshape(shape)
    while True:
        deciding = _deciding(evidence)
        pairs = compatibility(
            known, settings.slope_px * patches.stride, settings.jump, _spacing(known)
        )
        chances = posteriors(evidence, pairs)
        at_ends = _at_ends(chances, known, deciding, (known[:2][-1], known[-2:][0]))
        below, above = (
            _steps(end, min(end + START_PX, furthest_px), FAR_STEP_PX)
            if share > POSSIBLE
            else known[:0]
            for end, share in zip((-known[0], known[-1]), at_ends, strict=True)
        )
        if not len(below) + len(above):
            break
        further = -below[::-1], above
        low, high = (
            evidence_at(data, patches, corners, part, prior).log_likelihood.reshape(*shape, -1)
            if len(part)
            else evidence[..., :0]
            for part in further
        )
        evidence = np.concatenate([low, evidence, high], axis=-1)
        known = np.concatenate([further[0], known, further[1]])
    half = (patches.side - 1) * patches.spacing / 2
    centres = grid[0] + half, grid[1] + half
    return Volume(known, centres, chances, evidence, kind, deciding, max(at_ends))


def _possible(
    volume: Volume,
    patches: EvidencePatches,
    grid: tuple[NDArray[np.int64], NDArray[np.int64]],
    labels: Array,
) -> NDArray[np.bool_]:
    """Return which `labels` are near a likely disparity at or around each patch, (row, column,
    label).

    volume: of the coarse search. grid: rows and columns of the patches' corners.
    """
    around = 1.5 * np.diff(volume.centres[0]).max(initial=1.0)
    # The likeliest in any case: of many disparities all may be less than POSSIBLE.
    best = volume.probability.max(axis=-1, keepdims=True)
    likely = volume.probability >= np.minimum(best, np.float32(POSSIBLE))
    sides = []
    for centres, corners in zip(volume.centres, grid, strict=True):
        apart = np.abs(centres - corners[:, None] - patches.side / 2)
        # The nearest in any case: on a small sensor one patch may be all that the rough search has.
        sides.append(apart <= np.maximum(around + patches.side / 2, apart.min(axis=1)[:, None]))
    near_row, near_column = sides
    # Along rows first, then along columns: what is likely at any coarse patch nearby.
    rows = np.stack([likely[near].any(axis=0) for near in near_row])
    both = np.stack([rows[:, near].any(axis=1) for near in near_column], axis=1)
    apart = np.abs(labels - volume.disparities[:, None])
    about = apart <= _spacing(volume.disparities)[:, None] + 1e-9
    return both.astype(np.float32) @ about.astype(np.float32) > 0


def fine(
    data: SearchData, prior: TexturePrior, rough: Volume, settings: AdaptiveSettings
) -> Volume:
    """Return the search of `settings.step_px` among what the rough one left possible.

    1. Labels: multiples of step_px over the rough range. Each `every`-th, at most SMOOTH_PX apart,
       is evaluated where it is possible at any patch of a tile; a finer label only where it may be
       the best of a patch that decides (`_on_grid`).
    2. Evidence of patches that do not decide is continued flatly, and large disparities made rarer.
    3. Neighbours agree (`posteriors`), for each of one or two interleaved grids of patches.
    """
    shots, step_px = data.psi.shots, settings.step_px
    # About as many readings a patch for any number of shots.
    side = max(4, round(8 / shots**0.5))
    patches = EvidencePatches(side, min(settings.stride, side))
    prior = replace(prior, kept=KEPT if prior.finer_px else None)
    low, high = rough.disparities[[0, -1]]
    every = max(1, int(SMOOTH_PX / step_px + 1e-9))
    ends = np.floor(low / step_px / every) * every, np.ceil(high / step_px / every) * every
    labels = np.arange(ends[0], ends[1] + 1) * step_px

    two = settings.interleaved and patches.stride > 1
    firsts = (0, patches.stride // 2) if two else (0,)
    grids = [patches.grid(data.psi.frames_shape[1:], first) for first in firsts]
    asked = [_asked(_shared(_possible(rough, patches, grid, labels)), every) for grid in grids]
    used = _spanned(np.any([part.any(axis=(0, 1)) for part in asked], axis=0), every)

    # Large disparities average texture away: patches with hardly any fit them a little better.
    rare = np.log1p(np.abs(labels[used]) / RARE_PX).astype(np.float32)
    # Where patches overlap they count the same readings again.
    own = np.float32((patches.stride / side) ** 2)
    pairs = compatibility(labels[used], settings.slope_px * patches.stride, settings.jump)
    half, last = (side - 1) / 2, (low + step_px, high - step_px)
    between = None
    for grid, wanted in zip(reversed(grids), reversed(asked), strict=True):
        evidence, kind, decisive = _on_grid(data, patches, grid, prior, labels, every, wanted)
        evidence = evidence[..., used]
        evidence[~decisive] = _extended(evidence[~decisive])
        likely = evidence - np.where(decisive[..., None], np.float32(0), rare)
        chances = posteriors(likely * own, pairs)
        between = Volume(
            disparities=labels[used],
            centres=(grid[0] + half, grid[1] + half),
            probability=chances,
            evidence=evidence,
            kind=kind,
            decisive=decisive,
            at_end=max(_at_ends(chances, labels[used], decisive, last)),
            between=between,
        )
    assert between is not None
    return between


def _shared(possible: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the labels possible at any patch of a tile, for every patch of it, (row, column,
    label).

    The rough search alone is no reason to exclude what patches beside one allow: of a capture by
    others (smem/resolution_target, a disperser by 2 px a band) patches kept to their own agreed on
    1.7 px.
    """
    out = np.empty_like(possible)
    for top in range(0, possible.shape[0], TILE):
        for left in range(0, possible.shape[1], TILE):
            here = slice(top, top + TILE), slice(left, left + TILE)
            out[here] = possible[here].any(axis=(0, 1))
    return out


def _asked(possible: NDArray[np.bool_], every: int) -> NDArray[np.bool_]:
    """Return which of each `every`-th label to evaluate, (..., label).

    Every possible label then has an evaluated label on both sides.
    """
    padded = np.pad(possible, ((0, 0), (0, 0), (every - 1, every - 1)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * every - 1, axis=2)
    return np.logical_or.reduce(windows[:, :, ::every], axis=-1)


def _spanned(asked: NDArray[np.bool_], every: int) -> NDArray[np.bool_]:
    """Return which labels lie at or between the `every`-th labels that are evaluated."""
    known = np.where(asked, np.float32(0), np.float32(-np.inf))
    return np.isfinite(_between(known[None], every)[0])


def _extended(evidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return evidence (patch, label) of patches that do not decide also where not evaluated.

    It is nearly flat: linear between labels evaluated, constant beyond. Else what the rough search
    left out there would be excluded, though no patch of either speaks against it.
    """
    label = np.arange(evidence.shape[1])
    known = np.isfinite(evidence)
    out = [np.interp(label, label[at], row[at]) for row, at in zip(evidence, known, strict=True)]
    return np.array(out, dtype=np.float32).reshape(evidence.shape)


def _packed(asked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the patches that ask for any label, asked (patch, label), alike ones side by side.

    LANES patches are evaluated together, at every label requested by any patch.
    """
    some = np.flatnonzero(asked.any(axis=1))
    last = asked.shape[1] - asked[some, ::-1].argmax(axis=1)
    return some[np.lexsort((last, asked[some].argmax(axis=1)))]


@cache
def _spline(count: int, every: int) -> NDArray[np.float32]:
    """Return the matrix (every * (count - 1) + 1, count) that interpolates by a cubic spline."""
    if count == 1:
        return np.ones((1, 1), dtype=np.float32)
    from scipy.interpolate import CubicSpline  # loads for 0.2 s, which listings do not need

    between = np.arange(every * (count - 1) + 1) / every
    return CubicSpline(np.arange(count), np.eye(count))(between).astype(np.float32)


def _between(evidence: NDArray[np.float32], every: int) -> NDArray[np.float32]:
    """Return evidence (patch, label) of which each `every`-th is known, others interpolated.

    -inf where not known, and where labels to both sides are not.
    """
    known = np.isfinite(evidence)
    out = np.full((len(evidence), every * (evidence.shape[1] - 1) + 1), -np.inf, np.float32)
    ways, which = np.unique(np.packbits(known, axis=1), axis=0, return_inverse=True)
    for way in range(len(ways)):
        patches = np.flatnonzero(which.ravel() == way)
        steps = np.diff(known[patches[0]].astype(np.int8), prepend=0, append=0)
        for first, end in zip(np.flatnonzero(steps > 0), np.flatnonzero(steps < 0), strict=True):
            finer = slice(every * first, every * (end - 1) + 1)
            out[patches, finer] = evidence[patches, first:end] @ _spline(end - first, every).T
    return out


def _near_best(evidence: NDArray[np.float32], every: int) -> NDArray[np.bool_]:
    """Return which labels lie beside a nearly best label of a patch, (patch, label).

    evidence: (patch, label), of each `every`-th label; the labels returned lie between these.
    """
    known = np.isfinite(evidence)
    good = evidence > evidence.max(axis=1, keepdims=True) - DECISIVE
    between = known[:, 1:] & known[:, :-1] & (good[:, 1:] | good[:, :-1])
    out = np.zeros((len(evidence), every * (evidence.shape[1] - 1) + 1), dtype=bool)
    for offset in range(1, every):
        out[:, offset::every] = between
    return out


def _on_grid(
    data: SearchData,
    patches: EvidencePatches,
    grid: tuple[NDArray[np.int64], NDArray[np.int64]],
    prior: TexturePrior,
    labels: NDArray[np.float64],
    every: int,
    asked: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.bool_]]:
    """Return evidence (row, column, label), kinds, and whether patches decide, (row, column).

    grid: rows and columns of corners. asked: (row, column, each `every`-th label), to evaluate;
    others are evaluated where it matters, and else interpolated.
    """
    corners = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1)
    shape = corners.shape[:2]
    evidence = np.empty((*shape, len(labels)), dtype=np.float32)
    kind, deciding = np.empty(shape, dtype=np.int64), np.empty(shape, dtype=bool)
    order = _packed(asked.reshape(-1, asked.shape[2]))
    at = np.unravel_index(order, shape)
    found = evidence_at(data, patches, corners[at], labels[::every], prior, asked[at])
    kind[at], deciding[at] = found.kind, _deciding(found.log_likelihood)
    values = _between(found.log_likelihood, every)
    wanted = _near_best(found.log_likelihood, every) & deciding[at][:, None]
    some = _packed(wanted)
    if len(some):
        exact = evidence_at(
            data, patches, corners[at][some], labels, prior, wanted[some], found.kinds[some]
        ).log_likelihood
        values[some] = np.where(np.isfinite(exact), exact, values[some])
    evidence[at] = values
    return evidence, kind, deciding


Places = list[tuple[NDArray[np.float32], NDArray[np.float32]]]


def places(volume: Volume, rows: Array, columns: Array) -> Places:
    """Return where in each of a volume's grids pixels lie: fractional columns and rows, (y, x).

    rows, columns: of the pixels, (y,) and (x,), fractional where pixels hold several samples.
    """
    out = []
    for grid in volume.grids:
        y, x = (
            np.interp(at, centres, np.arange(len(centres))).astype(np.float32)
            for at, centres in zip((rows, columns), grid.centres, strict=True)
        )
        across, down = np.meshgrid(x, y)
        out.append((across, down))
    return out


def interpolated(
    volume: Volume, values: Callable[[Volume], Array], at: Places
) -> NDArray[np.float32]:
    """Return values (row, column) of a volume's grids at `places`: linear, and their mean."""
    each = [
        cv2.remap(
            np.ascontiguousarray(values(grid), dtype=np.float32),
            *where,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for grid, where in zip(volume.grids, at, strict=True)
    ]
    return np.asarray(each[0] if len(each) == 1 else (each[0] + each[1]) / 2, dtype=np.float32)


def _samples(volume: Volume, size: tuple[int, int], binning: int) -> Places:
    """Return the places of every sample (y, x)."""
    rows, columns = ((np.arange(length) + 0.5) / binning - 0.5 for length in size)
    return places(volume, rows, columns)


class Moments(NamedTuple):
    """Mean and variance of the disparity of every sample (y, x) over what the patches believe."""

    mean: NDArray[np.float32]
    variance: NDArray[np.float32]


def moments_per_pixel(volume: Volume, size: tuple[int, int], binning: int) -> Moments:
    """Return the moments of the disparity of every sample."""
    at = _samples(volume, size, binning)
    mean, square = (
        interpolated(
            volume, lambda grid, power=power: grid.probability @ grid.disparities**power, at
        )
        for power in (1, 2)
    )
    return Moments(mean, np.maximum(square - np.square(mean), 0))


def per_pixel(volume: Volume, size: tuple[int, int], binning: int) -> NDArray[np.float32]:
    """Return the disparity of every sample (y, x): the mean about the likeliest label.

    Probabilities are interpolated between the patches' centres.
    """
    at = _samples(volume, size, binning)
    best = np.full(size, -1.0, dtype=np.float32)
    which = np.zeros(size, dtype=np.int64)

    def spread(label: int) -> NDArray[np.float32]:
        return interpolated(volume, lambda grid: grid.probability[..., label], at)

    for label in range(len(volume.disparities)):
        chance = spread(label)
        better = chance > best
        best = np.where(better, chance, best)
        which[better] = label
    total, weight = np.zeros(size, np.float32), np.zeros(size, np.float32)
    for label, disparity in enumerate(volume.disparities):
        near = np.abs(volume.disparities[which] - disparity) <= 0.3
        if near.any():
            chance = np.where(near, spread(label), 0)
            total += np.float32(disparity) * chance
            weight += chance
    return total / weight
