"""Products by digest."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from emmc_rig.store import products
from emmc_rig.store.products import (
    PRODUCT,
    digest_of,
    product_digest,
    read_product,
    record_product,
)

INPUTS = {"frames": ["ab", "cd"], "settings": {"method": "parametric", "window": (3, 5)}}


@dataclass(frozen=True)
class Given:
    path: Path
    share: float


def test_a_digest_is_the_sha_256_of_canonical_json(monkeypatch):
    monkeypatch.setattr(products, "NUMERICS", 7)
    text = '{"inputs": {"a": [1, 2.5], "b": "x"}, "kind": "psi", "numerics": 7}'
    assert product_digest("psi", {"b": "x", "a": (1, 2.5)}) == (
        hashlib.sha256(text.encode()).hexdigest()
    )


def test_jobs_and_studies_of_earlier_versions_are_stored_under_the_same_digest():
    text = '{"a": [2], "b": {"10": null, "9": 0.5}}'
    expected = hashlib.blake2b(text.encode(), digest_size=12).hexdigest()
    assert digest_of({"b": {"9": 0.5, "10": None}, "a": (2,)}) == expected


def test_a_digest_depends_on_kind_inputs_and_numerics_alone(monkeypatch):
    digest = product_digest("psi", INPUTS)
    assert digest == product_digest("psi", dict(reversed(INPUTS.items())))
    assert digest != product_digest("readings", INPUTS)
    assert digest != product_digest("psi", {**INPUTS, "frames": ["ab", "ce"]})
    monkeypatch.setattr(products, "NUMERICS", products.NUMERICS + 1)
    assert digest != product_digest("psi", INPUTS)


def test_a_folder_states_each_kind_of_product_it_holds(tmp_path):
    given = Given(Path("a/b"), 0.25)
    psi = record_product(tmp_path, "psi", INPUTS)
    field = record_product(tmp_path, "light field", {"given": given})
    assert psi.digest == product_digest("psi", INPUTS)
    assert read_product(tmp_path, "psi") == json_of(psi)
    assert read_product(tmp_path, "light field") == field
    assert field.inputs == {"given": {"path": "a/b", "share": 0.25}}
    assert read_product(tmp_path, "readings") is None


def json_of(product):
    return type(product)(**json.loads(json.dumps(vars(product))))


@pytest.mark.parametrize("text", ["", "[]", "{", '{"psi": 1}', '{"psi": {"kind": "psi"}}'])
def test_a_damaged_statement_states_nothing_and_is_replaced(tmp_path, text):
    (tmp_path / PRODUCT).write_text(text)
    assert read_product(tmp_path, "psi") is None
    record_product(tmp_path, "psi", INPUTS)
    assert read_product(tmp_path, "psi") is not None
