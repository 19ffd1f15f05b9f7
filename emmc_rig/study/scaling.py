"""Tuned constants of modules: found, and scaled for as long as a block of code runs.

They are found, not listed: numbers in capitals at the top of a module. Those that compiled kernels
use are left out: they are frozen with the kernel.
"""

from __future__ import annotations

import ast
import inspect
import pkgutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

from emmc_rig.study.sweep import NotApplicableError
from reconstruction.verdict.rules import Limits

FACTORS = (2.0, 0.5)
Value = float | tuple[float, ...] | Limits


@dataclass(frozen=True)
class Constant:
    """A number, or several that are scaled together, of a module or of settings.

    module: its name within its package.
    """

    module: str
    name: str
    value: Value

    @property
    def label(self) -> str:
        """Return how a table calls it."""
        return f"{self.module}.{self.name}"


def modules_of(package: ModuleType) -> list[ModuleType]:
    """Return the modules of a package."""
    return [
        import_module(f"{package.__name__}.{one.name}")
        for one in pkgutil.iter_modules(package.__path__)
    ]


def short_name(module: ModuleType) -> str:
    """Return a module's name within its package."""
    return module.__name__.rpartition(".")[2]


def is_number(value: object) -> bool:
    """Return whether a constant can be scaled: a number, or several."""
    if isinstance(value, tuple):
        return bool(value) and all(map(is_number, value))
    return isinstance(value, int | float | Limits) and not isinstance(value, bool)


def _compiled(module: ModuleType) -> set[str]:
    """Return the names that the compiled functions of a module use."""
    kernels = [getattr(value, "py_func", None) for value in vars(module).values()]
    return {name for kernel in kernels if kernel for name in kernel.__code__.co_names}


def numbers_of(modules: Iterable[ModuleType]) -> list[Constant]:
    """Return the constants that the modules define."""
    modules = list(modules)
    found, frozen = [], set().union(*map(_compiled, modules))
    for module in modules:
        for node in ast.parse(inspect.getsource(module)).body:
            names = [
                name.id
                for target in getattr(node, "targets", ())
                for name in ast.walk(target)
                if isinstance(name, ast.Name) and name.id.isupper() and name.id not in frozen
            ]
            found += [
                Constant(short_name(module), name, value)
                for name in names
                if not name.startswith("_") and is_number(value := getattr(module, name))
            ]
    return found


def scaled_value(constant: Constant, factor: float) -> Value:
    """Return the constant's value times a factor, a whole number at least 1.

    An odd width in pixels stays odd, as windows around a pixel are: half of it is scaled.
    Raises NotApplicableError for a whole number that stays what it is.
    """
    given = constant.value
    if isinstance(given, int) and given % 2 and constant.name.endswith("_PX"):
        value = 2 * round(given // 2 * factor) + 1
    else:
        value = _times(given, factor)
    if value == constant.value:
        raise NotApplicableError(f"{constant.label} stays {value}")
    return value


def _times(value: Value, factor: float) -> Value:
    if isinstance(value, Limits):
        return value.times(factor)
    if isinstance(value, tuple):
        return tuple(_times(one, factor) for one in value)  # type: ignore[return-value]
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


@contextmanager
def scaled(modules: Iterable[ModuleType], constant: Constant, factor: float) -> Iterator[None]:
    """Let the modules use a constant times a factor until the block ends.

    Raises NotApplicableError as `scaled_value` does.
    """
    value = scaled_value(constant, factor)
    modules = list(modules)
    home = next(one for one in modules if short_name(one) == constant.module)
    was = getattr(home, constant.name)
    # Modules import names from each other: each has its own.
    users = [one for one in modules if getattr(one, constant.name, None) is was]
    try:
        for one in users:
            setattr(one, constant.name, value)
        yield
    finally:
        for one in users:
            setattr(one, constant.name, was)
