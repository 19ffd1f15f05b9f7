"""`emmc-rig chart --live`: the live page under load, and how soon a light field follows a frame."""

from __future__ import annotations

from pathlib import Path

import typer


def chart_live(camera: str, scene: str, size: tuple[int, int] | None, out: Path) -> None:
    """Time stopping among a hundred pages, pictures of 24 MP, and the live light field."""
    import os

    import emmc_rig as emmc
    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import command_line, versions, write_metrics
    from emmc_rig.study.benchmarks.live import SIZES, field_timing, shown_timing, stop_timing

    described = emmc.camera(camera)
    with result_folder(out, "chart --live") as folder:
        stop = stop_timing()
        typer.echo(
            f"stop among {stop.clients} pages: {stop.median_ms:.0f} ms, "
            f"at most {stop.worst_ms:.0f} ms"
        )
        shown = shown_timing()
        typer.echo(
            f"{shown.megapixels:.0f} MP: {shown.frames_per_s:.1f} frames/s to a page, "
            f"{shown.kilobytes:.0f} kB each, {shown.cpu_s_per_frame:.2f} s of computing"
        )
        fields = []
        for one in (size,) if size else SIZES:
            fields.append(field_timing(described, one, scene))
            field = fields[-1]
            typer.echo(
                f"light field of {one[0]}x{one[1]}: {field.frame_s:.2f} s after its frame "
                f"({field.frames_per_s:.1f}/s, {field.cpu_s:.2f} s of computing, the first "
                f"{field.first_s:.2f} s), {field.psnr_db:.1f} dB, the copied centre view "
                f"{field.copied_db:.1f} dB"
            )
        write_metrics(
            folder,
            {
                "camera": camera,
                "scene": scene,
                "stop": stop.as_dict(),
                "shown": shown.as_dict(),
                "light_fields": [field.as_dict() for field in fields],
                "load": os.getloadavg()[0],
                "cores": os.cpu_count(),
                "command": command_line(),
                "versions": versions(),
            },
        )
