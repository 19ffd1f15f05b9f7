"""The command `emmc-rig chart`: speed against accuracy of every method, and timings of parts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from emmc_rig.commands.chart_ablation import chart_ablation, chart_constants
from emmc_rig.commands.chart_guard import chart_guard
from emmc_rig.commands.chart_kernels import chart_kernels
from emmc_rig.commands.chart_live import chart_live
from emmc_rig.commands.chart_next_shot import chart_next_shot
from emmc_rig.commands.chart_peers import chart_peers
from emmc_rig.commands.chart_solvers import chart_solvers
from emmc_rig.commands.chart_stated import chart_stated
from emmc_rig.commands.options import (
    DEFAULT_SCENE,
    DictionaryOption,
    MethodsOption,
    ScenesOption,
    SeedOption,
    SizeOption,
)

if TYPE_CHECKING:
    from emmc_rig.study.chart.points import ChartSettings

ONE_SHOT = "rgbw-bayer-1shot"
TIMED_SIZE, TIMED_CALLS = (593, 840), 7
STUDIED_SIZE = (128, 160)


def chart(
    scene: ScenesOption = None,
    camera: Annotated[
        list[str] | None,
        typer.Option("--camera", help="a shipped camera or a YAML file; may repeat"),
    ] = None,
    fast: Annotated[
        bool, typer.Option("--fast", help="small crops, few points: minutes, not hours")
    ] = False,
    method: MethodsOption = None,
    scaling: Annotated[
        bool, typer.Option("--scaling/--no-scaling", help="growth with the problem's size")
    ] = True,
    kernels: Annotated[
        bool, typer.Option("--kernels", help="instead: the kernels against a memory triad")
    ] = False,
    solvers: Annotated[
        bool, typer.Option("--solvers", help="instead: the sparse solvers, and scikit-learn's")
    ] = False,
    peers: Annotated[
        bool, typer.Option("--peers", help="instead: the primal-dual step, and pyproximal's")
    ] = False,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="instead: gain and cost of each part of `adaptive`")
    ] = False,
    constants: Annotated[
        bool,
        typer.Option(
            "--constants", help="instead: cost of 2x, 0.5x of each constant of `adaptive`"
        ),
    ] = False,
    next_shot: Annotated[
        bool, typer.Option("--next-shot", help="instead: how many shots a scene needs, which")
    ] = False,
    guard: Annotated[
        bool, typer.Option("--guard", help="instead: PSNR of the default method, against figures")
    ] = False,
    live: Annotated[
        bool, typer.Option("--live", help="instead: the live page: stop, pictures, light field")
    ] = False,
    stated: Annotated[
        bool, typer.Option("--stated", help="instead: PSNR and deviation as stated, and as true")
    ] = False,
    until: Annotated[
        list[float] | None,
        typer.Option("--until", min=1, help="PSNR, dB, at which --next-shot stops; may repeat"),
    ] = None,
    dictionary: DictionaryOption = None,
    size: SizeOption = None,
    repeats: Annotated[
        int | None, typer.Option("--repeats", min=1, help="timed calls of each, at most")
    ] = None,
    seed: SeedOption = 0,
    out: Annotated[
        Path | None, typer.Option("--out", help="folder to write (default: emmc-chart)")
    ] = None,
) -> None:
    """Chart speed against accuracy of every method; run it again to go on where it stopped."""
    from emmc_rig.files.results import parse_size

    shape = parse_size(size)
    one_camera = (camera or [ONE_SHOT])[0]
    timed = shape or TIMED_SIZE, repeats or TIMED_CALLS
    if solvers:
        chart_solvers(one_camera, dictionary, out or Path("emmc-solvers"))
    elif peers:
        chart_peers(one_camera, *timed, out or Path("emmc-peers"))
    elif kernels:
        chart_kernels(one_camera, *timed, out or Path("emmc-kernels"))
    elif guard:
        chart_guard(scene or [], camera, shape, out or Path("emmc-guard"))
    elif live:
        chart_live(one_camera, (scene or [DEFAULT_SCENE])[0], shape, out or Path("emmc-live"))
    elif stated:
        chart_stated(scene or [], camera, shape, out or Path("emmc-stated"))
    elif constants:
        from simulators.scenes import SCENES

        cut, place = shape or STUDIED_SIZE, out or Path("emmc-constants")
        chart_constants(scene or list(SCENES), one_camera, cut, seed, place)
    elif ablation:
        seen, cut = (scene or [DEFAULT_SCENE])[0], shape or STUDIED_SIZE
        chart_ablation(seen, one_camera, cut, seed, out or Path("emmc-ablation"))
    elif next_shot:
        from simulators.scenes import SCENES

        place, targets = out or Path("emmc-next-shot"), sorted(until or [30.0])
        cut = shape or STUDIED_SIZE
        chart_next_shot(scene or list(SCENES), one_camera, cut, targets, seed, place)
    else:
        from emmc_rig.study.chart.points import chart_settings

        settings = chart_settings(
            fast, scene or [], camera or [], shape, repeats,
            methods=tuple(method or []), scaling=scaling, dictionary=dictionary, seed=seed,
        )  # fmt: skip
        _chart_methods(settings, out or Path("emmc-chart"))


def _chart_methods(settings: ChartSettings, place: Path) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    from emmc_rig.commands.bars import say, shown_bars
    from emmc_rig.study.chart.charting import run_chart

    with shown_bars() as bars:
        outcome = run_chart(settings, place, bars)
    for one in outcome.shown():
        table = Table("the front", "s", "dB", title=one.title, box=SIMPLE)
        for mark in one.front():
            table.add_row(mark.configuration.label, f"{mark.seconds:.3g}", f"{mark.psnr_db:.2f}")
        Console().print(table)
    if outcome.growths:
        table = Table("growth", "against", "exponent", "expected", box=SIMPLE)
        for growth in outcome.growths:
            expected = "-" if growth.expected is None else f"{growth.expected:.2f}"
            table.add_row(growth.label, growth.axis, f"{growth.exponent:.2f}", expected)
        Console().print(table)
    for line in outcome.left_out:
        say("left out", line)
    typer.echo(f"{outcome.seconds:.0f} s; open {place / outcome.page.name}")
