"""The learned aperture: learned cells, error of the decoder, refused cameras."""

import math

import numpy as np
import pytest
import yaml
from random_worlds import with_pattern
from train_aperture import PATCH_PX, Moments, aperture_of, learned_cells, patch_moments, train

from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import camera_file, find_camera
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.camera import load_camera
from emmc_rig.process.reconstructing import reconstruct

VIEWS = 25


@pytest.fixture(scope="module")
def moments():
    """Of patches of three worlds."""
    return patch_moments(3, 0, (5, 5))


@pytest.fixture
def edited(tmp_path):
    """Return a maker of the shipped camera's file, changed as plain data."""

    def make(change):
        text = yaml.safe_load(camera_file("learned-aperture").read_text(encoding="utf-8"))
        change(text)
        path = tmp_path / "camera.yaml"
        path.write_text(yaml.safe_dump(text), encoding="utf-8")
        return path

    return make


def test_the_cells_weigh_the_views_as_psi_does():
    camera = find_camera("learned-aperture")
    aperture = aperture_of(camera)
    weights = np.einsum("c,scv->sv", aperture.cells(), aperture.basis)
    of_psi = camera.psi((PATCH_PX, PATCH_PX)).weights.sum(axis=4)
    assert np.allclose(weights, of_psi[..., 2, 2].reshape(2, VIEWS), rtol=1e-4)


def test_the_error_is_that_of_the_best_linear_decoder_on_simulated_patches(moments):
    """Draw Gaussian patches and readings, fit a decoder to them by least squares, and compare."""
    camera = find_camera("learned-aperture")
    aperture = aperture_of(camera)
    rng = np.random.default_rng(0)
    flat = moments.covariance.reshape(VIEWS * PATCH_PX**2, -1)
    patches = rng.multivariate_normal(np.zeros(len(flat)), flat, 40_000, method="eigh")
    patches = patches.reshape(-1, VIEWS, PATCH_PX**2)
    psi = camera.psi((PATCH_PX, PATCH_PX))
    weights = psi.weights.sum(axis=4)[..., 2, 2].reshape(2, VIEWS)
    readings = np.einsum("sv,nvp->nsp", weights, patches)
    variance = camera.sensor.noise.variance(weights @ moments.mean, camera.exposures_s(), 3.0)
    readings += np.sqrt(variance)[:, None] * rng.standard_normal(readings.shape)
    readings = readings.reshape(len(readings), -1)
    wanted = patches[:, :, PATCH_PX**2 // 2]
    decoder, *_ = np.linalg.lstsq(readings, wanted, rcond=None)
    missed = float(np.mean(np.square(readings @ decoder - wanted)))
    assert aperture.error(aperture.cells(), moments) == pytest.approx(missed, rel=0.03)


def test_learning_beats_every_random_aperture_and_leaves_little_light_out(moments):
    aperture = aperture_of(find_camera("learned-aperture"))
    cells, errors = learned_cells(aperture, moments, 0)
    rng = np.random.default_rng(7)
    random = [aperture.error(rng.uniform(0, 1, cells.size), moments) for _ in range(20)]
    assert errors == sorted(errors)
    assert errors[0] < min(random) / 10**0.1  # by a decibel
    assert ((cells >= 0) & (cells <= 1)).all()
    assert errors[0] <= aperture.error(aperture.cells(), moments)
    assert aperture.error(cells, moments) == pytest.approx(errors[0])
    assert cells.reshape(2, -1).sum(axis=0).mean() > 0.8  # most views are seen by one shot


def test_one_view_of_no_noise_is_known_and_nothing_else_of_independent_views():
    aperture = aperture_of(find_camera("learned-aperture"))
    size = VIEWS * PATCH_PX**2
    alone = Moments(np.full(VIEWS, 1e-9), np.eye(size).reshape(2 * (VIEWS, PATCH_PX**2)) * 1e6)
    cells = np.zeros(2 * VIEWS)
    cells[[3, VIEWS + 7]] = 1
    assert aperture.error(cells, alone) == pytest.approx(1e6 * (VIEWS - 2) / VIEWS, rel=1e-4)


def test_the_camera_written_is_one_that_commands_take(tmp_path):
    train("learned-aperture", tmp_path / "a.yaml", 2, 1)
    assert load_camera(tmp_path / "a.yaml").psi((8, 8)).light_efficiency() > 0.3
    with pytest.raises(AppError, match="exists already"):
        train("learned-aperture", tmp_path / "a.yaml", 2, 1)
    with pytest.raises(AppError, match=r"ends in \.yaml"):
        train("learned-aperture", tmp_path / "a.h5", 2, 1)


def no_parameters(text):
    text["masks"]["first"]["pattern"] = {"kind": "random_binary", "open_probability": 0.5}


def near_the_sensor(text):
    text["masks"]["second"].update(distance_mm=1.0, cell_um=400.0)


def coloured(text):
    cells = text["masks"]["first"]["pattern"]["cells"]
    text["masks"]["first"]["pattern"]["cells"] = [[[c, c, c] for c in row] for row in cells]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (no_parameters, "random_binary"),
        (coloured, "coloured cells"),
        (near_the_sensor, "distance_mm: 50"),
        (lambda text: text["sensor"].update(cfa="rggb"), "cfa: mono"),
        (lambda text: text.update(shots=[{"masks": ["first"]}] * 2), "share a mask"),
        (lambda text: text.update(shots=[{"masks": ["first", "second"]}]), "one in each shot"),
    ],
)
def test_what_cannot_be_learned_is_refused_by_name(edited, tmp_path, change, named):
    out = tmp_path / "out.yaml"
    with pytest.raises(AppError, match=named):
        train(str(edited(change)), out, 1, 0)
    assert not out.exists()


def random_aperture(camera):
    rng = np.random.default_rng(5)
    for name in camera.masks:
        camera = with_pattern(camera, name, cells=rng.uniform(0, 1, (5, 5)).tolist())
    return camera


def test_the_shipped_aperture_is_better_than_a_random_one_by_the_moments_of_other_worlds():
    moments = patch_moments(3, 1, (5, 5))
    shipped = find_camera("learned-aperture")
    learned, random = (
        -10 * math.log10(aperture.error(aperture.cells(), moments))
        for aperture in map(aperture_of, (shipped, random_aperture(shipped)))
    )
    assert learned > random + 1


def test_the_shipped_aperture_is_better_where_neither_worlds_nor_a_linear_decoder_are_involved():
    """A built-in scene in grey, reconstructed by total variation."""
    size = (48, 64)
    coloured = open_scene("deep-occlusions", size).light_field
    grey = np.repeat(coloured.mean(axis=-1, keepdims=True), 3, axis=-1)
    shipped = find_camera("learned-aperture")
    learned, random = (
        -10
        * math.log10(
            np.mean(
                np.square(
                    reconstruct(
                        camera.psi(size), camera.expose(grey, seed=0), "tv"
                    ).light_field.mean(-1)
                    - grey[..., 0]
                )
            )
        )
        for camera in (shipped, random_aperture(shipped))
    )
    assert learned > random + 1
