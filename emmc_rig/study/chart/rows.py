"""Every measured point as one row of the tidy CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping

from emmc_rig.study.chart.plan import Point

COLUMNS = (
    "scene", "camera", "method", "level", "settings", "psnr_db", "ssim", "angular_db",
    "replicate_psnr_db", "disparity_mae_px", "floor_mae_px", "bad_share", "own_disparity_mae_px",
    "seconds", "fastest_s", "slowest_s", "cpu_seconds", "repeats", "reference_s",
    "reference_cpu_s", "dictionary_s", "peak_mib", "base_mib", "cores", "load", "shots", "views",
    "rows", "columns", "disparity_range_px", "steps", "status", "advice", "failed",
)  # fmt: skip
"""Of chart.csv. An empty field is infinite, not known or not applicable."""


def csv_text(results: Mapping[Point, dict]) -> str:
    """Return chart.csv: one row per point, in the order they were measured."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", restval="", extrasaction="ignore")
    writer.writeheader()
    for point, result in results.items():
        one = point.configuration
        row = {
            **result,
            "scene": point.capture.scene_name,
            "camera": point.capture.camera_name,
            "method": one.method,
            "level": one.level,
            "settings": one.settings.model_dump_json(exclude_defaults=True),
        }
        if "failed" not in result:
            row["views"] = "x".join(map(str, result["views"]))
            row["rows"], row["columns"] = result["size"]
        writer.writerow({key: _written(value) for key, value in row.items()})
    return text.getvalue()


def _written(value: object) -> object:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else value
