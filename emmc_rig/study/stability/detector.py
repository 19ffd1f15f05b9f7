"""How often verdicts flag broken results and pass good ones, on captures with every fault.

A result is broken when it lost more than 3 dB against that of the same capture without the fault,
good when it lost 1 dB or less. It is poor when it lost 3 dB or less but had little to lose: without
the fault it was within 5 dB of a picture of one even colour, or another method of those measured
was 2 dB better. These and those between may be flagged or not. Rows keep the evidence, from which
verdicts are made anew: changed rules need no new measurement.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from pydantic import Field

from emmc_rig.errors import AppError
from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.errors import ModelError
from emmc_rig.model.files import write_text
from emmc_rig.model.settings import Settings
from emmc_rig.progress import Watcher
from emmc_rig.study.stability.fault_sweep import named_methods
from emmc_rig.study.stability.faults import FAULTS, Point, find_fault
from emmc_rig.study.sweep import Results, Sweep, csv_text, sweep_folder
from emmc_rig.study.trial import MASK, SENSOR, SHOTS, Capture, Fault, Trial
from reconstruction.errors import ReconstructionError
from reconstruction.verdict.evidence import Evidence
from reconstruction.verdict.rules import Verdict, verdict_from
from reconstruction.verdict.run import reconstruct_judged
from simulators.scenes import SCENES

CSV = "verdicts.csv"
NONE, ALL = "none", "all"
BROKEN_DB, GOOD_DB, POOR_DB, EVEN_DB = 3.0, 1.0, 2.0, 5.0
KINDS = (SENSOR, MASK, SHOTS)
"""Of faults that befall a capture: a scene or a design that is hard is no fault of it."""


class DetectorSettings(Settings):
    """What to measure. faults: names; empty takes those of a capture."""

    scenes: tuple[str, ...]
    cameras: tuple[str, ...] = ("rgbw-bayer-1shot", "rgbw-bayer-3shots")
    methods: tuple[str, ...] = ("tv", "adaptive-fast")
    seeds: tuple[int, ...] = (1,)
    faults: tuple[str, ...] = ()
    fast: bool = False
    size: tuple[int, int] = (64, 80)
    zoom: int = Field(default=3, ge=1)


def detector_settings(
    fast: bool,
    scenes: Sequence[str] | None,
    camera: str | None,
    faults: Sequence[str] | None,
    methods: Sequence[str] | None,
    size: tuple[int, int] | None,
    seed: int,
) -> DetectorSettings:
    """Return the settings; what is not given is the default. fast: fewer strengths.

    Raises AppError and ReconstructionError naming the nearest for names that are not known.
    """
    for name in faults or ():
        find_fault(name)
    given = {
        "cameras": (camera,) if camera else (),
        "faults": tuple(faults or ()),
        "methods": named_methods(methods, fast) if methods else (),
        "size": size,
    }
    chosen = {key: value for key, value in given.items() if value}
    return DetectorSettings.model_validate(
        {"fast": fast, "scenes": tuple(scenes or ()) or tuple(SCENES), "seeds": (seed,), **chosen}
    )


def harmless(case: Point) -> Point:
    """Return the same capture without its fault."""
    if case.fault is None:
        return case
    return _case(case, FAULTS[case.fault], FAULTS[case.fault].strengths[0])


def _case(case: Point, fault: Fault, strength: float) -> Point:
    name = None if fault.is_clean(strength) else fault.name
    return replace(case, fault=name, strength=strength)


def cases(settings: DetectorSettings) -> list[Point]:
    """Return the cases; those of one trial together."""
    names = settings.faults or tuple(f.name for f in FAULTS.values() if f.kind in KINDS)
    found = []
    for scene in settings.scenes:
        for camera in settings.cameras:
            for seed in settings.seeds:
                capture = Capture(scene, camera, settings.size, seed, settings.zoom)
                shots = len(capture.described.shots)
                for fault in (FAULTS[name] for name in names):
                    for strength in fault.quick if settings.fast else fault.strengths:
                        for method in settings.methods if fault.shots <= shots else ():
                            case = _case(Point(capture, None, 0.0, method), fault, strength)
                            found += [harmless(case), case]
    return list(dict.fromkeys(found))


@dataclass(frozen=True, eq=False)
class CaseResult:
    """A case with its PSNR, what it lost against its harmless end, and its verdict.

    little_to_lose: whether the harmless end is poor already.
    """

    case: Point
    psnr_db: float
    lost_db: float
    little_to_lose: bool
    verdict: Verdict

    @property
    def kind(self) -> Literal["broken", "good", "between", "poor"]:
        """What it is, whatever the verdict."""
        if self.lost_db > BROKEN_DB:
            return "broken"
        if self.little_to_lose:
            return "poor"
        return "good" if self.lost_db <= GOOD_DB else "between"

    @property
    def wrong(self) -> bool:
        """Whether it is broken and trusted, or good and flagged."""
        trusted = self.verdict.level == "trust"
        return (self.kind == "broken" and trusted) or (self.kind == "good" and self.flagged)

    @property
    def flagged(self) -> bool:
        """Whether the verdict speaks against it."""
        return self.verdict.level in ("doubt", "do not use")


@dataclass
class DetectorSweep(Sweep[Point]):
    """The cases whose verdicts are tested; settings: DetectorSettings."""

    journal = "verdicts.jsonl"
    noun = "cases"
    stage = "judge"
    revision = 4

    def group(self, point: Point) -> Point:
        """Return what all methods of one trial have in common."""
        return replace(point, method="")

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the methods' evidence on one trial."""
        made = points[0].trial()
        for case in points:
            yield judged_row(case.method, made)


