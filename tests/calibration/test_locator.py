"""The locator of a mask's shadow, against the ray caster and against shifts by Fourier."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from mask_frames import BLACK, CAMERAS, SIZE, bench_frame
from scipy.ndimage import fourier_shift

from emmc_rig.calibration.boards import channels_of
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.locator import (
    LEAST_CORRELATION,
    frame_board,
    locate,
    refine,
    starting_placement,
)
from emmc_rig.calibration.openings import views_open
from emmc_rig.calibration.robust import correlation, deviation_of, tukey_loss, tukey_weights
from emmc_rig.calibration.shadow import shadow_mask
from emmc_rig.model.camera import psi_layout

CAMERA = "rgbw-bayer-1shot"
PLACES_UM = ((11.0, -7.0), (-163.0, 58.0), (37.5, 240.0))
CELL_UM = 36.0


@cache
def mask_of(name):
    return shadow_mask(CAMERAS[name], SIZE)


def board_of(name, signal):
    """A frame above black, (y, x), as the locator takes it."""
    opening = views_open(CAMERAS[name].views, None), (0.0, 0.0), 0
    channels = channels_of(psi_layout(CAMERAS[name], SIZE))
    white_dn = CAMERAS[name].sensor.noise.white_level_dn - BLACK
    return frame_board(signal.astype(np.float32), np.zeros(SIZE), white_dn, channels, opening)


def start_of(name):
    return starting_placement(CAMERAS[name], mask_of(name))


@cache
def signal_at(name, place_um, blur_um=0.0):
    """What the ray caster's sensor sees above black, (y, x)."""
    frame = bench_frame(
        CAMERAS[name], offset_um=place_um, rotation_deg=0.4, stretch=1.001, edge_blur_um=blur_um
    )
    return frame.mosaic.astype(np.float64) - BLACK


def uneven(signal, slope):
    """The same under a lamp that is brighter at one side, in a lens that darkens the corners."""
    y, x = (np.linspace(-1, 1, count) for count in signal.shape)
    return signal * (1 - slope * x / 2) * (1 - slope * (x**2 + y[:, None] ** 2) / 5)


@pytest.mark.slow
@pytest.mark.parametrize("blur_um", [0.0, 12.0])
@pytest.mark.parametrize("slope", [0.0, 0.8])
@pytest.mark.parametrize("noise", [0.0, 0.1, 0.4])
def test_a_shadow_lies_within_the_deviation_stated_of_where_the_bench_has_it(noise, slope, blur_um):
    rng = np.random.default_rng(0)
    scaled = []
    for place_um in PLACES_UM:
        signal = uneven(signal_at(CAMERA, place_um, blur_um), slope)
        signal = signal + noise * signal.mean() * rng.standard_normal(signal.shape)
        found = locate(board_of(CAMERA, signal), mask_of(CAMERA), start_of(CAMERA))
        off = np.subtract(found.offset_um, place_um)
        scaled += [
            off[0] / found.deviations["offset_x_um"],
            off[1] / found.deviations["offset_y_um"],
        ]
        turned = np.degrees(found.placement.rotation_rad) - 0.4
        scaled.append(turned / np.degrees(found.deviations["rotation_rad"]))
        assert found.offset_deviation_um < 0.04 * CELL_UM
        assert np.hypot(*off) < 0.05 * CELL_UM
    assert np.sqrt(np.mean(np.square(scaled))) < 2


@pytest.mark.slow
@pytest.mark.parametrize("shift_px", [(0.25, -0.5), (1.4, 3.3), (-6.75, 2.1)])
def test_a_frame_shifted_by_fourier_interpolation_is_found_shifted_by_as_much(shift_px):
    name = "rgbw-mono"
    mask, signal = mask_of(name), signal_at(name, (0.0, 0.0))
    moved = np.fft.ifft2(fourier_shift(np.fft.fft2(signal), shift_px)).real
    # Rows and columns that wrap around show another part of the mask.
    rim = np.ones(signal.shape, dtype=bool)
    rim[8:-8, 8:-8] = False
    here, there = (
        locate(board_of(name, frame).without(rim), mask, start_of(name))
        for frame in (signal, moved)
    )
    # The picture moves by 1 / (1 - d / D) of what the mask does, which is turned by 0.4 degrees.
    pixel_um = mask.pitch_um * (1 - mask.distance_um / mask.lens_um)
    expected_um = np.array(shift_px[::-1]) * pixel_um
    off_um = np.subtract(there.offset_um, here.offset_um) - expected_um
    assert np.abs(off_um).max() < 0.02 * pixel_um


@pytest.mark.slow
def test_a_search_for_the_offset_alone_keeps_the_rest_and_reaches_as_far_as_asked():
    signal, mask = signal_at(CAMERA, PLACES_UM[2]), mask_of(CAMERA)
    board = board_of(CAMERA, signal)
    start = replace(start_of(CAMERA), rotation_rad=float(np.deg2rad(0.4)), scale=1.001)
    found = locate(board, mask, start, 300.0)
    assert found.placement.rotation_rad == start.rotation_rad
    assert set(found.deviations) == {"offset_x_um", "offset_y_um"}
    assert np.abs(np.subtract(found.offset_um, PLACES_UM[2])).max() < 0.05 * CELL_UM


def test_a_saturated_frame_is_refused():
    signal = np.full(SIZE, 1e5)
    with pytest.raises(CalibrationError, match="hardly any pixel is lit"):
        locate(board_of(CAMERA, signal), mask_of(CAMERA), start_of(CAMERA))


def test_noise_without_a_shadow_is_refused_and_so_is_a_frame_with_hardly_a_pixel():
    signal = 1000 + 100 * np.random.default_rng(1).standard_normal(SIZE)
    with pytest.raises(CalibrationError, match="correlation is 0"):
        locate(board_of(CAMERA, signal), mask_of(CAMERA), start_of(CAMERA))
    with pytest.raises(CalibrationError, match=f"at least {LEAST_CORRELATION} is needed"):
        refine(board_of(CAMERA, signal), mask_of(CAMERA), start_of(CAMERA))
    most = np.ones(SIZE, dtype=bool)
    most[:2] = False
    with pytest.raises(CalibrationError, match="hardly any pixel"):
        refine(board_of(CAMERA, signal).without(most), mask_of(CAMERA), start_of(CAMERA))


def test_a_tenth_of_outliers_hardly_changes_a_deviation_and_levels_of_colours_no_correlation():
    rng = np.random.default_rng(0)
    clean = rng.standard_normal(20_000)
    dirty = np.where(rng.random(20_000) < 0.1, 50.0, clean)
    assert deviation_of(clean) == pytest.approx(1, abs=0.02)
    assert deviation_of(dirty) == pytest.approx(1, abs=0.15)
    assert (tukey_weights(dirty)[dirty == 50.0] == 0).all()
    # The derivative of the loss is the residual times its weight.
    at, step = np.array([0.3, 2.0, 4.0]), 1e-6
    slope = [(tukey_loss(a + step) - tukey_loss(a - step)) / (2 * step) for a in at]
    assert slope == pytest.approx(at * tukey_weights(at), abs=1e-5)
    channels = np.arange(20_000) % 3
    reading = 2 * clean + 10 * channels
    assert correlation(reading, clean, channels) == pytest.approx(1, abs=1e-3)
    assert correlation(reading, clean, 0 * channels) < 0.4
