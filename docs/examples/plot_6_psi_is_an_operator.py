"""
Psi is an operator
==================

Forward, adjoint, and SciPy's solvers on the same object; and why its data step is exact.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.sparse.linalg import aslinearoperator, lsqr

import emmc_rig as emmc

camera = emmc.camera("rgbw-bayer-3shots")
scene = emmc.scene("near-planar", size=(48, 64))
psi = camera.psi(scene.size)
psi

# %%
# A dot test, scaled by norms: the adjoint is the adjoint.

rng = np.random.default_rng(0)
light_field = rng.random(psi.light_field_shape)
frames = rng.random(psi.frames_shape)
forward, back = psi @ light_field, psi.T @ frames
gap = abs(np.vdot(forward, frames) - np.vdot(light_field, back))
print(f"relative gap {gap / (np.linalg.norm(forward) * np.linalg.norm(frames)):.1e}")

# %%
# SciPy takes Psi as it is. Least squares without any prior explains the frames and recovers
# nothing: there are twenty-five times fewer readings than unknowns.

readings = psi @ scene
solution = lsqr(aslinearoperator(psi), readings.ravel(), iter_lim=50)[0]
plain = solution.reshape(psi.light_field_shape)
with_prior = emmc.reconstruct(psi, readings, "tv", noise_sigma=1e-3).light_field

figure, axes = plt.subplots(1, 3, figsize=(9, 3), layout="constrained")
pictures = {"true view": np.asarray(scene), "least squares": plain, "total variation": with_prior}
for axis, (title, shown) in zip(axes, pictures.items(), strict=True):
    axis.imshow(np.clip(shown[0, 0], 0, 1) ** (1 / 2.2))
    axis.set(title=title, xticks=[], yticks=[])
