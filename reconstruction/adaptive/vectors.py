"""Functions of vector instructions for kernels, written in the language of Numba's compiler (LLVM).

Numba vectorises no loop as short as a row of a few values, and keeps no small matrix in registers.
Such functions name vectors of float32, which LLVM maps to the registers that a processor has. They
take numbers and flat arrays; no index is checked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic as numba_intrinsic

FLOAT = ir.FloatType()
LANE = ir.IntType(32)
intrinsic = cast(Callable[[Callable], Callable[..., Any]], numba_intrinsic)
"""A kernel calls it without its first parameter, Numba's context of types."""


class Code:
    """Writes the instructions of one function."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    def place(self, flat: Any, at: Any, further: int = 0) -> Any:
        """Return the address of flat[at + further]."""
        return self.builder.gep(flat, [self.builder.add(at, ir.Constant(at.type, further))])

    def load(self, flat: Any, at: Any, count: int, further: int = 0) -> Any:
        """Return `count` elements from flat[at + further] on, float32 or int16, as a vector of
        float32."""
        element = flat.type.pointee
        where = self._vector_at(self.place(flat, at, further), element, count)
        values = self.builder.load(where, align=4 if element == FLOAT else 2)
        if element == FLOAT:
            return values
        return self.builder.sitofp(values, ir.VectorType(FLOAT, count))

    def store(self, values: Any, flat: Any, at: Any, further: int = 0) -> None:
        """Set the float32 from flat[at + further] on to a vector."""
        where = self.place(flat, at, further)
        self.builder.store(values, self._vector_at(where, FLOAT, values.type.count), align=4)

    def _vector_at(self, where: Any, element: Any, count: int) -> Any:
        return self.builder.bitcast(where, ir.VectorType(element, count).as_pointer())

    def lanes(self, values: Any, which: Sequence[int]) -> Any:
        """Return the vector of some lanes of another."""
        none = ir.Constant(values.type, ir.Undefined)
        lanes = ir.Constant(ir.VectorType(LANE, len(which)), list(which))
        return self.builder.shuffle_vector(values, none, lanes)

    def spread(self, value: Any, count: int) -> Any:
        """Return a vector of which every lane is the value."""
        none = ir.Constant(ir.VectorType(FLOAT, count), ir.Undefined)
        return self.lanes(self.builder.insert_element(none, value, LANE(0)), [0] * count)


def function(returned: Any, kinds: Sequence[Any], write: Callable, code: type[Code] = Code) -> Any:
    """Return the signature of a function of arrays and numbers, and what generates it.

    write: called with the code and the arguments: arrays as pointers to their first number, numbers
    as 64-bit integers or float32. What it returns the function returns.
    """
    known = [
        types.intp
        if isinstance(kind, types.Integer)
        else types.float32
        if isinstance(kind, types.Float)
        else kind
        for kind in kinds
    ]

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        given = [
            context.make_array(kind)(context, builder, value).data
            if isinstance(kind, types.Array)
            else value
            for kind, value in zip(signature.args, values, strict=True)
        ]
        out = write(code(builder), *given)
        return context.get_dummy_value() if out is None else out

    return returned(*known), generate
