"""Search the disparities of a capture, from coarse to fine: where, and which, they may be.

The likelihood of disparities is evaluated for wide patches of every third pixel, half a pixel apart
where they are small and one beyond; the range grows while its ends are wanted. Each tile of the
fine search then evaluates only what the coarse one left possible there, so that cost grows with the
disparities a scene really has.

Where patches lie is arbitrary, and changes the disparities they agree on: shifted by 3 pixels, they
make a 96x96 crop of group A 0.5 dB better or worse (standard deviation). So what two grids of
patches believe, one between the other, is averaged: +0.2 dB (docs/adaptive.md).

Neighbouring patches agree by belief propagation: their disparities differ as d - d' is Laplace
distributed, or, with a small probability, are not related (another object). Messages are passed
along rows and columns, forth and back, some rounds (sum-product): 8 p L^2 operations a round for p
patches of L disparities.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.evidence import (
    EvidencePatches,
    PatchEvidence,
    TexturePrior,
    patch_evidence,
)

Array = NDArray[np.floating]
COARSE_STEP_PX = 0.5
"""Between disparities of the coarse search. 2x +0.09, 0.5x -0.11 dB."""
COARSE_SPACING = 3
"""Pixels between those of a coarse patch. 2x -0.10, 0.5x -0.10 dB."""
NEAR_PX, FAR_STEP_PX = 3.0, 1.0
"""Disparities beyond are evaluated this much apart. NEAR_PX: 2x -0.05, 0.5x -0.18 dB; FAR_STEP_PX:
2x -0.02, 0.5x 0.00 dB."""
START_PX, GROWTH_PX = 9.0, 3.0
"""Disparities searched first, to both sides; by how much the range grows at a time. START_PX: 2x
+0.05, 0.5x -0.04 dB; GROWTH_PX: 2x 0.00, 0.5x 0.00 dB."""
DECISIVE = 5.0
"""Log-likelihood by which a patch must prefer its best disparity to the mean one to count. 2x 0.00,
0.5x 0.00 dB."""
WANTED = 0.01
"""Share of the deciding patches at the end of the range that makes it grow. 2x 0.00, 0.5x 0.00 dB.
"""
POSSIBLE = 0.02
"""Probability above which a disparity is looked at again. 2x 0.00, 0.5x +0.05 dB."""
RARE_PX = 2.0
"""Disparity that half as many objects have as have none. Without it undecided patches of a smooth
scene agreed on -6.5 px; with it group A loses 0.00 to 0.03 dB on average. 2x -0.01, 0.5x 0.00 dB.
"""

TILE = 16
"""Patches a side. 2x 0.00, 0.5x -0.01 dB."""


def compatibility(
    disparities: NDArray[np.floating],
    slope_px: float,
    jump: float,
    spacing_px: float | NDArray[np.floating] = 1.0,
) -> Array:
    """Return the joint prior of two neighbours' disparities, (L, L), symmetric, not normalised.

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
    return beliefs / np.maximum(beliefs.sum(axis=-1, keepdims=True), 1e-30)


def posteriors(evidence: Array, pairs: Array, rounds: int = 3, floor: float = 1e-4) -> Array:
    """Return the probability of each label at each patch, (row, column, L), float32.

    evidence: (row, column, L) log-likelihoods. pairs: (L, L), see `compatibility`. floor: the
    probability that a patch's evidence is worth nothing (its texture is none on a plane).
    """
    own = np.exp((evidence - evidence.max(axis=-1, keepdims=True)).astype(np.float32))
    own = np.float32(1 - floor) * _normalised(own) + np.float32(floor / own.shape[-1])
    pairs = pairs.astype(np.float32)
    rows, columns, labels = own.shape
    messages = np.ones((4, rows, columns, labels), dtype=np.float32)
    for _ in range(rounds):
        for into, axis, reverse in ((0, 1, False), (1, 1, True), (2, 0, False), (3, 0, True)):
            length = own.shape[axis]
            order = range(length - 1, 0, -1) if reverse else range(length - 1)
            ahead = -1 if reverse else 1
            back = into ^ 1
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
    """What is to be explained. readings: frames less those of the smooth picture, variance: theirs,
    usable, all (shot, pixel_y, pixel_x); brightness: (pixel_y, pixel_x) of the smooth picture."""

    psi: ImagingMatrix
    readings: Array
    variance: Array
    usable: NDArray[np.bool_]
    brightness: Array


