"""GenICam features: a camera's XML is followed as EMVA's own library does, and never trusted."""

import lzma
import math
import os
import re
import struct
from collections import Counter
from contextlib import suppress
from random import Random

import numpy as np
import pytest
from fuzzing import fuzz
from hypothesis import given, settings
from hypothesis import strategies as st

from emmc_rig.drivers.errors import CameraDescriptionError, CameraSettingError, DriverError
from emmc_rig.drivers.genapi import Features
from emmc_rig.drivers.genapi_formula import Formula, FormulaError
from emmc_rig.simulators import u3v_description
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.u3v import U3vCameraSimulator

HEAD = (
    '<?xml version="1.0" encoding="utf-8"?><RegisterDescription ModelName="M" VendorName="V" '
    'StandardNameSpace="None" SchemaMajorVersion="1" SchemaMinorVersion="1" '
    'SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" SubMinorVersion="0" '
    'ProductGuid="6f9cb1e2-21b7-4c1f-9f3e-000000000001" '
    'VersionGuid="6f9cb1e2-21b7-4c1f-9f3e-000000000002" '
    'xmlns="http://www.genicam.org/GenApi/Version_1_1">'
)
TAIL = '<Port Name="Device"/></RegisterDescription>'


class Memory:
    """A port on a few bytes."""

    def __init__(self, data=bytes(64)):
        self.data = bytearray(data)

    def read(self, address, length):
        return bytes(self.data[address : address + length]).ljust(length, b"\0")

    def write(self, address, data):
        self.data[address : address + len(data)] = data


def features(body, memory=None):
    return Features((HEAD + body + TAIL).encode(), memory or Memory())


def register(name="R", kind="IntReg", address=0, length=4, more="", order="LittleEndian"):
    return (
        f'<{kind} Name="{name}"><Address>{address}</Address><Length>{length}</Length>'
        f"<AccessMode>RW</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>{more}"
        f"<Endianess>{order}</Endianess></{kind}>"
    )


RAMP = bytes(range(1, 65))


@pytest.mark.parametrize(
    ("node", "value"),
    [
        (register(), 0x04030201),
        (register(address=2, length=2, order="BigEndian"), 0x0304),
        (register(kind="FloatReg"), struct.unpack("<f", RAMP[:4])[0]),
        (register(kind="FloatReg", length=8, order="BigEndian"), struct.unpack(">d", RAMP[:8])[0]),
        (register(kind="MaskedIntReg", more="<LSB>4</LSB><MSB>11</MSB>"), 0x20),
        (register(kind="MaskedIntReg", more="<Bit>1</Bit>"), 0),
        # In big-endian registers bit 0 is the highest: bits 24 to 31 are the last byte.
        (
            register(kind="MaskedIntReg", more="<LSB>31</LSB><MSB>24</MSB>", order="BigEndian"),
            0x04,
        ),
        (
            register(kind="MaskedIntReg", more="<LSB>6</LSB><MSB>7</MSB><Sign>Signed</Sign>"),
            0,
        ),
    ],
)
def test_every_kind_of_register_is_read(node, value):
    assert features(node, Memory(RAMP)).number("R") == value


def test_a_signed_field_is_negative_where_its_top_bit_is_set():
    node = register(kind="MaskedIntReg", more="<LSB>4</LSB><MSB>7</MSB><Sign>Signed</Sign>")
    assert features(node, Memory(b"\xe0\0\0\0")).number("R") == -2


def test_writing_a_field_leaves_the_bits_around_it():
    memory = Memory(b"\xff\xff\xff\xff")
    found = features(register(kind="MaskedIntReg", more="<LSB>4</LSB><MSB>11</MSB>"), memory)
    found.set("R", 0x5A)
    assert memory.data[:4] == b"\xaf\xf5\xff\xff"


def test_an_address_may_be_a_sum_of_numbers_links_formulas_and_an_index():
    node = (
        '<IntReg Name="R"><Address>2</Address><pAddress>Base</pAddress>'
        '<IntSwissKnife Name="Inner"><pVariable Name="B">Base</pVariable><Formula>B * 2</Formula>'
        '</IntSwissKnife><pIndex Offset="3">Index</pIndex><Length>1</Length>'
        "<AccessMode>RO</AccessMode><pPort>Device</pPort></IntReg>"
        '<Integer Name="Base"><Value>0x4</Value></Integer>'
        '<Integer Name="Index"><Value>2</Value></Integer>'
    )
    assert features(node, Memory(RAMP)).number("R") == RAMP[2 + 4 + 8 + 6]


