"""The Python API: the snippet of the documentation, arrays and frames alike, what is shown."""

import doctest
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import Any

import matplotlib
import numpy as np
import pytest
import yaml
from matplotlib import pyplot
from scipy import sparse

import emmc_rig as emmc
from emmc_rig.formats import scenes
from emmc_rig.model.lightfield import load_hdf5, psnr_db
from emmc_rig.model.sensing import Psi

SNIPPET = """
import emmc_rig as emmc
camera = emmc.camera("rgbw-bayer-1shot")
scene = emmc.scene("deep-occlusions", size=(64, 80))
psi = camera.psi(scene.size)
frames = psi @ scene                      # or camera.expose(scene, seed=0), with noise
result = emmc.reconstruct(psi, frames)    # the default method
result.light_field, result.sigma, result.disparity, result.verdict
result.show()  # result.figure(other, truth=scene) for papers; _repr_html_ in notebooks
rig = emmc.rig("simulated"); emmc.capture("plan.yaml", rig); emmc.calibrate("plan-session")
"""
PLAN = {
    "camera": "rgbw-bayer-1shot",
    "shots": [{"exposure_s": 0.05}],
    "whiteboards": {
        "views": [[2, 2]],
        "shots": [0],
        "references": 2,
        "open": [{"repeats": 2}, {"validation": True}],
    },
    "darks": {"repeats": 2},
}


@pytest.fixture(autouse=True)
def headless():
    """Draw into memory: no window, wherever the tests run."""
    before = matplotlib.get_backend()
    matplotlib.use("agg")
    yield
    pyplot.close("all")
    matplotlib.use(before)


@pytest.fixture(scope="module")
def taken():
    """A small scene, its Psi and its frames with noise."""
    camera = emmc.camera("rgbw-bayer-2shots")
    scene = emmc.scene("deep-occlusions", size=(36, 44))
    psi = camera.psi(scene.size)
    return scene, psi, camera.expose(scene, seed=0, psi=psi)


@pytest.mark.slow
def test_the_snippet_of_the_documentation_runs_as_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # The simulated rig's default, smaller: the snippet names no size.
    monkeypatch.setattr(scenes, "_DEFAULT_SIZE_PX", (32, 48))
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    names = {}
    exec(SNIPPET, names)
    result, scene = names["result"], names["scene"]
    assert result.light_field.shape == (5, 5, 64, 80, 3)
    assert result.sigma.shape == (5, 5, 64, 80)
    assert result.disparity.shape == (64, 80)
    assert result.verdict.level in ("trust", "cannot tell", "doubt", "do not use")
    compared = result.compare(scene)
    assert compared["psnr_db"] == psnr_db(result.light_field, scene.light_field)
    assert compared["psnr_db"] > compared["replicate_psnr_db"]
    session = emmc.Session(tmp_path / "plan-session")
    assert session.is_complete
    assert (session.folder / "report.html").is_file()


@pytest.mark.slow
def test_a_session_goes_on_without_its_rig_and_calibrates_to_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    rig = emmc.rig("simulated", scene="near-planar", size=(32, 48), rays=256)
    assert "near-planar" in repr(rig)
    with pytest.raises(emmc.ERRORS, match="say which rig"):
        emmc.capture("plan.yaml")
    session = emmc.capture("plan.yaml", rig)
    assert repr(session).endswith("12 of 12 frames)")
    assert emmc.capture(session.folder).stored == session.stored
    calibration = emmc.calibrate(session)
    calibration.save("psi")
    saved = Psi.load(tmp_path / "psi" / "psi.h5")
    np.testing.assert_array_equal(saved.weights, calibration.psi.weights)
    assert "validation error" in repr(calibration)
    assert "32x48" in repr(calibration)
    psi, frames = emmc.open_frames(session.folder)
    assert frames.shape == psi.frames_shape == (1, 32, 48)


@pytest.mark.slow
def test_an_array_of_readings_is_taken_with_the_noise_of_the_sensor(taken):
    _, psi, frames = taken
    given = emmc.reconstruct(psi, frames, "tv")
    array = emmc.reconstruct(psi, frames.readings, "tv")
    assert array.frames.noise_sigma == pytest.approx(frames.noise_sigma, rel=1e-6)
    np.testing.assert_allclose(array.light_field, given.light_field, atol=1e-5)
    quiet = emmc.reconstruct(psi, frames.readings, "tv", noise_sigma=1e-4)
    assert quiet.frames.noise_sigma == pytest.approx(1e-4)


