"""Write docs/results.md, its charts and the README's table from docs/results/*.csv.

    python benchmarks/results_page.py

Every figure of the page is a row of a CSV, or a mean of rows; docs/results/runs.csv says when and
by which command each was measured. Rows whose code has changed since are refused: `--draft` writes
the page for a look. The standard library and git are all that it needs.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import unescape
from math import log
from pathlib import Path
from statistics import linear_regression, mean, median
from typing import Any

import svg_charts
from measured_code import COMMIT, RESULTS, ROOT, stale

GROUP_A = {"antinous", "begonia", "buttercup", "dice", "dragons", "fish", "occlusions"}
BEGIN, END = "<!-- reached: python benchmarks/results_page.py -->", "<!-- /reached -->"
"""Around the README's table."""

Row = Mapping[str, str]


@dataclass(frozen=True)
class Section:
    """A question with its answer in a sentence, charts and a table, from CSV files.

    charts: SVG by name. how: advice for reading the charts. table: head first. line: quantity and
    value of a row in the README's table.
    """

    heading: str
    answer: str
    how: str
    files: tuple[str, ...]
    charts: Mapping[str, str]
    table: Sequence[Sequence[str]] = ()
    line: tuple[str, str] | None = None


def rows_of(name: str) -> list[dict[str, str]]:
    """Return the rows of a CSV of docs/results."""
    with (RESULTS / f"{name}.csv").open(newline="", encoding="utf-8") as opened:
        return list(csv.DictReader(opened))


def number(row: Row, key: str) -> float:
    """Return a figure of a row."""
    return float(row[key])


def where(rows: Iterable[Row], **values: str) -> list[Row]:
    """Return the rows with these values."""
    return [row for row in rows if all(row[key] == value for key, value in values.items())]


def cost_and_psnr(rows: Sequence[Row]) -> tuple[float, float]:
    """Return the means of processor seconds and PSNR in dB."""
    return average(rows, "cpu_seconds"), average(rows, "psnr_db")


def average(rows: Iterable[Row], key: str) -> float:
    """Return the mean of a figure."""
    return mean(number(row, key) for row in rows)


def figures(rows: Iterable[Row], key: str, *names: str) -> dict[Any, float]:
    """Return a figure of each row by a name, or by several as a tuple."""
    return {
        row[names[0]] if len(names) == 1 else tuple(row[name] for name in names): number(row, key)
        for row in rows
    }


def leads(dots: Mapping[str, Sequence[float]], better: str, worse: str) -> list[float]:
    """Return by how much a series exceeds another, in each row."""
    return [a - b for a, b in zip(dots[better], dots[worse], strict=True)]


def percent(share: float) -> str:
    """Return a share as "90 %"."""
    return f"{100 * share:.0f} %"


def share(rows: Sequence[Row], counts: Callable[[Row], bool]) -> str:
    """Return how many of the rows count, as "9 of 10 (90 %)"."""
    found = sum(map(counts, rows))
    return f"{found} of {len(rows)} ({percent(found / len(rows))})"


def whole_frames() -> Section:
    """One shot of whole real light fields."""
    rows = rows_of("full-frames")
    own = {row["scene"]: row for row in where(rows, method="adaptive")}
    psnr_db = figures(rows, "psnr_db", "scene", "method")
    scenes = sorted(own, key=lambda scene: -psnr_db[scene, "adaptive"])
    methods = "tv-dict", "adaptive"
    dots = {
        "baseline: centre view in all places": [number(own[s], "baseline_db") for s in scenes],
        **{method: [psnr_db[scene, method] for scene in scenes] for method in methods},
    }
    lead = mean(leads(dots, "adaptive", "tv-dict"))
    reached = f"{min(dots['adaptive']):.1f} to {max(dots['adaptive']):.1f} dB"
    answer = f"One frame each: adaptive is {lead:.1f} dB above tv-dict"
    table: list[tuple[str, ...]] = [
        ("light field", "size", *(f"`{method}`" for method in methods), "processor seconds")
    ]
    for scene in scenes:
        cells = (f"{psnr_db[scene, method]:.2f} dB" for method in methods)
        size = f"{own[scene]['rows']}x{own[scene]['columns']}"
        table.append((scene, size, *cells, f"{number(own[scene], 'cpu_s'):.0f}"))
    return Section(
        "How good is one shot?",
        f"From one frame of the paper's Bayer camera `adaptive` reaches {reached}, {lead:.1f} dB "
        "above `tv-dict` on average, with noise and without training data.",
        "Right is better; 6 dB halve the error. The grey bar of a light field spans from the "
        "baseline, without parallax, to the best method. Seconds are those of `adaptive`.",
        ("full-frames",),
        {"whole-frames": svg_charts.dots(answer, "PSNR, dB", scenes, dots)},
        table,
        (
            f"PSNR of {len(scenes)} real light fields from one frame each",
            f"{reached}, {lead:.1f} dB above `tv-dict`",
        ),
    )


CAMERAS = {"one shot": "rgbw-bayer-1shot", "three shots": "rgbw-bayer-3shots"}


