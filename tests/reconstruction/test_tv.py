"""Total variation: the fused sweep against plain NumPy, the minimiser against another algorithm."""

import numpy as np
import pytest

from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.lightfield import psnr_db
from reconstruction import kernels
from reconstruction.choices import choose_mu
from reconstruction.differences import (
    fitting_indices,
    multi_indices,
    planar_variation,
    stencils,
)
from reconstruction.errors import ReconstructionError
from reconstruction.problem import colour_metric
from reconstruction.tv import TVSettings, reconstruct_tv, row_bands
from simulators.scenes import render

DV_1 = np.eye(3)
"""The metric of the paper's colour-coupled total variation."""
EPS = float(np.finfo(np.float32).eps)
SIZE = (6, 8)
VIEWS = (2, 3)
AXIS = {0: 3, 1: 2, 2: 1, 3: 0}
"""Directions of the dual variable, x y u v, as axes of (v, u, y, x, c)."""


def imaging_matrix(cfa="rggb", binning=1, shots=1, size=SIZE, views=VIEWS, seed=0):
    pattern = {"kind": "random_rgbw", "seed": seed}
    mask = {"distance_mm": 0.24, "cell_um": 24.0, "pattern": pattern}
    camera = Camera.model_validate(
        {
            "title": "test",
            "views": views,
            "sensor": {"cfa": cfa, "binning": binning},
            "masks": {"m": mask},
            "more_shots_step_um": {"m": (72, 48)},
        }
    )
    return build_imaging_matrix(camera.with_shots(shots), size)


def matrix(psi):
    return psi.to_scipy().toarray().astype(np.float64)


def gradient(light_field, metric=DV_1):
    """Return forward differences (direction, v, u, y, x, c), 0 across the far border."""
    found = np.zeros((4, *light_field.shape))
    for direction, axis in AXIS.items():
        inner = [slice(None)] * 5
        inner[axis] = slice(0, -1)
        found[(direction, *inner)] = np.diff(light_field, axis=axis)
    return np.einsum("kc,...c->...k", metric, found)


def gradient_adjoint(dual, metric=DV_1):
    """Return the adjoint of `gradient`, by its definition: minus on a sample, plus on the next."""
    mixed = np.einsum("kc,...k->...c", metric, dual)
    found = np.zeros(dual.shape[1:])
    for direction, axis in AXIS.items():
        here, beyond = [slice(None)] * 5, [slice(None)] * 5
        here[axis], beyond[axis] = slice(0, -1), slice(1, None)
        found[tuple(here)] -= mixed[(direction, *here)]
        found[tuple(beyond)] += mixed[(direction, *here)]
    return found


def variation(light_field, metric=DV_1):
    """Return the sum over samples of the length of all differences of all colours."""
    return float(np.sqrt(np.square(gradient(light_field, metric)).sum(axis=(0, -1))).sum())


def into_ball(dual, radius):
    """Return the dual variable with every sample's vector, colours together, in a ball."""
    length = np.sqrt(np.square(dual).sum(axis=(0, -1)))[None, ..., None]
    return dual / np.maximum(length / radius, 1)


def plain_step(dense, frames, light_field, dual, metric, gamma, sigma, mu, relax):
    """Return one over-relaxed primal-dual step (Condat 2013, algorithm 3.1).

    The proximal point of the misfit is solved in the space of the light field,
    (1 + gamma Psi^T Psi) z = q + gamma Psi^T I, not pixel by pixel as the kernel does.
    """
    descended = light_field - gamma * gradient_adjoint(dual, metric)
    system = np.eye(dense.shape[1]) + gamma * dense.T @ dense
    target = descended.ravel() + gamma * dense.T @ frames.ravel()
    new = np.linalg.solve(system, target).reshape(light_field.shape)
    raised = into_ball(dual + sigma * gradient(2 * new - light_field, metric), mu)
    return relax * new + (1 - relax) * light_field, relax * raised + (1 - relax) * dual


