"""GenICam formulas: parsed by hand and evaluated with bounds, since a device wrote them.

Nothing of the text is ever run as code. Order and meaning of the operators are those of EMVA's
reference implementation (GenApi 3.5, package `genicam`), which are not C's: comparisons, `&&`,
`||` and `?:` are equal in rank, and so are `**`, shifts and the operators on bits, which bind
most; equals go from left to right. A minus before a number or a variable belongs to that alone,
before anything else to all that follows: `-(5)+3` is -8. `=` is equality, `<>` inequality;
integers have 64 bits and divide towards zero; in floating point LN(0) is minus infinity, and what
has no value is not a number.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Number = int | float
Lookup = Callable[[str], Number]
Evaluate = Callable[["_Scope"], Number]
Join = Callable[["_Scope", Number, Evaluate], Number]
"""What a binary operator does with the value on its left; its right side may go unasked."""

LENGTH_LIMIT = 10_000
DEPTH_LIMIT = 80

_TOKEN = re.compile(
    r"\s*(?:(0[xX][0-9a-fA-F]+)|(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?)"
    r"|([A-Za-z_][\w.]*)|(\*\*|<<|>>|<=|>=|<>|&&|\|\||[-+*/%&|^~<>=?:(),]))"
)

LEVELS = (
    ("<", ">", "<=", ">=", "=", "<>", "&&", "||", "?"),
    ("+", "-"),
    ("*", "/", "%"),
    ("**", "<<", ">>", "&", "|", "^"),
)
"""Binary operators, those that bind least first; equals go from left to right."""

COMPARISONS: dict[str, Callable[[Number, Number], bool]] = {
    "=": operator.eq,
    "<>": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
}
CONSTANTS = {"PI": math.pi, "E": math.e}
FUNCTIONS: dict[str, Callable[..., Number]] = {
    "SGN": lambda x: (x > 0) - (x < 0),
    "NEG": lambda x: -x,
    "ABS": lambda x: abs(x),
    "SQRT": np.sqrt,
    "SIN": np.sin,
    "COS": np.cos,
    "TAN": np.tan,
    "ASIN": np.arcsin,
    "ACOS": np.arccos,
    "ATAN": np.arctan,
    "EXP": np.exp,
    "LN": np.log,
    "LG": np.log10,
    "TRUNC": lambda x: math.trunc(x),
    "FLOOR": math.floor,
    "CEIL": math.ceil,
    "ROUND": lambda x, places=0: _rounded(x, places),
}


class FormulaError(ValueError):
    """A formula that cannot be read, or that has no value."""


@dataclass(frozen=True)
class _Scope:
    lookup: Lookup
    integers: bool

    def number(self, value: Number) -> Number:
        """Return the value as numbers are here: of 64 bits, or floating."""
        if self.integers:
            return _wrapped(value) if isinstance(value, int) else value
        return float(value)

    def called(self, function: Callable[..., Number], *values: Number) -> Number:
        """Return a function's value; in integers what has none is an error."""
        with np.errstate(all="raise" if self.integers else "ignore"):
            found = function(*values)
        return found.item() if isinstance(found, np.generic) else found


class Formula:
    """A formula, ready to be evaluated; raises `FormulaError` for text that is none."""

    def __init__(self, text: str) -> None:
        if len(text) > LENGTH_LIMIT:
            raise FormulaError(f"a formula of {len(text)} characters is longer than allowed")
        self._tokens = _tokens(text)
        self._at = 0
        self._depth = 0
        self._run = self._choice()
        if self._at < len(self._tokens):
            raise FormulaError(f"{self._tokens[self._at][1]!r} is out of place in {text!r}")

    def value(self, lookup: Lookup, integers: bool) -> Number:
        """Return the value, in integers of 64 bits or in floating point.

        `lookup` returns a variable's value, and is asked only for those that matter. Raises
        `FormulaError` where there is no value, and what `lookup` raises.
        """
        try:
            result = self._run(_Scope(lookup, integers))
            return _wrapped(int(result)) if integers else float(result)
        except (ArithmeticError, ValueError, TypeError) as error:
            raise FormulaError(f"the formula has no value ({error})") from error

    def _choice(self) -> Evaluate:
        self._depth += 1
        if self._depth > DEPTH_LIMIT:
            raise FormulaError("the formula is nested deeper than allowed")
        value = self._binary(0)
        self._depth -= 1
        return value

    def _binary(self, level: int) -> Evaluate:
        if level == len(LEVELS):
            return self._signed()
        first = self._binary(level + 1)
        rest: list[tuple[Join, Evaluate]] = []
        while (symbol := self._takes(*LEVELS[level])) is not None:
            join = JOINS[symbol] if symbol != "?" else self._branch()
            rest.append((join, self._binary(level + 1)))
        if not rest:
            return first

        def chain(scope: _Scope) -> Number:
            value = first(scope)
            for join, operand in rest:
                value = scope.number(join(scope, value, operand))
            return value

        return chain

    def _branch(self) -> Join:
        yes = self._choice()
        self._needs(":")
        return lambda scope, left, right: yes(scope) if left else right(scope)

    def _signed(self) -> Evaluate:
        symbol = self._takes("-", "+", "~")
        if symbol is None:
            return self._single()
        self._depth += 1
        if self._depth > DEPTH_LIMIT:
            raise FormulaError("the formula is nested deeper than allowed")
        takes_all = symbol == "-" and not self._is_plain()
        operand = self._choice() if takes_all else self._signed()
        self._depth -= 1
        if symbol == "-":
            return lambda scope: -operand(scope)
        if symbol == "~":
            return lambda scope: scope.number(~_integer(operand(scope)))
        return operand

    def _is_plain(self) -> bool:
        """Return whether a number or a variable comes next, or another sign."""
        kind, text = self._tokens[self._at] if self._at < len(self._tokens) else ("", "")
        if kind == "name":
            return text not in FUNCTIONS or self._tokens[self._at + 1 :][:1] != [("symbol", "(")]
        return kind == "number" or text in ("-", "+")

    def _single(self) -> Evaluate:
        if self._takes("("):
            inside = self._choice()
            self._needs(")")
            return inside
        if self._at == len(self._tokens):
            raise FormulaError("the formula ends too early")
        kind, text = self._tokens[self._at]
        self._at += 1
        if kind == "number":
            return _literal(text)
        if kind != "name":
            raise FormulaError(f"{text!r} is out of place in a formula")
        if text in FUNCTIONS and self._takes("("):
            function, operands = FUNCTIONS[text], [self._choice()]
            if text == "ROUND" and self._takes(","):
                operands.append(self._choice())
            self._needs(")")
            return lambda scope: scope.number(
                scope.called(function, *(operand(scope) for operand in operands))
            )
        if text in CONSTANTS:
            constant = CONSTANTS[text]
            return lambda scope: constant

        def variable(scope: _Scope) -> Number:
            return scope.number(scope.lookup(text))

        return variable

    def _takes(self, *symbols: str) -> str | None:
        if self._at < len(self._tokens):
            kind, text = self._tokens[self._at]
            if kind == "symbol" and text in symbols:
                self._at += 1
                return text
        return None

    def _needs(self, symbol: str) -> None:
        if self._takes(symbol) is None:
            raise FormulaError(f"{symbol!r} is missing in a formula")