def speed() -> Section:
    """Accuracy and processor time of every method."""
    rows = where(rows_of("chart-group-b-64x80"), level="default")
    scenes = {row["scene"] for row in rows}
    named: dict[str, dict[str, tuple[float, float]]] = {}
    for shots, camera in CAMERAS.items():
        for method in sorted({row["method"] for row in rows}):
            of = cost_and_psnr(where(rows, camera=camera, method=method))
            named.setdefault(shots, {})[method] = of
    best = named["one shot"]["adaptive"]
    second = max(
        (db, method)
        for method, (_, db) in named["one shot"].items()
        if not method.startswith("adaptive")
    )
    fast = named["one shot"]["adaptive-fast"]
    answer = f"adaptive is {best[1] - second[0]:.1f} dB above the next best method"
    table: list[tuple[str, ...]] = [("method", "one shot", "three shots")]
    for method in sorted(named["one shot"], key=lambda method: -named["one shot"][method][1]):
        cells = (named[shots][method] for shots in CAMERAS)
        table.append((f"`{method}`", *(f"{db:.2f} dB, {cpu_s:.1f} s" for cpu_s, db in cells)))
    return Section(
        "Which method, for how much time?",
        f"`adaptive` leads `{second[1]}` by {best[1] - second[0]:.1f} dB with one shot; "
        f"`adaptive-fast` is {best[1] - fast[1]:.1f} dB below `adaptive`, in "
        f"{percent(fast[0] / best[0])} of the time.",
        f"Up is better, left is faster. Each point is the mean of {len(scenes)} light fields of "
        "group B, cropped to 64x80. Times are CPU seconds.",
        ("chart-group-b-64x80", "chart-group-a-64x80"),
        {"speed": svg_charts.points(answer, ("processor seconds", "PSNR, dB"), named)},
        table,
        (
            f"Mean PSNR of {len(scenes)} light fields not used for tuning, cropped to 64x80",
            f"{best[1]:.1f} dB in {best[0]:.1f} s; next best method, `{second[1]}`: "
            f"{second[0]:.1f} dB",
        ),
    )


def whole_speed() -> Section:
    """Accuracy and processor time of whole frames, and what bounds the accuracy."""
    rows = rows_of("full-frames")
    means = {
        method: {"": (average(of, "cpu_s"), average(of, "psnr_db"))}
        for method in dict.fromkeys(row["method"] for row in rows)
        for of in [where(rows, method=method)]
    }
    scenes = {row["scene"] for row in rows}
    best, fast = means["adaptive"][""], means["adaptive-fast"][""]
    known: dict[str, list[float]] = defaultdict(list)
    for row in rows_of("bounds"):
        known[row["known"]].append(number(row, "psnr_db"))
    table = [("truth given to `adaptive`, 128x128", "PSNR")]
    table += [(words or "nothing", f"{mean(of):.2f} dB") for words, of in known.items()]
    return Section(
        "How long does a whole frame take?",
        f"`adaptive` reaches {best[1]:.1f} dB in {best[0]:.0f} s of processor time, "
        f"`adaptive-fast` {fast[1]:.1f} dB in {fast[0]:.0f} s: means of {len(scenes)} whole light "
        "fields. The colours that the filters do not sample limit the PSNR, hardly the disparity.",
        "Up is better, left is faster. The table lists the PSNR with parts of the true light field "
        "given to the method.",
        ("full-frames", "bounds"),
        {
            "whole-speed": svg_charts.points(
                f"Whole frames: means of {len(scenes)} light fields",
                ("processor seconds", "PSNR, dB"), means,
            )
        },
        table,
    )  # fmt: skip


def shots() -> Section:
    """One, three and six shots of a moved mask."""
    rows = [row for row in rows_of("shots") if row["psnr_db"]]
    counts = sorted({row["shots"] for row in rows}, key=int)
    methods = sorted(
        {row["method"] for row in rows},
        key=lambda method: -average(where(rows, method=method), "psnr_db"),
    )
    named: dict[str, dict[str, tuple[float, float]]] = {}
    table: list[tuple[str, ...]] = [("method", *(f"shots: {count}" for count in counts))]
    for method in methods:
        of = {count: where(rows, method=method, shots=count) for count in counts}
        at = {
            count: (average(some, "cpu_s"), average(some, "psnr_db")) for count, some in of.items()
        }
        named[method] = dict(at)
        table.append((f"`{method}`", *(f"{db:.2f} dB, {cpu_s:.0f} s" for cpu_s, db in at.values())))
    by = figures(rows, "psnr_db", "scene", "method", "shots")
    scenes = sorted({row["scene"] for row in rows})
    over = [by[scene, "adaptive", "3"] - by[scene, "tv-dict", "3"] for scene in scenes]
    first, last = (named["adaptive"][count][1] for count in (counts[0], counts[-1]))
    return Section(
        "What do more shots give?",
        f"With a mask moved between {counts[-1]} shots, `adaptive` gains {last - first:.1f} dB "
        f"over one shot; with three it leads `tv-dict` by {min(over):.1f} to {max(over):.1f} dB.",
        "Up is better, left is faster. The number at each point is that of the shots. A point is "
        f"the mean of {len(scenes)} light fields of group B, cropped to 256x256; the camera is "
        f"`{rows[0]['camera']}`.",
        ("shots",),
        {"more-shots": svg_charts.points(
            f"{counts[-1]} shots gain {last - first:.1f} dB over one",
            ("processor seconds", "PSNR, dB"),
            named,
        )},
        table,
    )  # fmt: skip


