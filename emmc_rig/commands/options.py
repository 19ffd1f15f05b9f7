"""Options that several commands share, as typer reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

DEFAULT_SCENE = "deep-occlusions"
DEFAULT_CAMERA = "rgbw-bayer-3shots"
SIZE_VARIABLE = "EMMC_SIZE"
"""Environment variable: the --size where none is given, so that everything can be tried small."""
NAME_OR_PATH = "NAME|PATH"
SIMULATED_PANEL, PARALLEL_PANEL = "Simulated rig", "Large light fields"
"""Panels of the help for options that few commands' users need."""

SceneOption = Annotated[
    str,
    typer.Option(
        "--scene",
        metavar=NAME_OR_PATH,
        help="a folder of view_ROW_COL.png, an HDF5 file, or a built-in scene's name",
    ),
]
CameraOption = Annotated[
    str,
    typer.Option(
        "--camera",
        metavar=NAME_OR_PATH,
        help="a name that `emmc-rig cameras` lists, or a YAML file",
    ),
]
ShotsOption = Annotated[
    int | None, typer.Option("--shots", min=1, help="number of shots (default: the camera's own)")
]
ExportSizeOption = Annotated[
    str | None,
    typer.Option(
        "--size",
        envvar=SIZE_VARIABLE,
        help="ROWSxCOLUMNS, pixels, of a scene only (default: the whole)",
    ),
]
SeedOption = Annotated[
    int, typer.Option("--seed", min=0, help="seed of the random scene and noise")
]
OutOption = Annotated[Path, typer.Option("--out", help="folder to write")]


def out_option(default: str) -> Any:
    """Return the option --out of a command whose default folder depends on its arguments."""
    return typer.Option("--out", help=f"folder to write (default: {default})")


def size_option(default: str) -> Any:
    """Return the option --size of a command that reads scenes."""
    return typer.Option(
        "--size",
        envvar=SIZE_VARIABLE,
        help="ROWSxCOLUMNS, pixels: the middle of a scene; a built-in scene is drawn in that size "
        f"(default: {default})",
    )


TruthOption = Annotated[
    str | None,
    typer.Option(
        "--truth", metavar=NAME_OR_PATH, help="the scene that was captured, to compare with"
    ),
]
MethodOption = Annotated[
    str | None, typer.Option("--method", help="see `reconstruct --list` (default: adaptive)")
]
FastOption = Annotated[
    bool,
    typer.Option("--fast", help="small crops, few points: minutes instead of hours or days"),
]
ZarrOption = Annotated[
    bool,
    typer.Option(
        "--zarr", help="write Zarr, for large light fields", rich_help_panel=PARALLEL_PANEL
    ),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=1,
        help="processes that share the work (default: this one; of several captures one a core)",
        rich_help_panel=PARALLEL_PANEL,
    ),
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        help="tcp://HOST:PORT of a Dask scheduler, instead of --workers",
        rich_help_panel=PARALLEL_PANEL,
    ),
]
DictionaryOption = Annotated[
    str | None,
    typer.Option(
        "--dictionary",
        metavar=NAME_OR_PATH,
        help="for methods that need a dictionary: lambertian, or a file",
    ),
]
ScenesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--scene",
        metavar=NAME_OR_PATH,
        help="a folder of views, an HDF5 file or a built-in scene's name; may repeat (default: "
        "built-in scenes)",
    ),
]
MethodsOption = Annotated[
    list[str] | None, typer.Option("--method", help="only this method; may repeat (default: all)")
]
HostOption = Annotated[
    str, typer.Option("--host", help="address to serve the page at; 0.0.0.0: for a phone, too")
]
StageOption = Annotated[
    str | None,
    typer.Option(
        "--stage",
        help="zaber:PORT, grbl:PORT, apt:PORT, PLUG-IN:ADDRESS, or the YAML file of a stage or rig",
    ),
]
RigOption = Annotated[
    str | None,
    typer.Option("--rig", metavar=NAME_OR_PATH, help="simulated, or a YAML file of real devices"),
]
RigSceneOption = Annotated[
    str,
    typer.Option(
        "--scene",
        metavar=NAME_OR_PATH,
        help="the scene before its camera, as in `demo`",
        rich_help_panel=SIMULATED_PANEL,
    ),
]
RigSizeOption = Annotated[
    str | None,
    typer.Option(
        "--size",
        envvar=SIZE_VARIABLE,
        help="ROWSxCOLUMNS of the light field (default: the whole scene)",
        rich_help_panel=SIMULATED_PANEL,
    ),
]


def check_workers(workers: int | None, cluster: str | None) -> None:
    """Raise BadParameter where both are given."""
    if workers is not None and cluster is not None:
        raise typer.BadParameter("--workers and --cluster exclude each other: give one")
