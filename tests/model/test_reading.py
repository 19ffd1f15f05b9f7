"""Files from outside: whatever is in them becomes data, or one line of the caller's error.

EMMC_FUZZ multiplies the number of inputs of each kind.
"""

import io
import resource
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from fuzzing import FUZZ
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from view_files import png

from emmc_rig.bench.rig_config import RealRig
from emmc_rig.captures.plan import Plan
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.errors import CameraError, SceneError, SensingError
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.lightfield import load_hdf5, load_views
from emmc_rig.model.masks import Picture
from emmc_rig.model.reading import parse_yaml, read_yaml, stored_arrays
from emmc_rig.model.sensing import Psi
from emmc_rig.model.settings import validated
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.reconstruction.errors import DictionaryError
from emmc_rig.reconstruction.methods import MethodSettings

fuzzed = settings(
    max_examples=150 * FUZZ, deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)  # fmt: skip


def one_line(fault):
    text = str(fault.value)
    assert "\n" not in text
    return text


def done_or_refused(call, error):
    """Return whether a call succeeds; the only exception allowed is `error`, of one line."""
    try:
        call()
    except error as fault:
        if "\n" in str(fault):
            pytest.fail(f"more than one line: {fault}")
        return False
    return True


# YAML


BOMB = "a: &a [1,1,1,1,1,1,1,1,1,1]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 10)}]\n" for old, new in pairwise("abcdefghi")
)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a: 1\na: 2\n", "line 2: the key 'a' is there twice"),
        ("a: {b: 1, b: 2}\n", "the key 'b' is there twice"),
        ("[" * 5000, "nest"),
        ("[" * 200, "nested too deeply"),
        ("a: &a [*a]\n", "more than 1000000 values"),
        (BOMB, "more than 1000000 values"),
        ("a: 1: 2", "not valid YAML at line 1"),
        ("\x00", "not valid YAML"),
        ("? [1]\n: 2\n? {a: 1}\n: 3", "not valid YAML"),
    ],
)  # fmt: skip
def test_yaml_that_is_no_settings_file_is_refused_in_one_line(text, complaint):
    with pytest.raises(AppError) as fault:
        parse_yaml(text, "plan.yaml", AppError)
    assert complaint in one_line(fault)
    assert one_line(fault).startswith("plan.yaml: ")


def test_aliases_that_stay_small_are_welcome():
    read = parse_yaml("a: &a [1, 2]\nb: *a\nc: {<<: {d: 1}}\n", "x", AppError)
    assert read == {"a": [1, 2], "b": [1, 2], "c": {"d": 1}}


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (None, "holds nothing"),
        ([1], "holds a list"),
        (3, "holds a number"),
        ({"title": "t", "sensor": {"binning": True}}, "binning: a number is meant, not true"),
        ({"title": "t", "views": [True, 3]}, "views: a number is meant"),
        ({"title": "t", "masks": None}, "masks: input should be a mapping"),
        ({"title": "t", "views": 5}, "views: input should be a list"),
        ({"title": 5}, "title: input should be text"),
        ({"\n": 5}, "unknown key"),
    ],
)
def test_settings_of_a_wrong_kind_are_named_in_words_of_the_file(data, complaint):
    with pytest.raises(CameraError) as fault:
        validated(Camera, data, "mine.yaml", CameraError)
    assert complaint in one_line(fault)


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner,
                                                               max_size=4),
    max_leaves=12,
)  # fmt: skip


def keys_of(schema):
    """Every key that a kind of settings knows, anywhere."""
    found = set(schema.get("properties", {}))
    for part in schema.values():
        for item in part if isinstance(part, list) else [part]:
            if isinstance(item, dict):
                found |= keys_of(item)
                found |= {key for value in item.values() if isinstance(value, dict)
                          for key in keys_of(value)}  # fmt: skip
    return found


def settings_like(kind):
    """Mappings of the keys that a kind of settings knows, holding anything."""
    known = st.sampled_from(sorted(keys_of(kind.model_json_schema())))
    leaves = plain | st.sampled_from(["open", "random_rgbw", "rggb", "rgbw-mono", 1e-300, 1e300])
    return st.recursive(
        st.dictionaries(known, leaves, max_size=6),
        lambda inner: st.dictionaries(known, inner | leaves | st.lists(inner, max_size=2),
                                      max_size=6),
        max_leaves=10,
    )  # fmt: skip


KINDS = (Camera, Plan, MethodSettings, RealRig)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_whatever_yaml_says_is_settings_or_one_line(kind):
    @fuzzed
    @given(settings_like(kind) | plain)
    def holds(data):
        text = yaml.safe_dump(data, allow_unicode=True)
        done_or_refused(
            lambda: validated(kind, parse_yaml(text, "x.yaml", AppError), "x.yaml", AppError),
            AppError,
        )

    holds()


@fuzzed
@given(st.binary(max_size=200) | st.text(max_size=200))
def test_whatever_bytes_a_file_of_settings_holds_they_are_data_or_one_line(data):
    done_or_refused(lambda: parse_yaml(data, "x", AppError), AppError)
    done_or_refused(lambda: parse_json(data, "x", AppError), AppError)


def test_json_nested_without_end_is_refused():
    with pytest.raises(AppError, match="nested too deeply"):
        parse_json("[" * 100_000, "x", AppError)


# HDF5


def opened(path):
    with stored_arrays(path, SceneError, "copy it again") as stored:
        return stored.array("light_field")


