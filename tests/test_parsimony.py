"""Parsimony of the adaptive method: one plane, no colour, no surface, where frames say so."""

from dataclasses import replace

import numpy as np
import pytest
from test_adaptive import plane_scene, quick

from emmc_rig.files.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from reconstruction.adaptive.method import reconstruct_adaptive
from reconstruction.adaptive.models import MODELS
from reconstruction.adaptive.parsimony import Plane, colour_is_needed, grey_psi, one_plane
from reconstruction.adaptive.search import Volume
from reconstruction.adaptive.settings import AdaptiveSettings
from reconstruction.errors import ReconstructionError
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.tv import reconstruct_tv

LABELS = np.arange(-1, 1.01, 0.125)


@pytest.fixture(scope="module")
def bayer():
    return build_imaging_matrix(find_camera("scenario-ii-cfa"), (48, 56))


def volume_of(disparity, decisive=None):
    """Patches every 4 pixels that lose 20 nats a pixel off their disparity (row, column)."""
    evidence = -20 * np.abs(disparity[..., None] - LABELS)
    centres = tuple(3.5 + 4.0 * np.arange(n) for n in disparity.shape)
    sure = np.ones(disparity.shape, bool) if decisive is None else decisive
    chance = np.exp(evidence) / np.exp(evidence).sum(axis=-1, keepdims=True)
    kind = np.ones(disparity.shape, np.int64)
    return Volume(
        LABELS, centres, chance.astype(np.float32), evidence.astype(np.float32), kind, sure
    )


def test_a_plane_is_found_through_patches_that_decide_nothing():
    rows, columns = np.indices((10, 12)) * 4.0 + 3.5
    wanted = Plane(0.2, 0.005, -0.008).over((48, 56), 1)[4::4, 4::4][:10, :12]
    decisive = np.ones((10, 12), bool)
    decisive[3:5, 2:6] = False
    wild = wanted.copy()
    wild[~decisive] = -1
    found = one_plane(volume_of(wild, decisive), (48, 56))
    assert found is not None
    at = found.middle + found.down * (rows - 23.5) + found.right * (columns - 27.5)
    np.testing.assert_allclose(at[decisive], wanted[decisive], atol=0.05)
    assert not found.is_static


def test_disparity_0_comes_before_any_plane_and_relief_before_both():
    still = one_plane(volume_of(np.full((10, 12), 0.02)), (48, 56))
    assert still is not None
    assert still.is_static
    step = np.where(np.arange(12) < 9, 0.0, 0.8) * np.ones((10, 1))
    assert one_plane(volume_of(step), (48, 56)) is None
    undecided = volume_of(step, np.zeros((10, 12), bool))
    assert one_plane(undecided, (48, 56)) is None


def test_no_plane_lies_where_no_disparity_was_evaluated():
    near = volume_of(np.full((10, 12), 0.02))
    for missing in (np.abs(LABELS) < 0.4, LABELS < 0.4):  # a gap about 0, and beyond the range
        left = replace(
            near,
            disparities=LABELS[~missing],
            evidence=near.evidence[..., ~missing] * 0.01,
            probability=near.probability[..., ~missing],
        )
        found = one_plane(left, (48, 56))
        assert found is None or abs(found.middle) > 0.3


def test_colour_is_needed_only_beyond_chance():
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1, 400)
    assert not colour_is_needed(noise, noise + rng.normal(0, 0.01, 400))
    assert not colour_is_needed(noise, 0.9 * noise)
    assert colour_is_needed(noise, 1.5 * noise)


def test_grey_psi_is_psi_of_grey_light_fields(random_psi):
    for binning, stored in ((2, 1), (1, 3)):
        psi = random_psi(binning=binning, stored=stored)
        grey = np.random.default_rng(1).random(psi.light_field_shape[:4]).astype(np.float32)
        field = np.repeat(grey[..., None], 3, axis=-1)
        only = np.zeros_like(field)
        only[..., 0] = grey
        np.testing.assert_allclose(grey_psi(psi).forward(only), psi.forward(field), rtol=1e-5)


