"""Search the disparities of a capture, from coarse to fine: where, and which, they may be.

Wide patches of every third pixel judge half pixels of disparity, the range growing while its ends
are wanted. Each tile of the fine search then judges only what the coarse one left possible there,
so that cost grows with the disparities a scene really has.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.evidence import EvidencePatches, TexturePrior, patch_evidence
from reconstruction.adaptive.labels import compatibility, posteriors

Array = NDArray[np.floating]
COARSE_STEP_PX = 0.5
COARSE_SPACING = 3
START_PX = 3.0
"""Disparities searched first, to both sides; the range grows by as much at a time."""
DECISIVE = 5.0
"""Log-likelihood by which a patch must prefer its best disparity to the mean one to count."""
WANTED = 0.01
"""Share of the deciding patches at the end of the range that makes it grow."""
POSSIBLE = 0.02
"""Probability above which a disparity is looked at again."""
TILE = 16
"""Patches a side."""
OWN_SHARE = 0.5
"""Of a patch's evidence: patches overlap, and would count the same readings again."""


@dataclass(frozen=True, eq=False)
class Data:
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
    disparity); evidence: theirs, log-likelihoods, -inf where not judged. kind: (row, column) of the
    texture. decisive: (row, column), whether the patch's
    own evidence prefers any disparity. at_end: share of deciding patches at the range's ends.
    """

    disparities: NDArray[np.float64]
    centres: tuple[Array, Array]
    probability: NDArray[np.float32]
    evidence: NDArray[np.float32]
    kind: NDArray[np.int64]
    decisive: NDArray[np.bool_]
    at_end: float = 0.0


def reading_side(shots: int) -> int:
    """Return how many pixels wide a patch is: about as many readings for any number of shots."""
    return max(4, round(8 / shots**0.5))


def coarse_side(shots: int) -> int:
    """Return how many pixels wide a patch of the coarse search is: there are few of them."""
    return min(8, max(4, round(12 / shots**0.5)))


def _judged(
    data: Data, patches: EvidencePatches, disparities: Array, prior: TexturePrior
) -> tuple[Array, NDArray[np.int64], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return evidence (row, column, disparity), kinds (row, column), and the corners' grid."""
    rows, columns = patches.grid(data.psi.frames_shape[1:])
    corners = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    found = _evidence(data, patches, corners, disparities, prior)
    shape = len(rows), len(columns)
    return found.log_likelihood.reshape(*shape, -1), found.kind.reshape(shape), (rows, columns)


def _evidence(data: Data, patches: EvidencePatches, corners, disparities: Array, prior):
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


