"""The numbers that a program computes, one by one: arrays are arrays of *elements*.

An element is a number of one run: a constant, a variable, or an operation on elements. An array of
the traced function is an integer array of elements, so that slices, transposes, concatenations and
whatever else only moves numbers cost nothing when the program runs, zeros are known to be zeros
wherever they go, and what is computed twice is found.

A product with a known zero is 0 only if the other number is finite. It is taken to be, and is a
*suspect*: a run in which a suspect turns out not to be finite is not this program's to compute.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import contextmanager
from itertools import repeat
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    Refs = Any
else:
    Refs = np.ndarray | np.integer
"""Elements, integers; of any shape."""

CONSTANT, VARIABLE = 0, 1


class Operation(NamedTuple):
    """An operation as C++ text with operands {0}, {1}, {2}, and as a NumPy function."""

    text: str
    value: Callable[..., Any]
    commutes: bool = False


def _truth(function):
    return lambda *x: function(*x).astype(float)


def _compared(sign: str, function: Callable[..., Any]) -> Operation:
    return Operation(f"(({{0}} {sign} {{1}}) ? ONE : ZERO)", _truth(function))


def _called(name: str, function: Callable[..., Any]) -> Operation:
    return Operation(f"l_{name}({{0}})", function)


def _select(which, first, second):
    return np.where(which != 0, second, first)


def _round_away(x):
    whole = np.floor(np.abs(x))
    return np.copysign(whole + (np.abs(x) - whole >= 0.5), x)


def _within(x, low, high):
    return np.where((low <= x) & (x <= high), 0.0, np.nan)


OPERATIONS = {
    "copy": Operation("{0}", np.positive),
    "add": Operation("({0} + {1})", np.add, True),
    "sub": Operation("({0} - {1})", np.subtract),
    "mul": Operation("({0} * {1})", np.multiply, True),
    "div": Operation("({0} / {1})", np.divide),
    "neg": Operation("(-{0})", np.negative),
    "max": Operation("l_max({0}, {1})", np.maximum, True),
    "min": Operation("l_min({0}, {1})", np.minimum, True),
    "eq": _compared("==", np.equal),
    "ne": _compared("!=", np.not_equal),
    "lt": _compared("<", np.less),
    "le": _compared("<=", np.less_equal),
    "gt": _compared(">", np.greater),
    "ge": _compared(">=", np.greater_equal),
    "and": Operation("({0} * {1})", _truth(np.logical_and), True),
    "or": Operation("l_max({0}, {1})", _truth(np.logical_or), True),
    "not": Operation("(ONE - {0})", _truth(np.logical_not)),
    "select": Operation("(({0} != ZERO) ? {2} : {1})", _select),
    "is_finite": Operation("l_is_finite({0})", _truth(np.isfinite)),
    "sqrt": Operation("l_sqrt({0})", np.sqrt),
    "cbrt": _called("cbrt", np.cbrt),
    "abs": Operation("l_fabs({0})", np.abs),
    "floor": _called("floor", np.floor),
    "ceil": _called("ceil", np.ceil),
    "rem": Operation("l_fmod({0}, {1})", np.fmod),
    "round_to_even": _called("rint", np.rint),
    "round_away": _called("round", _round_away),
    "trunc": _called("trunc", np.trunc),
    "sign": Operation("l_sign({0})", np.sign),
    "sin": _called("sin", np.sin),
    "cos": _called("cos", np.cos),
    "tan": _called("tan", np.tan),
    "asin": _called("asin", np.arcsin),
    "acos": _called("acos", np.arccos),
    "atan": _called("atan", np.arctan),
    "sinh": _called("sinh", np.sinh),
    "cosh": _called("cosh", np.cosh),
    "tanh": _called("tanh", np.tanh),
    "exp": _called("exp", np.exp),
    "expm1": _called("expm1", np.expm1),
    "log": _called("log", np.log),
    "log1p": _called("log1p", np.log1p),
    "atan2": Operation("l_atan2({0}, {1})", np.arctan2),
    "pow": Operation("l_pow({0}, {1})", np.power),
    "within": Operation("l_within({0}, {1}, {2})", _within),
    "apart_from_zero": Operation(
        "l_apart_from_zero({0})", lambda x: np.where(x * 0 == x, np.nan, 0)
    ),
}
"""On numbers of one kind: integers are numbers without a fraction, and truth is 0 or 1. `within` is
0 for first operands from the second to the third, `apart_from_zero` for all but 0; else NaN."""
TRUTHS = ("eq", "ne", "lt", "le", "gt", "ge", "and", "or", "not", "is_finite")
BOUNDED = ("copy", "neg", "max", "min", "abs", "floor", "ceil", "trunc", "sign", "sin", "cos")
"""Finite where all operands are."""
NAMES = tuple(OPERATIONS)
CODES = {name: code for code, name in enumerate(NAMES, start=2)}


class Elements:
    """All elements of a program, in an order in which they can be computed."""

    def __init__(self, dtype: Any) -> None:
        self.dtype = np.dtype(dtype)
        self.size = 0
        self._code = np.zeros(1024, np.int16)
        self._arguments = np.zeros((1024, 3), np.int32)
        self._value = np.zeros(1024)
        self._region = np.zeros(1024, np.int32)
        self._finite = np.zeros(1024, bool)
        self._regions = 1
        self._known: list[dict[tuple[Any, ...], Any]] = [{}]
        self._inside = [0]
        self._suspects: list[set[int]] = [set()]
        self._constants: dict[int, int] = {}
        self.zero, self.one = (int(self.constant(x)) for x in (0.0, 1.0))

    @property
    def code(self) -> np.ndarray:
        """The code of every element: CONSTANT, VARIABLE or one of `CODES`."""
        return self._code[: self.size]

    @property
    def arguments(self) -> np.ndarray:
        """Operands; 0 for what an operation does not have."""
        return self._arguments[: self.size]

    @property
    def value(self) -> np.ndarray:
        """The value of every element that is a constant."""
        return self._value[: self.size]

    @property
    def region(self) -> np.ndarray:
        """The loop in which every element is computed."""
        return self._region[: self.size]

    @contextmanager
    def inside(self):
        """Open the body of a loop: elements made inside are not known outside."""
        self._known.append({})
        self._suspects.append(set())
        self._inside.append(self._regions)
        self._regions += 1
        try:
            yield
        finally:
            self._known.pop()
            self._suspects.pop()
            self._inside.pop()

    def constant(self, values: Any) -> Refs:
        """Elements for known numbers. Raises ValueError for integers that are none of these."""
        given = np.asarray(values)
        values = given.astype(self.dtype).astype(float)
        if np.issubdtype(given.dtype, np.integer) and np.any(values != given):
            raise ValueError("integers of so many digits are not supported by the native backend")
        bits, places = values.ravel().view(np.int64).tolist(), self._constants
        for one in sorted(set(bits).difference(places)):
            places[one] = place = int(self._new(1, CONSTANT)[0])
            self._value[place] = value = np.int64(one).view(float)
            self._finite[place] = np.isfinite(value)
        return np.array([places[one] for one in bits], np.int32).reshape(values.shape)

    def variables(self, shape: tuple[int, ...]) -> Refs:
        """Numbers that something else writes."""
        return self._new(math.prod(shape), VARIABLE).reshape(shape)

    def _new(self, count: int, code: int) -> Refs:
        start, self.size = self.size, self.size + count
        while self.size > len(self._code):
            for name in ("_code", "_arguments", "_value", "_region", "_finite"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))
        self._code[start : self.size] = code
        self._region[start : self.size] = self._inside[-1]
        return np.arange(start, self.size, dtype=np.int32)

    def is_constant(self, refs: Refs) -> Any:
        """Return which of the elements are constants."""
        return self._code[refs] == CONSTANT

    def is_zero(self, refs: Refs) -> Any:
        """Return which of the elements are zero, of either sign."""
        return self.is_constant(refs) & (self._value[refs] == 0)

    def known(self, refs: Refs) -> Any:
        """Values, where all are constant."""
        return self._value[refs] if np.all(self.is_constant(refs)) else None

    def suspect(self, refs: Refs) -> None:
        """These are to be finite, here."""
        refs = np.ravel(refs)
        self._suspects[-1].update(np.unique(refs[~self._finite[refs]]).tolist())

    def finite(self, refs: Refs) -> None:
        """These are known to be finite."""
        self._finite[refs] = True

    def suspects(self) -> Refs:
        """The suspects of the open loop, or of the program where none is open."""
        return np.array(sorted(self._suspects[-1]), np.int32)

    def region_now(self) -> int:
        """The loop that is open."""
        return self._inside[-1]

    def once(self, key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """Return what was made under this key here or in an enclosing loop, or make it now."""
        for known in reversed(self._known):
            if key in known:
                return known[key]
        self._known[-1][key] = made = make()
        return made

    def apply(self, name: str, *arguments: Refs) -> tuple[Refs, Refs]:
        """The results, and which elements are new for them."""
        arrays = np.broadcast_arrays(*arguments)
        flat = [x.ravel() for x in arrays]
        result = np.full(flat[0].shape, -1, np.int32)
        constants = [self.is_constant(x) for x in flat]
        some = name == "select" or any(x.any() for x in constants)
        if some and (constant := np.logical_and.reduce(constants)).any():
            result[constant] = self._folded(name, [x[constant] for x in flat])
        before = self.size
        for where, instead in self._shortcuts(name, flat) if some else ():
            where = where & (result < 0)
            np.copyto(result, instead, where=where)
            self._suspected(name, flat, where & (result == self.zero))
        todo = result < 0
        if todo.any():
            result[todo] = self._computed(name, [x[todo] for x in flat])
        return result.reshape(arrays[0].shape), np.arange(before, self.size, dtype=np.int32)

    def _folded(self, name: str, arguments: list[Refs]) -> Refs:
        with np.errstate(all="ignore"):
            values = OPERATIONS[name].value(*(self._value[x].astype(self.dtype) for x in arguments))
        return self.constant(values)

    def _suspected(self, name: str, x: list[Refs], zero: np.ndarray) -> None:
        """Suspect what must be finite, and in a quotient not zero, for results taken to be 0."""
        if not zero.any():
            return
        if name == "mul":
            for a in x:
                self.suspect(a[zero])
        elif name == "div":
            self.suspect(self._computed("apart_from_zero", [x[1][zero]]))

    def _shortcuts(self, name: str, x: list[Refs]):
        """Where, and what is the result without computing it. A product with 0 is 0."""
        if name in ("mul", "and"):
            for a, b in (x, x[::-1]):
                yield self.is_zero(a), self.zero
                yield a == self.one, b
        elif name in ("add", "or"):
            for a, b in (x, x[::-1]):
                yield self.is_zero(a), b
        elif name == "sub":
            yield self.is_zero(x[1]), x[0]
        elif name == "div":
            yield x[1] == self.one, x[0]
            yield self.is_zero(x[0]) & ~self.is_constant(x[1]), self.zero
        elif name == "select":
            yield self.is_zero(x[0]) | (x[1] == x[2]), x[1]
            yield self.is_constant(x[0]), x[2]

    def _computed(self, name: str, arguments: list[Refs]) -> Refs:
        """One element for every set of operands, in the order of their first use."""
        keys = np.zeros((len(arguments[0]), 3), np.int32)
        keys[:, : len(arguments)] = np.stack(arguments, 1)
        if OPERATIONS[name].commutes:
            keys[:, :2].sort(axis=1)
        code, start = CODES[name], self.size
        here, enclosing = self._known[-1], self._known[-2::-1]
        found, missing = [], []
        for place, key in enumerate(zip(repeat(code), *keys.T.tolist())):
            ref = here.get(key)
            for known in enclosing if ref is None else ():
                if (ref := known.get(key)) is not None:
                    break
            if ref is None:
                here[key] = ref = start + len(missing)
                missing.append(place)
            found.append(ref)
        keys, new = keys[missing], self._new(len(missing), code)
        self._arguments[new] = keys
        if name in TRUTHS:
            self._finite[new] = True
        elif name in BOUNDED:
            self._finite[new] = self._finite[keys[:, : len(arguments)]].all(1)
        elif name == "select":
            self._finite[new] = self._finite[keys[:, 1:]].all(1)
        return np.array(found, np.int32)
