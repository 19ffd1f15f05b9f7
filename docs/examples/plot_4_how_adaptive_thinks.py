"""
How ``adaptive`` thinks
=======================

What the default method estimates beside the light field, for one coded Bayer frame.
"""

import matplotlib.pyplot as plt
import numpy as np

import emmc_rig as emmc

camera = emmc.camera("scenario-ii-cfa")
scene = emmc.scene("deep-occlusions", size=(96, 128))
psi = camera.psi(scene.size)
frames = camera.expose(scene, seed=0)
result = emmc.reconstruct(psi, frames, "adaptive")

# %%
# The frame it starts from is one number per pixel: the masks' shadow, the Bayer pattern and the
# scene in one.

figure, axes = plt.subplots(2, 2, figsize=(9, 7), layout="constrained")
axes[0, 0].imshow(frames.readings[0], cmap="gray")
axes[0, 0].set_title("the frame")
picture = np.clip(result.light_field[2, 2], 0, 1) ** (1 / 2.2)
axes[0, 1].imshow(picture)
axes[0, 1].set_title("centre view")
shown = axes[1, 0].imshow(result.disparity, cmap="viridis")
axes[1, 0].set_title("disparity, pixels per view step")
figure.colorbar(shown, ax=axes[1, 0])
shown = axes[1, 1].imshow(result.sigma[2, 2], cmap="magma")
axes[1, 1].set_title("stated standard deviation")
figure.colorbar(shown, ax=axes[1, 1])
for axis in axes.flat:
    axis.set(xticks=[], yticks=[])

# %%
# How honest is the deviation? Of a Gaussian 68 % of the errors lie within one deviation, 95 %
# within two.

rms = np.sqrt(np.square(result.light_field - np.asarray(scene)).mean(axis=-1))
for factor in (1, 2):
    print(f"within {factor} deviation(s): {np.mean(rms <= factor * result.sigma):.0%}")

# %%
# The disparity against the truth of the rendered scene:

error_px = np.median(np.abs(result.disparity - scene.disparity_px))
print(f"median error {error_px:.3f} px per view step")
