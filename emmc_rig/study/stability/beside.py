"""What stands beside the sweeps: theory, numerical stability and the mismatch protocol.

Each part is measured into the sweeps' folder, with their scenes, camera and crop, and becomes
sections of the page, a chart, a CSV file and figures for metrics.json.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from emmc_rig.files.cameras import find_camera
from emmc_rig.model.files import write_text
from emmc_rig.pages.page import Section
from emmc_rig.progress import Watcher
from emmc_rig.study.points import kept_when_stopped, open_folder
from emmc_rig.study.stability.breaking import below_best, told
from emmc_rig.study.stability.checks import BROKEN, WEAK
from emmc_rig.study.stability.mismatch import (
    METHODS_JUDGED,
    QUICK_METHODS,
    MismatchSettings,
    measure_mismatch,
)
from emmc_rig.study.stability.mismatch_section import mismatch_sections, recovered_share
from emmc_rig.study.stability.numerics import measure_numerics
from emmc_rig.study.stability.numerics_section import numerics_section
from emmc_rig.study.stability.plan import StabilitySettings
from emmc_rig.study.stability.run import POINTS, StabilityStopped
from emmc_rig.study.stability.theory import TheorySettings, measure_theory
from emmc_rig.study.stability.theory_section import (
    BOUND,
    ORACLE,
    compared,
    judged,
    oracle_offset,
    rank_correlation,
    theory_sections,
)
from emmc_rig.study.stability.trial import NotApplicableError

DRAWN = "charts"
DEFAULT_SIZE = (96, 128)
QUICK_PATCHES, QUICK_CONDITIONED = 8, 2


@dataclass(frozen=True, eq=False)
class Beside:
    """sections: of the page. metrics: by part. told: a line each for the terminal."""

    sections: list[Section]
    metrics: dict[str, object]
    told: list[str]


def _theory(settings: StabilitySettings, folder: Path, watcher: Watcher) -> Beside:
    chosen = TheorySettings(
        settings.fast, settings.scenes, settings.camera, settings.size or DEFAULT_SIZE,
        settings.zoom, seed=settings.seed,
    )  # fmt: skip
    if settings.fast:
        chosen = replace(chosen, patches=QUICK_PATCHES, conditioned=QUICK_CONDITIONED)
    points = measure_theory(chosen, folder, watcher)
    rows = [
        {"scene": one.scene, "fault": one.fault, "strength": one.strength, **one.figures}
        for one in points
    ]
    write_text(folder / "theory.csv", _csv(rows))
    every = compared(points, chosen.methods)
    mean, root = oracle_offset(every)
    verdicts = [
        {
            "scene": one.scene,
            "fault": one.fault.name,
            "method": method,
            "bound": told(below_best(one.levels[BOUND], one.fault.whole), one.strengths),
            "oracle": told(below_best(one.levels[ORACLE], one.fault.whole), one.strengths),
            "measured": told(
                below_best(one.levels[f"{method}_db"], one.fault.whole), one.strengths
            ),
            "judged": judged(one, method),
            "rank_correlation": rank_correlation(one.levels[BOUND], one.levels[f"{method}_db"]),
        }
        for one in every
        for method in chosen.methods
    ]
    agreed = sum(not any(w in one["judged"] for w in NOT_PREDICTED) for one in verdicts)
    metrics = {"oracle_less_bound_db": {"mean": mean, "rms": root}, "breaks": verdicts}
    line = (
        f"theory: the bound says where a method breaks in {agreed} of {len(verdicts)} curves; "
        f"the oracle lies {mean:+.2f} dB from it"
    )
    sections = theory_sections(points, chosen.methods, folder / DRAWN)
    return Beside(sections, {"theory": metrics}, [line])


NOT_PREDICTED = ("sooner", "later", "only", "not measured")


def _numerics(settings: StabilitySettings, folder: Path, watcher: Watcher) -> Beside:
    found = measure_numerics(watcher, settings.fast)
    rows = [asdict(one) for one in found.findings]
    write_text(folder / "numerics.csv", _csv(rows))
    verdicts = [one.verdict for one in found.findings]
    weak, broken = verdicts.count(WEAK), verdicts.count(BROKEN)
    line = f"numerics: {len(rows)} checks, {weak} weak, {broken} broken"
    return Beside([numerics_section(found, folder / DRAWN)], {"numerics": rows}, [line])


def _mismatch(settings: StabilitySettings, folder: Path, watcher: Watcher) -> Beside:
    chosen = MismatchSettings(
        settings.fast, settings.scenes, settings.camera, settings.size or DEFAULT_SIZE,
        settings.zoom, QUICK_METHODS if settings.fast else METHODS_JUDGED, settings.seed,
    )  # fmt: skip
    try:
        found = measure_mismatch(chosen, folder, watcher)
    except NotApplicableError as fault:
        return Beside([], {}, [f"mismatch left out: {fault}"])
    rows = [
        {
            **{key: _finite(value) for key, value in asdict(one).items()},
            "recovered": one.recovered,
            "recovered_of_oracle": one.of_oracle,
        }
        for one in found
    ]
    write_text(folder / "mismatch.csv", _csv(rows))
    share = recovered_share(found, of_oracle=True)
    line = "mismatch: next to nothing is lost"
    if share is not None:
        line = f"mismatch: blind mending gives back {share:.0%} of what knowing Psi gives back"
    return Beside(mismatch_sections(found, folder / DRAWN), {"mismatch": rows}, [line])


PARTS: dict[str, Callable[[StabilitySettings, Path, Watcher], Beside]] = {
    "theory": _theory,
    "numerics": _numerics,
    "mismatch": _mismatch,
}


def measure_beside(
    settings: StabilitySettings, parts: Sequence[str], out: Path, watcher: Watcher
) -> Beside:
    """Return the parts wanted, in the order of PARTS, measured into the folder of the sweeps.

    Raises StabilityStopped at Ctrl-C, AppError for wrong input and a folder that cannot be
    written, and the errors of the layers below; points that are done are kept in each case.
    """
    if not parts:
        return Beside([], {}, [])
    find_camera(settings.camera)  # raises before anything is written
    folder = open_folder(out, POINTS, "an earlier sweep")
    sections, metrics, lines = [], {}, []
    with kept_when_stopped(out, folder, StabilityStopped):
        (folder / DRAWN).mkdir(exist_ok=True)
        for name, measure in PARTS.items():
            if name in parts:
                found = measure(settings, folder, watcher)
                sections += found.sections
                metrics |= found.metrics
                lines += found.told
    return Beside(sections, metrics, lines)


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _csv(rows: Sequence[Mapping[str, object]]) -> str:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
