"""
A power meter beside every frame
================================

How much light there was for each frame, from an instrument of the lab's own: a hook of the plan
asks it before the exposure, the lamp already lit as the frame wants it, and ends the capture where
the lamp gives up.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import emmc_rig as emmc

# %%
# A meter has a state, so it is an object; `pyvisa` opens a real one. The stand-in here has the lamp
# fade by a per cent from frame to frame.

HOOK = """
from emmc_rig import StopCapture


class Meter:
    power_w = 1.2e-3                                   # of a lamp that fades

    def query(self, command):                          # pyvisa: ResourceManager().open_resource(..)
        self.power_w *= 0.99
        return f"{self.power_w:.6e}"


meter = Meter()


def beside(rig, frame, note):
    if frame is None or frame.bench.lamp == "off":
        return
    power_w = float(meter.query("MEAS:POW?"))
    note(power_w=power_w)
    if power_w < 0.5e-3:
        raise StopCapture(f"the lamp gives {power_w * 1e3:.2f} mW only")
"""

PLAN = """
camera: rgbw-bayer-1shot
shots:
  - {exposure_s: 0.05, repeats: 12}
whiteboards: null
darks: {repeats: 2}
between: power:beside
"""

work = TemporaryDirectory()
folder = Path(work.name)
(folder / "power.py").write_text(HOOK)
(folder / "plan.yaml").write_text(PLAN)
rig = emmc.rig("simulated", scene="near-planar", size=(24, 32), rays=64)
session = emmc.capture(folder / "plan.yaml", rig)

# %%
# Its readings, beside the brightness of the frames:

power_w = {name: notes["power_w"] for name, notes in session.notes.items() if notes}
levels = [session.stored[name].level for name in power_w]
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot([1e3 * item for item in power_w.values()], label="power, mW")
axes.plot(levels, label="brightest readings of the frame, 1 at white")
axes.set(xlabel="frame", ylim=(0, None))
axes.legend()

# %%
work.cleanup()
