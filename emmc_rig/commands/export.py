"""The command `emmc-rig export`: a light field, or Psi, in a format that others read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from emmc_rig.commands.options import ExportSizeOption, TruthOption, out_option
from emmc_rig.commands.output import give_result, shown_progress, tell

if TYPE_CHECKING:
    from emmc_rig.formats.format import Film, Format


def export(
    result: Annotated[
        str | None,
        typer.Argument(
            help="a folder of `reconstruct` or `demo`, of a film too, a session, a scene, or the "
            "word psi"
        ),
    ] = None,
    of: Annotated[
        Path | None,
        typer.Argument(
            help="after psi: its file, or a session or folder that holds it; frames there are "
            "exported, too"
        ),
    ] = None,
    form: Annotated[
        str | None,
        typer.Option(
            "--format", help="see --list (default: viewer); for psi: npz (default) or mat"
        ),
    ] = None,
    list_formats: Annotated[
        bool, typer.Option("--list", help="list the formats: what each is, and keeps")
    ] = False,
    truth: TruthOption = None,
    size: ExportSizeOption = None,
    out: Annotated[Path | None, out_option("emmc-FORMAT")] = None,
) -> None:
    """Export a light field or Psi to other programs, or as a viewer."""
    from emmc_rig.formats.exports import film_of
    from emmc_rig.formats.registry import ALIASES, FORMATS
    from emmc_rig.report.viewer import VIEWER
    from emmc_rig.store.result_files import holds_light_field
    from emmc_rig.store.results import parse_size

    if of is not None and result != "psi":
        raise typer.BadParameter(f"'{of}': export one light field at a time")
    if result == "psi" and (of is not None or not holds_light_field(Path("psi"))):
        _export_psi(of or Path("psi" if Path("psi").exists() else "."), form or "npz", out)
        return
    known = {VIEWER.name: VIEWER, **FORMATS}
    if list_formats:
        for kind in known.values():
            uses = ["; --scene reads it"] * bool(kind.read) + ["; films"] * bool(kind.write_film)
            tell(f"{kind.name:<10} {kind.title}: {kind.keeps}{''.join(uses)}")
        give_result(formats={kind.name: kind.keeps for kind in known.values()})
        return
    named = form or VIEWER.name
    form = ALIASES.get(named, named)
    if form not in known:
        raise typer.BadParameter(f"no format {named!r}; there are {', '.join(known)}")
    if result is None:
        raise typer.BadParameter("name a result or a scene, or list the formats by --list")
    out = out or Path(f"emmc-{named}")
    film = film_of(result)
    if film is not None and truth is not None:
        raise typer.BadParameter(f"--truth: export a single frame, such as {film.first.source}")
    _write_as(known[form], result, truth, parse_size(size), film, named, out)


def _write_as(
    kind: Format,
    source: str,
    truth: str | None,
    size: tuple[int, int] | None,
    film: Film | None,
    named: str,
    out: Path,
) -> None:
    """Write a light field, or a film, in a format; named: the format as typed."""
    from emmc_rig.formats.exports import open_export
    from emmc_rig.store.folders import result_folder
    from emmc_rig.store.results import shown_bytes, write_metrics

    with result_folder(out, f"export --format {named}") as folder, shown_progress("read") as bars:
        if film is None:
            opened = open_export(source, truth, size)
            facts: dict[str, object] = {"shape": list(opened.light_field.shape)}
            bars.begin("write")
            kind.write_whole(folder, opened)
        else:
            facts = {"shape": list(film.shape), "missing_frames": film.missing}
            bars.begin("write", len(film.frames))
            kind.write_whole_film(folder, replace(film, watcher=bars))
        files = [path for path in folder.rglob("*") if path.is_file()]
        written = sum(path.stat().st_size for path in files)
        about = {"source": source, "format": kind.name, "keeps": kind.keeps}
        write_metrics(folder, {**about, **facts, "bytes": written})
        shown = files[0].relative_to(folder) if len(files) == 1 else None
    count = f"{len(files)} file{'s' * (len(files) > 1)}"
    tell(f"wrote {out / shown if shown else out}, {shown_bytes(written)} in {count}")
    give_result(out)


def _export_psi(source: Path, form: str, out: Path | None) -> None:
    """Write the Psi of a file or folder, and its frames if it has any, as a sparse matrix."""
    import emmc_rig as emmc
    from emmc_rig.formats.psi_exports import PSI_FORMATS
    from emmc_rig.store.folders import is_session, result_folder
    from emmc_rig.store.psi import (
        PSI_GROUP,
        StoredPsi,
        holds_frames,
        psi_beside,
    )
    from emmc_rig.store.results import shown_bytes, write_metrics

    if form not in PSI_FORMATS:
        raise typer.BadParameter(f"no format {form!r} of psi; there are {', '.join(PSI_FORMATS)}")
    out = out or Path(f"emmc-psi-{form}")
    with (
        result_folder(out, f"export psi --format {form}") as folder,
        shown_progress("read") as bars,
    ):
        frames = None
        if is_session(source) or holds_frames(source):
            psi, frames = emmc.open_frames(source)
        else:
            inside = source.is_dir() and source.name != PSI_GROUP
            psi = StoredPsi(psi_beside(source) if inside else source).load()
        bars.begin("write")
        PSI_FORMATS[form](folder, psi, frames)
        written = sum(path.stat().st_size for path in folder.iterdir())
        write_metrics(
            folder,
            {"source": str(source), "format": form, "shape": list(psi.shape), "bytes": written},
        )
    what = f"{psi!r}{'' if frames is None else ' and its frames'}"
    tell(f"wrote {what} to {out}, {shown_bytes(written)}")
    give_result(out)
