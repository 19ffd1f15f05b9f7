"""No perturbation as small as the noise harms a method much more than noise does.

A method is a black box f, so its Jacobian J is seen by finite differences alone: J z = f(y + s z) -
f(y), s the noise's deviation. The picture is cut into tiles, and every tile looks for its own worst
direction at once: in each round it draws directions beside its best so far and takes, of their
span, the one whose change in the tile is largest (Rayleigh-Ritz; Saad 2011, Numerical Methods for
Large Eigenvalue Problems, section 5.2). Last, every tile takes the sign that errs more. What is
found is a lower bound of the worst there is.
"""

from __future__ import annotations

import lab
import numpy as np

from emmc_rig.model.frames import even_frames
from emmc_rig.reconstruction.methods import installed_methods, reconstruct
from emmc_rig.study.trial import Capture, trial_of

TILE_PX, DIRECTIONS, ROUNDS = 8, 6, 2


def tiles(size: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """Return rows and columns of the tiles of a picture; the last ones may be smaller."""
    starts = [range(0, length, TILE_PX) for length in size]
    return [(slice(y, y + TILE_PX), slice(x, x + TILE_PX)) for y in starts[0] for x in starts[1]]


def normed(direction, every):
    """Return a direction whose norm in every tile is the root of its count of readings."""
    result = np.array(direction, dtype=np.float64)
    for tile in every:
        part = result[:, *tile]
        part *= part.size**0.5 / max(float(np.linalg.norm(part)), 1e-12)
    return result


def leading(directions, changes, every):
    """Return, tile by tile, the sum of directions that changes the tile most for its norm."""
    result = np.empty_like(directions[0])
    for tile in every:
        across = np.stack([direction[:, *tile].ravel() for direction in directions])
        moved = np.stack([change[:, :, *tile].ravel() for change in changes]).astype(np.float64)
        basis, mix = np.linalg.qr(across.T)
        # A direction is a sum of the basis, mix says which; a change is that of their changes.
        turned = np.linalg.solve(mix.T + 1e-9 * np.eye(len(mix)), moved)
        best = np.linalg.eigh(turned @ turned.T)[1][:, -1]
        result[:, *tile] = (basis @ best).reshape(result[:, *tile].shape)
    return result


def worst_direction(solve, readings, deviation, truth, rng, rounds: int):
    """Return the direction (shot, y, x) that harms most; it has the norm expected of noise."""
    base, every = solve(readings), tiles(readings.shape[1:])
    best = normed(rng.standard_normal(readings.shape), every)
    for _ in range(rounds):
        drawn = [rng.standard_normal(readings.shape) for _ in range(DIRECTIONS)]
        directions = [best, *(normed(direction, every) for direction in drawn)]
        changes = [solve(readings + deviation * z) - base for z in directions]
        best = normed(leading(directions, changes, every), every)
    errors = [np.square(solve(readings + sign * deviation * best) - truth) for sign in (1, -1)]
    for tile in every:
        if errors[1][:, :, *tile].sum() > errors[0][:, :, *tile].sum():
            best[:, *tile] *= -1
    return best


def measure(
    scene: str, camera: str, size: tuple[int, int], seed: int, method: str, rounds: int
) -> dict:
    """Return a method's PSNR under noise, and under the worst perturbation of its size."""
    trial = trial_of(Capture(scene, camera, size, seed))
    dictionary, clean = trial.dictionary(method), trial.psi.forward(trial.truth)
    deviation = max(trial.noise_sigma, 1e-9)

    def solve(readings):
        frames = readings.astype(np.float32)
        return reconstruct(
            method, trial.psi, even_frames(frames, deviation, trial.usable), dictionary
        ).light_field

    rng = np.random.default_rng(seed)
    noise = normed(rng.standard_normal(clean.shape), tiles(clean.shape[1:]))
    worst = worst_direction(solve, clean, deviation, trial.truth, rng, rounds)
    noise_db, worst_db = (
        trial.psnr_db(solve(clean + deviation * direction)) for direction in (noise, worst)
    )
    return {"noise_db": noise_db, "worst_db": worst_db, "lost_db": noise_db - worst_db}


def main() -> None:
    """Measure every method on every scene."""
    methods = installed_methods()
    args = lab.parsed(
        lab.arguments(__doc__, camera="rgbw-bayer-3shots", size="24x32", methods=methods)
    )
    rounds = 1 if args.smallest else ROUNDS
    points = lab.points(args, ({"method": method, "rounds": rounds} for method in args.methods))
    rows = lab.measured(points, measure, "worst", args)
    axes = rows.groupby("method").lost_db.max().plot.barh(xlabel="dB lost to the worst direction")
    lab.finished(rows, axes, "worst", args)


if __name__ == "__main__":
    main()
