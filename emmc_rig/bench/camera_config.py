"""The configuration of a camera: a short `KIND:ADDRESS`, or a YAML file with more settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from emmc_rig.errors import AppError
from emmc_rig.model.json_text import shown_path
from emmc_rig.model.reading import read_yaml
from emmc_rig.model.settings import Settings


@dataclass(frozen=True)
class CameraChoice:
    """A kind of camera, which one of its kind, and its other settings; `source` for messages."""

    kind: str
    address: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    source: str = ""


class MicroManagerCameraConfig(Settings):
    """A camera of a Micro-Manager configuration; see `drivers.micromanager.CameraSetup`."""

    label: str = ""
    cfa: Annotated[str, Field(pattern="^(mono|rggb|grbg|gbrg|bggr)$")] = "mono"
    black_level_dn: Annotated[int, Field(ge=0)] = 0
    bit_depth: Annotated[int, Field(gt=0, le=16)] | None = None
    binning: Annotated[int, Field(gt=0)] | None = None
    roi: tuple[int, int, int, int] | None = None
    properties: dict[str, str | int | float] = Field(default_factory=dict)


class GphotoCameraConfig(Settings):
    """A camera of libgphoto2; see `drivers.gphoto.GphotoCamera`."""

    model: str = ""
    settings: dict[str, str | int | float] = Field(default_factory=dict)
    delete: bool = False


def parse_camera(spec: str) -> CameraChoice:
    """Return the camera that `KIND:ADDRESS` or the name of a YAML file describes.

    The file holds `kind`, `address` and what that kind takes. Raises AppError with one line.
    """
    if not spec.endswith((".yaml", ".yml")) or ":" in spec:
        kind, _, address = spec.partition(":")
        return CameraChoice(kind, address, source=f"--camera {shown_path(spec)}")
    read = read_yaml(Path(spec), AppError)
    if not isinstance(read, dict) or not isinstance(read.get("kind"), str):
        raise AppError(
            f"{shown_path(spec)}: expected settings of a camera with its kind, such as kind: mm"
        )
    options = {str(key): value for key, value in read.items()}
    kind, address = options.pop("kind"), str(options.pop("address", ""))
    return CameraChoice(kind, address, options, shown_path(spec))