def growth() -> Section:
    """Time and memory against the size of the problem."""
    rows = rows_of("growth")
    methods = list(dict.fromkeys(row["method"] for row in rows))
    axes = {
        "pixels": lambda row: samples(row["size"]),
        "views": lambda row: number(row, "views") ** 2,
        "shots": lambda row: number(row, "shots"),
        "disparity range": lambda row: number(row, "zoom"),
    }
    table: list[tuple[str, ...]] = [("grows with", *(f"`{method}`" for method in methods))]
    lines: dict[str, list[tuple[float, float]]] = {}
    for axis, size_of in axes.items():
        cells = []
        for method in methods:
            at = sorted(
                (size_of(row), number(row, "cpu_seconds"))
                for row in where(rows, axis=axis, method=method)
            )
            cells.append(f"{slope(at):.2f}")
            if axis == "pixels":
                lines[method] = at
        table.append((axis, *cells))
    peak = max(number(row, "peak_mib") for row in where(rows, axis="pixels", method="adaptive"))
    return Section(
        "How does the time grow?",
        f"The time of `adaptive` grows with the power {table[1][1 + methods.index('adaptive')]} of "
        f"the pixels; the largest crop takes {peak / 1024:.1f} GiB.",
        "The table lists exponents: 1 doubles the time where the quantity doubles, 0 does not "
        "change it. Lower is better in the chart.",
        ("growth",),
        {
            "growth": svg_charts.lines(
                "Processor time against pixels",
                ("thousand pixels of a view", "processor seconds"), lines,
            )
        },
        table,
    )  # fmt: skip


def slope(line: Sequence[tuple[float, float]]) -> float:
    """Return the exponent of a power law through points (x, y), by least squares of logarithms."""
    return linear_regression(*zip(*((log(x), log(y)) for x, y in line), strict=True)).slope


def peer() -> Section:
    """A camera of others with 8x8 views, which a network of theirs reconstructs."""
    rows = {row["method"]: row for row in rows_of("coded-aperture")}
    own = rows["adaptive"]
    table = [("method", "PSNR", "processor time", "verdict")]
    for method, row in sorted(rows.items(), key=lambda pair: -number(pair[1], "psnr_db")):
        figures = f"{number(row, 'psnr_db'):.2f} dB", f"{number(row, 'cpu_s'):.0f} s"
        table.append((f"`{method}`", *figures, row["verdict"]))
    table.append(("Coded-E2LF, a network trained for it (from its authors)", "27.24 dB", "4 s", ""))
    return Section(
        "How does a trained network with 8x8 views compare?",
        f"Behind three coded apertures with 8x8 grey views, `adaptive` reaches "
        f"{number(own, 'psnr_db'):.1f} dB in {number(own, 'cpu_s'):.0f} s, without training.",
        "256x256 samples of Lego Knights (Stanford archive); the true middle view in all places "
        f"has {number(own, 'baseline_db'):.1f} dB.",
        ("coded-aperture",),
        {},
        table,
    )


def films() -> Section:
    """Films against their frames alone."""
    rows = rows_of("films")
    words = {
        "rests": "at rest", "creeps": "0.1 pixels a frame", "pans": "camera pans",
        "passes": "an object passes",
    }  # fmt: skip
    scenes = sorted({row["scene"] for row in rows})
    gain = figures(rows, "gain_db", "scene", "motion")
    dots = {text: [gain[scene, motion] for scene in scenes] for motion, text in words.items()}
    of = {motion: where(rows, motion=motion) for motion in words}
    pans, rests = (average(of[motion], "gain_db") for motion in ("pans", "rests"))
    cost, flicker = average(rows, "cost"), average(of["rests"], "flicker")
    table: list[tuple[str, ...]] = [
        ("motion", "mean gain", "least gain", "processor time", "flicker", "inside")
    ]
    for motion, text in words.items():
        gains = [number(row, "gain_db") for row in of[motion]]
        shares = (percent(average(of[motion], key)) for key in ("cost", "flicker", "inside"))
        table.append((text, f"{mean(gains):+.2f} dB", f"{min(gains):+.2f} dB", *shares))
    return Section(
        "What does a film gain over its frames?",
        f"{pans:+.1f} dB if the camera pans and {rests:+.1f} dB at rest. A film takes "
        f"{percent(cost)} of the time, and a scene at rest flickers {percent(flicker)} as much.",
        "Right of 0 is better. The gain is the mean PSNR of frames 3 to 8 minus that of the same "
        "frames reconstructed singly. The table lists time and flicker relative to single frames; "
        "inside: share of frames whose true PSNR lies in the stated interval.",
        ("films",),
        {"films": svg_charts.dots("A film against its single frames", "gain, dB", scenes, dots, 0)},
        table,
        ("Gain of a film over its frames reconstructed singly, camera panning", f"{pans:+.1f} dB"),
    )


