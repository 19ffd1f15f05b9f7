"""The marks of a chart on a page: each shows its label and pictures beside the chart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.pages.page import embedded


@dataclass(frozen=True)
class ShownPair:
    """Pictures of a reconstruction and of the truth, and a line above them."""

    words: str
    estimate: Path
    truth: Path


@dataclass(frozen=True)
class ShownMark:
    """What a page shows of a mark: a heading, a line, and pictures."""

    label: str
    words: str
    pairs: Sequence[ShownPair]


def marks_data(marks: Mapping[str, ShownMark]) -> dict[str, object]:
    """Return what chart.js reads, see `framed`; marks: by their names in the drawings."""
    points = {
        name: {
            "label": mark.label,
            "words": mark.words,
            "pictures": [
                {"words": pair.words, "estimate": pair.estimate.name, "truth": pair.truth.name}
                for pair in mark.pairs
            ],
        }
        for name, mark in marks.items()
    }
    pairs = [pair for mark in marks.values() for pair in mark.pairs]
    paths = dict.fromkeys(path for pair in pairs for path in (pair.estimate, pair.truth))
    return {"points": points, "pictures": {path.name: embedded(path) for path in paths}}
