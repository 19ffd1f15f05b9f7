"""Views stored or calibrated in another order than their names say are told, and put right."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from programs import program
from view_files import save_views

import emmc_rig as emmc
from emmc_rig.model import view_order
from emmc_rig.model.errors import ViewOrderWarning
from emmc_rig.model.lightfield import load_views
from emmc_rig.model.view_order import ViewOrder, order_of

WRONG = [order for order in ViewOrder if order != ViewOrder.AS_NAMED]
SIZE = (128, 160)


@pytest.mark.parametrize(
    ("as_named", "transposed", "order"),
    [
        (0.3, 0.8, ViewOrder.TRANSPOSED),
        (0.7, 0.8, ViewOrder.AS_NAMED),  # the named order leaves nearly as little unexplained
        (0.1, 0.5, ViewOrder.AS_NAMED),  # no order explains the changes between the views
    ],
)
def test_another_order_is_taken_only_if_it_explains_the_views_far_better(
    monkeypatch: pytest.MonkeyPatch, as_named: float, transposed: float, order: ViewOrder
) -> None:
    shares = {ViewOrder.AS_NAMED: [as_named], ViewOrder.TRANSPOSED: [0.0, transposed]}
    monkeypatch.setattr(view_order, "_explained", lambda light_field: shares)
    assert order_of(np.zeros((3, 3, 16, 16, 3))) == order


def named(order: ViewOrder, lying: np.ndarray) -> np.ndarray:
    """Return an array by the names of its views."""
    names = np.flip(lying, 1) if order.reverses else lying
    return np.ascontiguousarray(names.swapaxes(0, 1) if order.interchanges else names)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return emmc.scene("deep-occlusions", size=SIZE, seed=3).light_field


@pytest.mark.parametrize("order", WRONG)
def test_views_named_in_another_order_are_arranged_as_they_lie(order: ViewOrder) -> None:
    array = np.random.default_rng(0).random((3, 3, 4, 5))
    assert np.array_equal(order.arranged(named(order, array)), array)
    assert not np.array_equal(order.arranged(array), array)


@pytest.mark.slow
@pytest.mark.parametrize("order", ViewOrder)
@pytest.mark.parametrize("name", ["deep-occlusions", "non-lambertian", "dark", "wide-disparity"])
def test_parallax_tells_the_order(name: str, order: ViewOrder) -> None:
    scene = emmc.scene(name, size=(96, 128), seed=1).light_field
    assert order_of(named(order, scene)) == order


@pytest.mark.parametrize("views", [(5, 3), (3, 5), (3, 3)])
def test_other_grids(views: tuple[int, int]) -> None:
    scene = emmc.scene("deep-occlusions", size=(96, 128), views=views).light_field
    assert order_of(scene) == ViewOrder.AS_NAMED
    assert order_of(np.ascontiguousarray(scene[:, ::-1])) == ViewOrder.MIRRORED


def test_two_views_a_side_are_not_turned() -> None:
    scene = emmc.scene("deep-occlusions", size=(96, 128), views=(2, 2)).light_field
    assert order_of(scene) == ViewOrder.AS_NAMED


def test_without_parallax_names_are_believed(truth: np.ndarray) -> None:
    flat = np.broadcast_to(truth[2, 2], truth.shape)
    noise = np.random.default_rng(1).random(truth.shape, dtype=np.float32)
    dark = np.zeros_like(truth)
    for light_field in (flat, noise, dark, truth[:, :, :6, :7]):
        assert order_of(light_field) == ViewOrder.AS_NAMED


@pytest.mark.parametrize("order", WRONG)
def test_a_folder_in_another_order_is_told_and_put_right_by_its_option(
    tmp_path: Path, truth: np.ndarray, order: ViewOrder
) -> None:
    stored = named(order, truth)
    save_views(tmp_path / "views", stored)
    with pytest.warns(ViewOrderWarning, match=order.words):
        as_named = emmc.scene(str(tmp_path / "views"))
    assert np.abs(as_named.light_field - stored).max() <= 0.5 / 255 + 1e-6
    scene = emmc.scene(f"{tmp_path / 'views'}@by-parallax")
    assert scene.name == "views"
    for item in (as_named, scene):
        assert order.words in item.provenance
    assert np.abs(scene.light_field - truth).max() <= 0.5 / 255 + 1e-6
    assert np.abs(load_views(tmp_path / "views") - stored).max() <= 0.5 / 255 + 1e-6


def test_files_named_column_by_column_are_put_right(tmp_path: Path, truth: np.ndarray) -> None:
    # The test names the files itself: code under test must not decide the order.
    for row, column in np.ndindex(5, 5):
        codes = np.round(255 * truth[row, column, ..., ::-1]).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"view_{column}_{row}.png"), codes)
    scene = emmc.scene(f"{tmp_path}@by-parallax")
    assert np.abs(scene.light_field - truth).max() <= 0.5 / 255 + 1e-6


def _flow(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the dense optical flow between two views, (2, y, x), along x and y, in pixels."""
    codes = [np.round(255 * view.mean(axis=-1)).astype(np.uint8) for view in (first, second)]
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*codes, None)  # type: ignore[attr-defined, call-overload]
    return np.moveaxis(flow, -1, 0)


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.filterwarnings("ignore::emmc_rig.model.errors.ViewOrderWarning")
def test_real_views_move_along_their_rows_by_optical_flow() -> None:
    folders = [path for path in Path(os.environ["EMMC_LIGHTFIELDS"]).iterdir() if path.is_dir()]
    for folder in folders:
        lf = emmc.scene(f"{folder}@by-parallax", views=(5, 5)).light_field
        along_row, along_column = _flow(lf[2, 2], lf[2, 4]), _flow(lf[2, 2], lf[4, 2])
        within = np.square(along_row[0]) + np.square(along_column[1])
        across = np.square(along_row[1]) + np.square(along_column[0])
        # Medians: where nothing is to be seen, flow goes astray.
        assert np.median(within) > 2 * np.median(across), folder.name
        assert np.median(along_row[0] * along_column[1]) > 0, folder.name


def test_a_file_in_order_is_left_alone(tmp_path: Path, truth: np.ndarray) -> None:
    with h5py.File(tmp_path / "scene.h5", "w") as file:
        file["light_field"] = truth
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for spec in (tmp_path / "scene.h5", f"{tmp_path / 'scene.h5'}@by-parallax"):
            assert np.array_equal(emmc.scene(spec).light_field, truth)


def test_commands_say_it_in_a_line(tmp_path: Path, truth: np.ndarray) -> None:
    save_views(tmp_path / "views", named(ViewOrder.TRANSPOSED, truth))
    scene, out = tmp_path / "views", tmp_path / "frames"
    code, _, errors = program("simulate", "--scene", scene, "--out", out)
    assert code == 0
    said = [line for line in errors.splitlines() if ViewOrder.TRANSPOSED.words in line]
    assert len(said) == 1
    assert said[0].startswith("note:")
    assert f"open it as {scene}@by-parallax" in " ".join(errors.split()).replace("- ", "-")
    code, _, errors = program("simulate", "--scene", f"{scene}@by-parallax", "--out", out)
    assert (code, ViewOrder.TRANSPOSED.words in errors) == (0, False)
