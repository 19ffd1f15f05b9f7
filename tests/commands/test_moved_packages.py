"""A user's own modules may bear the names of the project's folders; old imports give the new."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from emmc_rig.moved_packages import MOVED

ROOT = Path(__file__).parents[2]
NOTEBOOK = """
import calibration, drivers, reconstruction, simulators
import emmc_rig as emmc
from emmc_rig.drivers.raw import RawFrame
assert {calibration.OWN, drivers.OWN, reconstruction.OWN, simulators.OWN} == {1}
scene = emmc.scene("near-planar", size=(24, 32))
psi = emmc.camera("rgbw-bayer-1shot").psi(scene.size)
result = emmc.reconstruct(psi, psi @ scene, "tv", noise_sigma=0.01)
print(result.light_field.shape)
"""


def run(program, folder):
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONSAFEPATH"}
    return subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True
    )


def test_own_modules_beside_a_notebook_are_imported_and_the_project_works(tmp_path):
    for name in ("calibration", "drivers", "reconstruction"):
        (tmp_path / f"{name}.py").write_text("OWN = 1\n")
    (tmp_path / "simulators").mkdir()
    (tmp_path / "simulators" / "__init__.py").write_text("OWN = 1\n")
    done = run(NOTEBOOK, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "(5, 5, 24, 32, 3)"


@pytest.mark.parametrize("name", MOVED)
@pytest.mark.parametrize("where", ["elsewhere", "in the checkout"])
def test_an_import_by_the_old_name_ends_in_a_line_with_the_new_name(tmp_path, name, where):
    folder = tmp_path if where == "elsewhere" else ROOT
    done = run(f"import emmc_rig, {name}", folder)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last == f"ModuleNotFoundError: import {MOVED[name]}, its name since 0.5"
