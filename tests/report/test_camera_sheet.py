"""The camera sheet: finding a camera, its figures against closed forms, its drawing."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import cv2
import pytest

from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import Camera
from emmc_rig.model.errors import CameraError
from emmc_rig.report.camera_list import camera_rows
from emmc_rig.report.camera_sheet import camera_figures, draw_camera


def camera(**settings: object) -> Camera:
    return Camera.model_validate({"title": "made for a test", **settings})


def test_a_camera_is_found_by_name_and_by_path(tmp_path: Path) -> None:
    shipped = find_camera("rgbw-bayer-3shots")
    text = resources.files("emmc_rig") / "cameras" / "rgbw-bayer-3shots.yaml"
    path = tmp_path / "mine.yaml"
    path.write_text(text.read_text(encoding="utf-8"), encoding="utf-8")
    assert find_camera(str(path)) == shipped


@pytest.mark.parametrize(
    ("spec", "nearest"),
    [("rgbw-bayer-3shot", "rgbw-bayer-3shots"), ("Convential", "conventional")],
)
def test_an_unknown_camera_names_the_nearest_and_how_to_list_them(spec: str, nearest: str) -> None:
    with pytest.raises(CameraError, match=f"did you mean '{nearest}") as caught:
        find_camera(spec)
    assert caught.value.advice == "list-cameras"
    assert "\n" not in str(caught.value)


def test_a_name_like_no_camera_gets_no_guess() -> None:
    with pytest.raises(CameraError, match="'x': a camera of your own"):
        find_camera("x")


def test_a_missing_camera_file_says_so(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="no such file"):
        find_camera(str(tmp_path / "absent.yaml"))


def test_the_figures_of_the_programmable_aperture_are_those_of_one_view_a_shot() -> None:
    figures = camera_figures(find_camera("programmable-aperture"), (8, 8))
    assert figures["sampling_rate"] == pytest.approx(1 / 3)
    assert figures["light_efficiency"] == pytest.approx(1 / 25, rel=1e-6)
    assert figures["total_exposure_s"] == pytest.approx(0.05)
    at_lens = figures["masks"]["aperture"]
    assert at_lens["view_shift_samples"] is None
    assert at_lens["magnification"] is None


def test_a_shadow_is_magnified_and_shifted_as_similar_triangles_say() -> None:
    mask = {"distance_mm": 10, "cell_um": 400, "pattern": {"kind": "random_binary"}}
    contact = {"distance_mm": 0, "cell_um": 24, "pattern": {"kind": "open"}}
    lens = {"distance_mm": 50, "aperture_cell_mm": 2}
    found = camera_figures(camera(lens=lens, masks={"mask": mask, "contact": contact}), (8, 8))
    # A view's step of 2 mm at the lens, seen through the mask 10 mm away: 2 x 10 / 40 mm.
    assert found["masks"]["mask"]["view_shift_samples"] == pytest.approx(500 / 24)
    assert found["masks"]["mask"]["magnification"] == pytest.approx(50 / 40)
    assert found["masks"]["mask"]["fresnel_number"] == pytest.approx(200**2 / (0.55 * 10_000))
    assert found["masks"]["contact"] == {
        "view_shift_samples": 0,
        "magnification": 1,
        "fresnel_number": None,
    }


def test_a_checkerboard_in_contact_darkens_half_of_the_pixels() -> None:
    board = {"kind": "tile", "cells": [[0, 1], [1, 0]]}
    mask = {"distance_mm": 0, "cell_um": 24, "pattern": board}
    figures = camera_figures(camera(masks={"mask": mask}), (8, 8))
    assert figures["dark_share"] == pytest.approx(0.5)
    assert figures["light_efficiency"] == pytest.approx(0.5, rel=1e-6)


def test_the_listing_counts_shots_and_measurements() -> None:
    rows = {row.name: row for row in camera_rows()}
    assert len(rows) == 18
    assert rows["conventional"].light_percent == pytest.approx(100)
    assert rows["conventional"].sensor == "rggb"
    assert rows["dual-mask-sinusoids"].masks == 2
    assert rows["programmable-aperture"].shots == 25
    rates = {name: row.sampling_rate for name, row in rows.items()}
    assert rates["rgbw-bayer-1shot"] == "1/75"
    assert rates["rgbw-bayer-3shots"] == "1/25"
    assert rates["programmable-aperture"] == "1/3"


def test_a_drawing_is_a_picture_1400_pixels_wide(tmp_path: Path) -> None:
    path = tmp_path / "sheet.png"
    draw_camera(find_camera("rgbw-bayer-2shots"), path)
    picture = cv2.imread(str(path))
    assert picture is not None
    assert picture.shape[1] == 1400
    assert list(tmp_path.iterdir()) == [path]


def test_a_camera_with_a_warning_binned_pixels_and_many_masks_is_drawn(tmp_path: Path) -> None:
    masks = {
        "film": {"distance_mm": 2, "cell_um": 24, "pattern": {"kind": "mura", "prime": 7}},
        "contact": {"distance_mm": 0, "cell_um": 24, "pattern": {"kind": "random_binary"}},
        "aperture": {"distance_mm": 50, "cell_um": 2500, "pattern": {"kind": "pinhole"}},
    }
    odd = camera(views=(3, 4), sensor={"cfa": "x-trans", "binning": 3}, masks=masks, shots=[{}] * 2)
    assert odd.warnings()
    draw_camera(odd, tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").stat().st_size > 10_000


def test_a_drawing_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with pytest.raises(AppError, match="cannot be written"):
        draw_camera(find_camera("conventional"), blocked / "sheet.png")
