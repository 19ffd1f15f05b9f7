"""A hook: a function of the lab's own that a plan has called between frames.

    between: lab:hook         # lab.py beside the plan, or an installed module, or an entry point

    def hook(rig, frame, note): ...

It is called before every frame, after work by hand at the bench (lamp, board, masks) and before any
axis moves; and once after the last frame, with `frame` None. All earlier frames are on the disk by
then. rig: a `Rig`, its devices open. frame: the next `PlannedFrame`. `note(power_w=0.1)` puts facts
into the journal: numbers, texts, lists, mappings. Raising `StopCapture` ends the capture; any other
error stops the capture with a line, and the same command goes on. A hook that does not return yet
pauses the capture; Ctrl-C ends it then. Afterwards the positions of axes are read again, and
everything else is set again.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from emmc_rig.bench.hardware import Rig
from emmc_rig.captures.faults import GaveUpError
from emmc_rig.errors import AppError
from emmc_rig.model.json_text import one_line
from emmc_rig.session.planned import PlannedFrame

HOOKS = "emmc_rig.hooks"
"""The group of entry points."""
Note = Callable[..., None]
Hook = Callable[[Rig, PlannedFrame | None, Note], object]


class HookError(GaveUpError):
    """What a hook raised; everything captured so far is kept."""

    def __init__(self, hook: Between, frame_id: str, fault: BaseException) -> None:
        when = f"before frame {frame_id}" if frame_id else "after the last frame"
        AppError.__init__(self, f"between: {hook.name} raised {hook.shown(fault)}, {when}")


@dataclass(frozen=True)
class Between:
    """A hook by its name in the plan; file: of its source, "" if unknown."""

    name: str
    call: Hook
    file: str = ""

    def facts(self) -> dict[str, str]:
        """Return what the journal keeps of it: name, file and the file's SHA-256."""
        try:
            digest = hashlib.sha256(Path(self.file).read_bytes()).hexdigest()
        except OSError:
            return {"name": self.name}
        return {"name": self.name, "file": self.file, "sha256": digest}

    def shown(self, fault: BaseException) -> str:
        """Return what was raised, in a line, and where in the hook's file."""
        lines, trace = [], fault.__traceback__
        while trace is not None:
            if trace.tb_frame.f_code.co_filename == self.file:
                lines.append(trace.tb_lineno)
            trace = trace.tb_next
        where = f" ({Path(self.file).name}, line {lines[-1]})" if lines else ""
        text = one_line(fault)
        return f"{type(fault).__name__}{f': {text}' if text else ''}{where}"


def load_hook(name: str, *folders: Path) -> Between:
    """Return the hook of a plan; folders: searched in order for the hook's module.

    Raises AppError if no hook has the name, if it cannot be loaded, or if it does not take
    (rig, frame, note).
    """
    module, colon, function = name.partition(":")
    try:
        if colon:
            files = [folder / f"{module.replace('.', '/')}.py" for folder in folders]
            file = next((file for file in files if file.is_file()), None)
            hook = _load(name) if file is None else _of_file(file, function)
        else:
            hook = next(iter(entry_points(group=HOOKS, name=name))).load()
    except ModuleNotFoundError as fault:
        if fault.name is None or not f"{module}.".startswith(f"{fault.name}."):
            raise AppError(f"between: {name} cannot be loaded: {one_line(fault)}") from fault
        looked = " or ".join(str(folder) for folder in dict.fromkeys(folders))
        raise AppError(
            f"between: {name}: there is no {module}.py in {looked}, and no installed module "
            f"{module}: put it beside the plan"
        ) from fault
    except StopIteration as fault:
        known = ", ".join(sorted(entry_points(group=HOOKS).names)) or "none"
        raise AppError(
            f"between: {name}: write module:function, or the name of an entry point of "
            f"{HOOKS} (there are: {known})"
        ) from fault
    except (Exception, SystemExit) as fault:
        text = f"{type(fault).__name__}: {one_line(fault)}"
        raise AppError(f"between: {name} cannot be loaded: {text}") from fault
    try:
        inspect.signature(hook).bind(None, None, None)
    except (TypeError, ValueError) as fault:
        raise AppError(f"between: {name} is no function of (rig, frame, note): {fault}") from fault
    if inspect.iscoroutinefunction(hook) or inspect.isgeneratorfunction(hook):
        raise AppError(f"between: {name} is a generator or coroutine: write a plain function")
    code = getattr(inspect.unwrap(hook), "__code__", None)
    return Between(name, hook, getattr(code, "co_filename", ""))


def plain(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return facts as JSON keeps them, arrays as lists, what is not finite as text.

    Raises `TypeError` or `ValueError` for what JSON cannot keep.
    """

    def of_numpy(value: Any) -> Any:
        if hasattr(value, "tolist"):
            return value.tolist()
        raise TypeError(
            f"note() takes numbers, texts, lists and mappings, not {type(value).__name__}"
        )

    text = json.dumps(facts, default=of_numpy)
    return json.loads(text, parse_constant=str)  # noqa: TID251 - the text of the line above


def _load(value: str) -> Hook:
    return EntryPoint("between", value, HOOKS).load()


def _of_file(file: Path, function: str) -> Hook:
    """Return a function of a file as it is now, whatever was imported under that name before."""
    folder = str(file.parent)
    if folder not in sys.path:
        sys.path.append(folder)  # for what it imports; nothing installed is hidden
    found: Any = ModuleType(f"emmc_hook_{file.stem}")
    found.__file__ = str(file)
    sys.modules[found.__name__] = found
    exec(compile(file.read_bytes(), str(file), "exec"), found.__dict__)
    for part in function.split("."):
        found = getattr(found, part)
    return found