def _tokens(text: str) -> list[tuple[str, str]]:
    tokens, at = [], 0
    text = text.strip()
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise FormulaError(f"{text[at : at + 10]!r} is out of place in a formula")
        hexadecimal, number, name, symbol = match.groups()
        if symbol is not None:
            tokens.append(("symbol", symbol))
        elif name is not None:
            tokens.append(("name", name))
        else:
            tokens.append(("number", hexadecimal or number))
        at = match.end()
    return tokens


def _literal(text: str) -> Evaluate:
    if text.lower().startswith("0x"):
        value: Number = int(text, 16)
    elif text.isdigit():
        value = int(text)
    else:
        value = float(text)
    return lambda scope: scope.number(value)


def _computing(compute: Callable[[Number, Number], Number]) -> Join:
    return lambda scope, left, right: compute(left, right(scope))


def _comparing(compare: Callable[[Number, Number], bool]) -> Join:
    return lambda scope, left, right: int(compare(left, right(scope)))


def _divided(a: Number, b: Number) -> Number:
    if isinstance(a, int) and isinstance(b, int):
        quotient = abs(a) // abs(b)
        return quotient if (a < 0) == (b < 0) else -quotient
    return a / b


def _remainder(a: Number, b: Number) -> Number:
    if isinstance(a, int) and isinstance(b, int):
        return abs(a) % abs(b) * (-1 if a < 0 else 1)
    return math.fmod(a, b)


def _shifted(a: Number, b: Number, by: Callable[[int, int], int]) -> int:
    count = _integer(b)
    if not 0 <= count < 64:
        raise FormulaError(f"a shift by {count} bits")
    return by(_integer(a), count)


def _power(base: Number, exponent: Number, integers: bool) -> Number:
    if integers and isinstance(base, int) and isinstance(exponent, int) and exponent >= 0:
        # Reduced on the way: the whole power could have more digits than memory.
        return pow(base, exponent, 1 << 64)
    with np.errstate(all="raise" if integers else "ignore"):
        return float(np.power(float(base), float(exponent)))


def _rounded(value: Number, places: Number) -> Number:
    """Return the nearest number of so many decimal places, halves away from zero."""
    if not math.isfinite(value):
        return value
    scale = 10.0 ** int(places)
    return math.floor(abs(value) * scale + 0.5) / scale * (1 if value >= 0 else -1)


def _integer(value: Number) -> int:
    return _wrapped(int(value))


def _wrapped(value: int) -> int:
    """Return the value as 64 bits hold it."""
    return (value + (1 << 63)) % (1 << 64) - (1 << 63)


ARITHMETIC: dict[str, Callable[[Number, Number], Number]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": _divided,
    "%": _remainder,
    "&": lambda a, b: _integer(a) & _integer(b),
    "|": lambda a, b: _integer(a) | _integer(b),
    "^": lambda a, b: _integer(a) ^ _integer(b),
    "<<": lambda a, b: _shifted(a, b, operator.lshift),
    ">>": lambda a, b: _shifted(a, b, operator.rshift),
}
JOINS: dict[str, Join] = {
    "&&": lambda scope, left, right: int(bool(left) and bool(right(scope))),
    "||": lambda scope, left, right: int(bool(left) or bool(right(scope))),
    "**": lambda scope, left, right: _power(left, right(scope), scope.integers),
    **{symbol: _comparing(compare) for symbol, compare in COMPARISONS.items()},
    **{symbol: _computing(compute) for symbol, compute in ARITHMETIC.items()},
}