def rows_of_colours(light_field):
    """Return (v, u, y, x, c) as the kernel's (v, u, y, c, x)."""
    return np.ascontiguousarray(np.swapaxes(light_field, -1, -2), dtype=np.float32)


def kernel_dual(dual):
    """Return (direction, v, u, y, x, c) as the kernel's (v, u, y, direction, c, x)."""
    return np.ascontiguousarray(dual.transpose(1, 2, 3, 0, 5, 4), dtype=np.float32)


def start(psi, seed=0):
    """Return random frames, a light field and a dual variable that is 0 across the far borders."""
    rng = np.random.default_rng(seed)
    frames = rng.random(psi.frames_shape).astype(np.float32)
    light_field = rng.random(psi.light_field_shape).astype(np.float32)
    dual = gradient(rng.standard_normal(psi.light_field_shape)).astype(np.float32)
    return frames, light_field, dual


def swept(psi, frames, light_field, dual, count, bands, ridge=None):
    """Return light field and dual after `count` sweeps of the kernel, and the sums it reports."""
    metric, gamma, sigma, mu, relax = STEPS
    inverse = psi.solver(1 / gamma if ridge is None else ridge).inverse
    # Derivatives along a single view do not exist.
    some = [multi_indices(1).index(one) for one in fitting_indices(1, psi.light_field_shape)]
    state, dual_state = rows_of_colours(light_field), kernel_dual(dual[some])
    moved = np.zeros((psi.frames_shape[1], 2))
    data = kernels.Data(psi.weights, psi.colour_map, inverse, frames, psi.binning)
    kind = np.float32
    steps = kernels.Steps(kind(gamma), kind(sigma), kind(mu), kind(relax), metric.astype(kind))
    taps, room = stencils(1, psi.light_field_shape, np.dtype(kind)), np.empty_like(state)
    shares = row_bands(psi.frames_shape[1], bands)
    for _ in range(count):
        kernels.sweep(data, steps, taps, state, dual_state, room, shares, moved)
    found = np.zeros_like(dual)
    found[some] = dual_state.transpose(3, 0, 1, 2, 5, 4)
    return np.swapaxes(state, -1, -2), found, moved


STEPS = (colour_metric(2.0), 0.7, 1 / (64 * 0.7), 0.3, 1.9)
"""Metric, primal step, dual step, mu and relaxation of the sweeps tested."""
SENSORS = [
    (cfa, binning, shots) for cfa in ("rggb", "mono") for binning in (1, 2) for shots in (1, 3)
]


@pytest.mark.parametrize(("cfa", "binning", "shots"), SENSORS)
def test_the_fused_sweep_is_the_plain_primal_dual_step(cfa, binning, shots):
    psi = imaging_matrix(cfa, binning, shots)
    frames, light_field, dual = start(psi)
    found, found_dual, moved = swept(psi, frames, light_field, dual, 3, 2)
    dense = matrix(psi)
    assert psi.weights.shape[4] == (1 if cfa == "rggb" else 3)
    before = expected = light_field.astype(np.float64)
    expected_dual = dual.astype(np.float64)
    for _ in range(3):
        before = expected
        expected, expected_dual = plain_step(dense, frames, expected, expected_dual, *STEPS)
    np.testing.assert_allclose(found, expected, atol=100 * EPS * np.abs(expected).max())
    np.testing.assert_allclose(found_dual, expected_dual, atol=100 * EPS)
    change = np.square((expected - before) / STEPS[4])
    by_row = [np.sum(part, axis=(0, 1, 3, 4)) for part in (change, np.square(expected))]
    by_pixel_row = np.array(by_row).reshape(2, -1, binning).sum(axis=-1).T
    np.testing.assert_allclose(moved, by_pixel_row, rtol=1e-4)


@pytest.mark.parametrize(("cfa", "binning", "shots"), SENSORS)
def test_a_sweep_does_not_depend_on_how_the_rows_are_shared(cfa, binning, shots):
    psi = imaging_matrix(cfa, binning, shots)
    whole = swept(psi, *start(psi), 3, 1)
    for bands in (2, 3, psi.frames_shape[1], 50):
        for one, other in zip(swept(psi, *start(psi), 3, bands), whole, strict=True):
            np.testing.assert_array_equal(one, other)


