"""What napari opens: layers of a light field, a Psi and a session; and the plug-in's manifest."""

import importlib
import json
import os
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

import emmc_rig as emmc
from drivers.raw import decode_raw
from emmc_rig.files.exports import save_maps
from emmc_rig.files.formats import Export
from emmc_rig.model.lightfield import refocus, save_hdf5
from emmc_rig.model.srgb import srgb_of
from emmc_rig.pages.layers import AXES, get_reader, layers, light_field_layers

MANIFEST = Path(emmc.__file__).with_name("napari.yaml")
SIZE = (24, 32)
OPENED = """
import sys
import npe2
from napari.components import ViewerModel
plugins = npe2.PluginManager.instance()
if "emmc-rig" not in plugins:  # a checkout that was installed before there was a manifest
    plugins.register(npe2.PluginManifest.from_file(sys.argv[2]))
viewer = ViewerModel()  # all of napari but its window, which needs OpenGL
viewer.open(sys.argv[1], plugin="emmc-rig")
print(len(viewer.layers), viewer.dims.axis_labels, viewer.dims.nsteps)
viewer.dims.set_current_step(1, 4)
print(viewer.layers[0].get_value((3, 4, 2, 10, 20)))
"""
WINDOW = """
import json
import sys
import napari
import npe2
import numpy as np
from qtpy.QtWidgets import QApplication
plugins = npe2.PluginManager.instance()
if "emmc-rig" not in plugins:
    plugins.register(npe2.PluginManifest.from_file(sys.argv[1]))
folder, *paths = sys.argv[2:]

def seen(viewer):
    for _ in range(20):
        QApplication.processEvents()
    return viewer.screenshot(canvas_only=True, flash=False)[..., :3]

reported = []
for number, path in enumerate(paths):
    viewer = napari.Viewer(show=True)
    viewer.open(path, plugin="emmc-rig")
    sliders = viewer.window._qt_viewer.dims.slider_widgets
    shown = {"sliders": [one.axis_label.text() for one in sliders if one.isVisible()]}
    pictures = {"opened": seen(viewer)}
    if "focus" in shown["sliders"]:
        sliders[1].slider.setValue(4)
        sliders[2].slider.setValue(0)
        pictures["view"] = seen(viewer)
        viewer.layers[1].visible = True
        sliders[0].slider.setValue(20)
        pictures["focused"] = seen(viewer)
        shown["focused"] = viewer.layers[1].metadata["disparities_px"][20]
    np.savez(f"{folder}/{number}.npz", **pictures)
    reported.append(shown)
    viewer.close()
print(json.dumps(reported))
"""


@pytest.fixture(scope="module")
def scene():
    return emmc.scene("deep-occlusions", size=SIZE)


@pytest.fixture(scope="module")
def result(scene, tmp_path_factory):
    """A result's folder with two maps."""
    folder = tmp_path_factory.mktemp("result")
    save_hdf5(folder / "light_field.h5", scene.light_field, {})
    sigma = np.full(scene.light_field.shape[:4], 0.1, np.float32)
    save_maps(folder, {"disparity": scene.disparity_px, "sigma": sigma})
    return folder


def test_a_light_field_has_a_slider_for_focus_and_view(scene):
    views, focused = light_field_layers(Export("s", "", scene.light_field))
    for data, options, kind in (views, focused):
        assert kind == "image"
        assert options["axis_labels"] == AXES
        assert data.shape[1:] == scene.light_field.shape
    np.testing.assert_array_equal(views[0][7, 1, 3], srgb_of(scene.light_field[1, 3]))
    disparity = focused[1]["metadata"]["disparities_px"][4]
    expected = srgb_of(refocus(scene.light_field, disparity))
    np.testing.assert_allclose(focused[0][4, 0, 2], expected, atol=1e-6)
    assert focused[0].base is not None  # no copy per view


def test_a_result_opens_with_its_maps_as_layers(result, scene):
    names = [options["name"] for _, options, _ in layers(result)]
    assert [name.partition(": ")[2] for name in names] == [
        "views", "refocus", "disparity, px per view", "standard deviation",
    ]  # fmt: skip
    sigma, options, _ = layers(result)[3]
    assert options["axis_labels"] == ("v", "u", "y", "x")
    assert sigma.shape == scene.light_field.shape[:4]


def test_a_psi_opens_as_weights_by_shot_and_view(tmp_path):
    psi = emmc.camera("rgbw-bayer-2shots").psi(SIZE)
    psi.save(tmp_path / "psi.h5")
    read = get_reader(str(tmp_path / "psi.h5"))
    assert read is not None
    ((data, options, _),) = read(str(tmp_path / "psi.h5"))
    assert options["axis_labels"] == ("shot", "colour", "v", "u", "y", "x")
    np.testing.assert_array_equal(data[1, 0, 2, 3], psi.weights[1, 2, 3, :, 0])


