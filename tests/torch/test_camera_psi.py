"""Psi as a function of masks' cells and places: the camera's own Psi, and its gradients."""

import numpy as np
import pytest

import emmc_rig as emmc
from emmc_rig.model.camera import shipped_cameras

torch = pytest.importorskip("torch", reason="needs the extra `torch`")

from emmc_rig.torch import camera_psi, drawn_cells  # noqa: E402

SIZE = (12, 18)
CODE = {
    "distance_mm": 0.5,
    "cell_um": 30,
    "pattern": {"kind": "uniform_colour", "seed": 1, "redraw": True},
}
FAR = {"distance_mm": 20, "cell_um": 1200, "pattern": {"kind": "random_binary", "seed": 2}}
OTHERS = {
    "two masks whose cells are seen in part": {"masks": {"code": CODE, "far": FAR}},
    "a round pupil with a rim": {
        "masks": {"code": CODE},
        "lens": {
            "pupil": {"diameter_mm": 21, "rim": {"diameter_mm": 23, "shift": 2}},
        },
    },
    "points of pixels and apertures": {
        "masks": {"code": CODE},
        "lens": {"aperture_fill": 0},
        "sensor": {"pixel_fill": 0},
    },
    "binned pixels, filters, shots that move": {
        "masks": {"code": CODE, "far": FAR},
        "sensor": {"cfa": "rggb", "binning": 2},
        "shots": [
            {"masks": ["code"], "offset_um": {"code": [11, -7]}},
            {"masks": [], "filter": "green"},
            {"offset_um": {"far": [100, 40]}},
        ],
    },
}


def camera(**described):
    return emmc.camera({"title": "test", **described})


def require_equal(found, psi):
    expected = psi.to_torch()
    gap = (found.weights - expected.weights).abs().max()
    assert gap < 1e-5 * expected.weights.max()
    assert found.binning == expected.binning
    assert (found.colour is None) == (expected.colour is None)
    assert found.colour is None or bool((found.colour == expected.colour).all())


@pytest.mark.parametrize("name", shipped_cameras())
def test_it_is_the_psi_of_every_shipped_camera(name):
    shipped = emmc.camera(name)
    require_equal(camera_psi(shipped, SIZE), shipped.psi(SIZE))


@pytest.mark.parametrize("name", OTHERS)
def test_it_is_the_psi_of_cameras_with(name):
    described = camera(**OTHERS[name])
    require_equal(camera_psi(described, SIZE), described.psi(SIZE))


def test_a_place_is_the_offset_of_every_shot():
    moved = {"code": (9.5, -4.25)}
    shots = [{"offset_um": {"code": [3, 5]}}, {}]
    there = [{"offset_um": {"code": [12.5, 0.75]}}, {"offset_um": moved}]
    place = {name: torch.tensor(at) for name, at in moved.items()}
    # The pattern of a larger offset has more cells: those that the first camera's lack are spare.
    cells = drawn_cells(camera(masks={"code": CODE}, shots=there), SIZE)
    found = camera_psi(camera(masks={"code": CODE}, shots=shots), SIZE, cells, place)
    require_equal(found, camera(masks={"code": CODE}, shots=there).psi(SIZE))


def test_cells_are_those_of_a_mask_given_cell_by_cell():
    grey = np.random.default_rng(3).random((5, 5)).astype(np.float32)
    aperture = {"distance_mm": 50, "cell_um": 5000}
    given = camera(
        masks={"a": {**aperture, "pattern": {"kind": "parameters", "cells": grey.tolist()}}}
    )
    opened = camera(masks={"a": {**aperture, "pattern": {"kind": "open"}}})
    require_equal(camera_psi(opened, SIZE, {"a": torch.tensor(grey)}), given.psi(SIZE))


@pytest.mark.parametrize(
    "kind", ["a round pupil with a rim", "binned pixels, filters, shots that move"]
)
def test_weights_have_the_gradients_of_cells_and_place(kind):
    described = camera(**OTHERS[kind], views=(2, 2))
    size = (2, 4)
    cells = {name: values.double() for name, values in drawn_cells(described, size).items()}
    place = torch.tensor([3.1, -2.3], dtype=torch.double, requires_grad=True)
    chosen = cells["code"].clone().requires_grad_()

    def weights(code, at):
        return camera_psi(described, size, {**cells, "code": code}, {"code": at}).weights

    torch.autograd.gradcheck(weights, (chosen, place), fast_mode=True)
    torch.autograd.gradcheck(lambda at: weights(cells["code"], at), (place,))
    assert all(
        (grad != 0).any()
        for grad in torch.autograd.grad(weights(chosen, place).square().sum(), (chosen, place))
    )


@pytest.mark.slow
def test_a_displaced_mask_is_located_by_gradient():
    described = camera(masks={"code": CODE}, sensor={"cfa": "rggb"})
    true_um = torch.tensor([7.0, -11.0])
    cells = drawn_cells(described, SIZE)
    white = torch.ones(5, 5, *SIZE, 3)
    frames = camera_psi(described, SIZE, cells, {"code": true_um})(white)
    place = torch.zeros(2, requires_grad=True)
    adam = torch.optim.Adam([place], lr=1)
    for _ in range(80):
        adam.zero_grad()
        seen = camera_psi(described, SIZE, cells, {"code": place})(white)
        (seen - frames).square().mean().backward()
        adam.step()
    assert (place.detach() - true_um).abs().max() < 0.5


def test_masks_that_cannot_be_are_refused():
    described = camera(masks={"code": CODE})
    with pytest.raises(emmc.ERRORS, match="no mask 'cod': did you mean 'code'"):
        camera_psi(described, SIZE, offset_um={"cod": torch.zeros(2)})
    with pytest.raises(emmc.ERRORS, match="smaller than the beam"):
        camera_psi(described, SIZE, offset_um={"code": torch.tensor([0.0, 900.0])})
