"""The mismatch protocol as a section of the page: four scenarios, every method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from emmc_rig.pages.drawing import FAINT, INK, save_svg, sheet, titled
from emmc_rig.pages.page import Section, embedded, table_head, text
from emmc_rig.study.chart.draw import COLOURS
from emmc_rig.study.stability.draw import PNG_DPI
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
        panel.xaxis.label.set_color(FAINT)
        titled(panel, error)
    lines, names = axes[0].get_legend_handles_labels()
    figure.legend(
        lines, names, loc="outside lower center", ncols=4, fontsize=8.5, frameon=False,
        labelcolor=INK,
    )  # fmt: skip
    figure.savefig(path.with_suffix(".png"), dpi=PNG_DPI)
    return save_svg(figure, path)


def recovered_share(rows: Sequence[Mismatch], of_oracle: bool = False) -> float | None:
    """Return what blind mending recovers of all that was lost; None where next to nothing was."""
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
        share, of_oracle = recovered_share(some), recovered_share(some, True)
        body = (
            '<p class="lead">Ideal: nothing has moved. Mismatched: the mask has, and Psi is the '
            "design's. Oracle: Psi is that which made the readings. Blind: Psi as the readings "
            "alone suggest. Protocol of InverseNet (arXiv 2603.04538).</p>"
            f"<p>Over all of it, blind mending recovers {_percent(share)} of what was lost against "
            f"the ideal, {_percent(of_oracle)} of what knowing Psi recovers.</p>"
            f'<img class="shown" alt="Mismatch on {text(scene)}" src="{embedded(picture)}">'
            f"{_table(some)}"
        )
        title = f"Mismatch of Psi, {scene}"
        sections.append(Section(f"mismatch-{scene}", title, title, body))
    return sections


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{share:.0%}"


def _db(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "–"


def _table(rows: Sequence[Mismatch]) -> str:
    heads = (
        "Error", "Error of Psi", "mended to", "Told", "Method", *SCENARIOS, "Recovered",
        "of the oracle's",
    )  # fmt: skip
    body = "".join(
        f'<tr><th scope="row">{text(row.error)}</th><td>{row.psi_error:.1%}</td>'
        f"<td>{row.psi_left:.1%}</td><td>{'yes' if row.told else 'no'}</td>"
        f"<td>{text(row.method)}</td>"
        + "".join(f"<td>{_db(getattr(row, kind))}</td>" for kind in SCENARIOS)
        + f"<td>{_percent(row.recovered)}</td><td>{_percent(row.of_oracle)}</td></tr>"
        for row in rows
    )
    return (
        f'<div class="scroll"><table class="breaks">{table_head(heads)}<tbody>{body}</tbody>'
        "</table></div>"
    )
