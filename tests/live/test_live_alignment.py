"""The mask's place and the focus from live frames, against a ray caster that knows the truth."""

import cv2
import numpy as np
import pytest
from mask_frames import BLACK, CAMERAS, SIZE, WHITE, bench_frame, frame_of

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.repeats import Repeats, repeats_of
from emmc_rig.captures import focus
from emmc_rig.captures.focus import REMEMBERED_S, FocusMeter, sharpness
from emmc_rig.live.alignment import MaskGauge
from emmc_rig.model.camera import Camera

KINDS = (
    "moving-colour-mask", "rgbw-bayer-1shot", "rgbw-mono", "scenario-i-rgb", "sensor-side-binary",
)  # fmt: skip
"""Cameras whose masks differ in what the shadow looks like: coloured or not, through filters or
without, near the sensor or far. The other shipped cameras have one of these masks' kinds."""
WITHOUT_SHADOW = sorted(
    name
    for name, camera in CAMERAS.items()
    if [mask.distance_mm < camera.lens.distance_mm for mask in camera.masks.values()] != [True]
)


def with_pattern(**pattern):
    """Return the camera rgbw-bayer-1shot with another pattern in its mask."""
    described = CAMERAS["rgbw-bayer-1shot"].model_dump(mode="json")
    (mask,) = described["masks"].values()
    mask["pattern"] = pattern
    return Camera.model_validate(described)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_mask_of_every_kind_is_measured_to_a_tenth_of_a_degree_and_per_cent(name):
    camera = CAMERAS[name]
    truth = {"offset_um": (11.0, -7.0), "rotation_deg": 0.7, "stretch": 0.9965}
    frame = bench_frame(camera, **truth)
    place = MaskGauge(camera, frame.mosaic.shape).measure(frame)
    # The bench turns clockwise, seen in the picture.
    turned, stretched = place.rotation_deg + 0.7, place.scale - 0.9965
    assert abs(turned) < min(0.1, 4 * place.rotation_deviation_deg)
    assert abs(stretched) < min(1e-3, 4 * place.scale_deviation)
    assert place.offset_um is not None
    assert np.abs(np.subtract(place.offset_um, (11.0, -7.0))).max() < 1.5
    assert not place.ambiguity


