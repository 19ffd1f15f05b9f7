"""Learning: pursuits against scikit-learn, K-SVD against its definition, resuming, coresets."""

import learning
import numpy as np
import pytest
from batch_omp import NO_ATOM, batch_omp
from learning import (
    LearningSettings,
    LearningState,
    first_state,
    flat_atoms,
    ksvd_step,
    learn_ksvd,
)
from training_patches import (
    PatchSettings,
    coreset,
    cut_patches,
    training_patches,
)

from emmc_rig.reconstruction.errors import DictionaryError

SHAPE = (2, 2, 3, 4, 1)
SAMPLES = 48


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def planted(count, atoms=60, sparsity=3, noise=0.0, seed=0, samples=SAMPLES):
    """Return atoms and patches of exactly `sparsity` of them, plus noise."""
    rng = np.random.default_rng(seed)
    truth = unit(rng.standard_normal((atoms, samples)))
    codes = np.zeros((count, atoms))
    for row in codes:
        row[rng.choice(atoms, sparsity, replace=False)] = rng.standard_normal(sparsity)
    patches = codes @ truth + noise * rng.standard_normal((count, samples))
    return truth, patches.astype(np.float32)


def dense(indices, coefficients, atoms):
    codes = np.zeros((len(indices), atoms + 1))
    np.put_along_axis(codes, indices.astype(int), coefficients, axis=1)
    return codes[:, :-1]


def squares(state, patches):
    """Return every patch's squared error, in float64, from the state's atoms and codes."""
    codes = dense(state.indices, state.coefficients, len(state.atoms))
    left = patches - codes @ state.atoms.astype(np.float64)
    return np.square(left).sum(axis=1)


def recovered(truth, atoms):
    """Return the share of true atoms with |<d, d'>| > 0.99 for some learnt atom."""
    return float((np.abs(truth @ atoms.T).max(axis=1) > 0.99).mean())


def plain_omp(atoms, patch, sparsity):
    """Return the codes of a textbook pursuit: choose, solve least squares, subtract."""
    chosen: list[int] = []
    left = patch.astype(np.float64)
    solution = np.zeros(0)
    for _ in range(sparsity):
        chosen.append(int(np.abs(atoms @ left).argmax()))
        basis = atoms[chosen].astype(np.float64)
        solution = np.linalg.lstsq(basis.T, patch, rcond=None)[0]
        left = patch - solution @ basis
    codes = np.zeros(len(atoms))
    codes[chosen] = solution
    return codes


def test_pursuits_are_the_textbook_s():
    rng = np.random.default_rng(1)
    atoms = unit(rng.standard_normal((700, SAMPLES)))
    patches = rng.standard_normal((40, SAMPLES)).astype(np.float32)
    found = dense(*batch_omp(atoms, patches, 9), 700)
    plain = np.array([plain_omp(atoms, patch, 9) for patch in patches])
    np.testing.assert_allclose(found, plain, atol=1e-4)


def test_codes_do_not_depend_on_the_batches(monkeypatch):
    truth, patches = planted(50)
    whole = batch_omp(truth, patches, 4)
    monkeypatch.setattr("batch_omp._BATCH_BYTES", 4 * 60 * 7)
    parts = batch_omp(truth, patches, 4)
    np.testing.assert_array_equal(whole[0], parts[0])
    np.testing.assert_allclose(whole[1], parts[1], atol=1e-5)


def test_a_pursuit_ends_when_nothing_is_left():
    atoms = np.eye(SAMPLES, dtype=np.float32)
    patches = np.zeros((3, SAMPLES), np.float32)
    patches[1, 5] = 2
    patches[2, [7, 9]] = 3, -1
    indices, coefficients = batch_omp(atoms, patches, 4)
    assert indices.tolist() == [
        [NO_ATOM] * 4,
        [5, NO_ATOM, NO_ATOM, NO_ATOM],
        [7, 9, NO_ATOM, NO_ATOM],
    ]
    np.testing.assert_allclose(coefficients, [[0, 0, 0, 0], [2, 0, 0, 0], [3, -1, 0, 0]])


def test_a_doubled_atom_is_taken_once():
    truth, patches = planted(30, atoms=20, noise=0.1)
    indices, coefficients = batch_omp(np.concatenate([truth, truth]), patches, 6)
    assert np.isfinite(coefficients).all()
    for row in indices:
        taken = row[row >= 0] % 20
        assert len(set(taken)) == len(taken)


