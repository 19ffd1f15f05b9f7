"""Psi in PyTorch, with gradients, and as a physics of deepinv (extra `torch`).

    psi = camera.psi(size).to_torch()                  # TorchPsi: psi(light_field), psi.adjoint
    psi = camera_psi(camera, size, cells, offset_um)   # gradients of masks' cells and places
    physics = physics(camera.psi(size))                # deepinv's solvers and networks

Importing it raises SensingError where PyTorch is not installed; the core never imports it.
"""

from importlib.util import find_spec

from emmc_rig.model.errors import SensingError

if find_spec("torch") is None:
    raise SensingError('Psi in PyTorch needs torch: pip install "emmc-rig[torch]"')

from emmc_rig.torch.camera_psi import camera_psi, drawn_cells
from emmc_rig.torch.operator import TorchPsi, physics

__all__ = ["TorchPsi", "camera_psi", "drawn_cells", "physics"]