def test_a_structured_register_gives_its_fields():
    node = (
        '<StructReg Comment="two"><Address>0</Address><Length>4</Length><AccessMode>RW</AccessMode>'
        "<pPort>Device</pPort><Endianess>LittleEndian</Endianess>"
        '<StructEntry Name="Low"><LSB>0</LSB><MSB>7</MSB></StructEntry>'
        '<StructEntry Name="Next"><LSB>8</LSB><MSB>15</MSB></StructEntry></StructReg>'
    )
    found = features(node, Memory(RAMP))
    assert (found.number("Low"), found.number("Next")) == (1, 2)


CONVERTED = (
    '<Float Name="F"><pValue>C</pValue><Unit>us</Unit></Float>'
    '<Converter Name="C"><FormulaTo>ROUND(FROM * 10)</FormulaTo>'
    "<FormulaFrom>TO / 10</FormulaFrom><pValue>I</pValue></Converter>"
    '<Integer Name="I"><pValue>R</pValue><Min>5</Min><Max>1000</Max></Integer>' + register()
)


def test_a_converter_works_both_ways_and_converts_the_limits():
    memory = Memory(struct.pack("<I", 25) + bytes(60))
    found = features(CONVERTED, memory)
    assert found.value("F") == 2.5
    assert found.limits("F") == (0.5, 100.0)
    assert found.unit("F") == "us"
    found.set("F", 7.34)
    assert struct.unpack_from("<I", memory.data) == (73,)


def test_a_falling_converter_swaps_the_limits():
    body = CONVERTED.replace("TO / 10", "100 / TO")
    assert features(body).limits("F") == (0.1, 20.0)


CHOICE = (
    '<Enumeration Name="E"><pIsLocked>Lock</pIsLocked>'
    '<EnumEntry Name="Off"><Value>0</Value></EnumEntry>'
    '<EnumEntry Name="On"><Value>0x10</Value></EnumEntry>'
    '<EnumEntry Name="Gone"><pIsImplemented>No</pIsImplemented><Value>2</Value></EnumEntry>'
    "<pValue>R</pValue></Enumeration>"
    '<Integer Name="Lock"><Value>0</Value></Integer><Integer Name="No"><Value>0</Value></Integer>'
    + register()
)


def test_an_enumeration_is_read_and_set_by_name():
    memory = Memory()
    found = features(CHOICE, memory)
    assert found.choices("E") == ("Off", "On")
    found.set("E", "On")
    assert (memory.data[0], found.value("E"), found.number("E")) == (0x10, "On", 0x10)


@pytest.mark.parametrize("choice", ["Gone", "Nonsense", 16])
def test_a_choice_that_is_not_offered_is_refused_by_name(choice):
    with pytest.raises(CameraSettingError, match=f"offers Off, On, not {choice}"):
        features(CHOICE).set("E", choice)


def test_a_locked_feature_is_not_written():
    found = features(CHOICE)
    assert found.is_writable("E")
    found.set("Lock", 1)
    assert not found.is_writable("E")
    with pytest.raises(CameraSettingError, match="cannot be changed now"):
        found.set("E", "On")


def test_a_command_stores_its_value():
    memory = Memory()
    body = '<Command Name="Go"><pValue>R</pValue><CommandValue>7</CommandValue></Command>'
    features(body + register(), memory).execute("Go")
    assert memory.data[0] == 7


def test_a_number_outside_its_limits_or_steps_is_refused_before_anything_is_sent():
    memory = Memory()
    body = '<Integer Name="I"><pValue>R</pValue><Min>4</Min><Max>20</Max><Inc>4</Inc></Integer>'
    found = features(body + register(), memory)
    with pytest.raises(CameraSettingError, match="from 4 to 20, not to 24"):
        found.set("I", 24)
    with pytest.raises(CameraSettingError, match="steps of 4 from 4, not 9"):
        found.set("I", 9)
    assert memory.data == bytearray(64)
    found.set_nearest("I", 9)
    assert found.value("I") == 8
    found.set_nearest("I", 99)
    assert found.value("I") == 20


