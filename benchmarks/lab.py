"""What the scripts of the lab share: their arguments, rows kept in a CSV, one picture."""

from __future__ import annotations

import argparse
import csv
import datetime
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import joblib
import matplotlib
import numpy as np
import pandas as pd
from measured_code import COMMIT, changed_since, commit_of_code, rooms_of

import emmc_rig
from emmc_rig.formats.scenes import Scene

matplotlib.use("Agg")
Result = TypeVar("Result")
RESULTS = Path(__file__).parent.parent / "docs" / "results"
GROUP_A = ("dragons", "dice", "fish", "buttercup", "occlusions", "begonia", "antinous")
GROUP_B = (
    "messerschmitt", "bikes", "isochart", "general11", "lytro1@by-parallax", "lytro2@by-parallax",
)  # fmt: skip
GROUPS = {"A": GROUP_A, "B": GROUP_B, "AB": (*GROUP_A, *GROUP_B)}
"""Real light fields in the folder EMMC_LIGHTFIELDS: tune on A, report on B."""
SMALLEST, QUICKEST = (32, 40), ("tv",)
RUNS = "runs.csv"
"""Of every CSV beside it: when its rows were measured, by which version and command."""
RUN_COLUMNS = "file", "date", "version", "command"


def arguments(
    sentence: str | None,
    scenes: Sequence[str] = ("deep-occlusions",),
    camera: str = "scenario-ii-cfa",
    size: str = "64x80",
    methods: Sequence[str] = (),
) -> argparse.ArgumentParser:
    """Return a parser of what most scripts take; the defaults are a script's own.

    methods: the methods compared where none is given; without it the script takes no `--method`.
    """
    parser = argparse.ArgumentParser(description=sentence)
    parser.add_argument("--scene", action="append", help=f"may repeat; default: {scenes}")
    parser.add_argument("--group", choices=GROUPS, help="real light fields, instead of scenes")
    parser.add_argument("--camera", default=camera)
    parser.add_argument("--size", default=size, help="rows x columns of the middle, or whole")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smallest", action="store_true", help="to see that it runs: seconds")
    if methods:
        parser.add_argument("--method", action="append", help=f"may repeat; default: {methods}")
    parser.set_defaults(scenes=scenes, methods=methods)
    return parser


def parsed(parser: argparse.ArgumentParser, given: Sequence[str] | None = None):
    """Return the arguments, `size` as rows and columns or None, `scenes` and `methods` as chosen.

    `--smallest` is one small scene, and a method that takes no time where methods can be chosen.
    """
    args = parser.parse_args(given)
    if args.methods:
        args.methods = tuple(args.method or (QUICKEST if args.smallest else args.methods))
    sides = args.size.lower().split("x")
    args.size = None if sides == ["whole"] else tuple(map(int, sides))
    if args.group:
        folder = Path(os.environ["EMMC_LIGHTFIELDS"])
        args.scenes = [str(folder / name) for name in GROUPS[args.group]]
    args.scenes = tuple(args.scene or args.scenes)
    if args.smallest:
        args.size, args.scenes = SMALLEST, args.scenes[:1]
    args.out.mkdir(parents=True, exist_ok=True)
    return args


def points(args, choices: Iterable[Mapping]) -> list[dict]:
    """Return each scene with each choice: keywords of a `measure`, beside camera, size and seed."""
    shared, choices = {"camera": args.camera, "size": args.size, "seed": args.seed}, list(choices)
    return [{"scene": scene, **shared, **choice} for scene in args.scenes for choice in choices]


