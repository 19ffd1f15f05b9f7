"""Table of another program's files: a row for each file, or globs with a kind for each."""

from __future__ import annotations

import csv
import glob
import io
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from emmc_rig.drivers.capture_order import natural
from emmc_rig.errors import AppError
from emmc_rig.model.decoding.regular import check_regular, file_bytes
from emmc_rig.model.errors import did_you_mean
from emmc_rig.model.json_text import shown_path
from emmc_rig.model.settings import Settings, validated

ImportedKind = Literal[
    "shot", "dark", "reference", "whiteboard", "open", "validation", "check", "reference-check"
]
LONGEST_S = 3600.0
MOST_TABLE_BYTES = 16_000_000
SEPARATOR_LINE = re.compile(r'"?sep=(.)"?[,;\s]*', re.IGNORECASE)
"""The line by which spreadsheets say what separates cells."""
DECIMAL_COMMA = re.compile(r"^([+-]?\d+),(\d+(?:[eE][+-]?\d+)?)$")
WORKBOOK = b"PK\x03\x04"
"""How .xlsx and .ods begin, which are ZIP."""


def _seconds(value: object) -> object:
    """Return a number, or the seconds of a date and time as ISO 8601 writes it."""
    if isinstance(value, str) and re.match(r"\d{4}-", value):
        return datetime.fromisoformat(value).timestamp()
    return value


def _present_kind(value: object) -> object:
    """Return a kind of file as it is called now."""
    return "validation" if value == "held-out" else value


class Row(Settings):
    """One file; a column that is left empty is not known."""

    file: str = Field(description="from the table's folder; FILE@ARRAY where it holds several")
    kind: Annotated[ImportedKind, BeforeValidator(_present_kind)]
    shot: int | None = Field(default=None, ge=0, description="from 0, as in plans")
    exposure_s: float | None = Field(default=None, gt=0, le=LONGEST_S)
    gain: float = Field(default=1.0, ge=1, le=100, description="a factor, 1 at the lowest ISO")
    mask_x_um: float | None = Field(default=None, description="from where the mask is centred")
    mask_y_um: float | None = None
    aperture_x_um: float | None = Field(default=None, description="of the pinhole, from the axis")
    aperture_y_um: float | None = None
    turn_deg: float | None = Field(
        default=None, gt=0, lt=360, description="by which the white board is turned in its plane"
    )
    lamp: Literal["white", "red", "green", "blue", "off"] | None = None
    time: Annotated[float | None, BeforeValidator(_seconds)] = Field(
        default=None, description="seconds on any clock, or a date and time"
    )
    temperature_c: float | None = Field(default=None, ge=-273.15)

    @property
    def mask_um(self) -> tuple[float, float] | None:
        """Place of the mask, x and y; None where no column states it."""
        return _pair(self.mask_x_um, self.mask_y_um)

    @property
    def pinhole_um(self) -> tuple[float, float] | None:
        """Place of the pinhole, x and y; None where no column states it."""
        return _pair(self.aperture_x_um, self.aperture_y_um)

    def misuse(self) -> str:
        """Return what this kind of file cannot have and the row states, "" for nothing."""
        kind, masked = self.kind, any(self.mask_um or ())
        faults = {
            f"gain {self.gain:g}; only shots may have another than 1":
                self.gain != 1 and kind != "shot",
            f"kind {kind} with the lamp {self.lamp}":
                self.lamp is not None and (self.lamp == "off") != (kind == "dark"),
            f"a pinhole's place with kind {kind}; only a whiteboard is taken through one":
                self.pinhole_um is not None and kind != "whiteboard",
            f"turn_deg with kind {kind}; boards that are turned are open or reference":
                self.turn_deg is not None and kind not in ("open", "reference"),
            "a mask's place with kind reference, which is without masks: is it open?":
                kind == "reference" and masked,
        }  # fmt: skip
        return next((words for words, is_so in faults.items() if is_so), "")


def _pair(x_um: float | None, y_um: float | None) -> tuple[float, float] | None:
    return None if x_um is None and y_um is None else (x_um or 0.0, y_um or 0.0)


@dataclass(frozen=True)
class Listed:
    """A row, the place of the row for messages (where), and the path of its file.

    pattern: the glob that matched the file, whose files are in no order; "" for rows of a table.
    """

    row: Row
    where: str
    path: Path
    array: str = ""
    pattern: str = ""


