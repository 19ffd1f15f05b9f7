"""Measure every figure that the README, docs/results.md and docs/real-captures.md state.

    EMMC_LIGHTFIELDS=FOLDER EMMC_PEER_FILES=FOLDER python benchmarks/everything.py

Each run writes a CSV of docs/results, with the commit in each row. Runs are skipped if their code
has not changed since: the same command goes on where it stopped. It takes hours. Commit first: rows
of uncommitted code have a + after the commit, and the page refuses them. Then
`python benchmarks/results_page.py` writes the page.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

import lab
import numpy as np
import pandas as pd
import yaml
from measured_code import COMMIT, commit_of_code, rooms_of, stale

WORK = Path(lab.RESULTS.parents[1], "emmc-everything")
ONE_SHOT, THREE_SHOTS = "rgbw-bayer-1shot", "rgbw-bayer-3shots"
DESIGNED = {
    ("monochrome", 3): "mono", ("monochrome", 1): "mono",
    ("Bayer", 3): "rggb", ("Bayer", 1): "rggb",
}  # fmt: skip
"""Colour filters of the sensors and shots that a mask is designed for."""
LARGE = (("8", "2448x3264", "3GiB"), ("24", "4000x6000", "4GiB"))
METHOD = "adaptive-fast"
"""Megapixels, size and memory of whole sensors, and their method."""


@dataclass(frozen=True)
class Run:
    """What makes a CSV: a script of the lab with its arguments, or a function of the name.

    alone: the run measures times; nothing else may run beside it.
    """

    name: str
    make: str | Callable[[str], None]
    alone: bool = True


def script(words: str, jobs: int) -> None:
    """Run a script of the lab."""
    asked = [*words.split(), *(("--jobs", str(jobs)) if jobs > 1 else ())]
    subprocess.run([sys.executable, *asked], cwd=lab.RESULTS.parents[1], check=True)


def program(*words: str) -> Path:
    """Run a command of the program into a folder of this commit, and return the folder.

    A command that ended once is not run again.
    """
    digest = hashlib.sha256("\n".join(words).encode()).hexdigest()[:12]
    out = WORK / commit_of_code() / f"{words[0]}-{digest}"
    if not (out / "metrics.json").is_file():
        subprocess.run(["emmc-rig", *words, "--out", out], check=True)
    return out


def scenes(group: str) -> list[str]:
    """Return the real light fields of a group as options."""
    folder = Path(os.environ["EMMC_LIGHTFIELDS"])
    return [word for name in lab.GROUPS[group] for word in ("--scene", str(folder / name))]


def store(name: str, rows: Iterable[dict] | pd.DataFrame, command: str) -> None:
    """Write rows of a command's results as a CSV, with their commit."""
    pd.DataFrame(rows).assign(**{COMMIT: commit_of_code(rooms_of(name))}).to_csv(
        lab.RESULTS / f"{name}.csv", index=False
    )
    lab.note_run(lab.RESULTS, name, command)


def chart(name: str) -> None:
    """Every method on crops of a group, and the plug-ins of the lab where they are installed."""
    asked = "--size", "64x80", "--camera", ONE_SHOT, "--camera", THREE_SHOTS, "--repeats", "3"
    out = program("chart", *asked, *scenes(name.split("-")[2].upper()))
    store(name, pd.read_csv(out / "chart.csv"), f"emmc-rig chart {' '.join(asked)} --scene ...")


def stability(name: str) -> None:
    """Faults on crops of group B, and from which strength on they cost."""
    asked = "--fast", "--size", "48x64", "--method", "tv", "--method", "adaptive-fast"
    out = program("stability", *asked, *scenes("B"))
    file = "breaking.csv" if name.endswith("breaking") else "points.csv"
    store(name, pd.read_csv(out / file), f"emmc-rig stability {' '.join(asked)} --scene ...")


def design(name: str) -> None:
    """The mask designed for each sensor and number of shots, against the shipped cameras."""
    rows = []
    for (sensor, shots), cfa in DESIGNED.items():
        bench = WORK / f"bench-{sensor}-{shots}.yaml"
        bench.parent.mkdir(parents=True, exist_ok=True)
        bench.write_text(yaml.safe_dump({"sensor": {"cfa": cfa}, "shots": shots}), "utf-8")
        out = program("design", str(bench), "--size", "96x96", *scenes("B"))
        found = json.loads((out / "metrics.json").read_text("utf-8"))
        (_, own_db), *shipped = [
            (row["name"], mean(row["psnr_db"].values())) for row in found["simulated"]
        ]
        best, best_db = max(shipped, key=lambda row: row[1])
        rows.append({
            "sensor": sensor, "shots": shots, "design": next(iter(found["manufacturing_db"])),
            "design_db": own_db, "best_shipped": best, "shipped_db": best_db,
        })  # fmt: skip
    store(name, rows, "emmc-rig design BENCH --size 96x96 --scene ...")


