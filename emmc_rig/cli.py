"""The command line: arguments in, exit code out; 0 done, 1 failed, 2 wrong usage, 130 Ctrl-C."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table

from calibration.errors import CalibrationError
from drivers.errors import DriverError
from emmc_rig import __version__
from emmc_rig.commands.bars import console, shown_bars
from emmc_rig.commands.calibrate import calibrate
from emmc_rig.commands.capture import CaptureStoppedError, capture
from emmc_rig.commands.devices import app as devices
from emmc_rig.commands.live import live
from emmc_rig.commands.options import (
    CameraOption,
    DictionaryOption,
    MethodOption,
    MethodsOption,
    OutOption,
    SceneOption,
    ScenesOption,
    SeedOption,
    ShotsOption,
    SizeOption,
)
from emmc_rig.commands.session import app as session
from emmc_rig.errors import AppError
from emmc_rig.model.errors import ModelError
from reconstruction.errors import ReconstructionError

if TYPE_CHECKING:
    from emmc_rig.model.camera import Camera

ERRORS = (AppError, ModelError, DriverError, CalibrationError, ReconstructionError)
INTERRUPTED = 130
DEFAULT_SCENE = "deep-occlusions"
DEFAULT_CAMERA = "rgbw-bayer-3shots"
TIMED_SIZE, TIMED_CALLS = "593x840", 7

app = typer.Typer(
    name="emmc-rig",
    help="Compressed light-field acquisition: model, rig, calibration, reconstruction.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(devices, name="devices")
app.add_typer(session, name="session")
app.command()(capture)
app.command()(live)
app.command()(calibrate)


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _size(
    text: str | None, option: str = "--size", example: str = "192x256"
) -> tuple[int, int] | None:
    from emmc_rig.files.results import parse_size

    return parse_size(text, option, example)


def _camera(spec: str, shots: int | None) -> Camera:
    """Return a camera by name or file, with as many shots as asked for."""
    from emmc_rig.files.cameras import find_camera

    camera = find_camera(spec)
    return camera if shots is None else camera.with_shots(shots)


@app.callback(invoke_without_command=True)
def root(
    version: Annotated[bool, typer.Option("--version", help="print the version")] = False,
) -> None:
    """Compressed light-field acquisition: model, rig, calibration, reconstruction."""
    if version:
        typer.echo(f"emmc-rig {__version__}")
        raise typer.Exit


@app.command()
def demo(
    scene: SceneOption = DEFAULT_SCENE,
    camera: CameraOption = DEFAULT_CAMERA,
    shots: ShotsOption = None,
    seed: SeedOption = 0,
    size: SizeOption = None,
    mu: Annotated[
        float | None, typer.Option("--mu", help="weight of the regulariser (default: from noise)")
    ] = None,
    chroma_weight: Annotated[
        float, typer.Option("--chroma-weight", help="of chrominance differences; 1: DV_1")
    ] = 2.0,
    method: MethodOption = "tv",
    dictionary: DictionaryOption = None,
    out: OutOption = Path("emmc-demo"),
) -> None:
    """Run the whole loop on the simulated rig, and write a report."""
    from emmc_rig.commands.demo import DemoSettings, run_demo
    from emmc_rig.files.results import result_folder
    from emmc_rig.model.settings import validated
    from reconstruction.methods import MethodSettings

    described = _camera(camera, shots)
    chosen = {"tv": {"mu": mu, "chroma_weight": chroma_weight}}
    solver = validated(MethodSettings, chosen, "solver settings", AppError)
    settings = DemoSettings(
        scene,
        camera,
        described,
        _size(size),
        seed,
        method=method,
        dictionary=dictionary,
        solver=solver,
    )
    for warning in described.warnings():
        console.print(f"[yellow]warning:[/] {warning}", highlight=False)
    with result_folder(out) as folder, shown_bars() as bars:
        metrics = run_demo(settings, folder, bars)
    gain = metrics["psnr_db"] - metrics["replicate_psnr_db"]
    typer.echo(
        f"{metrics['psnr_db']:.2f} dB from {metrics['shots']} shot(s), {gain:+.2f} dB against the "
        f"copied centre view; SSIM {metrics['ssim']:.3f}; Psi to "
        f"{metrics['psi_relative_error']:.2%}; {metrics['status']}"
        + (f" ({metrics['advice']})" if metrics["advice"] else "")
    )
    typer.echo(f"open {out / 'report.html'}")
    _end_with_verdict(metrics["verdict"], strict=False)


@app.command()
def cameras(
    name: Annotated[
        str | None, typer.Argument(help="a shipped camera or a YAML file; none: list all")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="folder for the drawing and its metrics")
    ] = None,
) -> None:
    """List the cameras known, or draw one: masks, weights, sampling, condition."""
    from emmc_rig.files.cameras import find_camera
    from emmc_rig.files.results import command_line, result_folder, versions, write_metrics
    from emmc_rig.pages.camera_sheet import (
        camera_figures,
        camera_rows,
        draw_camera,
    )

    if name is None:
        table = Table("camera", "sensor", "shots", "masks", "sampling", "light", box=SIMPLE)
        for row in camera_rows():
            table.add_row(
                f"[bold]{row.name}[/]\n{row.title}",
                row.sensor,
                str(row.shots),
                str(row.masks),
                row.sampling_rate,
                f"{row.light_percent:.0f} %",
            )
        Console().print(table)
        return
    camera = find_camera(name)
    figures = camera_figures(camera)
    folder_name = out or Path(f"camera-{Path(name).stem}")
    with result_folder(folder_name) as folder:
        draw_camera(camera, folder / "camera.png")
        write_metrics(folder, {**figures, "command": command_line(), "versions": versions()})
    table = Table("figure", "value", title=camera.title)
    for key, value in figures.items():
        if isinstance(value, dict):
            for mask, measured in value.items():
                for what, figure in measured.items():
                    table.add_row(f"{mask}: {what}", _shown(figure))
        else:
            table.add_row(key, _shown(value))
    Console().print(table)
    typer.echo(f"open {folder_name / 'camera.png'}")


@app.command()
def simulate(
    scene: SceneOption = DEFAULT_SCENE,
    camera: CameraOption = DEFAULT_CAMERA,
    shots: ShotsOption = None,
    seed: SeedOption = 0,
    size: SizeOption = None,
    out: OutOption = Path("emmc-frames"),
) -> None:
    """Make frames of a light field through any camera, without a rig."""
    from emmc_rig.capture.simulate import simulate as run
    from emmc_rig.files.results import result_folder

    described = _camera(camera, shots)
    with result_folder(out) as folder:
        metrics = run(scene, camera, described, _size(size), seed, folder)
    typer.echo(
        f"{metrics['shots']} frame(s), sensor PSNR {metrics['sensor_psnr_db']:.2f} dB, light "
        f"efficiency {metrics['light_efficiency']:.1%}; in {out}"
    )


@app.command()
def reconstruct(
    frames: Annotated[
        Path | None,
        typer.Argument(help="a session of `capture`, or a folder that `demo` or `simulate` wrote"),
    ] = None,
    method: Annotated[str | None, typer.Option("--method", help="see --list (default: tv)")] = None,
    list_methods: Annotated[
        bool, typer.Option("--list", help="the methods: what each assumes, costs, is for")
    ] = False,
    psi: Annotated[
        Path | None,
        typer.Option("--psi", help="imaging matrix (default: psi.h5 beside the frames)"),
    ] = None,
    dictionary: DictionaryOption = None,
    settings: Annotated[
        Path | None, typer.Option("--settings", help="YAML of method settings: tv, sparse")
    ] = None,
    truth: Annotated[
        str | None, typer.Option("--truth", help="the scene that was captured, to compare with")
    ] = None,
    tile: Annotated[
        int | None, typer.Option("--tile", min=1, help="in tiles of so many samples: less memory")
    ] = None,
    budget: Annotated[
        str | None, typer.Option("--budget", help="choose the best method for a time, as 30s")
    ] = None,
    want: Annotated[
        str | None, typer.Option("--want", help="choose the quickest method for a PSNR, as 28dB")
    ] = None,
    chart_folder: Annotated[
        Path | None,
        typer.Option("--chart", help="of `emmc-rig chart`, to choose by (default: the shipped)"),
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="exit with 1 when the verdict is: do not use")
    ] = False,
    out: OutOption = Path("emmc-reconstruction"),
) -> None:
    """Reconstruct the light field of a folder of frames, by any method."""
    from emmc_rig.files.results import result_folder
    from emmc_rig.reconstruct import advice_for, load_settings, run_in_tiles, run_reconstruct
    from reconstruction.methods import COSTS, METHODS

    if list_methods:
        for known in METHODS.values():
            typer.echo(f"{known.name}: {known.title}")
            typer.echo(f"    assumes  {known.assumes}")
            typer.echo(f"    use it   {known.when}")
            typer.echo(f"    costs    {known.cost}")
        typer.echo(COSTS)
        return
    if frames is None:
        raise typer.BadParameter("name a folder of frames, or --list the methods")
    chosen, why = load_settings(settings), None
    if budget is not None or want is not None:
        if method is not None or settings is not None:
            raise typer.BadParameter("--budget and --want choose the method and its settings")
        advice = advice_for(frames, psi, budget, want, chart_folder)
        method, chosen, why = advice.method, advice.settings, advice.why
        console.print(why, highlight=False, soft_wrap=True)
    elif chart_folder is not None:
        raise typer.BadParameter("--chart serves --budget and --want")
    method = method or "tv"
    if tile is not None:
        if truth is not None:
            raise typer.BadParameter(
                "--truth needs the whole light field in memory, without --tile"
            )
        with result_folder(out) as folder, shown_bars() as bars:
            bars.begin(f"{method} in tiles", None)
            metrics = run_in_tiles(
                frames, folder, method, tile, psi, dictionary, chosen, lambda *_: bars.step("")
            )
        typer.echo(f"{method}: {metrics['tiles']} tiles in {metrics['seconds']:.1f} s")
        typer.echo(f"read {out / 'light_field.h5'}")
        _end_with_verdict(metrics["verdict"], strict)
        return
    with result_folder(out) as folder, shown_bars() as bars:
        bars.begin(method, None)
        metrics = run_reconstruct(
            frames, folder, method, psi, dictionary, chosen, truth,
            lambda step: bars.advance(step), why,
        )  # fmt: skip
    for line in metrics["screening"]:
        console.print(f"[yellow]screening:[/] {line}", highlight=False, soft_wrap=True)
    for line in metrics.get("left_out", ()):
        console.print(f"[cyan]not modelled:[/] {line}", highlight=False, soft_wrap=True)
    compared = ""
    if "psnr_db" in metrics:
        gain = metrics["psnr_db"] - metrics["replicate_psnr_db"]
        compared = (
            f"; {metrics['psnr_db']:.2f} dB, {gain:+.2f} dB against the copied centre view, "
            f"SSIM {metrics['ssim']:.3f}"
        )
    typer.echo(
        f"{metrics['method']}: {metrics['status']} in {metrics['seconds']:.1f} s{compared}"
        + (f" ({metrics['advice']})" if metrics["advice"] else "")
    )
    typer.echo(f"open {out / 'pictures'}")
    _end_with_verdict(metrics["verdict"], strict)


VERDICT_COLOURS = {"trust": "green", "doubt": "yellow", "do not use": "red"}


def _end_with_verdict(verdict: dict, strict: bool) -> None:
    """Print a verdict, a line for each reason; strict: exit with 1 if it is not to be used."""
    colour = VERDICT_COLOURS[verdict["level"]]
    if not verdict["reasons"]:
        typer.secho("trust: nothing in frames, Psi and light field speaks against it", fg=colour)
    for reason in verdict["reasons"]:
        what, remedy = reason["what"], reason["remedy"]
        typer.secho(f"{reason['level']}: {what}; {remedy}", fg=VERDICT_COLOURS[reason["level"]])
    if strict and verdict["level"] == "do not use":
        raise typer.Exit(1)


@app.command()
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
        bool, typer.Option("--ablation", help="instead: what each piece of `adaptive` buys")
    ] = False,
    next_shot: Annotated[
        bool, typer.Option("--next-shot", help="instead: how many shots a scene needs, which")
    ] = False,
    guard: Annotated[
        bool, typer.Option("--guard", help="instead: PSNR of the default method, against figures")
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
    if kernels or solvers or peers:
        named, place = (camera or ["rgbw-bayer-1shot"])[0], out or Path("emmc-kernels")
        if solvers:
            _chart_solvers(named, dictionary, place)
        elif peers:
            _chart_peers(named, size or TIMED_SIZE, repeats or TIMED_CALLS, place)
        else:
            _chart_kernels(named, size or TIMED_SIZE, repeats or TIMED_CALLS, place)
        return
    if guard:
        _chart_guard(scene or [], camera, _size(size), out or Path("emmc-guard"))
        return
    if ablation or next_shot:
        through, cut = (camera or ["rgbw-bayer-1shot"])[0], _size(size) or (128, 160)
        if ablation:
            seen = (scene or [DEFAULT_SCENE])[0]
            _chart_ablation(seen, through, cut, seed, out or Path("emmc-ablation"))
        else:
            from simulators.scenes import SCENES

            place, targets = out or Path("emmc-next-shot"), sorted(until or [30.0])
            _chart_next_shot(scene or list(SCENES), through, cut, targets, seed, place)
        return
    from emmc_rig.study.chart.command import chart_settings, run_chart, shown_charts
    from emmc_rig.study.chart.run import ChartStopped

    place = out or Path("emmc-chart")
    settings = chart_settings(
        fast, scene or [], camera or [], _size(size), repeats,
        methods=tuple(method or []), scaling=scaling, dictionary=dictionary, seed=seed,
    )  # fmt: skip
    try:
        with shown_bars() as bars:
            outcome = run_chart(settings, place, bars)
    except ChartStopped as stop:
        _fail(str(stop), INTERRUPTED)
    else:
        for one in shown_charts(outcome.charts):
            table = Table("the front", "s", "dB", title=one.title, box=SIMPLE)
            for mark in one.front():
                table.add_row(
                    mark.configuration.label, f"{mark.seconds:.3g}", f"{mark.psnr_db:.2f}"
                )
            Console().print(table)
        if outcome.growths:
            table = Table("growth", "against", "exponent", "expected", box=SIMPLE)
            for growth in outcome.growths:
                expected = "-" if growth.expected is None else f"{growth.expected:.2f}"
                table.add_row(growth.label, growth.axis, f"{growth.exponent:.2f}", expected)
            Console().print(table)
        for line in outcome.left_out:
            console.print(f"[yellow]left out:[/] {line}", highlight=False)
        typer.echo(f"{outcome.seconds:.0f} s; open {place / outcome.page.name}")


@app.command()
def train(
    out: Annotated[Path, typer.Option("--out", help="the dictionary to write, FILE.h5")],
    scenes: Annotated[
        list[str] | None,
        typer.Option(
            "--scenes",
            help="a folder of scenes, a scene, or a built-in name; may repeat "
            "(default: the built-in scenes)",
        ),
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option("--leave-out", help="a scene not to train on, by its name; may repeat"),
    ] = None,
    views: Annotated[
        str | None, typer.Option("--views", help="ROWSxCOLUMNS, the middle ones (default: all)")
    ] = None,
    kind: Annotated[str, typer.Option("--kind", help="ksvd, online or separable")] = "ksvd",
    atoms: Annotated[int, typer.Option("--atoms", help="number of atoms")] = 1024,
    patch: Annotated[str, typer.Option("--patch", help="ROWSxCOLUMNS of a patch")] = "9x9",
    patches: Annotated[int, typer.Option("--patches", help="patches to train on")] = 10_000,
    sparsity: Annotated[int, typer.Option("--sparsity", help="atoms per patch at most")] = 8,
    iterations: Annotated[int, typer.Option("--iterations", help="steps in all")] = 15,
    seed: SeedOption = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="go on where the same training stopped")
    ] = False,
) -> None:
    """Train a dictionary of light-field patches; Ctrl-C leaves a checkpoint for --resume."""
    from emmc_rig.commands.train import InterruptedTrainingError, picture_path, train_settings
    from emmc_rig.commands.train import train as run

    size, grid = _size(patch, "--patch", "9x9"), _size(views, "--views", "5x5")
    assert size is not None
    chosen = {
        "patches": {"rows": size[0], "columns": size[1], "count": patches, "seed": seed},
        "learning": {"atoms": atoms, "sparsity": sparsity, "iterations": iterations, "seed": seed},
    }
    settings = train_settings(out, scenes or (), leave_out or (), grid, kind, chosen, resume)
    try:
        with shown_bars() as bars:
            dictionary, told = run(settings, bars)
    except InterruptedTrainingError as stop:
        _fail(str(stop), INTERRUPTED)
    last = told["history"][-1]
    typer.echo(
        f"{dictionary.size} atoms from {patches} patches of {len(told['sources'])} scene(s): error "
        f"{last['updated_rmse'] or last['coded_rmse']:.5f} with {sparsity} atoms per patch; "
        f"{told['learning_seconds']:.1f} s, peak memory {told['peak_memory_gib']:.2f} GiB"
    )
    typer.echo(f"wrote {out}; its atoms: {picture_path(out)}")


@app.command()
def tables(
    scenes: Annotated[
        Path | None, typer.Option("--scenes", help="a folder of scenes (default: the built-in)")
    ] = None,
    only: Annotated[
        str | None, typer.Option("--only", help="table2,table3,table4,figure5,...,figure10")
    ] = None,
    fast: Annotated[
        bool, typer.Option("--fast", help="crops and small dictionaries: minutes, not days")
    ] = False,
    dictionary: Annotated[
        list[str] | None,
        typer.Option(
            "--dictionary",
            help="a file, lambertian or dct; again for r = 1/4 (default: train leave-one-out)",
        ),
    ] = None,
    seed: SeedOption = 0,
    out: OutOption = Path("emmc-tables"),
) -> None:
    """Reproduce the paper's tables and figures; run it again to go on where it stopped."""
    from emmc_rig.study.tables.command import run_tables
    from emmc_rig.study.tables.console import shown
    from emmc_rig.study.tables.run import FAST, TablesSettings, TablesStopped

    settings = (FAST if fast else TablesSettings()).model_copy(update={"seed": seed})
    try:
        with shown_bars() as bars:
            outcome = run_tables(scenes, out, only, dictionary or [], settings, bars)
    except TablesStopped as stop:
        _fail(str(stop), INTERRUPTED)
    else:
        for part in shown(outcome.grids, outcome.findings):
            Console().print(part)
        typer.echo(f"{outcome.seconds:.0f} s; open {out / outcome.page.name}")


