"""Faults of sensor and light: photons, saturation, bad pixels, black level, tone curve, JPEG."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.camera import pixel_light
from emmc_rig.model.noise import SensorNoise
from emmc_rig.simulators.flaws import SensorFlaws
from emmc_rig.study.stability.fault import SENSOR, Fault
from emmc_rig.study.trial import Array, Capture, Trial, trial_of

DEAD_RESPONSE = 0.02
CODES = 255
BLACK_DEVIATIONS = 6
HEADROOM = 1.1
"""Of the white level over a white reading, for its noise."""
CFA_PERIOD = 12
"""Pixels in which every known tile of colour filters repeats."""


def exposure(capture: Capture, electrons: float) -> Trial:
    """A white reading is worth `electrons`, all shots together."""
    capture = _with_room(capture, electrons)
    camera = capture.described
    now = camera.sensor.noise.electrons_per_s * float(camera.exposures_s().sum())
    factor = electrons / now
    shots = tuple(
        shot
        if shot.exposure_s is None
        else shot.model_copy(update={"exposure_s": shot.exposure_s * factor})
        for shot in camera.shots
    )
    return trial_of(
        capture.with_camera(total_exposure_s=camera.total_exposure_s * factor, shots=shots)
    )


def _with_room(capture: Capture, electrons: float) -> Capture:
    """Return the capture with a gain low enough that white in all shots' light is not clipped."""
    noise, camera = capture.described.sensor.noise, capture.described
    share = camera.exposures_s() / camera.exposures_s().sum()
    side = CFA_PERIOD * camera.sensor.binning
    light = float(pixel_light(camera, (side, side)).max())
    room_dn = noise.white_level_dn - noise.black_level_dn
    most = room_dn / (HEADROOM * electrons * float(share.max()) * light)
    if most >= noise.gain_dn_per_electron:
        return capture
    return _with_noise(capture, {"gain_dn_per_electron": most})


def read_noise(capture: Capture, electrons: float) -> Trial:
    """Read noise, at least the camera's own."""
    own = capture.described.sensor.noise
    electrons = max(electrons, own.read_noise_electrons)
    # The black level lies clear of the noise, as on any sensor: clipped noise would be a bias.
    black = math.ceil(BLACK_DEVIATIONS * electrons * own.gain_dn_per_electron)
    black = min(max(black, own.black_level_dn), own.white_level_dn - 1)
    return trial_of(
        _with_noise(capture, {"read_noise_electrons": electrons, "black_level_dn": black})
    )


def saturation(capture: Capture, percent: float) -> Trial:
    """The white level lies so low that a share of the readings reaches it."""
    camera, noise = capture.described, capture.described.sensor.noise
    psi = capture.psi()
    clean, light = psi.forward(capture.scene_seen().light_field), pixel_light(camera, psi.size)
    electrons = noise.electrons(clean, camera.exposures_s()[:, None, None], light)
    level = float(np.quantile(electrons, 1 - percent / 100)) * noise.gain_dn_per_electron
    white = max(noise.black_level_dn + 1, round(noise.black_level_dn + level))
    return trial_of(_with_noise(capture, {"white_level_dn": min(white, noise.white_level_dn)}))


def _with_noise(capture: Capture, changed: dict[str, object]) -> Capture:
    sensor = capture.described.sensor
    noise = SensorNoise.model_validate({**sensor.noise.model_dump(), **changed})
    return capture.with_camera(sensor=sensor.model_copy(update={"noise": noise}))


def bad_pixels(capture: Capture, percent: float) -> Trial:
    """A share of the pixels is dead or hot, half of each, and not marked as unusable."""
    return _bad(capture, percent, listed=False)


def masked_pixels(capture: Capture, percent: float) -> Trial:
    """The same pixels, marked as unusable."""
    return _bad(capture, percent, listed=True)


