"""Numerical stability as a section of the page: the checks, and the PSNR of every method."""

from __future__ import annotations

import math
from pathlib import Path

from emmc_rig.pages.drawing import LEGEND, colours_of, save_drawing, sheet, titled
from emmc_rig.pages.page import Section, embedded, fragment
from emmc_rig.study.stability.numerics import Numerics


def draw_numerics(found: Numerics, path: Path) -> Path:
    """Write the PSNR of every method by the scale of its data as SVG and PNG."""
    figure, (axes,) = sheet(1, 6.4, 3.2)
    usual = found.outcomes["as it is"]
    for method, colour in colours_of(usual).items():
        levels = {1.0: usual[method]} | {
            scale: outcomes[method] for scale, outcomes in found.scales.items()
        }
        known = sorted((s, one.db) for s, one in levels.items() if math.isfinite(one.db))
        axes.plot(
            [s for s, _ in known], [db for _, db in known], "-o", markersize=3.6,
            color=colour, label=method,
        )  # fmt: skip
    axes.set_xscale("log")
    across = "readings and noise, times what they were (no mark: refused)"
    titled(axes, "The scale of the data", across)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), **LEGEND)
    return save_drawing(figure, path)


def numerics_section(found: Numerics, folder: Path) -> Section:
    """Return the section, its chart written into a folder."""
    picture = draw_numerics(found, folder / "numerics.svg")
    scales = {f"x {scale:g}": outcomes for scale, outcomes in found.scales.items()}
    body = fragment(
        "numerics.html",
        findings=found.findings,
        picture=embedded(picture),
        outcomes={**found.outcomes, **scales},
        methods=list(found.outcomes["as it is"]),
    )
    return Section("numerics", "Numerical stability", body)
