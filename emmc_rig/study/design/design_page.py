"""The page of a design: the mask, what was tried, what the maker may miss, the comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from emmc_rig.pages.page import (
    Card,
    Head,
    Section,
    fragment,
    framed,
    number,
    provenance_section,
    typed,
)
from emmc_rig.study.design.search import Search

CAVEATS = (
    "Theory assumes textures on two planes half a sample of disparity apart, and noise, without "
    "occlusion. Differences of a tenth of a dB are below its accuracy.",
    "Frames are simulated by the Psi of the mask as printed, on the grid of the reconstruction; "
    "on a bench, calibration measures that Psi.",
)
SHOWN = 20
"""Masks in the table."""
Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Heads of the columns, and rows."""


def design_page(
    about: Sequence[str],
    found: Search,
    simulated: Table,
    verdict: str,
    camera: Path,
    provenance: Mapping[str, str],
) -> str:
    """Return the page of a design.

    simulated: theory and simulation, a row a camera. camera: its file, as it will lie.
    """
    best = found.expected
    loss_db = found.ideal_db - best.psnr_db
    cards = (
        Card(
            "Expected PSNR",
            f"{best.psnr_db:.2f} dB",
            f"{found.held[0].worst_db:.2f} with the maker's worst error",
        ),
        Card("Light", f"{best.light:.0%}", "of the open camera's"),
        Card("Fresnel number", f"{best.fresnel:.2g}", f"diffraction loses {loss_db:.2f} dB"),
    )
    names = list(found.held[0].psnr_db)
    body = fragment(
        "design.html",
        cards=cards,
        tried=_tried(found),
        held=(
            ["Mask", *names],
            [
                [mask.candidate.label, *(number(mask.psnr_db[name], ".2f") for name in names)]
                for mask in found.held
            ],
        ),
        simulated=simulated,
    )
    sections = [Section("design", found.winner.label, body, "Design")]
    sections.append(provenance_section(provenance))
    head = Head(
        found.winner.label,
        verdict,
        [
            "try it on a scene of your own: "
            f"`emmc-rig simulate --camera {typed(camera)} --scene FOLDER`",
            "to have it made, send the mask's GDSII file, which is beside that camera",
        ],
    )
    return framed("Which mask to order", about, CAVEATS, sections, head=head)


def _tried(found: Search) -> Table:
    heads = ("Mask", "Expected PSNR, dB", "Light", "Fresnel number")
    rows = [
        [one.label, f"{what.psnr_db:.2f}", f"{what.light:.0%}", f"{what.fresnel:.2g}"]
        for one, what in found.tried[:SHOWN]
    ]
    return heads, rows
