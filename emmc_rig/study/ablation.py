"""Gain in dB and cost in seconds of each part of the adaptive method, on one scene's shot.

Every row leaves one part out. The rows after them are other methods, the true disparity and the
copied centre view, on the same frames.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from emmc_rig.model.lightfield import replicate_centre
from emmc_rig.progress import Watcher
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.benchmarks.timing import Figures
from emmc_rig.study.oracle import matched_disparity
from emmc_rig.study.sweep import Results, Sweep, machine
from emmc_rig.study.trial import Array, Capture, Trial, trial_of
from reconstruction.adaptive.method import reconstruct_adaptive
from reconstruction.adaptive.settings import AdaptiveSettings
from reconstruction.methods import MethodSettings

WHOLE = "adaptive"
LEFT_OUT = {
    "heavy tails of the evidence": {"freedom": 1000.0},
    "belief propagation": {"jump": 0.999},
    "a second length of textures": {"lengths_px": (3.0,)},
    "plane sweeps with the texture": {"texture": {"sweeps": ()}},
    "sharpening of the disparity": {"texture": {"refine_steps": 0}},
    "stacking of like blocks": {"texture": {"reach": 0}},
    "higher threshold of chrominance": {"texture": {"chroma": 1.0}},
    "momentum": {"texture": {"momentum": 0.0}},
    "a second fit, of less misfit": {"misfits": (0.004,)},
    "a second fit, of more misfit": {"misfits": (0.0015,)},
    "disparity (all at 0)": {"furthest_px": 0.01},
}
"""Parts of the method, and the settings without them."""
WITHOUT = "without "
ORACLE = "true disparity in place of the searched one"
COPIED = "copied true centre view"
RIVALS = ("adaptive-fast", "tv", "tv-dict")


@dataclass(frozen=True)
class Ablation(Figures):
    """One row: what was left out, its PSNR and seconds, and both less those of the whole."""

    name: str
    psnr_db: float
    seconds: float
    buys_db: float
    costs_s: float


@dataclass
class AblationSweep(Sweep[str]):
    """The rows of an ablation by name; settings: Capture."""

    journal = "ablation.jsonl"
    noun = "rows"
    stage = "reconstruct"
    revision = 1

    @cached_property
    def trial(self) -> Trial:
        """What every row reconstructs from."""
        return trial_of(self.settings)

    def inputs(self, point: str) -> dict[str, object]:
        """Return everything that a row depends on, as plain data."""
        settings = _settings(point).model_dump(mode="json")
        given = self.settings.identity()
        return {"row": point, "settings": settings, "machine": machine(), "capture": given}

    def prepare(self, points: Sequence[str], watcher: Watcher) -> None:
        """Run the method once, so that no row's seconds count its compiling."""
        if points:
            watcher.begin("compile", None)
            _reconstructed(self.trial, WHOLE)

    def measured(self, points: Sequence[str], watcher: Watcher) -> Results:
        """Yield the PSNR and the seconds of each row."""
        for point in points:
            light_field, seconds = _reconstructed(self.trial, point)
            yield {"psnr_db": self.trial.psnr_db(light_field), "seconds": seconds}


def _settings(row: str) -> MethodSettings:
    changed = LEFT_OUT.get(row.removeprefix(WITHOUT), {})
    return MethodSettings(adaptive=AdaptiveSettings.model_validate(changed))


def _reconstructed(given: Trial, row: str) -> tuple[Array, float]:
    """Return the light field of a row and the seconds that it took."""
    if row == COPIED:
        return replicate_centre(given.truth), 0.0
    if row == ORACLE:
        started = time.perf_counter()
        disparity = matched_disparity(given.truth)
        result = reconstruct_adaptive(
            given.psi, given.readings, given.noise_sigma, usable=given.usable, disparity=disparity
        )
        return result.light_field, time.perf_counter() - started
    result = given.solved(row if row in RIVALS else WHOLE, _settings(row))
    return result.light_field, result.seconds


def ablations(given: Capture, folder: Path, watcher: Watcher) -> list[Ablation]:
    """Return the whole method, then it without each part, its rivals, the oracle and the copy.

    Rows that the folder holds are not measured again; see `Sweep.run`.
    """
    names = [WHOLE, *(WITHOUT + name for name in LEFT_OUT), *RIVALS, ORACLE, COPIED]
    results = AblationSweep(given, folder).run(names, watcher)
    best, took = results[WHOLE]["psnr_db"], results[WHOLE]["seconds"]
    return [
        Ablation(name, **one, buys_db=best - one["psnr_db"], costs_s=took - one["seconds"])
        for name, one in results.items()
    ]


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Measure `adaptive` without each of its parts (`chart --ablation`)."""
    scene, size = (*asked.scenes, "deep-occlusions")[0], asked.size or (128, 160)
    rows = ablations(Capture(scene, asked.camera, size, asked.seed), folder, show)
    show.table(
        ("adaptive", "dB", "s", "buys dB", "costs s"),
        [
            (one.name, f"{one.psnr_db:.2f}", f"{one.seconds:.1f}", f"{one.buys_db:+.2f}",
             f"{one.costs_s:+.1f}")
            for one in rows
        ],
    )  # fmt: skip
    figures = [row.as_dict() for row in rows]
    return {"scene": scene, "camera": asked.camera, "size": list(size), "rows": figures}
