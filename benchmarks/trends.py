"""A better capture never costs accuracy: PSNR against noise and shots, beside other methods."""

from __future__ import annotations

import lab
import matplotlib.pyplot as plt

from emmc_rig.study.points import NotApplicableError
from emmc_rig.study.trial import Capture, trial_of

NOISES, SHOTS, NOISE = (0.008, 0.004, 0.002, 0.001, 0.0005), (1, 2, 3, 6, 16), 0.004
METHODS = ("adaptive", "tv", "tv-dict")


def measure(
    scene: str, camera: str, size: tuple[int, int], seed: int, method: str, shots: int, noise: float
) -> dict:
    """Return the PSNR of a method on a scene; empty where the camera takes no such shots."""
    try:
        given = trial_of(Capture(scene, camera, size, seed, shots=shots, noise=noise))
    except NotApplicableError:
        return {"psnr_db": None}
    return {"psnr_db": given.psnr_db(given.solved(method).light_field)}


def fall_db(better_and_better) -> float:
    """Return by how much the PSNR falls at most to any better capture; 0: it always rises."""
    levels = list(better_and_better)
    return max([a - b for i, a in enumerate(levels) for b in levels[i + 1 :]] + [0.0])


def main() -> None:
    """Measure every scene, noise, number of shots and method."""
    args = lab.parsed(lab.arguments(__doc__, size="64x64"))
    captures = [(1, noise) for noise in NOISES] + [(shots, NOISE) for shots in SHOTS]
    if args.smallest:
        captures = [(1, 0.004), (1, 0.001)]
    points = [
        {
            "scene": scene, "camera": args.camera, "size": args.size, "seed": args.seed,
            "method": method, "shots": shots, "noise": noise,
        }
        for scene in args.scenes
        for method in METHODS[: 1 if args.smallest else None]
        for shots, noise in dict.fromkeys(captures)
        if method == METHODS[0] or shots <= 6
    ]  # fmt: skip
    rows = lab.measured(points, measure, "trends", args).dropna(subset="psnr_db")
    _, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5))
    falls = []
    for (scene, method), some in rows.groupby(["scene", "method"]):
        by_noise = some[some.shots == 1].sort_values("noise", ascending=False)
        by_shots = some[some.noise == NOISE].sort_values("shots")
        left.semilogx(by_noise.noise, by_noise.psnr_db, "-o", label=f"{scene}, {method}")
        right.plot(by_shots.shots, by_shots.psnr_db, "-o")
        falls.append((scene, method, fall_db(by_noise.psnr_db), fall_db(by_shots.psnr_db)))
    left.set(xlabel="noise", ylabel="dB")
    right.set(xlabel="shots")
    left.legend(fontsize=6)
    columns = ["scene", "method", "falls with less noise", "falls with more shots"]
    lab.finished(lab.pd.DataFrame(falls, columns=columns), left, "trends", args)


if __name__ == "__main__":
    main()
