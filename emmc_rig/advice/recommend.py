"""Which method to take for a time budget or a wanted PSNR, by a trial on the frames at hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from emmc_rig.advice.trial import Prospect, prospects
from emmc_rig.files.results import parse_psnr, parse_seconds
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix


@dataclass(frozen=True)
class Advice:
    """The method to take, and why, in words."""

    method: str
    why: str


def parse_wanted(text: str) -> float:
    """Return the dB of "28dB" or "28"; raise WrongUsageError for anything else."""
    return parse_psnr(text, "--want")


def advice_for(psi: ImagingMatrix, frames: Frames, budget: str | None, want: str | None) -> Advice:
    """Return the method to take for these frames.

    budget, want: as typed, such as "30s" and "28dB". Raises WrongUsageError for what cannot be
    read, ReconstructionError for frames that do not fit Psi.
    """
    budget_s = parse_seconds(budget, "--budget")
    wanted_db = None if want is None else parse_wanted(want)
    return advised(prospects(psi, frames), budget_s, wanted_db)


def advised(
    expected: Sequence[Prospect], budget_s: float | None = None, wanted_db: float | None = None
) -> Advice:
    """Return the most accurate method within the budget, or the quickest that is good enough.

    expected: at least one method. Both limits: the quickest that surely reaches the PSNR within the
    budget, else the most accurate within it. Where nothing keeps to the budget, the quickest.
    """
    quickest_first = sorted(expected, key=lambda one: one.seconds)
    within = [one for one in quickest_first if budget_s is None or one.seconds <= budget_s]
    good = [one for one in within if wanted_db is not None and one.low_db >= wanted_db]
    if good and wanted_db is not None:
        return _advice(good[0], f"the quickest that surely reaches {wanted_db:g} dB")
    if not within:
        return _advice(quickest_first[0], f"the quickest: nothing keeps to {budget_s:g} s")
    best = max(within, key=lambda one: one.psnr_db)
    reason = "the most accurate" + ("" if budget_s is None else f" within {budget_s:g} s")
    if wanted_db is not None and best.high_db >= wanted_db:
        reason += f"; the frames cannot tell whether it reaches {wanted_db:g} dB"
    elif wanted_db is not None:
        reason += f"; nothing {'' if budget_s is None else 'in time '}reaches {wanted_db:g} dB"
    return _advice(best, reason)


def _advice(one: Prospect, reason: str) -> Advice:
    if one.low_db == 0:
        stated = "the frames are too few to say its PSNR"
    elif one.is_sure:
        stated = f"about {one.psnr_db:.1f} dB"
    else:
        stated = f"{one.low_db:.0f} to {one.high_db:.0f} dB, the frames cannot tell it closer"
    return Advice(
        one.method, f"{one.method}: {reason}; {stated}; about {one.seconds:.2g} s on this machine"
    )
