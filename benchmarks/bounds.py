"""What bounds `adaptive`: PSNR with the true disparity, colours and hidden surfaces, one at a time.

disparity: matched between the true views (`oracle.py`). colours: every pixel reads all three
colours, as three shots behind filters do, by the mask of one shot. occlusion: what the centre view
does not see is known, so its rays are taken out of Psi and the frames, and put in at the end.
"""

from __future__ import annotations

from dataclasses import replace

import lab
import numpy as np
from oracle import matched_disparity

from emmc_rig.model.frames import even_frames
from emmc_rig.reconstruction.adaptive.method import reconstruct_adaptive
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.adaptive.visibility import carried
from emmc_rig.study.trial import Capture, Trial, trial_of

KNOWN = (
    "", "disparity", "colours", "occlusion", "disparity+colours", "disparity+occlusion",
    "disparity+colours+occlusion",
)  # fmt: skip
COLOURS_OF = {"scenario-ii-cfa": "scenario-i-rgb"}
"""Camera with three colours a pixel, by the camera of the same mask behind a CFA."""


def measure(scene: str, camera: str, size: tuple[int, int], seed: int, known: str) -> dict:
    """Return the PSNR of a scene of which so much is known, and the share of hidden rays."""
    of = known.split("+")
    seen_by = COLOURS_OF[camera] if "colours" in of else camera
    given = trial_of(Capture(scene, seen_by, size, seed))
    disparity = matched_disparity(given.truth)
    margin = int(np.ceil(2 * np.abs(disparity).max())) + 4
    around = np.pad(disparity, margin, mode="edge")
    hidden = carried(around, margin, 1, given.psi.light_field_shape[:4])[1].astype(bool)
    psi, readings = given.psi, given.readings
    if "occlusion" in of:
        psi, readings = _without(given, hidden)
    # Sparse patches would hide the bound of a single shot.
    settings = AdaptiveSettings(patches=None)
    frames = even_frames(readings, given.noise_sigma, given.usable)
    known = disparity if "disparity" in of else None
    light_field = reconstruct_adaptive(psi, frames, settings, disparity=known).light_field
    if "occlusion" in of:
        light_field = np.where(hidden[..., None], given.truth, light_field)
    return {"psnr_db": given.psnr_db(light_field), "hidden": float(hidden.mean())}


def _without(given: Trial, hidden: np.ndarray):
    """Return Psi without hidden rays (v, u, y, x), and the readings without what these add."""
    psi = given.psi
    open_rays = ~hidden[None, :, :, :, None, :]
    dark = replace(psi, weights=np.where(open_rays, psi.weights, 0))
    return dark, (given.readings - (psi.forward(given.truth) - dark.forward(given.truth)))


def main() -> None:
    """Measure every scene with each known."""
    args = lab.parsed(lab.arguments(__doc__, size="128x160"))
    chosen = KNOWN[:4:3] if args.smallest else KNOWN
    points = lab.points(args, ({"known": known} for known in chosen))
    rows = lab.measured(points, measure, "bounds", args)
    table = rows.assign(known=rows.known.replace("", "nothing")).pivot_table(
        "psnr_db", "known", "scene", sort=False
    )
    gained = (table - table.loc["nothing"]).drop("nothing")
    gained["mean"] = gained.mean(axis=1)
    axes = gained["mean"].plot.barh(xlabel="dB that knowing it adds, mean over scenes", ylabel="")
    lab.finished(gained.reset_index(), axes, "bounds", args)


if __name__ == "__main__":
    main()