def test_a_grey_plane_is_modelled_as_one_and_reported(bayer):
    truth, _ = plane_scene(bayer, 0.7)
    grey = np.repeat(truth.mean(axis=-1, keepdims=True), 3, axis=-1).astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 0.003, bayer.frames_shape)
    frames = (bayer.forward(grey) + noise).astype(np.float32)
    lean = reconstruct_adaptive(bayer, frames, 0.003, AdaptiveSettings(free=False))
    reported = " ".join(lean.left_out)
    assert "one plane for the whole scene" in reported
    assert "colour: one for all" in reported
    assert (lean.light_field == lean.light_field[..., :1]).all()
    rich = reconstruct_adaptive(bayer, frames, 0.003, AdaptiveSettings(free=False, parsimony=False))
    assert rich.left_out == ()
    errors = [float(np.square(r.light_field - grey).mean()) for r in (lean, rich)]
    assert errors[0] < errors[1]


def test_colour_and_relief_are_kept_where_a_scene_has_them(bayer):
    truth, _ = plane_scene(bayer, 0.7)
    found = reconstruct_adaptive(bayer, bayer.forward(truth.astype(np.float32)), 0.003, quick())
    assert not any("colour" in part for part in found.left_out)


def test_where_surfaces_fail_total_variation_is_returned_and_said_to_be(bayer):
    rng = np.random.default_rng(3)
    shape = bayer.light_field_shape
    # Views with nothing in common: no disparity explains them.
    views = rng.random((*shape[:2], 6, 7, 3)).repeat(8, axis=2).repeat(8, axis=3)
    frames = bayer.forward(views.astype(np.float32))
    found = reconstruct_adaptive(bayer, frames, 0.003, quick().model_copy(update={"free": True}))
    assert "total variation is returned" in found.advice
    assert found.status == "doubtful"
    free = found.maps["model"] == MODELS.index("free")
    assert free.mean() > 0.5
    plain = reconstruct_tv(bayer, frames, 0.003).light_field
    assert np.abs(found.light_field - plain)[:, :, free].mean() < 0.05
    surfaces = reconstruct_adaptive(bayer, frames, 0.003, quick()).light_field
    errors = [float(np.square(one - views).mean()) for one in (found.light_field, surfaces)]
    assert errors[0] < 0.95 * errors[1]
    assert 0.15 * errors[0] < np.square(found.maps["sigma"]).mean() < 2.5 * errors[0]


def test_surfaces_stay_where_nothing_speaks_against_them(bayer):
    truth, _ = plane_scene(bayer, 0.7)
    frames = bayer.forward(truth.astype(np.float32))
    found = reconstruct_adaptive(bayer, frames, 0.003, quick().model_copy(update={"free": True}))
    assert (found.maps["model"] == MODELS.index("free")).mean() < 0.2


def test_every_reading_counts_by_its_own_noise(bayer):
    truth, _ = plane_scene(bayer, 0.7)
    rng = np.random.default_rng(4)
    deviation = np.full(bayer.frames_shape, 0.003)
    deviation[:, ::3, ::2] = 0.1
    frames = bayer.forward(truth.astype(np.float32)) + rng.normal(0, deviation)
    frames = frames.astype(np.float32)
    typical = float(np.sqrt(np.mean(np.square(deviation))))
    settings = MethodSettings(adaptive=quick())
    errors = [
        float(np.square(found.light_field - truth).mean())
        for noise in (deviation, typical)
        for found in [reconstruct("adaptive", bayer, frames, noise, settings=settings)]
    ]
    assert errors[0] < 0.5 * errors[1]
    each, one = (
        reconstruct("tv", bayer, frames, noise).light_field for noise in (deviation, typical)
    )
    np.testing.assert_allclose(each, one, atol=1e-5)


def test_noise_levels_that_do_not_fit_are_refused_in_one_line(bayer):
    frames = np.zeros(bayer.frames_shape, np.float32)
    with pytest.raises(ReconstructionError, match="noise levels of shape"):
        reconstruct_adaptive(bayer, frames, np.ones((1, 4, 4)))
    wrong = np.full(bayer.frames_shape, 0.01)
    wrong[0, 0, 0] = np.nan
    with pytest.raises(ReconstructionError, match="negative or not finite"):
        reconstruct_adaptive(bayer, frames, wrong)


def test_a_plane_counts_from_the_middle_of_the_frame():
    plane = Plane(0.5, 0.1, 0.0)
    over = plane.over((6, 8), 2)
    # Pixels of 2x2 samples: rows of pixels at -1, 0, 1, samples a quarter pixel to both sides.
    np.testing.assert_allclose(
        over[:, 0], 0.5 + 0.1 * np.array([-1.25, -0.75, -0.25, 0.25, 0.75, 1.25])
    )
    assert Plane(0, 0, 0).is_static