def test_texts_are_read_and_truths_set():
    body = (
        '<Boolean Name="B"><pValue>R</pValue><OnValue>3</OnValue><OffValue>1</OffValue></Boolean>'
        + register()
        + register("S", "StringReg", address=8, length=8)
    )
    memory = Memory()
    found = features(body, memory)
    found.set("B", True)
    memory.data[8:16] = b"cam 1\0\0\0"
    assert (found.value("B"), memory.data[0], found.value("S")) == (True, 3, "cam 1")


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        ('<Integer Name="X"><pValue>Y</pValue></Integer>', "has no Y"),
        ('<Integer Name="X"><pValue>X</pValue></Integer>', "circles"),
        ('<IntSwissKnife Name="X"><Formula>1 +</Formula></IntSwissKnife>', "ends too early"),
        ('<IntSwissKnife Name="X"><Formula>Q</Formula></IntSwissKnife>', "Q, which it does not"),
        ('<IntSwissKnife Name="X"><Formula>1/0</Formula></IntSwissKnife>', "no value"),
        ('<Integer Name="X"><Value>many</Value></Integer>', "worked out"),
        ('<Category Name="X"/>', "is no number"),
        (register("X", length=9), "9 bytes long"),
        (register("X", length=-1), "-1 bytes long"),
        (register("X", "MaskedIntReg", more="<LSB>0</LSB><MSB>99</MSB>"), "bits 0 to 99"),
        (register("X", "FloatReg", length=3), "worked out"),
        (register("X", address=-5), "lies at"),
    ],
)
def test_a_description_that_cannot_be_followed_is_named(body, complaint):
    with pytest.raises(CameraDescriptionError, match=complaint):
        features(body).number("X")


def test_work_that_doubles_with_every_node_is_cut_short():
    knives = "".join(
        f'<IntSwissKnife Name="K{i}"><pVariable Name="A">K{i + 1}</pVariable>'
        f'<pVariable Name="B">K{i + 1}</pVariable><Formula>A + B</Formula></IntSwissKnife>'
        for i in range(30)
    )
    with pytest.raises(CameraDescriptionError, match="too far"):
        features(knives + '<Integer Name="K30"><Value>1</Value></Integer>').number("K0")


@pytest.mark.parametrize(
    ("xml", "complaint"),
    [
        (b"", "no XML"),
        (b"<a><b></a>", "no XML"),
        (b"<Other/>", "describes a Other"),
        (b'<!DOCTYPE a [<!ENTITY e "x">]><RegisterDescription>&e;</RegisterDescription>', "type"),
        (
            b'<!DOCTYPE a SYSTEM "file:///etc/passwd"><RegisterDescription/>',
            "declares a document type",
        ),
        (b'<?xml version="1.0" encoding="klingon"?><a/>', "no XML"),
    ],
)
def test_xml_that_is_none_or_declares_entities_is_refused(xml, complaint):
    with pytest.raises(CameraDescriptionError, match=complaint):
        Features(xml, Memory())


@pytest.mark.parametrize(
    ("text", "integers", "value"),
    [
        ("1 + 2 * 3", True, 7),
        ("-7 / 2", True, -3),
        ("-7 % 3", True, -1),
        ("7 / 2", False, 3.5),
        ("0x10 + A", True, 15),
        ("(A > 0) ? 1 : 2", True, 2),
        ("1 = 1 && 2 <> 3", True, 1),
        ("SQRT(16) + LG(100) + LN(E)", False, 7.0),
        ("COS(PI)", False, -1.0),
        ("2 ** 62 * 4", True, 0),
        ("1 << 3 | 1", True, 9),
        ("~0", True, -1),
        ("1e3 + .5", False, 1000.5),
    ],
)
def test_formulas_have_the_value_of_the_standard(text, integers, value):
    assert Formula(text).value({"A": -1}.__getitem__, integers) == value


@pytest.mark.parametrize(
    "text", ["", "1 +", ")", "(1", "1 2", "@", "1 ? 2", "F(", "().__class__", "1;2", "(" * 99]
)
def test_text_that_is_no_formula_is_refused(text):
    with pytest.raises(FormulaError):
        Formula(text)


