"""No change made a method worse on average: PSNR and time of 52 crops, against those committed.

Crops lie at random, so that none is tuned on; `--group AB` names the scenes of EMMC_LIGHTFIELDS.
Exits with 1 where the mean of a method falls by more than 0.03 dB. One crop changes by 0.5 dB by
where patches lie: means count. Committed figures are those of docs/results/crops.csv.
"""

from __future__ import annotations

import sys
from io import StringIO

import lab
import numpy as np
import pandas as pd
from measured_code import git

from emmc_rig.study.trial import Capture, trial_of

MOST_FALL_DB, CROPS = 0.03, 52
METHODS = ("adaptive", "adaptive-fast")
KEYS = ["scene", "camera", "size", "crop", "shots", "method"]


def measure(
    scene: str, camera: str, size: tuple[int, int], crop: int, shots: int | None, method: str
) -> dict:
    """Return PSNR and processor seconds of a method on a crop of a scene."""
    capture = Capture(scene, camera, None, seed=crop, shots=shots)
    whole = capture.scene_seen()
    chance = np.random.default_rng(crop)
    corner = [
        int(chance.integers(0, max(length - side, 0) + 1))
        for length, side in zip(whole.size, size, strict=True)
    ]
    given = trial_of(capture, scene=lab.part_of(whole, corner, size))
    result, cpu_s = lab.timed(given.solved, method)
    return {"psnr_db": round(given.psnr_db(result.light_field), 3), "cpu_s": round(cpu_s, 2)}


def main() -> None:
    """Measure the crops, and compare with those committed."""
    parser = lab.arguments(__doc__, size="128x128", methods=METHODS)
    parser.add_argument("--shots", type=int, help="of the camera (default: its own)")
    parser.add_argument("--crops", type=int, default=CROPS)
    args = lab.parsed(parser)
    committed = git("show", "HEAD:docs/results/crops.csv")
    shared = {"camera": args.camera, "size": args.size, "shots": args.shots}
    points = [
        {"scene": args.scenes[crop % len(args.scenes)], **shared, "crop": crop, "method": method}
        for method in args.methods
        for crop in range(1 if args.smallest else args.crops)
    ]
    rows = lab.measured(points, measure, "crops", args)
    before = pd.read_csv(StringIO(committed)) if committed else rows
    now, before = (some.assign(**some[KEYS].map(str)) for some in (rows, before))
    both = now.merge(before, on=KEYS, how="left", suffixes=("", "_before"))
    both["change_db"] = both.psnr_db - both.psnr_db_before
    both["times"] = both.cpu_s / both.cpu_s_before
    lab.finished(both, both.set_index("scene").change_db.plot.barh(), "crops", args)
    means = both.groupby("method")[["psnr_db", "change_db", "cpu_s", "times"]].mean()
    print(means.to_string(float_format="%.3f"))
    if (means.change_db < -MOST_FALL_DB).any():
        sys.exit(f"fell: {', '.join(means.index[means.change_db < -MOST_FALL_DB])}")


if __name__ == "__main__":
    main()
