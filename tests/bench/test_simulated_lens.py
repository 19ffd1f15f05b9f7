"""The pupil of the simulated rig's lens: by its file, by the camera, or round by default."""

import numpy as np
import pytest

from emmc_rig.bench.hardware import default_pupil
from emmc_rig.bench.rig_config import SIMULATED, ImagedRig, opened_rig, rig_description
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.pupil import Pupil

SIZE = (48, 64)
DESCRIBED = Pupil(diameter_mm=15)


def camera_with(pupil):
    camera = find_camera("rgbw-bayer-1shot")
    lens = camera.lens.model_copy(update={"pupil": pupil})
    return camera.model_copy(update={"lens": lens})


def white_reading(rig, camera):
    """Return the mean reading of the white board through the open aperture, without masks."""
    with opened_rig(rig, camera, lambda task: None) as opened:
        opened.stage.home()
        opened.attendant.set_lamp("white")
        opened.attendant.place("whiteboard")
        opened.attendant.fit_masks(0, fitted=False)
        window_um = opened.zero_um["aperture_x"] + opened.window_um
        opened.stage.move_to_um({**opened.zero_um, "aperture_x": window_um})
        opened.camera.set_exposure_s(0.01)
        dn = opened.camera.snap().mosaic
    return camera.sensor.noise.normalise(dn, 0.01, 1.0).mean()


@pytest.mark.parametrize(
    ("pupil", "described", "open_share"),
    [
        ("{diameter_mm: 20}", None, np.pi * 10**2 / 25**2),
        ("{shape: square, diameter_mm: 20}", DESCRIBED, 0.64),
        ("none", DESCRIBED, 1.0),
        ("round", DESCRIBED, np.pi * 7.5**2 / 25**2),
    ],
)
def test_a_rig_s_file_says_what_the_lens_leaves_open(tmp_path, pupil, described, open_share):
    """`round` is the lens in the camera's file, if the file has a lens with a pupil."""
    (tmp_path / "rig.yaml").write_text(f"kind: simulated\npupil: {pupil}\n")
    imaged = ImagedRig(scene="dark", size=SIZE, rays=256)
    rig = rig_description(str(tmp_path / "rig.yaml"), imaged)
    assert white_reading(rig, camera_with(described)) == pytest.approx(open_share, rel=0.01)


@pytest.mark.parametrize(("described", "open_share"), [(None, 1.0), (DESCRIBED, 0.2827)])
def test_a_session_of_an_earlier_version_keeps_its_lens(described, open_share):
    """Its rig says nothing of a pupil: the views are whole where the camera describes none."""
    rig = rig_description(SIMULATED, ImagedRig(scene="dark", size=SIZE, rays=256))
    rig.pop("pupil", None)
    assert white_reading(rig, camera_with(described)) == pytest.approx(open_share, rel=0.01)


def test_by_default_the_lens_is_a_disk_around_all_views():
    assert default_pupil(camera_with(None)) == Pupil(diameter_mm=round(25 * 10 / 7, 6))
    assert default_pupil(camera_with(DESCRIBED)) == DESCRIBED
    assert camera_with(default_pupil(camera_with(None))).view_shares().min() == 1
    # The paper's apertures are points, and bands of a spectrum are no places of the aperture.
    assert default_pupil(find_camera("scenario-ii-cfa")) is None
    bands = camera_with(None).model_copy(update={"view_axes": ("angle", "band")})
    assert default_pupil(bands) is None


@pytest.mark.parametrize(
    ("pupil", "line"),
    [
        ("{diametre_mm: 25}", "pupil: unknown key 'diametre_mm': did you mean 'diameter_mm'?"),
        (
            "{diameter_mm: 25, rim: {diameter_mm: 9, shfit: 1}}",
            "pupil: unknown key 'rim.shfit': did you mean 'shift'?",
        ),
        ("{diameter_mm: -1}", "pupil: diameter_mm: input should be greater than 0"),
        ("ruond", "pupil: ruond: use round, none, or a lens such as {diameter_mm: 27.5}"),
    ],
)
def test_a_simulated_lens_that_cannot_be_is_refused_with_one_line(tmp_path, pupil, line):
    (tmp_path / "rig.yaml").write_text(f"kind: simulated\npupil: {pupil}\n")
    with pytest.raises(AppError) as refused:
        rig_description(str(tmp_path / "rig.yaml"), ImagedRig(scene="dark"))
    assert line in str(refused.value)
    assert "\n" not in str(refused.value)
