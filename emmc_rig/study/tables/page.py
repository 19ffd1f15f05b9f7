"""The tables, findings, charts and figures as one HTML file that opens offline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

from emmc_rig.pages.page import Section, embedded, framed, provenance_table, table_head, text
from emmc_rig.study.tables.findings import Finding
from emmc_rig.study.tables.grids import Grid, Pair
from emmc_rig.study.tables.plan import METHOD_TITLES, METHODS, PARTS

CAVEAT = (
    "The paper's figures stand beside ours to show the order of things, not to be reached or "
    "beaten: which aperture variant of the MIT scenes it used, and how far its mask stood from the "
    "sensor, is unknown. Compare methods and scenarios within one run."
)
TONES = {"holds": "good", "does not hold": "bad", "not measured": "watch"}
ALTS = {
    "figure5": "Frames of the three scenarios with enlarged pieces",
    "figure6": "Reconstructed views of the three scenarios with enlarged pieces",
    "figure7": "Epipolar images, true and reconstructed",
    "figure8": "Mask patterns",
    "figure9": "Reconstructed views by method and scenario with enlarged pieces",
    "figure10": "Super-resolved views with enlarged pieces",
}


def page(
    title: str,
    about: Sequence[str],
    grids: Sequence[Grid],
    findings: Sequence[Finding],
    charts: Mapping[str, Path],
    figures: Mapping[str, Path],
    provenance: Mapping[str, str],
) -> str:
    """Return the page. about: sentences under the title. charts: by title. figures: by part."""
    style = resources.files("emmc_rig.study.tables").joinpath("page.css").read_text("utf-8")
    sections = [Section("findings", "Findings", "Findings", _findings(findings))]
    if charts:
        sections.append(Section("charts", "Charts", "Charts", _charts(charts)))
    sections += [_section(grid.name, grid.title, _grid(grid)) for grid in grids]
    sections += [
        _section(f"{name}-picture", PARTS[name].title, _figure(name, path))
        for name, path in figures.items()
    ]
    sections.append(_section("provenance", "Provenance", provenance_table(dict(provenance))))
    return framed(title, about, [CAVEAT], sections, style)


def _section(key: str, title: str, body: str) -> Section:
    return Section(key, title.partition(":")[0], title, body)


def _findings(findings: Sequence[Finding]) -> str:
    rows = []
    for finding in findings:
        claim, judged = finding.claim, finding.judged
        others = [
            f"{METHOD_TITLES[method]} {spread}"
            for method, spread in finding.ours.items()
            if method != claim.judged_by
        ]
        rows.append(
            f'<tr><th scope="row">{text(claim.says)}'
            f'<p class="note">{text(claim.compares)}. Judged by '
            f"{text(METHOD_TITLES[claim.judged_by])}.</p>"
            f'<p class="note">“{text(claim.sentence)}”</p></th>'
            f'<td class="verdict {TONES[finding.verdict]}">{text(finding.verdict)}</td>'
            f'<td class="number">{text(judged or "-")}</td>'
            f'<td class="number">{f"{judged.holding} of {judged.scenes}" if judged else "-"}</td>'
            f'<td class="number">{"<br>".join(map(text, others)) or "-"}</td>'
            f'<td class="number">{text(finding.printed or "not printed")}</td></tr>'
        )
    heads = (
        "Finding, what is compared, and where the paper says so", "Here",
        "By dB: mean (range over scenes)", "Scenes", "Other methods", "In the paper's numbers",
    )  # fmt: skip
    return (
        '<p class="lead">A finding holds when the mean difference over the scenes is above zero.'
        f'</p><table class="findings">{table_head(heads)}<tbody>{"".join(rows)}</tbody></table>'
    )


def _grid(grid: Grid) -> str:
    rows = []
    before: tuple[str, ...] = ()
    for line in grid.lines:
        best = max((p.ours for p in line.pairs if p.ours is not None), default=None)
        heads = "".join(
            f'<th scope="row">{"" if before[: i + 1] == line.heads[: i + 1] else text(head)}</th>'
            for i, head in enumerate(line.heads)
        )
        cells = "".join(_pair(pair, best) for pair in line.pairs)
        first = "first" if not before or before[0] != line.heads[0] else ""
        rows.append(f'<tr class="{first} {"mean" if line.mean else ""}">{heads}{cells}</tr>')
        before = line.heads
    methods = ", ".join(METHOD_TITLES[method] for method in METHODS)
    return (
        f'<p class="lead">PSNR in dB, the paper\'s after the bar; the best of a line is bold. '
        f"Methods: {text(methods)}.</p>"
        f'<div class="scroll"><table class="grid">{table_head((*grid.heads, *grid.columns))}'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _pair(pair: Pair, best: float | None) -> str:
    ours = "–" if pair.ours is None else f"{pair.ours:.2f}"
    if pair.ours is not None and pair.ours == best:
        ours = f"<b>{ours}</b>"
    theirs = "" if pair.paper is None else f" <i>| {pair.paper:.2f}</i>"
    return f'<td class="number">{ours}{theirs}</td>'


def _charts(charts: Mapping[str, Path]) -> str:
    drawn = "".join(
        f"<figure><figcaption><strong>{text(title)}</strong></figcaption>"
        f'<img src="{embedded(path)}" alt="{text(title)}"></figure>'
        for title, path in charts.items()
    )
    return f'<div class="charts">{drawn}</div>'


def _figure(name: str, path: Path) -> str:
    source = embedded(path)
    return f'<img class="shown" src="{source}" alt="{text(ALTS[name])}">'
