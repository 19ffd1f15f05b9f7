"""The verdict on a light field that was reconstructed in blocks: of all together, and of places."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from emmc_rig.reconstruction.verdict.evidence import Evidence
from emmc_rig.reconstruction.verdict.rules import LEVELS, Limits, Reason, Verdict, verdict_from

Combine = Callable[[Sequence[float], Sequence[float]], float]
DOUBTED_SHARE = Limits(0.25, 1.0)
"""Share of the blocks that are doubted alone, beyond which the whole is: each is judged by fewer
readings than the whole, so that a few of them are doubted by chance."""
REFUSED_SHARE = Limits(0.0, 0.5)
"""Share of blocks with the verdict do not use: one is a place to look at, half of them the
capture."""


@dataclass(frozen=True)
class JudgedBlock:
    """A block's verdict, its first row and column of pixels, and how many pixels it is."""

    verdict: Verdict
    row: int
    column: int
    pixels: int


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
"""How figures of blocks become one; others by their mean."""


def _combined(key: str, values: Sequence[Any], weights: Sequence[float]) -> Any:
    """Return the combined value of a figure, or collection of figures, over the blocks with
    values."""
    having = [(value, weight) for value, weight in zip(values, weights, strict=True)
              if value is not None]  # fmt: skip
    if not having:
        return None
    first = having[0][0]
    some, heavy = [figure for figure, _ in having], [weight for _, weight in having]
    if isinstance(first, dict):
        keys = dict.fromkeys(name for figure in some for name in figure)
        return {
            name: _combined(name, [figure.get(name) for figure in some], heavy) for name in keys
        }
    if isinstance(first, tuple):
        return tuple(_combined(key, each, heavy) for each in zip(*some, strict=True))
    return COMBINED.get(key, _mean)(some, heavy)


def _places(blocks: Sequence[JudgedBlock]) -> dict[str, Any]:
    """Return figures of the worst block of each kind: hole and motion."""
    found: dict[str, Any] = {}
    e = [(block, block.verdict.evidence) for block in blocks]
    block, figures = max(e, key=lambda each: each[1].hole_px)
    found["hole_at"] = _at(block, figures.hole_at)
    moved = [(figures.motion, block, figures) for block, figures in e if figures.motion is not None]
    if moved:
        ratio, block, figures = max(moved, key=lambda each: each[0])
        found |= {
            "motion": ratio,
            "motion_effect": figures.motion_effect,
            "moved_px": figures.moved_px,
        }
        if figures.moved_at is not None:
            found["moved_at"] = (figures.moved_at[0], *_at(block, figures.moved_at[1:]))
    return found


def _at(block: JudgedBlock, place: Sequence[float]) -> tuple[int, int]:
    return int(block.row + place[0]), int(block.column + place[1])


def combined(blocks: Sequence[JudgedBlock]) -> Evidence:
    """Return the evidence of all blocks together: means by pixels, and the worst places."""
    weights = [float(block.pixels) for block in blocks]
    evidence = [block.verdict.evidence for block in blocks]
    first = evidence[0]
    same = {key: getattr(first, key) for key in ("method", "status", "view_axes")}
    left_out = tuple(sorted({shot for figures in evidence for shot in figures.left_out}))
    figures = {
        key: _combined(key, [getattr(of_block, key) for of_block in evidence], weights)
        for key in Evidence.__dataclass_fields__
        if key not in (*same, "left_out", "kept", "hole_at", "moved_at", "moved_px")
    }
    kept = sum(of_block.kept for of_block in evidence)
    parameters = {**(figures["parameters"] or {})}
    worst = max(blocks, key=lambda block: block.verdict.evidence.parameters.get("misfit", 0.0))
    if "misfit" in parameters:
        of_worst = worst.verdict.evidence.parameters
        row, column = _at(worst, (of_worst["misfit_row"], of_worst["misfit_column"]))
        parameters |= {"misfit_row": float(row), "misfit_column": float(column)}
    whole = {"hole_at": (0, 0), "moved_at": None, "moved_px": None, **_places(blocks)}
    figures |= {"parameters": parameters, "changes": figures["changes"] or {}}
    return Evidence(**{**same, "left_out": left_out, "kept": kept, **figures, **whole})


def judged_together(blocks: Sequence[JudgedBlock]) -> Verdict:
    """Return the verdict on all blocks; a reason more where some alone are worse than the whole.

    blocks: at least one.
    """
    whole = verdict_from(combined(blocks))
    reasons = list(whole.reasons)
    for level, limits in (("do not use", REFUSED_SHARE), ("doubt", DOUBTED_SHARE)):
        bad = [block for block in blocks if _rank(block.verdict.level) >= _rank(level)]
        share = len(bad) / len(blocks)
        level_of_share = limits.level(share)
        if level_of_share == "trust" or _rank(level) <= _rank(whole.level) or len(blocks) == 1:
            continue
        worst = max(bad, key=lambda block: _rank(block.verdict.level))
        reason = worst.verdict.reasons[0]
        reasons.append(
            Reason(
                f"{len(bad)} of {len(blocks)} blocks are worse than the whole, as that from row "
                f"{worst.row}, column {worst.column}: {reason.what}",
                share,
                reason.remedy,
                level_of_share,
            )
        )
        break
    reasons.sort(key=lambda reason: -_rank(reason.level))
    return replace(whole, level=reasons[0].level if reasons else "trust", reasons=tuple(reasons))


def _rank(level: str) -> int:
    return LEVELS.index(level)  # type: ignore[arg-type]
