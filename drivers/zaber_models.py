"""Length of a Zaber microstep by device and peripheral id: only models with a public source.

A model that is not listed has no scale here. Its own can be read in Zaber Launcher, on its data
sheet, or measured. A rotary stage is listed to be named in the refusal.
"""

from dataclasses import dataclass

DEFAULT_RESOLUTION = 64
"""Microsteps of a full step, as all Zaber steppers are shipped and as data sheets count them."""
FULL_STEPS_PER_S = 10_000.0
"""Fastest: `maxspeed` and `move vel` end at resolution times 16384, in 1.6384 microsteps a second
(ASCII Protocol Manual, "move vel")."""


@dataclass(frozen=True)
class Model:
    """A linear axis: `microstep_um` at `DEFAULT_RESOLUTION`, None for one that turns."""

    name: str
    microstep_um: float | None


DEVICES = {
    50081: Model("X-LHM", 0.1240234375),
    50105: Model("X-LSQ150A", 0.09921875),
}
"""By `deviceid`, of devices with their motor built in.

50081: motorZaberMotion (github.com/zabertech), tests' `devices/xlhm.py`, is an X-LHM; its screw is
that of 43211. 50105: thz-auto-vis (github.com/PTE-TTK-Programming-Projects), `zaberwindow.cpp`,
has its microstep and 150 mm; the same microstep (10078.74 a millimetre) is published for the
X-LSQ150A elsewhere.
"""
PERIPHERALS = {
    43211: Model("LHM", 0.1240234375),
    46657: Model("a rotary stage", None),
}
"""By `peripheralid`, of motors on a separate controller.

motorZaberMotion, tests' `devices/xmcc4.py` and `mock_helpers.py`: 8062.992126 microsteps a
millimetre and 6400 a degree.
"""


def find_model(device_id: int, peripheral_id: int | None) -> Model | None:
    """Return the model behind an axis; a controller's motor is its peripheral (0: none)."""
    if peripheral_id:
        return PERIPHERALS.get(peripheral_id)
    return DEVICES.get(device_id)