def moving_shots() -> Section:
    """Shots between which the scene moves, against the same at rest."""
    rows = rows_of("moving-shots")
    steps = sorted({number(row, "step_px") for row in rows})
    scenes = sorted({row["scene"] for row in rows})
    over = {
        (row["scene"], number(row, "step_px")): number(row, "moved_db") - number(row, "rest_db")
        for row in rows
    }
    dots = {f"{step:g} px": [over[scene, step] for scene in scenes] for step in steps}
    loss = mean(over.values())
    table = [("motion per shot", "against rest", "worst", "against one shot", "trusted", "inside")]
    for step in steps:
        of = [row for row in rows if number(row, "step_px") == step]
        own = [over[row["scene"], step] for row in of]
        alone = average(of, "moved_db") - average(of, "alone_db")
        trusted = sum(row["verdict"] == "trust" for row in of)
        inside = sum(row["inside"] == "True" for row in of)
        table.append(
            (
                f"{step:g} px", f"{mean(own):+.2f} dB", f"{min(own):+.2f} dB", f"{alone:+.2f} dB",
                f"{trusted} of {len(of)}", f"{inside} of {len(of)}",
            )
        )  # fmt: skip
    film = {row["scene"]: number(row, "film_db") - number(row, "together_db") for row in rows}
    return Section(
        "Does a capture survive motion between its shots?",
        f"Three shots of a scene that moves by {min(steps):g} to {max(steps):g} pixels per shot "
        f"differ by {loss:+.1f} dB from the scene at rest.",
        f"Right is better. {len(scenes)} light fields slide before the camera, 96x128. At rest, "
        f"the last of three film frames differs by {mean(film.values()):+.1f} dB from three shots "
        "reconstructed together, without patches. Inside: true PSNR within the stated interval.",
        ("moving-shots",),
        {
            "moving-shots": svg_charts.dots(
                "Shots that survive motion", "against rest, dB", scenes, dots, 0
            )
        },
        table,
    )


def noise_and_shots() -> Section:
    """Whether a better capture is ever a worse result."""
    rows = [row for row in rows_of("noise-and-shots") if row["psnr_db"]]
    least = min((row["shots"] for row in rows), key=int)
    middle = next(row["noise"] for row in rows if row["shots"] != least)

    def curves(key: str, kept: Callable[[Row], bool]) -> list[list[tuple[float, float]]]:
        by: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for row in filter(kept, rows):
            by[row["scene"]].append((number(row, key), number(row, "psnr_db")))
        most = max(map(len, by.values()))
        return [sorted(line) for line in by.values() if len(line) == most]

    def averaged(every: list[list[tuple[float, float]]]) -> list[tuple[float, float]]:
        return [(column[0][0], mean(db for _, db in column)) for column in zip(*every, strict=True)]

    noise = curves("noise", lambda row: row["shots"] == least)
    shots = curves("shots", lambda row: row["noise"] == middle)
    gained, more = (abs(line[-1][1] - line[0][1]) for line in (averaged(noise), averaged(shots)))
    falls = max(high - low for line in shots for (_, high), (_, low) in itertools.pairwise(line))
    charts = {
        "noise": svg_charts.lines(
            f"A sixteenth of the noise gains {gained:.1f} dB",
            ("standard deviation of a reading, 1 is white", "PSNR, dB"),
            {f"mean of {len(noise)} light fields": averaged(noise)}, noise, log=True,
        ),
        "shots": svg_charts.lines(
            f"Sixteen shots gain {more:.1f} dB over one",
            ("shots", "PSNR, dB"),
            {f"mean of {len(shots)} light fields": averaged(shots)}, shots, log=True,
        ),
    }  # fmt: skip
    return Section(
        "Do less noise and more shots help?",
        f"Less noise gains up to {gained:.1f} dB on average, sixteen shots gain {more:.1f} dB. One "
        f"scene with wide disparities loses {falls:.1f} dB from one number of shots to the next.",
        "A line should never fall towards less noise (left) or more shots (right). Thin lines are "
        "single light fields, 64x64.",
        ("noise-and-shots",),
        charts,
    )


WITHIN_ONE, ABOUT = 0.6827, 0.08
"""Share of Gaussian errors within one deviation, and the tolerance of a measured share."""


