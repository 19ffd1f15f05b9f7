"""The command `emmc-rig stability`: where methods fail, by sweeps of faults."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from emmc_rig.commands.options import (
    ClusterOption,
    DictionaryOption,
    ScenesOption,
    SeedOption,
    SizeOption,
    check_workers,
)
from emmc_rig.commands.output import give_result, say, show_table, shown_progress, tell


def stability(
    scene: ScenesOption = None,
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera", help="a shipped camera or a YAML file (default: rgbw-bayer-3shots)"
        ),
    ] = None,
    fault: Annotated[
        list[str] | None, typer.Option("--fault", help="only this one; may repeat")
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option("--method", help="only this one, or all; may repeat"),
    ] = None,
    fast: Annotated[
        bool, typer.Option("--fast", help="one small crop, few points: minutes, not hours")
    ] = False,
    screening: Annotated[
        bool | None,
        typer.Option(
            "--screening/--no-screening",
            help="screen the frames for bad pixels and shots (default: both, where it matters)",
        ),
    ] = None,
    theory: Annotated[
        bool, typer.Option("--theory", help="beside it: what Psi alone predicts, and its bounds")
    ] = False,
    numerics: Annotated[
        bool, typer.Option("--numerics", help="beside it: rounding, scale, repeated runs")
    ] = False,
    mismatch: Annotated[
        bool,
        typer.Option("--mismatch", help="beside it: a wrong Psi, corrected blindly or exactly"),
    ] = False,
    verdicts: Annotated[
        bool, typer.Option("--verdicts", help="instead: how often verdicts flag broken results")
    ] = False,
    constants: Annotated[
        bool,
        typer.Option("--constants", help="with --verdicts: 2x, 0.5x of each constant behind them"),
    ] = False,
    worst: Annotated[
        bool,
        typer.Option(
            "--worst", help="instead: the worst perturbation of the noise's size, details"
        ),
    ] = False,
    faults: Annotated[bool, typer.Option("--list", help="the faults, and leave")] = False,
    dictionary: DictionaryOption = None,
    size: SizeOption = None,
    seed: SeedOption = 0,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="processes that share the trials")
    ] = None,
    cluster: ClusterOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="folder to write (default: emmc-stability, -verdicts, -worst)"),
    ] = None,
) -> None:
    """Find where methods fail: sweeps of faults; run it again to go on where it stopped."""
    from emmc_rig.files.results import parse_size
    from emmc_rig.study.stability.curves import breaking_rows
    from emmc_rig.study.stability.fault_sweep import CAMERA, planned, stability_settings
    from emmc_rig.study.stability.sweeping import measure_beside, run_stability

    if faults:
        _list_faults()
        return
    check_workers(workers, cluster)
    if verdicts:
        place = out or Path("emmc-verdicts")
        shown = _verdict_constants if constants else _verdicts
        shown(place, fast, scene, camera, fault, method, parse_size(size), seed)
        return
    if worst:
        _worst(
            out or Path("emmc-worst"),
            fast, scene or [], camera, method or [], parse_size(size), dictionary, seed,
        )  # fmt: skip
        return
    out = out or Path("emmc-stability")
    settings = stability_settings(
        fast, scene or [], parse_size(size), camera=camera or CAMERA, faults=tuple(fault or []),
        methods=tuple(method or []), dictionary=dictionary, seed=seed,
        screening={None: "both", True: "on", False: "off"}[screening],
    )  # fmt: skip
    with shown_progress() as bars:
        planned(settings)  # raises for wrong names before anything is measured
        switches = {"theory": theory, "numerics": numerics, "mismatch": mismatch}
        wanted = [name for name, on in switches.items() if on]
        beside = measure_beside(settings, wanted, out, bars)
        outcome = run_stability(
            settings, out, bars, beside.sections, beside.metrics, workers=workers, cluster=cluster
        )
    rows, methods = breaking_rows(outcome.curves, outcome.curves[0].scene)
    title = f"{outcome.curves[0].scene}: 3 dB below its best / below the copied centre view"
    shown = [(f"{row.title}, {row.unit}", *row.cells) for row in rows]
    show_table(("fault", *methods), shown, title)
    for line in beside.lines:
        tell(line)
    for line in outcome.left_out:
        say("left out", line)
    tell(f"open {outcome.page}")
    give_result(out)


def _list_faults() -> None:
    from rich.table import Column

    from emmc_rig.study.stability.faults import FAULTS

    show_table(
        (Column("fault", no_wrap=True), "unit", "strengths", "what happens"),
        [
            (one.name, one.unit, " ".join(f"{s:g}" for s in one.strengths), one.explained)
            for one in FAULTS.values()
        ],
    )
    give_result(faults=list(FAULTS))


def _verdicts(out: Path, *wanted: Any) -> None:
    """Measure how often verdicts flag results that a fault broke, and good ones."""
    from emmc_rig.study.stability import detector

    settings = detector.detector_settings(*wanted)
    with shown_progress() as bars:
        results = detector.run_detector(settings, out, bars)
    show_table(
        ("fault", "method", "broken: flagged", "good: flagged", "between", "poor", "cannot tell"),
        [
            (
                *names,
                *(f"{flagged} of {there}" for flagged, there in tally.pairs()),
                str(tally.undecided),
            )
            for names, tally in detector.tables(results).items()
        ],
    )
    for one in detector.wrong(results):
        kind = "missed" if one.kind == "broken" else "false alarm"
        say(kind, detector.case_words(one))
    tell(f"open {out / 'verdicts.csv'}")
    give_result(out)


def _verdict_constants(out: Path, *wanted: Any) -> None:
    """Measure what the constants of verdicts and screening are worth."""
    from emmc_rig.study.stability import detector, verdict_constants

    settings = detector.detector_settings(*wanted)
    with shown_progress() as bars:
        costs, left_out = verdict_constants.run_verdict_constants(settings, out, bars)
    show_table(
        ("constant", "value", "times", "broken: flagged", "good: flagged", "verdicts changed"),
        [
            (one.constant, one.value, f"{one.factor:g}", f"{one.broken_flagged:+d}",
             f"{one.good_flagged:+d}", str(one.changed))
            for one in costs
            if one.changed
        ],
    )  # fmt: skip
    same = len({one.constant for one in costs} - {one.constant for one in costs if one.changed})
    tell(f"{same} more constants change no verdict of these cases")
    for line in left_out:
        say("left out", line)
    tell(f"open {out / verdict_constants.CSV}")
    give_result(out)


def _worst(out: Path, *wanted: Any) -> None:
    """Measure what harms every method most, and which details it keeps, loses or invents."""
    from emmc_rig.study.stability.worst_study import (
        details_table,
        noise_table,
        run_worst,
        worst_settings,
    )

    settings = worst_settings(*wanted)
    with shown_progress() as bars:
        outcome = run_worst(settings, out, bars)
    for name in (Path(scene).stem for scene in settings.scenes):
        show_table(*noise_table(name, outcome.noise), name)
        show_table(*details_table(name, outcome.details), name)
    for line in outcome.left_out:
        say("left out", line)
    tell(f"open {outcome.page}")
    give_result(out)
