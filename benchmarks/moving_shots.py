"""Shots of one capture between which the scene moves, against the same shots of a scene at rest.

Content slides aslant by so many pixels a shot; of a built-in scene that moves, a shot is a frame.
At rest the shots are a film, too: its last frame against all shots of one capture at once.
"""

from __future__ import annotations

import importlib
from functools import lru_cache
from pathlib import Path

import lab
import numpy as np
from films import frame_of, opened, window

from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.adaptive.film import Film
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.methods import MethodSettings, reconstruct
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.simulators.scenes import MOVING_SCENES

STEPS_PX = (0.3, 1.0, 2.5, 5.0)
"""By which a shot's content moves on from the one before."""
DIRECTION = np.array([0.3, 0.954])
WITHOUT_PATCHES = MethodSettings(adaptive=AdaptiveSettings(patches=None))


def _seen(scene: str, size: tuple[int, int], step_px: float, shot: int) -> np.ndarray:
    """Return the light field before the camera at a shot."""
    if scene in MOVING_SCENES:
        return frame_of(scene, "", "", size, shot if step_px else 0)
    return window(opened(scene), size, step_px * shot * DIRECTION)


def _captured(
    scene: str, camera: str, shots: int, size: tuple[int, int], seed: int, step_px: float
):
    """Return Psi, and the frames of shots between which the scene moves."""
    described = find_camera(camera).with_shots(shots)
    psi = build_imaging_matrix(described, size)
    clean = [
        psi.of_shots([shot]).forward(_seen(scene, size, step_px, shot)) for shot in range(shots)
    ]
    return psi, described.read_out(np.maximum(np.concatenate(clean), 0), seed)


@lru_cache(maxsize=1)
def _at_rest(scene: str, camera: str, shots: int, size: tuple[int, int], seed: int) -> dict:
    """Return what is reached without motion, see `measure`."""
    psi, rest = _captured(scene, camera, shots, size, seed, 0.0)
    truth = _seen(scene, size, 0.0, 0)

    def solved(shot: int, film: Film | None = None):
        seen = rest.of_one_deviation().cut(np.s_[shot : shot + 1,])
        return reconstruct("adaptive", psi.of_shots([shot]), seen, film=film)

    last = solved(0, Film())
    alone = last.light_field
    for shot in range(1, shots):
        last = solved(shot, last.film)
    together = reconstruct("adaptive", psi, rest, None, WITHOUT_PATCHES)
    (at_rest, _), cpu_s = lab.timed(reconstruct_judged, "adaptive", psi, rest)
    return {
        "rest_db": psnr_db(at_rest.light_field, truth),
        "alone_db": psnr_db(alone, truth),
        "film_db": psnr_db(last.light_field, truth),
        "together_db": psnr_db(together.light_field, truth),
        "cpu_s": cpu_s,
    }


def measure(
    scene: str, camera: str, shots: int, size: tuple[int, int], seed: int, step_px: float
) -> dict:
    """Return the PSNR of the light field before the first shot.

    moved_db, moved_cpu_s: of shots as they moved, and the time of their reconstruction; moved_px:
    what it states; verdict, inside: whether it is trusted, and its PSNR in the interval stated.
    rest_db, cpu_s: of shots at rest; alone_db: of the first alone; film_db: of the last frame
    of a film of the shots at rest; together_db: of all shots at rest, without patches as in films.
    """
    psi, moved = _captured(scene, camera, shots, size, seed, step_px)
    (result, verdict), cpu_s = lab.timed(reconstruct_judged, "adaptive", psi, moved)
    found_db = psnr_db(result.light_field, _seen(scene, size, step_px, 0))
    low_db, high_db = result.stated["stated_interval_db"] or (np.nan, np.nan)
    return {
        "moved_db": found_db,
        "moved_cpu_s": cpu_s,
        "verdict": verdict.level,
        "moved_px": result.parameters.get("moved_px", np.nan),
        "inside": low_db <= found_db <= high_db,
        **_at_rest(scene, camera, shots, size, seed),
    }


def main() -> None:
    """Measure every scene and motion."""
    parser = lab.arguments(__doc__, camera="rgbw-bayer-3shots", size="96x128")
    parser.add_argument("--shots", type=int, default=3)
    parser.add_argument("--step", action="append", type=float, help=f"default: {STEPS_PX}")
    args = lab.parsed(parser)
    steps = args.step or (STEPS_PX[:1] if args.smallest else STEPS_PX)
    points = lab.points(args, ({"shots": args.shots, "step_px": step} for step in steps))
    # A cached function is pickled by the name of its module, which must not be __main__.
    module = importlib.import_module(Path(__file__).stem)
    rows = lab.measured(points, module.measure, "moving-shots", args)
    rows["loss_db"] = rows.moved_db - rows.rest_db
    axes = rows.pivot_table(index="step_px", columns="scene", values="loss_db").plot()
    axes.set(ylabel="dB over the same at rest")
    lab.finished(rows, axes, "moving-shots", args)


if __name__ == "__main__":
    main()