def large(name: str) -> None:
    """Whole sensors, in blocks."""
    rows = []
    for megapixels, size, memory in LARGE:
        drawn = "--scene", "deep-occlusions", "--camera", ONE_SHOT, "--size", size, "--zarr"
        frames = program("simulate", *drawn)
        limits = "--workers", "1", "--memory", memory, "--zarr"
        out = program("reconstruct", str(frames), "--method", METHOD, *limits)
        found = json.loads((out / "metrics.json").read_text("utf-8"))
        of = ("seconds", "peak_gib", "program_peak_gib")
        rows.append({
            "megapixels": megapixels, "method": METHOD, "size": size, "memory": memory,
            "blocks": np.prod(found["blocks"]), **{key: found[key] for key in of},
        })  # fmt: skip
    store(name, rows, "emmc-rig reconstruct LARGE --workers 1 --memory MEMORY --zarr")


RUNS = (
    Run("full-frames", "benchmarks/full_frames.py"),
    Run("coded-aperture", "benchmarks/coded_aperture.py"),
    Run("chart-group-a-64x80", chart),
    Run("chart-group-b-64x80", chart),
    Run("growth", "benchmarks/growth.py --largest 512"),
    Run("films", "benchmarks/films.py --group B"),
    Run("shots", "benchmarks/trends.py --name shots --group B --shots 1 --shots 3 --shots 6 "
        "--noise 0.002 --size 256x256 --method adaptive --method adaptive-fast --method tv "
        "--method tv-dict"),
    Run("moving-shots", "benchmarks/moving_shots.py --group B", alone=False),
    Run("noise-and-shots", "benchmarks/trends.py --name noise-and-shots --group AB --size 64x64 "
        "--method adaptive", alone=False),
    Run("bounds", "benchmarks/bounds.py --group A --size 128x128", alone=False),
    Run("stated", "benchmarks/stated.py --group AB --size 96x96", alone=False),
    Run("verdicts", f"benchmarks/verdicts.py --group AB --camera {ONE_SHOT} "
        "--method adaptive-fast --seed 7", alone=False),
    Run("mismatch", "benchmarks/mismatch.py", alone=False),
    Run("depth", "benchmarks/depth.py --group AB --size 96x96", alone=False),
    Run("real_captures", "benchmarks/real_captures.py", alone=False),
    Run("stability-real", stability, alone=False),
    Run("stability-real-breaking", stability, alone=False),
    Run("design", design, alone=False),
    Run("constants", "benchmarks/constants.py --group A --size 64x64", alone=False),
    Run("worst", "benchmarks/worst.py", alone=False),
    Run("calibration_checks", "benchmarks/calibration_checks.py psi hands few effects session cost "
        "drift streamed"),
    Run("large", large),
    Run("crops", "benchmarks/crops.py --group AB"),  # ends with 1 where the mean fell
)  # fmt: skip


def main() -> None:
    """Carry out the runs whose code has changed since; runs that measure times run alone."""
    parser = argparse.ArgumentParser(description="Measure every figure that the pages state.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only these; default: all")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--list", action="store_true", help="list what is to measure, and exit")
    given = parser.parse_args()
    known = [run.name for run in RUNS]
    if wrong := set(given.names) - set(known):
        parser.error(f"no run {', '.join(sorted(wrong))}: use some of {', '.join(known)}")
    for run in (run for run in RUNS if run.name in (given.names or known)):
        why = stale(run.name)
        if given.list:
            print(f"{run.name}: {why or 'of this code'}")
        elif why:
            started = time.monotonic()
            print(f"{run.name}: {why}", file=sys.stderr)
            if callable(run.make):
                run.make(run.name)
            else:
                script(run.make, 1 if run.alone else given.jobs)
            print(f"{run.name}: {(time.monotonic() - started) / 60:.0f} min", file=sys.stderr)


if __name__ == "__main__":
    main()