@pytest.mark.parametrize(
    ("samples", "sparsity", "reported"),
    [(SAMPLES + 1, 3, "atoms have 48"), (SAMPLES, 0, "sparsity"), (SAMPLES, 61, "1 to 60")],
)
def test_pursuits_that_cannot_be_are_refused(samples, sparsity, reported):
    truth, _ = planted(1)
    with pytest.raises(DictionaryError, match=reported):
        batch_omp(truth, np.zeros((4, samples), np.float32), sparsity)


def settings_of(**changes):
    plain = {"atoms": 60, "sparsity": 3, "iterations": 5, "flat_atoms": False}
    return LearningSettings.model_validate({**plain, **changes})


def test_the_error_never_rises_in_the_coding_nor_in_the_update():
    _, patches = planted(900, noise=0.05)
    history = learn_ksvd(patches, SHAPE, settings_of(iterations=12, sparsity=4)).history
    assert sum(done.replaced for done in history) == 0
    errors = np.array([(done.coded_rmse, done.updated_rmse) for done in history]).ravel()
    assert (np.diff(errors) <= 1e-7).all()
    assert errors[-1] < 0.6 * errors[0]


def test_no_patch_is_coded_worse_than_before():
    _, patches = planted(400, noise=0.3)
    settings = settings_of(sparsity=5, iterations=3)
    state = learn_ksvd(patches, SHAPE, settings)
    before = squares(state, patches)
    indices, coefficients = batch_omp(state.atoms, patches, 5)
    plain = squares(LearningState(state.atoms, indices, coefficients), patches)
    assert (plain > before * (1 + 1e-6)).any(), "a pursuit alone does make some patches worse"
    residuals = np.empty_like(patches)
    kept = learning._keep_better(state, patches, indices, coefficients, residuals)
    assert (kept <= before * (1 + 1e-5)).all()
    assert (kept <= plain * (1 + 1e-5)).all()
    np.testing.assert_allclose(np.square(residuals).sum(axis=1), kept, rtol=1e-5)
    after = squares(LearningState(state.atoms, indices, coefficients), patches)
    np.testing.assert_allclose(after, kept, rtol=1e-4)


def test_the_error_falls_at_every_atom_s_update():
    _, patches = planted(500, noise=0.1)
    state = first_state(patches, settings_of(), SHAPE)
    indices, coefficients = batch_omp(state.atoms, patches, 3)
    codes = dense(indices, coefficients, 60)
    for last in range(0, 60, 7):
        atoms, weights = state.atoms.copy(), coefficients.copy()
        residuals = (patches - codes @ atoms).astype(np.float32)
        errors = [float(np.square(residuals).sum(dtype=np.float64))]
        for atom in range(last, min(last + 7, 60)):
            only = np.where(indices == atom, indices, NO_ATOM)
            learning._update_atoms(atoms, only, weights, residuals, 2, 0)
            errors.append(float(np.square(residuals).sum(dtype=np.float64)))
        assert (np.diff(errors) < 0).all()
        left = patches - dense(indices, weights, 60) @ atoms
        np.testing.assert_allclose(residuals, left, atol=2e-5)


def test_an_update_with_many_power_iterations_is_the_singular_vector():
    rng = np.random.default_rng(4)
    patches = rng.standard_normal((30, SAMPLES)).astype(np.float32)
    patches += 3 * rng.standard_normal((30, 1)).astype("f4") * unit(patches[:1])
    atoms = unit(rng.standard_normal((1, SAMPLES)))
    indices = np.zeros((30, 1), np.int32)
    weights = (patches @ atoms.T).astype(np.float32)
    residuals = patches - weights @ atoms
    learning._update_atoms(atoms, indices, weights, residuals, 60, 0)
    left, size, right = np.linalg.svd(patches.astype(np.float64))
    assert abs(right[0] @ atoms[0]) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(np.abs(weights[:, 0]), size[0] * np.abs(left[:, 0]), atol=1e-3)


def test_a_planted_dictionary_is_recovered():
    truth, patches = planted(3000, noise=0.03)
    state = learn_ksvd(patches, SHAPE, settings_of(iterations=60))
    assert recovered(truth, first_state(patches, settings_of(), SHAPE).atoms) < 0.1
    assert recovered(truth, state.atoms) >= 0.95


