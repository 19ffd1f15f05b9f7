"""Psi as a physics of deepinv: its tests, exact data steps, plug-and-play; the examples."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from peer_deepinv import deepinv, torch

import emmc_rig as emmc
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.torch import physics

PAGE = Path(__file__).parents[2] / "docs" / "torch.md"
EXAMPLES = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text("utf-8"), re.M | re.S)

pytestmark = pytest.mark.peers


@pytest.fixture(scope="module")
def psi():
    return emmc.camera("rgbw-bayer-3shots").psi((16, 24))


@pytest.fixture(scope="module")
def operator(psi):
    return physics(psi)


def images(operator, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(2, *operator.img_size, generator=generator)


def test_deepinvs_own_tests_of_adjoint_and_norm_pass(psi, operator):
    assert operator.adjointness_test(images(operator), num_samples=64) < 1e-6
    largest = np.linalg.eigvalsh(psi.gram.transpose(2, 3, 0, 1)).max()
    norm = operator.compute_norm(images(operator)[:1], squared=False, verbose=False, tol=1e-6)
    assert float(norm) == pytest.approx(largest**0.5, rel=1e-2)


def test_images_are_the_views_of_a_light_field(psi, operator):
    light_field = np.random.default_rng(0).random(psi.light_field_shape, dtype=np.float32)
    x = operator.images(torch.tensor(light_field)[None])
    assert bool((x[0, 1, 7] == torch.tensor(light_field[1, 2, :, :, 1])).all())
    np.testing.assert_allclose(operator.A(x)[0], psi.forward(light_field), rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(operator.light_field(x)[0], light_field)


def test_the_data_step_is_the_one_that_deepinv_iterates_for(psi):
    operator = physics(psi).double()
    z, y = (images(operator, seed).double() for seed in (0, 1))
    y = operator.A(y)
    exact = operator.prox_l2(z, y, 30.0)
    iterated = deepinv.physics.LinearPhysics.prox_l2
    found = iterated(operator, z, y, 30.0, solver="lsqr", max_iter=300, tol=1e-12)
    assert (exact - found).norm() < 1e-10 * (exact - z).norm()
    each = operator.prox_l2(z, y, torch.tensor([30.0, 3.0]))
    torch.testing.assert_close(each[0], exact[0])
    torch.testing.assert_close(each[1], operator.prox_l2(z, y, 3.0)[1])
    torch.testing.assert_close(operator.prox_l2(None, y, 3.0), operator.prox_l2(0 * z, y, 3.0))


def test_the_pseudo_inverse_explains_the_frames_and_is_the_smallest(operator):
    x = images(operator)
    y = operator.A(x)
    found = operator.A_dagger(y)
    torch.testing.assert_close(operator.A(found), y, rtol=1e-3, atol=1e-5)
    assert found.norm() < x.norm()
    torch.testing.assert_close(operator.A_dagger(operator.A(found)), found, rtol=1e-3, atol=1e-3)


def test_another_type_and_other_weights_are_followed(psi):
    operator = physics(psi)
    x = images(operator)
    y = operator.A(x)
    assert operator.double().A_dagger(y.double()).dtype == torch.double
    operator.update(weights=2 * operator.psi.weights)
    torch.testing.assert_close(operator.A(x.double()), 2 * y.double(), rtol=1e-4, atol=1e-6)


def test_without_deepinv_a_line_names_the_extra(psi, monkeypatch):
    monkeypatch.setitem(sys.modules, "deepinv", None)
    with pytest.raises(emmc.ERRORS, match=r'needs deepinv: pip install "emmc-rig\[torch\]"$'):
        physics(psi)


def test_readings_that_are_not_usable_are_ignored(psi):
    usable = np.random.default_rng(0).random(psi.frames_shape) < 0.8
    operator = physics(psi, usable=usable)
    y = operator.A(images(operator))
    wrong = torch.where(torch.tensor(usable), y, 7.0)
    torch.testing.assert_close(operator.A_dagger(wrong), operator.A_dagger(y))
    z = images(operator, 2)
    torch.testing.assert_close(operator.prox_l2(z, wrong, 9.0), operator.prox_l2(z, y, 9.0))


def test_deepinvs_total_variation_in_plug_and_play_gains_on_the_start():
    camera, scene = emmc.camera("rgbw-mono-3shots"), emmc.scene("near-planar", size=(32, 48))
    taken = camera.psi(scene.size)
    frames = camera.expose(scene, seed=0, psi=taken)
    operator = physics(taken, usable=frames.usable)
    y = torch.tensor(frames.readings, dtype=torch.float32)[None]
    start = torch.full_like(operator.A_adjoint(y), float(y.mean()))
    denoiser = deepinv.models.TimeAgnosticNet(deepinv.models.TVDenoiser(n_it_max=30))
    sigmas = np.geomspace(1, 0.02, 12)
    solver = deepinv.optim.HQS(
        data_fidelity=deepinv.optim.L2(),
        prior=deepinv.optim.PnP(denoiser),
        g_param=sigmas.tolist(),
        stepsize=((sigmas / np.median(frames.deviation)) ** 2).tolist(),
        max_iter=len(sigmas),
        custom_init=lambda readings, _: start,
    )
    with torch.no_grad():
        found, plain = solver(y, operator), operator.A_dagger(y)
    truth = np.asarray(scene)
    reached, of_start, of_plain = (
        psnr_db(operator.light_field(x)[0].numpy(), truth) for x in (found, start, plain)
    )
    assert reached > max(of_start, of_plain) + 3


def run(text, capsys):
    """Run an example, which prints what the page says, to 0.1 dB; return its names."""
    names: dict = {}
    exec(compile(text, str(PAGE), "exec"), names)
    printed = capsys.readouterr().out.strip()
    numbers = r"\d+\.\d"
    words = re.escape(re.sub(numbers, "@", printed)).replace("@", f"({numbers})")
    stated = re.search(f"`{words}`", PAGE.read_text("utf-8"))
    assert stated is not None, printed
    found = [float(number) for number in re.findall(numbers, printed)]
    np.testing.assert_allclose([float(number) for number in stated.groups()], found, atol=0.11)
    return names


def test_the_page_learns_the_cells_of_a_mask_in_40_lines(capsys):
    assert len(EXAMPLES[0].splitlines()) <= 40
    names = run(EXAMPLES[0], capsys)
    cells = {name: values.detach().sigmoid() for name, values in names["logits"].items()}
    reached = names["psnr_db"](names["error"](cells))
    assert reached > names["psnr_db"](names["errors"][0]) + 1.5


def test_the_page_runs_a_denoiser_of_ones_own(capsys):
    names = run(EXAMPLES[1], capsys)
    plain = names["operator"].A_dagger(names["readings"])
    plain_db = psnr_db(names["operator"].light_field(plain)[0].numpy(), names["scene"].light_field)
    assert psnr_db(names["light_field"], names["scene"].light_field) > plain_db + 8
