"""Type docs/tutorial.md: `python docs/pictures/draw_tutorial.py`, two minutes.

Every command of the page runs in a new folder. What it prints becomes the block below the command,
and its files become the pictures.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

import emmc_rig as emmc
from emmc_rig.model.srgb import srgb_of
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.session import Session
from emmc_rig.store.result_files import read_metrics

PAGE = Path(__file__).parents[1] / "tutorial.md"
STEP = re.compile(r"^```\n(emmc-rig [^\n]*)\n```\n\n```text\n(.*?)^```$", re.M | re.S)
"""A command and the text that it prints."""
FOLDER = "/home/me"
"""In place of the folder of the run."""
LONGEST, INDENT = 120, "    "
"""Of a line of the page; the rest follows, set in."""
OPEN, PINHOLE, SHOT = "open-0-r0", "board-s0-v0-u4-white-r0", "shot-0-e0-r0"
KINDS = {
    "reference": "whiteboard without mask",
    "check": "lamp and response",
    "whiteboard": "whiteboard, one view",
    "open": "whiteboard, whole aperture",
    "held-out": "validation whiteboard",
    "turned": "whiteboard turned",
}
"""Words for the plan's kinds of frames."""
INCH_WIDE, DOTS_PER_INCH = 7.0, 150

Array = NDArray[np.floating]


def printed(text: str, folder: Path) -> str:
    """Return what a command printed in a folder, as the page shows it."""
    shown = text.replace(str(folder), FOLDER)
    lines = [line for line in shown.splitlines() if "first run" not in line]
    return "".join(
        f"{textwrap.fill(line, LONGEST, subsequent_indent=INDENT, break_long_words=False)}\n"
        for line in lines
    )


def _row(titles: tuple[str, ...], values: tuple[Array, ...]) -> tuple[Figure, list[Axes]]:
    """Return a figure with pictures side by side; grey values from 0 to their largest."""
    figure = Figure(figsize=(INCH_WIDE, 4.6 / len(titles) + 0.65), layout="constrained")
    axes = [figure.add_subplot(1, len(titles), number + 1) for number in range(len(titles))]
    for axis, title, picture in zip(axes, titles, values, strict=True):
        axis.set(xticks=[], yticks=[])
        axis.set_title(title, fontsize=10)
        axis.imshow(picture, cmap="gray", vmin=0)
    return figure, axes


def _of_result(folder: Path) -> Figure:
    """Return two opposite views of a result, and its disparity."""
    result = emmc.open_result(folder)
    left, right = (srgb_of(result.light_field[2, u]) for u in (0, 4))
    titles = "view from the left of the lens", "view from the right", "disparity"
    figure, axes = _row(titles, (left, right, np.zeros(left.shape[:2])))
    found = axes[2].imshow(result.maps["disparity"], cmap="viridis")
    figure.colorbar(found, ax=axes[2], label="pixels per view", shrink=0.55)
    return figure


def figures(folder: Path) -> dict[str, Figure]:
    """Return the page's pictures by name; folder: where its commands ran."""
    plan = folder / "emmc-calibration"
    session, counts = Session(plan / "plan-session"), read_metrics(plan)["frames_by_kind"]
    frames = Figure(figsize=(INCH_WIDE, 2.4), layout="constrained")
    axis = frames.add_subplot()
    kinds = np.array([KINDS.get(kind, kind) for kind in counts])
    axis.bar_label(axis.barh(kinds, list(counts.values())), padding=3)
    axis.set(xlabel="frames")
    axis.invert_yaxis()
    axis.spines[["top", "right"]].set_visible(False)

    taken = tuple(
        decode_frame(session.read(name), session.stored[name]).mosaic.astype(np.float32)
        for name in (OPEN, PINHOLE, SHOT)
    )
    captured, _ = _row(("whiteboard, whole aperture", "through one pinhole", "the shot"), taken)

    psi = emmc.Psi.load(session.folder / "calibration" / "psi.h5")
    white = tuple(psi.weights[0][view].sum(axis=1) for view in ((2, 0), (2, 4)))
    titles = "Psi of the view at the left", "at the right", "the same 10 x 10 pixels of both"
    left, right = (view[11:21, 15:25] for view in white)
    gap = np.full((len(left), 1), np.nan)
    calibrated, _ = _row(titles, (*white, np.hstack([left, gap, right])))
    return {
        "demo": _of_result(folder / "emmc-demo"),
        "plan": frames,
        "capture": captured,
        "calibrate": calibrated,
        "reconstruct": _of_result(session.folder / "reconstruction"),
    }


def main() -> None:
    """Run the page's commands, write its blocks of text and its pictures."""
    page = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made).resolve()

        def typed(step: re.Match[str]) -> str:
            print(step[1])
            ended = subprocess.run(
                [Path(sys.executable).with_name("emmc-rig"), *shlex.split(step[1])[1:]],
                cwd=folder, env=os.environ | {"COLUMNS": "120"}, text=True,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            )  # fmt: skip
            if ended.returncode:
                sys.exit(ended.stdout)
            return f"```\n{step[1]}\n```\n\n```text\n{printed(ended.stdout, folder)}```"

        PAGE.write_text(STEP.sub(typed, page), encoding="utf-8")
        for name, figure in figures(folder).items():
            path = Path(__file__).parent / f"tutorial-{name}.webp"
            figure.savefig(path, dpi=DOTS_PER_INCH)


if __name__ == "__main__":
    main()
