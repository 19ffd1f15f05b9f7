"""The cells of tables and figures, reconstructed one by one, with the time left."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

from pydantic import Field

from emmc_rig.files.results import shown_seconds
from emmc_rig.model.settings import Settings
from emmc_rig.pages.page import number
from emmc_rig.pages.pictures import Pictures, epipolar_lines, pictures_of
from emmc_rig.progress import Watcher
from emmc_rig.study.scores import colour_scored
from emmc_rig.study.sweep import Results, Sweep, digest_of
from emmc_rig.study.tables.cells import PARTS, Capture, Cell, Part, cells_of, distinct, scenes_of
from emmc_rig.study.tables.library import Array, Cut, Library, Source, TrainingSettings
from emmc_rig.study.tables.shots import Sensors, Shots
from reconstruction.bpdn import BPDNSettings
from reconstruction.dictionary import Dictionary
from reconstruction.inputs import checked_inputs
from reconstruction.learning import LearningSettings
from reconstruction.methods import METHODS, MethodSettings, reconstruct
from reconstruction.result import Reconstruction
from reconstruction.sparse import PatchEstimates, SparseSettings, estimate_patches
from reconstruction.training_patches import PatchSettings
from reconstruction.tv import TVSettings

PICTURES = "pictures"
PAPERS_SOLVER = BPDNSettings(method="admm")


class TablesSettings(Settings):
    """How everything is computed; cuts are the middle of each scene.

    The patches of `dict-admm`, and of `tv-dict` which starts from them, are coded once by the
    solver of `methods.sparse`: ADMM, as in the paper.
    """

    cut: Cut = Cut()
    binned_cut: Cut = Cut(multiple=2)
    methods: MethodSettings = MethodSettings(sparse=SparseSettings(solver=PAPERS_SOLVER))
    binned_stride: int = Field(default=4, ge=2, multiple_of=2)
    training: TrainingSettings = Field(default_factory=TrainingSettings)
    seed: int = Field(default=0, ge=0)

    def cut_of(self, capture: Capture) -> Cut:
        """Return which part of a scene a capture sees."""
        return self.cut if capture.binning == 1 else self.binned_cut

    @property
    def cuts(self) -> tuple[Cut, ...]:
        """All cuts."""
        return tuple(dict.fromkeys((self.cut, self.binned_cut, self.training.cut)))

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
    cut=Cut((96, 128)),
    binned_cut=Cut((64, 80), 2),
    methods=MethodSettings(
        tv=TVSettings(max_steps=100),
        sparse=SparseSettings(solver=BPDNSettings(method="admm", rtol=1e-2, max_steps=200)),
    ),
    training=TrainingSettings(
        cut=Cut((192, 192)),
        patches=PatchSettings(count=2000, candidates_per_patch=2),
        learning=LearningSettings(atoms=256, iterations=4),
    ),
)
"""Crops and small dictionaries: all tables on nine scenes in minutes."""


@dataclass
class Forecast:
    """How long the remaining cells will take, judged by those of their kind that are done."""

    remaining: list[Cell]
    _seconds: dict[tuple, list[float]] = field(default_factory=lambda: defaultdict(list))

    @staticmethod
    def _kinds(cell: Cell) -> tuple[tuple, ...]:
        capture = cell.capture
        return (
            (cell.method, capture.scenario, capture.shots, capture.binning),
            (cell.method, capture.binning),
            (),
        )

    def done(self, cell: Cell, seconds: float) -> None:
        """Take the next cell off the list."""
        self.remaining.remove(cell)
        for kind in self._kinds(cell):
            self._seconds[kind].append(seconds)

    def left(self) -> str:
        """Return the time left in words; "" before the first cell is done."""
        if not self._seconds[()]:
            return ""
        left_s = 0.0
        for cell in self.remaining:
            known = next(self._seconds[kind] for kind in self._kinds(cell) if self._seconds[kind])
            left_s += sum(known) / len(known)
        return f"about {shown_seconds(left_s)} left"


@dataclass
class TablesSweep(Sweep[Cell]):
    """The cells of some tables and figures; settings: TablesSettings.

    source: of dictionaries, not asked when no method of the parts needs one.
    """

    parts: tuple[Part, ...]
    library: Library
    source: Source
    clock: Callable[[], float] = time.perf_counter
    journal = "cells.jsonl"
    noun = "cells"
    stage = "reconstruct"

    @property
    def cells(self) -> list[Cell]:
        """All cells of the parts, each once."""
        return distinct(cell for part in self.parts for cell in cells_of(part, self.library.names))

    @cached_property
    def pictured(self) -> set[Cell]:
        """The cells that some figure shows, asked for now or not."""
        names = self.library.names
        return {
            cell
            for part in PARTS.values()
            for cell in cells_of(part, names)
            if cell.method in part.pictured and cell.scene == scenes_of(part, names)[0]
        }

    def truth(self, cell: Cell) -> Array:
        """Return the light field that a cell reconstructs."""
        return self.library.light_field(cell.scene, self.settings.cut_of(cell.capture))

    def picture(self, cell: Cell) -> Path:
        """Return where the pictures of a cell are kept."""
        return self.folder / PICTURES / f"{self.digest(cell)}.npz"

    def measure(self, watcher: Watcher) -> dict[Cell, dict]:
        """Return the results of all cells, those in the folder not done again.

        Raises SweepStopped at Ctrl-C and AppError when the folder cannot be written, both after
        which the cells done are kept; and the errors of the layers below.
        """
        watcher.begin("check the scenes", len(self.library.names))
        for name in self.library.names:
            self.library.digest(name)
            watcher.step(name)
        return self.run(self.cells, watcher)

    def inputs(self, point: Cell) -> dict[str, object]:
        """Return everything that a cell's result depends on, as plain data."""
        capture, settings = point.capture, self.settings
        dictionary = None
        if METHODS[point.method].needs_dictionary:
            dictionary = digest_of(self.source.recipe(point.scene, capture.binning))
        return {
            "scene": point.scene,
            "content": self.library.digest(point.scene),
            "cut": asdict(settings.cut_of(capture)),
            "capture": asdict(capture),
            "camera": digest_of(capture.camera().model_dump(mode="json")),
            "seed": settings.seed if capture.noisy else None,
            "method": point.method,
            "settings": settings.of(point.method, capture).model_dump(mode="json"),
            "dictionary": dictionary,
        }

    def is_whole(self, point: Cell, result: dict) -> bool:
        """Return whether a cell that a figure shows has its pictures."""
        return point not in self.pictured or Pictures.load(self.picture(point)) is not None

    def group(self, point: Cell) -> Hashable:
        """Return what all methods on the same shots have in common."""
        return point.scene, point.capture

    def prepare(self, points: Sequence[Cell], watcher: Watcher) -> None:
        """Make the dictionaries that will be needed."""
        needing = [cell for cell in points if METHODS[cell.method].needs_dictionary]
        for scene, binning in dict.fromkeys((c.scene, c.capture.binning) for c in needing):
            self.source.dictionary(scene, binning, watcher)
        self._forecast = Forecast(list(points))
        self._sensors = Sensors(self.settings.seed)

    def measured(self, points: Sequence[Cell], watcher: Watcher) -> Results:
        """Yield the methods' results on the same shots."""
        scene, capture = points[0].scene, points[0].capture
        truth = self.truth(points[0])
        shots = self._sensors.take(capture, truth, scene)
        first = None
        for cell in points:
            started = self.clock()
            settings = self.settings.of(cell.method, capture)
            if METHODS[cell.method].needs_dictionary and first is None:
                dictionary = self.source.dictionary(scene, capture.binning, watcher)
                first = _first_stage(shots, dictionary, settings.sparse, self.clock)
            found, seconds = _solved(cell.method, shots, settings, first, self.clock)
            scores = colour_scored(found.light_field, truth)
            if cell in self.pictured:
                kept = pictures_of(found.light_field, epipolar_lines(truth))
                kept.save(self.picture(cell))
            self._forecast.done(cell, self.clock() - started)
            yield {
                **asdict(scores),
                "sensor_psnr_db": shots.sensor_psnr_db,
                "noise_sigma": shots.noise_sigma,
                "seconds": seconds,
                "steps": found.steps,
                "status": found.status,
                "advice": found.advice,
            }

    def words(self, point: Cell, result: dict) -> str:
        """Return a cell that was done, and how long the others will take."""
        return f"{self._forecast.left()}; {number(result['psnr_db'], '.2f')} dB {point.label}"


