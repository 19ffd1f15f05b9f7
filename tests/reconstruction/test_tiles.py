"""Blocks: they cover the light field once, and the result does not depend on who computes them."""

import dataclasses
import json

import numpy as np
import pytest

from emmc_rig.model.errors import SensingError
from emmc_rig.model.frames import even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.adaptive.settings import SIDES, AdaptiveSettings
from emmc_rig.reconstruction.dictionary import lambertian_dictionary
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.method import BlockSettings
from emmc_rig.reconstruction.methods import MethodSettings, reconstruct
from emmc_rig.reconstruction.result import Reconstruction, Status
from emmc_rig.reconstruction.sparse import SparseSettings
from emmc_rig.reconstruction.tiles import (
    CaptureSurvey,
    Grid,
    reconstruct_in_blocks,
    samples,
    summed_up,
    surveyed,
    within,
)
from emmc_rig.reconstruction.tv import TVSettings
from emmc_rig.reconstruction.verdict import run
from emmc_rig.reconstruction.verdict.blocks import JudgedBlock, combined, judged_together
from emmc_rig.reconstruction.verdict.orientation import Seen
from emmc_rig.reconstruction.verdict.rules import verdict_from
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.store.psi import StoredPsi

VIEWS = (2, 2)
SMALL = BlockSettings(whole=1, side=48, blend=4)


@pytest.mark.parametrize(
    ("size", "multiple", "halo", "side", "blend"),
    [((40, 60), 2, 3, 16, 2), ((41, 97), 2, 9, 20, 3), ((100, 36), 10, 5, 30, 4)],
)
def test_inner_parts_cover_every_sample_once_and_weights_of_parts_add_up_to_one(
    size, multiple, halo, side, blend
):
    grid = Grid(size, multiple, halo, BlockSettings(whole=1, side=side, blend=blend))
    seen, weights = np.zeros(size, dtype=int), np.zeros(size)
    assert len(grid) == len(list(grid)) > 1
    for block in grid:
        seen[block.inner] += 1
        for inner, part, outer, whole in zip(
            block.inner, block.part, block.outer, size, strict=True
        ):
            assert outer.start % multiple == 0
            assert outer.start == 0 or part.start - outer.start >= halo
            assert outer.stop == whole or outer.stop - part.stop >= halo
            assert part.start == 0 or inner.start - part.start >= blend
        for other, place, weight in grid.overlapping(block.inner):
            weights[place] += weight
            assert all(part.start >= 0 for part in within(place, other.part))
    np.testing.assert_array_equal(seen, 1)
    np.testing.assert_allclose(weights, 1, atol=1e-6)


def test_only_blocks_at_the_border_may_have_dark_edges():
    grid = Grid((90, 90), 2, 4, BlockSettings(whole=1, side=30, blend=2))
    assert grid.block(1, 1).sides == ()
    assert grid.block(0, 2).sides == ("top", "right")
    assert {side for block in grid for side in block.sides} == set(SIDES)


def test_sample_windows_lie_within_and_reach_all_corners():
    places = samples((500, 131), 6)
    assert {place[0].start for place in places} == {0, 204, 402}
    assert all(place[1].stop <= 131 and place[1].start % 6 == 0 for place in places)


def scene(random_psi, binning=1, shots=2, size=(36, 160)):
    psi = random_psi(shots, VIEWS, size, binning=binning)
    y, x = np.mgrid[: size[0], : size[1]] / 12
    picture = 0.5 + 0.3 * np.sin(x + np.sin(y))[..., None] * np.array([1, 0.5, -0.5])
    truth = np.broadcast_to(picture.astype(np.float32), psi.light_field_shape)
    noise = np.random.default_rng(0).normal(0, 0.01, psi.frames_shape)
    return psi, (psi.forward(truth) + noise).astype(np.float32), truth


def settings_of(method, **more):
    """Patches of the default's own size overlap by less: each has atoms of its own to sense."""
    sparse = SparseSettings(stride=2 if "dict" in method else 8)
    return MethodSettings(tv=TVSettings(max_steps=60), sparse=sparse, **more)


