"""Total variation: the minimiser against another algorithm, settings and refusals."""

import numpy as np
import pytest
from variation import adjoint, gradient, variation

from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.errors import SensingError
from emmc_rig.model.frames import even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.problem import choose_mu, colour_metric
from emmc_rig.reconstruction.tv import TVSettings, reconstruct_tv
from emmc_rig.simulators.scenes import render

SIZE = (6, 8)
VIEWS = (2, 3)


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


def into_ball(dual, radius):
    """Return the dual variable with every sample's vector, colours together, in a ball."""
    length = np.sqrt(np.square(dual).sum(axis=(0, -1)))[None, ..., None]
    return dual / np.maximum(length / radius, 1)


def test_the_colour_metric_turns_to_luminance_and_two_chrominances_and_weighs_these():
    np.testing.assert_allclose(colour_metric(1.0).T @ colour_metric(1.0), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(colour_metric(2.0) @ [1, 1, 1], [np.sqrt(3), 0, 0], atol=1e-12)
    lengths = np.linalg.norm(colour_metric(2.0), axis=1)
    np.testing.assert_allclose(lengths, [1, 2, 2])


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
    measured = variation(light_field, 1, colour_metric(chroma_weight))
    assert measured == pytest.approx(length * area, rel=1e-5)


def condat_vu(dense, frames, shape, metric, mu, steps):
    """Return the minimiser by Condat-Vu with the gradient of the misfit (paper, eq. 10-13)."""
    lipschitz = np.linalg.norm(dense, 2) ** 2
    sigma = 0.02
    tau = 1 / (lipschitz / 2 + 16 * sigma * np.linalg.norm(metric, 2) ** 2)
    light_field, dual = np.zeros(shape), np.zeros((4, *shape))
    for _ in range(steps):
        slope = (dense.T @ (dense @ light_field.ravel() - frames.ravel())).reshape(shape)
        new = light_field - tau * (slope + adjoint(dual, 1) @ metric)
        dual = into_ball(dual + sigma * gradient((2 * new - light_field) @ metric.T, 1), mu)
        light_field = new
    return light_field


def objective(dense, frames, light_field, metric, mu):
    misfit = dense @ light_field.ravel() - frames.ravel()
    return 0.5 * misfit @ misfit + mu * variation(light_field, 1, metric)


@pytest.mark.parametrize(
    ("cfa", "binning", "shots", "chroma_weight"),
    [("rggb", 1, 1, 1.0), ("rggb", 2, 3, 2.0), ("mono", 1, 2, 2.0), ("mono", 1, 2, 0.5)],
)
def test_the_minimiser_agrees_with_another_algorithm(cfa, binning, shots, chroma_weight):
    psi = imaging_matrix(cfa, binning, shots, size=(4, 6), views=(2, 2))
    dense, mu = psi.to_scipy().toarray().astype(np.float64), 2e-3
    metric = colour_metric(chroma_weight)
    truth = 0.2 + 0.6 * np.random.default_rng(2).random(psi.light_field_shape)
    truth[:, :, :, 3:] = [0.7, 0.3, 0.5]
    frames = (dense @ truth.ravel()).reshape(psi.frames_shape).astype(np.float32)
    peer = condat_vu(dense, frames, psi.light_field_shape, metric, mu, 6000)
    settings = TVSettings(
        mu=mu, chroma_weight=chroma_weight, primal_step=5, rtol=1e-7, max_steps=3000
    )
    result = reconstruct_tv(psi, even_frames(frames, 0.0), settings)
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
        results.append(reconstruct_tv(psi, even_frames(damaged, 0.004, usable)))
    for result in results[1:]:
        np.testing.assert_array_equal(result.light_field, results[0].light_field)
        assert result.parameters == results[0].parameters


def test_excluding_saturated_pixels_is_better_than_believing_them(problem):
    psi, frames = problem
    usable = np.random.default_rng(7).random(frames.shape) < 0.9
    damaged = np.where(usable, frames, np.float32(1))
    truth = smooth_scene(psi)
    excluded = reconstruct_tv(psi, even_frames(damaged, 0.004, usable))
    believed = reconstruct_tv(psi, even_frames(damaged, 0.004))
    whole = reconstruct_tv(psi, even_frames(frames, 0.004))
    excluded_db, believed_db, whole_db = (
        psnr_db(result.light_field, truth) for result in (excluded, believed, whole)
    )
    assert excluded_db > believed_db + 3
    assert excluded_db > whole_db - 2


@pytest.mark.parametrize(
    ("change", "noise", "words"),
    [
        (lambda frames: frames[:1], 0.01, r"frames of shape \(1, 16, 20\) given, Psi needs"),
        *(
            (lambda _, value=value: value, 0.01, "not finite: exclude")
            for value in (np.nan, np.inf)
        ),
        *((lambda frames: frames, noise, "noise level") for noise in (-0.01, np.nan, np.inf)),
    ],
)
def test_frames_and_noise_that_do_not_fit_are_refused(problem, change, noise, words):
    psi, frames = problem
    changed = change(frames)
    if isinstance(changed, float):
        changed = np.where(np.arange(20) == 4, np.float32(changed), frames)
    with pytest.raises(ReconstructionError, match=words):
        reconstruct_tv(psi, even_frames(changed, noise))


def test_a_choice_of_pixels_fits_the_frames_and_leaves_some(problem):
    psi, frames = problem
    with pytest.raises(SensingError, match=r"need one shape .* usable \(16, 20\)"):
        even_frames(frames, 0.01, np.ones((16, 20), dtype=bool))
    with pytest.raises(ReconstructionError, match="no usable pixel"):
        reconstruct_tv(psi, even_frames(frames, 0.01, np.zeros(frames.shape, dtype=bool)))


def test_frames_without_light_give_a_black_light_field():
    psi = imaging_matrix()
    for sigma in (0.0, 0.01):
        result = reconstruct_tv(psi, even_frames(np.zeros(psi.frames_shape, np.float32), sigma))
        assert not result.light_field.any()
        assert result.status == "converged"


def test_a_constant_light_field_comes_back():
    psi = imaging_matrix("mono", shots=3)
    white = np.full(psi.light_field_shape, 0.5, np.float32)
    result = reconstruct_tv(psi, even_frames(psi.forward(white), 0.0))
    np.testing.assert_allclose(result.light_field, 0.5, atol=2e-3)


def test_running_out_of_steps_is_a_status_with_advice(problem):
    psi, frames = problem
    result = reconstruct_tv(psi, even_frames(frames, 0.004), TVSettings(max_steps=3, rtol=1e-9))
    assert (result.status, result.steps) == ("step limit reached", 3)
    assert result.advice == "raise max_steps or loosen rtol"
    assert result.objective == ()
    converged = reconstruct_tv(psi, even_frames(frames, 0.004))
    assert (converged.status, converged.advice) == ("converged", "")
    assert converged.steps < 200


def test_every_step_is_observed_and_the_objective_is_reported_when_asked(problem):
    psi, frames = problem
    seen = []
    settings = TVSettings(max_steps=25, rtol=1e-9, objective_every=5)
    result = reconstruct_tv(psi, even_frames(frames, 0.004), settings, on_step=seen.append)
    assert [progress.step for progress in seen] == list(range(1, 26))
    evaluated = [(p.step, p.objective) for p in seen if p.objective is not None]
    assert evaluated == list(result.objective)
    assert [step for step, _ in evaluated] == [5, 10, 15, 20, 25]
    assert seen[-1].relative_change < seen[0].relative_change


def test_the_same_frames_give_the_same_light_field(problem):
    psi, frames = problem
    first, second = (reconstruct_tv(psi, even_frames(frames, 0.004)).light_field for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_without_noise_mu_is_small_but_not_zero(problem):
    psi, frames = problem
    assert 0 < choose_mu(psi, frames, 0.0) < 1e-4


@pytest.mark.parametrize(
    ("scene", "cfa", "shots", "noise"),
    [("near-planar", "rggb", 3, 0.01), ("deep-occlusions", "mono", 2, 0.05)],
)
def test_the_chosen_mu_is_near_the_best(scene, cfa, shots, noise):
    """`noise` is in shares of the mean brightness. The light field is rendered on the grid of the
    reconstruction and measured with its Psi: this is about mu, not about accuracy."""
    truth = render(scene, (3, 3), (48, 64)).light_field
    psi = imaging_matrix(cfa, 1, shots, size=(48, 64), views=(3, 3))
    sigma = noise * float(truth.mean())
    clean = psi.forward(truth)
    frames = clean + np.random.default_rng(8).normal(0, sigma, clean.shape).astype(np.float32)
    chosen = reconstruct_tv(psi, even_frames(frames, sigma))
    reached_db = psnr_db(chosen.light_field, truth)
    grid_db = [
        psnr_db(
            reconstruct_tv(psi, even_frames(frames, sigma), TVSettings(mu=mu)).light_field, truth
        )
        for mu in chosen.parameters["mu"] * 2.0 ** np.array([-4, -3, -2, -1, 1, 2, 3])
    ]
    assert reached_db > max(grid_db) - 0.7
