"""Films as `reconstruct` writes them: a scene that slides by a pixel a frame, for tests."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from emmc_rig.formats.scenes import open_scene
from emmc_rig.store.result_files import write_light_field
from emmc_rig.store.results import write_metrics

SIZE = 36, 48


def light_field_at(place: int) -> np.ndarray:
    """Return what a frame shows, (v, u, y, x, c): all moved left by its place, pixels."""
    scene = open_scene("near-planar", size=(SIZE[0], 2 * SIZE[1]), views=(3, 3))
    return scene.light_field[:, :, :, place : place + SIZE[1]]


def write_film(
    folder: Path, frames: int = 6, missing: Collection[int] = (3,), rate: float = 8.0,
    levels: Collection[str] = (),
) -> Path:  # fmt: skip
    """Write a film into a new folder and return it. levels: verdicts of the first frames."""
    given = dict(enumerate(levels))
    for place in range(frames):
        if place in missing:
            continue
        inside = folder / "frames" / f"{place:06d}"
        light_field = light_field_at(place)
        inside.mkdir(parents=True)
        sigma = np.full(light_field.shape[:4], 0.02, np.float32)
        maps = {"disparity": np.full(SIZE, 0.5, np.float32), "sigma": sigma}
        write_light_field(inside, light_field, maps)
        reasons = [{"what": "a reason", "remedy": "a remedy"}] if place in given else []
        verdict = {"level": given.get(place, "trust"), "reasons": reasons}
        write_metrics(inside, {"method": "adaptive", "verdict": verdict})
    times_s = [place / rate for place in range(frames)]
    write_metrics(folder, {"film": {"frames": frames, "rate": rate, "times_s": times_s}})
    return folder
