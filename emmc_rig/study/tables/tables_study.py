"""`emmc-rig tables`: the paper's tables on given scenes, with figures of every cell.

A dictionary that was trained on one of the scenes is refused.

Frames are made with the Psi that reconstructs them, as the paper does: an inverse crime, which
`emmc-rig demo` avoids.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.errors import AppError
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.settings import Settings
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction import methods as solvers
from emmc_rig.reconstruction.bpdn import BPDNSettings
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.reconstruction.inputs import checked_inputs
from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.reconstruction.sparse import PatchEstimates, SparseSettings, estimate_patches
from emmc_rig.reconstruction.tv import TVSettings
from emmc_rig.report.page import Head, Section, number, part
from emmc_rig.simulators.scenes import STILL_SCENES
from emmc_rig.store.pool import Pool
from emmc_rig.study.points import Report, Results, Study, Table
from emmc_rig.study.rows import SMALLEST_PX, dictionary_identity
from emmc_rig.study.scores import scored
from emmc_rig.study.tables import paper
from emmc_rig.study.tables.cells import METHODS, Cell, Part, Setup, cells_of, scenes_of
from emmc_rig.study.trial import Capture, Trial, open_dictionary_once, trial_of

CSV = "tables.csv"
Size = tuple[int, int] | None
VIEWS = (5, 5)
_ENDINGS = (".h5", ".hdf5")


class TablesSettings(Settings):
    """How everything is computed; sizes are middles of each scene.

    Patches are coded once, for `dict-admm` and for `tv-dict`. dictionary: see `open_dictionary`.
    """

    size: Size = None
    binned_size: Size = None
    methods: MethodSettings = MethodSettings()
    binned_stride: int = Field(default=4, ge=2, multiple_of=2)
    dictionary: str | None = None
    seed: int = Field(default=0, ge=0)

    def of(self, setup: Setup) -> MethodSettings:
        """Return the settings of a setup's reconstructions."""
        if setup.binning == 1:
            return self.methods
        sparse = self.methods.sparse.model_copy(update={"stride": self.binned_stride})
        return self.methods.model_copy(update={"sparse": sparse})


FAST = TablesSettings(
    size=(48, 48),
    binned_size=(32, 32),
    methods=MethodSettings(
        tv=TVSettings(max_steps=100),
        sparse=SparseSettings(solver=BPDNSettings(rtol=1e-2, max_steps=200)),
    ),
)
"""Crops: all tables on thirteen scenes in three minutes on two cores."""


def scene_specs(folder: Path | None) -> dict[str, str]:
    """Return what `open_scene` calls each scene of a folder, by name; the built-in ones for None.

    Raises AppError for no such folder, one without scenes, and scenes of the same name.
    """
    if folder is None:
        return {name: name for name in STILL_SCENES}
    if not folder.is_dir():
        raise AppError(f"{folder}: no such folder")
    if any(folder.glob("view_*_*.png")):
        raise AppError(f"{folder}: is itself a scene; give the folder that holds it and others")
    specs: dict[str, str] = {}
    for path in sorted(folder.iterdir()):
        is_folder = path.is_dir() and any(path.glob("view_*_*.png"))
        if not is_folder and not (path.is_file() and path.suffix.lower() in _ENDINGS):
            continue
        name = path.name if is_folder else path.stem
        if name in specs:
            raise AppError(f"{folder}: two scenes are called '{name}'; rename one")
        specs[name] = str(path.resolve())
    if not specs:
        raise AppError(
            f"{folder}: no scenes; needed is a folder of view_ROW_COL.png, or an HDF5 "
            "light field, for each"
        )
    return specs


