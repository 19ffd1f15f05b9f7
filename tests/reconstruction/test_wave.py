"""A few steps of total variation in one pass: those of the equations, and of `tv`."""

import numpy as np
import pytest

from emmc_rig.model import bands
from emmc_rig.model.frames import even_frames
from reconstruction import wave
from reconstruction.choices import choose_primal_step, contrast, smooth_guess
from reconstruction.differences import norm_squared
from reconstruction.problem import colour_metric
from reconstruction.tv import TVSettings, reconstruct_tv
from reconstruction.wave import few_steps

MU, STEPS = 2e-3, 7


def captured(random_psi, shots, stored, binning):
    psi = random_psi(shots=shots, stored=stored, binning=binning)
    rng = np.random.default_rng(1)
    frames = psi.forward(rng.random(psi.light_field_shape, dtype=np.float32))
    usable = rng.random(frames.shape) < 0.9
    return psi, frames, usable


def differences(z):
    """Those along x, y, u and v of (v, u, y, x, c), 0 where there is none: (4, v, u, y, x, c)."""
    return np.stack([np.diff(z, axis=a, append=z.take([-1], axis=a)) for a in (3, 2, 1, 0)])


def back(dual):
    """The adjoint of `differences`."""
    total = np.zeros(dual.shape[1:])
    for part, axis in zip(dual, (3, 2, 1, 0), strict=True):
        total -= np.diff(part, axis=axis, prepend=0 * part.take([0], axis=axis))
    return total


def by_the_equations(psi, frames, usable):
    """Condat 2013, algorithm 3.1, over-relaxed, in float64 and natural order."""
    settings, metric = TVSettings(), colour_metric(TVSettings().chroma_weight)
    guess = smooth_guess(psi, frames, usable)
    gamma = choose_primal_step(contrast(guess), MU, settings.chroma_weight)
    norm = np.linalg.norm(metric, 2) ** 2 * norm_squared(1, (*psi.views, None, None))
    tau, relax = 1 / (norm * gamma), settings.relaxation
    inverse = psi.inverted_blocks(np.where(usable, 1 / gamma, np.inf)).astype(np.float64)
    now = np.broadcast_to(guess, psi.light_field_shape).astype(np.float64)
    dual = np.zeros((4, *now.shape))
    for _ in range(STEPS):
        ahead = now - gamma * back(dual) @ metric
        missed = psi.forward(ahead.astype(np.float32)) - frames
        asked = np.einsum("stpq,tpq->spq", inverse, missed)
        new = ahead - psi.adjoint(asked.astype(np.float32))
        raised = dual + tau * differences((2 * new - now) @ metric.T)
        size = np.sqrt(np.square(raised).sum(axis=(0, -1), keepdims=True))
        dual += relax * (raised * np.minimum(1, MU / np.maximum(size, 1e-15)) - dual)
        now += relax * (new - now)
    return np.clip(now, 0, 1)


@pytest.mark.parametrize(("shots", "stored", "binning"), [(1, 1, 1), (2, 3, 1), (3, 1, 2)])
def test_steps_in_one_pass_are_those_of_the_equations(random_psi, shots, stored, binning):
    psi, frames, usable = captured(random_psi, shots, stored, binning)
    found = few_steps(psi, frames, usable, MU, STEPS)
    right = by_the_equations(psi, frames, usable)
    assert np.abs(found - right).max() < 1e-4
    assert found.std() > 100 * np.abs(found - right).max()


def test_steps_in_one_pass_are_those_of_tv(random_psi):
    psi, frames, usable = captured(random_psi, 2, 1, 1)
    found = few_steps(psi, frames, usable, MU, STEPS)
    settings = TVSettings(mu=MU, max_steps=STEPS, rtol=1e-12)
    one_by_one = reconstruct_tv(psi, even_frames(frames, 0.01, usable), settings).light_field
    np.testing.assert_allclose(found, one_by_one, atol=2e-5)


def test_bands_of_rows_change_no_value(random_psi, monkeypatch):
    psi, frames, usable = captured(random_psi, 1, 1, 1)
    together = few_steps(psi, frames, usable, MU, STEPS)
    monkeypatch.setattr(bands, "get_num_threads", lambda: 5)
    np.testing.assert_array_equal(few_steps(psi, frames, usable, MU, STEPS), together)


@pytest.mark.parametrize("binning", [1, 2])
def test_tiles_of_columns_change_no_value_beyond_rounding(random_psi, monkeypatch, binning):
    psi, frames, usable = captured(random_psi, 2, 1, binning)
    together = few_steps(psi, frames, usable, MU, 2)
    monkeypatch.setattr(wave, "TILE_BYTES", 1)
    monkeypatch.setattr(wave, "LEAST_TILE", 1)
    in_tiles = few_steps(psi, frames, usable, MU, 2)
    assert len(wave._tiles(psi, 2)) > 3
    np.testing.assert_allclose(in_tiles, together, atol=1e-6)
