"""A better capture never costs accuracy: PSNR against noise and shots, beside other methods.

Noises are deviations of readings, 0.008 to 0.0005: those of brightness 0.25 where a reading of 1 is
worth 4,000 to 10^6 electrons. Every noise is measured with the fewest shots, and every number of
shots at the middle noise.
"""

from __future__ import annotations

import lab
import matplotlib.pyplot as plt
import pandas as pd

from emmc_rig.study.points import NotApplicableError
from emmc_rig.study.trial import Capture, trial_of

NOISES, SHOTS = (0.008, 0.004, 0.002, 0.001, 0.0005), (1, 2, 3, 6, 16)
METHODS = ("adaptive", "tv", "tv-dict")


def measure(
    scene: str, camera: str, size: tuple[int, int], seed: int, method: str, shots: int, noise: float
) -> dict:
    """Return PSNR and processor seconds; empty where the camera takes no such shots."""
    try:
        given = trial_of(Capture(scene, camera, size, seed, shots=shots, noise=noise))
    except NotApplicableError:
        return {"psnr_db": None, "cpu_s": None}
    given.dictionary(method, None)
    result, cpu_s = lab.timed(given.solved, method)
    return {"psnr_db": given.psnr_db(result.light_field), "cpu_s": cpu_s}


def fall_db(better_and_better) -> float:
    """Return by how much the PSNR falls at most to any better capture; 0: it always rises."""
    levels = list(better_and_better)
    return max([a - b for i, a in enumerate(levels) for b in levels[i + 1 :]] + [0.0])


def falls(rows):
    """Return for each scene and method how much less noise and more shots cost at most, in dB.

    Of `adaptive` also by how much the best other method is ahead at most: behind_db.
    """
    found = []
    for (scene, method), some in rows.groupby(["scene", "method"]):
        table = some.pivot_table(index="shots", columns="noise", values="psnr_db").sort_index()
        less = table[sorted(table.columns, reverse=True)]
        found.append(
            {
                "scene": scene,
                "method": method,
                "less_noise_db": max(fall_db(line.dropna()) for _, line in less.iterrows()),
                "more_shots_db": max(fall_db(line.dropna()) for _, line in table.items()),
            }
        )
    table = rows.pivot_table(index=["scene", "shots", "noise"], columns="method", values="psnr_db")
    found = pd.DataFrame(found)
    if METHODS[0] in table:
        others = table.drop(columns=METHODS[0])
        behind = (others.max(axis=1) - table[METHODS[0]]).groupby("scene").max()
        found["behind_db"] = found.scene.map(behind).where(found.method == METHODS[0])
    return found


def main() -> None:
    """Measure every scene, noise, number of shots and method."""
    parser = lab.arguments(__doc__, size="64x80", methods=METHODS)
    parser.add_argument("--shots", type=int, action="append", help=f"may repeat; default: {SHOTS}")
    parser.add_argument("--noise", type=float, action="append", help=f"default: {NOISES}")
    parser.add_argument("--name", default="trends", help="of the CSV")
    args = lab.parsed(parser)
    shots, noises = args.shots or SHOTS, args.noise or NOISES
    captures = [(min(shots), noise) for noise in noises]
    captures += [(count, noises[len(noises) // 2]) for count in shots if count != min(shots)]
    if args.smallest:
        captures = [(1, 0.004), (1, 0.001)]
    choices = [
        {"method": method, "shots": shots, "noise": noise}
        for shots, noise in captures
        for method in args.methods
    ]
    rows = lab.measured(lab.points(args, choices), measure, args.name, args)
    rows = rows.dropna(subset="psnr_db")
    _, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5))
    for (scene, method), some in rows.groupby(["scene", "method"]):
        by_noise = some[some.shots == some.shots.min()].sort_values("noise")
        by_shots = some[some.noise == some.noise.min()].sort_values("shots")
        left.semilogx(by_noise.noise, by_noise.psnr_db, "-o", label=f"{scene}, {method}")
        right.plot(by_shots.shots, by_shots.psnr_db, "-o")
    left.set(xlabel="noise", ylabel="dB")
    right.set(xlabel="shots")
    left.legend(fontsize=6)
    lab.finished(falls(rows), left, args.name, args)


if __name__ == "__main__":
    main()
