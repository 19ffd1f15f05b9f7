"""
A light field from one frame
============================

A shipped camera, a procedural scene, one coded frame with sensor noise, and what comes back.
"""

import emmc_rig as emmc

camera = emmc.camera("rgbw-bayer-1shot")
scene = emmc.scene("deep-occlusions", size=(96, 128))
psi = camera.psi(scene.size)
frames = camera.expose(scene, seed=0)
result = emmc.reconstruct(psi, frames)
result

# %%
# The picture holds the centre view, an epipolar plane image, the disparity and the stated standard
# deviation. Every result carries a verdict with reasons:

print(result.verdict.words)

# %%
# Against the truth, which only a simulation knows. ``replicate_psnr_db`` is the figure to beat: the
# true centre view, copied to all views, has no parallax at all.

for name, value in result.compare(scene).items():
    print(f"{name}: {value:.3f}")

# %%
result.show()
