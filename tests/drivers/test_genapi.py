"""GenICam features by EMVA's library: refusals before anything is sent, values from no cache."""

import lzma
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from emmc_rig.drivers.errors import (
    CameraDescriptionError,
    CameraSettingError,
    DriverError,
    GenicamMissingError,
    UsbGoneError,
)
from emmc_rig.drivers.genapi import Features

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
        + '<StringReg Name="S"><Address>8</Address><Length>8</Length><AccessMode>RO</AccessMode>'
        + "<pPort>Device</pPort></StringReg>"
    )
    memory = Memory()
    found = features(body, memory)
    found.set("B", True)
    memory.data[8:16] = b"cam 1\0\0\0"
    assert (found.value("B"), memory.data[0], found.value("S")) == (True, 3, "cam 1")


@pytest.mark.parametrize(
    "body",
    [
        '<Integer Name="X"><pValue>Y</pValue></Integer>',
        '<Integer Name="X"><pValue>X</pValue></Integer>',
        '<IntSwissKnife Name="X"><Formula>1 +</Formula></IntSwissKnife>',
        '<IntSwissKnife Name="X"><Formula>1/0</Formula></IntSwissKnife>',
        '<Category Name="X"/>',
        register("Y"),
    ],
)
def test_a_description_that_cannot_be_followed_is_named(body):
    with pytest.raises(CameraDescriptionError):
        features(body).number("X")


@pytest.mark.parametrize(
    "xml",
    [
        *(b"", b"<a><b></a>", b"<Other/>", b"\xff"),
        b'<!DOCTYPE a [<!ENTITY e "x">]><RegisterDescription>&e;</RegisterDescription>',
        b'<?xml version="1.0" encoding="klingon"?><a/>',
    ],
)
def test_xml_that_describes_no_registers_is_refused(xml):
    with pytest.raises(CameraDescriptionError, match="cannot be followed"):
        Features(xml, Memory())


def test_a_value_is_what_the_camera_says_now_whatever_may_be_cached():
    memory = Memory()
    found = features(register().replace("NoCache", "WriteThrough"), memory)
    for number in (1, 2):
        memory.data[0] = number
        assert found.value("R") == number


def test_an_error_of_the_port_reaches_the_driver():
    class Unplugged(Memory):
        def read(self, address, length):
            raise UsbGoneError("the camera")

        def write(self, address, data):
            raise UsbGoneError("the camera")

    found = features(register(), Unplugged())
    with pytest.raises(UsbGoneError):
        found.value("R")
    with pytest.raises(UsbGoneError):
        found.set("R", 1)


def test_two_threads_read_at_a_time_while_the_port_waits():
    class Slow(Memory):
        def read(self, address, length):
            time.sleep(0.001)
            return super().read(address, length)

    found = features(register(), Slow(RAMP))
    with ThreadPoolExecutor(4) as threads:
        read = list(threads.map(found.value, ["R"] * 100, timeout=30))
    assert read == [0x04030201] * 100


def test_where_the_library_is_missing_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "genicam", None)
    with pytest.raises(GenicamMissingError, match=r'pip install "emmc-rig\[u3v\]"'):
        features(register())


STANDARD = "Width", "PixelFormat", "ExposureTime", "ExposureTimeAbs", "Gain", "AcquisitionFrameRate"


@pytest.mark.slow
def test_descriptions_of_real_cameras_are_followed(peer_files):
    """Standard features of every description, on a memory of zeros: some are absent there."""
    acts = Counter()
    for path in sorted((peer_files / "genicam").glob("*.xml.xz")):
        xml = lzma.decompress(path.read_bytes())
        found = Features(xml[xml.index(b"<") :], Memory())
        acts["cameras"] += 1
        for name in filter(found.has, STANDARD):
            is_choice = name == "PixelFormat"
            acts[name] += 1
            with suppress(DriverError):  # no value there where the memory holds zeros
                (found.choices if is_choice else found.limits)(name)
                found.value(name)
                acts["values"] += 1
    assert acts["cameras"] > 40, acts
    assert acts["values"] > 30, acts
