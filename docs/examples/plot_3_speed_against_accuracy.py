"""
Speed against accuracy
======================

The same frames, several methods. The full comparison is
``emmc-rig chart``; here it is in ten lines.
"""

import matplotlib.pyplot as plt

import emmc_rig as emmc

camera = emmc.camera("scenario-ii-cfa")
scene = emmc.scene("deep-occlusions", size=(64, 80))
psi = camera.psi(scene.size)
frames = camera.expose(scene, seed=0)

emmc.reconstruct(psi, frames, "adaptive")  # the first call compiles kernels
points = {}
for method in ("tv", "dict-admm", "tv-dict", "adaptive-fast", "adaptive"):
    result = emmc.reconstruct(psi, frames, method)
    points[method] = (result.seconds, result.compare(scene)["psnr_db"])
    print(f"{method:14} {points[method][0]:6.2f} s  {points[method][1]:6.2f} dB")

# %%
figure, axis = plt.subplots(figsize=(6, 3.4), layout="constrained")
for method, (seconds, psnr_db) in points.items():
    axis.plot(seconds, psnr_db, "o")
    axis.annotate(method, (seconds, psnr_db), xytext=(6, 4), textcoords="offset points")
axis.set(xscale="log", xlabel="seconds", ylabel="PSNR, dB", title="One Bayer shot, 64 x 80")
axis.margins(0.25)
