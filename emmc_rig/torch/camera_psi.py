"""Psi of a camera as a function of its masks' cells and places, with gradients (PyTorch)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from emmc_rig.model.camera import (
    BeamAxis,
    BeamField,
    Camera,
    beam_fields,
    draw_plates,
    open_shares,
    psi_layout,
)
from emmc_rig.model.errors import CameraError, nearest_of
from emmc_rig.model.geometry import SMALLEST_SHARE, covered, require_reach
from emmc_rig.model.pupil import LEAST_SHARE
from emmc_rig.torch.operator import TorchPsi, stored_colour


class _Mask(NamedTuple):
    """A mask in one shot: cells (colour, row, column), and its place (x, y)."""

    cells: Tensor
    cell_um: float
    distance_um: float
    offset_um: Tensor


def drawn_cells(camera: Camera, size: tuple[int, int]) -> dict[str, Tensor]:
    """Return the cells (frame, row, column, colour) of every mask as manufactured, float32."""
    return {name: torch.tensor(plate.cells) for name, plate in draw_plates(camera, size).items()}


def camera_psi(
    camera: Camera,
    size: tuple[int, int],
    cells: Mapping[str, Tensor] | None = None,
    offset_um: Mapping[str, Tensor] | None = None,
) -> TorchPsi:
    """Return `camera.psi(size)` with gradients of its masks' transmittance and place.

    The weights have the type and device of the first tensor given; else float32, on the CPU. With
    `pixel_fill` and `aperture_fill` 0 the gradient of a place is 0: points see one cell alone.

    Args:
        camera: its description.
        size: rows and columns of samples.
        cells: transmittances by mask, (frame, row, column, colour) as `drawn_cells` returns them,
            or greys (row, column). Other masks are as manufactured.
        offset_um: by mask, (x, y) beyond the shots' own.

    Raises:
        CameraError: a mask that the camera does not have, or that is smaller than the beam; pixels
            that do not divide the size.
    """
    cells, offset_um = dict(cells or {}), dict(offset_um or {})
    for name in {*cells, *offset_um} - set(camera.masks):
        raise CameraError(f"no mask '{name}': {nearest_of(name, camera.masks)}")
    layout, fields = psi_layout(camera, size), beam_fields(camera, size)
    like = next(iter((*cells.values(), *offset_um.values())), torch.empty(0))
    colour = layout.colour
    if colour is not None:
        colour = torch.tensor(colour, device=like.device).long()
    if set(cells) != set(camera.masks):
        cells = drawn_cells(camera, size) | cells
    weights = []
    for shot, share in enumerate(open_shares(camera, size)):
        masks = {}
        for name in camera.shot_masks(shot):
            mask, given = camera.masks[name], cells[name].to(like)
            grey = given.ndim == 2
            frame = given.expand(3, -1, -1) if grey else given[shot % len(given)].movedim(-1, 0)
            place = torch.tensor(camera.shots[shot].offset_um.get(name, (0, 0)), dtype=torch.double)
            place = place.to(like.device) + offset_um.get(name, 0)
            masks[name] = _Mask(frame, mask.cell_um, mask.distance_mm * 1e3, place)
        passed = _transmittance(camera, size, fields, masks, like)
        opened = passed * torch.from_numpy(share).to(like).movedim(-1, 0)
        weights.append(stored_colour(opened.movedim(2, 3), colour, shot))
    return TorchPsi(torch.stack(weights), colour, layout.binning)


def _transmittance(
    camera: Camera,
    size: tuple[int, int],
    fields: list[BeamField],
    masks: dict[str, _Mask],
    like: Tensor,
) -> Tensor:
    """Return the transmittance (v, u, colour, y, x) of all masks together, of one shot.

    It is V U / (sum of the shares of all views) sum_boxes share_box t_box, with

        t[y, x] = k^-4 sum over the parts of sample and opening, along y and along x, of
                  prod_m sum_ij D_m[y, i] cells_m[i, j] R_m[x, j],

    see `emmc_rig.model.camera`.
    """
    everything = np.zeros(size)
    views = {view: like.new_zeros(3, *size) for view in np.ndindex(camera.views)}
    for field in fields:
        everything[field.rows, field.columns] += field.blend * field.open
        blend = torch.as_tensor(field.blend).to(like)
        down, right = _parts(camera, field, masks, like)
        shape = 3, len(field.axes[0].samples_um), len(field.axes[1].samples_um)
        for view, boxes in field.boxes.items():
            for box in boxes:
                for of_rows in down:
                    for of_columns in right:
                        seen = (blend * box.share / len(down) ** 2).expand(shape)
                        for name, mask in masks.items():
                            rows = of_rows[name][box.down] @ mask.cells
                            seen = seen * (rows @ of_columns[name][box.across].T)
                        views[view][:, field.rows, field.columns] += seen
    scale = np.prod(camera.views) / np.maximum(everything, LEAST_SHARE)
    stacked = torch.stack(list(views.values())).unflatten(0, camera.views)
    return stacked * torch.from_numpy(scale).to(like)


def _parts(
    camera: Camera, field: BeamField, masks: dict[str, _Mask], like: Tensor
) -> list[list[dict[str, Tensor]]]:
    """Return D and R: along y and x, of every part of sample and opening, of every mask.

    There is one part, or `footprint_splits` squared where two masks' cells are seen in part.
    """

    def seen(axis: int, along: BeamAxis) -> dict[str, Tensor]:
        return {name: _cells_seen(along, mask, axis).to(like) for name, mask in masks.items()}

    whole = [seen(axis, along) for axis, along in enumerate(field.axes)]
    split = [
        any(bool(((side[name] > SMALLEST_SHARE).sum(-1) > 1).any()) for side in whole)
        for name in masks
    ]
    if sum(split) <= 1:
        return [[side] for side in whole]
    k = camera.footprint_splits
    return [
        [seen(axis, along.split(k, *part)) for part in np.ndindex(k, k)]
        for axis, along in enumerate(field.axes)
    ]


def _cells_seen(along: BeamAxis, mask: _Mask, axis: int) -> Tensor:
    """Return (opening, sample, cell): the share of every cell that is seen; axis: 0: y, 1: x."""
    count, offset_um = mask.cells.shape[1 + axis], mask.offset_um[1 - axis]
    edges_um = (torch.arange(count + 1).to(offset_um) - count / 2) * mask.cell_um
    seen = []
    for opening in range(len(along.openings_um)):
        meets_um = torch.from_numpy(along.meets_um(mask.distance_um, opening)).to(offset_um)
        footprint, places_um = along.footprint(mask.distance_um, opening), meets_um - offset_um
        require_reach(float(places_um.detach().abs().max()), footprint, mask.cell_um, count)
        seen.append(covered(edges_um - places_um[:, None], footprint).diff(dim=-1))
    return torch.stack(seen)
