"""The XML in which the simulated USB3 Vision camera describes itself, and where its registers lie.

The XML has every kind of node that a driver must follow: plain and masked registers, floats,
formulas, converters, choices, commands, limits and locks that other registers set. Source: EMVA
GenICam Standard 2.1.1; Standard Features Naming Convention 2.7.
"""

from __future__ import annotations

from collections.abc import Mapping

from emmc_rig.drivers.pixel_formats import BY_NAME

BASE = 0x100000
WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = 0x00, 0x04, 0x08, 0x0C
WIDTH_MAX, HEIGHT_MAX, PIXEL_FORMAT, PAYLOAD = 0x10, 0x14, 0x18, 0x1C
MODE, START, STOP, TRIGGER = 0x20, 0x24, 0x28, 0x2C
EXPOSURE, GAIN, BLACK_LEVEL, LOCKED, FRAME_RATE, AUTO = 0x34, 0x38, 0x3C, 0x40, 0x44, 0x48
LINE, SENSOR = 0x30, 0x50
SIZE = 0x70

EXPOSURE_TICK_US = 0.5
GAIN_STEP_DB = 0.1
TEMPERATURE_C = 38.5
SOURCE_SHIFT, FALLING_BIT = 4, 8
"""Bits in the register of the trigger: where its source begins (see LINES), and the edge's."""
LINES = {1: "Line0", 2: "Line1"}
AUTO_EXPOSURE_BIT, AUTO_GAIN_BIT = 0, 1

Limits = tuple[int, int]