def measured(points: Iterable[dict], measure: Callable[..., dict], name: str, args) -> pd.DataFrame:
    """Return a row for each point: the point's values, those of `measure(**point)`, the commit.

    NAME.unfinished.csv keeps each row, and becomes NAME.csv with the last. A later run skips a row
    if the code that it depends on is still the same, and measures it again otherwise. The run's
    command and date go into RUNS.
    """
    points = list(points)
    args.out.mkdir(parents=True, exist_ok=True)
    path, unfinished = args.out / f"{name}.csv", args.out / f"{name}.unfinished.csv"
    source = unfinished if unfinished.is_file() else path
    kept = pd.read_csv(source, dtype=str) if source.is_file() else pd.DataFrame()
    keys, rooms = list(points[0]), rooms_of(name)
    commit = commit_of_code(rooms)
    wanted = {tuple(map(_text, point.values())) for point in points}
    if not {*keys, COMMIT} <= set(kept.columns):
        kept = pd.DataFrame(columns=[*keys, COMMIT])
    same = [of == commit or not changed_since(of, rooms) for of in kept[COMMIT].fillna("")]
    stays = [s or key not in wanted for s, key in zip(same, _keys(kept, keys), strict=True)]
    kept = kept[np.array(stays, dtype=bool)]
    known = set(_keys(kept, keys))
    missing = [point for point in points if tuple(map(_text, point.values())) not in known]
    rows = joblib.Parallel(n_jobs=args.jobs, return_as="generator")(
        joblib.delayed(_row)(measure, point) for point in missing
    )
    for done, row in enumerate(rows, 1):
        row = {key: _text(value) for key, value in row.items()} | {COMMIT: commit}
        kept = pd.concat([kept, pd.DataFrame([row])])
        kept.to_csv(unfinished, index=False)
        print(f"{done}/{len(missing)}", row, file=sys.stderr)
    if unfinished.is_file():
        unfinished.replace(path)
        note_run(args.out, name)
    chosen = kept[[key in wanted for key in _keys(kept, keys)]]
    return chosen.reset_index(drop=True).apply(_numbers)


def timed(call: Callable[..., Result], *given: Any, **more: Any) -> tuple[Result, float]:
    """Return what a call returns, and its processor seconds."""
    started = time.process_time()
    result = call(*given, **more)
    return result, time.process_time() - started


def part_of(scene: Scene, corner: Sequence[int], size: tuple[int, int]) -> Scene:
    """Return rows x columns of a scene from a corner (y, x), without its disparity."""
    rows, columns = (slice(at, at + side) for at, side in zip(corner, size, strict=True))
    part = np.ascontiguousarray(scene.light_field[:, :, rows, columns])
    return replace(scene, light_field=part, disparity_px=None)


def note_run(folder: Path, name: str, command: str | None = None) -> None:
    """Write into RUNS when, and by which command, NAME.csv of the folder was measured.

    command: the command line that measured it; by default this script's.
    """
    path = folder / RUNS
    known: dict[str, dict[str, str]] = {}
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as opened:
            known = {row["file"]: row for row in csv.DictReader(opened)}
    typed = ["python", f"benchmarks/{Path(sys.argv[0]).name}", *map(_text, sys.argv[1:])]
    known[f"{name}.csv"] = {
        "file": f"{name}.csv",
        "date": datetime.date.today().isoformat(),
        "version": emmc_rig.__version__,
        "command": command or " ".join(typed),
    }
    with path.open("w", newline="", encoding="utf-8") as opened:
        writer = csv.DictWriter(opened, RUN_COLUMNS, lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows(known[file] for file in sorted(known))


def _keys(rows: pd.DataFrame, keys: Sequence[str]) -> list[tuple[str, ...]]:
    return list(rows[keys].fillna("").itertuples(index=False, name=None))


def _row(measure: Callable[..., dict], point: dict) -> dict:
    return {**point, **measure(**point)}


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return "" if value is None else Path(value).name if str(value).startswith("/") else str(value)


def _numbers(column: pd.Series) -> pd.Series:
    numbers = pd.to_numeric(column, errors="coerce")
    return numbers if numbers.notna().sum() == column.replace("", None).notna().sum() else column


def finished(rows: pd.DataFrame, axes, name: str, args) -> None:
    """Print the rows, and save the picture that `axes` belong to as NAME.svg."""
    print(rows.to_string(index=False, float_format="%.3g"))
    axes.figure.tight_layout()
    axes.figure.savefig(args.out / f"{name}.svg")
    print(args.out / f"{name}.csv", args.out / f"{name}.svg")
