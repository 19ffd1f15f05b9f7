"""The cells of the tables, reconstructed one by one."""

from __future__ import annotations

import time
from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass

from pydantic import Field

from emmc_rig.model.settings import Settings
from emmc_rig.progress import Watcher
from emmc_rig.study.points import Results, Study
from emmc_rig.study.rows import dictionary_identity, digest_of
from emmc_rig.study.scores import colour_scored
from emmc_rig.study.tables.cells import Capture, Cell, Part, cells_of
from emmc_rig.study.tables.shots import Shots, shots_of
from emmc_rig.study.tables.table_scenes import VIEWS, Array, Scenes, Size, check_dictionary
from emmc_rig.study.trial import open_dictionary_once
from reconstruction.bpdn import BPDNSettings
from reconstruction.dictionary import Dictionary
from reconstruction.inputs import checked_inputs
from reconstruction.methods import METHODS, MethodSettings, reconstruct
from reconstruction.sparse import PatchEstimates, SparseSettings, estimate_patches
from reconstruction.tv import TVSettings

PAPERS_SOLVER = BPDNSettings(method="admm")


class TablesSettings(Settings):
    """How everything is computed; sizes are middles of each scene.

    The patches of `dict-admm`, and of `tv-dict` which starts from them, are coded once by the
    solver of `methods.sparse`: ADMM, as in the paper. dictionary: see `open_dictionary`.
    """

    size: Size = None
    binned_size: Size = None
    methods: MethodSettings = MethodSettings(sparse=SparseSettings(solver=PAPERS_SOLVER))
    binned_stride: int = Field(default=4, ge=2, multiple_of=2)
    dictionary: str | None = None
    seed: int = Field(default=0, ge=0)

    def of(self, method: str, capture: Capture) -> MethodSettings:
        """Return the settings of a capture's reconstruction; the parts of others are default."""
        sparse = self.methods.sparse
        if capture.binning > 1:
            sparse = sparse.model_copy(update={"stride": self.binned_stride})
        return MethodSettings(
            tv=self.methods.tv if method.startswith("tv") else TVSettings(),
            sparse=sparse if METHODS[method].needs_dictionary else SparseSettings(),
        )


FAST = TablesSettings(
    size=(96, 128),
    binned_size=(64, 80),
    methods=MethodSettings(
        tv=TVSettings(max_steps=100),
        sparse=SparseSettings(solver=BPDNSettings(method="admm", rtol=1e-2, max_steps=200)),
    ),
)
"""Crops: all tables on nine scenes in minutes."""


@dataclass
class TablesStudy(Study[Cell]):
    """The cells of some tables; settings: TablesSettings."""

    parts: tuple[Part, ...]
    scenes: Scenes
    journal = "cells.jsonl"
    noun = "cells"
    stage = "reconstruct"
    revision = 1

    @property
    def cells(self) -> list[Cell]:
        """All cells of the parts, each once."""
        every = (cell for part in self.parts for cell in cells_of(part, self.scenes.names))
        return list(dict.fromkeys(every))

    def truth(self, cell: Cell) -> Array:
        """Return the light field that a cell reconstructs."""
        k = cell.capture.binning
        size = self.settings.size if k == 1 else self.settings.binned_size
        return self.scenes.light_field(cell.scene, size, k)

    def dictionary(self, binning: int) -> Dictionary:
        """Return the dictionary for pixels of so many samples; raises as `check_dictionary`."""
        spec = self.settings.dictionary
        opened = open_dictionary_once(spec, VIEWS, binning)
        scored = sorted({cell.scene for cell in self.cells})
        check_dictionary(opened, spec or opened.kind, scored, binning)
        return opened

    def measure(self, watcher: Watcher) -> dict[Cell, dict]:
        """Return the results of all cells, those in the folder not done again.

        Raises StudyStopped at Ctrl-C and AppError when the folder cannot be written, both after
        which the cells done are kept; and the errors of the layers below.
        """
        if any(METHODS[cell.method].needs_dictionary for cell in self.cells):
            for binning in {cell.capture.binning for cell in self.cells}:
                self.dictionary(binning)
        return self.run(self.cells, watcher)

    def inputs(self, point: Cell) -> dict[str, object]:
        """Return everything that a cell's result depends on, as plain data."""
        capture, settings = point.capture, self.settings
        needed = METHODS[point.method].needs_dictionary
        return {
            "scene": point.scene,
            "content": self.scenes.identity(point.scene),
            "size": settings.size if capture.binning == 1 else settings.binned_size,
            "capture": asdict(capture),
            "camera": digest_of(capture.camera().model_dump(mode="json")),
            "seed": settings.seed if capture.noisy else None,
            "method": point.method,
            "settings": settings.of(point.method, capture).model_dump(mode="json"),
            "dictionary": dictionary_identity(settings.dictionary) if needed else None,
        }

    def group(self, point: Cell) -> Hashable:
        """Return what all methods on the same shots have in common."""
        return point.scene, point.capture

    def measured(self, points: Sequence[Cell], watcher: Watcher) -> Results:
        """Yield the methods' results on the same shots."""
        scene, capture = points[0].scene, points[0].capture
        truth = self.truth(points[0])
        shots = shots_of(capture, truth, scene, self.settings.seed)
        first = None
        for cell in points:
            settings = self.settings.of(cell.method, capture)
            if METHODS[cell.method].needs_dictionary and first is None:
                first = _first_stage(shots, self.dictionary(capture.binning), settings.sparse)
            used = first if METHODS[cell.method].needs_dictionary else None
            result = reconstruct(
                cell.method,
                shots.psi,
                shots.frames,
                shots.noise_sigma,
                used.dictionary if used else None,
                settings,
                shots.usable,
                estimates=used.estimates if used else None,
            )
            yield {
                **asdict(colour_scored(result.light_field, truth)),
                "sensor_psnr_db": shots.sensor_psnr_db,
                "noise_sigma": shots.noise_sigma,
                "rows": truth.shape[2],
                "columns": truth.shape[3],
                "seconds": result.seconds + (used.seconds if used else 0),
                "steps": result.steps,
                "status": result.status,
                "advice": result.advice,
            }


@dataclass(frozen=True, eq=False)
class _FirstStage:
    """Dict-ADMM's patches, from which TV-Dict goes on, and what they took."""

    dictionary: Dictionary
    estimates: PatchEstimates
    seconds: float


def _first_stage(shots: Shots, dictionary: Dictionary, settings: SparseSettings) -> _FirstStage:
    started = time.perf_counter()
    sigma = shots.noise_sigma
    frames, usable = checked_inputs(shots.psi, shots.frames, sigma, shots.usable)
    estimates = estimate_patches(shots.psi, frames, sigma, dictionary, settings, usable)
    return _FirstStage(dictionary, estimates, time.perf_counter() - started)
