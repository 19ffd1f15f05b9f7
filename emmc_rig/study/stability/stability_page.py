"""The sweeps as one HTML file that opens offline: tables of breaking points, and curves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from emmc_rig.pages.marks import ShownMark, ShownPair, marks_data
from emmc_rig.pages.page import Section, fragment, framed, inline_svg, number
from emmc_rig.study.stability.curve_drawing import shown
from emmc_rig.study.stability.curves import Curve, breaking_rows
from emmc_rig.study.stability.fault_points import Point
from emmc_rig.study.stability.fault_sweep import StabilitySweep

CAVEATS = (
    "A method breaks where it falls 3 dB below its best on that curve, and where it falls below "
    "the true centre view copied to every view. Between measured strengths the curve is taken as "
    "straight.",
    "The readings are made by the real Psi with the sensor's noise on the grid of the "
    "reconstruction; where mask, lens or shots are at fault, the methods are given the design's.",
    "Turning and scaling a mask moves its rim most: the larger the picture, the sooner it breaks.",
    "Contrast: the PSNR is that of the picture stretched back to full contrast.",
)


def stability_page(
    about: Sequence[str],
    sections: Sequence[Section],
    sweep: StabilitySweep,
    curves: Sequence[Curve],
) -> str:
    """Return the page. about: sentences under the title. curves: whose points show pictures."""
    return framed(
        "Where methods fail", about, CAVEATS, sections, ["chart.css", "stability.css"],
        ["chart.js"], marks_data(_marks(sweep, curves)),
    )  # fmt: skip


def breaking_section(scene: str, curves: Sequence[Curve]) -> Section:
    """Return the table of one scene, or of all: method x fault -> breaking point."""
    rows, methods = breaking_rows(curves, scene)
    body = fragment("stability_breaking.html", rows=rows, methods=methods)
    return Section("breaking-" + scene.replace(" ", "-"), f"Breaking points, {scene}", body)


def curves_section(scene: str, kind: str, curves: Sequence[Curve], svg: Path) -> Section:
    """Return the small multiples of one kind of fault; points show their picture."""
    key = f"{kind}-{scene}".lower().replace(" ", "-")
    first = curves[0].mark_name(0)
    body = fragment("stability_curves.html", drawing=inline_svg(svg, key), first=first)
    return Section(key, f"{kind}, {scene}", body)


def _marks(sweep: StabilitySweep, curves: Iterable[Curve]) -> dict[str, ShownMark]:
    marks = {}
    for curve in curves:
        measured = zip(curve.strengths, curve.levels, curve.points, strict=True)
        for index, (strength, level, points) in enumerate(measured):
            if level is not None:
                label = f"{curve.fault.title}, {shown(strength)} {curve.fault.unit}"
                pairs = [_pair(sweep, point) for point in points]
                words = f"{curve.label}: {level:.2f} dB"
                marks[curve.mark_name(index)] = ShownMark(label, words, pairs)
    return marks


def _pair(sweep: StabilitySweep, point: Point) -> ShownPair:
    result = sweep.results[point]
    words = f"{point.scene_name}: {number(result['psnr_db'], '.2f')} dB"
    if result["view_db"] is not None:
        words += f", copied centre view {result['view_db']:.2f} dB"
    return ShownPair(words, sweep.picture(point), sweep.truth_picture(point))
