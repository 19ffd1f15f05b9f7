"""
Your own camera in ten lines
============================

A camera is a YAML file: views, lens, sensor, and masks with pattern, cell size and distance.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import emmc_rig as emmc

TEXT = """
title: A binary mask close to a Bayer sensor
sensor:
  cfa: rggb
masks:
  code:
    distance_mm: 0.2
    cell_um: 30
    pattern: {kind: random_binary, open_probability: 0.5, seed: 1}
"""

with TemporaryDirectory() as folder:
    path = Path(folder, "mine.yaml")
    path.write_text(TEXT)
    camera = emmc.camera(str(path))
camera

# %%
# What the model neglects although it matters is a warning, such as diffraction at small cells:

print(camera.warnings() or "no warnings")

# %%
# The imaging matrix shows what a sensor pixel sees from three of the views: the same mask, shifted
# by d/D times the step between views.

psi = camera.psi((64, 64))
figure, axes = plt.subplots(1, 3, figsize=(8, 3), layout="constrained")
for axis, u in zip(axes, (0, 2, 4), strict=True):
    axis.imshow(psi.weights[0, 2, u, :24, 0, :24], cmap="gray", vmin=0)
    axis.set(title=f"view (2, {u})", xticks=[], yticks=[])

# %%
# A misspelt key is refused with the nearest valid one:

with TemporaryDirectory() as folder:
    path = Path(folder, "mine.yaml")
    path.write_text(TEXT.replace("cell_um", "cel_um"))
    try:
        emmc.camera(str(path))
    except emmc.ERRORS as fault:
        print(str(fault).replace(folder, "..."))
