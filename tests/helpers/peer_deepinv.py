"""Importing this module imports deepinv, or skips tests where the extra `torch` is not installed.

PyPI's torchvision, which deepinv imports, needs PyPI's build of PyTorch. With a build for CPUs the
compiled operators of torchvision are missing: the import of torchvision fails. A declaration of two
operators lets the import pass. Neither deepinv's solvers nor the tests call the operators.
"""

import pytest

torch = pytest.importorskip("torch", reason="needs the extra `torch`")

try:
    import torchvision  # noqa: F401
except ImportError:
    pytest.skip("needs torchvision: extra `torch`", allow_module_level=True)
except RuntimeError:
    for name in ("nms", "qnms"):
        torch.library.define(
            f"torchvision::{name}",
            "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
        )

deepinv = pytest.importorskip("deepinv", reason="needs the extra `torch`")