def test_the_sweep_takes_shots_of_different_colours():
    shots = [{"filter": "red"}, {"filter": "green"}, {"filter": "blue"}]
    camera = Camera.model_validate({"title": "filters", "views": VIEWS, "shots": shots})
    psi = build_imaging_matrix(camera, SIZE)
    frames, light_field, dual = start(psi)
    found, found_dual, _ = swept(psi, frames, light_field, dual, 1, 2)
    expected, expected_dual = plain_step(matrix(psi), frames, light_field, dual, *STEPS)
    np.testing.assert_allclose(found, expected, atol=100 * EPS)
    np.testing.assert_allclose(found_dual, expected_dual, atol=100 * EPS)


@pytest.mark.parametrize("views", [(1, 1), (1, 3), (3, 1)])
def test_the_sweep_takes_a_single_row_or_column_of_views(views):
    psi = imaging_matrix(views=views)
    frames, light_field, dual = start(psi)
    found, found_dual, _ = swept(psi, frames, light_field, dual, 1, 2)
    expected, expected_dual = plain_step(matrix(psi), frames, light_field, dual, *STEPS)
    np.testing.assert_allclose(found, expected, atol=100 * EPS)
    np.testing.assert_allclose(found_dual, expected_dual, atol=100 * EPS)


def test_a_sweep_leaves_out_the_pixels_of_infinite_ridge():
    psi = imaging_matrix("mono", 1, 3)
    frames, light_field, dual = start(psi)
    used = np.random.default_rng(4).random(psi.frames_shape) < 0.7
    ridge = np.where(used, 1 / STEPS[1], np.inf)
    found, *_ = swept(psi, frames, light_field, dual, 1, 2, ridge)
    expected, _ = plain_step(matrix(psi)[used.ravel()], frames[used], light_field, dual, *STEPS)
    np.testing.assert_allclose(found, expected, atol=100 * EPS)


def test_the_colour_metric_turns_to_luminance_and_two_chrominances_and_weighs_these():
    np.testing.assert_allclose(colour_metric(1.0).T @ colour_metric(1.0), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(colour_metric(2.0) @ [1, 1, 1], [np.sqrt(3), 0, 0], atol=1e-12)
    lengths = np.linalg.norm(colour_metric(2.0), axis=1)
    np.testing.assert_allclose(lengths, [1, 2, 2])


@pytest.mark.parametrize("bands", [1, 2, 3, 7, 100])
@pytest.mark.parametrize("rows", [1, 2, 7, 64])
def test_bands_cover_every_row_of_pixels_once(rows, bands):
    found = row_bands(rows, bands)
    assert len(found) <= min(rows, bands)
    np.testing.assert_array_equal(np.concatenate([np.arange(*band) for band in found]), range(rows))


def measured_variation(light_field, metric=DV_1):
    return planar_variation(rows_of_colours(light_field), 1, metric.astype(np.float32))


@pytest.mark.parametrize("chroma_weight", [1.0, 2.0])
def test_tv_of_a_constant_light_field_is_zero(chroma_weight):
    colours = np.broadcast_to([0.2, 0.9, 0.4], (3, 4, 5, 6, 3))
    assert measured_variation(colours, colour_metric(chroma_weight)) == 0


@pytest.mark.parametrize("shape", [(2, 3, 5, 7, 3), (1, 1, 5, 7, 3), (3, 1, 1, 4, 3)])
def test_dv_1_is_the_sum_of_the_lengths_of_all_differences(shape):
    light_field = np.random.default_rng(0).random(shape)
    expected = pytest.approx(variation(light_field), rel=1e-6)
    assert measured_variation(light_field) == expected
    assert measured_variation(light_field, colour_metric(1.0)) == expected
    weighted = measured_variation(light_field, colour_metric(2.0))
    assert weighted == pytest.approx(variation(light_field, colour_metric(2.0)), rel=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2, 3])