def describe(
    model: str, pixel_formats: tuple[str, ...], exposure_ticks: Limits, gain_steps: Limits
) -> bytes:
    """Return the XML; limits are those of the raw registers."""
    entries = "".join(
        f'<EnumEntry Name="{name}"><Value>{BY_NAME[name].code:#x}</Value></EnumEntry>'
        for name in pixel_formats
    )
    parts = (
        _integer("Width", WIDTH, "WidthLimit", lock=True, step=2, least=2),
        _integer("Height", HEIGHT, "HeightLimit", lock=True, step=2, least=2),
        _integer("OffsetX", OFFSET_X, "OffsetXLimit", lock=True, step=2, least=0),
        _integer("OffsetY", OFFSET_Y, "OffsetYLimit", lock=True, step=2, least=0),
        _knife("WidthLimit", "ALL - OFF", {"ALL": "WidthMax", "OFF": "OffsetXReg"}),
        _knife("HeightLimit", "ALL - OFF", {"ALL": "HeightMax", "OFF": "OffsetYReg"}),
        _knife("OffsetXLimit", "ALL - USED", {"ALL": "WidthMax", "USED": "WidthReg"}),
        _knife("OffsetYLimit", "ALL - USED", {"ALL": "HeightMax", "USED": "HeightReg"}),
        _register("WidthMax", WIDTH_MAX, "RO"),
        _register("HeightMax", HEIGHT_MAX, "RO"),
        _register("SensorWidth", WIDTH_MAX, "RO"),
        _register("SensorHeight", HEIGHT_MAX, "RO"),
        _register("PayloadSize", PAYLOAD, "RO"),
        f'<Enumeration Name="PixelFormat"><pIsLocked>TLParamsLocked</pIsLocked>{entries}'
        "<pValue>PixelFormatReg</pValue></Enumeration>",
        _register("PixelFormatReg", PIXEL_FORMAT),
        _choice("AcquisitionMode", {"Continuous": 0, "SingleFrame": 1}, "AcquisitionModeReg"),
        _register("AcquisitionModeReg", MODE),
        _command("AcquisitionStart", START),
        _command("AcquisitionStop", STOP),
        _choice("TriggerSelector", {"FrameStart": 0}, None),
        _choice("TriggerMode", {"Off": 0, "On": 1}, "TriggerModeReg"),
        _masked("TriggerModeReg", TRIGGER, 0, 0),
        _choice("TriggerSource", {"Software": 0, "Line0": 1, "Line1": 2}, "TriggerSourceReg"),
        _masked("TriggerSourceReg", TRIGGER, 4, 7),
        _choice("TriggerActivation", {"RisingEdge": 0, "FallingEdge": 1}, "TriggerActivationReg"),
        _masked("TriggerActivationReg", TRIGGER, FALLING_BIT, FALLING_BIT),
        _choice("LineSelector", {"Line2": 0}, None),
        _choice("LineMode", {"Input": 0, "Output": 1}, "LineModeReg"),
        _masked("LineModeReg", LINE, 0, 0),
        _choice("LineSource", {"Off": 0, "ExposureActive": 1}, "LineSourceReg"),
        _masked("LineSourceReg", LINE, 4, 7),
        _choice("ExposureAuto", {"Off": 0, "Continuous": 1}, "ExposureAutoReg"),
        _masked("ExposureAutoReg", AUTO, AUTO_EXPOSURE_BIT, AUTO_EXPOSURE_BIT),
        _choice("GainAuto", {"Off": 0, "Continuous": 1}, "GainAutoReg"),
        _masked("GainAutoReg", AUTO, AUTO_GAIN_BIT, AUTO_GAIN_BIT),
        '<Float Name="ExposureTime"><pIsLocked>ExposureAutoReg</pIsLocked>'
        "<pValue>ExposureTimeConverter</pValue><Unit>us</Unit></Float>"
        '<Converter Name="ExposureTimeConverter">'
        f"<FormulaTo>ROUND(FROM / {EXPOSURE_TICK_US})</FormulaTo>"
        f"<FormulaFrom>TO * {EXPOSURE_TICK_US}</FormulaFrom>"
        "<pValue>ExposureTimeRaw</pValue></Converter>"
        '<Integer Name="ExposureTimeRaw"><pValue>ExposureTimeReg</pValue>'
        f"<Min>{exposure_ticks[0]}</Min><Max>{exposure_ticks[1]}</Max></Integer>",
        _register("ExposureTimeReg", EXPOSURE),
        '<Float Name="Gain"><pIsLocked>GainAutoReg</pIsLocked><pValue>GainConverter</pValue>'
        '<Unit>dB</Unit></Float><Converter Name="GainConverter">'
        f"<FormulaTo>ROUND(FROM / {GAIN_STEP_DB})</FormulaTo>"
        f"<FormulaFrom>TO * {GAIN_STEP_DB}</FormulaFrom>"
        "<pValue>GainRaw</pValue></Converter>"
        '<Integer Name="GainRaw"><pValue>GainReg</pValue>'
        f"<Min>{gain_steps[0]}</Min><Max>{gain_steps[1]}</Max></Integer>",
        _register("GainReg", GAIN, extra="<Sign>Signed</Sign>"),
        '<Float Name="BlackLevel"><pValue>BlackLevelKnife</pValue></Float>'
        '<SwissKnife Name="BlackLevelKnife"><pVariable Name="RAW">BlackLevelReg</pVariable>'
        "<Formula>RAW / 16</Formula></SwissKnife>",
        _register("BlackLevelReg", BLACK_LEVEL, "RO"),
        '<Float Name="DeviceTemperature"><pValue>Warmth</pValue><Unit>C</Unit></Float>'
        f'<SwissKnife Name="Warmth"><Formula>{TEMPERATURE_C}</Formula></SwissKnife>',
        _float("AcquisitionFrameRate", FRAME_RATE, (0.001, 1000), "Hz"),
        '<Integer Name="TLParamsLocked"><Visibility>Invisible</Visibility>'
        "<pValue>TLParamsLockedReg</pValue><Min>0</Min><Max>1</Max></Integer>",
        _register("TLParamsLockedReg", LOCKED),
        _text("SensorName", BASE + SENSOR, 32),
        _text("DeviceVendorName", 0x0004, 64),
        _text("DeviceModelName", 0x0044, 64),
        _text("DeviceSerialNumber", 0x0144, 64),
        '<Port Name="Device"/>',
    )
    features = (
        "Width Height OffsetX OffsetY WidthMax HeightMax SensorWidth SensorHeight PixelFormat "
        "PayloadSize AcquisitionMode "
        "AcquisitionStart AcquisitionStop TriggerSelector TriggerMode TriggerSource "
        "TriggerActivation LineSelector LineMode LineSource "
        "ExposureAuto ExposureTime GainAuto Gain BlackLevel "
        "AcquisitionFrameRate TLParamsLocked SensorName DeviceVendorName DeviceModelName "
        "DeviceSerialNumber DeviceTemperature"
    )
    listed = "".join(f"<pFeature>{name}</pFeature>" for name in features.split())
    xml = (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        f'<RegisterDescription ModelName="{model}" VendorName="EMMC" ToolTip="Simulated camera" '
        'StandardNameSpace="USB" SchemaMajorVersion="1" SchemaMinorVersion="1" '
        'SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" SubMinorVersion="0" '
        'ProductGuid="6f9cb1e2-21b7-4c1f-9f3e-000000000001" '
        'VersionGuid="6f9cb1e2-21b7-4c1f-9f3e-000000000002" '
        'xmlns="http://www.genicam.org/GenApi/Version_1_1">\n'
        f'<Category Name="Root" NameSpace="Standard">{listed}</Category>\n'
        + "\n".join(parts)
        + "\n</RegisterDescription>\n"
    )
    return xml.encode()