def read_table(path: Path) -> list[Listed]:
    """Return the rows of a CSV table; raises AppError with the line that is wrong."""
    shown = shown_path(path)
    if check_regular(path, AppError) > MOST_TABLE_BYTES:
        raise AppError(f"{shown}: larger than {MOST_TABLE_BYTES // 10**6} MB: not a table")
    data = file_bytes(path, AppError)
    if data.startswith(WORKBOOK):
        raise AppError(f"{shown}: a workbook, not a table in CSV; save it as CSV UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise AppError(
            f"{shown}: not text in UTF-8 (byte {fault.start}); save it as CSV UTF-8"
        ) from fault
    if "\0" in text:
        raise AppError(f"{shown}: not text: it holds a zero byte; save it as CSV UTF-8")
    begins, separator = _separator(text)
    try:
        reader = csv.reader(io.StringIO(text, newline=None), delimiter=separator, strict=True)
        lines = list(reader)[begins:]
    except csv.Error as fault:
        raise AppError(f"{shown}: not a table in CSV ({fault})") from fault
    if not lines:
        raise AppError(f"{shown}: empty; its first line names the columns: file,kind,exposure_s")
    names = [name.strip() for name in lines[0]]
    twice = {name for name in names if name and names.count(name) > 1}
    if twice:
        raise AppError(f"{shown}: the column '{twice.pop()}' is there twice")
    if not {"file", "kind"} & {name.lower() for name in names}:
        raise AppError(
            f"{shown}, line {begins + 1}: names no column; the first line of a table is: "
            "file,kind,exposure_s"
        )
    columns = max(place for place, name in enumerate(names, 1) if name)
    unknown = {name for name in names if name} - set(Row.model_fields)
    found = []
    for number, line in enumerate(lines[1:], begins + 2):
        cells = [cell.strip() for cell in line]
        if separator != ",":  # so write programs of countries whose decimal point is a comma
            cells = [DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in cells]
        if not any(cells):
            continue
        where = f"{shown}, line {number}"
        # Spreadsheets write empty cells beyond the last column.
        given = {name: cell for name, cell in zip_longest(names, cells, fillvalue="") if cell}
        if "" in given or len(cells) < columns:
            raise AppError(
                f"{where}: {len(cells)} cells under {columns} columns; give a row a "
                "cell for each, empty where it has no value"
            )
        # A column that nobody fills is checked too: it may be misspelt.
        row = validated(Row, dict.fromkeys(unknown, "") | given, where, AppError)
        found.append(_listed(row, where, path.parent))
    if not found:
        raise AppError(f"{shown}: no row below the names of the columns")
    return found


def _separator(text: str) -> tuple[int, str]:
    """Return how many lines stand before the names of the columns, and what separates cells."""
    head = text.partition("\n")[0].strip("\r")
    if stated := SEPARATOR_LINE.fullmatch(head):
        return 1, stated[1]
    return 0, next((mark for mark in "\t;" if mark in head and "," not in head), ",")


def rows_of_globs(globs: Mapping[ImportedKind, Sequence[str]]) -> list[Listed]:
    """Return a row for every file that a glob of its kind names, 2 before 10; raises AppError.

    GLOB@ARRAY names an array in each of its files.
    """
    found = []
    for kind, patterns in globs.items():
        for pattern in patterns:
            names = sorted(glob.glob(pattern, recursive=True), key=natural)
            files, at, array = pattern.rpartition("@")
            if at and not names:
                matching = sorted(glob.glob(files, recursive=True), key=natural)
                names = [f"{name}@{array}" for name in matching]
            if not names:
                raise AppError(f"{pattern}: no file of that name or pattern ({kind}); correct it")
            listed = (_listed(Row(file=name, kind=kind), name, Path()) for name in names)
            found += [replace(row, pattern=pattern) for row in listed]
    return found


def _listed(row: Row, where: str, beside: Path) -> Listed:
    name, _, array = row.file.partition("@")
    if os.path.exists(beside / row.file):
        name, array = row.file, ""
    elif "\\" in name and not os.path.exists(beside / name):
        name = name.replace("\\", "/")  # a table written on Windows
    path = beside / name
    if not os.path.exists(path):
        near = did_you_mean(path.name, os.listdir(path.parent)) if path.parent.is_dir() else ""
        raise AppError(f"{where}: {shown_path(path)}: no such file; {near}".strip(" ;"))
    return Listed(row, where, path, array)