def stated() -> Section:
    """How well the accuracy that a result states holds."""
    trusted = where(rows_of("stated"), verdict="trust")

    def held(row: Row) -> bool:
        return number(row, "low_db") <= number(row, "psnr_db") <= number(row, "high_db")

    def honest(row: Row) -> bool:
        return abs(number(row, "within_one") - WITHIN_ONE) <= ABOUT

    def nine_of_ten(rows: Sequence[Row], stated: str, true: str) -> str:
        apart = sorted(abs(number(row, stated) - number(row, true)) for row in rows)
        return f"{apart[int(0.9 * len(apart))]:.1f} dB"

    table = [(
        "trusted captures", "number", "estimate is right, in 9 of 10, to",
        "truth within interval", "its median width",
        "60 to 76 % of the errors within the deviation", "worst place is right, in 9 of 10, to",
    )]  # fmt: skip
    group_b = [row for row in trusted if row["scene"] not in GROUP_A]
    shots = {"1": ("1shot", "cfa"), "2": ("2shots",), "3": ("3shots",)}
    groups = {
        "group A (sets its constants)": [row for row in trusted if row["scene"] in GROUP_A],
        "group B": group_b,
        **{
            f"group B, shots: {count}": [row for row in group_b if row["camera"].endswith(names)]
            for count, names in shots.items()
        },
    }
    for group, rows in groups.items():
        width = median(number(row, "high_db") - number(row, "low_db") for row in rows)
        table.append((
            group, f"{len(rows)}", nine_of_ten(rows, "stated_db", "psnr_db"), share(rows, held),
            f"{width:.1f} dB", share(rows, honest),
            nine_of_ten(rows, "worst_stated_db", "worst_db"),
        ))  # fmt: skip
    inside = share(group_b, held)
    # A corner whose true views are noisy: no reading shows it.
    noisy = [row for row in group_b if (row["scene"], row["cut"]) == ("messerschmitt", "1")]
    estimates = [number(row, "stated_db") for row in noisy]
    return Section(
        "Can the estimated accuracy be believed?",
        "The interval of the estimated accuracy contains the true PSNR in "
        f"{inside} of the trusted captures excluded from its fit; its median width is "
        f"{table[2][4]}.",
        "The nominal rate is 90 %. The estimate separates good from poor results, but not 30 dB "
        "from 31 dB. The worst place has 24x24 pixels. In a corner of messerschmitt the true views "
        f"are noisy, by {average(noisy, 'psnr_db'):.0f} dB, which no reading shows: the estimate "
        f"there is {min(estimates):.0f} to {max(estimates):.0f} dB.",
        ("stated",),
        {},
        table,
        (
            "Captures with true PSNR inside the interval of the estimated accuracy (nominal: 90 %)",
            inside,
        ),
    )


LOST_DB = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 100.0)


def verdicts() -> Section:
    """Whether results that a fault broke are flagged."""
    rows = [row for row in rows_of("verdicts") if row["kind"] in ("broken", "good", "between")]
    groups = {
        "group A (sets the limits)": [row for row in rows if row["scene"] in GROUP_A],
        "group B": [row for row in rows if row["scene"] not in GROUP_A],
    }

    def flagged(row: Row) -> bool:
        return row["flagged"] == "True"

    faults = len({row["fault"] for row in rows} - {"none"})
    series = {}
    for group, of in groups.items():
        line = []
        for low, high in itertools.pairwise(LOST_DB):
            within = [row for row in of if low <= max(number(row, "lost_db"), 0) < high]
            at = 0.25 if not low else min((low + high) / 2, 8)
            line.append((at, 100 * mean(map(flagged, within))))
        series[group] = line
    table = [("", *groups)]
    counts = {}
    for kind, words in (
        ("broken", "broken (3 dB lost or more), flagged"),
        ("good", "good (1 dB at most), flagged"),
    ):
        counts[kind] = [share(where(of, kind=kind), flagged) for of in groups.values()]
        table.append((words, *counts[kind]))
    named = [
        [row for row in where(of, kind="broken", flagged="True") if row["right"]]
        for of in groups.values()
    ]
    right = [share(of, lambda row: row["right"] == "True") for of in named]
    table.append(("first reason names the fault, of those flagged that have a name", *right))
    return Section(
        "Is a broken result flagged?",
        f"In group B, {counts['broken'][1]} results that lost 3 dB or more to a fault are flagged; "
        f"among good results, {counts['good'][1]} are false alarms. The first reason names the "
        f"fault in {right[1]}.",
        f"{faults} faults in steps, one shot, `adaptive-fast`. The line should be at "
        "0 % on the left, where a fault costs nothing, and at 100 % from 3 dB on. *Doubt* and *do "
        "not use* count as flagged.",
        ("verdicts",),
        {
            "verdicts": svg_charts.lines(
                "The more a fault costs, the surer it is flagged",
                ("dB lost by the fault", "flagged, %"),
                series,
                log=True,
            )
        },
        table,
        (
            "Flagged results among those that lost 3 dB or more to a fault; false alarms",
            "; ".join(of[1] for of in counts.values()),
        ),
    )


def wrong_psi() -> Section:
    """What a moved mask costs, and what fitting Psi to the frames wins back."""
    rows = where(rows_of("mismatch"), error="mask-shift")
    rows.sort(key=lambda row: -number(row, "oracle_db"))
    names = {
        "Psi before the shift": "assumed_db", "Psi fitted to the frames": "mended_db",
        "the true Psi": "oracle_db",
    }  # fmt: skip
    dots = {words: [number(row, key) for row in rows] for words, key in names.items()}
    lost = leads(dots, "the true Psi", "Psi before the shift")
    won = leads(dots, "Psi fitted to the frames", "Psi before the shift")
    answer = "A mask shifted by half a pixel costs every method; the frames correct Psi"
    return Section(
        "What if the mask has moved?",
        f"A shift by half a pixel costs {min(lost):.1f} to {max(lost):.1f} dB; fitting Psi to the "
        f"frames alone recovers {percent(sum(won) / sum(lost))} of this loss.",
        "The grey bar is the loss by the wrong Psi. One scene, 32x40: the order counts, not the "
        "absolute values.",
        ("mismatch",),
        {"wrong-psi": svg_charts.dots(answer, "PSNR, dB", [row["method"] for row in rows], dots)},
    )


