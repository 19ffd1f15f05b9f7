"""metrics.json of a result: figures, command and versions; and figures formatted for people."""

from __future__ import annotations

import json
import math
import platform
import re
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import WrongUsageError
from emmc_rig.files.shards import ENDING, save_arrays
from emmc_rig.store.locks import command_line
from emmc_rig.version import __version__

METRICS = "metrics.json"
PSI_ASSUMED = (
    "Psi is computed from the camera's description, not calibrated: its error is in no estimated "
    "accuracy, and misplaced masks are noticed only where the frames show them"
)
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
    """Write metrics.json, with the command and the versions; see `metrics_text`."""
    text = metrics_text({**metrics, "command": command_line(), "versions": versions()})
    (folder / METRICS).write_text(text, encoding="utf-8")


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
    """Return "31.2 dB (29.8 to 33.0 in 9 of 10 captures)" by metrics.json; "" without it."""
    stated_db, interval = metrics.get("stated_db"), metrics.get("stated_interval_db")
    if not isinstance(stated_db, float):
        return ""
    match interval:
        case [float(low), float(high)]:
            return f"{stated_db:.1f} dB ({low:.1f} to {high:.1f} in 9 of 10 captures)"
    return f"{stated_db:.1f} dB"


def save_frames(
    path: Path,
    frames_dn: NDArray[np.uint16],
    readings: NDArray[np.floating],
    exposures_s: NDArray[np.floating],
    **more: NDArray,
) -> None:
    """Write frames (shot, y, x): frames_dn, readings, exposures_s (shot,), and more.

    path: a Zarr group where it ends in .zarr, else an HDF5 file.
    """
    arrays = {"frames_dn": frames_dn, "readings": readings, "exposures_s": exposures_s, **more}
    if path.suffix == ENDING:
        save_arrays(path, arrays)
        return
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array


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
