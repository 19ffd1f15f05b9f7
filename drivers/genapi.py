"""GenICam features: what a camera's XML describes, read and written by name through a port.

Only what a bench needs is understood: numbers, choices, texts, commands, the registers and
formulas behind them, their limits and locks. The XML comes from a device and is not trusted: no
document type or entity, bounded size, bounded work per access. Nothing is cached: a value is what
the camera says now. Source: EMVA GenICam Standard 2.1.1 and the Standard Features Naming
Convention.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, Protocol, TypeVar
from xml.etree import ElementTree

import numpy as np

from emmc_rig.drivers.errors import CameraDescriptionError, CameraSettingError
from emmc_rig.drivers.genapi_formula import Formula, Number

XML_LIMIT = 32 << 20
TEXT_LIMIT = 4096
DEPTH_LIMIT = 40
WORK_LIMIT = 20_000
"""Nodes that one access may visit: a description can make the count grow without bound."""

Value = int | float | str | bool
Limits = tuple[Number, Number]

_Answer = TypeVar("_Answer")

_parsed = lru_cache(maxsize=512)(Formula)


class Port(Protocol):
    """The camera's memory."""

    def read(self, address: int, length: int) -> bytes:
        """Return `length` bytes from `address` on."""
        ...

    def write(self, address: int, data: bytes) -> None:
        """Store `data` from `address` on."""


@dataclass(frozen=True)
class _Item:
    tag: str
    text: str
    name: str
    offset: str
    index: str
    node: _Node | None


@dataclass(frozen=True)
class _Node:
    """A named element of the XML. kind: the tag. items: the child elements."""

    kind: str
    name: str
    items: tuple[_Item, ...]

    def text(self, tag: str) -> str | None:
        """Return the text of the first item with that tag."""
        return next((item.text for item in self.items if item.tag == tag), None)

    def all(self, tag: str) -> Iterator[_Item]:
        """Yield the items with that tag."""
        return (item for item in self.items if item.tag == tag)


