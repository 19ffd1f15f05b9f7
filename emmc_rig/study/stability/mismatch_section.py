"""The mismatch protocol as a section of the page: four scenarios, every method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from emmc_rig.pages.drawing import COLOURS, INK, legend_below, save_drawing, sheet, titled
from emmc_rig.pages.page import Section, embedded, fragment
from emmc_rig.study.stability.mismatch import SCENARIOS, Mismatch

MARKS = {
    "ideal": ("o", INK, "none", 10),
    "mismatched": ("X", "#b42318", "#b42318", 7),
    "oracle": ("D", COLOURS[0], "none", 7),
    "blind": ("o", COLOURS[0], COLOURS[0], 4),
}


def draw_mismatch(rows: Sequence[Mismatch], path: Path) -> Path:
    """Write a panel for each error of one scene, a column a method, as SVG and PNG."""
    errors = list(dict.fromkeys(row.error for row in rows))
    figure, axes = sheet(len(errors), 3.9, 2.9, columns=min(3, len(errors)))
    for panel, error in zip(axes, errors, strict=True):
        some = [row for row in rows if row.error == error]
        for place, row in enumerate(some):
            ends = row.mismatched, row.blind
            panel.plot([place, place], ends, color=COLOURS[0], linewidth=1, alpha=0.5)
            for kind in SCENARIOS:
                mark, edge, face, size = MARKS[kind]
                panel.plot(
                    place, getattr(row, kind), mark, color=edge, markerfacecolor=face,
                    markersize=size, label=kind if place == 0 else None,
                )  # fmt: skip
        panel.set_xticks(range(len(some)), [row.method for row in some], rotation=20)
        panel.tick_params(labelsize=7.5)
        panel.set_xlim(-0.5, len(some) - 0.5)
        titled(panel, error)
    lines, names = axes[0].get_legend_handles_labels()
    legend_below(figure, lines, names, 4)
    return save_drawing(figure, path)


def recovered_share(rows: Sequence[Mismatch], of_oracle: bool = False) -> float | None:
    """Return what blind correction recovers of all that was lost; None where too little was."""
    whole = [row for row in rows if (row.of_oracle if of_oracle else row.recovered) is not None]
    best = (row.oracle if of_oracle else row.ideal for row in whole)
    lost = sum(one - row.mismatched for one, row in zip(best, whole, strict=True))
    return sum(row.blind - row.mismatched for row in whole) / lost if whole else None


def mismatch_sections(rows: Sequence[Mismatch], folder: Path) -> list[Section]:
    """Return a section for each scene, its chart written into a folder."""
    sections = []
    for scene in dict.fromkeys(row.scene for row in rows):
        some = [row for row in rows if row.scene == scene]
        picture = draw_mismatch(some, folder / f"mismatch-{scene}.svg")
        body = fragment(
            "mismatch.html",
            scene=scene,
            picture=embedded(picture),
            rows=some,
            scenarios=SCENARIOS,
            share=recovered_share(some),
            share_of_oracle=recovered_share(some, True),
        )
        sections.append(Section(f"mismatch-{scene}", f"Mismatch of Psi, {scene}", body))
    return sections