@app.command()
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
    method: MethodsOption = None,
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
        typer.Option("--mismatch", help="beside it: a wrong Psi, mended with and without help"),
    ] = False,
    verdicts: Annotated[
        bool, typer.Option("--verdicts", help="instead: how well verdicts tell broken results")
    ] = False,
    faults: Annotated[bool, typer.Option("--list", help="the faults, and leave")] = False,
    dictionary: DictionaryOption = None,
    size: SizeOption = None,
    seed: SeedOption = 0,
    out: Annotated[Path, typer.Option("--out", help="folder to write")] = Path("emmc-stability"),
) -> None:
    """Find where methods fail: sweeps of faults; run it again to go on where it stopped."""
    from emmc_rig.study.stability.beside import measure_beside
    from emmc_rig.study.stability.command import run_stability
    from emmc_rig.study.stability.faults import FAULTS
    from emmc_rig.study.stability.plan import CAMERA, planned, stability_settings
    from emmc_rig.study.stability.rows import breaking_rows
    from emmc_rig.study.stability.run import StabilityStopped

    if faults:
        table = Table(
            Column("fault", no_wrap=True), "unit", "strengths", "what happens", box=SIMPLE
        )
        for one in FAULTS.values():
            table.add_row(
                one.name, one.unit, " ".join(f"{s:g}" for s in one.strengths), one.explained
            )
        Console().print(table)
        return
    if verdicts:
        _stability_verdicts(fast, scene, camera, fault, method, _size(size), seed, out)
        return
    settings = stability_settings(
        fast, scene or [], _size(size), camera=camera or CAMERA, faults=tuple(fault or []),
        methods=tuple(method or []), dictionary=dictionary, seed=seed,
        screening={None: "both", True: "on", False: "off"}[screening],
    )  # fmt: skip
    try:
        with shown_bars() as bars:
            planned(settings)  # raises for wrong names before anything is measured
            switches = {"theory": theory, "numerics": numerics, "mismatch": mismatch}
            wanted = [name for name, on in switches.items() if on]
            beside = measure_beside(settings, wanted, out, bars)
            outcome = run_stability(settings, out, bars, beside.sections, beside.metrics)
    except StabilityStopped as stop:
        _fail(str(stop), INTERRUPTED)
    rows, methods = breaking_rows(outcome.curves, outcome.curves[0].scene)
    table = Table(
        "fault", *methods, box=SIMPLE,
        title=f"{outcome.curves[0].scene}: 3 dB below its best / below the copied centre view",
    )  # fmt: skip
    for row in rows:
        table.add_row(f"{row.title}, {row.unit}", *row.cells)
    Console().print(table)
    for line in beside.told:
        typer.echo(line)
    for line in outcome.left_out:
        console.print(f"[yellow]left out:[/] {line}", highlight=False, soft_wrap=True)
    typer.echo(f"open {outcome.page}")


