"""Every script of the lab that has a smallest size runs at it, in a folder of its own."""

import csv
import os
import runpy
import sys
from pathlib import Path

import pytest
from matplotlib import pyplot

LAB = Path(__file__).parent
SHARED = [path for path in sorted(LAB.glob("*.py")) if "lab.parsed(" in path.read_text("utf-8")]
OWN = [
    path
    for path in sorted(LAB.glob("*.py"))
    if 'add_argument("--smallest"' in path.read_text("utf-8")
]
"""Scripts with the arguments of `lab`, and scripts with their own."""
SCRIPTS = [path for path in (*SHARED, *OWN) if path.stem not in ("lab", "test_lab")]
KEEPING = [*SHARED, LAB / "calibration_checks.py", LAB / "outside_benches.py"]
"""Scripts that write into docs/results unless told otherwise."""
PEERS_FILES = {"real_captures", "coded_aperture"}
NEEDS = {"train_network": "torch"}
"""By script, a package beyond the extra `lab`."""


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_runs_at_its_smallest_size(script, tmp_path, monkeypatch):
    if script.stem in PEERS_FILES and "EMMC_PEER_FILES" not in os.environ:
        pytest.skip("EMMC_PEER_FILES names no folder with files of others")
    if script.stem in NEEDS:
        pytest.importorskip(NEEDS[script.stem])
    typed = [str(script), "--smallest", *(("--out", ".") if script in KEEPING else ())]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", typed)
    runpy.run_path(str(script), run_name="__main__")
    pyplot.close("all")
    assert any(tmp_path.iterdir()), "wrote nothing"
    if "lab.measured(" in script.read_text("utf-8"):
        with (tmp_path / "runs.csv").open(newline="", encoding="utf-8") as opened:
            runs = {row["file"]: row["command"] for row in csv.DictReader(opened)}
        assert all((tmp_path / file).is_file() for file in runs)
        assert set(runs.values()) == {f"python benchmarks/{script.name} --smallest --out ."}