def test_a_session_opens_frame_by_frame(tmp_path):
    plan = tmp_path / "plan.yaml"
    plan.write_text("{camera: rgbw-bayer-2shots, shots: [{}, {}], whiteboards: null, darks: null}")
    session = emmc.capture(plan, emmc.rig("simulated", scene="near-planar", size=SIZE, rays=16))
    ((data, options, _),) = layers(session.folder)
    names = options["metadata"]["frames"]
    assert data.shape == (len(names), *SIZE)
    assert set(names) == set(session.stored)
    for number, name in enumerate(names):
        np.testing.assert_array_equal(data[number], decode_raw(session.read(name)).mosaic)
    np.testing.assert_array_equal(data[:, 3, 4:9], np.stack([data[0], data[1]])[:, 3, 4:9])


def test_what_is_not_of_the_project_is_left_to_other_readers(tmp_path):
    (tmp_path / "other.h5").write_bytes(b"none of ours")
    (tmp_path / "picture.png").write_bytes(b"")
    for path in (tmp_path, tmp_path / "other.h5", tmp_path / "picture.png", tmp_path / "absent.h5"):
        assert get_reader(str(path)) is None
    assert get_reader([str(tmp_path)]) is None


def test_the_manifest_is_valid_and_names_functions_that_there_are():
    npe2 = pytest.importorskip("npe2", reason="extra `napari`")
    manifest = npe2.PluginManifest.from_file(MANIFEST)
    manifest.validate_imports()
    (reader,) = manifest.contributions.readers
    assert reader.accepts_directories
    assert {one.id for one in manifest.contributions.commands} == {reader.command}
    module, _, name = manifest.contributions.commands[0].python_name.partition(":")
    assert getattr(importlib.import_module(module), name) is get_reader


@pytest.mark.slow
def test_napari_opens_a_result_without_a_screen(result, scene):
    pytest.importorskip("napari", reason="extra `napari`")
    done = subprocess.run(
        [sys.executable, "-c", OPENED, str(result), str(MANIFEST)],
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    count, value = done.stdout.splitlines()[-2:]
    assert count.startswith("4 ")
    assert all(f"'{name}'" in count for name in AXES)
    shown = np.array(value.strip("[]").split(), float)
    np.testing.assert_allclose(shown, srgb_of(scene.light_field[4, 2, 10, 20]), atol=1e-5)


@contextmanager
def screen(folder):
    """Yield the environment of a screen with OpenGL that nobody looks at."""
    if shutil.which("Xvfb") is None:
        pytest.skip("napari's window draws by OpenGL: needs Xvfb on PATH")
    with (folder / "display").open("w+b") as name:
        server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(name.fileno()), "-screen", "0", "1400x900x24"],
            pass_fds=[name.fileno()],
            stderr=subprocess.DEVNULL,
        )
        try:
            while not (shown := (folder / "display").read_text().strip()):
                assert server.poll() is None
                time.sleep(0.05)
            yield {**os.environ, "DISPLAY": f":{shown}", "QT_QPA_PLATFORM": "xcb"}
        finally:
            server.terminate()
            server.wait()


def pictured(canvas, size):
    """What a canvas shows, without the black around it, as a picture of that size."""
    rows, columns = (np.flatnonzero((canvas.max(axis=2) > 9).any(axis=axis)) for axis in (1, 0))
    cut = canvas[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return cv2.resize(cut.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA)


@pytest.mark.slow
def test_naparis_window_shows_views_refocus_psi_and_session_by_sliders(result, scene, tmp_path):
    pytest.importorskip("napari", reason="extra `napari`")
    pytest.importorskip("qtpy", reason="a window needs Qt: extra `napari`")
    emmc.camera("rgbw-bayer-2shots").psi(SIZE).save(tmp_path / "psi.h5")
    plan = tmp_path / "plan.yaml"
    plan.write_text("{camera: rgbw-bayer-2shots, shots: [{}, {}], whiteboards: null, darks: null}")
    session = emmc.capture(plan, emmc.rig("simulated", scene="near-planar", size=SIZE, rays=16))
    paths = [str(one) for one in (result, tmp_path / "psi.h5", session.folder)]
    with screen(tmp_path) as environment:
        done = subprocess.run(
            [sys.executable, "-c", WINDOW, str(MANIFEST), str(tmp_path), *paths],
            env=environment, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
    if "no Qt platform plugin could be initialized" in done.stderr:
        pytest.skip("Qt cannot open a window here: its xcb plug-in lacks libraries")
    assert done.returncode == 0, done.stderr
    reported = json.loads(done.stdout.splitlines()[-1])
    assert [one["sliders"] for one in reported] == [
        ["focus", "v", "u"], ["shot", "v", "u"], ["frame"],
    ]  # fmt: skip
    drawn = [dict(np.load(tmp_path / f"{number}.npz")) for number in range(3)]
    view = pictured(drawn[0]["view"], SIZE) - 255 * srgb_of(scene.light_field[4, 0])
    assert np.abs(view).mean() < 3
    other = pictured(drawn[0]["opened"], SIZE) - 255 * srgb_of(scene.light_field[4, 0])
    assert np.abs(other).mean() > 10
    focused = srgb_of(refocus(scene.light_field, reported[0]["focused"]))
    assert np.abs(pictured(drawn[0]["focused"], SIZE) - 255 * focused).mean() < 3
    for one in drawn[1:]:
        assert one["opened"].std() > 10
