"""The weights of a network in a file: architecture, provenance, SHA-256."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.files import whole_file
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.reading import one_line, stored_arrays
from emmc_rig.model.settings import Settings, validated
from emmc_rig.reconstruction.errors import ReconstructionError

FORMAT = "emmc-rig network 1"
REMEDY = "`benchmarks/train_network.py` makes one"


class Architecture(Settings):
    """Size of a network. views: rows and columns of views."""

    views: tuple[int, int] = (5, 5)
    channels: int = Field(default=32, ge=1, le=256)
    blocks: int = Field(default=3, ge=1, le=16, description="of a stage")
    stages: int = Field(default=4, ge=1, le=5)


@dataclass(frozen=True, eq=False)
class NetworkWeights:
    """arrays: by the names of the network's parameters. provenance: how they were trained, JSON."""

    architecture: Architecture
    arrays: Mapping[str, NDArray[np.float32]]
    provenance: str

    def checksum(self) -> str:
        """Return the SHA-256 of architecture, arrays and provenance."""
        about = f"{FORMAT}|{self.architecture.model_dump_json()}|{self.provenance}"
        digest = hashlib.sha256(about.encode(errors="surrogatepass"))
        for name in sorted(self.arrays):
            digest.update(f"{name}{self.arrays[name].shape}".encode(errors="surrogatepass"))
            digest.update(np.ascontiguousarray(self.arrays[name], np.float32).tobytes())
        return digest.hexdigest()

    def save(self, path: Path) -> None:
        """Write HDF5, whole or not at all; raises ReconstructionError."""
        try:
            with whole_file(path) as partial, h5py.File(partial, "w") as file:
                file.attrs.update(
                    format=FORMAT,
                    architecture=self.architecture.model_dump_json(),
                    sha256=self.checksum(),
                )
                file["provenance"] = self.provenance
                file["names"] = json.dumps(list(self.arrays))
                for number, array in enumerate(self.arrays.values()):
                    file[f"array{number}"] = array
        except OSError as fault:
            raise ReconstructionError(f"{path}: cannot be written ({one_line(fault)})") from fault

    @classmethod
    def load(cls, path: Path) -> NetworkWeights:
        """Read what `save` wrote; raises ReconstructionError for what is none, or was changed."""
        with stored_arrays(path, ReconstructionError, REMEDY) as stored:
            if stored.attributes.get("format") != FORMAT:
                raise ReconstructionError(f"{path}: no network of this program; {REMEDY}")
            about, names = (
                parse_json(text, str(path), ReconstructionError)
                for text in (str(stored.attributes["architecture"]), stored.text("names"))
            )
            arrays = {name: stored.array(f"array{i}") for i, name in enumerate(names)}
            provenance, expected = stored.text("provenance"), stored.attributes["sha256"]
        architecture = validated(Architecture, about, str(path), ReconstructionError)
        loaded = cls(architecture, arrays, provenance)
        if loaded.checksum() != expected:
            raise ReconstructionError(
                f"{path}: changed since it was written (its SHA-256 differs); {REMEDY}"
            )
        return loaded
