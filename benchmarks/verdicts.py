"""Verdicts flag what a fault broke and pass what is good: rates over faults of capture and Psi.

A result is broken when it lost more than 3 dB against the same capture without the fault, good when
it lost 1 dB at most. A result is poor when its PSNR without the fault is within 5 dB of the PSNR of
a uniform picture, or 2 dB below another method. The first reason of a flagged result should name
the fault (NAMED).

    python benchmarks/verdicts.py --group A --method adaptive-fast --seed 7 --jobs 2
    python benchmarks/verdicts.py --group A --method adaptive-fast --seed 7 --jobs 2 \\
        --camera rgbw-bayer-1shot

The same of group B, whose scenes set no limit.
"""

from __future__ import annotations

import re

import lab
import numpy as np
import pandas as pd
from matplotlib import pyplot as plt

from emmc_rig.model.errors import ModelError
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.study.points import NotApplicableError
from emmc_rig.study.stability.fault import MASK, SENSOR, SHOTS
from emmc_rig.study.stability.faults import FAULTS, Point
from emmc_rig.study.trial import Capture

NAMED = {
    "mask-shift": "shadow is about|pixels off", "mask-distance-error": "further from",
    "mask-rotation": "turned by|shadow is about", "mask-scale": "cells are|shadow is about",
    "edge-blur": "blurred", "vignetting": "outermost rays", "black-level": "black level",
    "gamma": "to the power of", "jpeg": "compressed",
}  # fmt: skip
JUDGED = "kind", "flagged", "lost_db", "right"
"""Columns of the CSV that follow from the others."""
METHODS = ("tv", "adaptive-fast")
BROKEN_DB, GOOD_DB, POOR_DB, EVEN_DB = 3.0, 1.0, 2.0, 5.0


def measure(
    scene: str, camera: str, size: tuple[int, int], seed: int, method: str, fault: str,
    strength: float,
) -> dict:  # fmt: skip
    """Return PSNR and verdict of a method under a fault; empty where it does not apply."""
    zoom = 3 if Capture(scene, camera).is_built_in else 1
    point = Point(Capture(scene, camera, size, seed, zoom), fault, strength, method)
    try:
        given = point.trial()
        atoms = given.dictionary(method)
        result, verdict = reconstruct_judged(method, given.psi, given.frames, atoms)
    except (NotApplicableError, ReconstructionError, ModelError) as why:
        return {"psnr_db": None, "even_db": None, "level": "", "reasons": str(why)}
    return {
        "psnr_db": given.psnr_db(result.light_field),
        "even_db": given.psnr_db(
            np.broadcast_to(given.truth.mean(axis=(0, 1, 2, 3)), given.truth.shape)
        ),
        "level": verdict.level,
        "reasons": "; ".join(reason.what for reason in verdict.reasons),
    }


def kinds(rows):
    """Return the rows with the columns `kind`, by the loss, and `flagged`, by the verdict."""
    rows = rows.dropna(subset="psnr_db").copy()
    one_trial = ["scene", "camera", "fault", "seed"]
    harmless = {fault.name: f"{fault.quick[0]:g}" for fault in FAULTS.values()}
    first = rows.strength.map("{:g}".format) == rows.fault.map(harmless)
    clean = rows[first].set_index([*one_trial, "method"])[["psnr_db", "even_db"]]
    best = rows[first].groupby(one_trial).psnr_db.max().rename("best_db")
    clean = clean.add_suffix("_clean")
    rows = rows.join(clean, on=[*one_trial, "method"]).join(best, on=one_trial)
    lost = rows.psnr_db_clean - rows.psnr_db
    few = rows.psnr_db_clean < np.maximum(rows.best_db - POOR_DB, rows.even_db_clean + EVEN_DB)
    rows["kind"] = np.select(
        [lost > BROKEN_DB, few, lost <= GOOD_DB], ["broken", "poor", "good"], "between"
    )
    rows["flagged"] = rows.level.isin(["doubt", "do not use"])
    return rows.assign(lost_db=lost).drop(columns=["psnr_db_clean", "even_db_clean", "best_db"])


def first_right(row) -> bool | None:
    """Return whether the first reason names the fault; None of faults without a name."""
    if row.fault not in NAMED:
        return None
    return bool(re.search(NAMED[row.fault], str(row.reasons).split("; ")[0]))


def main() -> None:
    """Measure every fault of capture and Psi on every scene, by every method."""
    parser = lab.arguments(
        __doc__, ("near-planar", "deep-occlusions"), "rgbw-bayer-3shots", methods=METHODS
    )
    parser.add_argument("--fault", action="append", help="may repeat; default: all")
    args = lab.parsed(parser)
    shots = len(Capture(args.scenes[0], args.camera).described.shots)
    faults = [f for f in FAULTS.values() if f.kind in (SENSOR, MASK, SHOTS) and f.shots <= shots]
    faults = [f for f in faults if f.name in (args.fault or FAULTS)]
    choices = [
        {"method": method, "fault": fault.name, "strength": float(strength)}
        for fault in (faults[:1] if args.smallest else faults)
        for strength in fault.quick
        for method in args.methods
    ]
    lab.measured(lab.points(args, choices), measure, "verdicts", args)
    path = args.out / "verdicts.csv"
    # Of all runs into the folder: what is good depends on the other rows of a capture.
    rows = kinds(pd.read_csv(path, usecols=lambda name: name not in JUDGED))
    rows["right"] = [first_right(row) for row in rows.itertuples()]
    rows.to_csv(path, index=False)
    summary = rows.groupby("kind").flagged.agg(["sum", "count"])
    _, axes = plt.subplots()
    (100 * summary["sum"] / summary["count"]).plot.bar(ax=axes, ylabel="flagged, %")
    lab.finished(summary.reset_index(), axes, "verdicts", args)
    wrong = rows[((rows.kind == "broken") & ~rows.flagged) | ((rows.kind == "good") & rows.flagged)]
    right = rows.right[(rows.kind == "broken") & rows.flagged].dropna()
    print(f"first reason right: {int(right.sum())} of {len(right)}")
    print(wrong[["scene", "method", "fault", "strength", "kind", "level", "reasons"]].to_string())


if __name__ == "__main__":
    main()
