"""The method free of `calibrate SESSION`: Psi written to disk view by view is Psi in memory."""

import json

import h5py
import numpy as np
import pytest
from programs import exit_code

import emmc_rig as emmc
from emmc_rig.calibration import frames
from emmc_rig.captures.board_plan import PLAN, PlanSettings, write_plan
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.sensing import Psi

NAME, SIZE = "rgbw-bayer-1shot", (48, 64)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    write_plan(PlanSettings(NAME, find_camera(NAME), SIZE), folder)
    rig = emmc.rig("simulated", scene="near-planar", size=SIZE, rays=128)
    return emmc.capture(folder / PLAN, rig, out=folder / "session")


@pytest.mark.slow
def test_psi_on_disk_is_psi_in_memory(session, tmp_path, monkeypatch):
    whole = emmc.calibrate(session, method="free")
    whole.save(tmp_path / "whole")
    monkeypatch.setattr(frames, "BAND_PIXELS", 5 * SIZE[1])
    out = tmp_path / "streamed"
    assert exit_code("calibrate", session.folder, "--method", "free", "--out", out) == 0
    psi = Psi.load(out / "psi.h5")
    np.testing.assert_allclose(psi.weights, whole.psi.weights, rtol=1e-6, atol=1e-9)
    assert psi.camera_json == whole.psi.camera_json
    np.testing.assert_array_equal(psi.colour, whole.psi.colour)
    with (
        h5py.File(out / "calibration.h5") as streamed,
        h5py.File(tmp_path / "whole/calibration.h5") as kept,
    ):
        assert set(streamed) == set(kept)
        assert set(streamed.attrs) == set(kept.attrs)
        for name in kept:
            written, whole_array = streamed[name], kept[name]
            assert isinstance(written, h5py.Dataset)
            assert isinstance(whole_array, h5py.Dataset)
            np.testing.assert_allclose(written[...], whole_array[...], rtol=1e-5, atol=1e-9)
    judged = [
        json.loads((tmp_path / name / "metrics.json").read_text())["held_out"]["free"]
        for name in ("streamed", "whole")
    ]
    assert judged[0]["chi2"] == pytest.approx(judged[1]["chi2"], rel=1e-6)
