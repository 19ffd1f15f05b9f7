"""A simulated bench with a person, who makes on request the moves for which there is no axis."""

from contextlib import contextmanager
from dataclasses import replace

import yaml

from emmc_rig.bench.hands import APERTURE, AskingAttendant
from emmc_rig.bench.rig_config import ImagedRig, opened_rig, rig_description

PLAN = {
    "title": "by hand",
    "camera": "rgbw-bayer-1shot",
    "shots": [{"exposure_s": 0.02}],
    "whiteboards": {
        "views": [[0, 0], [1, 1]],
        "open": [{"validation": True, "repeats": 1}],
        "repeats": 1,
        "references": 2,
        "exposure_s": 0.002,
    },
    "darks": {"repeats": 2},
}
CELL_UM = 5000.0


class Person(AskingAttendant):
    """Does what was asked for on the bench of a simulated rig.

    wrong: by hole (v, u), the one on which they put the pinhole once instead.
    """

    def __init__(self, camera, ask, rig, wrong):
        super().__init__(camera, ask, rig.zero_um, rig.window_um)
        self.acts, self.wrong = rig.attendant, dict(wrong)

    def set_lamp(self, colour):
        super().set_lamp(colour)
        self.acts.set_lamp(colour)

    def place(self, target, turn_deg=0.0):
        super().place(target, turn_deg)
        self.acts.place(target, turn_deg)

    def fit_masks(self, shot, fitted=True):
        super().fit_masks(shot, fitted)
        self.acts.fit_masks(shot, fitted)

    def move(self, offsets_um):
        super().move(offsets_um)
        hole = tuple(round(offsets_um[axis] / CELL_UM) + 2 for axis in reversed(APERTURE))
        if hole in self.wrong:
            v, u = self.wrong.pop(hole)
            places_um = ((u - 2) * CELL_UM, (v - 2) * CELL_UM)
            offsets_um = dict(zip(APERTURE, places_um, strict=True))
        self.acts.move(offsets_um)


def manned(folder, monkeypatch, wrong=()):
    """Return plan and rig of a bench on which a person moves the pinhole; see `Person`."""

    from emmc_rig.captures import run as capture_run

    @contextmanager
    def opened(description, camera, ask):
        with opened_rig(description, camera, ask) as rig:
            yield replace(rig, attendant=Person(camera, ask, rig, wrong))

    monkeypatch.setattr(capture_run, "opened_rig", opened)
    plan, file = folder / "plan.yaml", folder / "rig.yaml"
    plan.write_text(yaml.safe_dump(PLAN))
    file.write_text("kind: simulated\naxes: [mask_x, mask_y]\nhands_um: 100\n")
    return plan, rig_description(str(file), ImagedRig(scene="near-planar", size=(48, 64), rays=64))
