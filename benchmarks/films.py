"""Films of light fields against the same frames, each reconstructed alone: accuracy, rest, cost.

A window of a light field rests or slides by fractions of a pixel. A disc of the next light field
passes at another speed and disparity before a window that slides ("passes") or rests ("crosses").
A built-in scene that moves is rendered itself, whatever the motion. The exact light field of every
frame is known.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import cv2
import lab
import numpy as np
from numpy.typing import NDArray

from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.adaptive.film import Film
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.simulators.scenes import MOVING_SCENES, SCENES, render

RESTS, CREEPS, PANS, PASSES, CROSSES = "rests", "creeps", "pans", "passes", "crosses"
PAN_PX = {
    RESTS: (0.0, 0.0), CREEPS: (0.03, 0.1), PANS: (0.45, 1.4), PASSES: (0.2, -0.6),
    CROSSES: (0.0, 0.0),
}  # fmt: skip
"""By how much the window's content moves per frame, along y and x."""
DISC_PX, DISC_DISPARITY, DISC_RADIUS = (-0.3, 1.7), 1.5, 0.28
"""Of the disc: motion per frame, how much nearer it is, radius over the window's rows."""
ROOM_PX = 16
MOVING_HZ = 10
Array = NDArray[np.floating]


def window(whole: Array, size: tuple[int, int], move_px: Array, disparity: float = 0.0) -> Array:
    """Return a window of a light field whose content is moved, and nearer by a disparity."""
    middle = [(length - side) // 2 for length, side in zip(whole.shape[2:4], size, strict=True)]
    steps = np.floor(move_px).astype(int)
    top, left = (start - step - ROOM_PX for start, step in zip(middle, steps, strict=True))
    rows, columns = (side + 2 * ROOM_PX for side in size)
    if min(top, left) < 0 or top + rows > whole.shape[2] or left + columns > whole.shape[3]:
        raise SystemExit(f"the light field is too small for a window of {size} that moves")
    out = np.empty((*whole.shape[:2], *size, 3), dtype=np.float32)
    for v, u in np.ndindex(out.shape[:2]):
        part = np.ascontiguousarray(whole[v, u, top : top + rows, left : left + columns])
        down = move_px[0] - steps[0] + disparity * (v - out.shape[0] // 2)
        right = move_px[1] - steps[1] + disparity * (u - out.shape[1] // 2)
        moved = cv2.warpAffine(
            part, np.array([[1, 0, right], [0, 1, down]]), part.shape[1::-1], flags=cv2.INTER_CUBIC
        )
        out[v, u] = moved[ROOM_PX:-ROOM_PX, ROOM_PX:-ROOM_PX]
    return np.clip(out, 0, 1)


def frame_of(scene: str, other: str, motion: str, size: tuple[int, int], frame: int) -> Array:
    """Return the light field (v, u, y, x, c) before the camera at a frame."""
    if scene in MOVING_SCENES:
        return render(scene, (5, 5), size, time_s=frame / MOVING_HZ).light_field
    whole, move = opened(scene), np.array(PAN_PX[motion]) * frame
    out = window(whole, size, move)
    if motion not in (PASSES, CROSSES):
        return out
    passed = np.array(DISC_PX) * frame
    disc = window(opened(other), size, passed, DISC_DISPARITY)
    rows, columns = np.indices(size, dtype=np.float32)
    radius = DISC_RADIUS * size[0]
    for v, u in np.ndindex(out.shape[:2]):
        seen = DISC_DISPARITY * np.array([v - out.shape[0] // 2, u - out.shape[1] // 2])
        y, x = np.array([0.45, 0.3]) * size + passed + seen
        inside = np.clip(radius - np.hypot(rows - y, columns - x) + 0.5, 0, 1)[..., None]
        out[v, u] = inside * disc[v, u] + (1 - inside) * out[v, u]
    return out


@lru_cache(maxsize=2)
def opened(scene: str) -> Array:
    """Return the whole light field of a scene that stands still."""
    size = (192, 256) if scene in SCENES else None
    return np.asarray(open_scene(scene, size, (5, 5), 0).light_field, dtype=np.float32)


def measure(
    scene: str, other: str, motion: str, camera: str, size: tuple[int, int], seed: int, frames: int
) -> dict:
    """Return means over the frames from the third on; alone: each frame by itself.

    flicker: root mean square change from frame to frame of the light field less the truth; of a
    window that rests, where the truth stays. cost: CPU time of a frame after the first over that of
    a frame alone. inside: share of frames whose PSNR lies in the interval stated; over_db: by how
    much the one stated exceeds it. worst_db: least gain of a frame. still: share of pixels at rest.
    """
    described = find_camera(camera)
    psi = build_imaging_matrix(described, size)
    film, rows, seen = Film(), [], []
    for frame in range(frames):
        truth = frame_of(scene, other, motion, size, frame)
        shown = described.read_out(np.maximum(psi.forward(truth), 0), seed + frame)
        shot = frame % psi.shots
        part = psi.of_shots([shot], psi.camera_json)
        given = part, shown.of_one_deviation().cut(np.s_[shot : shot + 1,])
        (result, _), carried_s = lab.timed(reconstruct_judged, "adaptive", *given, film=film)
        film = result.film
        (alone, _), alone_s = lab.timed(reconstruct_judged, "adaptive", *given)
        both = psnr_db(result.light_field, truth), psnr_db(alone.light_field, truth)
        seen.append((truth, result.light_field, alone.light_field))
        over_db, inside = [], []
        for of, true_db in zip((result, alone), both, strict=True):
            low_db, high_db = of.stated["stated_interval_db"] or (np.nan, np.nan)
            over_db.append(of.stated["stated_db"] - true_db)
            inside.append(low_db <= true_db <= high_db)
        still = result.parameters.get("still_share", 0.0)
        rows.append((*both, carried_s, alone_s, *inside, *over_db, still))
    kept, rests = np.array(rows[2:], dtype=float), PAN_PX[motion] == (0, 0)
    flicker = np.sqrt(np.mean([_changes(*pair, rests) for pair in pairwise(seen[2:])], axis=0))
    return {
        "film_db": kept[:, 0].mean(),
        "alone_db": kept[:, 1].mean(),
        "gain_db": (kept[:, 0] - kept[:, 1]).mean(),
        "worst_db": (kept[:, 0] - kept[:, 1]).min(),
        "flicker": flicker[0] / flicker[1],
        "cost": kept[:, 2].mean() / kept[:, 3].mean(),
        "inside": kept[:, 4].mean(),
        "alone_inside": kept[:, 5].mean(),
        "over_db": kept[:, 6].mean(),
        "alone_over_db": kept[:, 7].mean(),
        "still": kept[:, 8].mean(),
    }


def _changes(before: tuple[Array, ...], after: tuple[Array, ...], rests: bool) -> list[float]:
    """Return the mean square change of each light field less the truth, which comes first."""
    (truth, *first), (next_truth, *second) = before, after
    stays = truth == next_truth if rests else np.ones(truth.shape, dtype=bool)
    return [
        float(np.square((b - next_truth) - (a - truth))[stays].mean())
        for a, b in zip(first, second, strict=True)
    ]


def main() -> None:
    """Measure every scene and motion."""
    parser = lab.arguments(__doc__, size="96x128")
    parser.add_argument("--motion", action="append", choices=tuple(PAN_PX), help="default: all")
    parser.add_argument("--frames", type=int, default=8)
    args = lab.parsed(parser)
    motions = args.motion or (PAN_PX if not args.smallest else [PANS])
    frames = 4 if args.smallest else args.frames
    following = dict(zip(args.scenes, (*args.scenes[1:], args.scenes[0]), strict=True))
    points = lab.points(args, ({"motion": motion, "frames": frames} for motion in motions))
    for point in points:
        point["other"] = following[point["scene"]]
    rows = lab.measured(points, measure, "films", args)
    axes = rows.pivot_table(index="scene", columns="motion", values="gain_db").plot.bar()
    axes.set(ylabel="dB over frames alone")
    lab.finished(rows, axes, "films", args)


if __name__ == "__main__":
    main()
