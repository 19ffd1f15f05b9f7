"""The tables, findings, charts and figures as one HTML file that opens offline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from emmc_rig.pages.page import Section, embedded, fragment, framed, provenance_section
from emmc_rig.study.tables.cells import METHOD_TITLES, PARTS
from emmc_rig.study.tables.findings import Finding
from emmc_rig.study.tables.grids import Grid

CAVEAT = (
    "The paper's figures stand beside ours to show the order of things, not to be reached or "
    "beaten: which aperture variant of the MIT scenes it used, and how far its mask stood from the "
    "sensor, is unknown. Compare methods and scenarios within one run."
)
ALTS = {
    "figure5": "Frames of the three scenarios with enlarged pieces",
    "figure6": "Reconstructed views of the three scenarios with enlarged pieces",
    "figure7": "Epipolar images, true and reconstructed",
    "figure8": "Mask patterns",
    "figure9": "Reconstructed views by method and scenario with enlarged pieces",
    "figure10": "Super-resolved views with enlarged pieces",
}


def tables_page(
    about: Sequence[str],
    grids: Sequence[Grid],
    findings: Sequence[Finding],
    charts: Mapping[str, Path],
    figures: Mapping[str, Path],
    provenance: Mapping[str, str],
) -> str:
    """Return the page. about: sentences under the title. charts: by title. figures: by part."""
    body = fragment("tables_findings.html", findings=findings, titles=METHOD_TITLES)
    sections = [Section("findings", "Findings", body)]
    if charts:
        drawn = {title: embedded(path) for title, path in charts.items()}
        sections.append(Section("charts", "Charts", fragment("tables_charts.html", charts=drawn)))
    for grid in grids:
        body = fragment("tables_grid.html", grid=grid, titles=METHOD_TITLES)
        sections.append(_section(grid.name, grid.title, body))
    for name, path in figures.items():
        body = fragment("tables_figure.html", alt=ALTS[name], picture=embedded(path))
        sections.append(_section(f"{name}-picture", PARTS[name].title, body))
    sections.append(provenance_section(provenance))
    title = "The paper's tables and figures, reproduced"
    return framed(title, about, [CAVEAT], sections, ["tables.css"])


def _section(key: str, title: str, body: str) -> Section:
    return Section(key, title, body, title.partition(":")[0])
