"""The imaging matrix: every pattern, CFA and binning against dense matrices and traced rays."""

from itertools import product

import cv2
import h5py
import numpy as np
import pytest
from scipy.sparse.linalg import aslinearoperator, lsqr

from emmc_rig.model.arguments import ArgumentError
from emmc_rig.model.camera import Camera, build_imaging_matrix, draw_plates, sensor_response
from emmc_rig.model.errors import SensingError
from emmc_rig.model.masks import CFA
from emmc_rig.model.sensing import Psi

EPS = float(np.finfo(np.float32).eps)
VIEWS = (2, 3)
SIZE = (6, 12)
LENS_MM = 50.0
USER_TILE = ("RWG", "BGW")
TILES = [*CFA, USER_TILE]
NEAR_SENSOR = {
    "open": {},
    "pinhole": {"side_cells": 9.5},
    "random_rgbw": {"seed": 1, "redraw": True},
    "random_binary": {"seed": 2, "open_probability": 0.6},
    "uniform_colour": {"seed": 3},
    "gaussian_colour": {"seed": 4, "redraw": True},
    "gaussian_monochrome": {"seed": 5},
    "sinusoids": {"cycles_per_mm": [[9.0, 4.0], [0.0, 7.0]]},
    "mura": {"prime": 5},
    "tile": {"cells": [[[1, 0.5, 0], [0, 0.25, 1], [0.5, 0.5, 1]]]},
}
AT_LENS = {
    "sequence": {"scan": (3, 2)},
    "parameters": {"cells": [[0.25, 1.0, 0.5], [0.75, 0.0, 0.125]]},
}
KINDS = [*NEAR_SENSOR, *AT_LENS, "picture"]


def solved_blocks(psi, ridge, frames):
    """Return (Psi Psi^T + diag(ridge))^-1 frames."""
    return np.einsum("styx,tyx->syx", psi.inverted_blocks(ridge), frames)


def camera(masks, cfa="mono", binning=1, count=1, steps=None, views=VIEWS, **settings):
    """Return a camera of `count` shots whose masks move by `steps` (um) from shot to shot."""
    described = Camera.model_validate(
        {
            "title": "test",
            "views": views,
            "lens": {"distance_mm": LENS_MM, "aperture_cell_mm": 5.0},
            "sensor": {"cfa": cfa, "binning": binning},
            "masks": masks,
            "more_shots_step_um": steps or {},
            **settings,
        }
    )
    return described if "shots" in settings else described.with_shots(count)


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    path = tmp_path_factory.mktemp("masks") / "mask.png"
    codes = np.random.default_rng(6).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    assert cv2.imwrite(str(path), codes)
    return path


@pytest.fixture
def coded_camera(picture):
    """Return a function that makes a camera with one mask of a kind."""

    def made(kind, cfa, binning=1, shots=1):
        if kind in AT_LENS:
            mask = {"distance_mm": LENS_MM, "cell_um": 5000, "pattern": {"kind": kind}}
            mask["pattern"].update(AT_LENS[kind])
            return camera({"m": mask}, cfa, binning, shots)
        settings = (
            {"path": str(picture), "repeat": True} if kind == "picture" else NEAR_SENSOR[kind]
        )
        pattern = {"kind": kind, **settings}
        mask = {"distance_mm": 0.3, "cell_um": 31.0, "pattern": pattern}
        return camera({"m": mask}, cfa, binning, shots, {"m": (40.0, -25.0)})

    return made


def random_light_field(psi, seed=0):
    rng = np.random.default_rng(seed)
    return rng.standard_normal(psi.light_field_shape).astype(psi.weights.dtype)


def random_frames(psi, seed=1):
    rng = np.random.default_rng(seed)
    return rng.standard_normal(psi.frames_shape).astype(psi.weights.dtype)


