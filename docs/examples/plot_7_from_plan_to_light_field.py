"""
From plan to light field
========================

A whole bench session without hardware: the simulated rig captures a plan over the protocols of real
devices, Psi is measured from the whiteboards, and the light field is reconstructed.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import emmc_rig as emmc

PLAN = """
camera: rgbw-bayer-1shot
shots:
  - exposure_s: 0.05
whiteboards:
  views: [[2, 2]]
  shots: [0]
  references: 2
  open:
    - repeats: 2
    - validation: true
darks:
  repeats: 2
"""

work = TemporaryDirectory()
plan = Path(work.name, "plan.yaml")
plan.write_text(PLAN)
rig = emmc.rig("simulated", scene="near-planar", size=(48, 64), rays=256)
session = emmc.capture(plan, rig)
session

# %%
# A capture that was interrupted goes on where it stopped: the same call captures what is missing,
# here nothing.

print(emmc.capture(plan, rig).is_complete)

# %%
# Psi is measured; the whiteboard kept for validation says how well:

calibration = emmc.calibrate(session)
calibration

# %%
# Frames and Psi of the session are what every method takes:

psi, frames = emmc.open_frames(session.folder)
result = emmc.reconstruct(psi, frames, "adaptive-fast")
print(result.verdict.words)

figure, axes = plt.subplots(1, 3, figsize=(9, 2.8), layout="constrained")
axes[0].imshow(psi.weights[0, 0, 0, :, 0], cmap="gray")
axes[0].set_title("Psi measured: view (0, 0)")
axes[1].imshow(frames.readings[0], cmap="gray")
axes[1].set_title("the shot")
axes[2].imshow(np.clip(result.light_field[2, 2], 0, 1) ** (1 / 2.2))
axes[2].set_title("recovered centre view")
for axis in axes:
    axis.set(xticks=[], yticks=[])

# %%
work.cleanup()
