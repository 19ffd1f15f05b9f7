"""The sweeps as one HTML file that opens offline: sections in, page out."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path

from emmc_rig.pages.page import Section, embedded, framed, table_head, text
from emmc_rig.study.stability.curves import Curve
from emmc_rig.study.stability.draw import gid_of, shown
from emmc_rig.study.stability.rows import breaking_rows
from emmc_rig.study.stability.run import StabilityRun

CAVEATS = (
    "A method breaks where it falls 3 dB below its best on that curve, and where it falls below "
    "the true centre view copied to every view. Between measured strengths the curve is taken as "
    "straight.",
    "The readings are made by the real Psi with the sensor's noise on the grid of the "
    "reconstruction; where mask, lens or shots are at fault, the methods are told the design's.",
    "Turning and scaling a mask moves its rim most: the larger the picture, the sooner it breaks.",
    "Contrast: the PSNR is that of the picture stretched back to full contrast.",
)


def page(about: Sequence[str], sections: Sequence[Section], data: str = "") -> str:
    """Return the page. about: sentences under the title. data: from `points_data`."""
    chart = resources.files("emmc_rig.study.chart")
    own = resources.files("emmc_rig.study.stability").joinpath("page.css").read_text("utf-8")
    last = sections[-1]
    sections = [*sections[:-1], Section(last.key, last.short, last.title, last.body + data)]
    return framed(
        "Where methods fail",
        about,
        CAVEATS,
        sections,
        chart.joinpath("page.css").read_text("utf-8") + own,
        chart.joinpath("page.js").read_text("utf-8") if data else "",
    )


def breaking_section(scene: str, curves: Sequence[Curve]) -> Section:
    """Return the table of one scene, or of all: method x fault -> breaking point."""
    rows, methods = breaking_rows(curves, scene)
    lines = "".join(
        f'<tr><th scope="row" title="{text(row.fault.explained)}">{text(row.title)}</th>'
        f"<td>{text(row.unit)}</td>"
        f"<td>{'can be repaired' if row.fault.repairable else 'limit'}</td>"
        + "".join(f"<td>{text(cell)}</td>" for cell in row.cells)
        + "</tr>"
        for row in rows
    )
    head = table_head(("Fault", "Unit", "Kind", *methods))
    body = (
        '<p class="lead">Each cell: where the method falls 3 dB below its best / where it falls '
        'below the copied centre view. "Never": not within the sweep; "before": also broken on the '
        "other side of the best, up to there.</p>"
        f'<div class="scroll"><table class="breaks">{head}'
        f"<tbody>{lines}</tbody></table></div>"
    )
    key = "breaking-" + scene.replace(" ", "-")
    return Section(key, f"Breaking points, {scene}", f"Breaking points, {scene}", body)


def curves_section(scene: str, kind: str, curves: Sequence[Curve], svg: Path) -> Section:
    """Return the small multiples of one kind of fault; points show their picture."""
    key = f"{kind}-{scene}".lower().replace(" ", "-")
    drawn = svg.read_text("utf-8")
    drawn = drawn[drawn.index("<svg") :]
    # Several charts on one page: what one refers to must not be found in another.
    drawn = re.sub(r'(id="|href="#|url\(#)(?!mark-)', rf"\g<1>{key}-", drawn)
    first = gid_of(curves[0], 0)
    body = (
        '<p class="lead">Point at a measured strength to see what was reconstructed.</p>'
        f'<div class="chart panels"><div>{drawn}</div><div class="shown-point" '
        f'data-first="{first}" aria-live="polite"></div></div>'
    )
    return Section(key, f"{kind}, {scene}", f"{kind}, {scene}", body)


def points_data(run: StabilityRun, curves: Iterable[Curve]) -> str:
    """Return what the points show, for the page's script."""
    points, pictures = {}, {}
    for curve in curves:
        for index, (strength, level, measured) in enumerate(
            zip(curve.strengths, curve.levels, curve.points, strict=True)
        ):
            if level is None:
                continue
            pairs = []
            for point in measured:
                estimate, truth = run.pictures[point], run.truths[point]
                pictures.update({path.name: path for path in (estimate, truth)})
                pairs.append(
                    {
                        "told": f"{point.scene_name}: {_levels(run.results[point])}",
                        "estimate": estimate.name,
                        "truth": truth.name,
                    }
                )
            points[gid_of(curve, index)] = {
                "label": f"{curve.fault.title}, {shown(strength)} {curve.fault.unit}",
                "told": f"{curve.label}: {level:.2f} dB",
                "pictures": pairs,
            }
    shown_once = {name: embedded(path) for name, path in pictures.items()}
    return _script("points", points) + _script("pictures", shown_once)


def _levels(result: Mapping[str, object]) -> str:
    view = result["view_db"]
    copied = "" if view is None else f", copied centre view {view:.2f} dB"
    return f"{result['psnr_db']:.2f} dB{copied}"


def _script(name: str, data: object) -> str:
    content = json.dumps(data, ensure_ascii=True).replace("</", "<\\/")
    return f'<script type="application/json" id="{name}">{content}</script>'