@pytest.mark.parametrize(
    ("step", "length", "chroma_weight"),
    [
        ((0.5, 0.5, 0.5), 0.5 * np.sqrt(3), 1.0),
        ((0.5, 0.5, 0.5), 0.5 * np.sqrt(3), 3.0),
        ((0.2, 0.0, -0.2), 0.2 * np.sqrt(2), 1.0),
        ((0.2, 0.0, -0.2), 0.6 * np.sqrt(2), 3.0),
        ((0.1, -0.2, 0.1), 0.3 * np.sqrt(6), 3.0),
    ],
)
def test_tv_of_a_step_is_its_height_times_its_area_along_every_axis(
    axis, step, length, chroma_weight
):
    """A step is as high as its colour vector is long; chrominance counts chroma_weight times."""
    shape = (3, 4, 6, 5, 3)
    light_field = np.full(shape, 0.4)
    beyond = [slice(None)] * 5
    beyond[axis] = slice(2, None)
    light_field[tuple(beyond)] += step
    area = np.prod(shape[:4]) / shape[axis]
    measured = measured_variation(light_field, colour_metric(chroma_weight))
    assert measured == pytest.approx(length * area, rel=1e-5)


def test_the_plain_gradient_has_its_adjoint_and_norm():
    rng = np.random.default_rng(1)
    light_field, dual = rng.random((2, 3, 4, 5, 3)), rng.random((4, 2, 3, 4, 5, 3))
    metric = colour_metric(2.0)
    forward, backward = gradient(light_field, metric), gradient_adjoint(dual, metric)
    assert np.vdot(forward, dual) == pytest.approx(np.vdot(light_field, backward))
    checkerboard = (-1.0) ** np.indices((8, 8, 8, 8, 3))[:4].sum(axis=0)
    stretch = np.square(gradient(checkerboard)).sum() / np.square(checkerboard).sum()
    assert 14 <= stretch <= 16


def condat_vu(dense, frames, shape, metric, mu, steps):
    """Return the minimiser by Condat-Vu with the gradient of the misfit (paper, eq. 10-13)."""
    lipschitz = np.linalg.norm(dense, 2) ** 2
    sigma = 0.02
    tau = 1 / (lipschitz / 2 + 16 * sigma * np.linalg.norm(metric, 2) ** 2)
    light_field, dual = np.zeros(shape), np.zeros((4, *shape))
    for _ in range(steps):
        slope = (dense.T @ (dense @ light_field.ravel() - frames.ravel())).reshape(shape)
        new = light_field - tau * (slope + gradient_adjoint(dual, metric))
        dual = into_ball(dual + sigma * gradient(2 * new - light_field, metric), mu)
        light_field = new
    return light_field


def objective(dense, frames, light_field, metric, mu):
    misfit = dense @ light_field.ravel() - frames.ravel()
    return 0.5 * misfit @ misfit + mu * variation(light_field, metric)


@pytest.mark.parametrize(
    ("cfa", "binning", "shots", "chroma_weight"),
    [("rggb", 1, 1, 1.0), ("rggb", 2, 3, 2.0), ("mono", 1, 2, 2.0), ("mono", 1, 2, 0.5)],
)
def test_the_minimiser_agrees_with_another_algorithm(cfa, binning, shots, chroma_weight):
    psi = imaging_matrix(cfa, binning, shots, size=(4, 6), views=(2, 2))
    dense, mu = matrix(psi), 2e-3
    metric = DV_1 if chroma_weight == 1 else colour_metric(chroma_weight)
    truth = 0.2 + 0.6 * np.random.default_rng(2).random(psi.light_field_shape)
    truth[:, :, :, 3:] = [0.7, 0.3, 0.5]
    frames = (dense @ truth.ravel()).reshape(psi.frames_shape).astype(np.float32)
    peer = condat_vu(dense, frames, psi.light_field_shape, metric, mu, 6000)
    settings = TVSettings(
        mu=mu, chroma_weight=chroma_weight, primal_step=5, rtol=1e-7, max_steps=3000
    )
    result = reconstruct_tv(psi, frames, 0.0, settings)
    assert 0 < result.light_field.min() < result.light_field.max() < 1
    least = objective(dense, frames, peer, metric, mu)
    found = objective(dense, frames, result.light_field.astype(np.float64), metric, mu)
    assert found == pytest.approx(least, rel=1e-4)
    step, reported = result.objective[-1]
    assert step % 10 == 0
    assert reported == pytest.approx(least, rel=1e-4)