def test_a_data_set_in_another_file_is_not_followed(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["light_field"] = np.zeros(3)
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["light_field"] = h5py.ExternalLink("other.h5", "light_field")
    with pytest.raises(SceneError, match="link to elsewhere"):
        opened(tmp_path / "link.h5")
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout((3,), "f8")
        layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "light_field", (3,))
        file.create_virtual_dataset("light_field", layout)
    with pytest.raises(SceneError, match="lies in other files"):
        opened(tmp_path / "virtual.h5")
    (tmp_path / "secret").write_bytes(b"12345678")
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file.create_dataset(
            "light_field", (1,), "f8", external=[(str(tmp_path / "secret"), 0, 8)]
        )  # fmt: skip
    with pytest.raises(SceneError, match="lies in other files"):
        opened(tmp_path / "raw.h5")


READERS = {
    "light field": (load_hdf5, SceneError),
    "psi": (Psi.load, SensingError),
    "dictionary": (Dictionary.load, DictionaryError),
}
NAMES = ("light_field", "weights", "colour", "atoms", "provenance")
ATTRIBUTES = ("format", "binning", "camera", "sha256", "kind")
FORMATS = ("emmc-rig psi 1", "emmc-rig dictionary 1", "x")


@st.composite
def trees(draw):
    """An HDF5 file as bytes: data sets, groups and links under the names that readers ask for."""
    data = io.BytesIO()
    with h5py.File(data, "w") as file:
        for name in draw(st.lists(st.sampled_from(NAMES), unique=True, max_size=4)):
            kind = draw(st.sampled_from(["array", "group", "soft", "external", "text", "scalar"]))
            shape = tuple(draw(st.lists(st.integers(0, 3), max_size=6)))
            if kind == "array":
                file.create_dataset(name, shape, draw(st.sampled_from(["f4", "u1", "i8", "S3"])))
            elif kind == "group":
                file.create_group(name)
            elif kind == "soft":
                file[name] = h5py.SoftLink("/" + draw(st.sampled_from(NAMES)))
            elif kind == "external":
                file[name] = h5py.ExternalLink("/etc/passwd", "/x")
            else:
                file[name] = "text" if kind == "text" else 1.5
        for name in draw(st.lists(st.sampled_from(ATTRIBUTES), unique=True, max_size=5)):
            file.attrs[name] = draw(st.sampled_from([*FORMATS, 1, -1, 2.5, [1, 2]]))
    content = bytearray(data.getvalue())
    for _ in range(draw(st.integers(0, 3))):
        content[draw(st.integers(0, len(content) - 1))] = draw(st.integers(0, 255))
    return bytes(content[: draw(st.integers(0, len(content)))] if draw(st.booleans()) else content)


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_whatever_tree_a_file_holds_it_is_read_or_refused_in_one_line(tmp_path, reader):
    read, error = READERS[reader]

    @fuzzed
    @given(trees())
    def holds(content):
        path = tmp_path / "x.h5"
        path.write_bytes(content)
        done_or_refused(lambda: read(path), error)

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    holds()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000


# PNG


def test_a_picture_whose_header_claims_more_than_any_has_is_not_unpacked(tmp_path):
    (tmp_path / "view_0_0.png").write_bytes(png(60_000, 60_000))
    with pytest.raises(SceneError, match="60000 x 60000 pixels"):
        load_views(tmp_path)
    with pytest.raises(CameraError, match="60000 x 60000 pixels"):
        Picture(kind="picture", path=tmp_path / "view_0_0.png").draw(1, 4, 4, 10.0)


@fuzzed
@given(
    st.integers(0, 2**32 - 1) | st.integers(0, 9), st.integers(0, 2**32 - 1) | st.integers(0, 9),
    st.integers(0, 255), st.integers(0, 7), st.binary(max_size=80), st.integers(0, 200),
)  # fmt: skip
def test_whatever_a_png_claims_it_is_a_view_or_refused_in_one_line(
    tmp_path_factory, columns, rows, depth, kind, data, kept
):
    path = tmp_path_factory.getbasetemp() / "views" / "view_0_0.png"
    path.parent.mkdir(exist_ok=True)
    content = png(columns, rows, depth, kind, data)
    path.write_bytes(content[:kept] if kept % 3 == 0 else content)
    if columns * rows > 2**22 and columns * rows <= 2**28:
        return  # allowed, and large: its memory is what the header says
    done_or_refused(lambda: load_views(path.parent), SceneError)
    picture = Picture(kind="picture", path=path)
    done_or_refused(lambda: picture.draw(1, 2, 2, 10.0), CameraError)


@fuzzed
@given(st.text(max_size=400))
def test_whatever_a_path_is_called_it_is_refused_in_one_line(name):
    done_or_refused(lambda: read_yaml(Path(name), AppError), AppError)


LENGTHS = (
    ("lens", "distance_mm"), ("lens", "aperture_cell_mm"), ("sensor", "sample_pitch_um"),
    ("masks", "near", "distance_mm"), ("masks", "near", "cell_um"), ("total_exposure_s",),
    ("shots", 0, "exposure_s"), ("shots", 0, "offset_um", "near", 0),
)  # fmt: skip
EXTREMES = (-1e300, -1.0, 0, 1e-300, 1e-12, 1e-3, 1e8, 1e12, 1e300)


@pytest.mark.parametrize("value", EXTREMES)
@pytest.mark.parametrize("place", LENGTHS, ids=lambda place: place[-1])
def test_lengths_of_mistaken_units_make_a_psi_or_one_line(place, value):
    camera = {
        "title": "t",
        "lens": {},
        "sensor": {},
        "masks": {
            "near": {"distance_mm": 0.2, "cell_um": 30.0, "pattern": {"kind": "random_rgbw"}}
        },
        "shots": [{"offset_um": {"near": [0.0, 0.0]}}],
    }
    inner = camera
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value

    def built():
        psi = build_imaging_matrix(validated(Camera, camera, "x", CameraError), (8, 8))
        assert np.isfinite(psi.weights).all()

    done_or_refused(built, CameraError)
