"""What a reconstruction states of itself against the truth: PSNR before, deviation after.

The PSNR that a trial on the frames expects of each method (`emmc_rig.study.prospects`) is compared
with that of its reconstruction. Where a method states deviations, the errors within one and two of
them are counted: 68 and 95 % are meant.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emmc_rig.model.frames import Frames
from emmc_rig.pages.page import number
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.guard import cases, key
from emmc_rig.study.prospects import SURE_DB, Prospect, prospects
from emmc_rig.study.trial import Capture, trial_of


@dataclass(frozen=True)
class Stated:
    """A method on a case: what was expected, the true PSNR, and the shares of the errors within one
    and two stated deviations, None of methods that state none."""

    case: Capture
    expected: Prospect
    true_db: float
    within_one: float | None
    within_two: float | None

    @property
    def inside(self) -> bool:
        """Whether the truth lies in the stated interval."""
        return self.expected.low_db <= self.true_db <= self.expected.high_db

    @property
    def off_db(self) -> float:
        """The true PSNR less the expected one."""
        return self.true_db - self.expected.psnr_db

    def as_dict(self) -> dict:
        """Return the figures, for metrics."""
        return {
            "case": key(self.case),
            **asdict(self.expected),
            "true_db": self.true_db,
            "inside": self.inside,
            "within_one": self.within_one,
            "within_two": self.within_two,
        }


def stated(chosen: Iterable[Capture]) -> Iterator[Stated]:
    """Yield every method of the trial on every case; raises what scene, camera and method do."""
    for case in chosen:
        given = trial_of(case)
        frames = Frames(
            given.readings, np.full(given.readings.shape, given.noise_sigma), given.usable
        )
        for expected in prospects(given.psi, frames):
            result = given.solved(expected.method)
            sigma = result.maps.get("sigma")
            shares: list[float | None] = [None, None]
            if sigma is not None:
                error = np.abs(result.light_field - given.truth)
                shares = [float(np.mean(error <= n * sigma[..., None])) for n in (1, 2)]
            yield Stated(case, expected, given.psnr_db(result.light_field), *shares)


def summary(rows: Sequence[Stated]) -> list[str]:
    """Return in words how far the statements held."""
    sure = [row for row in rows if row.expected.is_sure]
    right = [row for row in sure if abs(row.off_db) <= SURE_DB]
    inside = [row for row in rows if row.inside]
    lines = [
        f"{len(inside)} of {len(rows)} true PSNRs lie in their interval",
        f"{len(sure)} were said within {SURE_DB:g} dB, and {len(right)} of them are; of the others "
        "it was said that the frames cannot tell it so closely",
    ]
    for n, word, wanted in ((1, "one", 68), (2, "two", 95)):
        shares = [(row.within_one, row.within_two)[n - 1] for row in rows]
        known = [share for share in shares if share is not None]
        if known:
            lines.append(
                f"within {word} deviation{'s' * (n > 1)}: {np.mean(known):.0%} of the errors on "
                f"average, {min(known):.0%} to {max(known):.0%} ({wanted} % meant)"
            )
    return lines


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Measure stated PSNRs and deviations on fixed captures beside the truth (`chart --stated`)."""
    rows = list(stated(cases(asked.scenes, asked.size, asked.camera)))
    lines, shown = summary(rows), []
    for row in rows:
        expected = row.expected
        interval = f"{expected.low_db:.1f} to {expected.high_db:.1f}"
        shares = [number(one, ".0%") for one in (row.within_one, row.within_two)]
        true = f"{row.true_db:.1f}{'' if row.inside else ' (outside)'}"
        stated_db = f"{expected.psnr_db:.1f} ({interval})"
        shown.append((key(row.case), expected.method, stated_db, true, *shares))
    show.table(("case", "method", "stated dB", "true dB", "within one", "within two"), shown)
    for line in lines:
        show.line(line)
    return {"rows": [row.as_dict() for row in rows], "summary": lines}
