"""The tests kill what breaks the program: random mutants of each room, and which survive.

A mutant is one operator, comparison, min or max of one function changed. It is killed when the
tests of its room fail. Run it in a clone of its own, since it writes into the program's files:

    git clone . /tmp/mutants && cd /tmp/mutants && python benchmarks/mutants.py --each 10
"""

from __future__ import annotations

import argparse
import ast
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd

ROOT = Path(__file__).parent.parent
ROOMS = {
    "model": ("emmc_rig/model", "tests/model"),
    "acquisition": ("emmc_rig/acquisition", "tests/acquisition"),
    "session": ("emmc_rig/session", "tests/session"),
    "calibration": ("calibration", "tests/calibration"),
    "reconstruction": ("reconstruction", "tests/reconstruction"),
    "drivers": ("drivers", "tests/drivers"),
    "simulators": ("simulators", "tests/simulators tests/drivers"),
}
SWAPS = {
    "+": "-", "-": "+", "*": "/", "/": "*", "<": "<=", "<=": "<", ">": ">=", ">=": ">",
    "==": "!=", "min": "max", "max": "min", "and": "or", "or": "and",
}  # fmt: skip
OPERATORS = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Lt: "<", ast.LtE: "<=",
    ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.And: "and", ast.Or: "or",
}  # fmt: skip


def mutants(path: Path) -> Iterator[tuple[int, str, str]]:
    """Yield line, what stands there, and the line as changed, for every change of a file."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    for function in (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef)):
        for node in ast.walk(function):
            for start, end, was in _places(node):
                if start[0] != end[0]:
                    continue
                line = lines[start[0] - 1]
                at = line.find(was, start[1], end[1])
                if at >= 0:
                    changed = line[:at] + SWAPS[was] + line[at + len(was) :]
                    yield start[0], line, changed


def _places(node: ast.AST) -> Iterator[tuple[tuple[int, int], tuple[int, int], str]]:
    """Yield between which places of the text an operator or a call stands that can be changed."""
    pairs: list[tuple[ast.expr, ast.expr, ast.AST]] = []
    if isinstance(node, ast.BinOp):
        pairs = [(node.left, node.right, node.op)]
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        pairs = [(node.left, node.comparators[0], node.ops[0])]
    elif isinstance(node, ast.BoolOp):
        pairs = [(node.values[0], node.values[1], node.op)]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in SWAPS:
        yield _start(node.func), _end(node.func), node.func.id
    for before, after, operator in pairs:
        if type(operator) in OPERATORS:
            yield _end(before), _start(after), OPERATORS[type(operator)]


def _start(node: ast.expr) -> tuple[int, int]:
    return node.lineno, node.col_offset


def _end(node: ast.expr) -> tuple[int, int]:
    assert node.end_lineno is not None
    assert node.end_col_offset is not None
    return node.end_lineno, node.end_col_offset


def survives(path: Path, number: int, changed: str, tests: str, limit_s: int) -> str:
    """Return whether the tests of a room miss a change: "killed", "survived" or "too slow"."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines(keepends=True)
    lines[number - 1] = changed + "\n"
    path.write_text("".join(lines), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", *tests.split()]
    try:
        failed = subprocess.run(command, cwd=ROOT, timeout=limit_s, capture_output=True).returncode
        return "killed" if failed else "survived"
    except subprocess.TimeoutExpired:
        return "too slow"
    finally:
        path.write_text(text, encoding="utf-8")


def main() -> None:
    """Try mutants of every room; write the survivors and the rates."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=10, help="mutants of a room")
    parser.add_argument("--room", action="append", choices=ROOMS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=int, default=600, help="seconds of a room's tests at most")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results")
    args = parser.parse_args()
    changes = subprocess.run(["git", "status", "--porcelain"], cwd=ROOT, capture_output=True)
    if changes.stdout:
        sys.exit("the clone has changes: commit them, or take another clone")
    rows = []
    for room in args.room or ROOMS:
        package, tests = ROOMS[room]
        rng = random.Random(f"{args.seed} {room}")
        files = sorted((ROOT / package).rglob("*.py"))
        every = [(path, *mutant) for path in files for mutant in mutants(path)]
        for path, number, line, changed in rng.sample(every, min(args.each, len(every))):
            outcome = survives(path, number, changed, tests, args.limit)
            place = f"{path.relative_to(ROOT)}:{number}"
            rows.append((room, place, outcome, line.strip(), changed.strip()))
            print(*rows[-1], sep=" | ", flush=True)
    columns = ["room", "place", "outcome", "was", "became"]
    table = pd.DataFrame(rows, columns=columns)
    table.to_csv(args.out / "mutants.csv", index=False)
    decided = table[table.outcome != "too slow"]
    print((decided.outcome == "killed").groupby(decided.room).agg(["mean", "count"]))


if __name__ == "__main__":
    main()
