"""
A light field from one frame
============================

A shipped camera, a procedural scene, one coded frame with sensor noise, and what comes back.
"""

import matplotlib.pyplot as plt
import numpy as np

import emmc_rig as emmc

camera = emmc.camera("rgbw-bayer-1shot")
scene = emmc.scene("deep-occlusions", size=(96, 128))
psi = camera.psi(scene.size)
frames = camera.expose(scene, seed=0)
result = emmc.reconstruct(psi, frames)

figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
axes[0].imshow(frames.readings[0], cmap="gray")
axes[0].set_title("the frame")
axes[1].imshow(np.clip(result.light_field[2, 2], 0, 1) ** (1 / 2.2))
axes[1].set_title("recovered centre view")
for axis in axes:
    axis.set(xticks=[], yticks=[])

# %%
# Every result carries a verdict with reasons:

print(result.verdict.words)

# %%
# Against the truth, which only a simulation knows. ``replicate_psnr_db`` is the baseline: the true
# centre view in all places, which has no parallax at all.

for name, value in result.compare(scene).items():
    print(f"{name}: {value:.3f}")

# %%
# Centre view, an epipolar plane image, the disparity and the stated standard deviation:

figure = result.show()