def _stability_verdicts(
    fast: bool,
    scenes: list[str] | None,
    camera: str | None,
    faults: list[str] | None,
    methods: list[str] | None,
    size: tuple[int, int] | None,
    seed: int,
    out: Path,
) -> None:
    from emmc_rig.study.stability.detector import (
        detector_settings,
        run_detector,
        tables,
        told,
        wrong,
    )

    settings = detector_settings(
        fast, scenes or [], camera, faults or [], methods or [], size, seed
    )
    try:
        with shown_bars() as bars:
            results = run_detector(settings, out, bars)
    except KeyboardInterrupt:
        _fail(f"stopped by Ctrl-C; what is judged is kept in {out}: run it again", INTERRUPTED)
    table = Table(
        "fault", "method", "broken: flagged", "good: flagged", "between", "poor", box=SIMPLE
    )
    for (name, method), tally in tables(results).items():
        table.add_row(
            name,
            method,
            f"{tally.broken_flagged} of {tally.broken}",
            f"{tally.good_flagged} of {tally.good}",
            f"{tally.between_flagged} of {tally.between}",
            f"{tally.poor_flagged} of {tally.poor}",
        )
    Console().print(table)
    for one in wrong(results):
        kind = "missed" if one.kind == "broken" else "false alarm"
        console.print(f"[yellow]{kind}:[/] {told(one)}", highlight=False, soft_wrap=True)
    typer.echo(f"open {out / 'verdicts.csv'}")


