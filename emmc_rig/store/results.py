"""metrics.json of a result: figures, command and versions; and figures formatted for people."""

from __future__ import annotations

import json
import math
import platform
import re
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
from numpy.typing import NDArray

from emmc_rig.errors import WrongUsageError
from emmc_rig.model.view_axes import axes_of, middle_name, view_names
from emmc_rig.store.locks import command_line
from emmc_rig.store.shards import ENDING, save_arrays
from emmc_rig.version import __version__

if TYPE_CHECKING:
    from emmc_rig.model.frames import Frames
    from emmc_rig.model.settings import Settings

METRICS = "metrics.json"
PSI_ASSUMED = (
    "Psi is computed from the camera's description, not calibrated: the estimated accuracy "
    "does not include its error, and a misplaced mask is noticed only if the frames show it"
)
FAR_DB = 3.0
"""Below the PSNR stated of the whole, from which on the worst place is named."""
_SECONDS = {"us": 1e-6, "ms": 1e-3, "": 1, "s": 1, "min": 60, "m": 60, "h": 3600}
VERSIONED = ("numpy", "scipy", "numba", "h5py", "opencv-contrib-python-headless", "rawpy")


def parse_size(
    text: str | None, option: str = "size", example: str = "192x256"
) -> tuple[int, int] | None:
    """Return rows and columns from ROWSxCOLUMNS; raises AppError."""
    if text is None:
        return None
    rows, cross, columns = text.lower().partition("x")
    if not (cross and rows.isdigit() and columns.isdigit()):
        raise WrongUsageError(f"{option} {text}: write ROWSxCOLUMNS, for instance {example}")
    return int(rows), int(columns)


def parse_psnr(text: str, option: str) -> float:
    """Return the dB of "28dB" or "28"; raises AppError for anything else."""
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*(db)?", text.strip().lower())
    if match is None or not float(match[1]) > 0:
        raise WrongUsageError(f"{option} {text}: write a PSNR, for instance 28dB")
    return float(match[1])


def parse_seconds(text: str | None, option: str) -> float | None:
    """Return the seconds of "20ms", "0.02", "30s", "2min" or "1h"; raises WrongUsageError."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d+\.?\d*(?:e[+-]?\d+)?|\.\d+)\s*([a-z]*)", text.strip().lower())
    if match is None or match[2] not in _SECONDS or not float(match[1]) > 0:
        raise WrongUsageError(
            f"{option} {text}: write a time above 0, in seconds or with a unit, for instance 0.02, "
            "20ms or 2min"
        )
    return float(match[1]) * _SECONDS[match[2]]


def write_metrics(folder: Path, metrics: Mapping[str, object]) -> None:
    """Write metrics.json, with what made the figures: see `provenance` and `metrics_text`."""
    (folder / METRICS).write_text(metrics_text({**provenance(), **metrics}), encoding="utf-8")


def metrics_text(metrics: Mapping[str, object]) -> str:
    """Return plain data as JSON; values that are not finite become null, as JSON has none."""
    return json.dumps(_finite(metrics), indent=2, allow_nan=False) + "\n"


def _finite(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value


def stated_words(metrics: Mapping[str, object]) -> str:
    """Return "31.2 dB (29.8 to 33.0 in 9 of 10 captures)" by metrics.json; "" without it.

    With "least accurate about row 40, column 66: 24 dB" where that place is worse by FAR_DB.
    """
    stated_db, interval = metrics.get("stated_db"), metrics.get("stated_interval_db")
    if not isinstance(stated_db, float):
        return ""
    words = f"{stated_db:.1f} dB"
    match interval:
        case [float(low), float(high)]:
            words += f" ({low:.1f} to {high:.1f} in 9 of 10 captures)"
    match metrics.get("stated_worst_db"), metrics.get("stated_worst_at"):
        case float(worst_db), [int(row), int(column)] if worst_db < stated_db - FAR_DB:
            words += f"; least accurate about row {row}, column {column}: {worst_db:.0f} dB"
    return words


def worse_words(metrics: Mapping[str, object]) -> str:
    """Return by how much a result falls short of the baseline, where the truth is known; else "".

    The baseline is the true centre view in all places, which shows no parallax.
    """
    found, baseline = metrics.get("psnr_db"), metrics.get("replicate_psnr_db")
    if not (isinstance(found, int | float) and isinstance(baseline, int | float)):
        return ""
    if found >= baseline:
        return ""
    return (
        f"against the truth it is {baseline - found:.1f} dB worse than the baseline "
        f"({middle_name(axes_of(metrics))} in all places)"
    )


def unmeasured_words(metrics: Mapping[str, object]) -> str:
    """Return which views no light reaches the sensor from, by metrics.json; "" without such."""
    outside = metrics.get("views_not_measured")
    if not isinstance(outside, list) or not outside:
        return ""
    return (
        f"Not measured, as no light of theirs reaches the sensor: {view_names(outside)}; filled in "
        "from their neighbours, and not counted in the accuracy"
    )


def save_frames(path: Path, frames: Frames, **more: NDArray) -> None:
    """Write frames with more arrays (shot, y, x), such as frames_dn, and exposures_s (shot,).

    path: a Zarr group where it ends in .zarr, else an HDF5 file.
    """
    own = {"readings": frames.readings, "deviation": frames.deviation, "usable": frames.usable}
    arrays = {**own, **more}
    if path.suffix == ENDING:
        save_arrays(path, arrays)
        return
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array


def provenance(settings: Settings | None = None) -> dict[str, object]:
    """Return what makes a figure again: command, versions, commit of a checkout, threads.

    settings: only values other than the defaults are listed. Threads are those of compiled kernels.
    """
    known: dict[str, object] = {"command": command_line(), "versions": versions()}
    if commit := _commit():
        known["commit"] = commit
    if numba := sys.modules.get("numba"):
        known["threads"] = numba.get_num_threads()
    if settings is not None:
        known["settings"] = settings.model_dump(mode="json", exclude_defaults=True)
    return known


@cache
def _commit() -> str:
    """Return the commit that runs, `-dirty` after it where files differ; "" without a checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return ""
    git = ("git", "--no-optional-locks", "-C", str(root))
    asked = (*git, "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty")
    try:
        return subprocess.run(
            asked, capture_output=True, encoding="utf-8", check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {"emmc-rig": __version__, "python": platform.python_version(), **_library_versions()}


@cache
def _library_versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in VERSIONED}


def shown_seconds(seconds: float) -> str:
    """Return a duration for people."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 600:
        return "{:.0f} min {:.0f} s".format(*divmod(round(seconds), 60))
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def shown_bytes(count: float) -> str:
    """Return a size for people."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