def _bad(capture: Capture, percent: float, listed: bool) -> Trial:
    camera, psi = capture.described, capture.psi()
    pixels = psi.frames_shape[1:]
    flaws = SensorFlaws(bad_share=percent / 100, seed=capture.seed + 1)
    hot, dead = flaws.bad(pixels)
    # Hot pixels differ: the brightest saturates no sensor, the faintest hardly shows.
    rng = np.random.default_rng([capture.seed, 5])
    glow = rng.random(pixels) * flaws.hot_electrons_per_s / camera.sensor.noise.electrons_per_s
    light = np.maximum(pixel_light(camera, psi.size), 1)

    def spoilt(clean: Array) -> Array:
        return np.where(dead, DEAD_RESPONSE * clean, clean) + np.where(hot, glow / light, 0)

    bad: NDArray[np.bool_] = np.broadcast_to(hot | dead, psi.frames_shape)
    return trial_of(capture, change_clean=spoilt, unusable=bad if listed else None)


def black_level(capture: Capture, percent: float) -> Trial:
    """The black level subtracted is too low, by a share of the mean reading."""
    return trial_of(capture, change_clean=lambda clean: clean + percent / 100 * clean.mean())


def gamma(capture: Capture, percent: float) -> Trial:
    """The readings follow a power of the light, less than 1 by a share."""

    def bent(clean: Array) -> Array:
        peak = clean.max()
        return peak * (np.maximum(clean, 0) / peak) ** (1 - percent / 100)

    return trial_of(capture, change_clean=bent)


def dead_lines(capture: Capture, count: float) -> Trial:
    """Columns side by side, from a third of the width on, are dead and not marked."""
    dead = np.zeros(capture.psi().frames_shape[2], np.bool_)
    dead[len(dead) // 3 :][: int(count)] = True
    return trial_of(capture, change_clean=lambda clean: np.where(dead, DEAD_RESPONSE, 1) * clean)


def jpeg(capture: Capture, quality: float) -> Trial:
    """Frames of 8 bits are stored as JPEG of some quality."""
    trial = trial_of(capture)
    peak = float(trial.readings.max())
    stored = []
    for frame in trial.readings:
        codes = np.clip(frame / peak * CODES, 0, CODES).round().astype(np.uint8)
        _, packed = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])
        stored.append(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE))
    return replace(trial, readings=np.asarray(stored, np.float32) / CODES * peak)


FAULTS = (
    Fault(
        "exposure", "Exposure", "electrons at white",
        (1_000_000, 200_000, 50_000, 15_500, 5_000, 1_500, 500, 150, 50, 15, 5),
        (1_000_000, 15_500, 500, 50),
        SENSOR, exposure,
    ),
    Fault(
        "read-noise", "Read noise", "electrons",
        (0, 30, 100, 300, 1_000, 3_000), (0, 100, 1_000, 3_000),
        SENSOR, read_noise,
    ),
    Fault(
        "saturation", "Saturation", "% of readings",
        (0, 1, 5, 10, 20, 40, 60, 80), (0, 10, 40, 80),
        SENSOR, saturation,
    ),
    Fault(
        "bad-pixels", "Bad pixels, not marked", "% of pixels",
        (0, 0.1, 0.3, 1, 3, 10, 30), (0, 0.3, 3, 20),
        SENSOR, bad_pixels, repairable=True,
    ),
    Fault(
        "masked-pixels", "Bad pixels, masked", "% of pixels",
        (0, 1, 3, 10, 30, 60, 90), (0, 10, 40, 80),
        SENSOR, masked_pixels,
    ),
    Fault(
        "dead-lines", "Dead columns, not marked", "columns",
        (0, 1, 2, 4, 8), (0, 2, 4),
        SENSOR, dead_lines, repairable=True,
    ),
    Fault(
        "black-level", "Black level too low", "% of the mean reading",
        (0, 1, 2, 4, 6, 10, 20), (0, 6, 20),
        SENSOR, black_level, repairable=True,
    ),
    Fault(
        "gamma", "Gamma below 1", "%",
        (0, 2, 5, 10, 20, 50), (0, 10, 50),
        SENSOR, gamma, repairable=True,
    ),
    Fault(
        "jpeg", "JPEG quality", "of 100",
        (100, 95, 90, 85, 70, 50), (100, 85, 50),
        SENSOR, jpeg,
    ),
)  # fmt: skip
