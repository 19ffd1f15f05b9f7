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

from emmc_rig.model.errors import CameraError
from emmc_rig.progress import Watcher
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.guard import GROUPS, cases
from emmc_rig.study.sweep import NotApplicableError, Results, Sweep
from emmc_rig.study.trial import Setup, trial_of
from reconstruction.methods import DEFAULT_METHOD

NOISES = (0.008, 0.004, 0.002, 0.001, 0.0005)
SHOTS = (1, 2, 3, 6, 16)
NOISE, RIVALS_SHOTS = 0.004, 6
"""Noise of the captures of several shots; most shots of captures that other methods get too."""
RIVALS = ("tv", "tv-dict")


@dataclass(frozen=True)
class Point:
    """A capture of a scene, and the method that reconstructs it."""

    scene: str
    shots: int
    noise: float
    method: str = DEFAULT_METHOD

    @property
    def label(self) -> str:
        """Return it in words."""
        return f"{self.method}, {Path(self.scene).name}, {self.shots} shot(s), noise {self.noise:g}"


@dataclass
class TrendSweep(Sweep[Point]):
    """The PSNR of every point; settings: what was asked for."""

    journal = "trends.jsonl"
    noun = "reconstructions"
    stage = "reconstruct"
    revision = 1

    def _setup(self, point: Point) -> Setup:
        given: Asked = self.settings
        try:
            camera = given.described.with_shots(point.shots)
        except CameraError as why:
            raise NotApplicableError(str(why)) from why
        size = given.size or next(iter(cases([point.scene]))).size
        return Setup(point.scene, camera, size, given.seed)

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figure depends on, as plain data."""
        setup = self._setup(point)
        return {
            "scene": point.scene,
            "content": setup.content(),
            "size": setup.size,
            "seed": setup.seed,
            "camera": setup.camera.model_dump(mode="json"),
            "noise": point.noise,
            "method": point.method,
        }

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the PSNR of each point; raises what the method does."""
        for point in points:
            given = trial_of(self._setup(point), white_noise=point.noise)
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
    scenes = list(dict.fromkeys(case.scene for case in cases(asked.scenes, asked.size)))
    if not asked.scenes:
        scenes = [scene for scene in scenes if Path(scene).name not in GROUPS["B"]]
    by_noise = [Point(scene, 1, noise) for scene in scenes for noise in NOISES]
    by_shots = [Point(scene, shots, NOISE) for scene in scenes for shots in SHOTS]
    rivals = [
        replace(point, method=method)
        for point in by_shots
        if point.shots <= RIVALS_SHOTS
        for method in RIVALS
    ]
    sweep = TrendSweep(asked, folder)
    results = sweep.run([*by_noise, *by_shots, *rivals], show)
    db = {point: result["psnr_db"] for point, result in results.items()}
    falls, losses = {}, {}
    for title, points, named in (
        ("less noise", by_noise, [f"{noise:g}" for noise in NOISES]),
        (f"more shots, noise {NOISE:g}", by_shots, [str(shots) for shots in SHOTS]),
    ):
        rows = []
        for scene in scenes:
            along = [db[one] for one in points if one.scene == scene and one in db]
            falls[f"{Path(scene).name}, {title}"] = fall = max(fall_db(along), 0.0)
            rows.append((Path(scene).name, *(f"{one:.2f}" for one in along), f"{fall:.2f}"))
        show.table(("dB", *named[: max(len(row) - 2 for row in rows)], "falls by"), rows, title)
    rows = []
    for point in (one for one in by_shots if one in db and one.shots <= RIVALS_SHOTS):
        others = [db[replace(point, method=method)] for method in RIVALS]
        losses[f"{Path(point.scene).name}, {point.shots}"] = loss = max(others) - db[point]
        figures = (f"{one:.2f}" for one in (db[point], *others))
        rows.append((Path(point.scene).name, str(point.shots), *figures, f"{loss:+.2f}"))
    heads = ("dB", "shots", DEFAULT_METHOD, *RIVALS, "below the best other")
    show.table(heads, rows, f"other methods, noise {NOISE:g}")
    for line in sorted(set(sweep.left_out.values())):
        show.note("left out", line)
    return {
        "camera": asked.camera,
        "rows": [{**vars(point), "psnr_db": value} for point, value in db.items()],
        "falls_db": falls,
        "losses_db": losses,
    }