def _chart_ablation(scene: str, camera: str, size: tuple[int, int], seed: int, out: Path) -> None:
    from emmc_rig.files.cameras import find_camera
    from emmc_rig.files.results import command_line, result_folder, versions, write_metrics
    from emmc_rig.study.ablation import ablations

    table = Table("adaptive", "dB", "s", "buys dB", "costs s")
    rows = []
    with result_folder(out) as folder:
        for row in ablations(scene, camera, find_camera(camera), size, seed, folder):
            rows.append(row.as_dict())
            table.add_row(
                row.name,
                f"{row.psnr_db:.2f}",
                f"{row.seconds:.1f}",
                f"{row.buys_db:+.2f}",
                f"{row.costs_s:+.1f}",
            )
        metrics = {"scene": scene, "camera": camera, "size": list(size), "rows": rows}
        write_metrics(folder, {**metrics, "command": command_line(), "versions": versions()})
    Console().print(table)


def _chart_guard(
    scenes: list[str], camera: list[str] | None, size: tuple[int, int] | None, out: Path
) -> None:
    from emmc_rig.files.results import command_line, result_folder, versions, write_metrics
    from emmc_rig.model.files import write_text
    from emmc_rig.study import guard

    stored = guard.stored_figures()
    chosen = guard.cases(scenes, size, (camera or [guard.CAMERA])[0])
    table, rows = Table("case", "dB", "stored dB", ""), []
    with result_folder(out) as folder:
        for row in guard.guarded(chosen, stored):
            rows.append(row)
            was = "-" if row.stored_db is None else f"{row.stored_db:.2f}"
            word = "fell" if row.fell else "none stored" if row.stored_db is None else ""
            table.add_row(row.case.key, f"{row.psnr_db:.2f}", was, word)
        figures = {row.case.key: row.psnr_db for row in rows}
        write_text(folder / guard.STORED, guard.merged_text(rows, stored))
        metrics = {"psnr_db": figures, "fell": [row.case.key for row in rows if row.fell]}
        write_metrics(folder, {**metrics, "command": command_line(), "versions": versions()})
    Console().print(table)
    fallen = [row.case.key for row in rows if row.fell]
    if fallen:
        typer.echo(
            f"{len(fallen)} figure(s) fell by more than {guard.MOST_FALL_DB} dB: "
            f"{'; '.join(fallen)}: mend the method, or store {out / guard.STORED} if it is meant",
            err=True,
        )
        raise typer.Exit(1)


