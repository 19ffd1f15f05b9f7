"""PSNR of the default method on fixed captures, against stored figures: CI fails where it falls.

Frames are Psi of the scene plus white noise of a known deviation: an inverse crime, the same in
every version. Built-in scenes are always there; real light fields are measured where
EMMC_LIGHTFIELDS names their folder, in the groups A, which settings may be tuned on, and B, which
they may not. A figure is stored for a scene, camera, size and noise; without one there is nothing
to fall below, and the row says so.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from emmc_rig.model.files import write_text
from emmc_rig.model.json_text import parse_json
from emmc_rig.study.benchmarks.running import CFA, Asked, Show
from emmc_rig.study.trial import Capture, trial_of
from reconstruction.methods import DEFAULT_METHOD

MOST_FALL_DB = 0.3
"""Below its stored figure, which fails."""
STORED = "guard.json"
CAMERA = CFA
NOISES = (0.0005, 0.004)
"""Deviations of readings: next to none, and that of a short exposure."""
BUILT_IN, BUILT_IN_SIZE = ("near-planar", "deep-occlusions", "wide-disparity"), (64, 80)
GROUPS = {
    "A": ("dragons", "dice", "fish", "buttercup", "occlusions", "begonia", "antinous"),
    "B": ("messerschmitt", "bikes", "isochart", "general11", "lytro1", "lytro2"),
}
REAL_SIZE = (96, 96)


def key(case: Capture) -> str:
    """Return the name of a capture's stored figure."""
    assert case.size is not None
    rows, columns = case.size
    return f"{Path(case.scene).name} {rows}x{columns} {case.camera} {case.noise:g}"


@dataclass(frozen=True)
class Row:
    """A case measured: its PSNR and the one stored, None where there is none."""

    case: Capture
    psnr_db: float
    stored_db: float | None

    @property
    def fell(self) -> bool:
        """Whether the figure is more than MOST_FALL_DB below the stored one."""
        return self.stored_db is not None and self.psnr_db < self.stored_db - MOST_FALL_DB


def cases(
    scenes: Sequence[str] = (), size: tuple[int, int] | None = None, camera: str = CAMERA
) -> list[Capture]:
    """Return the cases of some scenes; by default the built-in ones, and the real ones there are.

    size: rows and columns of all; by default BUILT_IN_SIZE of built-in and REAL_SIZE of real ones.
    """
    folder = Path(os.environ.get("EMMC_LIGHTFIELDS", ""))
    there = [folder / name for group in GROUPS.values() for name in group]
    real = [str(scene) for scene in there if os.environ.get("EMMC_LIGHTFIELDS") and scene.is_dir()]
    chosen = scenes or (*BUILT_IN, *real)
    return [
        Capture(
            scene, camera, size or (BUILT_IN_SIZE if scene in BUILT_IN else REAL_SIZE), noise=noise
        )
        for scene in chosen
        for noise in NOISES
    ]


def measured_db(case: Capture) -> float:
    """Return the PSNR of the default method; raises what scene, camera and method do."""
    given = trial_of(case)
    return given.psnr_db(given.solved(DEFAULT_METHOD).light_field)


def stored_figures() -> dict[str, float]:
    """Return the stored PSNR of every case, by its key."""
    data = resources.files("emmc_rig.study").joinpath(STORED).read_bytes()
    return parse_json(data, STORED, ValueError)


def guarded(chosen: Iterable[Capture], stored: Mapping[str, float]) -> Iterator[Row]:
    """Yield every case measured, beside its stored figure."""
    for case in chosen:
        yield Row(case, measured_db(case), stored.get(key(case)))


def merged_text(rows: Iterable[Row], stored: Mapping[str, float]) -> str:
    """Return the text of a file of figures: those stored, with those measured in their place."""
    new = {key(row.case): round(row.psnr_db, 2) for row in rows}
    return json.dumps({**stored, **new}, indent=2, sort_keys=True) + "\n"


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Measure fixed captures beside their stored figures (`chart --guard`); write the new ones."""
    stored, rows, shown = stored_figures(), [], []
    for row in guarded(cases(asked.scenes, asked.size, asked.camera), stored):
        rows.append(row)
        was = "-" if row.stored_db is None else f"{row.stored_db:.2f}"
        word = "fell" if row.fell else "none stored" if row.stored_db is None else ""
        shown.append((key(row.case), f"{row.psnr_db:.2f}", was, word))
    show.table(("case", "dB", "stored dB", ""), shown)
    write_text(folder / STORED, merged_text(rows, stored))
    fell = [key(row.case) for row in rows if row.fell]
    return {"psnr_db": {key(row.case): row.psnr_db for row in rows}, "fell": fell}
