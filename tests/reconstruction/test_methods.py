"""The methods by name: a module adds a method with its own settings."""

import csv
import os
import re
import statistics
import subprocess
import sys
import textwrap
from collections import defaultdict
from pathlib import Path

import pytest
from pydantic import ValidationError

from emmc_rig.model.errors import RemovedSettingWarning
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.dictionary import usual_patch
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.methods import DEFAULT_METHOD, METHODS, MethodSettings, find_method
from emmc_rig.reconstruction.methods.surfaces import sparse_patches
from emmc_rig.reconstruction.patches import regular_grid
from emmc_rig.reconstruction.sparse import SparseSettings

CHART = Path(__file__).parents[2] / "docs/results/chart-group-a-64x80.csv"
MEAN_PICTURE = textwrap.dedent('''
    """The method `mean`: one grey for all, from the mean reading."""

    import numpy as np
    from pydantic import Field

    from emmc_rig.model.settings import Settings
    from emmc_rig.reconstruction.method import Method
    from emmc_rig.reconstruction.result import Reconstruction, Status


    class MeanSettings(Settings):
        """Settings of `mean`."""

        gain: float = Field(default=1.0, gt=0)


    def _solve(given, settings):
        level = settings.of(MeanSettings).gain * given.frames.mean()
        light_field = np.full(given.psi.light_field_shape, level, dtype=np.float32)
        return Reconstruction("mean", light_field, Status.CONVERGED, "", 1, (), 0.0, {})


    METHODS = (
        Method("mean", "mean reading", "a flat scene", "N", "never", _solve, "mean", MeanSettings),
    )
''')
USED = textwrap.dedent("""
    import numpy as np
    from emmc_rig.formats.cameras import find_camera
    from emmc_rig.model.camera import build_imaging_matrix
    from emmc_rig.model.frames import even_frames
    from emmc_rig.reconstruction.methods import MethodSettings, reconstruct

    psi = build_imaging_matrix(find_camera("rgbw-mono"), (8, 8))
    settings = MethodSettings.model_validate({"mean": {"gain": 0.5}})
    frames = even_frames(np.full(psi.frames_shape, 0.2, np.float32), 0.01)
    result = reconstruct("mean", psi, frames, settings=settings)
    print(result.method, round(float(result.light_field.mean()), 3))
    try:
        MethodSettings.model_validate({"mean": {"gian": 0.5}})
    except ValueError:
        print("misspelt settings refused")
""")


@pytest.mark.slow
def test_another_package_offers_a_method_by_one_module_with_settings_of_its_own(tmp_path):
    (tmp_path / "mean_picture.py").write_text(MEAN_PICTURE, encoding="utf-8")
    installed = tmp_path / "mean_picture-1.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: mean-picture\nVersion: 1\n")
    (installed / "entry_points.txt").write_text("[emmc_rig.methods]\nmean = mean_picture\n")
    path = os.pathsep.join([str(tmp_path), *sys.path])
    ran = subprocess.run(
        [sys.executable, "-c", USED],
        capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    assert ran.stdout.splitlines() == ["mean 0.1", "misspelt settings refused"], ran.stderr


def test_a_method_that_is_misspelt_is_refused_with_the_nearest():
    with pytest.raises(ReconstructionError, match="did you mean 'adaptive'"):
        find_method("adaptve")


def test_every_method_finds_its_part_of_the_settings():
    settings = MethodSettings()
    for method in METHODS.values():
        assert getattr(settings, method.part) == settings.of(method.settings)


def test_the_default_method_needs_no_dictionary():
    assert not find_method(DEFAULT_METHOD).needs_dictionary


@pytest.mark.parametrize(
    ("shots", "size", "binning", "takes"),
    [(1, (24, 24), 1, False), (2, (24, 24), 1, True), (2, (5, 24), 1, False), (2, (8, 8), 2, True)],
)
def test_adaptive_takes_patches_from_two_shots_where_one_fits(
    random_psi, shots, size, binning, takes
):
    psi = random_psi(shots, (2, 2), size, binning=binning)
    settings = MethodSettings()
    assert (METHODS["adaptive"].patches(psi, settings) is not None) == takes
    assert METHODS["adaptive-fast"].patches(psi, settings) is None


def test_blocks_and_time_budgets_ask_the_method_and_name_none():
    root = Path(__file__).parents[2]
    for module in ("reconstruction/tiles.py", "emmc_rig/process/cost.py"):
        code = (root / module).read_text()
        # Keys of settings are not names of methods.
        code = re.sub(r"model_copy\(update=\{.*?\}\)", "", code)
        assert not [name for name in METHODS if f'"{name}"' in code], module
    assert METHODS["adaptive-fast"].factor == 1
    assert (METHODS["adaptive"].factor or 0) > 1
    for method in METHODS.values():
        assert method.scout is None or METHODS[method.scout].settings is method.settings


@pytest.mark.parametrize("shots", [1, 2, 3, 9, 16])
@pytest.mark.parametrize("binning", range(1, 18))
def test_the_patches_of_adaptive_cut_no_pixel_and_leave_no_gap(random_psi, binning, shots):
    size = (10 * binning, 10 * binning)
    psi, patch = (
        random_psi(shots, (1, 1), size, binning=binning),
        usual_patch(binning, shots, (1, 1)),
    )
    stride = sparse_patches(SparseSettings(), psi).stride
    assert len(regular_grid(size, patch, stride, binning)) > 1


@pytest.mark.parametrize(
    ("shots", "binning", "views", "side"),
    [
        (1, 1, 5, 9), (2, 1, 5, 6), (6, 1, 5, 6), (9, 1, 5, 5), (60, 1, 5, 4), (3, 2, 5, 8),
        (3, 1, 8, 9), (6, 1, 8, 6), (3, 1, 3, 6),
    ],
)  # fmt: skip
def test_patches_of_several_shots_are_smaller_and_of_many_views_larger(shots, binning, views, side):
    assert usual_patch(binning, shots, (views, views)) == (side, side)


def test_settings_of_version_0_2_open_with_a_warning_for_what_is_gone():
    old = {"adaptive": {"rest": False, "views": None, "stride": 5}}
    old |= {"sparse": {"aggregation": "hann"}}
    with pytest.warns(RemovedSettingWarning, match="was removed") as seen:
        settings = MethodSettings.model_validate(old)
    removed = {str(warning.message).split("'")[1] for warning in seen}
    assert removed == {"rest", "views", "aggregation"}
    assert settings.adaptive == AdaptiveSettings(stride=5)
    with pytest.raises(ValidationError, match="resst"):
        MethodSettings.model_validate({"adaptive": {"resst": False}})


def test_methods_are_said_to_take_what_the_chart_measured():
    measured = defaultdict(list)
    with CHART.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if row["level"] == "default":
                measured[row["method"], int(row["shots"])].append(float(row["seconds"]))
    said = {
        (name, shots): float(seconds)
        for name, method in METHODS.items()
        for shots, seconds in zip((1, 3), re.findall(r"([\d.]+) s\b", method.cost), strict=False)
    }
    assert set(said) >= {(name, 1) for name in ("adaptive", "adaptive-fast", "tv", "tv-dict")}
    for key, seconds in said.items():
        assert 0.5 < seconds / statistics.median(measured[key]) < 2, key
