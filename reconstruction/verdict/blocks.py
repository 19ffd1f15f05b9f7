"""The verdict on a light field that was reconstructed in blocks: of all together, and of places."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from emmc_rig.reconstruction.verdict.evidence import Evidence
from emmc_rig.reconstruction.verdict.rules import LEVELS, Level, Reason, Verdict, verdict_from

Combine = Callable[[Sequence[float], Sequence[float]], float]
DOUBTED_SHARE = 0.25
"""Share of the blocks that are doubted alone, beyond which the whole is: each is judged by fewer
readings than the whole, so that a few of them are doubted by chance."""
REFUSED_SHARE = 0.5
"""Share of the blocks with the verdict do not use, beyond which the whole is not to be used; a
single block is a place to look at."""


@dataclass(frozen=True)
class JudgedBlock:
    """A block's verdict, its first row and column of pixels, and how many pixels it is."""

    verdict: Verdict
    row: int
    column: int
    pixels: int

    @property
    def evidence(self) -> Evidence:
        """The figures of its verdict."""
        return self.verdict.evidence

    def in_whole(self, place: Sequence[float]) -> tuple[int, int]:
        """Return a place of the block, row and column, counted from the first pixel of all."""
        return int(self.row + place[0]), int(self.column + place[1])


def _mean(values: Sequence[float], weights: Sequence[float]) -> float:
    return float(np.average(values, weights=weights))


def _root_mean_square(values: Sequence[float], weights: Sequence[float]) -> float:
    return float(np.sqrt(np.average(np.square(values), weights=weights)))


def _error_of_mean(values: Sequence[float], weights: Sequence[float]) -> float:
    share = np.asarray(weights) / np.sum(weights)
    return float(np.sqrt(np.sum(np.square(share * np.asarray(values)))))


def _largest(values: Sequence[float], weights: Sequence[float]) -> float:
    return float(max(values))


COMBINED: dict[str, Combine] = {
    "strength_errors": _error_of_mean,
    "colour_error": _root_mean_square,
    "misfit": _root_mean_square,
    "hole_px": _largest,
}
"""How figures of blocks are combined; those not named here by their mean."""


def _over_blocks(key: str, values: Sequence[Any], weights: Sequence[float]) -> Any:
    """Return a figure, or each of a tuple or dict of figures, over the blocks that have it."""
    having = [(v, w) for v, w in zip(values, weights, strict=True) if v is not None]
    if not having:
        return None
    known, of_known = zip(*having, strict=True)
    if isinstance(known[0], dict):
        names = dict.fromkeys(name for figures in known for name in figures)
        return {
            name: _over_blocks(name, [figures.get(name) for figures in known], of_known)
            for name in names
        }
    if isinstance(known[0], tuple):
        return tuple(_over_blocks(key, each, of_known) for each in zip(*known, strict=True))
    return COMBINED.get(key, _mean)(known, of_known)


def _worst_motion(blocks: Sequence[JudgedBlock]) -> dict[str, Any]:
    """Return the figures of motion of the block where its ratio is largest."""
    moving = [block for block in blocks if block.evidence.motion is not None]
    if not moving:
        return {"moved_at": None, "moved_px": None}
    worst = max(moving, key=lambda block: block.evidence.motion or 0.0)
    e = worst.evidence
    at = None if e.moved_at is None else (e.moved_at[0], *worst.in_whole(e.moved_at[1:]))
    return {
        "motion": e.motion, "moved_px": e.moved_px,
        "moved_at": at,
    }  # fmt: skip


def _masks_seen(blocks: Sequence[JudgedBlock]) -> tuple[Any, ...] | None:
    """Return how the masks stand in most pixels: see `Evidence`."""
    pixels = defaultdict[tuple[Any, ...] | None, int](int)
    for block in blocks:
        pixels[block.evidence.masks_seen] += block.pixels
    return max(pixels, key=lambda seen: pixels[seen])


def combined(blocks: Sequence[JudgedBlock]) -> Evidence:
    """Return the evidence of all blocks together: means by pixels, and the worst places."""
    evidence = [block.evidence for block in blocks]
    weights = [float(block.pixels) for block in blocks]
    worst_hole = max(blocks, key=lambda block: block.evidence.hole_px)
    of_whole = {
        **{key: getattr(evidence[0], key) for key in ("method", "status", "view_axes")},
        "left_out": tuple(sorted({shot for e in evidence for shot in e.left_out})),
        "kept": sum(e.kept for e in evidence),
        "hole_at": worst_hole.in_whole(worst_hole.evidence.hole_at),
        "masks_seen": _masks_seen(blocks),
        **_worst_motion(blocks),
    }
    figures = {
        key: _over_blocks(key, [getattr(e, key) for e in evidence], weights)
        for key in Evidence.__dataclass_fields__
        if key not in of_whole
    }
    parameters = dict(figures["parameters"] or {})
    if "misfit" in parameters:
        worst = max(blocks, key=lambda block: block.evidence.parameters.get("misfit", 0.0))
        of_worst = worst.evidence.parameters
        row, column = worst.in_whole((of_worst["misfit_row"], of_worst["misfit_column"]))
        parameters |= {"misfit_row": float(row), "misfit_column": float(column)}
    figures |= {"parameters": parameters, "changes": figures["changes"] or {}}
    return Evidence(**figures, **of_whole)


def judged_together(blocks: Sequence[JudgedBlock]) -> Verdict:
    """Return the verdict on all blocks; a reason more where some alone are worse than the whole.

    blocks: at least one.
    """
    whole = verdict_from(combined(blocks))
    levels: tuple[Level, ...] = ("do not use", "doubt")
    for level in levels:
        rank = LEVELS.index(level)
        bad = [block for block in blocks if LEVELS.index(block.verdict.level) >= rank]
        share = len(bad) / len(blocks)
        if share <= (DOUBTED_SHARE if level == "doubt" else 0) or len(blocks) == 1:
            continue
        if rank <= LEVELS.index(whole.level):
            continue
        worst = max(bad, key=lambda block: LEVELS.index(block.verdict.level))
        reason = worst.verdict.reasons[0]
        words = (
            f"{len(bad)} of {len(blocks)} blocks are worse than the whole, as that from row "
            f"{worst.row}, column {worst.column}: {reason.what}"
        )
        level_of_share = level if share > REFUSED_SHARE else "doubt"
        return whole.with_reasons([Reason(words, share, reason.remedy, level_of_share)])
    return whole
