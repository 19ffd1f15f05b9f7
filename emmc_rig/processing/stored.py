"""A calibration on disk: Psi, how sure it is, where the mask sat, and what it says of itself."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from calibration.placement import SCALARS, labels
from calibration.routes import Outcome
from calibration.whiteboard import Calibration, NewArray
from emmc_rig.files.psi import PSI

Array = NDArray[np.floating]

REPORT, CALIBRATION = "report.html", "calibration.h5"


def outcome_figures(outcome: Outcome) -> dict:
    """Return what a calibration says of itself, for metrics.json and the report."""
    return {
        "chosen": outcome.chosen,
        "why": outcome.why,
        "findings": list(outcome.findings),
        "advice": list(outcome.advice),
        "unwatched": list(outcome.unwatched),
        "held_out": {
            name: {
                "chi2": one.chi2,
                "chi2_without_worst_percent": one.trimmed,
                "neighbour_correlation": one.whiteness,
                "relative_error": one.relative_error,
                "chi2_by_kind": dict(one.groups),
            }
            for name, one in outcome.judged.items()
        },
        "frames": dict(outcome.frames),
        "bad_pixels": float(1 - outcome.good.mean()),
        "defects": None if outcome.mixed is None else _defect_count(outcome),
        "parameters": _parameters(outcome),
        "fit": _fit_figures(outcome),
    }


def _defect_count(outcome: Outcome) -> int:
    assert outcome.mixed is not None
    return 0 if outcome.mixed.defects is None else outcome.mixed.defects.count


def _parameters(outcome: Outcome) -> dict[str, dict[str, float]]:
    best = outcome.mixed or outcome.parametric
    if best is None:
        return {}
    values = best.fit.placement.vector()
    views = np.array(best.fit.placement.aperture).shape
    deviations = np.sqrt(np.diag(best.fit.covariance))
    return {
        name: {"value": float(values[i]), "deviation": float(deviations[i])}
        for i, name in enumerate(labels((views[0], views[1])))
    }


def _fit_figures(outcome: Outcome) -> dict[str, object]:
    best = outcome.mixed or outcome.parametric
    if best is None:
        return {}
    fit = best.fit
    return {
        "correlation": fit.correlation,
        "chi2": fit.chi2,
        "outliers": fit.outliers,
        "steps": fit.steps,
        "status": fit.status,
        "undecided": list(fit.undecided),
        "boards": [asdict(one) for one in fit.boards],
    }


@contextmanager
def arrays_in(folder: Path) -> Iterator[NewArray]:
    """Yield what makes the arrays of Psi in the files of a folder that `save_outcome` completes."""
    with ExitStack() as files:

        def empty(name: str, shape: tuple[int, ...]) -> h5py.Dataset:
            path = folder / {"weights": PSI, "deviation": CALIBRATION}[name]
            file = files.enter_context(h5py.File(path, "w"))
            return file.create_dataset(name, shape, np.float32)

        yield empty


def save_outcome(folder: Path, outcome: Outcome, chosen: Calibration) -> None:
    """Write psi.h5 and calibration.h5 of the calibration chosen into an existing folder.

    Arrays that are on disk stay where they are, and their files get the rest.
    """
    weights, deviation = chosen.psi.weights, chosen.deviation
    if isinstance(weights, h5py.Dataset) and isinstance(deviation, h5py.Dataset):
        chosen.psi.describe(weights.file)
        _describe(deviation.file, outcome, chosen)
        return
    chosen.psi.save(folder / PSI)
    with h5py.File(folder / CALIBRATION, "w") as file:
        file["deviation"] = chosen.deviation
        _describe(file, outcome, chosen)


def _describe(file: h5py.File, outcome: Outcome, chosen: Calibration) -> None:
    """Write what turns frames into readings, and where the mask sat."""
    file.attrs["gain_dn_per_electron"] = chosen.gain.gain_dn_per_electron
    file.attrs["dark_variance_dn2"] = chosen.gain.dark_variance_dn2
    file["dark_dn"] = chosen.dark_dn
    file["white_dn_per_s"] = chosen.white_dn_per_s
    if chosen.good is not None:
        file["good"] = chosen.good
    if outcome.crosstalk is not None:
        # What every filter sees of the colours, (filter, colour).
        file["crosstalk"] = outcome.crosstalk.seen
    best = outcome.mixed or outcome.parametric
    by_route = {"parametric": outcome.parametric, "mixed": outcome.mixed, "combined": best}
    known = by_route.get(outcome.chosen)
    if known is not None:
        for name in SCALARS:
            file.attrs[name] = getattr(known.fit.placement, name)
        file["aperture"] = np.array(known.fit.placement.aperture)
        if known.defects is not None:
            file["lost"] = known.defects.lost
