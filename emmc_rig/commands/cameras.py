"""The command `emmc-rig cameras`: the cameras known, and a drawing of one."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import out_option
from emmc_rig.commands.output import give_result, say, show_table, shown_progress, tell


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def cameras(
    name: Annotated[
        str | None, typer.Argument(help="a shipped camera or a YAML file (default: list all)")
    ] = None,
    out: Annotated[Path | None, out_option("camera-NAME")] = None,
) -> None:
    """List the shipped cameras, or draw the masks of one and write its description to edit."""
    if name is None:
        from emmc_rig.report.camera_list import camera_rows

        shown = camera_rows()
        show_table(
            ("camera", "sensor", "shots", "masks", "sampling", "light"),
            [
                (f"[bold]{row.name}[/]\n{row.title}", row.sensor, str(row.shots), str(row.masks),
                 row.sampling_rate, f"{row.light_percent:.0f} %")
                for row in shown
            ],
        )  # fmt: skip
        give_result(cameras=[asdict(row) for row in shown])
        return
    import emmc_rig as emmc
    from emmc_rig.model.camera import shipped_camera_files
    from emmc_rig.report.camera_sheet import camera_figures, draw_camera
    from emmc_rig.store.folders import result_folder
    from emmc_rig.store.results import write_metrics

    camera = emmc.camera(name)
    folder_name = out or Path(f"camera-{Path(name).stem}")
    with result_folder(folder_name, "cameras") as folder, shown_progress("draw"):
        figures = camera_figures(camera)
        draw_camera(camera, folder / "camera.png")
        write_metrics(folder, figures)
        if shipped := shipped_camera_files().get(name):
            shutil.copyfile(shipped, folder / "camera.yaml")
    rows = []
    for key, value in figures.items():
        if isinstance(value, dict):
            for mask, measured in value.items():
                for what, figure in measured.items():
                    rows.append((f"{mask}: {what}", _shown(figure)))
        else:
            rows.append((key, _shown(value)))
    show_table(("figure", "value"), rows, camera.title)
    for warning in camera.warnings():
        say("warning", warning)
    tell(f"open {folder_name / 'camera.png'}")
    if shipped:
        tell(f"for a camera of your own, edit a copy of {folder_name / 'camera.yaml'}")
    give_result(folder_name)
