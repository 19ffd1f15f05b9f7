"""Do the cells of the chosen tables, each kept as it is done, and go on where a run stopped."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path

from pydantic import Field

from emmc_rig.model.settings import Settings
from emmc_rig.pages.pictures import Pictures, pictures_of, telling_lines
from emmc_rig.progress import Watcher
from emmc_rig.study.points import Journal, digest_of, kept_when_stopped
from emmc_rig.study.tables.dictionaries import Source, TrainingSettings
from emmc_rig.study.tables.library import Array, Cut, Library
from emmc_rig.study.tables.plan import PARTS, Capture, Cell, Part, cells_of, distinct, scenes_of
from emmc_rig.study.tables.scores import scored
from emmc_rig.study.tables.shots import Sensors, Shots
from emmc_rig.version import __version__
from reconstruction.bpdn import BPDNSettings
from reconstruction.dictionary import Dictionary
from reconstruction.inputs import checked_inputs
from reconstruction.learning import LearningSettings
from reconstruction.methods import METHODS, MethodSettings, reconstruct
from reconstruction.result import Reconstruction
from reconstruction.sparse import PatchEstimates, SparseSettings, estimate_patches
from reconstruction.training_patches import PatchSettings
from reconstruction.tv import TVSettings

CELLS, PICTURES = "cells.jsonl", "pictures"
PAPERS_SOLVER = BPDNSettings(method="admm")


class TablesStopped(KeyboardInterrupt):
    """Ctrl-C; the cells done are kept."""


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
        """Return the time left in words; nothing before the first cell is done."""
        if not self._seconds[()]:
            return ""
        left_s = 0.0
        for cell in self.remaining:
            known = next(self._seconds[kind] for kind in self._kinds(cell) if self._seconds[kind])
            left_s += sum(known) / len(known)
        return f"about {_duration(left_s)} left"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


@dataclass(frozen=True)
class Run:
    """What to do, and where. source: None when no method of the parts needs a dictionary."""

    parts: tuple[Part, ...]
    library: Library
    source: Source
    settings: TablesSettings
    folder: Path

    @property
    def cells(self) -> list[Cell]:
        """All cells of the parts, each once."""
        return distinct(cell for part in self.parts for cell in cells_of(part, self.library.names))

    @property
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

    def inputs(self, cell: Cell) -> dict:
        """Return everything that a cell's result depends on, as plain data."""
        capture = cell.capture
        needs = METHODS[cell.method].needs_dictionary
        return {
            "version": __version__,
            "scene": cell.scene,
            "content": self.library.digest(cell.scene),
            "cut": asdict(self.settings.cut_of(capture)),
            "capture": asdict(capture),
            "camera": digest_of(capture.camera().model_dump(mode="json")),
            "seed": self.settings.seed if capture.noisy else None,
            "method": cell.method,
            "settings": self.settings.of(cell.method, capture).model_dump(mode="json"),
            "dictionary": (
                digest_of(self.source.recipe(cell.scene, capture.binning)) if needs else None
            ),
        }

    def picture_path(self, digest: str) -> Path:
        """Return where the pictures of a cell are kept."""
        return self.folder / PICTURES / f"{digest}.npz"


def do_cells(
    run: Run, watcher: Watcher, clock: Callable[[], float] = time.perf_counter
) -> dict[Cell, dict]:
    """Return the results of all cells of the parts; those in the folder are not done again.

    Raises TablesStopped at Ctrl-C and AppError when the folder cannot be written, both after which
    the cells done are kept; and the errors of the layers below.
    """
    cells, pictured = run.cells, run.pictured
    journal = Journal(run.folder / CELLS)
    watcher.begin("check the scenes", len(run.library.names))
    for name in run.library.names:
        run.library.digest(name)
        watcher.step(name)
    inputs = {cell: run.inputs(cell) for cell in cells}
    digests = {cell: digest_of(inputs[cell]) for cell in cells}

    def missing(cell: Cell) -> bool:
        path = run.picture_path(digests[cell])
        return journal.get(digests[cell]) is None or (
            cell in pictured and Pictures.load(path) is None
        )

    todo = [cell for cell in cells if missing(cell)]

    def kept() -> str:
        done = sum(journal.get(digest) is not None for digest in digests.values())
        return f"{done} of {len(cells)} cells are"

    with kept_when_stopped(run.folder, run.folder, TablesStopped, kept):
        _do(run, todo, pictured, inputs, digests, journal, watcher, clock)
    results = {cell: journal.get(digests[cell]) for cell in cells}
    return {cell: result for cell, result in results.items() if result is not None}


def _do(
    run: Run,
    todo: Sequence[Cell],
    pictured: set[Cell],
    inputs: dict[Cell, dict],
    digests: dict[Cell, str],
    journal: Journal,
    watcher: Watcher,
    clock: Callable[[], float],
) -> None:
    needing = [cell for cell in todo if METHODS[cell.method].needs_dictionary]
    for scene, binning in dict.fromkeys((cell.scene, cell.capture.binning) for cell in needing):
        run.source.dictionary(scene, binning, watcher)
    watcher.begin(f"reconstruct, {len(inputs) - len(todo)} kept from before", len(todo))
    forecast = Forecast(list(todo))
    sensors = Sensors(run.settings.seed)
    for (scene, capture), group in groupby(todo, lambda cell: (cell.scene, cell.capture)):
        group = list(group)
        truth = run.truth(group[0])
        shots = sensors.take(capture, truth, scene)
        first = None
        for cell in group:
            started = clock()
            settings = run.settings.of(cell.method, capture)
            if METHODS[cell.method].needs_dictionary and first is None:
                dictionary = run.source.dictionary(scene, capture.binning, watcher)
                first = _first_stage(shots, dictionary, settings.sparse, clock)
            found, seconds = _solved(cell.method, shots, settings, first, clock)
            scores = scored(found.light_field, truth)
            if cell in pictured:
                kept = pictures_of(found.light_field, telling_lines(truth))
                kept.save(run.picture_path(digests[cell]))
            result = {
                **asdict(scores),
                "sensor_psnr_db": shots.sensor_psnr_db,
                "noise_sigma": shots.noise_sigma,
                "seconds": seconds,
                "steps": found.steps,
                "status": found.status,
                "advice": found.advice,
            }
            journal.add(digests[cell], inputs[cell], _plain(result))
            forecast.done(cell, clock() - started)
            watcher.step(f"{forecast.left()}; {scores.psnr_db:.2f} dB {cell.label}")


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


def _plain(result: dict) -> dict:
    """Return the result with None for what JSON has no number for."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in result.items()
    }