@pytest.mark.parametrize(
    "text", ["9 ** 9 ** 9 ** 9 ** 9", "1 << 99", "LN(0)", "EXP(9999)", "1 / 0", "1 % 0"]
)
@pytest.mark.parametrize("integers", [True, False])
def test_a_formula_without_bounds_or_value_ends_at_once(text, integers):
    try:
        value = Formula(text).value(lambda name: 0, integers)
    except FormulaError:
        return
    assert -(1 << 63) <= value < 1 << 63 or math.isinf(value)


SHAPE = (40, 48)


class SimulatorMemory:
    """The simulated camera's registers as a port, without the wire."""

    def __init__(self, simulator):
        self._simulator = simulator

    def read(self, address, length):
        base, offset = self._simulator._find(address, length)
        return bytes(self._simulator._regions[base][offset : offset + length])

    def write(self, address, data):
        assert self._simulator._store(address, data) == 0


def simulator():
    return U3vCameraSimulator(lambda exposure_s: np.zeros(SHAPE, np.uint16), ManualClock(), SHAPE)


def reference(xml, memory):
    """The same XML in EMVA's own library, over the same memory."""
    genapi = pytest.importorskip("genicam.genapi")

    class Port(genapi.AbstractPort):
        def read(self, address, length):
            return memory.read(address, length)

        def write(self, address, data):
            memory.write(address, bytes(data))

        def get_access_mode(self):
            return genapi.EAccessMode.RW

    nodes, port = genapi.NodeMap(), Port()
    nodes.load_xml_from_string(xml.decode())
    for name in re.findall(rb'<Port Name="([^"]+)"', xml):
        nodes.connect(port, name.decode())
    return nodes, port


NUMBERS = (
    *("Width", "Height", "OffsetX", "OffsetY", "WidthMax", "PayloadSize", "ExposureTime", "Gain"),
    *("BlackLevel", "AcquisitionFrameRate", "TLParamsLocked", "ExposureTimeRaw", "GainRaw"),
)
OPEN = ("WidthMax", "PayloadSize", "BlackLevel")
"""Without limits of their own; the library then gives the largest floats."""
CHOICES = ("PixelFormat", "AcquisitionMode", "TriggerMode", "TriggerSource", "ExposureAuto")


@pytest.mark.peers
def test_the_simulated_camera_reads_the_same_through_emvas_library():
    camera = simulator()
    memory = SimulatorMemory(camera)
    nodes, _port = reference(camera.description, memory)
    ours = Features(camera.description, memory)
    for name in CHOICES:
        assert ours.value(name) == nodes.get_node(name).value
        assert set(ours.choices(name)) == set(nodes.get_node(name).symbolics)
    ours.set("ExposureAuto", "Off")
    ours.set("GainAuto", "Off")
    ours.set("ExposureTime", 1234.5)
    ours.set("Gain", 3.3)
    ours.set("Width", 32)
    ours.set("PixelFormat", "BayerRG12Packed")
    ours.set("TriggerSource", "Line0")
    for name in NUMBERS:
        node = nodes.get_node(name)
        assert ours.number(name) == pytest.approx(node.value), name
        if name not in OPEN:
            assert ours.limits(name) == pytest.approx((node.min, node.max)), name
    for name in CHOICES:
        assert ours.value(name) == nodes.get_node(name).value
    nodes.get_node("ExposureTime").value = 777.0
    nodes.get_node("Height").value = 20
    nodes.get_node("TriggerMode").value = "On"
    assert ours.value("ExposureTime") == 777.0
    assert ours.value("Height") == 20
    assert ours.value("TriggerMode") == "On"


@pytest.mark.peers
@pytest.mark.parametrize("order", ["LittleEndian", "BigEndian"])
@pytest.mark.parametrize("sign", ["Signed", "Unsigned"])
@pytest.mark.parametrize("length", [1, 2, 4, 8])
def test_fields_of_registers_lie_where_emvas_library_finds_them(order, sign, length):
    last = 8 * length - 1
    for low, high in ((0, 2), (1, last), (3, 3), (last - 2, last)):
        ends = (high, low) if order == "BigEndian" else (low, high)
        more = f"<LSB>{ends[0]}</LSB><MSB>{ends[1]}</MSB><Sign>{sign}</Sign>"
        body = register(kind="MaskedIntReg", length=length, more=more, order=order)
        memory = Memory(bytes((0xA5, 0x3C, 0x96, 0x0F, 0x5A, 0xC3, 0x69, 0xF0)) + bytes(8))
        nodes, _port = reference((HEAD + body + TAIL).encode(), memory)
        assert features(body, memory).number("R") == nodes.get_node("R").value