def in_blocks(method, psi, frames, blocks, usable=None, dictionary=None, on_step=None):
    settings = settings_of(method, blocks=blocks)
    usable = np.ones(frames.shape, dtype=bool) if usable is None else usable
    return reconstruct_in_blocks(
        method, psi, even_frames(frames, 0.01, usable), dictionary, settings, on_step
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "binning"),
    [
        ("tv", 1),
        ("dict-admm", 1),
        ("tv-dict", 2),
        ("adaptive-fast", 2),
        ("adaptive", 1),
    ],
)
def test_every_method_works_in_blocks_and_loses_little(random_psi, method, binning, monkeypatch):
    psi, frames, truth = scene(random_psi, binning, size=(36, 100))
    dictionary = lambertian_dictionary(VIEWS, (4, 4)) if "dict" in method else None
    # One shot takes no sparse patches in blocks: whether surfaces fail is not known beforehand.
    without = settings_of(method, adaptive=AdaptiveSettings(patches=None))
    whole = reconstruct(method, psi, even_frames(frames, 0.01), dictionary, without)
    result, verdict = in_blocks(method, psi, frames, SMALL, dictionary=dictionary)
    assert result.light_field.shape == psi.light_field_shape
    assert set(result.maps) == set(whole.maps)
    assert verdict.evidence.kept > 0
    # A small block keeps 4 % of its readings for the verdict, which costs `tv-dict` 0.2 to 3 dB.
    monkeypatch.setattr(run, "kept_readings", lambda psi, usable: np.zeros_like(usable))
    result, _ = in_blocks(method, psi, frames, SMALL, dictionary=dictionary)
    assert psnr_db(result.light_field, truth) > psnr_db(whole.light_field, truth) - 0.3


def test_a_step_of_the_result_between_blocks_is_no_larger_than_within_them(random_psi):
    psi, frames, _ = scene(random_psi)
    result, _ = in_blocks("tv", psi, frames, SMALL)
    steps = np.abs(np.diff(result.light_field, axis=3)).mean(axis=(0, 1, 2, 4))
    grid = Grid(psi.size, 2, 48, SMALL)
    seams = np.array(grid.edges[1][1:-1]) - 1
    assert steps[seams].max() < 1.5 * np.median(steps)


def test_a_light_field_of_one_block_is_that_of_the_method_itself(random_psi):
    psi, _, _ = scene(random_psi)
    settings = MethodSettings()
    grid = Grid(psi.size, 2, 48, settings.blocks)
    assert len(grid) == 1
    block = grid.block(0, 0)
    whole = (slice(0, 36), slice(0, 160))
    assert block.outer == block.part == block.inner == whole


def test_psi_is_read_from_its_file_window_by_window(random_psi, tmp_path):
    psi, frames, _ = scene(random_psi, binning=2)
    psi.save(tmp_path / "psi.h5")
    saved = StoredPsi(tmp_path / "psi.h5")
    saved.verify()
    assert (saved.size, saved.binning) == (psi.size, 2)
    part, expected = (source.window(slice(4, 20), slice(10, 30)) for source in (saved, psi))
    np.testing.assert_array_equal(part.weights, expected.weights)
    np.testing.assert_array_equal(part.colour, expected.colour)
    first, other = (in_blocks("tv", source, frames, SMALL)[0] for source in (psi, saved))
    np.testing.assert_array_equal(first.light_field, other.light_field)


def test_a_damaged_psi_is_found_out_without_holding_it(random_psi, tmp_path):
    psi, _, _ = scene(random_psi)
    psi.save(tmp_path / "psi.h5")
    content = bytearray((tmp_path / "psi.h5").read_bytes())
    content[-100] ^= 1
    (tmp_path / "psi.h5").write_bytes(content)
    with pytest.raises(SensingError, match="damaged"):
        StoredPsi(tmp_path / "psi.h5").verify()
    (tmp_path / "psi.h5").write_bytes(b"no")
    with pytest.raises(SensingError, match="of an unknown format"):
        StoredPsi(tmp_path / "psi.h5")


def test_progress_is_reported_block_by_block(random_psi):
    psi, frames, _ = scene(random_psi)
    reported = []
    in_blocks(
        "tv", psi, frames, SMALL, on_step=lambda step: reported.append((step.step, step.total))
    )
    assert reported == [(1, 4), (2, 4), (3, 4), (4, 4)]


@pytest.mark.slow
def test_a_block_without_usable_pixels_is_dark_and_the_others_are_judged(random_psi):
    psi, frames, _ = scene(random_psi)
    usable = np.ones(psi.frames_shape, dtype=bool)
    usable[:, :, :100] = False
    blocks = BlockSettings(whole=1, side=16, blend=2)
    result, verdict = in_blocks("tv", psi, frames, blocks, usable)
    assert not result.light_field[:, :, :, :38].any()
    assert result.light_field[:, :, :, 120:].any()
    assert verdict.evidence.kept > 0
    with pytest.raises(ReconstructionError, match="no usable pixel"):
        in_blocks("tv", psi, frames, blocks, np.zeros(frames.shape, bool))


