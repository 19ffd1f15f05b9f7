"""Raw values to readings: against the values that made them, given and estimated."""

import os
from pathlib import Path

import numpy as np
import pytest

import emmc_rig as emmc
from emmc_rig.model.camera import shipped_cameras
from emmc_rig.simulators.scenes import STILL_SCENES

RAW = Path(os.environ.get("EMMC_PEER_FILES", "")) / "raw"

BLACK, GAIN, READ, WHITE = 64, 0.8, 2.5, 4095
SIZE = (128, 192)


@pytest.fixture(scope="module")
def exposed():
    """(frames in DN of two shots, the DN above black that they would have without noise)."""
    rng = np.random.default_rng(3)
    y, x = np.indices(SIZE) / max(SIZE)
    smooth = np.stack([2 + 4000 * x**2, 50 + 3000 * y * x])  # electrons
    return sensor(smooth, rng), GAIN * smooth


def sensor(electrons, rng):
    """Return what a sensor of the figures above reads."""
    noise = rng.normal(0, READ, electrons.shape)
    return np.floor(BLACK + GAIN * (rng.poisson(electrons) + noise) + 0.5)


def spread_of(frames, truth):
    """Return the deviation of (reading - truth) / stated deviation, of what is not nearly dark."""
    counted = frames.usable & (truth > 0.005)
    return float(((frames.readings - truth)[counted] / frames.deviation[counted]).std())


def test_readings_are_shares_of_the_white_level_and_stray_as_their_deviation_says(exposed):
    dn, signal = exposed
    frames = emmc.frames(
        dn.astype(np.uint16), dark=BLACK, white_level=WHITE, gain=GAIN, read_noise=READ
    )
    assert frames.estimates == ()
    truth = signal / (WHITE - BLACK)
    assert (frames.readings - truth).mean() == pytest.approx(0, abs=1e-4)
    assert spread_of(frames, truth) == pytest.approx(1, abs=0.03)


def test_noise_is_estimated_where_frames_are_smooth_and_said_to_be(exposed):
    dn, signal = exposed
    frames = emmc.frames(dn, dark=BLACK, white_level=WHITE)
    assert [words.split()[0] for words in frames.estimates] == ["noise"]
    assert "estimated: noise (at most)" in repr(frames)
    assert spread_of(frames, signal / (WHITE - BLACK)) == pytest.approx(1, abs=0.06)
    for known in ({"gain": GAIN}, {"read_noise": READ}):
        half = emmc.frames(dn, dark=BLACK, white_level=WHITE, **known)
        assert spread_of(half, signal / (WHITE - BLACK)) == pytest.approx(1, abs=0.1)
    assert half.deviation.min() * (WHITE - BLACK) == pytest.approx(GAIN * READ, rel=0.1)


