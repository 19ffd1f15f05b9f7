"""The command `emmc-rig mask`: a mask's cells from its photograph."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.output import give_result, say, shown_progress, tell

SHOWN_DEFECTS = 10


def mask(
    photo: Annotated[Path, typer.Argument(help="a picture of 8 or 16 bits, or a RAW file")],
    cells: Annotated[str, typer.Option("--cells", help="ROWSxCOLUMNS of the mask")],
    cell_um: Annotated[
        float, typer.Option("--cell-um", min=1e-3, help="side of a cell, um")
    ],
    out: Annotated[Path, typer.Option("--out", help="picture of the mask to write, .png")],
    corners: Annotated[
        str | None,
        typer.Option(
            "--corners",
            metavar="'X,Y X,Y X,Y X,Y'",
            help="outer corners of the cells in the photograph, px, clockwise from the mask's top "
            "left (default: found)",
        ),
    ] = None,
    ordered: Annotated[
        Path | None,
        typer.Option(
            "--ordered",
            help="the mask as ordered, a picture of one pixel a cell, to compare with",
        ),
    ] = None,
    linear: Annotated[
        bool | None,
        typer.Option(
            "--linear/--srgb",
            help="the picture's coding (default: linear with 16 bits, sRGB with 8)",
        ),
    ] = None,
) -> None:  # fmt: skip
    """Measure a mask's cells in a photograph of it."""
    from emmc_rig.calibration.mask_photo import read_mask
    from emmc_rig.errors import WrongUsageError
    from emmc_rig.formats.photograph import read_photograph
    from emmc_rig.report.mask_drawing import write_mask
    from emmc_rig.store.results import parse_size

    size = parse_size(cells, "--cells", "64x64") or (0, 0)
    at = None if corners is None else _corners(corners)
    with shown_progress("read the mask"):
        if out.suffix.lower() != ".png":
            raise WrongUsageError(f"--out {out}: name a file that ends in .png")
        light = read_photograph(photo, linear)
        wanted = None if ordered is None else read_photograph(ordered, linear=True)
        found = read_mask(light, size, at, wanted)
        listed, checked = write_mask(light, found, out, cell_um)
    sigma = float((found.sigma**2).mean() ** 0.5)
    height, width = (count * cell_um / 1e3 for count in size)
    tell(
        f"{cells} cells, {height:g} x {width:g} mm: transmittance within "
        f"{sigma:.3f} rms, {found.clear:.0%} clear, blur {found.blur_cells:.2f} cells"
    )
    for defect in found.defects[:SHOWN_DEFECTS]:
        say("defect", f"row {defect.row}, column {defect.column}: {defect.what}")
    if len(found.defects) > SHOWN_DEFECTS:
        say("defect", f"and {len(found.defects) - SHOWN_DEFECTS} more, see {listed}")
    tell(f"in a camera's file: pattern: {{kind: picture, path: {out.name}}}, cell_um: {cell_um:g}")
    tell(f"wrote {out} and {listed}; look at {checked}")
    give_result(out, figures=str(listed), drawing=str(checked), sigma=sigma)


def _corners(text: str) -> list[tuple[float, float]]:
    """Return four points from "X,Y X,Y X,Y X,Y"; raises BadParameter."""
    try:
        points = [tuple(map(float, pair.split(","))) for pair in text.split()]
    except ValueError:
        points = []
    if len(points) != 4 or any(len(point) != 2 for point in points):
        raise typer.BadParameter(
            f"--corners {text}: write four points in quotes, such as '12,9 620,14 611,630 8,622'"
        )
    return [(point[0], point[1]) for point in points]
