"""No change made the default method worse: PSNR of fixed captures against docs/results/guard.csv.

Exits with 1 where one falls by more than 0.3 dB; `--store` makes the figures of today those that
count. Built-in scenes are always there, real ones where EMMC_LIGHTFIELDS names their folder.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import lab
import pandas as pd

from emmc_rig.study.trial import Capture, trial_of
from reconstruction.methods import DEFAULT_METHOD

MOST_FALL_DB = 0.3
BUILT_IN = ("near-planar", "deep-occlusions", "wide-disparity")
STORED = lab.RESULTS / "guard.csv"
KEYS = ["scene", "camera", "size", "noise"]


def measure(scene: str, camera: str, size: tuple[int, int], noise: float) -> dict:
    """Return the PSNR of the default method."""
    given = trial_of(Capture(scene, camera, size, noise=noise))
    return {"psnr_db": round(given.psnr_db(given.solved(DEFAULT_METHOD).light_field), 2)}


def main() -> None:
    """Measure the captures, and compare."""
    parser = lab.arguments(__doc__, scenes=BUILT_IN)
    parser.add_argument("--store", action="store_true", help="keep the figures as those to reach")
    args = lab.parsed(parser)
    scenes = dict.fromkeys(args.scenes, args.size)
    folder = os.environ.get("EMMC_LIGHTFIELDS")
    if folder and not args.smallest and not args.scene:
        scenes |= {str(Path(folder) / n): (96, 96) for n in (*lab.GROUP_A, *lab.GROUP_B)}
    points = [
        {"scene": scene, "camera": args.camera, "size": size, "noise": noise}
        for scene, size in scenes.items()
        for noise in (0.0005, 0.004)
    ]
    rows = lab.measured(points, measure, "guard-now", args)
    stored = pd.read_csv(STORED)
    both = rows.merge(stored, on=KEYS, how="left", suffixes=("", "_stored"))
    both["change_db"] = both.psnr_db - both.psnr_db_stored
    lab.finished(both, both.set_index("scene").change_db.plot.barh(), "guard-now", args)
    if args.store:
        kept = pd.concat([stored, rows[[*KEYS, "psnr_db"]]]).drop_duplicates(KEYS, keep="last")
        kept.sort_values(KEYS).to_csv(STORED, index=False)
    elif (both.change_db < -MOST_FALL_DB).any():
        sys.exit("fell: " + ", ".join(both.scene[both.change_db < -MOST_FALL_DB]))


if __name__ == "__main__":
    main()
