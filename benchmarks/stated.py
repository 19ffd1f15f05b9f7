"""What is stated is true: 68 % of the errors lie within the deviation, the PSNR in its interval.

Two cuts of each scene, by cameras of one, two and three shots, at two noises. `--fit` prints the
constants of `reconstruction.adaptive.uncertainty`: run it on the built-in scenes and on group A
into one folder, and judge by group B.
"""

from __future__ import annotations

import lab
import numpy as np
import pandas as pd

from emmc_rig.formats.scenes import Scene, open_scene
from emmc_rig.reconstruction.adaptive.uncertainty import (
    EVEN_DECIDED,
    FEATURES,
    WITHIN_ONE,
    foretold_db,
)
from emmc_rig.reconstruction.result import PLACE_PX
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.simulators.scenes import STILL_SCENES
from emmc_rig.study.trial import Capture, trial_of

CAMERAS = "rgbw-bayer-1shot", "scenario-ii-cfa", "rgbw-bayer-2shots", "rgbw-bayer-3shots"
NOISES = 0.003, 0.01
LEVEL = 0.9
FITTED = {"error_db": (("apart", "disparity"), 0.1), "deviation_db": (tuple(FEATURES), 0.3)}
"""By which features each is foretold, and the ridge over their variance. With all four, or with
that of parallax, range, noise, shots, misfit and what held-out readings explain, error_db of scenes
not fitted to is foretold no better."""


def measure(
    scene: str, cut: int, camera: str, size: tuple[int, int], seed: int, method: str, noise: float
) -> dict:
    """Return the stated and the true accuracy of a capture, and the features of `foretold_db`.

    cut: 0 the middle of a scene, 1 about the middle of its first quarter; a built-in scene is drawn
    anew instead. error_db, deviation_db: the values that `foretold_db` should return.
    """
    capture = Capture(scene, camera, size, seed + cut, noise=noise)
    given = trial_of(
        capture, scene=None if capture.is_built_in or not cut else _quarter(scene, size)
    )
    result, verdict = reconstruct_judged(method, given.psi, given.frames)
    if "sigma" not in result.maps:
        return {"verdict": verdict.level}
    sigma = result.maps["sigma"].astype(np.float64)[..., None]
    times = np.abs(result.light_field - given.truth) / sigma
    of = {name: result.parameters[f"stated_{name}"] for name in FEATURES}
    factor_db = foretold_db(of)[1]
    psnr_db = given.psnr_db(result.light_field)
    low_db, high_db = result.stated["stated_interval_db"]
    middle, half = result.stated["stated_worst_at"], PLACE_PX // 2
    worst = np.s_[:, :, *(slice(max(at - half, 0), at + half) for at in middle)]
    missed = np.square(result.light_field[worst] - given.truth[worst], dtype=np.float64)
    return {
        "verdict": verdict.level,
        "psnr_db": psnr_db,
        "stated_db": result.stated["stated_db"],
        "low_db": low_db,
        "high_db": high_db,
        "worst_stated_db": result.stated["stated_worst_db"],
        "worst_db": float(-10 * np.log10(missed.mean())),
        "within_one": float(np.mean(times <= 1)),
        "within_two": float(np.mean(times <= 2)),
        "error_db": factor_db - psnr_db - 10 * np.log10(np.mean(np.square(sigma))),
        "deviation_db": factor_db + 20 * np.log10(np.quantile(times, WITHIN_ONE)),
        "decided": result.parameters.get("decided", 1.0),
        **of,
    }