def _chart_next_shot(
    scenes: list[str], camera: str, size: tuple[int, int], until: list[float], seed: int, out: Path
) -> None:
    from emmc_rig.files.cameras import find_camera
    from emmc_rig.files.results import command_line, versions, write_metrics
    from emmc_rig.study.next_shot import ROWS, next_shots, savings, total_savings
    from emmc_rig.study.points import open_folder

    described = find_camera(camera)
    folder = open_folder(out, ROWS, "shots of `emmc-rig chart --next-shot`")
    with shown_bars() as bars:
        bars.begin("capture and judge", None)
        found = list(next_shots(scenes, camera, described, size, seed, folder, bars.step))
    names = ("scene", "wanted, dB", "shots", "stated, dB", "in truth, dB", "fixed number")
    table = Table(*names, box=SIMPLE)
    rows = [one for scene in found for one in savings(scene, until)]
    for one in rows:
        table.add_row(
            one.scene,
            f"{one.target_db:g}",
            f"{one.stopped.count}" if one.reached else f"{one.stopped.count}, short",
            f"{one.stopped.stated_db:.2f}",
            f"{one.stopped.psnr_db:.2f}",
            "-" if one.fixed is None else str(one.fixed),
        )
    Console().print(table)
    for line in total_savings(rows):
        typer.echo(line)
    metrics = {
        "camera": camera,
        "size": list(size),
        "seed": seed,
        "rows": [row.as_dict() for row in rows],
        "scenes": [asdict(scene) for scene in found],
        "command": command_line(),
        "versions": versions(),
    }
    write_metrics(folder, metrics)