OPERATORS = ("+", "-", "*", "/", "%", "<", ">", "<=", ">=", "=", "<>", "&&", "||", "&", "|", "^")
SMALL = st.sampled_from(["1", "2", "7"])
LEAVES = st.sampled_from(["0", "1", "2", "7", "0x1F", "A", "B", "C"])


def _combine(inner):
    return st.one_of(
        st.builds("{} {} {}".format, inner, st.sampled_from(OPERATORS), inner),
        st.builds("{} {} {}".format, inner, st.sampled_from(["<<", ">>", "**"]), SMALL),
        st.builds("({})".format, inner),
        st.builds("({} ? {} : {})".format, inner, inner, inner),
    )


@pytest.mark.slow
@pytest.mark.peers
def test_formulas_have_the_value_that_emvas_library_gives_them():
    genapi = pytest.importorskip("genicam.genapi")
    variables = {"A": 5, "B": 2, "C": -3}
    bound = "".join(f'<pVariable Name="{v}">N{v}</pVariable>' for v in variables)
    values = "".join(
        f'<Integer Name="N{v}"><Value>{x}</Value></Integer>' for v, x in variables.items()
    )
    compared = 0

    @settings(max_examples=400, deadline=None, database=None, derandomize=True)
    @given(st.recursive(LEAVES, _combine, max_leaves=8))
    def check(text):
        nonlocal compared
        escaped = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
        knife = f'<IntSwissKnife Name="K">{bound}<Formula>{escaped}</Formula></IntSwissKnife>'
        nodes = genapi.NodeMap()
        nodes.load_xml_from_string(HEAD + knife + values + TAIL)
        try:
            theirs = nodes.get_node("K").value
        except Exception:
            # GenApi also evaluates unselected branches, which may have no value.
            return
        try:
            ours = features(knife + values).number("K")
        except CameraDescriptionError:
            return
        # Beyond 32 bits the library wraps or clips, as the formula goes.
        if abs(ours) < 1 << 31 and abs(theirs) < 1 << 31:
            assert ours == theirs, text
            compared += 1

    check()
    assert compared > 200


MINUS = (
    "-(5)+3",
    "-(A)-3",
    "-(2)**2",
    "-(5)>3",
    "3*-(5)+2",
    "-(5)?1:2",
    "-((5))+3",
    "-A+3",
    "-2**2",
)
NO_VALUE = ("LN(0)", "LN(-1)", "SQRT(-1)", "EXP(1000)", "LN(0)+1", "SGN(LN(0))", "ROUND(2.345,2)")


@pytest.mark.peers
@pytest.mark.parametrize("text", [*MINUS, *NO_VALUE])
def test_a_minus_and_what_has_no_value_are_taken_as_emvas_library_takes_them(text):
    genapi = pytest.importorskip("genicam.genapi")
    body = '<Integer Name="N"><Value>5</Value></Integer>'
    for kind in ("IntSwissKnife", "SwissKnife")[text in NO_VALUE :]:
        formula = text.replace("<", "&lt;").replace(">", "&gt;")
        inside = f'<pVariable Name="A">N</pVariable><Formula>{formula}</Formula>'
        knife = f'<{kind} Name="K">{inside}</{kind}>'
        nodes = genapi.NodeMap()
        nodes.load_xml_from_string(HEAD + knife + body + TAIL)
        ours = features(knife + body).number("K")
        assert ours == pytest.approx(nodes.get_node("K").value, nan_ok=True)


INTERFACES = {"IInteger", "IFloat", "IBoolean", "IString"}


def same(theirs, ours):
    if isinstance(theirs, float):
        wide = abs(theirs) > 1e300 and abs(ours) > 1e300  # "no limit", one way or the other
        return wide or ours == pytest.approx(theirs, rel=1e-6, nan_ok=True)
    return theirs == ours


