"""PSNR of the default method as captures get better, and beside other methods (`chart --trends`).

Less noise should never cost accuracy, nor should a further shot of equal noise. Captures are those
of the guard: Psi of a scene plus white noise, an inverse crime. The largest fall on the way to a
better capture, and the largest loss against another method, are what the result says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from emmc_rig.progress import Watcher
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.guard import GROUPS, cases
from emmc_rig.study.sweep import Results, Sweep
from emmc_rig.study.trial import Capture, trial_of
from reconstruction.methods import DEFAULT_METHOD

NOISES = (0.008, 0.004, 0.002, 0.001, 0.0005)
SHOTS = (1, 2, 3, 6, 16)
NOISE, RIVALS_SHOTS = 0.004, 6
"""Noise of the captures of several shots; most shots of captures that other methods get too."""
RIVALS = ("tv", "tv-dict")


@dataclass(frozen=True)
class Point:
    """A capture of a scene, and the method that reconstructs it."""

    capture: Capture
    method: str = DEFAULT_METHOD

    @property
    def label(self) -> str:
        """Return it in words."""
        one = self.capture
        return f"{self.method}, {one.scene_name}, {one.shots} shot(s), noise {one.noise:g}"


@dataclass
class TrendSweep(Sweep[Point]):
    """The PSNR of every point; settings: what was asked for."""

    journal = "trends.jsonl"
    noun = "reconstructions"
    stage = "reconstruct"
    revision = 1

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the PSNR of each point; raises what the method does."""
        for point in points:
            given = trial_of(point.capture)
            result = given.solved(point.method, dictionary=self.settings.dictionary)
            yield {"psnr_db": given.psnr_db(result.light_field)}


def fall_db(better_and_better: Sequence[float]) -> float:
    """Return by how much the PSNR falls at most to any better capture; below 0: it always rises."""
    return max(
        (
            worse - better
            for at, worse in enumerate(better_and_better)
            for better in better_and_better[at + 1 :]
        ),
        default=0.0,
    )


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Measure the default method against noise, shots and other methods (`chart --trends`)."""
    every = {one.scene: one for one in cases(asked.scenes, asked.size, asked.camera)}
    captures = [
        replace(one, seed=asked.seed)
        for one in every.values()
        if asked.scenes or one.scene_name not in GROUPS["B"]
    ]
    by_noise = [Point(replace(one, shots=1, noise=by)) for one in captures for by in NOISES]
    by_shots = [Point(replace(one, shots=by, noise=NOISE)) for one in captures for by in SHOTS]
    beside = [point for point in by_shots if (point.capture.shots or 1) <= RIVALS_SHOTS]
    rivals = [replace(point, method=method) for point in beside for method in RIVALS]
    sweep = TrendSweep(asked, folder)
    results = sweep.run([*by_noise, *by_shots, *rivals], show)
    db = {point: result["psnr_db"] for point, result in results.items()}
    falls, losses = {}, {}
    for title, points, named in (
        ("less noise", by_noise, [f"{noise:g}" for noise in NOISES]),
        (f"more shots, noise {NOISE:g}", by_shots, [str(shots) for shots in SHOTS]),
    ):
        rows = []
        for name in (one.scene_name for one in captures):
            along = [db[one] for one in points if one.capture.scene_name == name and one in db]
            falls[f"{name}, {title}"] = fall = max(fall_db(along), 0.0)
            rows.append((name, *(f"{one:.2f}" for one in along), f"{fall:.2f}"))
        show.table(("dB", *named[: max(len(row) - 2 for row in rows)], "falls by"), rows, title)
    rows = []
    for point in (one for one in beside if one in db):
        name, shots = point.capture.scene_name, str(point.capture.shots)
        others = [db[replace(point, method=method)] for method in RIVALS]
        losses[f"{name}, {shots}"] = loss = max(others) - db[point]
        figures = (f"{one:.2f}" for one in (db[point], *others))
        rows.append((name, shots, *figures, f"{loss:+.2f}"))
    heads = ("dB", "shots", DEFAULT_METHOD, *RIVALS, "below the best other")
    show.table(heads, rows, f"other methods, noise {NOISE:g}")
    for line in sorted(set(sweep.left_out.values())):
        show.note("left out", line)
    return {
        "camera": asked.camera,
        "rows": [
            {
                **{name: getattr(point.capture, name) for name in ("scene", "shots", "noise")},
                "method": point.method,
                "psnr_db": value,
            }
            for point, value in db.items()
        ],
        "falls_db": falls,
        "losses_db": losses,
    }