def _chart_kernels(camera: str, size: str | None, repeats: int, out: Path) -> None:
    from emmc_rig.files.cameras import find_camera
    from emmc_rig.files.results import command_line, result_folder, versions, write_metrics
    from emmc_rig.study.benchmarks.kernels import kernel_timings, reconstruction_memory

    described, shape = find_camera(camera), _size(size)
    assert shape is not None
    table = Table("kernel", "GB counted", "ms", "GB/s", "times its bound")
    rows = []
    with result_folder(out) as folder:
        seconds, peak_gib = reconstruction_memory(camera, shape)
        for timing in kernel_timings(described, shape, repeats):
            rows.append(timing.as_dict())
            table.add_row(
                timing.name,
                f"{timing.gigabytes:.3f}",
                f"{timing.seconds * 1e3:.1f}",
                f"{timing.gigabytes / timing.seconds:.1f}",
                f"{timing.ratio:.2f}",
            )
        metrics = {
            "camera": camera,
            "size": list(shape),
            "kernels": rows,
            "reconstruction_seconds": seconds,
            "reconstruction_peak_gib": peak_gib,
            "command": command_line(),
            "versions": versions(),
        }
        write_metrics(folder, metrics)
    Console().print(table)
    typer.echo(f"one TV reconstruction: {seconds:.1f} s, peak memory {peak_gib:.2f} GiB")


