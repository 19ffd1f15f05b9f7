"""Products by digest: a result folder states what each of its products follows from.

    product.json   by kind of product: its digest, inputs, versions, and when it was made

The digest is the same for the same kind and inputs while the program computes the same from them.
Jobs and points of studies are known by their digest, too, see `emmc_rig.store.jobs`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python

from emmc_rig.model.files import write_text
from emmc_rig.model.json_text import parse_json
from emmc_rig.version import NUMERICS, __version__

PRODUCT = "product.json"
JOB_HASH = partial(hashlib.blake2b, digest_size=12)


@dataclass(frozen=True)
class Product:
    """What a product follows from; numerics: `NUMERICS` of the program that made it."""

    kind: str
    digest: str
    inputs: Mapping[str, Any]
    numerics: int
    version: str
    made: str


def digest_of(inputs: Mapping[str, Any], hashed: Callable[[bytes], Any] = JOB_HASH) -> str:
    """Return a digest of plain data, the same for equal content in any order of keys.

    hashed: the hash function. Jobs and studies of earlier versions are stored under digests of
    JOB_HASH, products under SHA-256; with another function the program would not find them.
    """
    return hashed(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def product_digest(kind: str, inputs: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a kind of product, its inputs and `NUMERICS`; keys in any order.

    inputs: plain data, settings, dataclasses, paths. Raises ValueError for anything else.
    """
    what = to_jsonable_python({"kind": kind, "inputs": inputs, "numerics": NUMERICS})
    return digest_of(what, hashlib.sha256)


def record_product(folder: Path, kind: str, inputs: Mapping[str, Any]) -> Product:
    """State in a folder that its product of this kind follows from these inputs; return that.

    What the folder states of other kinds stays. Raises OSError and ValueError.
    """
    now = datetime.now(UTC).astimezone().isoformat(timespec="seconds")
    plain = to_jsonable_python(inputs)
    product = Product(kind, product_digest(kind, inputs), plain, NUMERICS, __version__, now)
    text = json.dumps({**_stated(folder), kind: asdict(product)}, indent=1)
    write_text(folder / PRODUCT, f"{text}\n")
    return product


def read_product(folder: Path, kind: str) -> Product | None:
    """Return what a folder states of its product of this kind; None where it states nothing."""
    try:
        return Product(**_stated(folder)[kind])
    except (KeyError, TypeError):
        return None


def _stated(folder: Path) -> dict[str, Any]:
    try:
        stated = parse_json((folder / PRODUCT).read_bytes(), PRODUCT, ValueError)
    except (OSError, ValueError):
        return {}
    return stated if isinstance(stated, dict) else {}
