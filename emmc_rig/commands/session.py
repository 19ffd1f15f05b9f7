"""The commands `emmc-rig session`: list, show, verify, export, sheet."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.output import give_result, show_table, shown_progress, tell

app = typer.Typer(
    name="session",
    help="List, show, verify and export sessions of `capture`.",
)

Folder = Annotated[Path, typer.Argument(help="a session folder")]


@app.command("list")
def list_sessions(
    folder: Annotated[Path, typer.Argument(help="the folder that holds sessions")] = Path(),
) -> None:
    """List the sessions in and below a folder."""
    from rich.markup import escape
    from rich.table import Column

    from emmc_rig.errors import AppError
    from emmc_rig.session.verify import sessions_in
    from emmc_rig.store.results import shown_bytes

    with shown_progress("read sessions") as progress:
        found = []
        for session in sessions_in(folder):
            progress.step(session.name)
            found.append(session)
    if not found:
        raise AppError(f"{folder}: holds no session; `emmc-rig capture PLAN` makes one")
    rows = []
    for session in found:
        # Its path from here distinguishes sessions of one name in several folders.
        inside = os.path.relpath(session.folder, folder)
        name = session.name if inside == "." else inside
        about = ", ".join(dict.fromkeys(part for part in (session.title, session.camera) if part))
        stated = "" if session.stated_db is None else f"{session.stated_db:.1f}"
        frames, size = f"{session.stored}/{session.planned}", shown_bytes(session.bytes)
        rows.append(
            (f"{escape(name)}\n[dim]{escape(about)}[/]", session.state, frames, size,
             session.created[:10], session.verdict, stated)
        )  # fmt: skip
    heads = (Column(head, no_wrap=True) for head in ("state", "frames", "size", "begun", "verdict"))
    show_table((Column("session", overflow="fold"), *heads, "accuracy, dB"), rows)
    give_result(sessions=[{**asdict(session), "folder": str(session.folder)} for session in found])


@app.command()
def show(session: Folder) -> None:
    """Show a session's frames, plan and events, without reading the frames."""
    from emmc_rig.report.session_sheet import events
    from emmc_rig.session.brightness import exposure_reasons, shot_exposures
    from emmc_rig.session.planned import kind_name
    from emmc_rig.session.session import PLAN, Session, amended_name
    from emmc_rig.session.verify import counts, summary
    from emmc_rig.store.results import shown_bytes

    opened = Session(session)
    listed = summary(opened)
    tell(f"{listed.name}: {listed.title}")
    tell(f"  {'state':<12} {listed.state} after {opened.runs} run{'s' * (opened.runs > 1)}")
    tell(f"  {'begun':<12} {listed.created}")
    tell(f"  {'size':<12} {shown_bytes(listed.bytes)}")
    tell(f"  {'frames':<12} {listed.stored} of {listed.planned}")
    for kind, (done, planned) in counts(opened).items():
        tell(f"  {kind_name(kind):<12} {done} of {planned}")
    if opened.amendments:
        plans = Counter(entry.plan for entry in opened.stored.values())
        for number in range(opened.amendments + 1):
            name = amended_name(PLAN, number)
            tell(f"  {'plan ' + str(number):<12} {plans[number]} frames, by {name}")
    leftovers, foreign = opened.unexpected_files()
    if leftovers:
        names = ", ".join(leftovers)
        tell(f"  left over from a crash, not counted: {names}")
    for name in foreign:
        tell(f"  {name}: not part of this session")
    for reason in exposure_reasons(shot_exposures(opened)):
        tell(f"  {reason.level:<12} {reason.what}; {reason.remedy}")
    for kind, line in events(opened):
        tell(f"  {kind:<12} {line}")
    give_result(**{**asdict(listed), "folder": str(listed.folder)})


@app.command()
def verify(session: Folder) -> None:
    """Check every frame's SHA-256; exit code 1 unless all are there and good."""
    from emmc_rig.errors import AppError
    from emmc_rig.session.session import Session
    from emmc_rig.session.verify import verify as verified

    opened = Session(session)
    with shown_progress() as progress:
        progress.begin("verify", len(opened.stored))
        verdict = verified(opened, progress)
    for line in verdict.lines():
        tell(line)
    if verdict.is_complete:
        tell(f"complete: {verdict.good} frames, every one as the journal says")
    give_result(complete=verdict.is_complete, good=verdict.good, planned=verdict.planned)
    if not verdict.is_complete:
        raise AppError(
            f"{session}: {verdict.good} of {verdict.planned} frames are good; "
            f"go on with: emmc-rig capture {session}"
        )


@app.command()
def export(
    session: Folder,
    out: Annotated[Path, typer.Option("--out", help="file to write, as s.h5; with --dng a folder")],
    compress: Annotated[
        bool, typer.Option("--compress", help="compress by gzip: much slower")
    ] = False,
    dng: Annotated[
        bool,
        typer.Option("--dng", help="write each frame as DNG"),
    ] = False,
) -> None:
    """Export a session as one HDF5 file (NeXus), or its frames as DNG."""
    from emmc_rig.session.export import export_dng, export_hdf5
    from emmc_rig.session.session import Session
    from emmc_rig.store.results import shown_bytes

    opened = Session(session)
    if dng:
        if compress:
            raise typer.BadParameter("--compress: no effect with --dng; leave it out")
        with shown_progress() as progress:
            progress.begin("export", len(opened.stored))
            export_dng(opened, out, progress)
        tell(f"wrote {len(opened.stored)} DNG files into {out}")
        give_result(out, frames=len(opened.stored))
        return
    with shown_progress() as progress:
        progress.begin("export", len(opened.needed))
        export_hdf5(opened, out, compress, progress)
    tell(f"wrote {out}, {shown_bytes(out.stat().st_size)}")
    give_result(out, bytes=out.stat().st_size)


@app.command()
def sheet(
    session: Folder,
    out: Annotated[
        Path | None, typer.Option("--out", help="folder to write (default: the session)")
    ] = None,
    pictures: Annotated[
        int, typer.Option("--pictures", min=0, help="pictures on the page at most")
    ] = 200,
) -> None:
    """Write the contact sheet of a session: frames, events and times in one HTML page."""
    from emmc_rig.report.session_sheet import write_sheet
    from emmc_rig.session.session import REPORT, Session

    opened = Session(session)
    folder = out or session
    with shown_progress("draw"):
        write_sheet(opened, folder, pictures)
    tell(f"open {folder / REPORT}")
    give_result(report=str(folder / REPORT))