def coarse(
    data: Data, prior: TexturePrior, furthest_px: float, slope_px: float, jump: float
) -> Volume:
    """Return the coarse search over disparities up to `furthest_px` to both sides."""
    side = coarse_side(data.psi.shots)
    room = (min(data.psi.frames_shape[1:]) - 1) // (side - 1)
    patches = EvidencePatches(side, 3 * side // 2, min(COARSE_SPACING, max(room, 1)))
    reach = COARSE_STEP_PX * np.floor(min(START_PX, furthest_px) / COARSE_STEP_PX)
    known = np.arange(-reach, reach + 1e-9, COARSE_STEP_PX)
    evidence, kind, grid = _judged(data, patches, known, prior)
    while True:
        deciding = _deciding(evidence)
        chances = posteriors(evidence, compatibility(known, slope_px * patches.stride, jump))
        best = chances.argmax(axis=-1)
        share = [
            float(np.mean(best[deciding] <= 1)) if deciding.any() else 0.0,
            float(np.mean(best[deciding] >= len(known) - 2)) if deciding.any() else 0.0,
        ]
        more = [
            (known[0] - np.arange(START_PX, 0, -COARSE_STEP_PX), share[0]),
            (known[-1] + np.arange(COARSE_STEP_PX, START_PX + 1e-9, COARSE_STEP_PX), share[1]),
        ]
        wanted = [
            part[np.abs(part) <= furthest_px] if ends > WANTED else part[:0] for part, ends in more
        ]
        if not sum(len(part) for part in wanted):
            break
        added = [_judged(data, patches, part, prior)[0] for part in wanted if len(part)]
        if len(wanted[0]):
            evidence = np.concatenate([added.pop(0), evidence], axis=-1)
        if len(wanted[1]):
            evidence = np.concatenate([evidence, added.pop(0)], axis=-1)
        known = np.concatenate([wanted[0], known, wanted[1]])
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
    possible = volume.disparities[part.max(axis=0) > POSSIBLE]
    near = np.abs(labels[:, None] - possible[None]).min(axis=1) <= COARSE_STEP_PX + 1e-9
    return np.flatnonzero(near)


def fine(
    data: Data,
    prior: TexturePrior,
    rough: Volume,
    stride: int,
    step_px: float,
    slope_px: float,
    jump: float,
) -> Volume:
    """Return the search of `step_px` among what the rough one left possible."""
    side = reading_side(data.psi.shots)
    patches = EvidencePatches(side, min(stride, side))
    low, high = rough.disparities[[0, -1]]
    labels = np.arange(np.floor(low / step_px), np.ceil(high / step_px) + 1) * step_px
    rows, columns = patches.grid(data.psi.frames_shape[1:])
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
            found = _evidence(data, patches, corners, labels[chosen], prior)
            shape = len(some[0]), len(some[1])
            values = found.log_likelihood.reshape(*shape, -1)
            part = np.full((*shape, len(labels)), -np.inf, dtype=np.float32)
            part[..., chosen] = values
            evidence[here], kind[here] = part, found.kind.reshape(shape)
            deciding[here] = _deciding(values)
    used = np.flatnonzero(np.isfinite(evidence).any(axis=(0, 1)))
    evidence, labels = evidence[..., used], labels[used]
    chances = posteriors(
        evidence * OWN_SHARE, compatibility(labels, slope_px * patches.stride, jump)
    )
    centres = rows + (side - 1) / 2, columns + (side - 1) / 2
    return Volume(labels, centres, chances, evidence, kind, deciding, rough.at_end)


def _pixel_maps(
    volume: Volume, size: tuple[int, int], binning: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where in the grid of patches every sample (y, x) lies: columns and rows, (y, x)."""
    along = []
    for at, length in zip(volume.centres, size, strict=True):
        pixel = (np.arange(length) + 0.5) / binning - 0.5
        along.append(np.interp(pixel, at, np.arange(len(at))).astype(np.float32))
    columns, rows = np.meshgrid(along[1], along[0])
    return columns, rows


def _interpolated(grid: Array, columns: Array, rows: Array) -> NDArray[np.float32]:
    found = cv2.remap(grid, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float32)


def variance_per_pixel(volume: Volume, size: tuple[int, int], binning: int) -> NDArray[np.float32]:
    """Return the variance of the disparity of every sample (y, x) over what the patches believe."""
    mean = volume.probability @ volume.disparities
    square = volume.probability @ np.square(volume.disparities)
    spread = np.maximum(square - np.square(mean), 0).astype(np.float32)
    columns, rows = _pixel_maps(volume, size, binning)
    return _interpolated(spread, columns, rows)


def per_pixel(volume: Volume, size: tuple[int, int], binning: int) -> NDArray[np.float32]:
    """Return the disparity of every sample (y, x): the mean about the likeliest label.

    Probabilities are interpolated between the patches' centres.
    """
    columns, rows = _pixel_maps(volume, size, binning)
    best = np.full(size, -1.0, dtype=np.float32)
    which = np.zeros(size, dtype=np.int64)

    def spread(label: int) -> NDArray[np.float32]:
        layer = np.ascontiguousarray(volume.probability[..., label])
        return _interpolated(layer, columns, rows)

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
