"""The rows of advice that a chart's measured points give: accuracy and cost by configuration."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from emmc_rig.advice.recommend import Row
from emmc_rig.study.chart.plan import Configuration, Point


def advice_rows(results: Mapping[Point, dict]) -> list[Row]:
    """Return the rows of a chart's points: ours only, and those measured in every scene."""
    groups: dict[tuple[str, Configuration], list[dict]] = {}
    scenes: dict[str, set[str]] = {}
    for point, result in results.items():
        if "failed" in result or point.configuration.is_peer:
            continue
        camera = point.capture.camera_name
        scenes.setdefault(camera, set()).add(point.capture.scene)
        groups.setdefault((camera, point.configuration), []).append(result)
    found = []
    for (camera, one), some in groups.items():
        if len(some) < len(scenes[camera]):
            continue
        works = np.mean([_fixed_and_growing(result) for result in some], axis=0)
        found.append(
            Row(
                camera,
                some[0]["shots"],
                some[0]["colours_stored"] == 1,
                one.method,
                one.level,
                one.settings.model_dump(mode="json", exclude_defaults=True),
                float(np.mean([r["psnr_db"] for r in some])),
                float(np.mean([r["psnr_db"] - r["replicate_psnr_db"] for r in some])),
                float(np.mean([r["dictionary_s"] / r["reference_s"] for r in some])),
                float(works[0]),
                float(works[1]),
            )
        )
    return found


def _fixed_and_growing(result: Mapping) -> tuple[float, float]:
    """Return the line through the window's and the whole picture's work: at 0, per million."""
    values = float(np.prod(result["views"]) * np.prod(result["size"]) * 3)
    whole, part = (
        result[key] / result["reference_cpu_s"] for key in ("cpu_seconds", "window_cpu_s")
    )
    wider = values - result["window_values"]
    growing = max(whole - part, 0.0) / wider if wider > 0 else whole / values
    fixed = max(whole - growing * values, 0.0)
    return fixed, (whole - fixed) / values * 1e6