def plain_forward(psi, light_field):
    """Return the frames by the definition: every sample adds to the pixel that holds it."""
    frames = np.zeros(psi.frames_shape)
    shots, views_v, views_u, rows, _, columns = psi.weights.shape
    for s, v, u, y in product(range(shots), range(views_v), range(views_u), range(rows)):
        for x in range(columns):
            weight = psi.weights[s, v, u, y, :, x].astype(np.float64)
            light = light_field[v, u, y, x].astype(np.float64)
            if psi.colour is not None:
                light = light[psi.colour[s, y, x]]
            frames[s, y // psi.binning, x // psi.binning] += (weight * light).sum()
    return frames


def matrix_gram(psi, matrix):
    """Return the diagonals of the (shot, shot) blocks of Psi Psi^T, and check the rest is zero."""
    pixels = matrix.shape[0] // psi.shots
    full = (matrix @ matrix.T).tocoo()
    assert not (full.data[full.row % pixels != full.col % pixels]).any()
    blocks = np.zeros((psi.shots, psi.shots, pixels))
    np.add.at(blocks, (full.row // pixels, full.col // pixels, full.row % pixels), full.data)
    return blocks.reshape(psi.shots, *psi.frames_shape)


def assert_operator_equals_matrix(psi):
    """Forward, adjoint, Gram blocks and norms equal those of the explicit matrix."""
    matrix = psi.to_scipy().astype(np.float64)
    dense = matrix.toarray()
    assert dense.shape == psi.shape
    eps = float(np.finfo(psi.weights.dtype).eps)
    light_field, frames = random_light_field(psi), random_frames(psi)
    terms = psi.weights.size // int(np.prod(psi.frames_shape))
    seen = psi.forward(light_field)
    lit = psi.adjoint(frames)
    assert seen.dtype == lit.dtype == psi.weights.dtype
    assert np.abs(seen.ravel() - dense @ light_field.ravel()).max() <= (
        eps * terms * (abs(matrix) @ np.abs(light_field.ravel())).max()
    )
    assert np.abs(lit.ravel() - dense.T @ frames.ravel()).max() <= (
        eps * psi.shots * (abs(matrix.T) @ np.abs(frames.ravel())).max()
    )
    forward = np.vdot(seen.astype(np.float64), frames.astype(np.float64))
    backward = np.vdot(light_field.astype(np.float64), lit.astype(np.float64))
    bound = 4 * eps * np.linalg.norm(dense @ light_field.ravel()) * np.linalg.norm(frames)
    assert abs(forward - backward) <= bound
    np.testing.assert_allclose(psi.gram, matrix_gram(psi, matrix), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(psi.row_norms().ravel(), np.linalg.norm(dense, axis=1), 1e-12)
    return dense


@pytest.mark.parametrize("cfa", TILES, ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_forward_and_adjoint_are_the_explicit_matrix(coded_camera, kind, cfa):
    for binning, shots in product((1, 2, 3), (1, 3)):
        psi = build_imaging_matrix(coded_camera(kind, cfa, binning, shots), SIZE)
        assert_operator_equals_matrix(psi)


@pytest.mark.parametrize("cfa", TILES, ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_forward_is_its_plain_definition_and_reaches_no_other_colour(coded_camera, kind, cfa):
    described = coded_camera(kind, cfa, 2, 2)
    psi = build_imaging_matrix(described, (4, 6))
    light_field = random_light_field(psi)
    np.testing.assert_allclose(
        psi.forward(light_field), plain_forward(psi, light_field), rtol=1e-5, atol=2e-6
    )
    assert (psi.colour is None) == any("W" in row for row in CFA.get(cfa, cfa))
    response = np.repeat(sensor_response(described, (4, 6))[:, None], VIEWS[0], axis=1)
    unseen = np.broadcast_to((response.sum(axis=0) == 0)[:, None], psi.light_field_shape)
    assert not psi.to_scipy().toarray()[:, unseen.ravel()].any()


@pytest.mark.parametrize("binning", [1, 2, 3])
@pytest.mark.parametrize("cfa", TILES, ids=str)
def test_an_open_camera_reads_1_from_a_white_light_field(cfa, binning):
    psi = build_imaging_matrix(camera({}, cfa, binning), SIZE)
    white = np.ones(psi.light_field_shape, dtype=np.float32)
    np.testing.assert_allclose(psi.forward(white), 1, atol=20 * EPS)
    assert psi.light_efficiency() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(("cfa", "binning"), [("mono", 1), ("mono", 2), ("rggb", 1)])
def test_shots_behind_filters_share_no_light_between_colours(cfa, binning):
    """Shots that store different colours at a sample have nothing in common there."""
    mask = {"distance_mm": 0.3, "cell_um": 24, "pattern": {"kind": "uniform_colour"}}
    shots = [{"filter": "red"}, {"filter": "green"}, {"filter": "red", "offset_um": {"m": [72, 0]}}]
    psi = build_imaging_matrix(camera({"m": mask}, cfa, binning, shots=shots), SIZE)
    assert psi.colour is not None
    assert_operator_equals_matrix(psi)
    assert not psi.gram[0, 1].any()
    assert psi.gram[0, 2].any()


@pytest.mark.parametrize("cfa", ["rggb", "mono"])
@pytest.mark.parametrize(("binning", "shots"), [(1, 1), (1, 3), (2, 3), (3, 2)])
@pytest.mark.parametrize("ridge", ["number", "array", "unused"])
def test_the_pixel_solve_is_the_dense_solve(coded_camera, cfa, binning, shots, ridge):
    psi = build_imaging_matrix(coded_camera("gaussian_colour", cfa, binning, shots), SIZE)
    rng = np.random.default_rng(3)
    diagonal = np.full(psi.frames_shape, 0.01)
    if ridge != "number":
        diagonal = rng.uniform(0.001, 0.1, psi.frames_shape)
    if ridge == "unused":
        diagonal[rng.random(psi.frames_shape) < 0.3] = np.inf
    frames = random_frames(psi)
    solved = solved_blocks(psi, 0.01 if ridge == "number" else diagonal, frames)
    used = np.isfinite(diagonal).ravel()
    dense = psi.to_scipy().toarray().astype(np.float64)[used]
    expected = np.zeros(used.size)
    system = dense @ dense.T + np.diag(diagonal.ravel()[used])
    expected[used] = np.linalg.solve(system, frames.ravel()[used])
    np.testing.assert_allclose(solved.ravel(), expected, atol=20 * EPS * np.abs(expected).max())
    assert not solved.ravel()[~used].any()


@pytest.mark.parametrize("distance_mm", [0.0, 0.3])
def test_repeated_shots_are_singular_without_a_ridge(distance_mm):
    mask = {"distance_mm": distance_mm, "cell_um": 24, "pattern": {"kind": "uniform_colour"}}
    psi = build_imaging_matrix(camera({"m": mask}, "mono", 1, 3), SIZE)
    with pytest.raises(SensingError, match=r"singular at 72 pixels.*use a ridge above 0"):
        psi.inverted_blocks(0.0)
    assert np.isfinite(psi.inverted_blocks(1e-3)).all()


@pytest.mark.parametrize("ridge", [-1e-3, float("nan")])
def test_a_negative_ridge_is_refused(ridge):
    psi = build_imaging_matrix(camera({}), SIZE)
    with pytest.raises(SensingError, match="at least 0"):
        psi.inverted_blocks(ridge)


@pytest.mark.parametrize("cfa", ["rggb", "mono"])
def test_psi_multiplies_as_an_operator(coded_camera, cfa):
    psi = build_imaging_matrix(coded_camera("random_rgbw", cfa, 2, 2), SIZE)
    light_field, frames = random_light_field(psi), random_frames(psi)
    assert psi.shape == psi.T.shape[::-1]
    assert psi.T.T is psi
    np.testing.assert_array_equal(psi @ light_field, psi.forward(light_field))
    np.testing.assert_array_equal(psi.T @ frames, psi.adjoint(frames))


@pytest.mark.parametrize("cfa", ["rggb", "mono"])
def test_scipy_takes_psi_as_a_linear_operator(coded_camera, cfa):
    psi = build_imaging_matrix(coded_camera("random_rgbw", cfa, 2, 2), SIZE)
    operator, dense = aslinearoperator(psi), psi.to_scipy().toarray()
    assert operator.shape == dense.shape
    assert operator.dtype == np.float32
    x, y = random_light_field(psi).ravel(), random_frames(psi).ravel()
    np.testing.assert_allclose(operator @ x, dense @ x, atol=1e-5)
    np.testing.assert_allclose(operator.T @ y, dense.T @ y, atol=1e-5)
    columns = np.stack([x, 2 * x], axis=1)
    np.testing.assert_allclose(np.asarray(operator @ columns), dense @ columns, atol=2e-5)
    solved = lsqr(operator, dense @ x, iter_lim=200)[0]
    np.testing.assert_allclose(dense @ solved, dense @ x, atol=1e-3)


def test_psi_is_shown_in_one_line(coded_psi, random_psi):
    psi = coded_psi(shots=2, size=(12, 16))
    assert repr(psi) == "Psi(2 shots, 2x3 views, 12x16, rggb, 0.0092 MB)"
    assert repr(psi.T) == f"{psi!r}.T"
    assert "one colour a pixel" in repr(random_psi())
    assert "three colours a pixel" in repr(random_psi(stored=3))


@pytest.mark.slow
@pytest.mark.parametrize(("cfa", "binning", "shots"), [("rggb", 2, 2), ("mono", 1, 3)])
def test_psi_in_double_precision_is_exact_to_double_precision(coded_camera, cfa, binning, shots):
    single = build_imaging_matrix(coded_camera("uniform_colour", cfa, binning, shots), SIZE)
    psi = Psi(single.weights.astype(np.float64), single.colour, binning)
    dense = assert_operator_equals_matrix(psi)
    frames = random_frames(psi)
    solved = solved_blocks(psi, 0.1, frames)
    expected = np.linalg.solve(dense @ dense.T + 0.1 * np.eye(len(dense)), frames.ravel())
    np.testing.assert_allclose(solved.ravel(), expected, atol=1e-12)


def test_a_light_field_need_not_be_contiguous():
    mask = {"distance_mm": 0.3, "cell_um": 24, "pattern": {"kind": "uniform_colour"}}
    psi = build_imaging_matrix(camera({"m": mask}, "rggb"), SIZE)
    light_field = random_light_field(psi)
    planes = np.ascontiguousarray(np.moveaxis(light_field, -1, 0))
    np.testing.assert_array_equal(psi.forward(np.moveaxis(planes, 0, -1)), psi.forward(light_field))
    wide = np.repeat(random_frames(psi), 2, axis=-1)
    np.testing.assert_array_equal(psi.adjoint(wide[..., ::2]), psi.adjoint(wide[..., ::2].copy()))


def test_arrays_that_do_not_fit_are_refused():
    psi = build_imaging_matrix(camera({}, "rggb", 2), SIZE)
    with pytest.raises(SensingError, match=r"a light field of shape \(2, 3, 6, 11, 3\)"):
        psi.forward(np.zeros((2, 3, 6, 11, 3), np.float32))
    with pytest.raises(SensingError, match="frames of shape"):
        psi.adjoint(np.zeros((1, *SIZE), np.float32))


@pytest.mark.parametrize(
    ("weights", "colour", "binning", "complaint"),
    [
        (np.ones((1, 2, 2, 4, 4)), None, 1, "do not make a Psi"),
        (np.ones((1, 2, 2, 4, 1, 4)), None, 1, "do not make a Psi"),
        (np.ones((1, 2, 2, 4, 3, 4)), np.zeros((1, 4, 4), np.uint8), 1, "do not make a Psi"),
        (np.ones((1, 2, 2, 4, 1, 4)), np.zeros((2, 4, 4), np.uint8), 1, "colour map of shape"),
        (np.ones((1, 2, 2, 4, 1, 4)), np.full((1, 4, 4), 3, np.uint8), 1, "colour map"),
        (np.ones((1, 2, 2, 4, 3, 4)), None, 3, "do not divide"),
        (np.full((1, 2, 2, 4, 3, 4), np.nan), None, 1, "not finite"),
    ],
)
def test_weights_that_make_no_psi_are_refused(weights, colour, binning, complaint):
    with pytest.raises(SensingError, match=complaint):
        Psi(weights.astype(np.float32), colour, binning)


def test_the_relative_difference_is_the_frobenius_norms_ratio(coded_camera):
    psi = build_imaging_matrix(coded_camera("uniform_colour", "rggb"), SIZE)
    other = Psi(psi.weights * np.float32(1.25), psi.colour)
    assert other.relative_difference(psi) == pytest.approx(0.25)
    assert psi.relative_difference(psi) == 0
    with pytest.raises(SensingError, match="same camera and size"):
        psi.relative_difference(build_imaging_matrix(camera({}, "rggb"), (6, 6)))


@pytest.mark.parametrize("cfa", ["rggb", "mono"])
def test_psi_is_saved_and_loaded_unchanged(tmp_path, coded_camera, cfa):
    psi = build_imaging_matrix(coded_camera("random_rgbw", cfa, 2, 3), SIZE)
    path = tmp_path / "psi.h5"
    psi.save(path)
    assert [item.name for item in tmp_path.iterdir()] == ["psi.h5"]
    loaded = Psi.load(path)
    np.testing.assert_array_equal(loaded.weights, psi.weights)
    assert (loaded.colour is None) == (psi.colour is None)
    np.testing.assert_array_equal(loaded.colour_map, psi.colour_map)
    assert (loaded.binning, loaded.camera_json) == (2, psi.camera_json)
    assert loaded.checksum() == psi.checksum()
    described = coded_camera("random_rgbw", cfa, 2, 3)
    assert Camera.model_validate_json(loaded.camera_json) == described


@pytest.mark.parametrize("damage", ["weights", "colour", "binning", "camera"])
def test_a_damaged_file_is_not_believed(tmp_path, coded_camera, damage):
    path = tmp_path / "psi.h5"
    build_imaging_matrix(coded_camera("random_rgbw", "rggb", 2), SIZE).save(path)
    with h5py.File(path, "r+") as file:
        if damage == "weights":
            file["weights"][0, 0, 0, 0, 0, 0] = 0.5  # type: ignore[index]
        elif damage == "colour":
            file["colour"][0, 0, 0] = 2  # type: ignore[index]
        else:
            file.attrs[damage] = {"binning": 1, "camera": "{}"}[damage]
    with pytest.raises(SensingError, match="damaged"):
        Psi.load(path)


def test_files_that_hold_no_psi_are_refused_in_one_line(tmp_path):
    text, other, missing = tmp_path / "a.h5", tmp_path / "b.h5", tmp_path / "c.h5"
    text.write_text("not HDF5")
    with h5py.File(other, "w") as file:
        file["weights"] = np.ones(3)
    cut = tmp_path / "d.h5"
    build_imaging_matrix(camera({}), SIZE).save(cut)
    cut.write_bytes(cut.read_bytes()[:3000])
    for path in (text, other, missing, tmp_path, cut):
        with pytest.raises(SensingError) as fault:
            Psi.load(path)
        assert "\n" not in str(fault.value)
        assert str(path) in str(fault.value)


def test_psi_that_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path):
    psi = build_imaging_matrix(camera({}), SIZE)
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "missing" / "psi.h5", tmp_path / "file" / "psi.h5"):
        with pytest.raises(SensingError, match="cannot be written"):
            psi.save(path)
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


def traced_transmittance(described, size, rays):
    """Return what dense rays pass, (v, u, y, x, c), of the masks of a camera's first shot.

    Rays are straight lines from rays[0] points of a sample's width to rays[1] points of an
    aperture cell's, along both axes; a ray takes the transmittance of the mask cell that it meets.
    """
    plates = draw_plates(described, size)
    pitch = described.sensor.sample_pitch_um
    cell = described.lens.aperture_cell_mm * 1e3
    lens_um = described.lens.distance_mm * 1e3
    from_points, to_points = ((np.arange(count) + 0.5) / count - 0.5 for count in rays)

    def met(sample, samples, view, views, name, axis):
        x = (sample - (samples - 1) / 2 + from_points[:, None]) * pitch
        u = (view - (views - 1) / 2 + to_points[None, :]) * cell
        plate = plates[name]
        at = x + (u - x) / lens_um * plate.distance_mm * 1e3
        offset = described.shots[0].offset_um.get(name, (0.0, 0.0))[1 - axis]
        return np.floor((at - offset) / plate.cell_um + plate.cells.shape[1 + axis] / 2).astype(int)

    passed = np.empty((*described.views, *size, 3))
    for v, u, y, x in np.ndindex(passed.shape[:4]):
        product_of_masks = np.ones((rays[0] * rays[1], rays[0] * rays[1], 3), np.float32)
        for name, plate in plates.items():
            rows = met(y, size[0], v, described.views[0], name, 0).ravel()
            columns = met(x, size[1], u, described.views[1], name, 1).ravel()
            product_of_masks *= plate.cells[0][rows[:, None], columns[None, :]]
        passed[v, u, y, x] = product_of_masks.mean(axis=(0, 1))
    return passed


COLOUR_MASK = {"kind": "uniform_colour", "seed": 8}
BINARY_MASK = {"kind": "random_binary", "seed": 9}


@pytest.mark.parametrize(
    ("masks", "offsets", "rays", "tolerance"),
    [
        ({"m": (0.3, 31.0, COLOUR_MASK)}, {"m": (7.0, -50.0)}, (16, 16), 0.005),
        ({"m": (20.0, 900.0, BINARY_MASK)}, {"m": (111.0, 3.0)}, (2, 100), 0.005),
        ({"m": (0.0, 24.0, COLOUR_MASK), "n": (0.3, 31.0, COLOUR_MASK)}, {}, (16, 16), 0.005),
        (
            {"m": (0.3, 31.0, COLOUR_MASK), "n": (49.0, 2500.0, COLOUR_MASK)},
            {"m": (7.0, -50.0), "n": (300.0, 100.0)},
            (16, 16),
            0.02,
        ),
    ],
    ids=["one near the sensor", "one midway", "in contact and near", "near and at the lens"],
)
def test_psi_is_the_average_over_dense_rays(masks, offsets, rays, tolerance):
    """One mask is averaged exactly, and so is a second one of whole cells: 0.005 is what so many
    rays miss. Of two masks both partly covered the model averages the products of 3 x 3 parts."""
    described = camera(
        {
            name: {"distance_mm": distance, "cell_um": cell, "pattern": pattern}
            for name, (distance, cell, pattern) in masks.items()
        },
        shots=[{"offset_um": offsets}],
        views=(2, 2),
    )
    psi = build_imaging_matrix(described, (3, 4))
    passed = traced_transmittance(described, (3, 4), rays)
    modelled = psi.weights[0].transpose(0, 1, 2, 4, 3) * 3 * 4
    error = np.abs(modelled - passed)
    assert error.max() < tolerance, error.max()


def test_weights_below_zero_by_more_than_noise_are_refused():
    weights = np.random.default_rng(0).random((1, 2, 2, 4, 6))
    weights[0, 1, 1, 2, 3] = -0.01
    assert Psi.from_weights(weights).shots == 1
    weights[0, 1, 1, 2, 3] = -0.5
    with pytest.raises(SensingError, match=r"weights down to -0\.5, and a pixel sees no less"):
        Psi.from_weights(weights)


def test_values_that_are_masked_are_not_taken():
    weights = np.random.default_rng(0).random((1, 2, 2, 4, 6))
    masked = np.ma.masked_less(weights, 0.1)
    with pytest.raises(ArgumentError, match=r"weights: \d+ of its values are masked"):
        Psi.from_weights(masked)
    kept = Psi.from_weights(np.ma.masked_array(weights))
    assert np.array_equal(kept.weights, Psi.from_weights(weights).weights)
