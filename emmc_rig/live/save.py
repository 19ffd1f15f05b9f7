"""What the page to set up by found, written into a person's plan and rig files."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.bench.rig_config import SIMULATED, RealRig, SimulatedFile
from emmc_rig.captures.focus import FocusFound
from emmc_rig.captures.plan import Plan, load_plan
from emmc_rig.errors import AppError
from emmc_rig.formats.yaml_edit import Key, replace_text, with_values
from emmc_rig.live.alignment import MaskPlace
from emmc_rig.model.reading import parse_yaml, read_yaml
from emmc_rig.model.settings import validated


@dataclass(frozen=True)
class Found:
    """What was found; None: not yet. zero_um: by axis, where the mask is centred."""

    exposure_s: float | None = None
    mask: MaskPlace | None = None
    zero_um: Mapping[str, float] | None = None
    focus: FocusFound | None = None


class Files:
    """The plan and rig files that may be written, as named on the command line."""

    def __init__(self, plan: Path | None = None, rig: Path | None = None) -> None:
        self._plan, self._rig = plan, rig
        self._previewed: dict[Path, tuple[str, str]] = {}

    @property
    def takes(self) -> list[str]:
        """What these files have a place for: some of exposure, centre, mask, focus."""
        plan = ["exposure"] if self._plan is not None else []
        if self._rig is None:
            return plan
        simulated = _kind(read_yaml(self._rig, AppError)) == SIMULATED
        return [*plan, *([] if simulated else ["centre"]), "mask", "focus"]

    def preview(self, found: Found, what: Sequence[str]) -> str:
        """Return what `save` would change, as a unified diff; "": nothing.

        what: some of exposure, centre, mask, focus. Raises AppError.
        """
        self._previewed = {}
        if self._plan is not None and "exposure" in what and found.exposure_s is not None:
            shots = len(load_plan(self._plan).shots)
            values: dict[Key, float] = {
                ("shots", place, "exposure_s"): found.exposure_s for place in range(shots)
            }
            self._edit(self._plan, values)
        if self._rig is not None:
            self._edit(self._rig, _rig_values(found, what))
        return "".join(
            line
            for path, (before, after) in self._previewed.items()
            for line in difflib.unified_diff(
                before.splitlines(True), after.splitlines(True), str(path), str(path), n=1
            )
        )

    def save(self) -> list[str]:
        """Write what was previewed last, and return the files written; raises AppError."""
        if not self._previewed:
            raise AppError("nothing was previewed")
        written = []
        for path, (before, after) in self._previewed.items():
            replace_text(path, before, after)
            written.append(str(path))
        self._previewed = {}
        return written

    def _edit(self, path: Path, values: Mapping[Key, float]) -> None:
        before = path.read_text(encoding="utf-8")
        read = parse_yaml(before, str(path), AppError)
        simulated = SimulatedFile if _kind(read) == SIMULATED else RealRig
        settings = Plan if path == self._plan else simulated
        there = read if isinstance(read, dict) else {}
        earlier: dict[str | int, str] = {
            n: old for old, n in settings.renamed.items() if old in there
        }
        named = {(earlier.get(key[0], key[0]), *key[1:]): value for key, value in values.items()}
        after = with_values(before, named, str(path))
        validated(settings, parse_yaml(after, str(path), AppError), str(path), AppError)
        if after != before:
            self._previewed[path] = before, after


def _kind(rig: object) -> object:
    return rig.get("kind") if isinstance(rig, dict) else None


def _rig_values(found: Found, what: Sequence[str]) -> dict[Key, float]:
    values: dict[Key, float] = {}
    if "centre" in what and found.zero_um is not None:
        values |= {("zero_um", axis): um for axis, um in found.zero_um.items()}
    if "mask" in what and found.mask is not None:
        place = found.mask
        names = "rotation_deg", "rotation_deviation_deg", "scale", "scale_deviation"
        values |= {("mask", name): getattr(place, name) for name in names}
    if "focus" in what and found.focus is not None:
        values["fixed_positions_um", found.focus.axis] = found.focus.place_um
    return values