def test_what_a_mosaic_s_colours_differ_by_is_no_noise(exposed):
    _, signal = exposed
    colours = np.tile([[0.3, 1.0], [1.0, 0.6]], (SIZE[0] // 2, SIZE[1] // 2))
    dn = sensor(signal / GAIN * colours, np.random.default_rng(4))
    frames = emmc.frames(dn, dark=BLACK, white_level=WHITE)
    assert spread_of(frames, signal * colours / (WHITE - BLACK)) == pytest.approx(1, abs=0.1)


def test_noise_is_not_stated_too_small_behind_a_mask(exposed):
    _, signal = exposed
    code = np.random.default_rng(5).random(SIZE)
    dn = sensor(signal / GAIN * code, np.random.default_rng(6))
    frames = emmc.frames(dn, dark=BLACK, white_level=WHITE)
    assert spread_of(frames, signal * code / (WHITE - BLACK)) < 1


def test_darks_give_the_level_of_every_pixel_and_the_noise_in_the_dark(exposed):
    _, signal = exposed
    rng = np.random.default_rng(7)
    fixed = rng.uniform(0, 40, SIZE)
    darks = np.stack([sensor(np.zeros(SIZE), rng) + np.floor(fixed) for _ in range(16)])
    dn = sensor(signal / GAIN, rng) + np.floor(fixed)
    frames = emmc.frames(dn, dark=darks, white_level=WHITE, gain=GAIN, read_noise=READ)
    span = WHITE - darks.mean()
    assert spread_of(frames, signal / span) == pytest.approx(1, abs=0.03)
    assert frames.deviation.min() * span == pytest.approx(
        np.sqrt(((GAIN * READ) ** 2 + 1 / 12) * (1 + 1 / 16)), rel=0.02
    )


def test_a_white_board_reads_one_whatever_the_lens_does(exposed):
    _, signal = exposed
    rng = np.random.default_rng(8)
    falloff = np.linspace(0.4, 1, SIZE[1]) * np.ones(SIZE)
    board = np.stack([sensor(3500 * falloff, rng) for _ in range(4)])
    dn = sensor(signal / GAIN * falloff, rng)
    given = {"dark": BLACK, "white_level": WHITE, "gain": GAIN, "read_noise": READ}
    frames = emmc.frames(dn, white=board, **given)
    truth = signal / (GAIN * 3500)
    assert spread_of(frames, truth) == pytest.approx(1, abs=0.03)
    level = emmc.frames(dn, white=BLACK + GAIN * 3500, **given)
    np.testing.assert_allclose(level.readings, (dn - BLACK) / (GAIN * 3500), atol=1e-6)


def test_saturated_pixels_are_found_where_their_level_is_not_given(exposed):
    dn, _ = exposed
    frames = emmc.frames(np.minimum(dn, 2000), dark=BLACK)
    np.testing.assert_array_equal(frames.usable, dn < 2000)
    assert frames.estimates[0] == "white level 2000 DN (where values pile up)"
    open_ended = emmc.frames(dn, dark=BLACK)
    assert open_ended.usable.all()
    assert open_ended.estimates[0].startswith("white level 4095 DN (the range of the values")


def test_a_black_level_that_nobody_gave_is_in_the_deviation(exposed):
    dn, signal = exposed
    given = {"white_level": WHITE, "gain": GAIN, "read_noise": READ}
    frames = emmc.frames(dn, **given)
    assert frames.estimates[0].startswith("black level 6")
    off = frames.readings.mean() - (signal / (WHITE - BLACK)).mean()
    assert abs(off) < frames.deviation.min()
    assert frames.deviation.min() > 3 * emmc.frames(dn, dark=BLACK, **given).deviation.min()


def test_codes_of_a_picture_become_light():
    light = np.linspace(0.01, 1, 128**2).reshape(128, 128)
    codes = np.round(255 * light ** (1 / 2.2)).astype(np.uint8)
    frames = emmc.frames(codes, white_level=255.5, gamma=2.2)
    np.testing.assert_allclose(frames.readings[0], light, atol=0.012)


def test_shots_of_other_exposures_read_alike_and_as_surely_as_their_light_says(exposed):
    _, signal = exposed
    rng = np.random.default_rng(9)
    times_s = np.array([0.01, 0.04])
    electrons = np.stack([signal[0] / GAIN / 8 * t / 0.01 for t in times_s])
    given = {"dark": BLACK, "white_level": WHITE, "gain": GAIN, "read_noise": READ}
    frames = emmc.frames(sensor(electrons, rng), exposure_s=times_s, **given)
    truth = np.stack([GAIN * electrons[0] / (WHITE - BLACK)] * 2)
    assert (frames.readings - truth).mean() == pytest.approx(0, abs=1e-4)
    for shot in range(2):
        bright = frames.usable[shot] & (truth[shot] > 0.002)
        scaled = (frames.readings[shot] - truth[shot])[bright] / frames.deviation[shot][bright]
        assert scaled.std() == pytest.approx(1, abs=0.03)
    assert frames.deviation[1].mean() < 0.6 * frames.deviation[0].mean()


def test_what_was_estimated_stands_in_a_result_s_metrics_and_on_its_page(tmp_path):
    light = np.linspace(0.1, 0.9, 96 * 96).reshape(1, 96, 96) * np.ones((2, 1, 1))
    dn = sensor(4000 * light, np.random.default_rng(10))
    psi = emmc.Psi.from_weights(np.ones((2, 1, 2, 96, 96)) / 2)
    frames = emmc.frames(dn, white_level=WHITE)
    result = emmc.reconstruct(psi, frames, "tv")
    assert result.metrics()["estimated_from_frames"] == list(frames.estimates)
    page = result.viewer().split("<script")[0]
    assert "Not given, so estimated from the frames: black level" in page
    given = emmc.frames(dn, dark=BLACK, white_level=WHITE, gain=GAIN, read_noise=READ)
    told = emmc.reconstruct(psi, given, "tv")
    assert "estimated_from_frames" not in told.metrics()
    assert "Estimated from" not in told.viewer().split("<script")[0]


@pytest.fixture(scope="module")
def smooth():
    """12-bit raw values of a smooth scene, one shot, of shot noise, black level 64."""
    y, x = np.indices((256, 384)) / 384
    electrons = 20000 * (0.02 + 0.95 * (0.5 + 0.5 * np.sin(9 * x + 3 * y * y) * np.cos(7 * y)))
    rng = np.random.default_rng(11)
    return np.round(64 + 0.2 * (rng.poisson(electrons) + rng.normal(0, READ, electrons.shape)))


def gammas(frames):
    """Return what is said of the gamma."""
    return [words for words in frames.estimates if words.startswith("gamma")]


CODED = {
    "16 bits of a 12-bit sensor": (lambda dn: np.round(65535 * (dn / 4095) ** (1 / 2.2)), "closer"),
    "floats of a 12-bit sensor": (lambda dn: (dn / 4095) ** (1 / 2.2), "closer towards white"),
    "floats without levels": (
        lambda dn: np.random.default_rng(0).normal(
            (np.maximum(dn - 64, 0) / 4095) ** (1 / 2.2), 1e-5
        ),
        "noise does not grow with light",
    ),
    "8 bits": (lambda dn: np.uint8(np.round(255 * (dn / 4095) ** (1 / 2.2))), "codes of 8 bits"),
    "8 bits in 16": (lambda dn: 257 * np.round(255 * dn / 4095), "codes of 8 bits"),
    "8 bits as floats": (lambda dn: np.round(255 * dn / 4095) / 255, "codes of 8 bits"),
}


@pytest.mark.parametrize("kind", CODED)
def test_values_that_look_like_a_picture_s_codes_are_said_to(kind, smooth):
    coded, words = CODED[kind]
    said = gammas(emmc.frames(coded(smooth)))
    assert len(said) == 1
    assert words in said[0]
    assert "give gamma=2.2" in said[0]
    for given in (1, 2.2):
        assert gammas(emmc.frames(coded(smooth), gamma=given)) == []


@pytest.mark.parametrize(
    "linear",
    [
        lambda dn: dn,
        lambda dn: 16 * dn,
        lambda dn: np.round(dn * 65535 / 4095),
        lambda dn: (dn - 64) / 4031,
        lambda dn: np.random.default_rng(1).normal(dn, 20),
        lambda dn: dn + np.random.default_rng(2).normal(0, 40, dn.shape[1]),
    ],
)
def test_linear_values_are_not_taken_for_codes(linear, smooth):
    assert gammas(emmc.frames(linear(smooth))) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", STILL_SCENES)
def test_no_camera_s_frames_of_a_built_in_scene_look_like_codes(name):
    for camera in shipped_cameras().values():
        scene = emmc.scene(name, size=(96, 128), views=camera.views)
        taken = camera.expose(scene, seed=1)
        for values in (taken.frames_dn, taken.readings, taken.noise_free):
            dark = 0 if values.min() < 0 else None  # a black level was subtracted
            found = emmc.frames(values, dark, gain=1, read_noise=1)
            assert gammas(found) == [], camera.title


@pytest.mark.slow
@pytest.mark.skipif(not RAW.is_dir(), reason="EMMC_PEER_FILES names no folder with raw/")
def test_no_maker_s_raw_values_look_like_codes():
    rawpy = pytest.importorskip("rawpy")
    looked = 0  # most of these files are cut off behind their tags
    for path in sorted(RAW.iterdir()):
        try:
            with rawpy.imread(str(path)) as opened:
                values = np.array(opened.raw_image_visible)
        except rawpy.LibRawError:
            continue
        if values.ndim == 2 and values.any():
            looked += 1
            assert gammas(emmc.frames(values, gain=1, read_noise=1)) == [], path.name
    assert looked


def test_what_is_masked_is_not_usable_and_in_no_estimate(exposed):
    dn, _ = exposed
    dead = np.zeros(dn.shape, dtype=bool)
    dead[:, 40:44, 50:60] = True
    known = emmc.frames(dn, dark=BLACK, white_level=WHITE)
    for value in (np.nan, 0, 60_000):
        masked = np.ma.masked_array(np.where(dead, value, dn), dead)
        frames = emmc.frames(masked, dark=BLACK, white_level=WHITE)
        np.testing.assert_array_equal(frames.usable, ~dead & known.usable)
        np.testing.assert_array_equal(frames.readings, np.where(dead, 0, known.readings))
        assert frames.noise_sigma == pytest.approx(known.noise_sigma, rel=0.05)


FLAT = np.full((1, 64, 64), 900.0)
MISTAKES = {
    "text": (lambda: emmc.frames("shot.tif"), "dn: got 'shot.tif'; it takes raw values"),
    "a colour picture": (lambda: emmc.frames(np.ones((1, 8, 8, 3))), "dn: got ndarray of shape"),
    "a hole": (
        lambda: emmc.frames(np.where(np.eye(64, dtype=bool), np.nan, FLAT)),
        r"dn: 64 values are not finite, the first at \(0, 0, 0\)",
    ),
    "above white": (lambda: emmc.frames(FLAT, white_level=255), "up to 900 DN, above the white"),
    "all white": (lambda: emmc.frames(FLAT, white_level=900), "every pixel reads the white level"),
    "small": (
        lambda: emmc.frames(FLAT[:, :20], dark=0, white_level=1023),
        "too few pixels that are not saturated to estimate their noise",
    ),
    "shots last, as MATLAB keeps them": (
        lambda: emmc.frames(np.moveaxis(np.repeat(FLAT, 2, axis=0), 0, -1)),
        r"dn: shape \(64, 64, 2\) looks like \(y, x, shot\), where shots come first: np.moveaxis",
    ),
    "a picture": (
        lambda: emmc.frames(np.full((40, 64, 3), 9, np.uint8), white_level=255),
        r"dn: shape \(40, 64, 3\) looks like a picture \(y, x, colour\)",
    ),
    "too few columns": (
        lambda: emmc.frames(FLAT[:, :, :4], dark=0, white_level=1023),
        "too few pixels that are not saturated to estimate their noise",
    ),
    "below 0": (lambda: emmc.frames(FLAT - 1000), "values down to -100 DN.*give dark=0"),
    "complex numbers": (lambda: emmc.frames(FLAT + 1j), "complex128; it takes raw values"),
    "objects": (lambda: emmc.frames(FLAT.astype(object)), "object; it takes raw values"),
    "all masked": (lambda: emmc.frames(np.ma.masked_all((1, 64, 64))), "all values are masked"),
    "a masked dark": (
        lambda: emmc.frames(FLAT, dark=np.ma.masked_equal(FLAT, 900), white_level=4095),
        "dark: 4096 of its values are masked, so not valid",
    ),
    "swapped": (lambda: emmc.frames(FLAT, dark=1000, white_level=4095), "frames and darks swapped"),
    "a dark of another size": (
        lambda: emmc.frames(FLAT, dark=np.ones((32, 64)), white_level=4095),
        r"dark: frames of \(32, 64\) pixels, dn has \(64, 64\)",
    ),
    "no lamp": (
        lambda: emmc.frames(
            FLAT, dark=0, white=np.zeros((64, 64)), white_level=999, gain=1, read_noise=2
        ),
        "is no brighter than the dark",
    ),
    "a white board that is saturated": (
        lambda: emmc.frames(
            FLAT, dark=0, white=np.full((64, 64), 1023), white_level=1023, gain=1, read_noise=2
        ),
        "white: most of it reads the white level, 1023 DN",
    ),
    "an exposure too few": (
        lambda: emmc.frames(FLAT, exposure_s=[0.1, 0.2]),
        "exposure_s: 2 exposures of 1 shots",
    ),
    "no exposure": (lambda: emmc.frames(FLAT, exposure_s=[np.nan]), "seconds above 0"),
    "gain of nothing": (lambda: emmc.frames(FLAT, gain=0), "gain: got 0; it takes a number above"),
    "noise below nothing": (lambda: emmc.frames(FLAT, read_noise=-1), "read_noise: got -1"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_are_no_raw_frames_is_refused_in_one_line(mistake):
    call, words = MISTAKES[mistake]
    with pytest.raises(emmc.ERRORS, match=words) as refused:
        call()
    assert "\n" not in str(refused.value)