def test_shots_that_do_not_fit_are_left_out_and_evened_for_all_blocks_alike(random_psi):
    psi, frames, _ = scene(random_psi, shots=4)
    frames[1] = 0.0
    frames[2] *= 1.2
    given = even_frames(frames, 0.01)
    survey = surveyed("tv", psi, given)
    assert survey.left_out == (1,)
    assert survey.gains[2] / survey.gains[0] == pytest.approx(1.2, rel=0.05)
    evened = survey.applied(given)
    assert not evened.usable[1].any()
    assert evened.readings[2].mean() / evened.readings[0].mean() == pytest.approx(
        frames[2].mean() / frames[0].mean() / 1.2, rel=0.05
    )


@pytest.mark.slow
def test_the_halo_follows_from_the_largest_disparity(random_psi):
    psi, frames, _ = scene(random_psi)
    assert surveyed("tv", psi, even_frames(frames, 0.01)).halo == 48
    for binning in (1, 2):
        psi, frames, _ = scene(random_psi, binning)
        survey = surveyed("adaptive-fast", psi, even_frames(frames, 0.01))
        assert survey.halo == 16 * binning + int(np.ceil(survey.largest_px))


@pytest.fixture(scope="module")
def blocks(random_psi):
    psi, frames, _ = scene(random_psi)
    _, verdict = reconstruct_judged("tv", psi, even_frames(frames, 0.01))
    wrong, _, _ = scene(random_psi, shots=2)
    _, bad = reconstruct_judged("tv", wrong, even_frames(frames[:, ::-1, ::-1].copy(), 0.01))
    assert (verdict.level, bad.level) == ("cannot tell", "do not use")
    return verdict, bad


def test_the_verdict_on_equal_blocks_is_that_of_one(blocks):
    verdict, _ = blocks
    together = judged_together([JudgedBlock(verdict, 0, at, 100) for at in (0, 80)])
    assert together.level == "cannot tell"
    first, two = verdict.evidence, together.evidence
    assert two.kept == 2 * first.kept
    assert two.explained == pytest.approx(first.explained)
    assert two.strengths == pytest.approx(first.strengths)
    assert two.strength_errors == pytest.approx(np.array(first.strength_errors) / 2**0.5)
    json.dumps(together.as_dict(), allow_nan=False)


def test_masks_that_most_blocks_show_turned_are_named_for_the_whole(blocks):
    good, _ = blocks
    seen = Seen("turned by 180 degrees", False, (0, 0), 0.9)
    turned = verdict_from(dataclasses.replace(good.evidence, masks_seen=tuple(seen)))
    few, most = (
        judged_together([JudgedBlock(each, 0, 0, 100) for each in found])
        for found in ([good, good, turned], [good, turned, turned])
    )
    assert few.evidence.masks_seen is None
    assert "turned by 180 degrees" in most.reasons[0].what
    assert most.level == "do not use"


def test_one_bad_block_of_many_raises_doubt_and_is_named(blocks):
    good, bad = blocks
    found = [JudgedBlock(good, 0, 100 * at, 100) for at in range(15)]
    assert judged_together(found).level == "cannot tell"
    together = judged_together([*found, JudgedBlock(bad, 7, 1500, 100)])
    assert together.level == "doubt"
    assert "1 of 16 blocks" in together.words
    assert "row 7, column 1500" in together.words


def test_places_are_those_of_the_whole(blocks):
    verdict, _ = blocks
    evidence = combined([JudgedBlock(verdict, 0, 0, 1), JudgedBlock(verdict, 50, 60, 1)])
    hole = verdict.evidence.hole_at
    assert evidence.hole_at in (hole, (hole[0] + 50, hole[1] + 60))


@pytest.mark.parametrize(
    ("advice", "expected"),
    [(("", "raise it: 3 %", "raise it: 4 %"), "2 of 3 blocks, the first: raise it: 3 %"), ((), "")],
)
def test_the_advice_of_blocks_is_the_first_s_and_how_many_have_any(advice, expected):
    empty = np.empty((0, 0, 0, 0, 3), np.float32)
    results = [Reconstruction("tv", empty, Status.STEP_LIMIT, a, 1, (), 0, {}) for a in advice]
    survey = CaptureSurvey.of_one_block(MethodSettings(), 1)
    assert summed_up("tv", results, survey, 0.0).advice == expected