def test_atoms_unused_or_doubled_are_replaced_by_what_is_worst_coded():
    _, patches = planted(200, noise=0.1)
    settings = settings_of()
    atoms = first_state(patches, settings, SHAPE).atoms
    atoms[7] = -atoms[3]
    indices, coefficients = batch_omp(atoms, patches, 3)
    coefficients[indices == 11] = 0
    indices[indices == 11] = NO_ATOM
    state = LearningState(atoms, indices, coefficients)
    new, count = learning._replace_atoms(state, patches, settings, 0)
    changed = set(np.flatnonzero((new.atoms != atoms).any(axis=1)))
    assert count == len(changed)
    assert 11 in changed
    assert len(changed & {3, 7}) == 1
    errors = squares(state, patches)
    left = patches - dense(indices, coefficients, 60) @ atoms
    worst = unit(left[np.argsort(-errors)[:count]])
    np.testing.assert_allclose(np.abs(new.atoms[sorted(changed)] @ worst.T).max(1), 1, atol=1e-5)
    assert not np.isin(new.indices, sorted(changed)).any()
    kept = ~np.isin(indices, sorted(changed))
    np.testing.assert_array_equal(new.coefficients[kept], coefficients[kept])


def test_flat_atoms_stay_and_span_the_flat_colours():
    shape = (2, 2, 3, 4, 3)
    rng = np.random.default_rng(0)
    patches = rng.random((200, 144)).astype(np.float32)
    flat = flat_atoms(shape)
    settings = settings_of(atoms=20, flat_atoms=True, iterations=2)
    np.testing.assert_array_equal(learn_ksvd(patches, shape, settings).atoms[:3], flat)
    for colour in np.eye(3):
        patch = np.broadcast_to(colour, shape).ravel()
        np.testing.assert_allclose(flat.T @ (flat @ patch), patch, atol=1e-6)


def arrays(state):
    return {k: v for k, v in vars(state).items() if k != "history"}


def assert_equal_states(state, other):
    assert state.history == other.history
    for key, array in arrays(state).items():
        np.testing.assert_array_equal(array, arrays(other)[key])


def test_a_resumed_training_is_the_undisturbed_one_and_another_seed_another():
    _, patches = planted(300, noise=0.1)
    whole = learn_ksvd(patches, SHAPE, settings_of(iterations=5))
    kept = learn_ksvd(patches, SHAPE, settings_of(iterations=2))
    assert_equal_states(whole, learn_ksvd(patches, SHAPE, settings_of(iterations=5), kept))
    other = learn_ksvd(patches, SHAPE, settings_of(iterations=2, seed=6))
    assert kept.history != other.history


def test_every_step_is_seen_and_steps_do_not_change_their_input():
    _, patches = planted(200, noise=0.1)
    settings = settings_of(iterations=3)
    seen = []
    last = learn_ksvd(patches, SHAPE, settings, on_step=seen.append)
    assert [len(state.history) for state in seen] == [1, 2, 3]
    assert seen[-1] is last
    copies = {key: array.copy() for key, array in arrays(seen[0]).items()}
    again = ksvd_step(seen[0], patches, settings, 0)
    np.testing.assert_array_equal(again.atoms, seen[1].atoms)
    for key, array in arrays(seen[0]).items():
        np.testing.assert_array_equal(array, copies[key])


@pytest.mark.parametrize(
    ("change", "settings", "reported"),
    [
        (lambda p: p[:, :-1], {}, r"needs \(patch, 48\)"),
        (lambda p: p[:20], {}, "20 patches for 60 atoms"),
        (lambda p: np.where(np.arange(len(p))[:, None] == 9, np.nan, p), {}, "not finite"),
        (lambda p: p.astype(np.float64), {}, "float64"),
        (np.zeros_like, {}, "too few to start"),
        (np.copy, {"sparsity": 70}, "sparsity of 70"),
        (np.copy, {"atoms": 1, "sparsity": 1, "flat_atoms": True}, "more than the 1 flat"),
    ],
)
def test_patches_and_settings_that_teach_nothing_are_refused(change, settings, reported):
    with pytest.raises(DictionaryError, match=reported):
        learn_ksvd(change(planted(100)[1]), SHAPE, settings_of(**settings))


def test_a_state_of_another_training_is_refused():
    state = learn_ksvd(planted(300)[1], SHAPE, settings_of(iterations=1))
    with pytest.raises(DictionaryError, match="other patches or settings"):
        learn_ksvd(planted(300, samples=36)[1], (2, 2, 3, 3, 1), settings_of(iterations=2), state)


def ramp_scene(views=(3, 3), size=(12, 14), colours=3):
    """Return a light field whose every sample has its own value."""
    count = int(np.prod([*views, *size, colours]))
    return (np.arange(count) / count).reshape(*views, *size, colours).astype(np.float32)


@pytest.mark.parametrize("symmetry", range(8))
def test_a_symmetry_turns_views_and_pixels_together(symmetry):
    lf = ramp_scene()
    patch = cut_patches(lf, np.array([[2, 3]]), np.array([symmetry]), (4, 4))[0]
    plain = lf[:, :, 2:6, 3:7]
    if symmetry & 1:
        plain = plain[:, ::-1, :, ::-1]
    if symmetry & 2:
        plain = plain[::-1, :, ::-1]
    if symmetry & 4:
        plain = plain.transpose(1, 0, 3, 2, 4)
    np.testing.assert_array_equal(patch, plain)


