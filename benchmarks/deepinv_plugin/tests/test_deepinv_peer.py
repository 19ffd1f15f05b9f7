"""The peer of the chart that deepinv solves."""

from types import SimpleNamespace

import numpy as np
from emmc_rig_deepinv import METHODS, DeepinvSettings
from peer_deepinv import deepinv  # noqa: F401

import emmc_rig as emmc
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.method import Given


def test_the_peer_explains_the_frames_and_gains_on_an_even_light_field():
    (method,) = METHODS
    scene = emmc.scene("near-planar", size=(16, 24))
    camera = emmc.camera("rgbw-bayer-3shots")
    psi = camera.psi(scene.size)
    frames = camera.expose(scene, seed=0, psi=psi)
    settings = SimpleNamespace(of=lambda kind: DeepinvSettings())  # of a plug-in not installed
    result = method.solve(Given(psi, frames, None, None), settings)  # pyright: ignore
    truth = np.asarray(scene)
    even = np.full_like(truth, truth.mean())
    assert psnr_db(result.light_field, truth) > psnr_db(even, truth) + 3
    missed = (psi.forward(result.light_field) - frames.readings)[frames.usable]
    assert np.sqrt(np.mean(missed**2)) < 0.2 * frames.readings.std()  # the denoiser comes last