class _NoDocumentType(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse what entities are declared in."""
        raise CameraDescriptionError("it declares a document type")


class Features:
    """A camera's features, by their GenICam names.

    Every method raises `CameraDescriptionError` for a feature that is missing or described in a
    way that cannot be followed, and what the port raises.
    """

    def __init__(self, xml: bytes, port: Port) -> None:
        self._port = port
        self._nodes = _read_nodes(xml)
        self._kept: dict[str, Number] = {}
        self._accesses: dict[int, Access] = {}
        self._work = 0
        self._depth = 0

    def __contains__(self, name: str) -> bool:
        return name in self._nodes

    def has(self, name: str) -> bool:
        """Whether the camera describes the feature and offers it now."""
        return name in self._nodes and len(self._asked(name, self._access)) > 1

    def is_writable(self, name: str) -> bool:
        """Whether the feature is there and may be changed now."""
        return name in self._nodes and WRITE in self._asked(name, self._access)

    def value(self, name: str) -> Value:
        """Return a number, a truth, a text, or the name of a choice."""
        return self._asked(name, self._value)

    def number(self, name: str) -> Number:
        """Return a number; a choice gives its code."""
        return self._asked(name, self._number)

    def limits(self, name: str) -> Limits:
        """Return the least and the greatest value of a number."""
        return self._asked(name, self._limits)

    def unit(self, name: str) -> str:
        """Return a number's unit, "" where it has none."""
        return self._asked(name, lambda node: (node.text("Unit") or "").strip())

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the choices of an enumeration that are offered now."""
        return self._asked(name, self._choices)

    def set(self, name: str, value: Value) -> None:
        """Store a number, a truth, or a choice by name.

        Raises `CameraSettingError`, before anything is sent, for a value that the feature cannot
        take or while it may not be changed.
        """
        self._asked(name, lambda node: self._set(node, value))

    def set_nearest(self, name: str, value: Number) -> None:
        """Store the nearest to a number that the feature can take; raises as `set`."""
        self._asked(name, lambda node: self._set_nearest(node, value))

    def execute(self, name: str) -> None:
        """Carry a command out."""
        self._asked(name, self._execute)

    def _asked(self, name: str, answer: Callable[[_Node], _Answer]) -> _Answer:
        self._work = 0
        self._depth = 0
        self._accesses.clear()
        try:
            return answer(self._node(name))
        except (ArithmeticError, LookupError, RecursionError, ValueError, struct.error) as error:
            raise CameraDescriptionError(f"{name} cannot be worked out ({error})") from error

    def _node(self, name: str | None) -> _Node:
        key = (name or "").strip()
        if key not in self._nodes:
            raise CameraDescriptionError(f"it has no {key[:80] or 'name where one belongs'}")
        return self._nodes[key]

    @contextmanager
    def _step(self, node: _Node) -> Iterator[None]:
        self._work += 1
        self._depth += 1
        if self._work > WORK_LIMIT or self._depth > DEPTH_LIMIT:
            raise CameraDescriptionError(f"{node.name} leads round in circles, or too far")
        try:
            yield
        finally:
            self._depth -= 1

    def _value(self, node: _Node) -> Value:
        if node.kind == "Enumeration":
            code = self._number(node)
            for entry in self._entries(node):
                if _integer(entry.text("Value")) == code:
                    return entry.name
            raise CameraDescriptionError(f"{node.name} is {code}, no value of the choices")
        if node.kind == "Boolean":
            return self._number(node) == _integer(node.text("OnValue") or "1")
        if node.kind in ("StringReg", "String"):
            return self._text(node)
        return self._number(node)

    def _text(self, node: _Node) -> str:
        with self._step(node):
            if node.kind == "StringReg":
                length = self._length(node, TEXT_LIMIT, least=0)
                raw = self._port.read(self._address(node), length) if length else b""
                return raw.split(b"\0", 1)[0].decode("utf-8", "replace")
            if node.kind == "String":
                target = node.text("pValue")
                return self._text(self._node(target)) if target else node.text("Value") or ""
            raise CameraDescriptionError(f"{node.name} is no text")

    def _number(self, node: _Node) -> Number:
        with self._step(node):
            if node.kind in _PLAIN:
                return self._plain(node)
            if node.kind in _REGISTERS:
                return self._register(node)
            if node.kind in ("SwissKnife", "IntSwissKnife"):
                return self._formula(node, "Formula", {})
            if node.kind in ("Converter", "IntConverter"):
                raw = self._number(self._node(node.text("pValue")))
                return self._formula(node, "FormulaFrom", {"TO": raw})
            raise CameraDescriptionError(f"{node.name} ({node.kind}) is no number")

    def _plain(self, node: _Node) -> Number:
        target = self._target(node)
        if target is not None:
            found = self._number(target)
        elif node.name in self._kept:
            found = self._kept[node.name]
        else:
            found = _PLAIN[node.kind](self._literal(node))
        return found if node.kind == "Float" else _whole(found)

    def _target(self, node: _Node) -> _Node | None:
        """Return the node that holds the value, None where the description itself does."""
        target = self._chosen(node, "pValue")
        if target is None:
            target = node.text("pValue")
        return None if target is None else self._node(target)

    def _literal(self, node: _Node) -> str:
        indexed = node.text("pIndex") is not None
        return (self._chosen(node, "Value") if indexed else node.text("Value")) or "0"

    def _chosen(self, node: _Node, tag: str) -> str | None:
        """Return what a node's index chooses among its tags, the default's where it is none."""
        index = node.text("pIndex")
        if index is None:
            return None
        chosen = self._number(self._node(index))
        for item in node.all(f"{tag}Indexed"):
            if _integer(item.index) == chosen:
                return item.text
        return node.text(f"{tag}Default")

    def _linked(self, node: _Node, tag: str, default: Number) -> Number:
        target = node.text("p" + tag)
        if target is not None:
            return self._number(self._node(target))
        literal = node.text(tag)
        if literal is None:
            return default
        return float(literal) if node.kind in ("Float", "Converter") else _integer(literal)

    def _formula(self, node: _Node, tag: str, given: dict[str, Number]) -> Number:
        text = node.text(tag)
        if text is None:
            raise CameraDescriptionError(f"{node.name} has no {tag}")
        integers = node.kind.startswith("Int")

        def lookup(name: str) -> Number:
            if name in given:
                return given[name]
            for item in node.items:
                if item.name != name:
                    continue
                if item.tag == "pVariable":
                    return self._aspect(item, name)
                if item.tag == "Constant":
                    return _integer(item.text) if integers else float(item.text)
                if item.tag == "Expression":
                    with self._step(node):
                        return _parsed(item.text).value(lookup, integers)
            raise CameraDescriptionError(f"{node.name} uses {name[:80]}, which it does not define")

        return _parsed(text).value(lookup, integers)

    def _aspect(self, item: _Item, name: str) -> Number:
        """Return a variable's value, or what its name's ending asks for."""
        node = self._node(item.text)
        if name.endswith(".Min"):
            return self._limits(node)[0]
        if name.endswith(".Max"):
            return self._limits(node)[1]
        if name.endswith(".Inc"):
            return self._linked(node, "Inc", 1)
        _, _, entry_name = name.partition(".Enum.")
        for entry in self._entries(node) if entry_name else ():
            if entry.name == entry_name:
                return _integer(entry.text("Value"))
        return self._number(node)

    def _address(self, node: _Node) -> int:
        address = 0
        for item in node.items:
            if item.tag == "Address":
                address += _integer(item.text)
            elif item.tag == "pAddress":
                address += int(self._number(self._node(item.text)))
            elif item.tag == "IntSwissKnife" and item.node is not None:
                address += int(self._number(item.node))
            elif item.tag == "pIndex":
                stride = _integer(item.offset) if item.offset else self._length(node, TEXT_LIMIT)
                address += stride * int(self._number(self._node(item.text)))
        if not 0 <= address < 1 << 64:
            raise CameraDescriptionError(f"{node.name} lies at {address:#x}")
        return address

    def _length(self, node: _Node, most: int, least: int = 1) -> int:
        length = int(self._linked(node, "Length", 0))
        if not least <= length <= most:
            raise CameraDescriptionError(f"{node.name} is {length} bytes long")
        return length

    def _register(self, node: _Node) -> Number:
        length = self._length(node, 8)
        raw = self._port.read(self._address(node), length)
        order = _order(node)
        if node.kind == "FloatReg":
            return struct.unpack(order + _FLOATS[length], raw)[0]
        signed = (node.text("Sign") or "").strip() == "Signed"
        if node.kind == "IntReg":
            return int.from_bytes(raw, _ORDERS[order], signed=signed)
        shift, width = _bits(node, length)
        field = int.from_bytes(raw, _ORDERS[order]) >> shift & ((1 << width) - 1)
        return field - (1 << width) if signed and field >> (width - 1) else field

    def _store(self, node: _Node, value: Number) -> None:
        """Write to a number or what holds it."""
        with self._step(node):
            if node.kind in _PLAIN:
                target = self._target(node)
                if target is not None:
                    self._store(target, value)
                else:
                    self._kept[node.name] = value
            elif node.kind in _REGISTERS:
                self._store_register(node, value)
            elif node.kind in ("Converter", "IntConverter"):
                raw = self._formula(node, "FormulaTo", {"FROM": value})
                self._store(self._node(node.text("pValue")), raw)
            else:
                raise CameraDescriptionError(f"{node.name} ({node.kind}) cannot be stored to")

    def _store_register(self, node: _Node, value: Number) -> None:
        length, address, order = self._length(node, 8), self._address(node), _order(node)
        if node.kind == "FloatReg":
            self._port.write(address, struct.pack(order + _FLOATS[length], value))
            return
        whole = _whole(value)
        signed = (node.text("Sign") or "").strip() == "Signed"
        shift, width = _bits(node, length) if node.kind == "MaskedIntReg" else (0, 8 * length)
        low, high = (-(1 << width - 1), 1 << width - 1) if signed else (0, 1 << width)
        if not low <= whole < high:
            raise CameraSettingError(node.name, f"holds {low} to {high - 1}, not {whole}")
        field = (whole & ((1 << width) - 1)) << shift
        if node.kind == "MaskedIntReg":
            old = int.from_bytes(self._port.read(address, length), _ORDERS[order])
            field |= old & ~(((1 << width) - 1) << shift)
        self._port.write(address, field.to_bytes(length, _ORDERS[order]))

    def _limits(self, node: _Node) -> Limits:
        with self._step(node):
            if node.kind in ("Converter", "IntConverter"):
                if (node.text("Slope") or "").strip() == "Varying":
                    return _OPEN["Integer" if node.kind == "IntConverter" else "Float"]
                ends = self._limits(self._node(node.text("pValue")))
                low, high = sorted(self._formula(node, "FormulaFrom", {"TO": end}) for end in ends)
            elif node.kind in _REGISTERS:
                low, high = self._register_limits(node)
            elif node.kind in ("Integer", "Float"):
                target = self._target(node)
                inner = _OPEN[node.kind] if target is None else self._limits(target)
                low = max(self._linked(node, "Min", inner[0]), inner[0])
                high = min(self._linked(node, "Max", inner[1]), inner[1])
            elif node.kind in ("SwissKnife", "IntSwissKnife"):
                low, high = _OPEN["Integer" if node.kind == "IntSwissKnife" else "Float"]
            else:
                raise CameraDescriptionError(f"{node.name} ({node.kind}) has no limits")
            return low, high

    def _register_limits(self, node: _Node) -> Limits:
        length = self._length(node, 8)
        if node.kind == "FloatReg":
            most = float(np.finfo(np.float32).max) if length == 4 else math.inf
            return -most, most
        width = _bits(node, length)[1] if node.kind == "MaskedIntReg" else 8 * length
        if (node.text("Sign") or "").strip() == "Signed":
            return -(1 << width - 1), (1 << width - 1) - 1
        return 0, min((1 << width) - 1, _OPEN["Integer"][1])

    def _entries(self, node: _Node) -> Iterator[_Node]:
        return (item.node for item in node.all("EnumEntry") if item.node is not None)

    def _choices(self, node: _Node) -> tuple[str, ...]:
        if node.kind != "Enumeration":
            raise CameraDescriptionError(f"{node.name} ({node.kind}) has no choices")
        return tuple(entry.name for entry in self._entries(node) if READ in self._access(entry))

    def _access(self, node: _Node) -> Access:
        """Return whether a node is present now, and whether it may be read and written.

        A node is present while its own conditions hold, the inputs of its formula, address and
        limits can be read, and an enumeration or category has a present member. Its access is
        limited by the access of the node that holds its value.
        """
        known = self._accesses.get(id(node))
        if known is None:
            self._accesses[id(node)] = EVERYTHING  # of a node that its own conditions lead to
            known = self._accesses[id(node)] = self._worked_out_access(node)
        return known

    def _worked_out_access(self, node: _Node) -> Access:
        with self._step(node):
            if not self._holds(node.text("pIsImplemented")):
                return ABSENT
            access = self._own_access(node)
            if not self._holds(node.text("pIsAvailable")):
                access &= UNAVAILABLE
            for source in self._inputs(node):
                access &= EVERYTHING_OF[self._access(source) & READABLE]
            if node.kind == "Enumeration":
                entries = (self._access(entry) for entry in self._entries(node))
                access &= EVERYTHING_OF[frozenset().union(*entries) & READABLE]
            elif node.kind == "Category":
                features = [self._access(self._node(item.text)) for item in node.all("pFeature")]
                return READABLE if any(features) else ABSENT
            target = self._target(node) if node.kind in _HOLDING else None
            return access if target is None else access & self._access(target)

    def _holds(self, condition: str | None) -> bool:
        """Return whether a condition holds; an unreadable condition counts as false."""
        if condition is None:
            return True
        node = self._node(condition)
        return READ in self._access(node) and bool(self._number(node))

    def _own_access(self, node: _Node) -> Access:
        """Return what the node's own element allows."""
        access = READABLE if node.kind in _COMPUTED else EVERYTHING
        for tag in ("AccessMode", "ImposedAccessMode"):
            access &= ACCESS_MODES.get((node.text(tag) or "").strip(), EVERYTHING)
        lock = node.text("pIsLocked")
        if lock is not None and self._number(self._node(lock)):
            access &= READABLE
        return access

    def _inputs(self, node: _Node) -> Iterator[_Node]:
        """Yield the nodes that a formula, an address or limits are worked out from."""
        for item in node.items:
            if item.tag in _INPUTS:
                yield self._node(item.text)
            elif item.tag == "IntSwissKnife" and item.node is not None:
                yield item.node

    def _set(self, node: _Node, value: Value) -> None:
        if WRITE not in self._access(node):
            raise CameraSettingError(node.name, "cannot be changed now: stop the acquisition first")
        if node.kind == "Enumeration":
            offered = self._choices(node)
            if value not in offered:
                raise CameraSettingError(node.name, f"offers {', '.join(offered)}, not {value}")
            entry = next(e for e in self._entries(node) if e.name == value)
            self._store(node, _integer(entry.text("Value")))
        elif node.kind == "Boolean":
            word = node.text("OnValue") or "1" if value else node.text("OffValue") or "0"
            self._store(node, _integer(word))
        elif isinstance(value, str):
            raise CameraSettingError(node.name, f"is a number, not {value!r}")
        else:
            self._set_number(node, value)

    def _set_number(self, node: _Node, value: Number) -> None:
        low, high = self._limits(node)
        slack = 1e-9 * max(abs(low), abs(high)) if node.kind in ("Float", "Converter") else 0
        if not low - slack <= value <= high + slack:
            raise CameraSettingError(node.name, f"goes from {low:g} to {high:g}, not to {value:g}")
        step = int(self._linked(node, "Inc", 1)) if node.kind == "Integer" else 1
        if step > 1 and (_whole(value) - _whole(low)) % step:
            raise CameraSettingError(node.name, f"goes in steps of {step} from {low}, not {value}")
        self._store(node, value)

    def _set_nearest(self, node: _Node, value: Number) -> None:
        low, high = self._limits(node)
        value = min(max(value, low), high)
        if node.kind == "Integer":
            step = max(1, int(self._linked(node, "Inc", 1)))
            value = _whole(low) + round((value - low) / step) * step
            value -= step if value > high else 0
        self._set(node, value)

    def _execute(self, node: _Node) -> None:
        if node.kind != "Command":
            raise CameraDescriptionError(f"{node.name} ({node.kind}) is no command")
        if WRITE not in self._access(node):
            raise CameraSettingError(node.name, "cannot be carried out now")
        order = self._linked(node, "CommandValue", 1)
        self._store(self._node(node.text("pValue")), order)


def _read_nodes(xml: bytes) -> dict[str, _Node]:
    """Return what the XML describes, by name; raises `CameraDescriptionError`."""
    if len(xml) > XML_LIMIT:
        raise CameraDescriptionError(f"its {len(xml)} bytes are more than {XML_LIMIT}")
    try:
        root = ElementTree.fromstring(xml, ElementTree.XMLParser(target=_NoDocumentType()))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise CameraDescriptionError(f"it is no XML ({error})") from error
    if _tag(root) != "RegisterDescription":
        raise CameraDescriptionError(f"it describes a {_tag(root)[:80]}, not registers")
    nodes: dict[str, _Node] = {}
    groups = [root]
    for group in groups:
        for element in group:
            if _tag(element) == "Group":
                groups.append(element)
            else:
                node = _read_node(element)
                nodes.update(_struct_entries(node))
                if node.name:
                    nodes[node.name] = node
    return nodes


def _read_node(element: ElementTree.Element, within: int = 0) -> _Node:
    items = tuple(
        _Item(
            _tag(child),
            (child.text or "").strip(),
            child.get("Name", ""),
            child.get("Offset", ""),
            child.get("Index", ""),
            _read_node(child, within + 1) if len(child) and within < 2 else None,
        )
        for child in element
    )
    return _Node(_tag(element), element.get("Name", ""), items)


def _struct_entries(node: _Node) -> dict[str, _Node]:
    """Return the fields of a structured register, as registers of their own."""
    if node.kind != "StructReg":
        return {}
    shared = tuple(item for item in node.items if item.tag != "StructEntry")
    entries = [item.node for item in node.all("StructEntry") if item.node is not None]
    return {e.name: _Node("MaskedIntReg", e.name, e.items + shared) for e in entries}


def _tag(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _integer(text: str | None) -> int:
    """Return the integer in a text, decimal or hexadecimal; nothing is 0."""
    stripped = (text or "0").strip()
    hexadecimal = stripped.lower().lstrip("+-").startswith("0x")
    return int(stripped, 16 if hexadecimal else 10)


def _truth(text: str) -> int:
    return {"true": 1, "false": 0}.get(text.strip().lower(), 0) or int(text.strip() == "1")


def _whole(value: Number) -> int:
    """Return the nearest integer, halves away from zero."""
    if isinstance(value, int):
        return value
    return int(abs(value) + 0.5) * (1 if value >= 0 else -1)


def _order(node: _Node) -> str:
    big = (node.text("Endianess") or node.text("Endianness") or "").strip() == "BigEndian"
    return ">" if big else "<"


def _bits(node: _Node, length: int) -> tuple[int, int]:
    """Return a field's lowest bit and its width.

    In big-endian registers bits are counted from the highest one on.
    """
    bit = node.text("Bit")
    ends = [_integer(bit)] * 2 if bit is not None else [_integer(node.text(t)) for t in _ENDS]
    if _order(node) == ">":
        ends = [8 * length - 1 - end for end in ends]
    low, high = sorted(ends)
    if not 0 <= low <= high < 8 * length:
        raise CameraDescriptionError(f"{node.name} has bits {low} to {high} of {length} bytes")
    return low, high - low + 1


HAS, READ, WRITE = "has", "reads", "writes"
Access = frozenset[str]
"""Whether a feature exists, and can be read and written now."""
ABSENT: Access = frozenset()
UNAVAILABLE, READABLE = Access((HAS,)), Access((HAS, READ))
EVERYTHING = Access((HAS, READ, WRITE))
ACCESS_MODES = {"RO": READABLE, "WO": Access((HAS, WRITE)), "RW": EVERYTHING}
EVERYTHING_OF = {READABLE: EVERYTHING, UNAVAILABLE: UNAVAILABLE, ABSENT: ABSENT}
"""Access to a node that the access to its inputs allows."""
_INPUTS = ("pVariable", "pAddress", "pIndex", "pMin", "pMax", "pInc")
_COMPUTED = ("SwissKnife", "IntSwissKnife", "Category", "EnumEntry")
_ENDS = ("LSB", "MSB")
_ORDERS: dict[str, Literal["little", "big"]] = {"<": "little", ">": "big"}
_FLOATS = {4: "f", 8: "d"}
_REGISTERS = ("IntReg", "MaskedIntReg", "FloatReg")
_PLAIN: dict[str, Callable[[str], Number]] = {
    "Integer": _integer,
    "Float": float,
    "Enumeration": _integer,
    "Boolean": _truth,
    "Command": _integer,
}
"""Nodes that hold a value or name the node that does, and how a value in the XML is read."""
_HOLDING = (*_PLAIN, "String", "Converter", "IntConverter")
_OPEN: dict[str, Limits] = {
    "Integer": (-(1 << 63), (1 << 63) - 1),
    "Float": (-math.inf, math.inf),
}
