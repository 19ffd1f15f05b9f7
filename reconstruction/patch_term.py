"""What any collection of patch estimates asks of a light field: a target and a weight per sample.

The paper's rho/2 |P L - Lhat|^2 (Section VI-B, eq. 9), for patches of any sizes, places and
weights w, and of any methods, is rho/2 sum_(y, x) W |L - M|^2 + const: W(y, x) sums the weights
of the patches that cover a sample, M is their weighted mean. So L needs no patches any more.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import repeat, zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.errors import ReconstructionError

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class PatchTerm:
    """target: M, (v, u, y, x, c) float32. weight: W, (y, x) float32, 0 where nothing is known.

    The factor rho stays outside, in the settings of the solver.
    """

    target: NDArray[np.float32]
    weight: NDArray[np.float32]

    def __post_init__(self) -> None:
        if self.target.ndim != 5 or self.target.shape[-1] != 3:
            raise ReconstructionError(
                f"a patch target of shape {self.target.shape}: give (v, u, y, x, 3)"
            )
        if self.weight.shape != self.target.shape[2:4]:
            raise ReconstructionError(
                f"patch weights of shape {self.weight.shape} do not fit a target of "
                f"{self.target.shape[2:4]} samples"
            )
        _check_weight(self.weight)
        if not np.isfinite(self.target).all():
            raise ReconstructionError(
                "the patch target has values that are not finite: give those samples weight 0"
            )

    @property
    def norm(self) -> float:
        """|P* P|: the largest weight."""
        return float(self.weight.max())

    def value(self, light_field: Array) -> float:
        """Return 1/2 sum W |L - M|^2 of a light field (v, u, y, x, c), without rho."""
        total = 0.0
        for view in np.ndindex(self.target.shape[:2]):
            square = np.square(light_field[view] - self.target[view], dtype=np.float64)
            total += float(np.sum(self.weight * square.sum(axis=-1)))
        return total / 2

    def window(self, rows: slice, columns: slice) -> PatchTerm:
        """Return the term of a part of the light field, a copy."""
        return PatchTerm(self.target[:, :, rows, columns].copy(), self.weight[rows, columns].copy())


def _check_weight(weight: Array) -> None:
    if not np.isfinite(weight).all():
        raise ReconstructionError("the patch weights hold values that are not finite")
    if weight.size and weight.min() < 0:
        raise ReconstructionError(
            f"a patch weight of {weight.min():g}: weights must be at least 0 (0 leaves out)"
        )


def from_patches(
    positions: Iterable[tuple[int, int]],
    patches: Iterable[Array],
    weights: Iterable[float | Array] | None,
    shape: tuple[int, ...],
) -> PatchTerm:
    """Return the term of patches (v, u, patch_y, patch_x, c), each with a corner (y, x).

    positions, patches, weights: as many of each, taken one by one (a generator saves memory), in
        any order, of any sizes. weights: a number or an array (patch_y, patch_x) per patch;
        None counts every patch once, as the paper does.
    shape: of the light field, (v, u, y, x, c).
    """
    total = np.zeros(shape, dtype=np.float32)
    weight = np.zeros(shape[2:4], dtype=np.float32)
    given = repeat(1.0) if weights is None else weights
    for number, (corner, patch, share) in enumerate(_matched(positions, patches, given)):
        y, x = _corner(number, corner)
        patch = np.asarray(patch)
        rows, columns = patch.shape[2:4] if patch.ndim == 5 else (0, 0)
        if patch.shape != (*shape[:2], rows, columns, *shape[4:]) or not rows * columns:
            raise ReconstructionError(
                f"patch {number} has shape {patch.shape}: the light field {tuple(shape)} needs "
                f"({shape[0]}, {shape[1]}, rows, columns, {shape[4]})"
            )
        if y < 0 or x < 0 or y + rows > shape[2] or x + columns > shape[3]:
            raise ReconstructionError(
                f"patch {number}, {rows}x{columns} at ({y}, {x}), leaves the {shape[2]}x{shape[3]} "
                "light field: move or crop it"
            )
        share = np.asarray(share, dtype=np.float32)
        if share.shape not in ((), (rows, columns)):
            raise ReconstructionError(
                f"the weights of patch {number} have shape {share.shape}: give one number or "
                f"{(rows, columns)}"
            )
        _check_weight(share)
        place = np.s_[y : y + rows, x : x + columns]
        if not np.isfinite(patch).all():
            raise ReconstructionError(f"patch {number} is not finite everywhere: leave it out")
        weight[place] += share
        total[(slice(None), slice(None), *place)] += share[..., None] * patch
    return PatchTerm(_mean(total, weight), weight)


_MISSING = object()


def _matched(
    positions: Iterable, patches: Iterable, weights: Iterable
) -> Iterator[tuple[Any, Any, Any]]:
    """Yield a position, a patch and a weight at a time; weights may go on for ever."""
    weights = iter(weights)
    for number, (corner, patch) in enumerate(zip_longest(positions, patches, fillvalue=_MISSING)):
        weight = next(weights, _MISSING)
        if any(part is _MISSING for part in (corner, patch, weight)):
            raise ReconstructionError(
                f"positions, patches and weights end apart, at {number}: give as many of each"
            )
        yield corner, patch, weight
    if not isinstance(weights, repeat) and next(weights, _MISSING) is not _MISSING:
        raise ReconstructionError("more weights than patches: give as many of each")


def _corner(number: int, corner: object) -> tuple[int, int]:
    place = np.asarray(corner)
    if place.shape != (2,) or not np.issubdtype(place.dtype, np.integer):
        raise ReconstructionError(
            f"patch {number} is at {corner}: a position is two whole numbers, row and column"
        )
    return int(place[0]), int(place[1])


def _mean(total: Array, weight: Array) -> NDArray[np.float32]:
    """Turn a weighted sum (v, u, y, x, c) into the mean, in place; 0 where nothing was summed."""
    total /= np.where(weight > 0, weight, 1)[..., None]
    return total


def from_estimate(light_field: Array, weight: float | Array = 1.0) -> PatchTerm:
    """Return the term of a whole estimate (v, u, y, x, c): one patch as large as the light field.

    weight: one for all, or (y, x); where it is 0 the estimate is ignored.
    """
    spread = np.broadcast_to(np.asarray(weight, dtype=np.float32), light_field.shape[2:4]).copy()
    seen = (spread > 0)[..., None]
    return PatchTerm(np.where(seen, light_field, 0).astype(np.float32), spread)


def combine(terms: Iterable[PatchTerm]) -> PatchTerm:
    """Return one term for the sum of several, but for a constant: weights add, targets average."""
    total, weight = None, None
    for term in terms:
        part = term.weight[..., None] * term.target
        if total is None or weight is None:
            total, weight = part, term.weight.copy()
        elif term.target.shape != total.shape:
            raise ReconstructionError(
                f"patch terms of shapes {total.shape} and {term.target.shape} do not combine"
            )
        else:
            total += part
            weight += term.weight
    if total is None or weight is None:
        raise ReconstructionError("no patch terms to combine: give at least one")
    return PatchTerm(_mean(total, weight), weight)
