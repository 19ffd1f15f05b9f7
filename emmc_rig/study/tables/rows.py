"""Every cell as one row of the tidy CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping

from emmc_rig.study.tables.plan import Cell, cells_of
from emmc_rig.study.tables.run import Run
from reconstruction.methods import METHODS

COLUMNS = (
    "tables", "scene", "scenario", "shots", "r", "mask", "noise", "demosaiced_first", "method",
    "psnr_db", "paper_psnr_db", "ssim", "replicate_psnr_db", "luma_psnr_db", "chroma_psnr_db",
    "chroma_share", "sensor_psnr_db", "noise_sigma", "rows", "columns", "seconds", "steps",
    "status", "advice", "dictionary", "settings",
)  # fmt: skip
"""Of tables.csv. PSNRs have peak 1; an empty field is infinite, not printed or not applicable."""
_DIGITS = {"seconds": 3, "noise_sigma": 6, "ssim": 5, "chroma_share": 4}


def csv_text(run: Run, results: Mapping[Cell, dict]) -> str:
    """Return tables.csv: one row per cell, in the order of the tables."""
    parts: dict[Cell, list[str]] = {}
    for part in run.parts:
        for cell in cells_of(part, run.library.names):
            parts.setdefault(cell, []).append(part.name)
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", restval="", extrasaction="ignore")
    writer.writeheader()
    for cell, names in parts.items():
        if cell in results:
            row = {**results[cell], **_described(run, cell), "tables": " ".join(names)}
            writer.writerow({key: _written(key, value) for key, value in row.items()})
    return text.getvalue()


def _described(run: Run, cell: Cell) -> dict[str, object]:
    capture, method = cell.capture, METHODS[cell.method]
    size = run.truth(cell).shape[2:4]
    settings = run.settings.of(cell.method, capture)
    changed = settings.model_dump_json(exclude_defaults=True)
    named = run.source.label(cell.scene, capture.binning) if method.needs_dictionary else ""
    return {
        "scene": cell.scene,
        "scenario": capture.scenario,
        "shots": capture.shots,
        "r": f"1/{capture.binning**2}" if capture.binning > 1 else "1",
        "mask": capture.mask,
        "noise": "yes" if capture.noisy else "no",
        "demosaiced_first": "yes" if capture.demosaiced else "no",
        "method": cell.method,
        "paper_psnr_db": cell.paper_psnr_db,
        "rows": size[0],
        "columns": size[1],
        "dictionary": named,
        "settings": changed,
    }


def _written(key: str, value: object) -> object:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.{_DIGITS.get(key, 4)}f}"
    return value