def _float(name: str, offset: int, limits: tuple[float, float], unit: str) -> str:
    return (
        f'<Float Name="{name}"><pValue>{name}Reg</pValue><Min>{limits[0]}</Min>'
        f"<Max>{limits[1]}</Max><Unit>{unit}</Unit></Float>"
        f'<FloatReg Name="{name}Reg"><Address>{BASE + offset:#x}</Address>'
        "<Length>4</Length><AccessMode>RW</AccessMode><pPort>Device</pPort>"
        "<Endianess>LittleEndian</Endianess></FloatReg>"
    )


def _register(name: str, offset: int, access: str = "RW", extra: str = "") -> str:
    return (
        f'<IntReg Name="{name}"><Address>{BASE + offset:#x}</Address><Length>4</Length>'
        f"<AccessMode>{access}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
        f"{extra}<Endianess>LittleEndian</Endianess></IntReg>"
    )


def _text(name: str, address: int, length: int) -> str:
    return (
        f'<StringReg Name="{name}"><Address>{address:#x}</Address><Length>{length}</Length>'
        "<AccessMode>RO</AccessMode><pPort>Device</pPort></StringReg>"
    )


def _masked(name: str, offset: int, low: int, high: int) -> str:
    return (
        f'<MaskedIntReg Name="{name}"><Address>{BASE + offset:#x}</Address><Length>4</Length>'
        "<AccessMode>RW</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
        f"<LSB>{low}</LSB><MSB>{high}</MSB><Endianess>LittleEndian</Endianess></MaskedIntReg>"
    )


def _integer(name: str, offset: int, limit: str, lock: bool, step: int, least: int) -> str:
    locked = "<pIsLocked>TLParamsLocked</pIsLocked>" if lock else ""
    return (
        f'<Integer Name="{name}">{locked}<pValue>{name}Reg</pValue><Min>{least}</Min>'
        f"<pMax>{limit}</pMax><Inc>{step}</Inc></Integer>" + _register(name + "Reg", offset)
    )


def _knife(name: str, formula: str, variables: Mapping[str, str]) -> str:
    bound = "".join(f'<pVariable Name="{v}">{node}</pVariable>' for v, node in variables.items())
    return f'<IntSwissKnife Name="{name}">{bound}<Formula>{formula}</Formula></IntSwissKnife>'


def _choice(name: str, codes: Mapping[str, int], register: str | None) -> str:
    entries = "".join(
        f'<EnumEntry Name="{entry}"><Value>{code}</Value></EnumEntry>'
        for entry, code in codes.items()
    )
    value = "<Value>0</Value>" if register is None else f"<pValue>{register}</pValue>"
    return f'<Enumeration Name="{name}">{entries}{value}</Enumeration>'


def _command(name: str, offset: int) -> str:
    return (
        f'<Command Name="{name}"><pValue>{name}Reg</pValue><CommandValue>1</CommandValue>'
        "</Command>" + _register(name + "Reg", offset)
    )