FAULTS = {
    "exposure": "electrons at white, fewer than", "read-noise": "read noise, electrons",
    "saturation": "saturated readings, %", "bad-pixels": "bad pixels, not listed, %",
    "masked-pixels": "bad pixels, listed, %", "mask-shift": "mask shift, px",
    "mask-rotation": "mask rotation, degrees", "mask-distance-error": "mask distance, %",
    "mask-scale": "mask scale, %", "edge-blur": "blurred edges, px", "vignetting": "vignetting, %",
    "camera-motion": "camera motion, px a shot",
}  # fmt: skip


def breaking() -> Section:
    """From which strength a fault costs 3 dB."""
    rows = [row for row in rows_of("stability-real-breaking") if row["scene"] != "all scenes"]
    found = rows_of("stability-real")
    table = [("fault", "`adaptive-fast`, median (least, most)", "`tv`, median")]
    charts: dict[str, str] = {}
    for fault, words in FAULTS.items():
        fast, tv = (
            [
                number(row, "below_best_to")
                for row in where(rows, fault=fault, method=method)
                if row["below_best_to"]
            ]
            for method in ("adaptive-fast", "tv")
        )
        least = _plain(f"{median(fast):.2g}")
        most = f"{least} ({min(fast):.2g}, {max(fast):.2g})"
        table.append((words, _plain(most), _plain(f"{median(tv):.2g}")))
        charts[f"fault-{fault}"] = _fault_chart(where(found, fault=fault), words, least)
    shifts = figures(
        where(rows, fault="mask-shift", method="adaptive-fast"), "below_best_to", "scene"
    )
    strict, mild = min(shifts, key=shifts.__getitem__), max(shifts, key=shifts.__getitem__)
    return Section(
        "Which strength of a fault costs 3 dB?",
        f"The strength depends on the scene: a mask shift costs 3 dB from {shifts[strict]:.2g} "
        f"pixels in {strict.split('@')[0]}, and from {shifts[mild]:.2g} pixels in "
        f"{mild.split('@')[0]}.",
        f"The table lists the strengths that cost 3 dB, over {len(shifts)} light fields, 48x64, "
        "three shots, after frame clean-up. Each chart shows a fault: thick lines are means, thin "
        "lines `adaptive-fast` on single light fields.",
        ("stability-real-breaking", "stability-real"), charts, table,
    )  # fmt: skip


def _fault_chart(rows: Sequence[Row], words: str, costly: str) -> str:
    """Return the PSNR by a fault's strength. costly: the strength that costs 3 dB, median."""
    every: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for row in rows:
        place = number(row, "strength"), number(row, "psnr_db")
        every[row["method"], row["scene"]].append(place)
    strengths = {x for line in every.values() for x, _ in line}
    means = {
        name: [
            (x, mean(dict(line)[x] for (method, _), line in every.items() if method == name))
            for x in sorted(strengths)
        ]
        for name in ("adaptive-fast", "tv")
    }
    fault, _, unit = words.rpartition(", ")
    below = unit == "fewer than"
    title = f"{fault.capitalize()}: 3 dB lost {'below' if below else 'from'} {costly}"
    return svg_charts.lines(
        title if below else f"{title} {unit}", (fault if below else words, "PSNR, dB"), means,
        [sorted(line) for (method, _), line in every.items() if method == "adaptive-fast"],
        log=min(strengths) > 0,
    )  # fmt: skip


def _plain(words: str) -> str:
    """Return figures without exponents."""
    return " ".join(
        f"{left}{float(part.strip('(),')):g}{right}" if "e+" in part else part
        for part in words.split(" ")
        for left, right in [("(" if part[0] == "(" else "", part[len(part.rstrip("),")) :])]
    )


def calibration() -> Section:
    """How well Psi is measured."""
    rows = rows_of("calibration_checks")
    by = figures(rows, "measured", "what")
    names = [
        row["what"].split(":")[0] for row in rows if row["what"].endswith(": stated error of Psi")
    ]
    labels = ["ten whiteboards" if name == "few" else name for name in names]
    dots = {
        key: [100 * by[f"{name}: {key} error of Psi"] for name in names]
        for key in ("stated", "true")
    }
    pairs = zip(labels, dots["true"], dots["stated"], strict=True)
    times = {label: true / stated for label, true, stated in pairs}
    asked = next(row for row in rows if row["what"].endswith("true over stated"))
    most = number(asked, "at_most")
    near = sum(ratio <= most for ratio in times.values())
    worst = max(times, key=lambda name: times[name])
    table = [("calibration method", "true error of Psi")]
    for words, what in (
        ("parametric: the mask's position, fitted", "Psi, parametric (dust not modelled)"),
        ("parametric, with the mask's defects", "Psi, mixed"),
        ("free: every coefficient measured", "Psi, free"),
        ("both combined", "Psi, combined"),
    ):
        table.append((words, f"{100 * by[what]:.2f} %"))
    return Section(
        "How well is Psi measured?",
        f"The error of Psi is {100 * by['Psi, combined']:.1f} %, from {by['frames']:.0f} frames of "
        f"a simulated bench with offset, rotation, dust, vignetting and bad pixels. In {near} of "
        f"{len(names)} other sessions the true error is at most {most:g} times the stated error; "
        f"the largest is {times[worst]:.1f} times ({worst}). "
        f"A sensor of {next(row['size'] for row in rows if row['check'] == 'streamed')} pixels "
        f"takes {by['streamed: CPU time, s']:.0f} s and "
        f"{by['streamed: peak memory, GiB']:.2f} GiB.",
        "Each row is a bench with another fault. The stated and the true error of a row should "
        "coincide; the true Psi is integrated ray by ray.",
        ("calibration_checks",),
        {
            "calibration": svg_charts.dots(
                f"The true error of Psi is as stated in {near} of {len(names)} sessions",
                "error of Psi, %", labels, dots, 0
            )
        },
        table,
        (
            "Error of Psi, measured on a simulated bench with ordinary faults",
            f"{100 * by['Psi, combined']:.2f} %",
        ),
    )  # fmt: skip