@dataclass(frozen=True, eq=False)
class _FirstStage:
    """Dict-ADMM's patches, from which TV-Dict goes on, and what they took."""

    dictionary: Dictionary
    estimates: PatchEstimates
    seconds: float


def _first_stage(
    shots: Shots, dictionary: Dictionary, settings: SparseSettings, clock: Callable[[], float]
) -> _FirstStage:
    started = clock()
    sigma = shots.noise_sigma
    frames, usable = checked_inputs(shots.psi, shots.frames, sigma, shots.usable)
    estimates = estimate_patches(shots.psi, frames, sigma, dictionary, settings, usable)
    return _FirstStage(dictionary, estimates, clock() - started)


def _solved(
    method: str,
    shots: Shots,
    settings: MethodSettings,
    first: _FirstStage | None,
    clock: Callable[[], float],
) -> tuple[Reconstruction, float]:
    """Return a method's result and its seconds, those of the first stage included."""
    used = first if METHODS[method].needs_dictionary else None
    found = reconstruct(
        method,
        shots.psi,
        shots.frames,
        shots.noise_sigma,
        used.dictionary if used else None,
        settings,
        shots.usable,
        clock=clock,
        estimates=used.estimates if used else None,
    )
    return found, found.seconds + (used.seconds if used else 0)