def judged_row(method: str, given: Trial) -> dict:
    """Return PSNR and evidence of a method on a trial, or why it refused."""
    dictionary = given.dictionary(method)
    try:
        found, verdict = reconstruct_judged(
            method, given.psi, given.readings, given.noise_sigma, dictionary, None, given.usable
        )
    except (ReconstructionError, ModelError) as fault:
        return {"refused": str(fault)}
    return {
        "psnr_db": given.psnr_db(found.light_field),
        "even_db": given.psnr_db(given.even),
        "evidence": verdict.evidence.as_dict(),
    }


def case_results(rows: Mapping[Point, dict]) -> list[CaseResult]:
    """Return the rows with verdicts by the present rules; those without a result are left out."""
    best: dict[Point, float] = {}
    for case, row in rows.items():
        if "psnr_db" in row:
            any_method = replace(case, method="")
            best[any_method] = max(best.get(any_method, -math.inf), row["psnr_db"])
    found = []
    for case, row in rows.items():
        clean = rows.get(harmless(case), {})
        if "evidence" not in row or "psnr_db" not in clean:
            continue
        level = clean["psnr_db"]
        rival = best[replace(harmless(case), method="")]
        little = level < max(rival - POOR_DB, clean["even_db"] + EVEN_DB)
        verdict = verdict_from(Evidence.from_dict(row["evidence"]))
        found.append(CaseResult(case, row["psnr_db"], level - row["psnr_db"], little, verdict))
    return found


@dataclass(frozen=True)
class Tally:
    """How many results were of each kind, and how many of those were flagged.

    undecided: of all kinds, how many got the verdict *cannot tell*.
    """

    broken: int = 0
    broken_flagged: int = 0
    between: int = 0
    between_flagged: int = 0
    good: int = 0
    good_flagged: int = 0
    poor: int = 0
    poor_flagged: int = 0
    undecided: int = 0

    def pairs(self) -> list[tuple[int, int]]:
        """Return, of broken, good, between and poor, how many were flagged, and how many are."""
        counts = asdict(self)
        return [(counts[f"{k}_flagged"], counts[k]) for k in ("broken", "good", "between", "poor")]

    @property
    def shares(self) -> tuple[float | None, float | None]:
        """Shares of the broken and of the good ones that were flagged; None without any."""
        found, alarms = (flagged / all if all else None for flagged, all in self.pairs()[:2])
        return found, alarms


def tallied(results: Iterable[CaseResult]) -> Tally:
    """Return the counts."""
    counts: Counter[str] = Counter()
    for one in results:
        counts[one.kind] += 1
        counts[f"{one.kind}_flagged"] += one.flagged
        counts["undecided"] += one.verdict.level == "cannot tell"
    return Tally(**counts)


def tables(results: Sequence[CaseResult]) -> dict[tuple[str, str], Tally]:
    """Return the counts by fault and method, then by method, then of all; ALL names the sums."""
    faults = list(dict.fromkeys(one.case.fault or NONE for one in results))
    methods = list(dict.fromkeys(one.case.method for one in results))
    keys = [(fault, method) for fault in faults for method in methods]
    keys += [*((ALL, method) for method in methods), (ALL, ALL)]
    return {
        (fault, method): tallied(
            one
            for one in results
            if fault in (ALL, one.case.fault or NONE) and method in (ALL, one.case.method)
        )
        for fault, method in keys
    }


def wrong(results: Iterable[CaseResult]) -> list[CaseResult]:
    """Return the broken results that were trusted and the good ones that were not."""
    return [one for one in results if one.wrong]


def case_words(one: CaseResult) -> str:
    """Return a result in words."""
    reasons = "; ".join(reason.what for reason in one.verdict.reasons) or "nothing against it"
    return f"{one.case.label}: lost {one.lost_db:.1f} dB, {one.verdict.level} ({reasons})"


def run_detector(settings: DetectorSettings, out: Path, watcher: Watcher) -> list[CaseResult]:
    """Measure all cases; write verdicts.csv and metrics.json beside the rows.

    Raises SweepStopped at Ctrl-C, AppError for a folder that cannot be written, and what the
    layers below do.
    """
    with sweep_folder(out, DetectorSweep.journal, "stability --verdicts") as folder:
        results = case_results(DetectorSweep(settings, folder).run(cases(settings), watcher))
        if not results:
            raise AppError("no case to measure: no fault applies to these scenes and cameras")
        rows = [_csv_row(one) for one in results]
        tallies = {
            f"{fault}, {method}": {
                **asdict(tally),
                **dict(zip(("found", "alarms"), tally.shares, strict=True)),
            }
            for (fault, method), tally in tables(results).items()
        }
        metrics = {
            "results": len(results),
            "tallies": tallies,
            "wrong": [case_words(one) for one in wrong(results)],
            "settings": settings.model_dump(mode="json"),
        }
        with result_folder(folder, "stability --verdicts", adds=True) as new:
            write_text(new / CSV, csv_text(rows, form=".3f", forms={"strength": "g"}))
            write_metrics(new, metrics)
    return results


def _csv_row(one: CaseResult) -> dict[str, object]:
    case = one.case
    return {
        "scene": case.scene_name,
        "camera": case.capture.camera_name,
        "seed": case.capture.seed,
        "method": case.method,
        "fault": case.fault or NONE,
        "strength": float(case.strength),
        "psnr_db": one.psnr_db,
        "lost_db": one.lost_db,
        "kind": one.kind,
        "verdict": one.verdict.level,
        "reasons": " | ".join(reason.what for reason in one.verdict.reasons),
    }