WORTH_DB = 1.0
"""Gain that a mask of one's own is worth: its maker takes weeks."""


def mask_design() -> Section:
    """What a designed mask gains over the shipped ones."""
    rows = rows_of("design")
    names = [f"{row['sensor']}, {row['shots']} shot{'s' * (row['shots'] != '1')}" for row in rows]
    keys = {"best shipped camera": "shipped_db", "designed": "design_db"}
    dots = {words: [number(row, key) for row in rows] for words, key in keys.items()}
    gains = leads(dots, "designed", "best shipped camera")
    table = [("sensor", "designed mask", "best shipped", "gain")]
    for name, row, gain in zip(names, rows, gains, strict=True):
        table.append((name, row["design"], f"`{row['best_shipped']}`", f"{gain:+.2f} dB"))
    return Section(
        "Which mask to order?",
        ("A mask designed for your bench" if max(gains) > WORTH_DB else "That of a shipped camera")
        + f": designed masks change the accuracy by {min(gains):+.1f} to {max(gains):+.1f} dB "
        "against the best shipped camera of the same sensor and number of shots.",
        "Right is better. Mean of the light fields of group B, 96x96, diffraction included, equal "
        "exposure.",
        ("design",),
        {
            "design": svg_charts.dots(
                f"A designed mask gains {max(gains):.1f} dB at most", "PSNR, dB", names, dots
            )
        },
        table,
    )  # fmt: skip


def learning() -> Section:
    """What a trained network gains."""
    kept = where(rows_of("chart-group-b-64x80"), camera=CAMERAS["one shot"], level="default")
    by = figures(kept, "psnr_db", "scene", "method")
    scenes = sorted({row["scene"] for row in kept}, key=lambda scene: -by[scene, "adaptive"])
    dots = {
        words: [by[scene, method] for scene in scenes]
        for words, method in (
            ("tv", "tv"), ("unrolled, a network", "unrolled"), ("adaptive", "adaptive"),
        )
    }  # fmt: skip
    over = mean(leads(dots, "unrolled, a network", "tv"))
    under = mean(leads(dots, "adaptive", "unrolled, a network"))
    return Section(
        "What does training gain?",
        f"A small network, trained on random worlds, gains {over:.1f} dB over total "
        f"variation and stays {under:.1f} dB below `adaptive`, which needs no training data.",
        "Right is better. Group B, 64x80, one shot. The network is the plug-in "
        "`benchmarks/unrolled_plugin`.",
        ("chart-group-b-64x80",),
        {
            "learning": svg_charts.dots(
                "A small network gains little, the adaptive model much", "PSNR, dB", scenes, dots
            )
        },
    )


def others() -> Section:
    """Captures of cameras that nobody here built."""
    rows = where(rows_of("real_captures"), mask="right")
    by = {
        (row["capture"], row["method"]): number(row, "rms") / number(row, "interpolation_rms")
        for row in rows
    }
    level = {(row["capture"], row["method"]): row["level"] for row in rows}
    captures = sorted({row["capture"] for row in rows})
    cameras = len({capture.split("/")[0] for capture in captures})
    dots = {
        method: [round(by[capture, method], 3) for capture in captures]
        for method in ("tv", "adaptive-fast")
    }
    worse = [key for key, ratio in by.items() if ratio > 1]
    trusted = sum(level[key] == "trust" for key in worse)
    wrong = [
        row
        for row in rows_of("real_captures")
        if row["mask"] not in ("right", "0.9 px softer") and row["level"]
    ]
    refused = share(wrong, lambda row: row["level"] == "do not use")
    table = [("capture", "verdict of `adaptive-fast`", "of `tv`")]
    for capture in captures:
        table.append((capture, level[capture, "adaptive-fast"], level[capture, "tv"]))
    return Section(
        "Does emmc-rig work on captures of other authors?",
        f"{len(captures)} captures of {cameras} cameras: {len(worse)} of {len(by)} results predict "
        f"validation readings worse than interpolation; {trusted or 'none'} of them trusted. "
        f"Masks shifted by some rows or mirrored: {refused} refused.",
        "Left is better: the error of validation readings, divided by that of interpolation, which "
        "uses no camera model. The published mask of tsa is sharper than its shadow, as its "
        "verdict says: [captures of other authors](real-captures.md).",
        ("real_captures",),
        {
            "others": svg_charts.dots(
                "With a right Psi, readings are predicted better than by interpolation",
                "error of validation readings, 1 = interpolation", captures, dots, 1,
            )
        },
        table,
    )  # fmt: skip


