"""Which code measured a row, and whether that code is still the same.

The standard library and git are all that it needs.
"""

from __future__ import annotations

import ast
import csv
import subprocess
from collections import Counter
from collections.abc import Iterable
from functools import cache
from pathlib import Path

ROOT, COMMIT = Path(__file__).parent.parent, "commit"
"""The folder of the code, and the column of a row that names its commit."""
FITTING = (
    "reconstruction", "emmc_rig/model", "emmc_rig/cameras", "simulators/scenes.py",
    "simulators/raycaster.py", "simulators/textures.py",
)  # fmt: skip
"""Files and folders whose code decides what a reconstruction measures."""
CALIBRATING = (
    *FITTING, "calibration", "simulators", "emmc_rig/bench/hardware.py", "emmc_rig/captures",
    "emmc_rig/process",
)  # fmt: skip
"""The same for a calibration of simulated benches."""
RESULTS = ROOT / "docs" / "results"


def rooms_of(name: str) -> tuple[str, ...]:
    """Return the files and folders on whose code the rows of NAME.csv depend."""
    return CALIBRATING if name in ("calibration_checks", "mismatch") else FITTING


def stale(name: str) -> str:
    """Return why rows of NAME.csv in docs/results are not of the code as it is now; "" if none."""
    path = RESULTS / f"{name}.csv"
    if not path.is_file():
        return "not measured"
    with path.open(newline="", encoding="utf-8") as opened:
        commits = Counter(row.get(COMMIT) or "" for row in csv.DictReader(opened))
    for commit, rows in commits.items():
        if changed := changed_since(commit, rooms_of(name)):
            if changed == rooms_of(name):
                return f"{rows} rows are of {commit or 'code'}, which no commit here has"
            return f"{rows} rows are of {commit}; changed since: {', '.join(changed[:3])}"
    return ""


def commit_of_code(rooms: Iterable[str] = CALIBRATING) -> str:
    """Return the commit of the code, with a + where files of the rooms differ from it.

    Returns "" without git.
    """
    found = git("rev-parse", "--short=10", "HEAD").strip()
    changed = git("status", "--porcelain", "--", *rooms)
    return f"{found}+" if found and changed else found


@cache
def changed_since(commit: str, rooms: tuple[str, ...] = FITTING) -> tuple[str, ...]:
    """Return the files of the rooms whose code differs from that of a commit.

    Comments, docstrings, layout, what errors say and texts of several words do not count. For an
    unknown commit, or a commit with a +, all rooms are returned.
    """
    if not commit or commit.endswith("+") or not git("cat-file", "-t", commit):
        return rooms
    files = git("diff", "--name-only", "--no-renames", commit, "--", *rooms).splitlines()
    return tuple(name for name in files if _differs(name, commit))


def _differs(name: str, commit: str) -> bool:
    path = ROOT / name
    before = git("show", f"{commit}:{name}")
    now = path.read_text(encoding="utf-8") if path.is_file() else ""
    if path.suffix == ".py" and before and now:
        return _without_words(before) != _without_words(now)
    return before != now


def _without_words(source: str) -> str:
    """Return the syntax tree of a module without strings alone on a line and what users read."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "cost_words":
            node.args = []  # the chart's own seconds
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            node.exc = node.exc.func  # an error that is raised ends a measurement, whatever it says
        if isinstance(node, ast.JoinedStr) and any(map(_is_words, node.values)):
            node.values = [part for part in node.values if not _is_str(part)]
        if isinstance(node, ast.Constant) and _is_words(node):
            node.value = ""
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [line for line in body if not _is_text(line)]  # type: ignore[attr-defined]
    return ast.dump(tree)


def _is_text(line: ast.AST) -> bool:
    return isinstance(line, ast.Expr) and _is_str(line.value)


def _is_str(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_words(node: ast.AST) -> bool:
    return _is_str(node) and " " in ast.literal_eval(node)


def git(*words: str) -> str:
    """Return what a git command prints; "" where it fails."""
    asked = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return asked.stdout if asked.returncode == 0 else ""
