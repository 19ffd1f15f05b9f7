"""The command `emmc-rig import`: files and masks of another program to a session."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import CameraOption, OutOption
from emmc_rig.commands.output import give_result, say, shown_progress, tell


def import_(
    table: Annotated[
        Path | None,
        typer.Argument(
            help="CSV with a row for each file: file, kind, exposure_s and more, see docs"
        ),
    ] = None,
    camera: CameraOption = "",
    out: OutOption = Path("emmc-session"),
    shots: Annotated[
        list[str] | None,
        typer.Option(
            "--shots", help="without a table: shots, for instance 'shot*.tif'; may repeat"
        ),
    ] = None,
    darks: Annotated[
        list[str] | None, typer.Option("--darks", help="without a table: dark frames, lamp off")
    ] = None,
    whites: Annotated[
        list[str] | None,
        typer.Option(
            "--whites", help="without a table: whiteboards through the masks, aperture open"
        ),
    ] = None,
    references: Annotated[
        list[str] | None,
        typer.Option("--references", help="without a table: whiteboards without the masks"),
    ] = None,
    planes: Annotated[
        bool,
        typer.Option("--planes", help="read a colour picture as three monochrome shots"),
    ] = False,
) -> None:
    """Make a session from frames of another program."""
    from emmc_rig.captures.import_session import import_session
    from emmc_rig.captures.import_table import ImportedKind, read_table, rows_of_globs

    globs: dict[ImportedKind, list[str] | None] = {
        "shot": shots, "dark": darks, "open": whites, "reference": references
    }  # fmt: skip
    given: dict[ImportedKind, list[str]] = {kind: some for kind, some in globs.items() if some}
    if not camera:
        raise typer.BadParameter("--camera: name the camera that took the files")
    if (table is None) == (not given):
        raise typer.BadParameter("name a table, or the files by --shots 'shot*.tif' and the like")
    listed = rows_of_globs(given) if table is None else read_table(table)
    with shown_progress() as bars:
        bars.begin("files", len(listed))
        done = import_session(listed, camera, out, planes, bars.step)
    for note in done.notes:
        say("note", note)
    kinds = {frame.kind for frame in done.session.frames}
    tell(
        f"{len(done.session.stored)} frames of {len(listed)} files imported and verified, in {out}"
    )
    if not kinds & {"whiteboard", "open"}:
        tell(
            "no whiteboards: Psi is the camera's design, or one of your own: "
            f"emmc-rig reconstruct {out} --psi PSI.h5"
        )
    else:
        tell(f"measure Psi from the whiteboards: emmc-rig calibrate {out}")
    give_result(out, frames=len(done.session.stored))