def large() -> Section:
    """Whole sensors."""
    rows = rows_of("large")
    table = [("megapixels", "method", "time of one worker", "per sample", "memory per worker")]
    for row in rows:
        seconds = number(row, "seconds")
        table.append(
            (
                row["megapixels"], f"`{row['method']}`", f"{seconds / 60:.0f} min",
                f"{1e3 * seconds / samples(row['size']):.2f} ms",
                f"{number(row, 'peak_gib'):.2f} GiB",
            )
        )  # fmt: skip
    most = max(rows, key=lambda row: number(row, "megapixels"))
    return Section(
        "How large can a light field be?",
        f"{most['megapixels']} megapixels were reconstructed in {most['blocks']} blocks of "
        f"{number(most, 'peak_gib'):.2f} GiB each.",
        "Time and memory grow with the pixels and the range of disparities; "
        "[large captures](scale.md) explains how to distribute them.",
        ("large",),
        {},
        table,
    )


def samples(size: str) -> int:
    """Return the samples of a size such as "64x80" or "(64, 80)"."""
    rows, columns = map(int, re.findall(r"\d+", size))
    return rows * columns


SECTIONS: tuple[Callable[[], Section], ...] = (
    whole_frames, whole_speed, speed, shots, growth, peer, films, moving_shots, noise_and_shots,
    stated, verdicts, wrong_psi, breaking, calibration, mask_design, learning, others, large,
)  # fmt: skip

HEAD = """\
# Results

<!-- Made by `python benchmarks/results_page.py`: change the rows in results/, or that script. -->

Real light fields come in two groups. Settings were tuned on **A**; means are of **B**, which no
setting was tuned on. Whole frames are of both. Accuracy is the {term}`PSNR` of all views, pixels
and colours against the true light field. One command draws the charts from the listed files; each
section ends with the commands that measured them.
"""


def table_text(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; the first row is its head."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def run_text(file: str, runs: Mapping[str, Row]) -> str:
    """Return a link to a CSV, with date, version, commits and command of its measurement."""
    run = runs[f"{file}.csv"]
    commits = sorted({row.get(COMMIT) or "" for row in rows_of(file)} - {""})
    commit = f", commit {', '.join(commits)}" if commits else ""
    return (
        f"[{file}.csv](results/{file}.csv): {run['date']}, version {run['version']}{commit}, "
        f"`{run['command']}`"
    )


def older_text(files: Sequence[str], runs: Mapping[str, Row]) -> str:
    """Return "by version 0.1.0" where the code of a file has changed since, in a draft; else ""."""
    versions = sorted({runs[f"{file}.csv"]["version"] for file in files if stale(file)})
    return f"by version {' and '.join(versions)}" if versions else ""


def sections() -> tuple[list[Section], list[str]]:
    """Return the sections whose rows have been measured, and the CSVs that others lack."""
    found, lacking = [], []
    for make in SECTIONS:
        try:
            found.append(make())
        except FileNotFoundError as error:
            lacking.append(Path(error.filename).stem)
    return found, lacking


def made() -> dict[Path, str]:
    """Return every file that the command writes, and its text."""
    runs = {row["file"]: row for row in rows_of("runs")}
    files: dict[Path, str] = {}
    page, lines = [HEAD], [("what", "reached", "measured by")]
    shown: set[str] = set()
    for section in sections()[0]:
        older = older_text(section.files, runs)
        measured = f" (Measured {older}.)" if older else ""
        page.append(f"## {section.heading}\n\n{section.answer}{measured}\n")
        for name, chart in section.charts.items():
            files[RESULTS / "charts" / f"{name}.svg"] = chart
            says = re.search('aria-label="(.*?)"', chart)
            page.append(f"![{unescape(says[1]) if says else name}](results/charts/{name}.svg)")
        if section.charts:
            page.append("")
        page.append(f"**How to read this.** {section.how}\n")
        if section.table:
            page.append(table_text(section.table) + "\n")
        page += [f"- {run_text(file, runs)}" for file in section.files]
        page.append("")
        shown |= set(section.files)
        if section.line:
            command = runs[f"{section.files[0]}.csv"]["command"].split(" --")[0]
            lines.append((*section.line, ", ".join(filter(None, [f"`{command}`", older]))))
    page.append("## Other runs\n")
    page += [
        f"- {run_text(Path(file).stem, runs)}"
        for file in sorted(runs)
        if Path(file).stem not in shown
    ]
    files[ROOT / "docs" / "results.md"] = "\n".join(page) + "\n"
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    before, rest = readme.split(BEGIN)
    files[ROOT / "README.md"] = f"{before}{BEGIN}\n{table_text(lines)}\n{END}{rest.split(END)[1]}"
    return files


def main() -> None:
    """Write the page, its charts, and the README's table, unless rows are of other code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--draft", action="store_true", help="write it from rows of other code too")
    listed = [Path(row["file"]).stem for row in rows_of("runs")]
    files = dict.fromkeys([*listed, *sections()[1]])
    old = [f"{file}.csv: {why}" for file in files if (why := stale(file))]
    print(*old, sep="\n", file=sys.stderr)
    if not parser.parse_args().draft and old:
        sys.exit("nothing written: `python benchmarks/everything.py` measures these again")
    for path, text in made().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
