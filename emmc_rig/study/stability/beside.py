"""Studies beside the sweeps: theory, numerical stability and the mismatch protocol.

Each part is measured into the sweeps' folder, with their scenes, camera and crop, and becomes
sections of the page, a chart, a CSV file and figures for metrics.json.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from emmc_rig.files.cameras import find_camera
from emmc_rig.files.folders import result_folder
from emmc_rig.model.files import write_text
from emmc_rig.pages.page import Section
from emmc_rig.progress import Watcher
from emmc_rig.study.stability.breaking import below_best, span_words
from emmc_rig.study.stability.checks import BROKEN, WEAK
from emmc_rig.study.stability.fault_points import StabilitySettings
from emmc_rig.study.stability.fault_sweep import StabilitySweep
from emmc_rig.study.stability.mismatch import measure_mismatch
from emmc_rig.study.stability.mismatch_section import mismatch_sections, recovered_share
from emmc_rig.study.stability.numerics import measure_numerics
from emmc_rig.study.stability.numerics_section import numerics_section
from emmc_rig.study.stability.theory import METHODS_COMPARED, measure_theory
from emmc_rig.study.stability.theory_section import (
    BOUND,
    ORACLE,
    Compared,
    agreement,
    compared,
    oracle_offset,
    rank_correlation,
    theory_sections,
)
from emmc_rig.study.sweep import NotApplicableError, csv_text, plain, sweep_folder

DRAWN = "charts"
NOT_PREDICTED = ("sooner", "later", "only", "not measured")


@dataclass(frozen=True, eq=False)
class Beside:
    """sections: of the page. metrics: by part. lines: for the terminal."""

    sections: list[Section]
    metrics: dict[str, object]
    lines: list[str]


def _theory(settings: StabilitySettings, folder: Path, new: Path, watcher: Watcher) -> Beside:
    points = measure_theory(settings, folder, watcher)
    rows = [
        {"scene": one.scene, "fault": one.fault, "strength": one.strength, **one.figures}
        for one in points
    ]
    write_text(new / "theory.csv", csv_text(rows))
    every = compared(points, METHODS_COMPARED)
    mean, root = oracle_offset(every)
    breaks = [_theory_break(one, method) for one in every for method in METHODS_COMPARED]
    agreed = sum(not any(word in one["judged"] for word in NOT_PREDICTED) for one in breaks)
    metrics = {"oracle_less_bound_db": {"mean": mean, "rms": root}, "breaks": breaks}
    line = (
        f"theory: the bound says where a method breaks in {agreed} of {len(breaks)} curves; "
        f"the oracle lies {mean:+.2f} dB from it"
    )
    sections = theory_sections(points, METHODS_COMPARED, new / DRAWN)
    return Beside(sections, {"theory": metrics}, [line])


def _theory_break(one: Compared, method: str) -> dict:
    """Return where bound, oracle and a method break, and whether the bound predicts the method."""

    def break_of(key: str) -> str:
        return span_words(below_best(one.levels[key], one.fault.whole), one.strengths)

    measured = f"{method}_db"
    return {
        "scene": one.scene,
        "fault": one.fault.name,
        "method": method,
        "bound": break_of(BOUND),
        "oracle": break_of(ORACLE),
        "measured": break_of(measured),
        "judged": agreement(one, method),
        "rank_correlation": rank_correlation(one.levels[BOUND], one.levels[measured]),
    }


def _numerics(settings: StabilitySettings, folder: Path, new: Path, watcher: Watcher) -> Beside:
    found = measure_numerics(watcher, settings.fast)
    rows = [asdict(one) for one in found.findings]
    write_text(new / "numerics.csv", csv_text(rows))
    verdicts = [one.verdict for one in found.findings]
    weak, broken = verdicts.count(WEAK), verdicts.count(BROKEN)
    line = f"numerics: {len(rows)} checks, {weak} weak, {broken} broken"
    return Beside([numerics_section(found, new / DRAWN)], {"numerics": rows}, [line])


def _mismatch(settings: StabilitySettings, folder: Path, new: Path, watcher: Watcher) -> Beside:
    try:
        found = measure_mismatch(settings, folder, watcher)
    except NotApplicableError as fault:
        return Beside([], {}, [f"mismatch left out: {fault}"])
    rows = [
        plain({**asdict(one), "recovered": one.recovered, "recovered_of_oracle": one.of_oracle})
        for one in found
    ]
    write_text(new / "mismatch.csv", csv_text(rows))
    share = recovered_share(found, of_oracle=True)
    line = "mismatch: too little is lost to measure a recovered share"
    if share is not None:
        line = f"mismatch: blind correction recovers {share:.0%} of what the true Psi recovers"
    return Beside(mismatch_sections(found, new / DRAWN), {"mismatch": rows}, [line])


PARTS: dict[str, Callable[[StabilitySettings, Path, Path, Watcher], Beside]] = {
    "theory": _theory,
    "numerics": _numerics,
    "mismatch": _mismatch,
}


def measure_beside(
    settings: StabilitySettings, parts: Sequence[str], out: Path, watcher: Watcher
) -> Beside:
    """Return the parts wanted, in the order of PARTS, measured into the folder of the sweeps.

    Raises SweepStopped at Ctrl-C, AppError for wrong input and a folder that cannot be written,
    and the errors of the layers below; points that are done are kept in each case.
    """
    sections, metrics, lines = [], {}, []
    if not parts:
        return Beside(sections, metrics, lines)
    find_camera(settings.camera)  # raises before anything is written
    with (
        sweep_folder(out, StabilitySweep.journal, "stability") as folder,
        result_folder(folder, "stability", adds=True) as new,
    ):
        (new / DRAWN).mkdir()
        for name, measure in PARTS.items():
            if name in parts:
                found = measure(settings, folder, new, watcher)
                sections += found.sections
                metrics |= found.metrics
                lines += found.lines
    return Beside(sections, metrics, lines)