def middle(light_field: NDArray, size: Size, multiple: int = 1) -> NDArray:
    """Return the middle of a light field (v, u, y, x, c), down to a multiple of so many pixels.

    size: rows and columns at most; None takes all.
    """
    has = light_field.shape[2:4]
    kept = [min(w, n) // multiple * multiple for w, n in zip(size or has, has, strict=True)]
    starts = [(whole - part) // 2 for whole, part in zip(has, kept, strict=True)]
    rows, columns = (slice(s, s + n) for s, n in zip(starts, kept, strict=True))
    return np.ascontiguousarray(light_field[:, :, rows, columns])


def check_dictionary(
    dictionary: Dictionary, spec: str, scenes: Sequence[str], binning: int
) -> None:
    """Raise AppError for a dictionary that does not fit the pixels, was trained on a scene of the
    tables, or does not state its training scenes.
    """
    rows, columns = dictionary.patch_shape[2:4]
    if rows % binning or columns % binning:
        raise AppError(
            f"dictionary {spec}: pixels of {binning}x{binning} samples (r = 1/{binning**2}) need "
            f"patches that are a multiple of {binning}, these are {rows}x{columns}; leave those "
            "tables out"
        )
    names = _trained_on(dictionary)
    if names is None:
        raise AppError(
            f"dictionary {spec}: does not say which scenes it was trained on, so nothing can be "
            "scored with it; train it with benchmarks/train_dictionary.py"
        )
    trained = {paper.known_as(name) or name.lower() for name in names}
    for scene in scenes:
        if (paper.known_as(scene) or scene.lower()) in trained:
            raise AppError(
                f"dictionary {spec}: was trained on '{scene}', which is to be scored; train "
                "without it, or use another"
            )


def _trained_on(dictionary: Dictionary) -> list[str] | None:
    """Return the names of the scenes that a dictionary learned from; None when it does not say."""
    if dictionary.kind == "lambertian":  # made by formula
        return []
    try:
        scenes = parse_json(dictionary.provenance, "provenance", ValueError)["scenes"]
        names = [scene["name"] if isinstance(scene, dict) else scene for scene in scenes]
        return [Path(name).stem for name in names] or None
    except (ValueError, KeyError, TypeError):
        return None


@dataclass
class TablesStudy(Study[Cell]):
    """The paper's tables, ours beside the paper's; settings: TablesSettings.

    parts: tables and parts of tables. scenes: see `scene_specs`.
    """

    parts: tuple[Part, ...]
    scenes: dict[str, str]
    journal = "cells.jsonl"
    noun = "cells"
    stage = "reconstruct"
    revision = 3
    command, title, page = "tables", "The paper's tables, reproduced", "tables.html"
    caveats = (
        "The paper's figures are for orientation: its aperture variant of the MIT scenes and its "
        "distance from mask to sensor are unknown. Compare methods and scenarios within one run.",
        "The paper's means are over all of its scenes, whether they are measured here or not.",
        "In the paper three monochrome shots lead three CFA shots; here they trail them. Columns "
        "without noise depend on neither light nor the unit of noise, and the mask is the paper's. "
        "The dictionary differs: the paper's was trained, ours needs no training, and the paper's "
        "penalty is not stated.",
    )
    columns: ClassVar[Mapping[str, Sequence[str]]] = {
        CSV: (
            "tables", "scene", "scenario", "shots", "r", "noise", "method", "psnr_db",
            "paper_psnr_db", "ssim", "angular_db", "replicate_psnr_db", "noise_sigma", "rows",
            "columns", "seconds", "steps", "status", "advice", "dictionary", "settings",
        )
    }  # fmt: skip

    @property
    def cells(self) -> list[Cell]:
        """All cells of the parts, each once."""
        every = (cell for part in self.parts for cell in cells_of(part, list(self.scenes)))
        return list(dict.fromkeys(every))

    def dictionary(self, binning: int) -> Dictionary:
        """Return the dictionary for pixels of so many samples; raises as `check_dictionary`."""
        spec = self.settings.dictionary
        opened = open_dictionary_once(spec, VIEWS, binning)
        check_dictionary(
            opened, spec or opened.kind, sorted({cell.scene for cell in self.cells}), binning
        )
        return opened

    def planned(self) -> list[Cell]:
        """Return the cells."""
        return self.cells

    def run(
        self, points: Iterable[Cell], watcher: Watcher, pool: Pool | None = None
    ) -> dict[Cell, dict]:
        """Measure cells as every study does, after the dictionary and the scenes are checked."""
        self.check_input()
        return super().run(points, watcher, pool)

    def check_input(self) -> None:
        """Raise AppError for a dictionary or a scene that does not fit."""
        for binning in {cell.setup.binning for cell in self.cells}:
            self.dictionary(binning)
        for cell in {cell.scene: cell for cell in self.cells}.values():
            capture = self.capture(cell)
            rows, columns = capture.scene_seen().size
            capture.identity()  # sums the scene while it is in memory: few scenes are
            if min(rows, columns) < SMALLEST_PX:
                raise AppError(
                    f"{cell.scene}: {rows}x{columns} pixels, needs {SMALLEST_PX}x{SMALLEST_PX} or "
                    "more; leave the scene out"
                )

    def capture(self, cell: Cell) -> Capture:
        """Return the capture of a cell, of the whole scene."""
        setup = cell.setup
        noise = None if setup.noisy else 0.0
        return Capture(
            self.scenes[cell.scene], setup.camera(), seed=self.settings.seed, noise=noise
        )

    def trial(self, cell: Cell) -> Trial:
        """Return what a cell's method gets, of the middle of the scene, and the truth."""
        capture, k = self.capture(cell), cell.setup.binning
        size = self.settings.size if k == 1 else self.settings.binned_size
        whole = capture.scene_seen()
        scene = replace(whole, light_field=middle(whole.light_field, size, k), disparity_px=None)
        return trial_of(capture, scene=scene)

    def inputs(self, point: Cell) -> dict[str, object]:
        """Return everything that a cell's result depends on, as plain data."""
        settings, needed = self.settings, solvers.METHODS[point.method].needs_dictionary
        return {
            "capture": self.capture(point).identity(),
            "size": settings.size if point.setup.binning == 1 else settings.binned_size,
            "method": point.method,
            "settings": settings.of(point.setup).model_dump(mode="json"),
            "dictionary": dictionary_identity(settings.dictionary) if needed else None,
        }

    def group(self, point: Cell) -> Hashable:
        """Return what all methods on the same shots have in common."""
        return point.scene, point.setup

    def measured(self, points: Sequence[Cell]) -> Results:
        """Yield the methods' results on the same shots; patches are coded once."""
        setup, made = points[0].setup, self.trial(points[0])
        settings = self.settings.of(setup)
        patches: PatchEstimates | None = None
        coding_s = 0.0
        for cell in points:
            dictionary = None
            if solvers.METHODS[cell.method].needs_dictionary:
                dictionary = self.dictionary(setup.binning)
                if patches is None:
                    started = time.perf_counter()
                    inputs = checked_inputs(made.psi, made.frames)
                    # Dict-ADMM ends with these patches; TV-Dict starts from them.
                    patches = estimate_patches(made.psi, inputs, dictionary, settings.sparse)
                    coding_s = time.perf_counter() - started
            result = solvers.reconstruct(
                cell.method, made.psi, made.frames, dictionary, settings,
                estimates=patches if dictionary else None,
            )  # fmt: skip
            yield {
                **asdict(scored(result.light_field, made.truth)),
                "noise_sigma": made.noise_sigma,
                "rows": made.truth.shape[2],
                "columns": made.truth.shape[3],
                "seconds": result.seconds + (coding_s if dictionary else 0.0),
                "steps": result.steps,
                "status": result.status,
                "advice": result.advice,
            }

    @property
    def grids(self) -> list[Table]:
        """The measured tables, as the page shows them."""
        return [grid_of(part, self.results, list(self.scenes)) for part in self.parts]

    def shown(self) -> Iterable[Table | str]:
        """Return the tables for a terminal; ours above the paper's, as the widest would not fit."""
        for grid in self.grids:
            rows = [[cell.replace(" | ", "\n") for cell in row] for row in grid.rows]
            yield grid._replace(rows=rows)
        yield "PSNR in dB, the paper's below; compare figures within one run only"

    def report(self, new: Path) -> Report:
        """Return the content of the files; raises AppError where nothing could be measured."""
        grids, cut = self.grids, self.settings.size
        size = "whole views" if cut is None else f"the middle {cut[0]}×{cut[1]} pixels"
        lead = part("lead", "PSNR in dB, the paper's after the bar.")
        return Report(
            head=_head(self.results),
            about=[
                f"{len(self.results)} reconstructions of {', '.join(self.scenes)}; {size}, "
                "5×5 views, PSNR with peak 1 over all views, pixels and colours.",
                "Equal total exposure for every setup; frames are made with the Psi that "
                "reconstructs them, as in the paper.",
            ],
            sections=[
                Section(
                    f"table-{index}",
                    grid.title,
                    lead + part("wide_table", grid.heads, grid.rows),
                    grid.title.partition(":")[0],
                )
                for index, grid in enumerate(grids)
            ],
            rows={CSV: self._rows()},
            metrics={
                "cells": len(self.results),
                "seconds": self.seconds,
                "scenes": self.scenes,
                "tables": {grid.title: [grid.heads, *grid.rows] for grid in grids},
                "settings": self.settings.model_dump(mode="json"),
            },
            sources={f"Scene {name}": spec for name, spec in self.scenes.items()},
        )

    def _rows(self) -> list[dict[str, object]]:
        """Return the rows of tables.csv: one row per cell, in the order of the tables."""
        names: dict[Cell, list[str]] = {}
        for table in self.parts:
            for cell in cells_of(table, list(self.scenes)):
                names.setdefault(cell, []).append(table.name)
        return [
            {
                **self.results[cell],
                "scenario": cell.setup.scenario,
                "shots": cell.setup.shots,
                "r": f"1/{cell.setup.binning**2}" if cell.setup.binning > 1 else "1",
                "noise": "yes" if cell.setup.noisy else "no",
                "scene": cell.scene,
                "method": cell.method,
                "paper_psnr_db": cell.paper_psnr_db,
                "tables": " ".join(names[cell]),
                "dictionary": self.inputs(cell)["dictionary"],
                "settings": self.settings.of(cell.setup).model_dump_json(exclude_defaults=True),
            }
            for cell in names
            if cell in self.results
        ]


def grid_of(table: Part, results: Mapping[Cell, Mapping], scenes: Sequence[str]) -> Table:
    """Return scenes by all methods, then means; a dash stands for what was not measured.

    Cells are our PSNR in dB and the paper's, where it prints any, as "30.12 | 30.22".
    """

    def cell(setup: Setup, method: str, ours: Sequence[str], theirs: Sequence[str]) -> str:
        """Return our mean over some scenes, and the paper's over others."""
        cells = [Cell(scene, setup, method) for scene in ours]
        measured = [results[cell]["psnr_db"] for cell in cells if cell in results]
        printed = [Cell(scene, setup, method).paper_psnr_db for scene in theirs]
        return _mean(measured) + (f" | {_mean(printed)}" if any(printed) else "")

    shown, printed = scenes_of(table, scenes), scenes_of(table, list(paper.TITLES))
    groups = [(scene, [scene], [scene]) for scene in shown] + [("mean", shown, printed)]
    rows = [
        (f"{name}, {title}", *(cell(setup, method, ours, theirs) for setup in table.setups))
        for name, ours, theirs in groups
        for method, title in METHODS.items()
    ]
    return Table(table.title, ("scene, method", *table.columns), rows)


def _mean(levels: Sequence[float | None]) -> str:
    known = [level for level in levels if level is not None]
    return number(float(np.mean(known)) if known else None, ".2f")


def _head(results: Mapping[Cell, Mapping]) -> Head:
    """Return the method that is best in the mean over what all methods reconstructed."""
    by_method: dict[str, list[float]] = {}
    for cell, result in results.items():
        if result["psnr_db"] is not None:
            by_method.setdefault(cell.method, []).append(result["psnr_db"])
    if not by_method:
        raise AppError("nothing could be measured: no PSNR is finite")
    means = {METHODS[name]: float(np.mean(levels)) for name, levels in by_method.items()}
    best = max(means, key=lambda name: means[name])
    return Head(
        f"{best} is best in the mean",
        ", ".join(f"{name} {db:.2f} dB" for name, db in means.items()),
        [
            "compare methods within a column, and scenarios within a row",
            "measure on light fields of your own: `emmc-rig tables --scenes PATH`",
        ],
    )
