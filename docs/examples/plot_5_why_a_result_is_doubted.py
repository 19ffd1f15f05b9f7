"""
Why a result is doubted
=======================

The mask has moved by one pixel since Psi was measured. Nobody says so; the frames do.
"""

import numpy as np

import emmc_rig as emmc

camera = emmc.camera("rgbw-bayer-1shot")
scene = emmc.scene("deep-occlusions", size=(96, 128))
psi = camera.psi(scene.size)
good = camera.expose(scene, seed=0)
result = emmc.reconstruct(psi, good, "adaptive-fast")
print(result.verdict.words)
print(f"{result.compare(scene)['psnr_db']:.2f} dB")

# %%
# The same scene, but the frames come from a mask one pixel to the right:

moved_psi = camera.psi(scene.size)
weights = np.roll(psi.weights, 1, axis=-1)
moved = type(psi)(weights, psi.colour, psi.binning) @ scene
result = emmc.reconstruct(psi, moved, "adaptive-fast", noise_sigma=good.noise_sigma)
print(f"{result.compare(scene)['psnr_db']:.2f} dB")

# %%
# Level, reasons, figures and remedies:

print(result.verdict.level)
for reason in result.verdict.reasons:
    print(f"- {reason.what}\n  {reason.remedy}")

# %%
# What it would have shown, beside the truth and the readings that it leaves unexplained:

figure = result.figure(truth=scene)
