"""The command `emmc-rig stability`: where methods fail, by sweeps of faults."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import (
    DEFAULT_CAMERA,
    CameraOption,
    ClusterOption,
    DictionaryOption,
    FastOption,
    OutOption,
    ScenesOption,
    SeedOption,
    WorkersOption,
    check_workers,
    size_option,
)
from emmc_rig.commands.output import give_result, show_study, show_table, shown_progress


def stability(
    scene: ScenesOption = None,
    camera: CameraOption = DEFAULT_CAMERA,
    fault: Annotated[
        list[str] | None, typer.Option("--fault", help="only this fault; may repeat (default: all)")
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            help="only this method, or `all`; may repeat (default: five; with --fast two)",
        ),
    ] = None,
    fast: FastOption = False,
    faults: Annotated[bool, typer.Option("--list", help="list the faults, and exit")] = False,
    dictionary: DictionaryOption = None,
    size: Annotated[str | None, size_option("96x128; with --fast 36x48")] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    out: OutOption = Path("emmc-stability"),
) -> None:
    """Find the strength of faults at which methods fail.

    The same command goes on where it stopped.
    """
    from emmc_rig.store.results import parse_size
    from emmc_rig.study.stability.stability_study import StabilityStudy, stability_settings

    if faults:
        _list_faults()
        return
    check_workers(workers, cluster)
    settings = stability_settings(
        fast, scene or [], parse_size(size), camera=camera, faults=tuple(fault or []),
        methods=tuple(method or []), dictionary=dictionary, seed=seed,
    )  # fmt: skip
    study = StabilityStudy(settings, out)
    with shown_progress() as bars:
        study.carry_out(bars, workers, cluster)
    show_study(study, out)


def _list_faults() -> None:
    from rich.table import Column

    from emmc_rig.study.stability.faults import FAULTS

    show_table(
        (Column("fault", no_wrap=True), "unit", "strengths", "what happens"),
        [
            (fault.name, fault.unit, " ".join(f"{s:g}" for s in fault.strengths), fault.explained)
            for fault in FAULTS.values()
        ],
    )
    give_result(faults=list(FAULTS))