def _quarter(scene: str, size: tuple[int, int]) -> Scene:
    """Return a window about the middle of a scene's first quarter."""
    whole = open_scene(scene)
    corner = [
        int(np.clip(length // 4 - side // 2, 0, length - side))
        for length, side in zip(whole.size, size, strict=True)
    ]
    return lab.part_of(whole, corner, size)


def fitted(rows: pd.DataFrame, column: str) -> pd.Series:
    """Return what features add to a column per unit, and what to begin with, `first`."""
    names, ridge = FITTED[column]
    values, wanted = rows[list(names)].to_numpy(float), rows[column].to_numpy(float)
    mean, scale = values.mean(axis=0), values.std(axis=0)
    scaled = (values - mean) / scale
    gram = scaled.T @ scaled + ridge * len(rows) * np.eye(len(names))
    slopes = np.linalg.solve(gram, scaled.T @ (wanted - wanted.mean())) / scale
    return pd.Series([*slopes, wanted.mean() - slopes @ mean], index=[*names, "first"])


def missed_db(rows: pd.DataFrame, column: str) -> pd.Series:
    """Return by how much a column differs from what the captures of all other scenes foretell."""
    missed = pd.Series(rows[column].to_numpy(float), index=rows.index)
    for _, own in rows.groupby("scene"):
        by = fitted(rows.drop(own.index), column)
        missed[own.index] -= own[by.index[:-1]] @ by[:-1] + by["first"]
    return missed


def _trusted(rows: pd.DataFrame) -> pd.DataFrame:
    stated = (rows.verdict == "trust") & rows[list(FEATURES)].notna().all(axis=1)
    return rows.loc[stated].reset_index(drop=True)


def fit(rows: pd.DataFrame) -> None:
    """Print the constants that trusted captures give."""
    rows = _trusted(rows)
    by = pd.DataFrame({column: fitted(rows, column) for column in FITTED}).fillna(0.0)
    for name in FEATURES:
        error, deviation = by.loc[name]
        low, high = rows[name].min(), rows[name].max()
        print(f'"{name}": Foretold({error:.3f}, {deviation:.3f}, {low:.2f}, {high:.2f}),')
    print("ERROR_DB, DEVIATION_DB = {:.2f}, {:.2f}".format(*by.loc["first"]))
    times = missed_db(rows, "error_db").abs() / (EVEN_DECIDED + 1 - rows.decided)
    print(f"WITHIN_DB = {_quantile_of_scenes(times, rows.scene):.2f}, of {len(rows)}")


def _quantile_of_scenes(values: pd.Series, scenes: pd.Series) -> float:
    """Return what 9 of 10 values of another scene lie below: each scene counts alike, and one more
    is thought to lie above all."""
    count = scenes.nunique()
    shares = 1 / scenes.map(scenes.value_counts()) / (count + 1)
    order = np.argsort(values.to_numpy())
    below = values.to_numpy()[order][shares.to_numpy()[order].cumsum() >= LEVEL]
    return float(below.min(initial=np.inf))


def summary(rows: pd.DataFrame) -> None:
    """Print how true what trusted captures state is."""
    rows = _trusted(rows)
    off, width = rows.stated_db - rows.psnr_db, (rows.high_db - rows.low_db).median()
    held = rows.psnr_db.between(rows.low_db, rows.high_db).mean()
    alike = (rows.within_one - WITHIN_ONE).abs() <= 0.08
    print(f"{len(rows)} trusted captures; stated less true PSNR {off.min():.1f} to {off.max():.1f}")
    print(
        f"dB, rms {np.sqrt(np.square(off).mean()):.2f}, within 1 dB {(off.abs() <= 1).mean():.0%};"
    )
    print(f"in the interval {held:.0%}, its median width {width:.1f} dB;")
    worst = (rows.worst_stated_db - rows.worst_db).abs()
    print(f"the worst place to within {worst.quantile(LEVEL):.1f} dB in nine of ten;")
    print(f"60 to 76 % of the errors within one deviation: {alike.mean():.0%}")


def main() -> None:
    """Measure every scene, and print what is true, or the constants that follow."""
    parser = lab.arguments(__doc__, tuple(STILL_SCENES), camera="", size="96x96")
    parser.add_argument("--method", default="adaptive")
    parser.add_argument("--fit", action="store_true", help="print constants from all rows kept")
    args = lab.parsed(parser)
    choices = [
        {"cut": cut, "camera": camera, "method": args.method, "noise": noise}
        for cut in (0, 1)
        for camera in ([args.camera] if args.camera else CAMERAS)
        for noise in NOISES
    ]
    points = lab.points(args, choices)
    rows = lab.measured(points[:1] if args.smallest else points, measure, "stated", args)
    if args.fit:
        fit(pd.read_csv(args.out / "stated.csv"))
        return
    axes = rows.plot.scatter("psnr_db", "stated_db")
    axes.axline((30, 30), slope=1, color="grey", linewidth=1)
    lab.finished(rows, axes, "stated", args)
    summary(rows)


if __name__ == "__main__":
    main()
