"""Numerical stability as a section of the page: the checks, and what became of every method."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from emmc_rig.pages.drawing import FAINT, INK, save_svg, sheet, titled
from emmc_rig.pages.page import Section, embedded, table_head, text
from emmc_rig.study.chart.draw import COLOURS
from emmc_rig.study.stability.checks import Outcome
from emmc_rig.study.stability.draw import PNG_DPI
from emmc_rig.study.stability.numerics import Numerics


def draw_numerics(found: Numerics, path: Path) -> Path:
    """Write the PSNR of every method by the scale of its data as SVG and PNG."""
    figure, (axes,) = sheet(1, 6.4, 3.2)
    usual = found.outcomes["as it is"]
    for place, method in enumerate(usual):
        levels = {1.0: usual[method]} | {
            scale: outcomes[method] for scale, outcomes in found.scales.items()
        }
        known = sorted((s, one.db) for s, one in levels.items() if math.isfinite(one.db))
        axes.plot(
            [s for s, _ in known], [db for _, db in known], "-o", markersize=3.6,
            color=COLOURS[place % len(COLOURS)], label=method,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlabel(
        "readings and noise, times what they were (no mark: refused)", color=FAINT, fontsize=8.5
    )
    titled(axes, "The scale of the data")
    axes.legend(
        fontsize=8, frameon=False, labelcolor=INK, loc="center left", bbox_to_anchor=(1, 0.5)
    )
    figure.savefig(path.with_suffix(".png"), dpi=PNG_DPI)
    return save_svg(figure, path)


def numerics_section(found: Numerics, folder: Path) -> Section:
    """Return the section, its chart written into a folder."""
    picture = draw_numerics(found, folder / "numerics.svg")
    rows = "".join(
        f'<tr><th scope="row">{text(one.name)}</th><td>{text(one.figure)}</td>'
        f'<td class="{one.verdict}">{one.verdict}</td><td>{text(one.meaning)}</td></tr>'
        for one in found.findings
    )
    heads = table_head(("Check", "Found", "Verdict", "What it means"))
    every: dict[str, Mapping[str, Outcome]] = {
        **found.outcomes,
        **{f"x {scale:g}": outcomes for scale, outcomes in found.scales.items()},
    }
    methods = list(found.outcomes["as it is"])
    cells = "".join(
        f'<tr><th scope="row">{text(method)}</th>'
        + "".join(
            f'<td title="{text(one[method].refused)}">{text(one[method].words)}</td>'
            for one in every.values()
        )
        + "</tr>"
        for method in methods
    )
    body = (
        '<p class="lead">Small captures of a built-in scene. What should change nothing must '
        "change nothing; what cannot be solved must be refused in words, or come out finite.</p>"
        f'<div class="scroll"><table class="findings">{heads}<tbody>{rows}</tbody></table></div>'
        f'<img class="shown" alt="PSNR by the scale of the data" src="{embedded(picture)}">'
        "<h3>Every method, dB</h3>"
        f'<div class="scroll"><table class="breaks">{table_head(("Method", *every))}'
        f"<tbody>{cells}</tbody></table></div>"
    )
    return Section("numerics", "Numerical stability", "Numerical stability", body)