def test_an_array_for_a_psi_of_no_known_camera_needs_its_noise(taken):
    _, psi, frames = taken
    unknown = Psi(psi.weights, psi.colour, psi.binning)
    with pytest.raises(emmc.ERRORS, match="give the readings' noise_sigma"):
        emmc.reconstruct(unknown, frames.readings)
    with pytest.raises(emmc.ERRORS, match="frames of shape"):
        emmc.reconstruct(psi, frames.readings[:, :-2])


def test_without_pytorch_a_line_names_the_extra(taken, monkeypatch):
    _, psi, _ = taken
    for name in [name for name in sys.modules if name.startswith("emmc_rig.torch")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(emmc.ERRORS, match=r'needs torch: pip install "emmc-rig\[torch\]"$'):
        psi.to_torch()


@pytest.mark.slow
def test_frames_are_arrays_to_numpy(taken):
    scene, psi, frames = taken
    np.testing.assert_array_equal(np.asarray(frames), frames.readings)
    np.testing.assert_array_equal(psi @ scene, psi.forward(scene.light_field))
    np.testing.assert_array_equal(psi.T @ frames, psi.adjoint(frames.readings))
    error = frames.readings - frames.noise_free
    assert frames.noise_sigma == pytest.approx(error.std(), rel=0.06)


def test_a_result_is_saved_as_the_command_saves_it(taken, tmp_path):
    _, psi, frames = taken
    result = emmc.reconstruct(psi, frames, "dict-admm", dictionary="lambertian")
    result.save(tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "files.json",
        "frames.h5",
        "light_field.h5",
        "maps.h5",
        "metrics.json",
        "psi.h5",
        "report.html",
    }
    saved = load_hdf5(tmp_path / "out" / "light_field.h5")
    np.testing.assert_array_equal(saved, result.light_field)
    assert result.metrics()["dictionary"] == "lambertian"
    assert result.sigma is None
    assert result.disparity is None


def test_what_the_api_returns_is_shown_in_one_line(taken):
    scene, psi, frames = taken
    result = emmc.reconstruct(psi, frames, "tv")
    assert repr(scene) == "Scene('deep-occlusions', 5x5 views of 36x44)"
    assert repr(psi) == "Psi(2 shots, 5x5 views, 36x44, rggb, 0.32 MB)"
    assert repr(frames).startswith("SimulatedFrames(2 shots of 36x44 pixels, noise ")
    assert repr(result).startswith("Result(tv, 5x5 views of 36x44, converged in ")
    assert str(emmc.camera("rgbw-mono")).startswith("Camera(")
    assert len(repr(emmc.camera("rgbw-mono"))) < 120
    page = result._repr_html_()
    assert page.count("<iframe") == 1
    assert "viewer-data" in page
    assert "verdict: " in page


def test_public_names_are_functions_and_classes_and_no_folder_is_called_as_one():
    folders = {path.name for path in Path(emmc.__path__[0]).iterdir()}
    assert folders.isdisjoint(emmc.__all__)
    functions = "calibrate camera capture frames open_frames reconstruct rig scene"
    for name in functions.split():
        assert isinstance(getattr(emmc, name), FunctionType)
        assert getattr(emmc, name).__doc__
    for name in ("Camera", "Frames", "Psi", "Result", "Scene", "Session"):
        assert isinstance(getattr(emmc, name), type)
    assert set(emmc.__all__) <= set(dir(emmc))
    with pytest.raises(AttributeError, match="recontruct"):
        _ = emmc.recontruct


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "unwanted"),
    [
        ("emmc_rig", ["numpy", "pydantic", "typer"]),
        ("emmc_rig.captures.run", ["matplotlib"]),
        ("emmc_rig.process.reconstructing", ["torch"]),
        ("emmc_rig.captures.sequencer", ["matplotlib"]),
        ("emmc_rig.cli", ["numpy", "scipy", "cv2", "numba", "matplotlib", "pydantic"]),
    ],
)
def test_a_module_loads_only_what_it_needs(module, unwanted):
    code = f"import sys, {module}; print(*sorted(set({unwanted}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize(
    "module",
    [
        "emmc_rig",
        "emmc_rig.formats.cameras",
        "emmc_rig.formats.scenes",
        "emmc_rig.model.sensing",
        "emmc_rig.process.filming",
        "emmc_rig.process.raw_frames",
        "emmc_rig.process.reconstructing",
        "emmc_rig.process.result",
        "emmc_rig.bench.rig_config",
    ],
)
def test_the_examples_in_docstrings_give_what_they_show(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tested = doctest.testmod(import_module(module), extraglobs={})
    assert tested.attempted > 0
    assert tested.failed == 0


PAGE = Path(__file__).parents[2] / "docs/api.md"
WAY_IN = """
    psi = emmc.Psi.from_scipy(matrix, views=(5, 5), size=(40, 60), cfa="rggb")
    psi = emmc.Psi.from_weights(weights)
    camera = emmc.camera(described)
    frames = emmc.frames(dn, dark=dark, white_level=4095, gain=0.8, read_noise=2.5)
    calibration = emmc.calibrate(whiteboards, poses, camera, darks=darks)
    result = emmc.reconstruct(calibration.psi
"""


def test_the_page_for_those_with_a_pipeline_of_their_own_has_each_line_of_the_way_in():
    typed = [example.source for example in doctest.DocTestParser().get_examples(PAGE.read_text())]
    for line in WAY_IN.strip().splitlines():
        assert any(source.startswith(line.strip()) for source in typed), line
    for name in ("light_field", "sigma", "disparity", "verdict"):
        assert any(f"result.{name}" in source for source in typed), name


@pytest.mark.slow
def test_the_page_for_those_with_a_pipeline_of_their_own_gives_what_it_shows(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tested = doctest.testfile(str(PAGE), module_relative=False)
    assert tested.attempted > 10
    assert tested.failed == 0


CAMERA = {"title": "no mask", "sensor": {"cfa": "mono"}}
api: Any = emmc
"""The package, for calls that its types forbid."""


def mask_of(cells):
    """A mask before the sensor whose cells are an array."""
    pattern = {"kind": "parameters", "cells": cells}
    return {"distance_mm": 1.0, "cell_um": 24, "pattern": pattern}


def codes_of(frames):
    """Frames as a picture has them: 8 bits, with a gamma."""
    light = np.clip(frames.readings / frames.readings.max(), 0, 1)
    return np.round(255 * light ** (1 / 2.2)).astype(np.uint8)


def sized(change):
    """Reconstruct readings of another shape."""
    return lambda t: api.reconstruct(t[1], change(t[2].readings))


MISTAKES = {
    "a camera of no name": (lambda t: api.camera(3), "camera: got 3; it takes a shipped camera's"),
    "a camera without title": (lambda t: api.camera({}), "the camera: title: field required"),
    "a misspelt key": (lambda t: api.camera({**CAMERA, "lense": {}}), "did you mean 'lens'"),
    "shots as text": (lambda t: api.camera("rgbw-mono", shots="2"), "shots: got '2'"),
    "a scene of nothing": (lambda t: api.scene(None), "scene: got None; it takes a name"),
    "a scene of codes": (
        lambda t: api.scene(np.zeros((2, 2, 4, 4, 3), np.uint8)),
        r"uint8, .*: scene / 255 of linear codes, \(scene / 255\) \*\* 2.2 of a picture's",
    ),
    "a grey scene": (
        lambda t: api.scene(np.zeros((2, 2, 4, 4))),
        r"\(v, u, y, x, c\): scene\[..., None\].repeat\(3, axis=-1\) of grey$",
    ),
    "a scene of one colour": (
        lambda t: api.scene(np.zeros((2, 2, 4, 4, 1))),
        r"needs 3 \(RGB\): scene.repeat\(3, axis=-1\) of grey$",
    ),
    "exposing codes": (
        lambda t: api.camera("rgbw-mono").expose(np.zeros((5, 5, 24, 32, 3), np.uint16)),
        "scene / 65535 of linear codes",
    ),
    "an exposure below 0": (
        lambda t: api.camera("rgbw-mono").expose(t[0], exposure_s=-1),
        "exposure_s: got -1; it takes seconds, of every shot or of each of 1",
    ),
    "an exposure too many": (
        lambda t: api.camera("rgbw-bayer-2shots").expose(t[0], exposure_s=(1, 2, 3)),
        "exposure_s: .* of each of 2",
    ),
    "a mask that is nowhere": (
        lambda t: api.camera({**CAMERA, "masks": {"code": np.ones((9, 9))}}),
        "masks.code: cells alone do not say where the mask is",
    ),
    "a Psi for frames": (lambda t: api.Frames(t[1], t[1], t[1]), "readings: got Psi of shape"),
    "a size of one side": (lambda t: api.scene("dark", size=24), "size: got 24; it takes rows"),
    "half a pixel": (lambda t: api.scene("dark", size=(24.5, 32)), "size: got tuple"),
    "a seed as text": (lambda t: api.scene("dark", size=(24, 32), seed="a"), "seed: got 'a'"),
    "a picture as a folder": (lambda t: api.open_frames(__file__), "a file; open_frames takes"),
    "frames of an array": (lambda t: api.open_frames(t[2].readings), "folder: got ndarray"),
    "a Psi of SciPy": (lambda t: api.reconstruct(t[1].to_scipy(), t[2]), "Psi.from_scipy"),
    "a Psi's file": (lambda t: api.reconstruct("psi.h5", t[2]), "psi: got 'psi.h5'; it takes"),
    "Psi and frames swapped": (lambda t: api.reconstruct(t[2], t[1]), "psi: got SimulatedFrames"),
    "no frames": (lambda t: api.reconstruct(t[1], None), "frames: got None; it takes frames"),
    "ragged frames": (lambda t: api.reconstruct(t[1], [[1], [1, 2]]), "frames: got list"),
    "complex frames": (lambda t: api.reconstruct(t[1], t[2].readings * 1j), "frames: got ndarray"),
    "no method": (lambda t: api.reconstruct(t[1], t[2], None), "method: got None"),
    "settings of a number": (lambda t: api.reconstruct(t[1], t[2], settings=3), "settings: got 3"),
    "a misspelt setting": (
        lambda t: api.reconstruct(t[1], t[2], settings={"tv": {"step": 1}}),
        "unknown key 'tv.step'",
    ),
    "noise below 0": (
        lambda t: api.reconstruct(t[1], t[2], noise_sigma=-1),
        "noise_sigma: got -1",
    ),
    "noise as text": (lambda t: api.reconstruct(t[1], t[2], noise_sigma="a"), "noise_sigma: got"),
    "usable as a list": (lambda t: api.reconstruct(t[1], t[2], usable=[True]), "usable: got list"),
    "a dictionary of a number": (
        lambda t: api.reconstruct(t[1], t[2], "dict-admm", dictionary=3),
        "dictionary: got 3",
    ),
    "a step that is no function": (
        lambda t: api.reconstruct(t[1], t[2], on_step=3),
        "on_step: got 3",
    ),
    "a rig of no name": (lambda t: api.rig(None), "rig: got None; it takes"),
    "a rig of no size": (lambda t: api.rig("simulated", size="x"), "size: input should be"),
    "a plan of no name": (lambda t: api.capture(None), "plan: got None; it takes"),
    "a rig of a number": (lambda t: api.capture("plan.yaml", 3), "rig: got 3; it takes"),
    "a session of nothing": (lambda t: api.calibrate(None), "session: got None; it takes"),
    "Session of nothing": (lambda t: api.Session(None), "session: got None; it takes"),
    "weights of a list": (lambda t: api.Psi([[1]], None), "weights: got list; it takes"),
    "weights of whole numbers": (
        lambda t: api.Psi(np.ones((1, 1, 1, 4, 3, 6), dtype=int), None),
        "int64; it takes",
    ),
    "a file of no name": (lambda t: api.Psi.load(None), "path: got None; it takes"),
    "a dense matrix": (lambda t: api.Psi.from_scipy(np.eye(6), (1, 1), (2, 3)), "matrix: got nd"),
    "a matrix of another size": (
        lambda t: api.Psi.from_scipy(sparse.eye_array(6), (2, 2), (2, 3)),
        "need 24 or 72 columns, and 6 rows a shot",
    ),
    "a matrix that blurs": (
        lambda t: api.Psi.from_scipy(sparse.eye_array(6, k=1), (1, 1), (2, 3)),
        r"5 entries lie off their pixel, the first in row 0, column 1: pixel \(0, 0\)",
    ),
    "weights of no shots": (
        lambda t: api.Psi.from_weights(np.ones((2, 2, 4, 6))),
        r"weights: got ndarray of shape \(2, 2, 4, 6\), float64; it takes an array \(shot, v, u, y",
    ),
    "weights of four colours": (
        lambda t: api.Psi.from_weights(np.ones((1, 2, 2, 4, 6, 4))),
        "weights: got ndarray of shape",
    ),
    "weights that are not finite": (
        lambda t: api.Psi.from_weights(np.full((1, 1, 1, 4, 6), np.nan)),
        "entries that are not finite",
    ),
    "weights below 0": (
        lambda t: api.Psi.from_weights(np.linspace(-0.1, 1, 24).reshape(1, 1, 1, 4, 6)),
        "weights down to -0.1, and a pixel sees no less than no light",
    ),
    "weights that are masked": (
        lambda t: api.Psi.from_weights(np.ma.masked_equal(np.eye(4)[None, None, None], 1)),
        "weights: 4 of its values are masked, so not valid",
    ),
    "readings that are masked": (
        lambda t: api.reconstruct(t[1], np.ma.masked_less(t[2].readings, 0.1), "tv"),
        r"frames: \d+ of its values are masked, so not valid",
    ),
    "readings of shots last": (
        lambda t: api.reconstruct(t[1], np.moveaxis(t[2].readings, 0, -1), "tv"),
        r"the axis of shots comes first: np.moveaxis\(frames, -1, 0\)",
    ),
    "a folder without a result": (lambda t: api.open_result("nowhere"), "nowhere: no such folder"),
    "a result of a number": (lambda t: api.open_result(3), "folder: got 3; it takes"),
    "a mask that lets nothing through": (
        lambda t: api.Psi.from_weights(np.zeros((1, 1, 1, 4, 6))),
        "weights that are all 0",
    ),
    "pixels that cut samples": (
        lambda t: api.Psi.from_weights(np.ones((1, 1, 1, 5, 6)), binning=2),
        r"pixels of 2x2 samples do not divide \(5, 6\)",
    ),
    "a mask of three values a cell by twos": (
        lambda t: api.camera({**CAMERA, "masks": {"code": mask_of(np.ones((4, 4, 2)))}}),
        "masks.code.pattern.parameters: expected a 2-dimensional array",
    ),
    "a mask with a hole in its numbers": (
        lambda t: api.camera({**CAMERA, "masks": {"code": mask_of(np.full((4, 4), np.nan))}}),
        "masks.code.pattern.parameters: transmittance must lie in",
    ),
    "raw values": (
        lambda t: api.reconstruct(t[1], t[2].frames_dn),
        r"frames: whole numbers up to \d+ are raw values, no readings: emmc_rig.frames\(dn",
    ),
    "raw values as floating ones": (
        lambda t: api.reconstruct(t[1], t[2].frames_dn.astype(float)),
        "are raw values, no readings",
    ),
    "a picture's codes": (
        lambda t: api.reconstruct(t[1], codes_of(t[2]), noise_sigma=0.01),
        "are raw values, no readings.*codes of a picture have a gamma",
    ),
    "a picture's codes from 0 to 1": (
        lambda t: api.reconstruct(t[1], codes_of(t[2]) / np.float32(255), noise_sigma=0.01),
        r"multiples of 1/255 are codes of a picture, whose light has a gamma: .*gamma=2.2",
    ),
    "one shot without its axis": (
        sized(lambda r: r[0]),
        "2 axes instead of three|an axis of shots",
    ),
    "frames with the shots last": (
        sized(lambda r: np.moveaxis(r, 0, -1)),
        r"the axis of shots comes first: np.moveaxis\(frames, -1, 0\)",
    ),
    "a colour picture": (
        sized(lambda r: np.repeat(r[0][..., None], 3, axis=-1)),
        "a picture of three colours",
    ),
    "one shot of two": (sized(lambda r: r[:1]), r"shots given: 1, Psi is of 2: use the Psi"),
    "rows as columns": (sized(lambda r: r.swapaxes(1, 2)), r"swapped: frames.swapaxes\(1, 2\)"),
    "frames not binned": (
        sized(lambda r: np.kron(r, np.ones((1, 2, 2)))),
        "2 times as many pixels along each side: bin them",
    ),
    "frames binned": (sized(lambda r: r[:, ::2, ::2]), "2 times fewer pixels along each side"),
    "frames with a border": (sized(lambda r: np.pad(r, 1)[1:-1]), "cut out the part that Psi is"),
    "frames of another sensor": (sized(lambda r: r[:, :-3]), "frames of another sensor or part"),
    "a light field as text": (lambda t: t[1] @ "scene", "light field: got 'scene'"),
    "frames as text": (lambda t: t[1].T @ "frames", "frames: got 'frames'"),
    "Psi of one side": (lambda t: api.camera("rgbw-mono").psi(24), "size: got 24; it takes"),
    "exposing a name": (lambda t: api.camera("rgbw-mono").expose("dark"), "scene: got 'dark'"),
    "a Psi of no camera": (
        lambda t: api.reconstruct(replace(t[1], camera_json="{}"), t[2].readings),
        "Psi's camera: title: field required",
    ),
    "frames of lists": (lambda t: api.Frames([1], [1], [1]), "readings: got list"),
    "frames of two shapes": (
        lambda t: api.Frames(t[2].readings, t[2].deviation[:, 1:], t[2].usable),
        "need one shape",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_a_public_name_does_not_take_is_refused_in_one_line(taken, mistake):
    call, words = MISTAKES[mistake]
    with pytest.raises(emmc.ERRORS, match=words) as refused:
        call(taken)
    assert "\n" not in str(refused.value)


def test_a_camera_is_also_a_dict_or_a_camera_and_a_scene_also_an_array(taken):
    scene, _, _ = taken
    camera = emmc.camera("rgbw-bayer-2shots")
    assert emmc.camera(camera.model_dump(mode="json")) == emmc.camera(camera) == camera
    given = emmc.scene(np.asarray(scene), size=(20, 24))
    np.testing.assert_array_equal(given, np.asarray(emmc.scene(scene, size=(20, 24))))
    np.testing.assert_array_equal(given, np.asarray(scene)[:, :, 8:28, 10:34])


@pytest.mark.parametrize("name", ["rgbw-bayer-2shots", "rgbw-mono"])
@pytest.mark.parametrize("binning", [1, 2])
def test_a_psi_becomes_a_matrix_of_scipy_and_comes_back(name, binning):
    description = emmc.camera(name).model_dump(mode="json")
    description["sensor"]["binning"] = binning
    psi = emmc.camera(description).psi((12, 16))
    back = emmc.Psi.from_scipy(psi.to_scipy(), (5, 5), (12, 16), binning=binning)
    assert back.frames_shape == psi.frames_shape
    np.testing.assert_array_equal(back.to_scipy().toarray(), psi.to_scipy().toarray())
    assert back.weights.shape == psi.weights.shape


def test_a_matrix_without_colours_gets_those_of_the_filters():
    rng = np.random.default_rng(0)
    weights = rng.uniform(size=(2, 3, 4, 6))  # (v, u, y, x)
    views = [np.diag(view.ravel()) for view in weights.reshape(6, 4, 6)]
    matrix = sparse.csr_array(np.hstack(views))
    light_field = rng.uniform(size=(2, 3, 4, 6, 3)).astype(np.float32)
    psi = emmc.Psi.from_scipy(matrix, (2, 3), (4, 6), cfa="rggb")
    tile = np.array([[0, 1], [1, 2]])  # red, green; green, blue
    y, x = np.indices((4, 6))
    seen = light_field[:, :, y, x, tile[y % 2, x % 2]]
    np.testing.assert_allclose((psi @ light_field)[0], (weights * seen).sum(axis=(0, 1)), rtol=1e-5)
    mono = emmc.Psi.from_scipy(matrix, (2, 3), (4, 6))
    grey = light_field.mean(axis=-1)
    np.testing.assert_allclose(
        (mono @ light_field)[0], (weights * grey).sum(axis=(0, 1)), rtol=1e-5
    )


@pytest.mark.parametrize("binning", [1, 2])
@pytest.mark.parametrize("cfa", ["mono", "rggb", ("RW", "GB")])
def test_readings_are_the_sum_over_views_of_weight_times_the_light_that_filters_let_through(
    cfa, binning
):
    rng = np.random.default_rng(0)
    weights, light = rng.uniform(size=(2, 1, 7, 4, 6)), rng.uniform(size=(1, 7, 4, 6, 3))
    psi = emmc.Psi.from_weights(weights, cfa, binning)
    tile = {"mono": ["W"], "rggb": ["RG", "GB"], ("RW", "GB"): ["RW", "GB"]}[cfa]
    passed = {"R": (1, 0, 0), "G": (0, 1, 0), "B": (0, 0, 1), "W": np.full(3, 1 / 3)}
    expected = np.zeros((2, 4 // binning, 6 // binning))
    for y, x in np.ndindex(4, 6):
        row, column = y // binning, x // binning
        letter = tile[row % len(tile)][column % len(tile[0])]
        seen = light[:, :, y, x] @ np.asarray(passed[letter])
        expected[:, row, column] += (weights[..., y, x] * seen).sum(axis=(1, 2))
    np.testing.assert_allclose(psi @ light, expected, atol=1e-5)
    back = emmc.Psi.from_scipy(psi.to_scipy(), (1, 7), (4, 6), binning=binning)
    np.testing.assert_array_equal(back.to_scipy().toarray(), psi.to_scipy().toarray())


def test_light_without_colours_is_reconstructed_as_grey():
    rng = np.random.default_rng(1)
    weights = rng.uniform(0, 1, (3, 1, 3, 24, 32))
    psi = emmc.Psi.from_weights(weights / weights.sum(axis=(1, 2)).mean())
    assert psi.weights.shape[4] == 1
    y, x = np.indices((24, 32))
    grey = 0.5 + 0.3 * np.sin(x / 5 + np.arange(3)[:, None, None]) * np.cos(y / 7)
    light = np.repeat(grey[None, ..., None], 3, axis=-1)
    result = emmc.reconstruct(psi, psi @ light, "tv", noise_sigma=1e-3)
    found = result.light_field
    np.testing.assert_array_equal(found, np.repeat(found[..., :1], 3, axis=-1))
    assert np.sqrt(np.mean((psi @ found - psi @ light) ** 2)) < 0.003
    assert np.sqrt(np.mean((found - light) ** 2)) < 0.1


def test_weights_of_every_colour_are_psi_s_own():
    psi = emmc.camera("rgbw-bayer-2shots").psi((6, 8))
    dense = psi.to_scipy().toarray().reshape(*psi.frames_shape, *psi.light_field_shape)
    weights = np.einsum("syxvuyxc->svuyxc", dense)
    again = emmc.Psi.from_weights(weights)
    np.testing.assert_array_equal(again.weights, psi.weights)
    np.testing.assert_array_equal(again.colour, psi.colour)


def test_a_matrix_that_names_a_place_twice_means_the_sum():
    twice = sparse.csr_array((np.ones(3), [0, 0, 1], [0, 2, 3]), shape=(2, 2))
    psi = emmc.Psi.from_scipy(twice, (1, 1), (1, 2))
    np.testing.assert_allclose(psi @ np.ones((1, 1, 1, 2, 3)), [[[2, 1]]], rtol=1e-6)


def test_the_cells_of_a_mask_are_an_array_as_well_as_lists():
    cells = np.random.default_rng(0).random((64, 80)) < 0.5
    views = np.array([3, 3])
    listed = mask_of(cells.astype(int).tolist())
    camera = {**CAMERA, "masks": {"code": listed}, "views": [3, 3]}
    given = emmc.camera({**camera, "masks": {"code": mask_of(cells)}, "views": views})
    assert given == emmc.camera(camera)
    np.testing.assert_array_equal(
        given.psi((12, 16)).weights, emmc.camera(camera).psi((12, 16)).weights
    )


def test_a_verdict_is_one_sentence(taken):
    _, psi, frames = taken
    verdict = emmc.reconstruct(psi, frames, "tv").verdict
    assert str(verdict) == verdict.words
    assert str(verdict).startswith(f"{verdict.level}: ")
    assert len(repr(verdict)) < 60


@pytest.mark.parametrize(
    "arguments", [("capture", "missing.yaml"), ("capture", "plan.yaml"), ("reconstruct", "missing")]
)
def test_a_mistake_in_a_name_or_plan_is_reported_before_heavy_packages_load(tmp_path, arguments):
    (tmp_path / "plan.yaml").write_text("camera: rgbw-bayer-2shots\nshot: []\n")
    code = (
        f"import sys; sys.argv = ['emmc-rig', *{arguments}]\n"
        "from emmc_rig.cli import main\n"
        "try: main()\n"
        "finally: print(*sorted({'numba', 'scipy', 'cv2', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (1, "\n"), done.stderr
