"""Each part of `adaptive` buys accuracy: PSNR and seconds without it, beside the whole's.

The last row of each scene is the disparity of the true views in place of the searched one.
"""

from __future__ import annotations

import lab
from oracle import matched_disparity

from emmc_rig.reconstruction.adaptive.method import reconstruct_adaptive
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.study.trial import Capture, trial_of

PARTS = {
    "the whole": {},
    "heavy tails of the evidence": {"freedom": 1000.0},
    "belief propagation": {"jump": 0.999},
    "a second length of textures": {"lengths_px": (3.0,)},
    "plane sweeps with the texture": {"texture": {"sweeps": ()}},
    "sharpening of the disparity": {"texture": {"refine_steps": 0}},
    "stacking of like blocks": {"texture": {"reach": 0}},
    "higher threshold of chrominance": {"texture": {"chroma": 1.0}},
    "momentum": {"texture": {"momentum": 0.0}},
    "a second fit, of less misfit": {"misfits": (0.004,)},
    "disparity (all at 0)": {"furthest_px": 0.01},
}
ORACLE = "search: the true disparity instead"


def measure(scene: str, camera: str, size: tuple[int, int], seed: int, without: str) -> dict:
    """Return PSNR and seconds of a scene without a part."""
    given = trial_of(Capture(scene, camera, size, seed))
    disparity = matched_disparity(given.truth) if without == ORACLE else None
    settings = AdaptiveSettings.model_validate(PARTS.get(without, {}))
    result, cpu_s = lab.timed(
        reconstruct_adaptive, given.psi, given.frames, settings, disparity=disparity
    )
    return {"psnr_db": given.psnr_db(result.light_field), "cpu_s": cpu_s}


def main() -> None:
    """Measure every part on every scene."""
    args = lab.parsed(lab.arguments(__doc__, size="128x160"))
    names = ["the whole", "momentum", ORACLE] if args.smallest else [*PARTS, ORACLE]
    points = lab.points(args, ({"without": name} for name in names))
    rows = lab.measured(points, measure, "ablation", args)
    table = rows.pivot_table("psnr_db", "without", "scene", sort=False)
    lost = (table.loc["the whole"] - table).drop("the whole")
    lost["mean"] = lost.mean(axis=1)
    axes = lost["mean"].plot.barh(xlabel="dB that it buys, mean over scenes", ylabel="")
    lab.finished(lost.reset_index(), axes, "ablation", args)


if __name__ == "__main__":
    main()