def smooth_scene(psi, level=0.35):
    """Return a smooth light field of a tilted, coloured plane: (v, u, y, x, c)."""
    v, u, y, x = np.indices(psi.light_field_shape[:4])
    wave = np.sin(0.5 * (x + u)) * np.cos(0.4 * (y + v))
    return (level + 0.15 * wave[..., None] * np.array([1, 0.6, -0.5])).astype(np.float32)


@pytest.fixture(scope="module")
def problem():
    psi = imaging_matrix(shots=2, size=(16, 20))
    rng = np.random.default_rng(5)
    frames = psi.forward(smooth_scene(psi))
    return psi, (frames + rng.normal(0, 0.004, frames.shape)).astype(np.float32)


def test_the_value_of_an_excluded_pixel_has_no_influence(problem):
    psi, frames = problem
    usable = np.random.default_rng(6).random(frames.shape) < 0.9
    results = []
    for value in (0.0, 77.0, -1e6, np.nan, np.inf):
        damaged = np.where(usable, frames, np.float32(value))
        results.append(reconstruct_tv(psi, damaged, 0.004, usable=usable))
    for result in results[1:]:
        np.testing.assert_array_equal(result.light_field, results[0].light_field)
        assert result.parameters == results[0].parameters


def test_excluding_saturated_pixels_is_better_than_believing_them(problem):
    psi, frames = problem
    usable = np.random.default_rng(7).random(frames.shape) < 0.9
    damaged = np.where(usable, frames, np.float32(1))
    truth = smooth_scene(psi)
    excluded = reconstruct_tv(psi, damaged, 0.004, usable=usable)
    believed = reconstruct_tv(psi, damaged, 0.004)
    whole = reconstruct_tv(psi, frames, 0.004)
    excluded_db, believed_db, whole_db = (
        psnr_db(result.light_field, truth) for result in (excluded, believed, whole)
    )
    assert excluded_db > believed_db + 3
    assert excluded_db > whole_db - 2


def test_frames_that_do_not_fit_are_refused(problem):
    psi, frames = problem
    with pytest.raises(
        ReconstructionError, match=r"frames of shape \(1, 16, 20\) given, Psi needs"
    ):
        reconstruct_tv(psi, frames[:1], 0.01)
    with pytest.raises(ReconstructionError, match="mask of usable pixels has shape"):
        reconstruct_tv(psi, frames, 0.01, usable=np.ones((16, 20), dtype=bool))
    with pytest.raises(ReconstructionError, match="no usable pixel"):
        reconstruct_tv(psi, frames, 0.01, usable=np.zeros(frames.shape, dtype=bool))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_frames_that_are_not_finite_are_refused(problem, value):
    psi, frames = problem
    damaged = frames.copy()
    damaged[1, 3, 4] = value
    with pytest.raises(ReconstructionError, match="not finite: exclude them"):
        reconstruct_tv(psi, damaged, 0.01)


@pytest.mark.parametrize("sigma", [-0.01, np.nan, np.inf])
def test_a_noise_level_that_is_none_is_refused(problem, sigma):
    psi, frames = problem
    with pytest.raises(ReconstructionError, match="noise"):
        reconstruct_tv(psi, frames, sigma)


def test_frames_without_light_give_a_black_light_field():
    psi = imaging_matrix()
    for sigma in (0.0, 0.01):
        result = reconstruct_tv(psi, np.zeros(psi.frames_shape, np.float32), sigma)
        assert not result.light_field.any()
        assert result.status == "converged"