@dataclass(frozen=True, eq=False)
class Volume:
    """Probabilities of disparities on a grid of patches.

    centres: rows and columns of the patches' centres, in pixels. probability: (row, column,
    disparity); evidence: theirs, log-likelihoods, -inf where not evaluated. kind: (row, column) of
    the texture. decisive: (row, column), whether the patch's own evidence prefers any disparity.
    at_end: share of deciding patches at the range's ends. between: the same of a grid between these
    patches, of the same disparities.
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
        """Return this and the one between, if there is one: beliefs are their mean."""
        return (self,) if self.between is None else (self, self.between)


def reading_side(shots: int) -> int:
    """Return how many pixels wide a patch is: about as many readings for any number of shots."""
    return max(4, round(8 / shots**0.5))


def coarse_side(shots: int) -> int:
    """Return how many pixels wide a patch of the coarse search is: there are few of them."""
    return min(8, max(4, round(12 / shots**0.5)))


def _evaluated(
    data: SearchData, patches: EvidencePatches, disparities: Array, prior: TexturePrior
) -> tuple[Array, NDArray[np.int64], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return evidence (row, column, disparity), kinds (row, column), and the corners' grid."""
    rows, columns = patches.grid(data.psi.frames_shape[1:])
    corners = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    found = evidence_at(data, patches, corners, disparities, prior)
    shape = len(rows), len(columns)
    return found.log_likelihood.reshape(*shape, -1), found.kind.reshape(shape), (rows, columns)


def evidence_at(
    data: SearchData,
    patches: EvidencePatches,
    corners: NDArray[np.int64],
    disparities: Array,
    prior: TexturePrior,
) -> PatchEvidence:
    """Return the evidence of the patches at corners (patch, 2), in pixels."""
    half = ((patches.side - 1) * patches.spacing) // 2
    bright = data.brightness[corners[:, 0] + half, corners[:, 1] + half]
    return patch_evidence(
        data.psi,
        data.readings,
        data.variance,
        data.usable,
        bright,
        corners,
        patches.places(data.psi.shots),
        disparities,
        prior,
    )


def _deciding(evidence: Array) -> NDArray[np.bool_]:
    return evidence.max(axis=-1) - evidence.mean(axis=-1) > DECISIVE


def _reach(first_px: float, last_px: float, step_px: float) -> NDArray[np.float64]:
    """Return the disparities beyond the first, to the last, a step apart."""
    return np.arange(first_px + step_px, last_px + 1e-9, step_px)


