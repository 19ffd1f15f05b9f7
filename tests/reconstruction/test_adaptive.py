"""Adaptive reconstruction: its parts against dense algebra and SciPy, the whole when planted."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from planes import plane_scene, textured
from scipy.stats import multivariate_t

import emmc_rig as emmc
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.frames import Frames, even_frames
from emmc_rig.model.lightfield import OPPONENT, centre_view, psnr_db
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive import assembly, method, search
from emmc_rig.reconstruction.adaptive.evidence import EvidencePatches, TexturePrior, patch_evidence
from emmc_rig.reconstruction.adaptive.joint import TextureSettings, solve
from emmc_rig.reconstruction.adaptive.method import reconstruct_adaptive
from emmc_rig.reconstruction.adaptive.rays import Surfaces
from emmc_rig.reconstruction.adaptive.refine import fitted, slopes
from emmc_rig.reconstruction.adaptive.register_tiles import LANES
from emmc_rig.reconstruction.adaptive.search import (
    TILE,
    Volume,
    _asked,
    _between,
    _extended,
    _near_best,
    _possible,
    _shared,
    _spanned,
    compatibility,
    moments_per_pixel,
    per_pixel,
    posteriors,
)
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.adaptive.survey import checked, surveyed
from emmc_rig.reconstruction.adaptive.sweep import plane_frames, swept
from emmc_rig.reconstruction.adaptive.uncertainty import (
    FEATURES,
    SEARCH_MISSES,
    disparity_deviation,
    features,
    foretold_db,
    held_out,
    within_db,
)
from emmc_rig.reconstruction.adaptive.visibility import carried
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import Readings
from emmc_rig.reconstruction.tv import reconstruct_tv
from emmc_rig.study.trial import Capture, trial_of


@pytest.mark.parametrize(
    ("cfa", "shots", "binning"), [("rggb", 1, 1), ("mono", 2, 1), ("rggb", 2, 2)]
)
def test_the_evidence_is_the_log_likelihood_of_a_dense_student_t(coded_psi, cfa, shots, binning):
    psi = coded_psi(cfa, binning, shots, (6 * binning, 7 * binning), (3, 3))
    rng = np.random.default_rng(0)
    data = rng.normal(0, 0.1, psi.frames_shape).astype(np.float32)
    usable = rng.random(data.shape) > 0.1
    variance = rng.uniform(1e-4, 3e-4, data.shape)
    prior = TexturePrior(kinds=((0.04, 0.1),))
    patches = EvidencePatches(4, 2)
    corner, bright, disparities = np.array([[1, 2]]), np.array([0.5]), np.array([-1.0, 0.3])
    residual = Readings(psi, data, 0.0, variance, usable)
    places = patches.places(shots)
    found = patch_evidence(residual, bright, corner, places, disparities, prior)
    rows = np.zeros(psi.frames_shape, dtype=bool)
    rows[:, 1:5, 2:6] = True
    rows &= usable
    matrix = psi.to_scipy().toarray()[rows.ravel()]
    seen = matrix.any(axis=0)
    matrix = matrix[:, seen]
    v, u, y, x, c = np.indices(psi.light_field_shape).reshape(5, -1)[:, seen]
    colours = OPPONENT.T @ np.diag([1, 0.1, 0.1]) @ OPPONENT
    for d, value in zip(disparities, found.log_likelihood[0], strict=True):
        at = np.stack([y - d * (v - 1), x - d * (u - 1)], axis=1)
        square = np.square(at[:, None] - at[None]).sum(axis=-1)
        texture = 0.04 * 0.25 * prior.covariance(square) * colours[c[:, None], c[None]]
        scale = matrix @ texture @ matrix.T + np.diag(variance[rows])
        m, freedom = rows.sum(), prior.freedom
        dense = multivariate_t(np.zeros(m), scale, df=int(freedom))
        at_zero = dense.logpdf(np.zeros(m)) + 0.5 * np.linalg.slogdet(scale)[1]
        assert value == pytest.approx(dense.logpdf(data[rows]) - at_zero, abs=2e-2)


def evidence_of_patches(psi, prior, **given):
    """The evidence of 4x4 patches of noise at five disparities, and how many patches they are."""
    rng = np.random.default_rng(0)
    data = rng.normal(0, 0.1, psi.frames_shape).astype(np.float32)
    patches = EvidencePatches(4, 3)
    corners = np.stack(np.meshgrid(*patches.grid(data.shape[1:]), indexing="ij"), axis=-1)
    corners = corners.reshape(-1, 2)
    found = patch_evidence(
        Readings(psi, data, 0.01, np.full(data.shape, 1e-4), np.ones(data.shape, bool)),
        np.full(len(corners), 0.5),
        corners,
        patches.places(psi.shots),
        np.linspace(-2, 2, 5),
        prior,
        **given,
    )
    return found, len(corners)


@pytest.mark.parametrize("stored", [1, 3])
def test_patches_behind_a_coded_aperture_share_covariances(random_psi, monkeypatch, stored):
    psi = random_psi(2, (3, 3), (19, 40), stored)
    aperture = np.broadcast_to(psi.weights[:, :, :, :1, :, :1], psi.weights.shape)
    psi = replace(psi, weights=np.ascontiguousarray(aperture))
    data = np.random.default_rng(0).normal(0, 0.1, psi.frames_shape).astype(np.float32)
    usable = np.random.default_rng(1).random(psi.frames_shape) > 0.1
    patches, prior = EvidencePatches(4, 2), TexturePrior(3.0, (1.5,))
    grid = np.meshgrid(*patches.grid(data.shape[1:]), indexing="ij")
    corners = np.stack(grid, axis=-1).reshape(-1, 2)
    # Groups of patches ask for different disparities.
    first = np.arange(len(corners))[:, None] // LANES % 4
    asked = (np.arange(7) >= first) & (np.arange(7) < first + 3)

    def found():
        return patch_evidence(
            Readings(psi, data, 0.01, np.full(data.shape, 1e-4), usable),
            np.full(len(corners), 0.5), corners, patches.places(2), np.linspace(-1, 1, 7), prior,
            asked,
        )  # fmt: skip

    shared = found()
    monkeypatch.setattr("emmc_rig.reconstruction.adaptive.evidence._alike", lambda _: False)
    single = found()
    np.testing.assert_array_equal(shared.kinds, single.kinds)
    evaluated = np.isfinite(single.log_likelihood)
    np.testing.assert_array_equal(np.isfinite(shared.log_likelihood), evaluated)
    # What is not usable adds the same to all disparities of a patch.
    assert not evaluated.all()
    shift = np.full(evaluated.shape, np.nan)
    shift[evaluated] = shared.log_likelihood[evaluated] - single.log_likelihood[evaluated]
    assert np.nanmax(np.nanmax(shift, axis=1) - np.nanmin(shift, axis=1)) < 0.02


def test_the_evidence_of_several_lengths_is_the_mean_likelihood_of_each(coded_psi):
    psi = coded_psi(size=(14, 16))
    long, short, both = (
        evidence_of_patches(psi, prior)[0]
        for prior in (TexturePrior(4.0), TexturePrior(1.0), TexturePrior(4.0, (1.0,)))
    )
    each = [found.log_likelihood.astype(np.float64) for found in (long, short)]
    np.testing.assert_allclose(
        both.log_likelihood, np.logaddexp(*each) - np.log(2), rtol=1e-5, atol=1e-4
    )
    shorter = each[1].max(axis=1) > each[0].max(axis=1)
    assert 0 < shorter.mean() < 1
    assert (long.kind != short.kind).any()
    np.testing.assert_array_equal(both.kind, np.where(shorter, short.kind, long.kind))


def test_disparities_are_evaluated_where_a_patch_or_one_beside_it_asks(coded_psi):
    psi = coded_psi(size=(20, 22))
    prior = TexturePrior(4.0, (1.0,))
    all_of_them, count = evidence_of_patches(psi, prior)
    assert count > 2 * LANES
    possible = np.zeros((count, 5), dtype=bool)
    possible[:LANES, 1] = possible[3, 4] = possible[LANES:, 2] = possible[-1, 0] = True
    asked = np.zeros((count, 5), dtype=bool)
    asked[:LANES, [1, 4]] = asked[LANES:, 2] = asked[count // LANES * LANES :, 0] = True
    found, _ = evidence_of_patches(psi, prior, possible=possible, kinds=all_of_them.kinds)
    np.testing.assert_array_equal(np.isfinite(found.log_likelihood), asked)
    np.testing.assert_allclose(
        found.log_likelihood[asked], all_of_them.log_likelihood[asked], rtol=1e-5
    )
    np.testing.assert_array_equal(found.kinds, all_of_them.kinds)


def test_a_known_kind_of_texture_is_the_one_that_evidence_assumes(coded_psi):
    psi, prior = coded_psi(size=(14, 16)), TexturePrior(4.0, (1.0,))
    _, count = evidence_of_patches(psi, prior)
    kinds = np.full((count, 2), 4)
    found, _ = evidence_of_patches(psi, prior, kinds=kinds)
    alone, _ = evidence_of_patches(psi, replace(prior, kinds=prior.kinds[4:5]))
    np.testing.assert_allclose(found.log_likelihood, alone.log_likelihood, rtol=1e-6)
    assert np.all(found.kind == 4)


def test_fewer_kinds_compared_never_fit_better_at_what_is_probed(coded_psi):
    psi, prior = coded_psi(size=(14, 16)), TexturePrior(3.0)
    every, _ = evidence_of_patches(psi, prior)
    few, _ = evidence_of_patches(psi, replace(prior, kept=1))
    differ = (few.kind != every.kind).ravel()
    assert 0 < differ.mean() < 1
    best, kept = (found.log_likelihood[:, :4].max(axis=1) for found in (every, few))
    assert np.all(kept[~differ] == best[~differ])
    assert best.mean() > kept.mean()


def test_readings_that_repeat_each_other_without_noise_have_finite_evidence(coded_psi):
    psi = coded_psi(shots=2, size=(14, 16))
    psi = replace(psi, weights=psi.weights[[0, 0]], colour=psi.colour[[0, 0]])
    patches = EvidencePatches(4, 3)
    zero, corner = np.zeros(psi.frames_shape, np.float32), np.array([[1, 2]])
    found = patch_evidence(
        Readings(psi, zero, 0.0, zero, zero == 0), np.ones(1), corner, patches.places(2),
        np.zeros(1), TexturePrior(),
    )  # fmt: skip
    assert np.isfinite(found.log_likelihood).all()


def test_psi_of_surfaces_is_psi_of_their_light_field(random_psi, monkeypatch):
    for stored, shots, binning in ((1, 1, 1), (3, 2, 1), (1, 2, 2)):
        psi = random_psi(shots, (3, 3), (10, 12), stored, binning)
        rng = np.random.default_rng(1)
        centre = rng.uniform(-1, 1, (20, 22)).astype(np.float32)
        disparity, hidden = carried(centre, 5, 1, psi.light_field_shape[:4])
        assert hidden.any()
        texture = rng.random((3, 20, 22)).astype(np.float32)
        frames = rng.normal(size=psi.frames_shape).astype(np.float32)
        change = rng.normal(size=(20, 22)).astype(np.float32)
        results = []
        for most in (assembly.MOST_ROWS, 0):
            monkeypatch.setattr(assembly, "MOST_ROWS", most)
            surfaces = Surfaces(psi, disparity, hidden, 5)
            changes = surfaces.derivative(slopes(texture))
            results.append(
                (
                    surfaces.forward(texture),
                    surfaces.adjoint(frames),
                    changes.forward(change[None]),
                    changes.adjoint(frames),
                )
            )
        monkeypatch.undo()
        expected = psi.forward(surfaces.light_field(texture))
        for part in results:
            # Cells are rounded to 1 / 65534 of a box's largest, here about 1, and a box has 100.
            np.testing.assert_allclose(part[0], expected, rtol=1e-4, atol=3e-4)
            assert np.vdot(part[1], texture) == pytest.approx(np.vdot(expected, frames), rel=1e-4)
            assert np.vdot(part[3], change) == pytest.approx(np.vdot(part[2], frames), rel=1e-4)
        for assembled, followed in zip(*results, strict=True):
            np.testing.assert_allclose(assembled, followed, rtol=1e-3, atol=1e-5)


def test_the_derivative_is_what_frames_change_by_when_the_disparity_grows(coded_psi):
    psi = coded_psi(size=(16, 16), views=(3, 3))
    margin = 6
    # Waves longer than the taps' support: slopes by differences hold to a few per cent.
    y, x = np.indices((28, 28)) / 9
    picture = np.stack([0.5 + 0.3 * np.sin(y + k) * np.cos(x) for k in range(3)]).astype(np.float32)

    def surfaces(d):
        rays = np.full((3, 3, 16, 16), d, np.float32)
        return Surfaces(psi, rays, np.zeros(rays.shape, np.uint8), margin)

    step = 0.1  # of cells rounded to 16 bits, a smaller one shows little but rounding
    change = (surfaces(0.5 + step).forward(picture) - surfaces(0.5 - step).forward(picture)) / (
        2 * step
    )
    changes = surfaces(0.5).derivative(slopes(picture))
    got = changes.forward(np.ones((1, 28, 28), np.float32))
    assert np.linalg.norm(got - change) < 0.03 * np.linalg.norm(change)


def test_the_fit_is_the_posterior_mean_of_dense_algebra(random_psi):
    psi = random_psi(2, (3, 3), (5, 6))
    disparity = np.full((3, 3, 5, 6), 0.4, np.float32)
    surfaces = Surfaces(psi, disparity, np.zeros(disparity.shape, np.uint8), 3)
    shape = surfaces.texture_shape
    rng = np.random.default_rng(2)
    prior = rng.random(shape).astype(np.float32)
    frames = rng.random(psi.frames_shape).astype(np.float32)
    precision = rng.uniform(1, 20, psi.frames_shape).astype(np.float32)
    columns = np.eye(int(np.prod(shape)), dtype=np.float32)
    matrix = np.stack([surfaces.forward(c.reshape(shape)).ravel() for c in columns], axis=1)
    weighted = matrix.T * precision.ravel()
    dense = np.linalg.solve(
        weighted @ matrix + np.eye(len(columns)) / 0.3**2,
        weighted @ frames.ravel() + prior.ravel() / 0.3**2,
    )
    found = fitted(surfaces, frames, precision, prior, 0.3, 200)
    np.testing.assert_allclose(found.ravel(), dense, atol=2e-3)


def test_the_nearer_of_two_planes_hides_the_further_and_uncovers_it_behind():
    centre = np.zeros((30, 30), np.float32)
    centre[10:20, 10:20] = 2.0
    disparity, hidden = carried(centre, 5, 1, (3, 3, 20, 20))
    right = disparity[1, 2]
    assert (right[5:15, 7:17] == 2).all()
    assert hidden[1, 2].sum() == pytest.approx(10 * 2, abs=4)
    assert hidden[1, 2, 5:15, 5:6].all()
    assert (disparity[1, 2][hidden[1, 2] == 1] == 0).all()
    assert not hidden[1, 1].any()
    behind, _ = carried(centre, 5, -1, (3, 3, 20, 20))
    assert (behind[1, 2, 5:15, 15:17] == 0).all()


def test_beliefs_on_a_chain_are_the_exact_marginals(monkeypatch):
    monkeypatch.setattr(search, "FLOOR", 0)
    rng = np.random.default_rng(3)
    evidence = rng.normal(size=(1, 4, 3))
    pairs = compatibility(np.array([-1.0, 0.0, 1.0]), 0.5, 0.1)
    joint = np.einsum("a,b,c,d,ab,bc,cd->abcd", *np.exp(evidence[0]), pairs, pairs, pairs)
    found = posteriors(evidence, pairs)
    for place in range(4):
        exact = joint.sum(axis=tuple(k for k in range(4) if k != place))
        np.testing.assert_allclose(found[0, place], exact / exact.sum(), rtol=1e-4)


def test_another_object_is_rarer_the_larger_its_disparity():
    disparities = np.array([-4.0, 0.0, 1.0, 2.0, 4.0])
    pairs = compatibility(disparities, 0.01, 0.1, np.array([1.0, 1.0, 1.0, 1.0, 2.0]))
    np.testing.assert_allclose(pairs, pairs.T)
    jumps = pairs[1, [0, 3, 4]]
    np.testing.assert_allclose(jumps / jumps[0], [1, 1.5, 2])


@pytest.fixture(scope="module")
def bayer():
    return build_imaging_matrix(find_camera("scenario-ii-cfa"), (48, 56))


@pytest.fixture(scope="module")
def planted(bayer):
    """One noisy shot of a plane at 0.7 px per view, and what is found."""
    truth, _ = plane_scene(bayer, 0.7)
    sigma = 0.004
    noise = np.random.default_rng(5).normal(0, sigma, bayer.frames_shape)
    frames = (bayer.forward(truth.astype(np.float32)) + noise).astype(np.float32)
    return truth, frames, sigma, reconstruct_adaptive(bayer, even_frames(frames, sigma))


def test_a_planted_plane_is_recovered_with_its_disparity(bayer, planted):
    truth, frames, sigma, found = planted
    assert found.status == "converged"
    inner = found.maps["disparity"][6:-6, 26:-6]
    assert np.median(inner) == pytest.approx(0.7, abs=0.08)
    assert np.mean(np.abs(inner - 0.7) < 0.2) > 0.9
    rival = reconstruct_tv(bayer, even_frames(frames, sigma)).light_field
    assert psnr_db(found.light_field, truth) > psnr_db(rival, truth) + 3


def test_sigma_is_calibrated_on_the_planted_plane(planted):
    truth, _, _, found = planted
    error = np.abs(found.light_field - truth)
    sigma = found.maps["sigma"][..., None]
    # On 14 captures 51 to 77 % lay within one deviation, here 82 %.
    assert 0.5 < np.mean(error <= sigma) < 0.85
    # The flat part is known better, and said to be.
    for known in (sigma[..., 0], np.sqrt(np.square(error).mean(axis=-1))):
        assert known[..., :12].mean() < 0.9 * known[..., -20:].mean()


def test_a_disparity_is_as_unsure_as_its_error_where_a_search_believes_in_another_surface():
    rng, stated = np.random.default_rng(0), np.float32(0.2)
    of_one = rng.normal(stated, 0.1, 100_000)
    of_two = np.where(rng.random(100_000) < 0.3, of_one + 2.0, of_one)
    for searches, true in (((of_one,), of_one), ((of_one, of_two), of_two)):
        moments = [
            search.Moments(*np.array([[[px.mean()]], [[px.var()]]], np.float32)) for px in searches
        ]
        found = disparity_deviation(np.array([[stated]]), moments)
        error_px = float(np.sqrt(np.mean((true - stated) ** 2)))
        assert float(found[0, 0]) == pytest.approx(SEARCH_MISSES * error_px, rel=1e-3)


@pytest.mark.slow
def test_the_disparities_of_a_wide_scene_are_within_what_is_stated():
    camera, scene = emmc.camera("scenario-ii-cfa"), emmc.scene("wide-disparity", (96, 96))
    psi = camera.psi(scene.size)
    result = emmc.reconstruct(psi, camera.expose(scene, 0, psi))
    assert scene.disparity_px is not None
    missed = np.abs(result.maps["disparity"] - scene.disparity_px) / result.maps["disparity_sigma"]
    assert (missed < 2).mean() > 0.75  # 0.48 of the spread of a single search
    assert (missed < 1).mean() < 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("method", "at_least"), [("adaptive", 11), ("adaptive-fast", 9)])
def test_intervals_hold_true_psnrs_and_deviations_most_errors(method, at_least):
    """Of twelve captures: fitted on `adaptive`, all of them; of `adaptive-fast`, to 0.5 dB."""
    held = []
    for scene, camera, seed in itertools.product(
        ("deep-occlusions", "dark", "non-lambertian"),
        ("rgbw-bayer-1shot", "rgbw-bayer-3shots"),
        (7, 8),
    ):
        given = trial_of(Capture(scene, camera, (48, 64), seed=seed, noise=0.003))
        found = given.solved(method)
        low_db, high_db = found.stated["stated_interval_db"]
        psnr_db = given.psnr_db(found.light_field)
        assert low_db - 0.6 < psnr_db < high_db + 0.6
        held.append(low_db < psnr_db < high_db)
        assert high_db - low_db == pytest.approx(2 * within_db(found.parameters["decided"]))
        error = np.abs(found.light_field - given.truth)
        assert 0.5 < np.mean(error <= found.maps["sigma"][..., None]) < 0.8
    assert sum(held) >= at_least


def test_an_interval_is_wider_where_patches_do_not_decide():
    assert 1 < within_db(1.0) < within_db(0.5) < within_db(0.2)
    assert within_db(None) == within_db(1.0)


def test_what_a_capture_foretells_does_not_depend_on_its_brightness():
    rng = np.random.default_rng(0)
    light_field = rng.random((3, 3, 8, 8, 3))
    variance, other, spread = rng.random(3)
    sigma_px = rng.random((8, 8))
    of = features(variance, other, spread, sigma_px, light_field)
    dim = features(variance / 16, other / 16, spread / 16, sigma_px, light_field / 4)
    assert dim == pytest.approx(of)
    # Further from total variation, or less sure of disparities: more errors, and larger ones.
    further = of | {"apart": of["apart"] + 1}, of | {"disparity": -2.0}
    for item, more in ((of, further[0]), (of | {"disparity": -3.0}, further[1])):
        assert all(b > a for a, b in zip(foretold_db(item), foretold_db(more), strict=True))
    # Nothing is foretold from beyond the captures that were fitted.
    least = {name: feature.lowest for name, feature in FEATURES.items()}
    assert foretold_db({name: value - 5 for name, value in least.items()}) == foretold_db(least)


def test_a_mask_that_treats_all_views_alike_decides_nothing():
    camera = Camera.model_validate(
        {"title": "no mask", "views": (3, 3), "sensor": {"cfa": "mono"}, "masks": {}}
    )
    psi = build_imaging_matrix(camera, (40, 40))
    weights = np.zeros_like(psi.weights)
    weights[:, 1, 1] = 1 / 3
    pinhole = Psi(weights, psi.colour)
    truth, _ = plane_scene(pinhole, 0.0, seed=1)
    found = reconstruct_adaptive(pinhole, even_frames(pinhole.forward(truth), 0.003), quick())
    assert found.parameters["decided"] < 0.25


@pytest.mark.parametrize(("furthest_px", "low", "high"), [(24.0, 0.0, 0.01), (0.5, 0.5, 1.0)])
def test_a_scene_beyond_the_range_searched_is_at_its_end(bayer, planted, furthest_px, low, high):
    """A plane at 0.7 px per view; the share is that of the fine search, not of the coarse one."""
    _, frames, sigma, _ = planted
    given = checked(bayer, even_frames(frames, sigma))
    settings = AdaptiveSettings(furthest_px=furthest_px)
    survey = surveyed(given, settings, None, lambda _: None)
    rough = replace(survey.rough, at_end=0.25)
    assert low <= search.fine(survey.data, survey.prior, rough, settings).at_end <= high


def test_weak_textures_that_prefer_no_disparity_do_not_make_the_evidence_flat():
    kind, unit = np.full((4, 5), 1), np.zeros(1, np.float32)
    kind[0] = 3
    volume = Volume(np.zeros(1), (unit, unit), unit[None, None], unit[None, None], kind, kind == 3)
    assert method._decided(volume) == 1
    assert method._decided(replace(volume, decisive=kind < 0)) == 0
    assert method._decided(replace(volume, kind=np.ones((4, 5), int))) is None


def test_corners_of_a_second_grid_lie_between_and_cover_the_same_pixels():
    patches = EvidencePatches(side=8, stride=6)
    rows, columns = patches.grid((30, 32), first=3)
    assert rows.tolist() == [0, 3, 9, 15, 21, 22]
    assert columns.tolist() == [0, 3, 9, 15, 21, 24]
    assert patches.grid((30, 32))[0].tolist() == [0, 6, 12, 18, 22]


def test_a_disparity_is_possible_near_where_the_rough_search_believes_it():
    grid = np.array([4.0, 16.0, 28.0]), np.array([4.0, 16.0, 28.0, 40.0])
    rough = np.zeros((3, 4, 3), np.float32)
    rough[..., 0] = 1
    rough[1, 2] = 0.0, 0.97, 0.03
    kind = np.zeros((3, 4), int)
    volume = Volume(np.array([-0.5, 0.0, 1.0]), grid, rough, rough, kind, kind == 0)
    labels = np.arange(-4, 9) * 0.25
    corners = np.array([0, 20]), np.array([0, 40])
    found = _possible(volume, EvidencePatches(8, 6), corners, labels)
    # Centres 12 px apart: what lies within 18 px of a patch is near. The labels' spacings are 0.5,
    # 0.75 and 1.
    near_first = np.abs(labels + 0.5) <= 0.5
    others = (np.abs(labels) <= 0.75) | (np.abs(labels - 1) <= 1)
    np.testing.assert_array_equal(found[:, 0], [near_first] * 2)
    np.testing.assert_array_equal(found[:, 1], [near_first | others] * 2)
    # Of many disparities none may be as probable as is asked: the likeliest is possible.
    vague = replace(volume, probability=(rough * 0.01).astype(np.float32))
    np.testing.assert_array_equal(
        _possible(vague, EvidencePatches(8, 6), corners, labels)[:, 0], [near_first] * 2
    )
    # Far from all, what the nearest believe counts.
    far = _possible(volume, EvidencePatches(8, 6), (np.array([20]), np.array([90])), labels)
    np.testing.assert_array_equal(far[0, 0], near_first)


def test_evidence_between_disparities_is_that_of_a_cubic():
    at = np.arange(13.0)
    curves = np.stack([0.1 * at**3 - at**2, 5 - at**2]).astype(np.float32)
    known = curves[:, ::3].copy()
    known[1, 0] = -np.inf
    found = _between(known, 3)
    np.testing.assert_allclose(found[0], curves[0], atol=1e-3)
    np.testing.assert_allclose(found[1, 3:], curves[1, 3:], atol=1e-3)
    assert np.all(found[1, :3] == -np.inf)
    # One known value stands alone, others lie beyond a gap.
    known = np.array([[1.0, -np.inf, 2.0, 4.0]], np.float32)
    expected = [[1, -np.inf, -np.inf, -np.inf, 2, 3, 4]]
    np.testing.assert_allclose(_between(known, 2), expected, rtol=1e-6)


def test_evidence_that_decides_nothing_excludes_nothing():
    known = np.array([[-np.inf, 1.0, -np.inf, 2.0, -np.inf, -np.inf]], np.float32)
    np.testing.assert_allclose(_extended(known), [[1, 1, 1.5, 2, 2, 2]])
    assert _extended(known[:0]).shape == (0, 6)


def test_patches_of_a_tile_evaluate_what_any_of_them_allows():
    possible = np.zeros((TILE + 2, TILE, 3), dtype=bool)
    possible[0, 5, 1] = possible[TILE + 1, 0, 2] = True
    found = _shared(possible)
    np.testing.assert_array_equal(found[:TILE], np.broadcast_to([0, 1, 0], (TILE, TILE, 3)))
    np.testing.assert_array_equal(found[TILE:], np.broadcast_to([0, 0, 1], (2, TILE, 3)))


def test_labels_evaluated_have_those_possible_between_them():
    possible = np.zeros((1, 2, 7), dtype=bool)
    possible[0, 0, 3] = possible[0, 1, 4] = True
    np.testing.assert_array_equal(_asked(possible, 1), possible)
    found = _asked(possible, 2)
    assert [np.flatnonzero(item).tolist() for item in found[0]] == [[1, 2], [2]]
    assert np.flatnonzero(_spanned(found[0, 0], 2)).tolist() == [2, 3, 4]
    assert np.flatnonzero(_spanned(np.array([1, 0, 1, 1], bool), 2)).tolist() == [0, 4, 5, 6]


def test_disparities_beside_the_best_known_are_evaluated():
    evidence = np.array([[0.0, -9.0, -30.0, -29.0, -1.0, -np.inf, -2.0]], np.float32)
    found = _near_best(evidence, 2)
    assert np.flatnonzero(found[0]).tolist() == [1, 7]
    assert not _near_best(evidence, 1).any()


def test_beliefs_of_two_grids_are_averaged_where_they_disagree():
    labels, own = np.array([0.0, 0.25, 1.0]), np.zeros((2, 2, 3), np.float32)
    own[..., 0] = 1
    other = np.zeros((2, 2, 3), np.float32)
    other[..., 1:] = 0.8, 0.2
    grid, kind = np.array([1.0, 5.0]), np.zeros((2, 2), int)
    between = Volume(labels, (grid + 1, grid + 1), other, other, kind, kind == 0)
    volume = Volume(labels, (grid, grid), own, own, kind, kind == 0, between=between)
    # 0 is the likeliest, 1/2, and 0.25, 0.4, lies beside it; 1 is another surface.
    expected = 0.25 * 0.4 / 0.9
    np.testing.assert_allclose(per_pixel(volume, (7, 7), 1), expected, rtol=1e-5)
    mean = 0.4 * 0.25 + 0.1
    variance = 0.4 * 0.25**2 + 0.1 - mean**2
    np.testing.assert_allclose(moments_per_pixel(volume, (7, 7), 1).variance, variance, rtol=1e-5)
    assert np.all(per_pixel(replace(volume, between=None), (7, 7), 1) == 0)


def quick():
    return AdaptiveSettings(texture=TextureSettings(steps=3, refine_steps=0, fit_steps=6))


@pytest.mark.parametrize("camera", ["rgbw-bayer-1shot", "rgbw-bayer-2shots"])
def test_where_surfaces_fail_total_variation_is_returned(camera):
    psi = build_imaging_matrix(find_camera(camera), (48, 56))
    rng = np.random.default_rng(3)
    # Views with nothing in common: no disparity explains them.
    views = rng.random((*psi.light_field_shape[:2], 6, 7, 3)).repeat(8, axis=2).repeat(8, axis=3)
    frames = psi.forward(views.astype(np.float32))
    found = reconstruct_adaptive(psi, even_frames(frames, 0.003), quick())
    plain = reconstruct_tv(psi, even_frames(frames, 0.003)).light_field
    assert np.median(np.abs(found.light_field - plain).mean(axis=(0, 1, 4))) < 0.05
    error = float(np.square(found.light_field - views).mean())
    assert 0.15 * error < np.square(found.maps["sigma"]).mean() < 2.5 * error


def test_surfaces_stay_where_nothing_speaks_against_them():
    psi = build_imaging_matrix(find_camera("rgbw-bayer-2shots"), (48, 56))
    truth = plane_scene(psi, 0.7)[0].astype(np.float32)
    frames = psi.forward(truth)
    found = reconstruct_adaptive(psi, even_frames(frames, 0.003), quick())
    plain = reconstruct_tv(psi, even_frames(frames, 0.003)).light_field
    assert psnr_db(found.light_field, truth) > psnr_db(plain, truth) + 3


def test_misfit_is_one_at_the_noise_and_says_where_it_is_more():
    missed = np.random.default_rng(2).normal(0, 0.001, (2, 60, 80))
    noise, fitted = np.full(missed.shape, 0.001**2), np.ones(missed.shape, bool)
    assert method.misfit(missed, noise, fitted)["misfit"] == pytest.approx(1, abs=0.05)
    missed[:, 40:46, 20:26] *= 30
    found = method.misfit(missed, noise, fitted)
    # The sum of 8,528 squares at the noise and 72 of 900 times that.
    assert found["misfit"] == pytest.approx(np.sqrt((9528 + 72 * 900) / 9600), rel=0.1)
    assert abs(found["misfit_row"] - 42.5) < 2
    assert abs(found["misfit_column"] - 22.5) < 2


def test_the_disparity_of_every_pixel_is_sharpened_towards_the_planted_one(bayer):
    light_field, _ = plane_scene(bayer, 0.7, seed=2)
    frames = bayer.forward(light_field)
    begun = (0.7 + np.random.default_rng(3).normal(0, 0.1, bayer.size)).astype(np.float32)
    precision = np.full(frames.shape, 1 / 0.003**2, np.float32)
    picture = centre_view(light_field)
    found = solve(bayer, begun, 1, frames, precision, picture, TextureSettings(sweeps=()))
    # Flat at the left: there nothing tells the disparity.
    before, after = (item[6:-6, 26:-6] - 0.7 for item in (begun, found.centre))
    assert abs(np.median(after)) < 0.02
    assert np.abs(after).mean() < 0.5 * np.abs(before).mean()


def test_a_scene_of_little_contrast_is_fitted_as_if_it_had_more(bayer, planted):
    _, frames, sigma, _ = planted
    scales = []
    for share in (0.1, 0.2, 3.0):
        given = checked(bayer, even_frames((share * frames).astype(np.float32), share * sigma))
        scales.append(surveyed(given, quick(), None, lambda _: None).scale)
    assert scales[0] < 0.5
    assert scales[1] == pytest.approx(2 * scales[0], rel=1e-3)
    assert scales[2] == 1


def test_every_reading_counts_by_its_own_noise(bayer):
    truth, _ = plane_scene(bayer, 0.7)
    rng = np.random.default_rng(4)
    deviation = np.full(bayer.frames_shape, 0.003)
    deviation[:, ::3, ::2] = 0.1
    frames = bayer.forward(truth.astype(np.float32)) + rng.normal(0, deviation)
    each = Frames(frames.astype(np.float32), deviation, np.ones(frames.shape, bool))
    errors = [
        float(np.square(reconstruct_adaptive(bayer, given, quick()).light_field - truth).mean())
        for given in (each, each.of_one_deviation())
    ]
    assert errors[0] < 0.5 * errors[1]
    by_each, by_one = (
        reconstruct_tv(bayer, given).light_field for given in (each, each.of_one_deviation())
    )
    np.testing.assert_allclose(by_each, by_one, atol=1e-5)


def test_bad_inputs_are_refused_in_one_line(bayer):
    with pytest.raises(ReconstructionError, match="frames of shape"):
        reconstruct_adaptive(bayer, even_frames(np.zeros((1, 4, 4), np.float32), 0.01))
    dark, small = np.zeros(bayer.frames_shape, np.float32), np.zeros((4, 4), np.float32)
    with pytest.raises(ReconstructionError, match="a disparity of shape"):
        reconstruct_adaptive(bayer, even_frames(dark, 0.01), disparity=small)
    wrong = np.full(bayer.frames_shape, 0.01)
    wrong[0, 0, 0] = np.nan
    with pytest.raises(ReconstructionError, match="a noise level of nan"):
        reconstruct_adaptive(bayer, replace(even_frames(dark, 0.01), deviation=wrong))
    tiny = bayer.window(slice(0, 4), slice(0, 4))
    with pytest.raises(ReconstructionError, match="do not fit a sensor"):
        reconstruct_adaptive(tiny, even_frames(np.zeros((1, 4, 4), np.float32), 0.01))


def test_a_pixel_is_kept_from_the_fit_with_all_its_shots_or_not_at_all():
    usable = np.ones((3, 40, 50), bool)
    usable[1, :20] = False
    held = held_out(usable)
    assert 0 < held.sum() < 0.06 * usable.sum()
    np.testing.assert_array_equal(held, usable & held.any(axis=0))


@pytest.mark.parametrize("binning", [1, 2])
def test_frames_of_a_plane_are_psi_of_its_surface(random_psi, binning):
    psi = random_psi(2, (3, 3), (10, 12), 1, binning)
    texture = np.random.default_rng(1).random((3, 24, 26)).astype(np.float32)
    rays = np.full((3, 3, *psi.size), -0.7, np.float32)
    surfaces = Surfaces(psi, rays, np.zeros(rays.shape, np.uint8), 7)
    np.testing.assert_allclose(
        plane_frames(psi, texture, -0.7, 7), surfaces.forward(texture), rtol=1e-4, atol=1e-5
    )


def test_a_sweep_with_the_right_texture_mends_a_wrong_disparity(bayer):
    truth, surfaces = plane_scene(bayer, 0.75)
    frames = bayer.forward(truth.astype(np.float32))
    texture = textured(surfaces.texture_shape[1:])
    labels = np.arange(-1, 1.1, 0.25)
    # All patches but one in the even part believe in 0, though not firmly.
    beliefs = np.full((3, 3, len(labels)), 0.05, np.float32)
    beliefs[..., 4] = 1 - 0.05 * (len(labels) - 1)
    beliefs[2, 0] = beliefs[2, 0, ::-1].take(np.arange(len(labels)) + 6, mode="wrap")
    at = np.array([0.0, 24.0, 47.0]), np.array([0.0, 28.0, 55.0])
    volume = Volume(labels, at, beliefs, beliefs, np.zeros((3, 3), int), beliefs[..., 0] > 0)
    noise = np.full(frames.shape, 1e-5, np.float32)
    used = np.ones(frames.shape, bool)
    rays = np.zeros_like(surfaces.disparity)
    wrong = Surfaces(bayer, rays, np.zeros(rays.shape, np.uint8), surfaces.margin)
    found = swept(
        volume, Readings(bayer, frames, 0.003, noise, used), texture, wrong, AdaptiveSettings()
    )
    disparity = per_pixel(found, bayer.size, 1)[4:-4, 26:-6]
    assert np.mean(np.abs(disparity - 0.75) < 0.13) > 0.9
