"""Options that several commands share, as typer reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

DEFAULT_SCENE = "deep-occlusions"
DEFAULT_CAMERA = "rgbw-bayer-3shots"
SIZE_VARIABLE = "EMMC_SIZE"
"""Environment variable: the --size where none is given, so that everything can be tried small."""

SceneOption = Annotated[
    str,
    typer.Option(
        "--scene",
        help="a folder of view_ROW_COL.png or an HDF5 file (NAME@by-parallax: its views in the "
        "order that parallax shows), or a built-in name",
    ),
]
CameraOption = Annotated[
    str, typer.Option("--camera", help="a shipped camera (see `emmc-rig cameras`) or a YAML file")
]
ShotsOption = Annotated[
    int | None, typer.Option("--shots", min=1, help="number of shots (default: the camera's own)")
]
SizeOption = Annotated[
    str | None,
    typer.Option(
        "--size", envvar=SIZE_VARIABLE, help="ROWSxCOLUMNS: the middle of a scene, or its size"
    ),
]
ExportSizeOption = Annotated[
    str | None,
    typer.Option(
        "--size", envvar=SIZE_VARIABLE, help="ROWSxCOLUMNS of a scene; a result keeps its own"
    ),
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="seed of scene and noise")]
OutOption = Annotated[Path, typer.Option("--out", help="folder to write")]
ClusterOption = Annotated[
    str | None,
    typer.Option("--cluster", help="tcp://HOST:PORT of a Dask scheduler, in place of --workers"),
]
DictionaryOption = Annotated[
    str | None,
    typer.Option("--dictionary", help="a dictionary's file, or: lambertian, dct"),
]
ScenesOption = Annotated[
    list[str] | None,
    typer.Option("--scene", help="a folder of views, an HDF5 file or a built-in name; may repeat"),
]
MethodsOption = Annotated[
    list[str] | None, typer.Option("--method", help="only this one; may repeat")
]
RigOption = Annotated[
    str | None, typer.Option("--rig", help="simulated, or a YAML file of real devices")
]
RigSceneOption = Annotated[
    str, typer.Option("--scene", help="what the simulated rig looks at, see `demo`")
]
RigSizeOption = Annotated[
    str | None,
    typer.Option("--size", envvar=SIZE_VARIABLE, help="ROWSxCOLUMNS of the simulated light field"),
]


def check_workers(workers: int | None, cluster: str | None) -> None:
    """Raise BadParameter where both are given."""
    if workers is not None and cluster is not None:
        raise typer.BadParameter("--workers are of this machine, --cluster has its own: give one")