def test_a_symmetry_keeps_a_plane_a_plane_of_the_same_disparity():
    rng = np.random.default_rng(0)
    texture = rng.random((20, 20)).astype(np.float32)
    lf = np.empty((3, 3, 12, 12, 1), np.float32)
    for v, u in np.ndindex(3, 3):
        lf[v, u, ..., 0] = texture[5 - v : 17 - v, 5 - u : 17 - u]
    patches = cut_patches(lf, np.full((8, 2), 3), np.arange(8), (5, 5))
    for patch in patches:
        np.testing.assert_array_equal(patch[2, 2, 1:, 1:], patch[1, 1, :-1, :-1])


def test_patches_of_even_size_keep_their_mean():
    scene = 0.5 + 0.1 * ramp_scene()
    settings = PatchSettings(rows=8, columns=8, count=50, candidates_per_patch=1)
    patches = training_patches([lambda: scene], settings)
    assert patches.shape == (50, 3, 3, 8, 8, 3)
    assert patches.mean() == pytest.approx(scene.mean(), rel=0.02)


def test_patches_come_from_every_scene_evenly_and_by_the_seed():
    scenes = [lambda level=level: np.full((2, 2, 9, 9, 3), level, "f4") for level in (0.2, 0.4)]
    settings = PatchSettings(rows=4, columns=4, count=20, candidates_per_patch=1)
    levels = training_patches(scenes, settings)[:, 0, 0, 0, 0, 0]
    assert np.unique(levels, return_counts=True)[1].tolist() == [10, 10]
    ramp = [ramp_scene]
    first, same, other = (
        training_patches(ramp, PatchSettings(rows=4, columns=4, count=20, seed=seed))
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, same)
    assert (first != other).any()


def test_every_scene_is_read_twice_one_at_a_time():
    read, seen = [], []
    scenes = [lambda i=i: read.append(i) or ramp_scene() for i in range(3)]
    training_patches(scenes, PatchSettings(rows=4, columns=4, count=9), seen.append)
    assert read == seen == [0, 1, 2, 0, 1, 2]


def test_a_coreset_has_what_was_asked_for_and_no_candidate_twice():
    rng = np.random.default_rng(0)
    energies = rng.exponential(size=1000) ** 3
    for count in (1, 100, 999, 1000):
        chosen, weights = coreset(energies, count, np.random.default_rng(1))
        assert len(set(chosen.tolist())) == len(chosen) == count
        assert (np.diff(chosen) > 0).all()
        assert weights.mean() == pytest.approx(1)


def test_a_coreset_s_weighted_error_is_an_unbiased_estimate_of_all_candidates():
    rng = np.random.default_rng(0)
    energies = rng.exponential(size=2000) ** 2
    other = energies * rng.random(2000)
    estimates = []
    for seed in range(300):
        chosen, weights = coreset(energies, 100, np.random.default_rng(seed))
        estimates.append(np.mean(weights * other[chosen]))
    spread = np.std(estimates) / np.sqrt(len(estimates))
    assert np.mean(estimates) == pytest.approx(other.mean(), abs=4 * spread + 0.01 * other.mean())
    even = [np.mean(rng.choice(other, 100)) for _ in range(300)]
    assert np.std(estimates) < 0.7 * np.std(even)


def test_a_coreset_of_equal_candidates_is_even():
    for energies in (np.zeros(100), np.ones(100)):
        chosen, weights = coreset(energies, 20, np.random.default_rng(0))
        np.testing.assert_array_equal(np.diff(chosen), 5)
        np.testing.assert_allclose(weights, 1)


def test_scenes_that_give_no_patches_are_refused():
    settings = PatchSettings(rows=9, columns=9, count=8)
    broken = ramp_scene()
    broken[1, 1, 3, 3] = np.nan
    for scenes, reported in (
        ([], "no scenes"),
        ([lambda: ramp_scene(size=(8, 20))], "8x20 pixels, less than a patch of 9x9"),
        ([ramp_scene, lambda: ramp_scene(views=(2, 3))], "2x3 views of 3 colours, the first 3x3"),
        ([ramp_scene, lambda: ramp_scene(colours=1)], "of 1 colours"),
        ([lambda: broken], "not finite"),
    ):
        with pytest.raises(DictionaryError, match=reported):
            training_patches(scenes, settings)
