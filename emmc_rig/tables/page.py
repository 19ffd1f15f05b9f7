"""The tables, findings, charts and figures as one HTML file that opens offline."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

from emmc_rig import __version__
from emmc_rig.tables.findings import Finding
from emmc_rig.tables.grids import Grid, Pair
from emmc_rig.tables.plan import METHOD_TITLES, METHODS, PARTS

CAVEAT = (
    "The paper's figures stand beside ours to show the order of things, not to be reached or "
    "beaten: which aperture variant of the MIT scenes it used, and how far its mask stood from the "
    "sensor, is unknown. Compare methods and scenarios within one run."
)
KINDS = {".png": "image/png", ".svg": "image/svg+xml"}
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
    report = resources.files("emmc_rig").joinpath("report_template.html").read_text("utf-8")
    template = resources.files("emmc_rig.tables").joinpath("page.html").read_text("utf-8")
    style = re.search(r"<style>(.*?)</style>", report, re.DOTALL)
    assert style is not None
    sections = [("findings", "Findings", _findings(findings))]
    sections += [(grid.name, grid.title, _grid(grid)) for grid in grids]
    if charts:
        sections.insert(1, ("charts", "Charts", _charts(charts)))
    sections += [
        (f"{name}-picture", PARTS[name].title, _figure(name, path))
        for name, path in figures.items()
    ]
    sections.append(("provenance", "Provenance", _provenance(provenance)))
    parts = {
        "title": _text(title),
        "generator": _text(f"emmc-rig {__version__}"),
        "style": re.sub(r"\{\{\w+\}\}", "", style[1]),
        "about": "".join(f"<p>{_text(line)}</p>" for line in about),
        "caveat": _text(CAVEAT),
        "navigation": "".join(
            f'<li><a href="#{key}">{_text(_short(name))}</a></li>' for key, name, _ in sections
        ),
        "sections": "".join(
            f'<section id="{key}"><h2>{_text(name)}</h2>{body}</section>'
            for key, name, body in sections
        ),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


def _short(name: str) -> str:
    return name.partition(":")[0]


def _text(value: object) -> str:
    return html.escape(str(value), quote=True)


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
            f'<tr><th scope="row">{_text(claim.says)}'
            f'<p class="note">{_text(claim.compares)}. Judged by '
            f"{_text(METHOD_TITLES[claim.judged_by])}.</p>"
            f'<p class="note">“{_text(claim.sentence)}”</p></th>'
            f'<td class="verdict {TONES[finding.verdict]}">{_text(finding.verdict)}</td>'
            f'<td class="number">{_text(judged or "-")}</td>'
            f'<td class="number">{f"{judged.holding} of {judged.scenes}" if judged else "-"}</td>'
            f'<td class="number">{"<br>".join(map(_text, others)) or "-"}</td>'
            f'<td class="number">{_text(finding.printed or "not printed")}</td></tr>'
        )
    heads = (
        "Finding, what is compared, and where the paper says so", "Here",
        "By dB: mean (range over scenes)", "Scenes", "Other methods", "In the paper's numbers",
    )  # fmt: skip
    return (
        '<p class="lead">A finding holds when the mean difference over the scenes is above zero.'
        f'</p><table class="findings">{_head(heads)}<tbody>{"".join(rows)}</tbody></table>'
    )


def _head(names: Sequence[str]) -> str:
    cells = "".join(f'<th scope="col">{_text(name)}</th>' for name in names)
    return f"<thead><tr>{cells}</tr></thead>"


def _grid(grid: Grid) -> str:
    rows = []
    before: tuple[str, ...] = ()
    for line in grid.lines:
        best = max((p.ours for p in line.pairs if p.ours is not None), default=None)
        heads = "".join(
            f'<th scope="row">{"" if before[: i + 1] == line.heads[: i + 1] else _text(head)}</th>'
            for i, head in enumerate(line.heads)
        )
        cells = "".join(_pair(pair, best) for pair in line.pairs)
        first = "first" if not before or before[0] != line.heads[0] else ""
        rows.append(f'<tr class="{first} {"mean" if line.mean else ""}">{heads}{cells}</tr>')
        before = line.heads
    methods = ", ".join(METHOD_TITLES[method] for method in METHODS)
    return (
        f'<p class="lead">PSNR in dB, the paper\'s after the bar; the best of a line is bold. '
        f"Methods: {_text(methods)}.</p>"
        f'<div class="scroll"><table class="grid">{_head((*grid.heads, *grid.columns))}'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _pair(pair: Pair, best: float | None) -> str:
    ours = "–" if pair.ours is None else f"{pair.ours:.2f}"
    if pair.ours is not None and pair.ours == best:
        ours = f"<b>{ours}</b>"
    theirs = "" if pair.paper is None else f" <i>| {pair.paper:.2f}</i>"
    return f'<td class="number">{ours}{theirs}</td>'


def _embedded(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f"data:{KINDS[path.suffix]};base64,{data}"


def _charts(charts: Mapping[str, Path]) -> str:
    drawn = "".join(
        f"<figure><figcaption><strong>{_text(title)}</strong></figcaption>"
        f'<img src="{_embedded(path)}" alt="{_text(title)}"></figure>'
        for title, path in charts.items()
    )
    return f'<div class="charts">{drawn}</div>'


def _figure(name: str, path: Path) -> str:
    source = _embedded(path)
    return f'<img class="shown" src="{source}" alt="{_text(ALTS[name])}">'


def _provenance(provenance: Mapping[str, str]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{_text(key)}</th><td><code>{_text(value)}</code></td></tr>'
        for key, value in provenance.items()
    )
    return f'<table class="narrow"><tbody>{rows}</tbody></table>'
