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

import numpy as np
from numpy.typing import NDArray

from emmc_rig.files.cameras import find_camera
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.methods import DEFAULT_METHOD, reconstruct

MOST_FALL_DB = 0.3
"""Below its stored figure, which fails."""
STORED = "guard.json"
CAMERA = "scenario-ii-cfa"
NOISES = (0.0005, 0.004)
"""Deviations of readings: next to none, and that of a short exposure."""
BUILT_IN, BUILT_IN_SIZE = ("near-planar", "deep-occlusions", "wide-disparity"), (64, 80)
GROUPS = {
    "A": ("dragons", "dice", "fish", "buttercup", "occlusions", "begonia", "antinous"),
    "B": ("messerschmitt", "bikes", "isochart", "general11", "lytro1", "lytro2"),
}
REAL_SIZE = (96, 96)
SEED = 0


@dataclass(frozen=True)
class Case:
    """A scene, by what `open_scene` takes, its middle of `size` pixels, a shipped camera, and the
    standard deviation of the readings' noise."""

    scene: str
    size: tuple[int, int]
    camera: str = CAMERA
    noise: float = NOISES[0]

    @property
    def key(self) -> str:
        """The name of its stored figure."""
        rows, columns = self.size
        return f"{Path(self.scene).name} {rows}x{columns} {self.camera} {self.noise:g}"


@dataclass(frozen=True)
class Row:
    """A case measured: its PSNR and the one stored, None where there is none."""

    case: Case
    psnr_db: float
    stored_db: float | None

    @property
    def fell(self) -> bool:
        """Whether the figure is more than MOST_FALL_DB below the stored one."""
        return self.stored_db is not None and self.psnr_db < self.stored_db - MOST_FALL_DB


def cases(
    scenes: Sequence[str] = (), size: tuple[int, int] | None = None, camera: str = CAMERA
) -> list[Case]:
    """Return the cases of some scenes; by default the built-in ones, and the real ones there are.

    size: rows and columns of all; by default BUILT_IN_SIZE of built-in and REAL_SIZE of real ones.
    """
    folder = Path(os.environ.get("EMMC_LIGHTFIELDS", ""))
    there = [folder / name for group in GROUPS.values() for name in group]
    real = [str(scene) for scene in there if os.environ.get("EMMC_LIGHTFIELDS") and scene.is_dir()]
    chosen = scenes or (*BUILT_IN, *real)
    return [
        Case(scene, size or (BUILT_IN_SIZE if scene in BUILT_IN else REAL_SIZE), camera, noise)
        for scene in chosen
        for noise in NOISES
    ]


def captured(case: Case) -> tuple[ImagingMatrix, NDArray[np.float32], NDArray]:
    """Return Psi, the frames (shot, pixel_y, pixel_x) and the true light field of a case."""
    camera = find_camera(case.camera)
    truth = open_scene(case.scene, size=case.size, views=camera.views, seed=SEED).light_field
    psi = build_imaging_matrix(camera, case.size)
    frames = psi.forward(truth.astype(np.float32))
    noise = np.random.default_rng(SEED).normal(0, case.noise, frames.shape)
    return psi, (frames + noise).astype(np.float32), truth


def measured_db(case: Case) -> float:
    """Return the PSNR of the default method; raises what scene, camera and method do."""
    psi, frames, truth = captured(case)
    return psnr_db(reconstruct(DEFAULT_METHOD, psi, frames, case.noise).light_field, truth)


def stored_figures() -> dict[str, float]:
    """Return the stored PSNR of every case, by its key."""
    return json.loads(resources.files("emmc_rig.study").joinpath(STORED).read_text())


def guarded(chosen: Iterable[Case], stored: Mapping[str, float]) -> Iterator[Row]:
    """Yield every case measured, beside its stored figure."""
    for case in chosen:
        yield Row(case, measured_db(case), stored.get(case.key))


def merged_text(rows: Iterable[Row], stored: Mapping[str, float]) -> str:
    """Return the text of a file of figures: those stored, with those measured in their place."""
    new = {row.case.key: round(row.psnr_db, 2) for row in rows}
    return json.dumps({**stored, **new}, indent=2, sort_keys=True) + "\n"
