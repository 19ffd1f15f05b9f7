"""Parts of the aperture: the moved window uncovers whole views, on the side of its move."""

import json

import numpy as np
import pytest
import yaml

from emmc_rig.calibration.openings import parts, views_open, window_place_um
from emmc_rig.formats.cameras import find_camera

CAMERA = find_camera("rgbw-bayer-1shot")


@pytest.mark.parametrize(
    ("window", "rows", "columns"),
    [
        ((0, 0), slice(0, 5), slice(0, 5)),
        ((3, 0), slice(0, 5), slice(3, 5)),
        ((-3, 0), slice(0, 5), slice(0, 2)),
        ((2, -2), slice(0, 3), slice(2, 5)),
    ],
)
def test_the_window_uncovers_the_views_on_the_side_to_which_it_moves(window, rows, columns):
    expected = np.zeros((5, 5), dtype=bool)
    expected[rows, columns] = True
    np.testing.assert_array_equal(views_open((5, 5), None, window), expected)


def test_the_windows_edge_lies_between_two_cells():
    x_um, y_um = window_place_um((2, -1), (5, 5), cell_um=100.0, side_um=530.0)
    assert x_um - 530 / 2 == pytest.approx(-250 + 2 * 100)
    assert y_um + 530 / 2 == pytest.approx(250 - 100)


@pytest.mark.parametrize(("size", "opens_every_view"), [("32x40", True), ("192x256", False)])
def test_few_whiteboards_never_take_more_frames_than_every_view(
    run, tmp_path, size, opens_every_view
):
    planned = {}
    for name, more in (("all", ()), ("few", ("--few",))):
        code, _, _ = run("calibrate", "--plan", "--size", size, "--out", tmp_path / name, *more)
        assert code == 0
        planned[name] = json.loads((tmp_path / name / "metrics.json").read_text())
    assert planned["few"]["frames"] <= planned["all"]["frames"]
    same = planned["few"]["frames_by_kind"] == planned["all"]["frames_by_kind"]
    assert same == opens_every_view


def test_where_the_aperture_stays_open_only_the_mask_moves(run, tmp_path):
    asked = ("calibrate", "--plan", "--skip", "aperture", "--size", "96x128")
    code, _, _ = run(*asked, "--target", "0.01", "--out", tmp_path / "plan")
    assert code == 0
    boards = yaml.safe_load((tmp_path / "plan" / "plan.yaml").read_text())["whiteboards"]
    assert boards["views"] == []
    assert not any("window" in board for board in boards["open"])
    places = {
        tuple(board.get("mask_um", (0, 0)))
        for board in boards["open"]
        if not board.get("validation")
    }
    assert len(places) == 4
    metrics = json.loads((tmp_path / "plan" / "metrics.json").read_text())
    assert metrics["expected_relative_error"] <= 0.01
    assert "aperture" in metrics["left_out"]
    code, _, said = run(*asked, "--target", "0.0001", "--out", tmp_path / "none")
    assert code == 1
    assert "or plan the aperture, too" in said
    assert not (tmp_path / "none" / "plan.yaml").exists()


def test_few_whiteboards_are_planned_by_parts_of_the_aperture(run, tmp_path):
    out = tmp_path / "plan"
    asked = ("--plan", "--few", "--size", "32x48", "--target", "0.01", "--out", out)
    code, _, _ = run("calibrate", *asked)
    assert code == 0
    boards = yaml.safe_load((out / "plan.yaml").read_text())["whiteboards"]
    assert boards["views"] == []
    windows = [tuple(board.get("window", (0, 0))) for board in boards["open"]]
    assert set(parts(CAMERA.views)) <= set(windows)
    metrics = json.loads((out / "metrics.json").read_text())
    assert sum(board["frames"] for board in metrics["whiteboards"]) <= 12
    assert metrics["model_error"] < metrics["expected_relative_error"] <= 0.01
