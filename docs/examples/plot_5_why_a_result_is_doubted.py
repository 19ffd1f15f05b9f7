"""
Why a result is doubted
=======================

The mask has moved by one pixel since Psi was measured. Nobody says so; the frames do.
"""

import matplotlib.pyplot as plt
import numpy as np

import emmc_rig as emmc

camera = emmc.camera("rgbw-bayer-1shot")
scene = emmc.scene("deep-occlusions", size=(96, 128))
psi = camera.psi(scene.size)
good = camera.expose(scene, seed=0)
right = emmc.reconstruct(psi, good, "adaptive-fast")
print(right.verdict.words)
print(f"{right.compare(scene)['psnr_db']:.2f} dB")

# %%
# The same scene, but the frames come from a mask one pixel to the right:

weights = np.roll(psi.weights, 1, axis=-1)
moved = type(psi)(weights, psi.colour, psi.binning) @ scene
result = emmc.reconstruct(psi, moved, "adaptive-fast", noise_sigma=good.noise_sigma)
print(f"{result.compare(scene)['psnr_db']:.2f} dB")

figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
pictures = {
    f"Psi is right: {right.verdict.level}": right,
    f"the mask has moved: {result.verdict.level}": result,
}
for axis, (title, shown) in zip(axes, pictures.items(), strict=True):
    axis.imshow(np.clip(shown.light_field[2, 2], 0, 1) ** (1 / 2.2))
    axis.set(title=title, xticks=[], yticks=[])

# %%
# Level, reasons, figures and remedies:

print(result.verdict.level)
for reason in result.verdict.reasons:
    print(f"- {reason.what}\n  {reason.remedy}")