def compared(genapi, node, ours, name):
    """Yield (what, whether both agree) of one node."""
    kind = type(node).__name__
    yield "available", genapi.is_available(node) == ours.has(name)
    if kind != "ICategory" and kind != "IPort":
        yield "writable", genapi.is_writable(node) == ours.is_writable(name)
    if kind not in INTERFACES or not genapi.is_readable(node):
        return
    try:
        yield "value", same(node.value, ours.value(name))
        if kind in ("IInteger", "IFloat"):
            pairs = zip((node.min, node.max), ours.limits(name), strict=True)
            yield "limits", all(same(theirs, mine) for theirs, mine in pairs)
    except genapi.GenericException:
        yield "no value there", True


@pytest.mark.slow
@pytest.mark.peers
def test_descriptions_of_real_cameras_read_as_in_emvas_library(peer_files):
    """Values, availability, access and limits of some nodes of every fourth one, on empty memory.

    EMMC_PEER_NODES=0 compares every node of every one, in a minute or two.
    """
    genapi = pytest.importorskip("genicam.genapi")
    every = int(os.environ.get("EMMC_PEER_NODES", "30"))
    counted, different = Counter(), []
    paths = sorted((peer_files / "genicam").glob("*.xml.xz"))
    for path in paths[:: 4 if every else 1]:
        xml = lzma.decompress(path.read_bytes())
        xml = xml[xml.index(b"<") :]
        memory = Memory(b"")
        nodes, _port = reference(xml, memory)
        ours = Features(xml, memory)
        known = [node for node in nodes.nodes if node.node.name in ours]
        step = max(1, len(known) // every) if every else 1
        for node in known[::step]:
            name = node.node.name
            for what, agree in compared(genapi, node, ours, name):
                counted[what] += 1
                if not agree:
                    different.append((path.name, name, what))
    assert different == []
    assert min(counted[what] for what in ("available", "writable", "value", "limits")) > 200
    print(dict(counted))


SEEDS = st.integers(0, 1 << 62)
XML = u3v_description.describe("M", ("BayerRG8", "BayerRG12p"), (20, 20_000), (0, 240))
WORDS = (
    *(b"Value", b"pValue", b"Formula", b"Address", b"Length", b"Width", b"WidthLimit", b"<", b">"),
    *(b"0", b"0x", b"-1", b"99999999999999999999", b"ALL - OFF", b"TO", b"(", b"**", b"\xff", b""),
)


def damaged_xml(random):
    raw = bytearray(XML)
    for _ in range(random.randint(1, 6)):
        at = random.randrange(len(raw))
        raw[at : at + random.randint(0, 12)] = random.choice(WORDS)
    return bytes(raw)


@pytest.mark.slow
def test_no_xml_makes_the_reader_fail_outside_the_drivers_errors():
    names = ("Width", "ExposureTime", "Gain", "PixelFormat", "AcquisitionStart", "BlackLevel")

    def check(seed):
        random = Random(seed)
        try:
            found = Features(damaged_xml(random), Memory(random.randbytes(64)))
        except DriverError:
            return
        for name in names:
            for act in (found.value, found.limits, found.choices, found.is_writable, found.has):
                with suppress(DriverError):
                    act(name)
            for value in (1, "On", 2.5):
                with suppress(DriverError):
                    found.set(name, value)

    fuzz(check, SEEDS)


PIECES = (
    *("(", ")", "+", "-", "*", "/", "%", "**", "&", "|", "^", "~", "<", ">", "<=", "=", "<>"),
    *("?", ":", "&&", "||", "<<", ">>", "1", "2", "99", "0x7FFFFFFFFFFFFFFF", "1e308", "A"),
    *("SQRT(", "EXP(", "LN(", "ROUND(", "PI", "E", ".", ",", "@", "\n"),
)


def test_no_formula_makes_the_evaluator_fail_or_hang():
    def check(seed):
        random = Random(seed)
        text = " ".join(random.choices(PIECES, k=random.randint(0, 40)))
        with suppress(FormulaError):
            Formula(text).value(lambda name: -3, random.random() < 0.5)

    fuzz(check, SEEDS)
