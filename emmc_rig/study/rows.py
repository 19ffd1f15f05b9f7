"""Points and results as plain data: digests, rows of CSV files, where figures came from."""

from __future__ import annotations

import csv
import io
import os
import platform
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.settings import Settings
from emmc_rig.store.results import command_line, metrics_text, versions


def plain(result: Mapping[str, object]) -> dict:
    """Return a result as read back from JSON: None for what is not finite, lists for tuples."""
    return parse_json(metrics_text(result), "a result", AppError)


def csv_text(rows: Sequence[Mapping[str, object]], columns: Sequence[str]) -> str:
    """Return rows as CSV: the columns named, floats to six digits, None as an empty field."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n", restval="", extrasaction="ignore")
    writer.writeheader()
    for row in rows:
        writer.writerow(
            {k: format(v, ".6g") if isinstance(v, float) else v for k, v in row.items()}
        )
    return text.getvalue()


def provenance(settings: Settings, seconds: float, **more: str) -> dict[str, str]:
    """Return what a page says of where it came from; more: rows after the seconds."""
    return {
        "Command line": command_line(),
        "Seconds of this run": f"{seconds:.0f}",
        **more,
        "Settings": settings.model_dump_json(),
        **{f"Version of {name}": version for name, version in versions().items()},
    }


def check_scene_names(specs: Sequence[str], kind: str = "scenes") -> None:
    """Raise AppError when two scenes (or cameras, by `kind`) have one name."""
    names = [Path(spec).stem for spec in specs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise AppError(f"two {kind} are called '{twice}'; name each once, or rename one")


SMALLEST_PX = 16


def check_size(size: tuple[int, int] | None) -> None:
    """Raise AppError for a picture too small to be judged."""
    if size is not None and min(size) < SMALLEST_PX:
        raise AppError(f"size {size[0]}x{size[1]}: needs {SMALLEST_PX}x{SMALLEST_PX} or more")


def available_cores() -> int:
    """Return the cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def machine() -> str:
    """Return the processor's name and the number of cores."""
    name = platform.processor() or platform.machine()
    try:
        cpu = Path("/proc/cpuinfo").read_text("utf-8", errors="replace")
    except OSError:
        cpu = ""
    if found := re.search(r"^model name\s*:\s*(.+)$", cpu, re.MULTILINE):
        name = found[1].strip()
    return f"{name}, {available_cores()} cores"


def dictionary_identity(dictionary: str | None) -> str:
    """Return what identifies a dictionary: its name, and of a file its size and time."""
    if dictionary is None or not Path(dictionary).is_file():
        return dictionary or "lambertian"
    seen = Path(dictionary).stat()
    return f"{dictionary} {seen.st_size} {seen.st_mtime_ns}"