def _spacing(disparities: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.gradient(disparities) if len(disparities) > 1 else np.ones(len(disparities))


def coarse(
    data: SearchData, prior: TexturePrior, furthest_px: float, slope_px: float, jump: float
) -> Volume:
    """Return the coarse search over disparities up to `furthest_px` to both sides."""
    side = coarse_side(data.psi.shots)
    room = (min(data.psi.frames_shape[1:]) - 1) // (side - 1)
    patches = EvidencePatches(side, 3 * side // 2, min(COARSE_SPACING, max(room, 1)))
    near = np.append(0.0, _reach(0, min(NEAR_PX, furthest_px), COARSE_STEP_PX))
    beyond = np.concatenate([near, _reach(near[-1], min(START_PX, furthest_px), FAR_STEP_PX)])
    known = np.concatenate([-beyond[:0:-1], beyond])
    evidence, kind, grid = _evaluated(data, patches, known, prior)
    while True:
        deciding = _deciding(evidence)
        pairs = compatibility(known, slope_px * patches.stride, jump, _spacing(known))
        chances = posteriors(evidence, pairs)
        best = chances.argmax(axis=-1)
        share = [
            float(np.mean(best[deciding] <= 1)) if deciding.any() else 0.0,
            float(np.mean(best[deciding] >= len(known) - 2)) if deciding.any() else 0.0,
        ]
        below, above = (
            _reach(end, min(end + GROWTH_PX, furthest_px), FAR_STEP_PX)
            if ends > WANTED
            else known[:0]
            for end, ends in zip((-known[0], known[-1]), share, strict=True)
        )
        if not len(below) + len(above):
            break
        further = -below[::-1], above
        evaluated = [
            _evaluated(data, patches, part, prior)[0] if len(part) else evidence[..., :0]
            for part in further
        ]
        evidence = np.concatenate([evaluated[0], evidence, evaluated[1]], axis=-1)
        known = np.concatenate([further[0], known, further[1]])
    half = (patches.side - 1) * patches.spacing / 2
    centres = grid[0] + half, grid[1] + half
    return Volume(known, centres, chances, evidence, kind, deciding, max(share))


def _candidates(
    volume: Volume, rows: tuple[float, float], columns: tuple[float, float], labels: Array
) -> NDArray[np.intp]:
    """Return the indices of `labels` near what may be within rows and columns of pixels."""
    around = 1.5 * np.diff(volume.centres[0]).max(initial=1.0)
    within = [
        np.flatnonzero((at >= first - around) & (at <= last + around))
        for at, (first, last) in zip(volume.centres, (rows, columns), strict=True)
    ]
    part = volume.probability[np.ix_(*within)].reshape(-1, len(volume.disparities))
    possible = part.max(axis=0) > POSSIBLE
    about = _spacing(volume.disparities)[possible] + 1e-9
    apart = np.abs(labels[:, None] - volume.disparities[possible][None])
    return np.flatnonzero((apart <= about).any(axis=1))


def fine(
    data: SearchData,
    prior: TexturePrior,
    rough: Volume,
    stride: int,
    step_px: float,
    slope_px: float,
    jump: float,
    interleaved: bool = True,
) -> Volume:
    """Return the search of `step_px` among what the rough one left possible.

    interleaved: whether a second grid of patches lies between the first, see `Volume.between`.
    """
    side = reading_side(data.psi.shots)
    patches = EvidencePatches(side, min(stride, side))
    low, high = rough.disparities[[0, -1]]
    labels = np.arange(np.floor(low / step_px), np.ceil(high / step_px) + 1) * step_px
    firsts = (0, patches.stride // 2) if interleaved and patches.stride > 1 else (0,)
    parts = [_on_grid(data, patches, first, prior, rough, labels) for first in firsts]
    used = np.any([np.isfinite(part.evidence).any(axis=(0, 1)) for part in parts], axis=0)
    labels = labels[used]
    # Large disparities average texture away: patches with hardly any fit them a little better.
    rare = np.log1p(np.abs(labels) / RARE_PX).astype(np.float32)
    # Where patches overlap they count the same readings again.
    own = np.float32((patches.stride / side) ** 2)
    pairs = compatibility(labels, slope_px * patches.stride, jump)
    between = None
    for part in reversed(parts):
        evidence = part.evidence[..., used]
        likely = evidence - np.where(part.decisive[..., None], np.float32(0), rare)
        between = replace(
            part,
            disparities=labels,
            evidence=evidence,
            probability=posteriors(likely * own, pairs),
            between=between,
        )
    assert between is not None
    return between


def _on_grid(
    data: SearchData,
    patches: EvidencePatches,
    first: int,
    prior: TexturePrior,
    rough: Volume,
    labels: NDArray[np.float64],
) -> Volume:
    """Return the evidence on a grid of patches (`EvidencePatches.grid`), without probabilities."""
    side = patches.side
    rows, columns = patches.grid(data.psi.frames_shape[1:], first)
    evidence = np.full((len(rows), len(columns), len(labels)), -np.inf, dtype=np.float32)
    kind = np.zeros((len(rows), len(columns)), dtype=np.int64)
    deciding = np.zeros((len(rows), len(columns)), dtype=bool)
    for top in range(0, len(rows), TILE):
        for left in range(0, len(columns), TILE):
            here = slice(top, top + TILE), slice(left, left + TILE)
            some = rows[here[0]], columns[here[1]]
            spans = [(at[0], at[-1] + side) for at in some]
            chosen = _candidates(rough, spans[0], spans[1], labels)
            corners = np.stack(np.meshgrid(*some, indexing="ij"), axis=-1).reshape(-1, 2)
            found = evidence_at(data, patches, corners, labels[chosen], prior)
            shape = len(some[0]), len(some[1])
            values = found.log_likelihood.reshape(*shape, -1)
            part = np.full((*shape, len(labels)), -np.inf, dtype=np.float32)
            part[..., chosen] = values
            evidence[here], kind[here] = part, found.kind.reshape(shape)
            deciding[here] = _deciding(values)
    centres = rows + (side - 1) / 2, columns + (side - 1) / 2
    return Volume(labels, centres, evidence, evidence, kind, deciding, rough.at_end)


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


def variance_per_pixel(volume: Volume, size: tuple[int, int], binning: int) -> NDArray[np.float32]:
    """Return the variance of the disparity of every sample (y, x) over what the patches believe."""
    at = _samples(volume, size, binning)
    mean, square = (
        interpolated(
            volume, lambda grid, power=power: grid.probability @ grid.disparities**power, at
        )
        for power in (1, 2)
    )
    return np.maximum(square - np.square(mean), 0)


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