RANDOM = np.random.default_rng(3).integers(0, 2, (48, 40)).astype(float)
STRIPES = np.tile([0.0, 1, 1, 0, 1, 0, 0, 0], (50, 6))
CELL_UM = 36.0


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (RANDOM, Repeats()),
        (np.tile(RANDOM[:8, :8], (8, 6)), Repeats(((8 * CELL_UM, 0), (0, 8 * CELL_UM)))),
        (np.tile(RANDOM[:, :6], (1, 8)), Repeats(((6 * CELL_UM, 0),))),
        (np.tile(RANDOM[:12, :6], (5, 8)), Repeats(((6 * CELL_UM, 0), (0, 12 * CELL_UM)))),
        (np.indices((50, 50)).sum(axis=0) % 2, Repeats(((-CELL_UM, CELL_UM), (CELL_UM, CELL_UM)))),
        (STRIPES, Repeats(uniform=True)),
        (STRIPES.T, Repeats(uniform=True)),
        (np.ones((50, 50)), Repeats(uniform=True)),
    ],
)
def test_how_a_mask_repeats_follows_from_its_cells(cells, expected):
    found = repeats_of(np.repeat(cells[..., None], 3, axis=-1), CELL_UM, 600.0)
    assert found.uniform == expected.uniform
    np.testing.assert_allclose(sorted(found.steps_um), sorted(expected.steps_um), atol=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("offset_um", [(60.0, -110.0), (170.0, 20.0)])
def test_a_mask_that_repeats_is_placed_but_for_its_repeats(offset_um):
    camera = with_pattern(kind="tile", cells=RANDOM[:8, :8].tolist())
    place = MaskGauge(camera, SIZE).measure(bench_frame(camera, offset_um=offset_um))
    period_um = 8 * CELL_UM
    assert place.offset_um is not None
    off_um = np.subtract(place.offset_um, offset_um)
    assert np.abs(off_um - period_um * np.round(off_um / period_um)).max() < 1.5
    assert np.abs(place.offset_um).max() < period_um / 2 + 1.5
    assert "repeats every" in place.ambiguity


@pytest.mark.slow
def test_where_stripes_stand_along_themselves_is_not_stated():
    camera = with_pattern(kind="tile", cells=STRIPES[:1, :8].tolist())
    place = MaskGauge(camera, SIZE).measure(bench_frame(camera, offset_um=(11.0, -7.0)))
    assert place.offset_um is None
    assert "along one direction" in place.ambiguity


@pytest.mark.parametrize("name", WITHOUT_SHADOW)
def test_cameras_without_one_mask_that_throws_a_shadow_say_so(name):
    with pytest.raises(CalibrationError, match=r"lie at the lens|(0|2) masks"):
        MaskGauge(CAMERAS[name], SIZE)


@pytest.mark.slow
def test_a_mask_turned_by_five_degrees_is_measured():
    camera = CAMERAS["rgbw-mono"]
    frame = bench_frame(camera, rotation_deg=-5.0)
    place = MaskGauge(camera, frame.mosaic.shape).measure(frame)
    assert place.rotation_deg == pytest.approx(5.0, abs=0.1)


@pytest.mark.slow
def test_a_mask_that_moved_on_is_followed_and_one_that_went_is_not_shown():
    camera = CAMERAS["rgbw-bayer-1shot"]
    frame = bench_frame(camera, rotation_deg=0.1)
    gauge = MaskGauge(camera, frame.mosaic.shape)
    assert gauge.measure(frame).rotation_deg == pytest.approx(-0.1, abs=0.05)
    later = gauge.measure(bench_frame(camera, rotation_deg=0.2))
    assert later.rotation_deg == pytest.approx(-0.2, abs=0.05)
    noise = np.random.default_rng(0).normal(2000, 200, SIZE)
    with pytest.raises(CalibrationError, match="not seen"):
        gauge.measure(frame_of(noise))


@pytest.mark.slow
def test_nothing_is_said_of_the_mask_in_a_dark_picture_or_through_other_filters():
    camera = CAMERAS["rgbw-bayer-1shot"]
    gauge = MaskGauge(camera, SIZE)
    with pytest.raises(CalibrationError, match="dark"):
        gauge.measure(bench_frame(camera, lamp="off"))
    with pytest.raises(CalibrationError, match="bggr"):
        gauge.measure(frame_of(np.full(SIZE, 2000), "bggr"))
    with pytest.raises(CalibrationError, match="72x96"):
        gauge.measure(frame_of(np.full((8, 8), 2000)))


def noisy(blur, seed, level=1500.0, sigma=40.0, shape=(120, 160)):
    """A random picture, blurred by so much, with noise of its own."""
    scene = np.random.default_rng(7).random(shape)
    sharp = cv2.GaussianBlur(scene, (0, 0), blur) if blur else scene
    noise = np.random.default_rng(seed).normal(0, sigma, shape)
    return frame_of(np.clip(BLACK + level * sharp + noise, 0, WHITE), "mono")


def test_sharpness_is_that_of_the_scene_without_its_noise():
    clean, quiet = (
        sharpness(noisy(1.0, 0, sigma=sigma), noisy(1.0, 1, sigma=sigma)) for sigma in (0.0, 40.0)
    )
    assert clean is not None
    assert quiet is not None
    assert abs(quiet.value - clean.value) < 4 * quiet.deviation
    assert quiet.deviation < 0.2 * clean.value


def test_dark_noise_has_no_sharpness_and_never_becomes_the_best():
    rng = np.random.default_rng(0)
    dark = [frame_of(BLACK + rng.normal(0, 5, (120, 160)).round(), "mono") for _ in range(4)]
    assert sharpness(dark[0], dark[1]) is None
    meter = FocusMeter()
    assert [meter.add(frame, number) for number, frame in enumerate(dark)] == [None] * 4
    assert meter.add(noisy(1.0, 0), 4.0) is None
    best = meter.add(noisy(1.0, 1), 5.0)
    assert best is not None
    assert best["share"] == 1.0


def test_a_blurred_picture_is_less_sharp_than_the_best_until_that_is_forgotten():
    meter = FocusMeter()
    for number in range(2):
        meter.add(noisy(1.0, number), number)
    meter.add(noisy(2.0, 2), 2.0)
    soft = meter.add(noisy(2.0, 3), 3.0)
    assert soft is not None
    assert soft["share"] + 3 * soft["deviation"] < 0.5
    later = meter.add(noisy(2.0, 4), REMEMBERED_S + 2.5)
    assert later is not None
    assert later["share"] > 0.8
    meter.forget()
    assert meter.add(noisy(2.0, 5), REMEMBERED_S + 3) is None


def test_what_was_seen_may_be_forgotten_while_the_best_of_it_is_looked_for(monkeypatch):
    meter = FocusMeter()

    class Forgetful:
        """A sharpness that, when it is looked at, makes the meter forget, as another thread may."""

        deviation = 0.1

        @property
        def value(self):
            meter.forget()
            return 1.0

    monkeypatch.setattr(focus, "sharpness", lambda *_: Forgetful())
    frame = noisy(1.0, 0)
    meter._before = frame
    reported = meter.add(frame, 1.0)
    assert reported is not None
    assert reported["share"] == 1.0