def test_a_constant_light_field_comes_back():
    psi = imaging_matrix("mono", shots=3)
    white = np.full(psi.light_field_shape, 0.5, np.float32)
    result = reconstruct_tv(psi, psi.forward(white), 0.0)
    np.testing.assert_allclose(result.light_field, 0.5, atol=2e-3)


def test_running_out_of_steps_is_a_status_with_advice(problem):
    psi, frames = problem
    result = reconstruct_tv(psi, frames, 0.004, TVSettings(max_steps=3, rtol=1e-9))
    assert (result.status, result.steps) == ("step limit reached", 3)
    assert result.advice == "raise max_steps or loosen rtol"
    assert result.objective == ()
    converged = reconstruct_tv(psi, frames, 0.004)
    assert (converged.status, converged.advice) == ("converged", "")
    assert converged.steps < 200


def test_every_step_is_observed_and_the_objective_is_reported_when_asked(problem):
    psi, frames = problem
    seen = []
    settings = TVSettings(max_steps=25, rtol=1e-9, objective_every=5)
    result = reconstruct_tv(psi, frames, 0.004, settings, on_step=seen.append)
    assert [progress.step for progress in seen] == list(range(1, 26))
    evaluated = [(p.step, p.objective) for p in seen if p.objective is not None]
    assert evaluated == list(result.objective)
    assert [step for step, _ in evaluated] == [5, 10, 15, 20, 25]
    assert seen[-1].relative_change < seen[0].relative_change


def test_the_seconds_are_those_of_the_clock_passed_in(problem):
    psi, frames = problem
    ticks = iter([100.0, 107.5])
    result = reconstruct_tv(psi, frames, 0.0, TVSettings(max_steps=1), clock=lambda: next(ticks))
    assert result.seconds == 7.5


def test_the_same_frames_give_the_same_light_field(problem):
    psi, frames = problem
    first, second = (reconstruct_tv(psi, frames, 0.004).light_field for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(("scale", "tolerance"), [(0.5, 0.0), (0.3, 1e-5), (0.013, 1e-5)])
def test_scaled_frames_and_noise_give_the_scaled_light_field(problem, scale, tolerance):
    psi, frames = problem
    whole = reconstruct_tv(psi, frames, 0.004)
    assert 0 < whole.light_field.min() < whole.light_field.max() < 1
    scaled = reconstruct_tv(psi, frames * np.float32(scale), 0.004 * scale)
    assert scaled.parameters["mu"] == pytest.approx(scale * whole.parameters["mu"])
    assert scaled.steps == whole.steps
    np.testing.assert_allclose(
        scaled.light_field, np.float32(scale) * whole.light_field, atol=tolerance * scale
    )


def test_without_noise_mu_is_small_but_not_zero(problem):
    psi, frames = problem
    assert 0 < choose_mu(psi, frames, 0.0) < 1e-4


@pytest.mark.parametrize(
    ("scene", "cfa", "shots"), [("near-planar", "rggb", 3), ("deep-occlusions", "mono", 2)]
)
@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_the_chosen_mu_is_near_the_best(scene, cfa, shots, noise):
    """`noise` is in shares of the mean brightness. The light field is rendered on the grid of the
    reconstruction and measured with its Psi: this is about mu, not about accuracy."""
    truth = render(scene, (3, 3), (48, 64)).light_field
    psi = imaging_matrix(cfa, 1, shots, size=(48, 64), views=(3, 3))
    sigma = noise * float(truth.mean())
    clean = psi.forward(truth)
    frames = clean + np.random.default_rng(8).normal(0, sigma, clean.shape).astype(np.float32)
    chosen = reconstruct_tv(psi, frames, sigma)
    reached_db = psnr_db(chosen.light_field, truth)
    grid_db = [
        psnr_db(reconstruct_tv(psi, frames, sigma, TVSettings(mu=mu)).light_field, truth)
        for mu in chosen.parameters["mu"] * 2.0 ** np.array([-4, -3, -2, -1, 1, 2, 3])
    ]
    assert reached_db > max(grid_db) - 0.7
