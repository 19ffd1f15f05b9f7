"""Shots of one capture between which the scene moves, against the same shots of a scene at rest.

Content slides aslant by so many pixels a shot; of a built-in scene that moves, a shot is a frame.
At rest the shots are a film, too: its last frame against all shots of one capture at once.
"""

from __future__ import annotations

import time

import lab
import numpy as np
from films import frame_of, opened, window

from emmc_rig.files.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.lightfield import psnr_db
from reconstruction.adaptive.film import Film
from reconstruction.adaptive.settings import AdaptiveSettings
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.verdict.run import reconstruct_judged
from simulators.scenes import MOVING_SCENES

STEPS_PX = (0.0, 0.3, 1.0, 2.5, 5.0)
"""By which a shot's content moves on from the one before."""
DIRECTION = np.array([0.3, 0.954])
WITHOUT_PATCHES = MethodSettings(adaptive=AdaptiveSettings(patches=None))


def _seen(scene: str, size: tuple[int, int], step_px: float, shot: int) -> np.ndarray:
    """Return the light field before the camera at a shot."""
    if scene in MOVING_SCENES:
        return frame_of(scene, "", "", size, shot if step_px else 0)
    return window(opened(scene), size, step_px * shot * DIRECTION)


def measure(
    scene: str, camera: str, shots: int, size: tuple[int, int], seed: int, step_px: float
) -> dict:
    """Return the PSNR of the first shot's light field, and of a film's last frame at rest.

    rest_db, cpu_s: of shots at rest, and the time of the reconstruction; alone_db: of the first
    shot alone; moved_db, moved_cpu_s: of the shots as they moved; verdict, inside: of the latter,
    and whether its PSNR lies in the interval stated. Of a step of 0: film_db, of the last frame of
    the shots as a film; together_db: of all shots at once without patches, which films do not have.
    """
    described = find_camera(camera).with_shots(shots)
    psi = build_imaging_matrix(described, size)
    truth = _seen(scene, size, step_px, 0)

    def captured(step_px: float):
        clean = [
            psi.of_shots([shot]).forward(_seen(scene, size, step_px, shot)) for shot in range(shots)
        ]
        return described.read_out(np.maximum(np.concatenate(clean), 0), seed)

    def judged(shown):
        started = time.process_time()
        found = reconstruct_judged(
            "adaptive", psi, shown.readings, shown.noise_sigma, usable=shown.usable
        )
        return *found, time.process_time() - started

    rest, moved = captured(0.0), captured(step_px)
    (at_rest, _, cpu_s), (result, verdict, moved_cpu_s) = judged(rest), judged(moved)
    found_db = psnr_db(result.light_field, truth)
    low_db, high_db = result.stated["stated_interval_db"] or (np.nan, np.nan)

    def one(shot: int, film: Film | None = None):
        given = rest.readings[[shot]], rest.noise_sigma, None, None, rest.usable[[shot]]
        return reconstruct("adaptive", psi.of_shots([shot]), *given, film=film)

    out = {
        "rest_db": psnr_db(at_rest.light_field, truth),
        "alone_db": psnr_db(one(0).light_field, truth),
        "moved_db": found_db,
        "cpu_s": cpu_s,
        "moved_cpu_s": moved_cpu_s,
        "verdict": verdict.level,
        "moved_px": result.parameters.get("moved_px", np.nan),
        "inside": low_db <= found_db <= high_db,
        "film_db": np.nan,
        "together_db": np.nan,
    }
    if step_px == 0:
        film = Film()
        for shot in range(shots):
            last = one(shot, film)
            film = last.film
        given = psi, rest.readings, rest.noise_sigma, None, WITHOUT_PATCHES, rest.usable
        together = reconstruct("adaptive", *given)
        out["film_db"] = psnr_db(last.light_field, truth)
        out["together_db"] = psnr_db(together.light_field, truth)
    return out


def main() -> None:
    """Measure every scene and motion."""
    parser = lab.arguments(__doc__, camera="rgbw-bayer-3shots", size="96x128")
    parser.add_argument("--shots", type=int, default=3)
    parser.add_argument("--step", action="append", type=float, help=f"default: {STEPS_PX}")
    args = lab.parsed(parser)
    steps = args.step or ((0.0, 1.0) if args.smallest else STEPS_PX)
    points = [
        {
            "scene": scene, "camera": args.camera, "shots": args.shots, "size": args.size,
            "seed": args.seed, "step_px": step,
        }
        for scene in args.scenes
        for step in steps
    ]  # fmt: skip
    rows = lab.measured(points, measure, "moving-shots", args)
    rows["loss_db"] = rows.moved_db - rows.rest_db
    axes = rows.pivot_table(index="step_px", columns="scene", values="loss_db").plot()
    axes.set(ylabel="dB over the same at rest")
    lab.finished(rows, axes, "moving-shots", args)


if __name__ == "__main__":
    main()
