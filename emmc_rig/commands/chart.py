"""The command `emmc-rig chart`: speed against accuracy of every method, and timings of parts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from emmc_rig.commands.options import (
    DictionaryOption,
    MethodsOption,
    ScenesOption,
    SeedOption,
    SizeOption,
)
from emmc_rig.commands.output import give_result, say, show_table, shown_progress, tell

if TYPE_CHECKING:
    from emmc_rig.study.chart.points import ChartSettings


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
        bool, typer.Option("--constants", help="instead: cost of 2x, 0.5x of each constant of it")
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
    pages: Annotated[
        bool, typer.Option("--pages", help="instead: report and viewer in a headless Chromium")
    ] = False,
    stated: Annotated[
        bool, typer.Option("--stated", help="instead: PSNR and deviation as stated, and as true")
    ] = False,
    trends: Annotated[
        bool, typer.Option("--trends", help="instead: PSNR against noise, shots, other methods")
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
    instead = {
        "kernels": kernels, "solvers": solvers, "peers": peers, "ablation": ablation,
        "constants": constants,
        "next-shot": next_shot, "guard": guard, "live": live, "pages": pages,
        "stated": stated, "trends": trends,
    }  # fmt: skip
    for name in (name for name, wanted in instead.items() if wanted):
        _benchmark(
            name, out or Path(f"emmc-{name}"), (camera or [None])[0], scenes=scene or [],
            size=shape, repeats=repeats, seed=seed, dictionary=dictionary, targets_db=until or [],
        )  # fmt: skip
        return
    from emmc_rig.study.chart.points import chart_settings

    settings = chart_settings(
        fast, scene or [], camera or [], shape, repeats,
        methods=tuple(method or []), scaling=scaling, dictionary=dictionary, seed=seed,
    )  # fmt: skip
    _chart_methods(settings, out or Path("emmc-chart"))


def _benchmark(name: str, out: Path, camera: str | None, **asked: Any) -> None:
    from emmc_rig.errors import AppError
    from emmc_rig.study.benchmarks.running import run_benchmark

    with shown_progress() as bars:
        metrics = run_benchmark(name, out, bars, camera, **asked)
    give_result(out)
    if fallen := metrics.get("fell"):
        raise AppError(
            f"{len(fallen)} figure(s) fell: {'; '.join(fallen)}: fix the method, or store "
            f"{out / 'guard.json'} where intended"
        )


def _chart_methods(settings: ChartSettings, place: Path) -> None:
    from emmc_rig.study.chart.charting import run_chart

    with shown_progress() as bars:
        outcome = run_chart(settings, place, bars)
    for one in outcome.shown():
        rows = [
            (m.configuration.label, f"{m.seconds:.3g}", f"{m.psnr_db:.2f}") for m in one.front()
        ]
        show_table(("the front", "s", "dB"), rows, one.title)
    if outcome.growths:
        rows = [
            (
                g.label,
                g.axis,
                f"{g.exponent:.2f}",
                "-" if g.expected is None else f"{g.expected:.2f}",
            )
            for g in outcome.growths
        ]
        show_table(("growth", "against", "exponent", "expected"), rows)
    for line in outcome.left_out:
        say("left out", line)
    tell(f"{outcome.seconds:.0f} s; open {place / outcome.page.name}")
    give_result(place)
