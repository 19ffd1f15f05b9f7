"""The same raw frames give the same readings and light field through every door."""

import csv

import numpy as np
import pytest
import yaml
from programs import program

import emmc_rig as emmc
from emmc_rig.calibration.frames import MeanFrame, SensorGain
from emmc_rig.calibration.scale import Scale
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.raw import decode_raw
from emmc_rig.live.light_field import LiveLightField, live_scale
from emmc_rig.model.camera import pixel_light
from emmc_rig.model.frames import Frames
from emmc_rig.session.measured_psi import session_scale
from emmc_rig.session.session import Session

GAIN_DN, READ_DN, RATE = 0.5, 3.0, 60_000.0
"""Of the camera: DN per electron, read noise in DN, electrons per second of white light."""


class Ended:
    """In place of a solver: it notes what the live page gives it."""

    def __init__(self):
        self.frames: Frames | None = None

    def __call__(self, method, psi, frames, *rest):
        self.frames = frames
        raise emmc.ERRORS[-1]("enough")


def shown_live(scale, raw):
    """What the live page reconstructs of a frame that stands still."""
    clock, solver = [0.0], Ended()
    live = LiveLightField(scale, "tv", solver, lambda: clock[0])
    live.update(raw)
    clock[0] = 10.0
    live.update(raw)
    while live.update(raw)["why"] != "enough":
        pass
    assert solver.frames is not None
    return solver.frames


def imported(folder, gain, exposure_s, black_dn, binning):
    """A session of a shot and darks, DNGs of a sensor with these settings, and true readings."""
    described = {
        "title": "mine",
        "views": [3, 3],
        "lens": {"distance_mm": 50, "aperture_cell_mm": 2},
        "sensor": {
            "cfa": "rggb" if binning == 1 else "mono",
            "sample_pitch_um": 24,
            "binning": binning,
            "noise": {
                "black_level_dn": black_dn,
                "white_level_dn": 16_000,
                "gain_dn_per_electron": GAIN_DN,
                "electrons_per_s": RATE,
                "read_noise_electrons": READ_DN / GAIN_DN,
            },
        },
        "masks": {"mask": {"distance_mm": 0.5, "cell_um": 24, "pattern": {"kind": "random_rgbw"}}},
    }
    (folder / "mine.yaml").write_text(yaml.safe_dump(described))
    camera = emmc.camera(folder / "mine.yaml")
    scene = emmc.scene("near-planar", size=(24 * binning, 32 * binning), views=(3, 3))
    psi = camera.psi(scene.size)
    true, rng = np.asarray(psi @ scene), np.random.default_rng(0)
    shape, area = true.shape[1:], np.broadcast_to(pixel_light(camera, scene.size), true.shape)[0]

    def exposed(light, gain):
        electrons = rng.poisson(light * area * RATE * exposure_s)
        signal = gain * (GAIN_DN * electrons + rng.normal(0, READ_DN, shape))
        return np.clip(np.round(black_dn + signal), 0, 16_000).astype(np.uint16)

    cfa = described["sensor"]["cfa"]
    rows = [{"file": "shot.dng", "kind": "shot", "shot": 0, "gain": gain}]
    mosaics = {"shot.dng": exposed(true[0], gain)}
    for number in range(4):
        mosaics[f"dark{number}.dng"] = exposed(np.zeros(shape), 1.0)
        rows.append({"file": f"dark{number}.dng", "kind": "dark"})
    for name, mosaic in mosaics.items():
        (folder / name).write_bytes(encode_dng(mosaic, cfa, black_dn, 16_000, exposure_s))
    with (folder / "table.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["file", "kind", "shot", "gain"])
        writer.writeheader()
        writer.writerows(rows)
    out = folder / "session"
    done = program("import", folder / "table.csv", "--camera", folder / "mine.yaml", "--out", out)
    assert done[0] == 0, done
    return out, true


@pytest.mark.parametrize(
    ("gain", "exposure_s", "black_dn", "binning"),
    [(1, 0.02, 64, 1), (1.25, 0.02, 64, 1), (2, 0.05, 512, 1), (2, 0.02, 0, 2), (1, 0.05, 512, 2)],
)
def test_session_live_page_and_scale_read_equal_bytes(
    tmp_path, gain, exposure_s, black_dn, binning
):
    folder, true = imported(tmp_path, gain, exposure_s, black_dn, binning)
    psi, frames = emmc.open_frames(folder)
    good = frames.usable
    # Readings follow from light alone, and are as far from it as is stated.
    score = (frames.readings - true)[good] / frames.deviation[good]
    assert abs(np.mean(score)) < 0.25
    assert np.std(score) == pytest.approx(1, abs=0.15)
    session = Session(folder)
    raw = decode_raw((tmp_path / "shot.dng").read_bytes())
    raw = raw.__class__(**{**vars(raw), "gain": float(gain)})
    live = shown_live(live_scale(folder), raw)
    direct = session_scale(session).frames(lambda shot: [raw])
    for other in (live, direct):
        assert frames.readings.tobytes() == other.readings.tobytes()
        assert frames.deviation.tobytes() == other.deviation.tobytes()
    assert frames.noise_sigma == live.noise_sigma == direct.noise_sigma
    assert frames.usable.tobytes() == live.usable.tobytes() == direct.usable.tobytes()
    assert frames.exposures == direct.exposures
    assert (frames.exposures[0].gain, frames.exposures[0].exposures_s) == (gain, (exposure_s,))
    by_session, by_page = (emmc.reconstruct(psi, given, "tv") for given in (frames, live))
    assert by_session.light_field.tobytes() == by_page.light_field.tobytes()


def test_the_fast_rate_of_a_preview_is_that_of_the_readings_at_any_gain():
    camera = emmc.camera("rgbw-bayer-1shot")
    psi = camera.psi((24, 32))
    rng = np.random.default_rng(1)
    shape = psi.frames_shape[1:]
    dark = MeanFrame(100 + rng.random(shape).astype(np.float32), 4.0, 16, 0.1)
    scale = Scale(
        psi, np.full((1, *shape), 9_000.0), (dark,), SensorGain(0.5, 4.0), np.ones(shape, bool)
    )
    mosaic = rng.integers(200, 900, shape).astype(np.uint16)
    for gain in (1.0, 1.5, 2.0):
        raw = decode_raw(encode_dng(mosaic, "rggb", 100, 4_095, 0.1))
        raw = raw.__class__(**{**vars(raw), "gain": gain})
        (reading,) = scale.frames(lambda shot, raw=raw: [raw]).readings
        np.testing.assert_allclose(scale.rate(raw) / 9_000, reading, rtol=1e-5, atol=1e-7)
        expected = (mosaic - 100 - gain * (dark.mean_dn - 100)) / (0.1 * gain) / 9_000
        np.testing.assert_allclose(reading, expected, rtol=1e-4, atol=1e-6)
