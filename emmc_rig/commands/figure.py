"""The command `emmc-rig figure`: results of one capture side by side, for a paper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import ExportSizeOption, OutOption, TruthOption
from emmc_rig.commands.output import give_result, shown_progress, tell


def figure(
    results: Annotated[
        list[str], typer.Argument(help="folders of `reconstruct` or `demo`, or sessions")
    ],
    truth: TruthOption = None,
    view: Annotated[
        str | None,
        typer.Option(
            "--view", metavar="V,U", help="row and column of the view shown (default: the middle)"
        ),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            "--at",
            metavar="Y,X",
            help="row and column of a close-up's centre; may repeat (default: two with many edges)",
        ),
    ] = None,
    side: Annotated[
        int | None,
        typer.Option(
            "--side", min=4, help="side of a close-up, pixels (default: 16 % of the width)"
        ),
    ] = None,
    width: Annotated[
        float, typer.Option("--width", min=2, max=40, help="width of the figure, inches")
    ] = 7.16,
    size: ExportSizeOption = None,
    out: OutOption = Path("emmc-figure"),
) -> None:
    """Draw results of one capture side by side, for a paper."""
    from emmc_rig.formats.exports import open_export
    from emmc_rig.report.result_figure import FigureSettings, draw_results
    from emmc_rig.store.folders import result_folder
    from emmc_rig.store.results import parse_size, write_metrics

    settings = FigureSettings(
        None if view is None else _pair("--view", view),
        [_pair("--at", text) for text in at or ()],
        side,
        width,
    )
    with result_folder(out, "figure") as folder, shown_progress("read") as bars:
        truths = (truth, *[None] * (len(results) - 1))
        asked = parse_size(size)
        opened = [open_export(*pair, asked) for pair in zip(results, truths, strict=True)]
        bars.begin("draw")
        drawn = draw_results(opened, settings)
        drawn.save(folder)
        write_metrics(
            folder, {"results": results, "truth": truth, "caption": drawn.caption, **drawn.measured}
        )
    tell(drawn.caption)
    tell(f"wrote {out / 'figure.pdf'}, .svg, .png and .txt, the caption")
    give_result(out)


def _pair(option: str, text: str) -> tuple[int, int]:
    """Return two whole numbers from "2,3"; raises BadParameter."""
    first, comma, second = (part.strip() for part in text.partition(","))
    if not (comma and first.isdecimal() and second.isdecimal()):
        raise typer.BadParameter(f"{option} {text}: write two whole numbers, for instance 2,3")
    return int(first), int(second)
