"""CONTRIBUTING.md: the worked examples are run as they stand, and the places they name exist."""

import re
from pathlib import Path

import numpy as np
import yaml

from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.frames import even_frames
from emmc_rig.reconstruction.method import Given
from emmc_rig.study.trial import Capture
from emmc_rig.version import __version__

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def example(heading):
    """What the block under a heading defines."""
    found = re.search(rf"^### {heading}\n.*?^```python\n(.*?)^```$", TEXT, re.M | re.S)
    assert found is not None
    names: dict = {"__name__": "example"}
    exec(compile(found[1], heading, "exec", dont_inherit=True), names)
    return names


def test_the_method_reconstructs_with_its_own_settings():
    names = example("A method")
    (method,) = names["METHODS"]
    psi = build_imaging_matrix(find_camera("rgbw-mono"), (8, 8))
    frames = even_frames(np.full(psi.frames_shape, 0.2, dtype=np.float32), 0.01)
    given = Given(psi, frames, None, None)

    class Settings:
        def of(self, kind):
            return kind(gain=0.5)

    result = method.solve(given, Settings())
    assert np.allclose(result.light_field, 0.1)


def test_the_mask_pattern_draws_stripes():
    cells = example("A mask pattern")["Stripes"](kind="stripes").draw(2, 3, 4, 30.0)
    assert cells.shape == (2, 3, 4, 3)
    assert cells[1, 2, :, 0].tolist() == [0, 1, 0, 1]


def test_the_fault_darkens_so_much_of_the_readings():
    (fault,) = example("A fault")["FAULTS"]
    assert fault.explained.startswith("A share of the picture")
    trial = fault.make(Capture("near-planar", find_camera("rgbw-bayer-1shot"), (20, 20)), 25)
    assert np.mean(trial.readings == 0) >= 0.25


def test_every_place_that_the_table_names_exists():
    for place in re.findall(r"`((?:emmc_rig|reconstruction|tests)/[\w/.]+)`", TEXT):
        assert (ROOT / place).exists(), place
    for link in re.findall(r"\]\(([\w/.]+)\)", TEXT):
        assert (ROOT / link).exists(), link


def test_the_citation_names_the_program_s_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert str(cited["version"]) == __version__