def _chart_peers(camera: str, size: str | None, repeats: int, out: Path) -> None:
    from emmc_rig.files.cameras import find_camera
    from emmc_rig.files.results import command_line, result_folder, versions, write_metrics
    from emmc_rig.study.benchmarks.variational import variational_timings

    described, shape = find_camera(camera), _size(size)
    assert shape is not None
    table = Table("primal-dual step", "ms", "times ours")
    rows = []
    with result_folder(out) as folder:
        for timing in variational_timings(described, shape, repeats):
            rows.append(timing.as_dict())
            table.add_row(timing.name, f"{timing.seconds * 1e3:.1f}", f"{timing.times_ours:.1f}")
        metrics = {"camera": camera, "size": list(shape), "steps": rows}
        write_metrics(folder, {**metrics, "command": command_line(), "versions": versions()})
    Console().print(table)


def _chart_solvers(camera: str, dictionary: str | None, out: Path) -> None:
    from emmc_rig.files.cameras import find_camera
    from emmc_rig.files.results import command_line, result_folder, versions, write_metrics
    from emmc_rig.reconstruct import open_dictionary
    from emmc_rig.study.benchmarks.sparse import TIMED_SIZE, peer_timings, solver_timings

    described = find_camera(camera)
    atoms = open_dictionary(dictionary, described.views, described.sensor.binning)
    table = Table("solver", "ms/patch", "passes", "GFLOP/s", "times its bound", "gap", "dB")
    rows, peers = [], []
    with result_folder(out) as folder:
        for timing in solver_timings(described, TIMED_SIZE, atoms):
            rows.append(timing.as_dict())
            table.add_row(
                timing.name,
                f"{timing.milliseconds:.2f}",
                f"{timing.passes:.0f}",
                f"{timing.gigaflops:.1f}",
                f"{timing.ratio:.1f}",
                f"{timing.gap:.1e}",
                f"{timing.psnr_db:.2f}",
            )
        Console().print(table)
        try:
            peers = [timing.as_dict() for timing in peer_timings(described, TIMED_SIZE, atoms)]
        except AppError as missing:
            console.print(f"[yellow]not compared:[/] {missing}", highlight=False)
        metrics = {
            "camera": camera,
            "dictionary": atoms.kind,
            "atoms": atoms.size,
            "solvers": rows,
            "peers": peers,
            "command": command_line(),
            "versions": versions(),
        }
        write_metrics(folder, metrics)
    for peer in peers:
        typer.echo(
            f"{peer['name']}: ours {peer['ours_ms']:.2f} ms a patch, scikit-learn's "
            f"{peer['theirs_ms']:.2f} ms: {peer['ratio']:.1f} times faster"
        )


def main() -> None:
    """Run the program; never shows a traceback for a fault that the user can mend."""
    try:
        code = app(standalone_mode=False) or 0
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        sys.exit(code)
    except KeyboardInterrupt:
        _fail("stopped by Ctrl-C; nothing was written", INTERRUPTED)
    except CaptureStoppedError as stop:
        _fail(str(stop), INTERRUPTED)
    except ERRORS as fault:
        _fail(str(fault), 1)
    except MemoryError:
        _fail("not enough memory: use a smaller --size or fewer shots", 1)
    except Exception as fault:
        show, code = getattr(fault, "show", None), getattr(fault, "exit_code", None)
        if type(fault).__name__ == "Abort":
            _fail("stopped by Ctrl-C; nothing was written", INTERRUPTED)
        if show is None or code is None:
            raise
        show()
        sys.exit(code)


def _fail(message: str, code: int) -> NoReturn:
    console.print(f"[bold red]emmc-rig:[/] {message}", highlight=False, soft_wrap=True)
    sys.exit(code)
