"""Masks that stand otherwise than in Psi are named, on a bench of no code in common."""

import re

import numpy as np
import pytest
from outside_bench import Bench, Optics
from outside_boards import bench_of, camera_of

import emmc_rig as emmc
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.frames import even_frames
from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.reconstruction.tv import TVSettings
from emmc_rig.reconstruction.verdict.orientation import ORIENTATIONS
from emmc_rig.reconstruction.verdict.run import reconstruct_judged

SIZE, NOISE = (72, 96), 0.003
CAMERA = camera_of(Optics())
QUICK = MethodSettings(tv=TVSettings(max_steps=20))


@pytest.fixture(scope="module")
def psi():
    return build_imaging_matrix(CAMERA, SIZE)


@pytest.fixture(scope="module")
def cells():
    return bench_of(CAMERA, SIZE).cells


def verdict_on(psi, cells, moved_um=(0.0, 0.0), scene="deep-occlusions", **optics):
    """Return the verdict on a frame through these cells, the mask moved by (x, y)."""
    bench = Bench(cells, SIZE, optics=Optics(**optics), seed=0)
    seen = np.take_along_axis(
        emmc.scene(scene, size=SIZE, views=CAMERA.views).light_field,
        bench.colour[None, None, :, :, None],
        axis=4,
    )[..., 0]
    frame = (bench.psi(*moved_um) * seen).sum((0, 1))
    frame = frame + NOISE * np.random.default_rng(1).standard_normal(SIZE)
    frames = even_frames(frame[None].astype(np.float32), NOISE, None)
    return reconstruct_judged("tv", psi, frames, settings=QUICK)[1]


@pytest.mark.parametrize("negative", [False, True])
@pytest.mark.parametrize("name", ORIENTATIONS)
def test_the_masks_orientation_and_a_negative_are_the_first_reason(psi, cells, name, negative):
    turns, mirrored = ORIENTATIONS[name]
    stands = np.rot90(cells[:, ::-1] if mirrored else cells, turns)
    verdict = verdict_on(psi, 1 - stands if negative else stands)
    words = ", ".join(filter(None, ["a negative" * negative, name]))
    if words:
        assert verdict.level == "do not use"
        assert verdict.reasons[0].what == f"against Psi the masks are {words}"
    else:
        assert verdict.evidence.masks_seen is None


def test_a_mask_far_off_its_place_is_named_with_the_displacement(psi, cells):
    pitch_um = CAMERA.sensor.sample_pitch_um
    verdict = verdict_on(psi, cells, (6 * pitch_um, -4 * pitch_um))
    assert verdict.reasons[0].what == "against Psi the masks are (+6, -4) pixels off in x and y"


@pytest.mark.parametrize(
    ("optics", "words"),
    [
        ({"mask_um": 1_250.0}, r"the masks are about 25% further from the sensor"),
        ({"mask_um": 600.0}, r"the masks are about (36|49)% nearer to the sensor"),
        ({"rotation_rad": 0.105}, r"the masks are turned by about \+6 degrees from x to y"),
        ({"cell_um": 21.5}, r"the masks' cells are about 7\.5% larger"),
    ],
)
def test_masks_far_from_psi_are_named_with_how_far(psi, cells, optics, words):
    verdict = verdict_on(psi, cells, **optics)
    assert verdict.level == "do not use"
    assert re.fullmatch("against Psi " + words, verdict.reasons[0].what)


def test_another_mask_is_none_of_them(psi, cells):
    rng = np.random.default_rng(5)
    other = cells.reshape(-1, 3)[rng.permutation(cells.shape[0] * cells.shape[1])]
    verdict = verdict_on(psi, other.reshape(cells.shape))
    assert verdict.evidence.masks_seen is None
    assert verdict.level == "do not use"
