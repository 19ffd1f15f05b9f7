"""The command `emmc-rig export`: a light field in a format that others read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import ExportSizeOption
from emmc_rig.commands.output import give_result, shown_progress, tell


def export(
    result: Annotated[
        str | None,
        typer.Argument(help="a folder of `reconstruct` or `demo`, a session, or a scene's name"),
    ] = None,
    form: Annotated[str, typer.Option("--format", help="see --list")] = "viewer",
    list_formats: Annotated[
        bool, typer.Option("--list", help="the formats: what each is, and keeps")
    ] = False,
    truth: Annotated[
        str | None, typer.Option("--truth", help="the scene that was captured, for the viewer")
    ] = None,
    size: ExportSizeOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="folder to write (default: emmc-FORMAT)")
    ] = None,
) -> None:
    """Write a light field in a format that others read, or as a viewer: one HTML file."""
    from emmc_rig.files.exports import open_export
    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.formats import FORMATS
    from emmc_rig.files.results import parse_size, shown_bytes, write_metrics
    from emmc_rig.pages.viewer import VIEWER

    known = {VIEWER.name: VIEWER, **FORMATS}
    if list_formats:
        for one in known.values():
            scene = "; --scene reads it" if one.read else ""
            tell(f"{one.name:<10} {one.title}: {one.keeps}{scene}")
        give_result(formats={one.name: one.keeps for one in known.values()})
        return
    if form not in known:
        raise typer.BadParameter(f"no format {form!r}; there are {', '.join(known)}")
    if result is None:
        raise typer.BadParameter("name a result or a scene, or --list the formats")
    out = out or Path(f"emmc-{form}")
    with result_folder(out, f"export --format {form}") as folder, shown_progress("read") as bars:
        opened = open_export(result, truth, parse_size(size))
        bars.begin("write")
        known[form].write_whole(folder, opened)
        files = [path for path in folder.rglob("*") if path.is_file()]
        written = sum(path.stat().st_size for path in files)
        write_metrics(
            folder,
            {
                "source": result,
                "format": form,
                "keeps": known[form].keeps,
                "shape": list(opened.light_field.shape),
                "bytes": written,
            },
        )
        shown = files[0].relative_to(folder) if len(files) == 1 else None
    tell(f"wrote {out / shown if shown else out}, {shown_bytes(written)} in {len(files)} file(s)")
    give_result(out)
