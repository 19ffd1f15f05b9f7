"""The configuration of a camera: a short `DRIVER:ADDRESS`, or a YAML file with more settings."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import Field, create_model

from emmc_rig.errors import AppError
from emmc_rig.model.json_text import shown_path
from emmc_rig.model.reading import read_yaml
from emmc_rig.model.settings import Settings

DRIVER_KEYS = ("driver", "kind")
"""Of a camera's YAML file: the name of its driver, now and in earlier versions."""


@dataclass(frozen=True)
class CameraChoice:
    """A driver, which of its cameras, and its other settings; `source` for messages."""

    driver: str
    address: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    source: str = ""


def settings_of(kind: type[Any]) -> type[Settings]:
    """Return the model that reads a driver's dataclass of options, and refuses unknown keys."""
    hints = get_type_hints(kind, include_extras=True)
    found: dict[str, Any] = {
        one.name: (
            hints[one.name],
            one.default
            if one.default_factory is MISSING
            else Field(default_factory=one.default_factory),
        )
        for one in fields(kind)
    }
    return create_model(kind.__name__, __base__=Settings, **found)


def parse_camera(spec: str) -> CameraChoice:
    """Return the camera that `DRIVER:ADDRESS` or the name of a YAML file describes.

    The file holds `driver` (in earlier versions `kind`), `address` and what that driver takes.
    Raises AppError with one line.
    """
    if not spec.endswith((".yaml", ".yml")) or ":" in spec:
        driver, _, address = spec.partition(":")
        return CameraChoice(driver, address, source=f"camera {shown_path(spec)}")
    read = read_yaml(Path(spec), AppError)
    options = {str(key): value for key, value in read.items()} if isinstance(read, dict) else {}
    named = next((key for key in DRIVER_KEYS if isinstance(options.get(key), str)), None)
    if named is None:
        raise AppError(f"{shown_path(spec)}: name the camera's driver, such as driver: mm")
    driver, address = options.pop(named), str(options.pop("address", ""))
    return CameraChoice(driver, address, options, shown_path(spec))
