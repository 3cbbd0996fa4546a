"""The translation of a traced function to a program on elements: a rule for every primitive."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jax.interpreters import partial_eval

from jaxslam._numerics.tracing import free_gathers
from jaxslam.linalg import symmetric_part_p
from jaxslam.native.elements import OPERATIONS, Elements, Refs
from jaxslam.native.program import (
    Apply,
    Check,
    ElementProgram,
    Loop,
    Product,
    Put,
    Sort,
    Step,
    Take,
    While,
)
from jaxslam.native.rows import RowLoop

UNROLLED = 3000
"""Operations up to which all turns of a loop are written out: their indices are then known."""
TURNS = 64
"""Of a loop that is written out, at the most: each is a few lines of the program."""
FEW_TERMS = 3
FEW_PRODUCTS = 400
"""A product of matrices with fewer is written out number by number."""


class NotSupportedError(ValueError):
    """A function that has something for which there is no rule."""


def program(function: Callable[..., Any], *arguments: Any) -> tuple[ElementProgram, Any]:
    """The program of a function of such arguments, and the shapes of what it returns."""
    with free_gathers():
        traced, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    leaves = jax.tree.leaves(arguments)
    jaxpr, used = partial_eval.dce_jaxpr(traced.jaxpr, [True] * len(traced.out_avals))[:2]
    tracer = Tracer(Elements(_dtype([*leaves, *traced.out_avals])))
    inputs = [tracer.elements.variables(x.shape) for x in leaves]
    for x, refs, needed in zip(leaves, inputs, used, strict=True):
        if needed:
            tracer.given(refs, x.dtype)
    given = [x for x, needed in zip(inputs, used, strict=True) if needed]
    outputs = tracer.run(jaxpr, traced.consts, given)
    tracer.check()
    return ElementProgram(tracer.elements, tracer.steps, inputs, outputs), shapes


def _dtype(avals: Sequence[Any]) -> np.dtype:
    found = {np.dtype(x.dtype) for x in avals if np.issubdtype(x.dtype, np.floating)}
    if len(found) != 1 or not found <= {np.dtype("float32"), np.dtype("float64")}:
        raise NotSupportedError(f"numbers of {found} are not supported by the native backend")
    return found.pop()


class Tracer:
    """Applies the rules, and gathers the steps."""

    def __init__(self, elements: Elements) -> None:
        self.elements = elements
        self.steps: list[Step] = []
        self.exact = 2 ** (np.finfo(elements.dtype).nmant + 1) - 1
        """Up to here, integers are numbers."""
        self.going: Refs | None = None
        """Where the loops around are still going on."""
        self.rows: list[RowLoop] = []
        """Those that the loops around read and write."""
        self.whole = False
        """Whether sums are of integers."""

    def check(self) -> None:
        """Append a check of what has been suspected here."""
        suspects = self.elements.suspects()
        if suspects.size:
            self.steps.append(Check(suspects, self.elements.region_now(), self.going))

    def given(self, refs: Refs, dtype: Any) -> None:
        """Numbers of this type come from outside."""
        self.supported(dtype)
        if np.dtype(dtype).kind != "f":
            self.elements.finite(refs)
        if np.issubdtype(dtype, np.integer) and np.iinfo(dtype).max > self.exact:
            self.within(refs, -self.exact, self.exact)

    def supported(self, dtype: Any) -> None:
        """Raise `NotSupportedError` for numbers of another precision, or that are none."""
        kind = getattr(dtype, "kind", "")
        if not (dtype == self.elements.dtype or kind in ("b", "i", "u")):
            numbers = self.elements.dtype
            raise NotSupportedError(
                f"{dtype} beside {numbers} is not supported by the native backend"
            )

    def within(self, refs: Refs, low: float, high: float) -> None:
        """Suspect what is not from low to high."""
        if not refs.size:
            return
        told = self.apply("within", refs, self.constant(float(low)), self.constant(float(high)))
        if not np.all(self.elements.known(told[self.elements.is_constant(told)]) == 0):
            raise NotSupportedError(
                "integers that overflow are not supported by the native backend"
            )
        self.elements.suspect(told)

    def run(self, jaxpr: Jaxpr, constants: Sequence[Any], arguments: Sequence[Refs]) -> list[Refs]:
        """Results of a traced function."""
        values: dict[Any, Refs] = {}

        def read(x):
            if isinstance(x, Literal):
                return self.elements.constant(np.asarray(x.val, x.aval.dtype))
            return values[x]

        values.update(zip(jaxpr.constvars, map(self.elements.constant, constants), strict=True))
        values.update(zip(jaxpr.invars, arguments, strict=True))
        for equation in jaxpr.eqns:
            results = self.one(equation, [read(x) for x in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def closed(self, traced: ClosedJaxpr | Jaxpr, arguments: Sequence[Refs]) -> list[Refs]:
        """Results of a function within."""
        if isinstance(traced, ClosedJaxpr):
            return self.run(traced.jaxpr, traced.consts, arguments)
        return self.run(traced, (), arguments)

    def one(self, equation: Any, arguments: list[Refs]) -> list[Refs]:
        """One operation, by its rule, and of integers only where they fit their type."""
        name, avals = equation.primitive.name, [v.aval for v in equation.outvars]
        if not any(name in known for known in (INNER, MOVES, RULES, OPERATIONS)):
            raise NotSupportedError(f"not supported by the native backend: {name}")
        for aval in avals if name not in INNER else ():
            self.supported(aval.dtype)
        if name not in ARITHMETIC:
            return self.by_rule(equation, arguments)
        if avals[0].dtype.kind == "b" and name != "convert_element_type":
            raise NotSupportedError(f"not supported by the native backend: {name} of truth")
        whole = avals[0].dtype.kind in ("i", "u")
        self.whole = whole and name in SUMS
        results = self.by_rule(equation, arguments)
        self.whole = False
        if whole and (name != "convert_element_type" or equation.invars[0].aval.dtype.kind != "b"):
            limits = np.iinfo(avals[0].dtype)
            self.within(results[0], max(limits.min, -self.exact), min(limits.max, self.exact))
        return results

    def by_rule(self, equation: JaxprEqn, arguments: list[Refs]) -> list[Refs]:
        """Return the results of an operation, by the rule of its primitive."""
        name, parameters = equation.primitive.name, equation.params
        if name in INNER:
            return self.closed(parameters[INNER[name]], arguments)
        if name in MOVES:
            results = MOVES[name](parameters, *arguments)
            return list(results) if equation.primitive.multiple_results else [results]
        if name in RULES:
            results = RULES[name](self, equation, arguments)
            return results if isinstance(results, list) else [results]
        return [self.apply(name, *arguments)]

    def apply(self, name: str, *arguments: Refs) -> Refs:
        """An operation, number by number."""
        result, made = self.elements.apply(name, *arguments)
        if made.size:
            self.steps.append(Apply(made))
        if self.whole and name in ("add", "mul"):
            self.whole = False
            self.within(result, -self.exact, self.exact)
            self.whole = True
        return result

    def constant(self, values: Any) -> Refs:
        """Elements of known numbers."""
        return self.elements.constant(values)

    @contextmanager
    def aside(self, going: Refs | None = None):
        """Steps that are made here are another list; for runs that are going on."""
        outer, around = self.steps, self.going
        self.steps = []
        with self.elements.inside():
            if going is not None:
                self.going = going if around is None else self.apply("and", going, around)
            yield self.steps
            self.check()
        self.steps, self.going = outer, around


SUMS = ("reduce_sum", "reduce_prod", "cumsum", "cumprod", "dot_general")
ARITHMETIC = (
    *("add", "add_any", "sub", "mul", "neg", "abs", "sign", "div", "rem", "pow", "integer_pow"),
    *("square", "convert_element_type", "scatter-add", "scatter-mul", *SUMS),
)
"""What takes integers out of the range of their type."""
INNER = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "remat": "jaxpr",
    "checkpoint": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vjp_call_jaxpr": "fun_jaxpr",
    "custom_vmap_call": "call",
}
"""Functions within, by the parameter that holds them."""


# What only moves numbers: functions of the primitive's parameters and of arrays of elements.


def _broadcast_in_dim(p, x, *_):
    shape = [1] * len(p["shape"])
    for axis, size in zip(p["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), p["shape"])


def _slice(p, x):
    strides = p["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]


def _split(p, x):
    return np.split(x, np.cumsum(p["sizes"])[:-1].astype(int), p["axis"])


def _pad(p, x, filling):
    for axis, (low, high, inner) in enumerate(p["padding_config"]):
        x = np.moveaxis(x, axis, 0)
        size = len(x) + inner * max(len(x) - 1, 0)
        full = np.full((max(low, 0) + size + max(high, 0), *x.shape[1:]), filling)
        full[max(low, 0) : max(low, 0) + size : inner + 1] = x
        full = full[max(-low, 0) : len(full) - max(-high, 0)]
        x = np.moveaxis(full, 0, axis)
    return x


def _symmetric_part(p, x):
    """The lower half above too."""
    lower = np.tri(x.shape[-1], dtype=bool)
    return np.where(lower, x, np.swapaxes(x, -1, -2))


MOVES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": lambda p, x: x.reshape(p["new_sizes"]),
    "squeeze": lambda p, x: np.squeeze(x, p["dimensions"]),
    "expand_dims": lambda p, x: np.expand_dims(x, p["dimensions"]),
    "transpose": lambda p, x: np.transpose(x, p["permutation"]),
    "rev": lambda p, x: np.flip(x, p["dimensions"]),
    "slice": _slice,
    "split": _split,
    "concatenate": lambda p, *x: np.concatenate(x, p["dimension"]),
    "stack": lambda p, *x: np.stack(x, p["axis"]),
    "unstack": lambda p, x: np.moveaxis(x, p["axis"], 0),
    "tile": lambda p, x: np.tile(x, p["reps"]),
    "pad": _pad,
    "copy": lambda p, x: x,
    "copy_p": lambda p, x: x,
    "stop_gradient": lambda p, x: x,
    "forward_only": lambda p, x: x,
    "optimization_barrier": lambda p, *x: x,
    symmetric_part_p.name: _symmetric_part,
}


# Rules: functions of the tracer, the equation and arrays of elements.


def _iota(tracer, equation, _):
    p = equation.params
    axis = np.arange(p["shape"][p["dimension"]]).astype(p["dtype"])
    shape = [1] * len(p["shape"])
    shape[p["dimension"]] = -1
    return np.broadcast_to(tracer.constant(axis).reshape(shape), p["shape"])


def _convert(tracer, equation, arguments):
    (x,) = arguments
    old, new = (np.dtype(v.aval.dtype) for v in (equation.invars[0], equation.outvars[0]))
    if new.kind == "b" and old.kind != "b":
        return tracer.apply("ne", x, tracer.constant(0.0))
    if np.issubdtype(new, np.integer) and np.issubdtype(old, np.floating):
        return tracer.apply("trunc", x)
    return x


def _only_of_truth(name):
    def rule(tracer, equation, arguments):
        if equation.outvars[0].aval.dtype.kind != "b":
            raise NotSupportedError(f"not supported by the native backend: {name} of integers")
        return tracer.apply(name, *arguments)

    return rule


def _div(tracer, equation, arguments):
    result = tracer.apply("div", *arguments)
    whole = np.issubdtype(equation.outvars[0].aval.dtype, np.integer)
    return tracer.apply("trunc", result) if whole else result


def _round(tracer, equation, arguments):
    to_even = equation.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return tracer.apply("round_to_even" if to_even else "round_away", *arguments)


def _select(tracer, equation, arguments):
    which, *cases = arguments
    return _selected(tracer, which, cases)


def _selected(tracer, which, cases):
    """Case k where `which` is k; a number beyond the last is the last."""
    result = cases[-1]
    for k in reversed(range(len(cases) - 1)):
        here = which if k == 0 else tracer.apply("sub", which, tracer.constant(float(k)))
        here = here if len(cases) == 2 else tracer.apply("gt", here, tracer.constant(0.0))
        result = tracer.apply("select", here, cases[k], result)
    return result


def _integer_pow(tracer, equation, arguments):
    (x,), power = arguments, equation.params["y"]
    result, square, left = tracer.constant(1.0), x, abs(power)
    while left:
        if left % 2:
            result = tracer.apply("mul", result, square)
        square, left = tracer.apply("mul", square, square) if left > 1 else square, left // 2
    result = np.broadcast_to(result, x.shape)
    return tracer.apply("div", tracer.constant(1.0), result) if power < 0 else result


def _square(tracer, equation, arguments):
    return tracer.apply("mul", arguments[0], arguments[0])


def _rsqrt(tracer, equation, arguments):
    return tracer.apply("div", tracer.constant(1.0), tracer.apply("sqrt", *arguments))


def _clamp(tracer, equation, arguments):
    low, x, high = arguments
    return tracer.apply("min", tracer.apply("max", x, low), high)


def _reduced(name, empty):
    def rule(tracer, equation, arguments):
        (x,), axes = arguments, equation.params["axes"]
        kept = [k for k in range(x.ndim) if k not in axes]
        shape = math.prod(x.shape[k] for k in axes), *(x.shape[k] for k in kept)
        x = np.transpose(x, [*axes, *kept]).reshape(shape)
        if not len(x):
            dtype, value = equation.outvars[0].aval.dtype, empty
            if np.isinf(empty) and dtype.kind != "f":
                limits = (0, 1) if dtype.kind == "b" else _limits(dtype)
                value = limits[int(empty > 0)]
            return np.broadcast_to(tracer.constant(value), x.shape[1:])
        return _folded(tracer, name, x)

    return rule


def _limits(dtype):
    return np.iinfo(dtype).min, np.iinfo(dtype).max


def _folded(tracer, name, x):
    """Neighbours together, until one is left: shorter chains than one after the other."""
    while len(x) > 1:
        half = len(x) // 2
        joined = tracer.apply(name, x[:half], x[half : 2 * half])
        x = np.concatenate([joined, x[2 * half :]])
    return x[0]


def _arg(holds):
    """Return the rule of argmax or argmin: the first of the best, with NaN better than all.

    `holds` says that the best still is.
    """

    def rule(tracer, equation, arguments):
        (x,), (axis,) = arguments, equation.params["axes"]
        x = np.moveaxis(x, axis, 0)
        best, index = x[0], np.broadcast_to(tracer.constant(0.0), x.shape[1:])
        for k in range(1, len(x)):
            better = tracer.apply("not", tracer.apply(holds, best, x[k]))
            better = tracer.apply("and", better, tracer.apply("eq", best, best))
            best = tracer.apply("select", better, best, x[k])
            index = tracer.apply("select", better, index, tracer.constant(float(k)))
        return index

    return rule


def _cumulative(name):
    def rule(tracer, equation, arguments):
        (x,), p = arguments, equation.params
        x = np.moveaxis(x, p["axis"], 0)
        x = x[::-1] if p["reverse"] else x

        def turn(given):
            return [tracer.apply(name, *given)] * 2

        if len(x) > 1:
            rest = {"length": len(x) - 1, "reverse": False}
            _, sums = _repeated(tracer, rest, 1, turn, [], [x[0]], [x[1:]])
            x = np.concatenate([x[:1], sums])
        return np.moveaxis(x[::-1] if p["reverse"] else x, 0, p["axis"])

    return rule


def _as_matrices(x, over, batch):
    """Batch × own × summed over, and the sizes of its own axes."""
    own = [k for k in range(x.ndim) if k not in (*over, *batch)]
    sizes = [math.prod(x.shape[k] for k in axes) for axes in (batch, own, over)]
    return np.transpose(x, [*batch, *own, *over]).reshape(sizes), [x.shape[k] for k in own]


def _sort(tracer, equation, arguments):
    axis, keys = equation.params["dimension"], equation.params["num_keys"]
    given = np.stack([np.moveaxis(x, axis, -1) for x in arguments])
    shape = given.shape
    given = given.reshape(len(arguments), -1, shape[-1])
    made = tracer.elements.variables(given.shape)
    tracer.steps.append(Sort(made, given, keys))
    return [np.moveaxis(x, -1, axis) for x in made.reshape(shape)]


def _dot(tracer, equation, arguments):
    (over_a, over_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    a, own_a = _as_matrices(arguments[0], over_a, batch_a)
    b, own_b = _as_matrices(arguments[1], over_b, batch_b)
    a_there, b_there = (~tracer.elements.is_zero(x) for x in (a, b))
    terms = np.einsum("smk,snk->smn", a_there.astype(int), b_there.astype(int))
    thin = min(terms.shape[1:], default=0) == 1
    few = terms.max(initial=0) <= FEW_TERMS or terms.sum() <= FEW_PRODUCTS * len(a) or thin
    constants = np.concatenate([x[tracer.elements.is_constant(x)] for x in (a, b)])
    few = few or tracer.whole or not np.all(np.isfinite(tracer.elements.known(constants)))
    multiply = _written_out if few else _products
    result = multiply(tracer, a, b, terms)
    return result.reshape((*(arguments[0].shape[k] for k in batch_a), *own_a, *own_b))


def _written_out(tracer, a, b, terms):
    result = np.broadcast_to(tracer.constant(0.0), terms.shape)
    for k in range(a.shape[2]):
        term = tracer.apply("mul", a[:, :, None, k], b[:, None, :, k])
        result = tracer.apply("add", result, term)
    return result


def _products(tracer, a, b, terms):
    for x, y in ((a, b), (b, a)):
        zero = tracer.elements.is_zero(x).any(1)
        tracer.elements.suspect(y[np.broadcast_to(zero[:, None], y.shape)])
    return np.stack([_product(tracer, *x) for x in zip(a, b, terms, strict=True)])


def _product(tracer, a, b, terms):
    def make():
        made = tracer.elements.variables(terms.shape)
        tracer.steps.append(Product(made, a, b))
        return np.where(terms == 0, tracer.elements.zero, made)

    return tracer.elements.once(("product", a.shape, b.shape, a.tobytes(), b.tobytes()), make)


def _dynamic_slice(tracer, equation, arguments):
    x, *starts = arguments
    sizes = equation.params["slice_sizes"]
    for rows in tracer.rows[-1:]:
        if (row := rows.read(x, starts, sizes)) is not None:
            return row
    starts = [_clipped(tracer, s, n - k) for s, n, k in zip(starts, x.shape, sizes, strict=True)]
    if _is_row(tracer, x, starts, sizes):
        made = tracer.elements.variables(sizes)
        tracer.steps.append(Take(made.ravel(), x.reshape(len(x), -1), starts[0].ravel()))
        return made
    return _taken(tracer, x, _places(tracer, starts, sizes))


def _dynamic_update_slice(tracer, equation, arguments):
    x, new, *starts = arguments
    for rows in tracer.rows[-1:]:
        if (made := rows.write(x, new, starts)) is not None:
            return made
    starts = [
        _clipped(tracer, s, n - k) for s, n, k in zip(starts, x.shape, new.shape, strict=True)
    ]
    if _is_row(tracer, x, starts, new.shape):
        made, which = tracer.elements.variables((len(x), x[0].size)), _held(tracer, starts[0])
        tracer.steps.append(Put(made, x.reshape(made.shape), which.ravel(), new.ravel(), None))
        return made.reshape(x.shape)
    return _written(tracer, x, _places(tracer, starts, new.shape), new, None)


def _is_row(tracer, x, starts, sizes):
    """Whether a window is a row of several, and which is not known."""
    several = x.ndim > 1 and len(x) > 1 and tuple(sizes) == (1, *x.shape[1:])
    return several and tracer.elements.known(starts[0]) is None


def _held(tracer, which):
    """Places where something is put: what a run that has left a loop holds stays as it is."""
    if tracer.going is None:
        return which
    return tracer.apply("select", tracer.going, tracer.constant(-1.0), which)


def _places(tracer, starts, sizes):
    """Return the index along each axis of every number of a window with these starts."""
    return [
        tracer.apply("add", np.broadcast_to(start, sizes), tracer.constant(offset))
        for start, offset in zip(starts, np.indices(sizes), strict=True)
    ]


def _clipped(tracer, index, last):
    low = tracer.apply("max", index, tracer.constant(0.0))
    return tracer.apply("min", low, tracer.constant(float(last)))


def _linear(tracer, shape, places):
    """Return the flat indices of numbers in an array that is stored row by row."""
    strides = np.cumprod([1, *shape[:0:-1]])[::-1] if shape else ()
    terms = [
        tracer.apply("mul", place, tracer.constant(float(stride)))
        for place, stride in zip(places, strides, strict=True)
    ]
    return functools.reduce(lambda x, y: tracer.apply("add", x, y), terms, tracer.constant(0.0))


def _taken(tracer, x, places):
    """Numbers of x at places that are in it."""
    which = _linear(tracer, x.shape, places)
    known = tracer.elements.known(which)
    if known is not None:
        return x.ravel()[known.astype(int)]
    if x.size == 1:
        return np.broadcast_to(x.ravel()[0], which.shape)
    made = tracer.elements.variables(which.shape)
    tracer.steps.append(Take(made.ravel(), x.ravel(), which.ravel()))
    return made


def _written(tracer, x, places, values, by, inside=None):
    """Return x with values at places, or by an operation; those that are not inside are dropped."""
    which = _linear(tracer, x.shape, places)
    which = np.broadcast_to(which, values.shape)
    if inside is not None:
        which = tracer.apply("select", inside, tracer.constant(-1.0), which)
    if tracer.elements.known(which) is None:
        which = _held(tracer, which)
    known = tracer.elements.known(which)
    if known is not None:
        return _moved(tracer, x, known.ravel().astype(int), values.ravel(), by)
    made = tracer.elements.variables(x.shape)
    given = (y.ravel() for y in (made, x, which, values))
    tracer.steps.append(Put(*given, by))
    return made


def _moved(tracer, x, which, values, by):
    """Write values at places that are known, or what an operation makes of both."""
    flat, there = x.ravel().copy(), which >= 0
    which, values = which[there], values[there]
    if by and len(set(which)) < len(which):
        for place, value in zip(which, values, strict=True):
            flat[place] = tracer.apply(by, flat[place], value)
    else:
        flat[which] = tracer.apply(by, flat[which], values) if by else values
    return flat.reshape(x.shape)


def _gather(tracer, equation, arguments):
    (x, indices), p = arguments, equation.params
    numbers, sizes = p["dimension_numbers"], p["slice_sizes"]
    shape = equation.outvars[0].aval.shape
    batch = [k for k in range(len(shape)) if k not in numbers.offset_dims]
    gone = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    window = dict(
        zip([k for k in range(x.ndim) if k not in gone], numbers.offset_dims, strict=True)
    )
    at = np.indices(shape)
    here = tuple(at[k] for k in batch)
    places, inside = _window_places(
        tracer, x.shape, indices, here, sizes, numbers.start_index_map,
        dict(zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True)),
        {axis: at[k] for axis, k in window.items()}, shape, _drops(p["mode"]),
    )  # fmt: skip
    taken = _taken(tracer, x, places)
    if inside is None:
        return taken
    filling = p["fill_value"]
    if filling is None:
        dtype = equation.outvars[0].aval.dtype
        filling = {"f": np.nan, "b": True}.get(dtype.kind)
        if filling is None:
            filling = np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return tracer.apply("select", inside, tracer.constant(filling), taken)


def _drops(mode):
    return "FILL_OR_DROP" in str(mode) or str(mode).endswith("fill")


def _window_places(tracer, shape, indices, here, sizes, starts, batching, window, out, drops):
    """Along each axis, where a window's numbers are; and whether the window is inside."""
    zero = np.broadcast_to(tracer.constant(0.0), out)
    places, inside = [], None
    for axis, size in enumerate(shape):
        place = zero
        if axis in batching:
            place = tracer.constant(here[batching[axis]].astype(float))
        if axis in starts:
            place = indices[(*here, np.full(out, starts.index(axis)))]
            last = size - sizes[axis]
            clipped = _clipped(tracer, place, last)
            if drops:
                within = tracer.apply("eq", clipped, place)
                inside = within if inside is None else tracer.apply("and", inside, within)
            place = clipped
        if axis in window:
            place = tracer.apply("add", place, tracer.constant(window[axis].astype(float)))
        places.append(place)
    return places, inside


def _scatter(by):
    def rule(tracer, equation, arguments):
        (x, indices, values), p = arguments, equation.params
        numbers = p["dimension_numbers"]
        at = np.indices(values.shape)
        here = tuple(at[k] for k in range(values.ndim) if k not in numbers.update_window_dims)
        gone = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        axes = [k for k in range(x.ndim) if k not in gone]
        window = dict(zip(axes, numbers.update_window_dims, strict=True))
        sizes = [values.shape[window[k]] if k in window else 1 for k in range(x.ndim)]
        batching = zip(
            numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True
        )
        places, inside = _window_places(
            tracer, x.shape, indices, here, sizes, numbers.scatter_dims_to_operand_dims,
            dict(batching), {axis: at[k] for axis, k in window.items()}, values.shape,
            "CLIP" not in str(p["mode"]),
        )  # fmt: skip
        if by == "add" and equation.outvars[0].aval.dtype.kind != "f":
            most = tracer.exact // (values.size + 1)
            for refs in (x, values):
                tracer.within(refs, -most, most)
        return _written(tracer, x, places, values, by, inside)

    return rule


def _cond(tracer, equation, arguments):
    which, *operands = arguments
    branches = equation.params["branches"]
    known = tracer.elements.known(which)
    if known is not None:
        return tracer.closed(branches[int(np.clip(known, 0, len(branches) - 1))], operands)
    results = [tracer.closed(branch, operands) for branch in branches]
    return [_selected(tracer, which, cases) for cases in zip(*results, strict=True)]


def _platform_index(tracer, equation, arguments):
    platforms = equation.params["platforms"]
    found = [k for k, names in enumerate(platforms) if names is None or "cpu" in names]
    return tracer.constant(float(found[0]))


def _size(jaxpr) -> int:
    """Operations, of all turns of the loops within."""
    total = 0
    for equation in jaxpr.eqns:
        inner = [_size(getattr(x, "jaxpr", x)) for x in _functions(equation.params)]
        total += sum(inner) * equation.params.get("length", 1) if inner else 1
    return total


def _functions(parameters):
    for value in parameters.values():
        for x in value if isinstance(value, tuple | list) else [value]:
            if hasattr(x, "eqns") or hasattr(x, "jaxpr"):
                yield x


def _scan(tracer, equation, arguments):
    p = equation.params
    if "ft_in" in p:  # since JAX 0.11
        first, carried, _ = map(len, p["ft_in"].unpack())
    else:
        first, carried = p["num_consts"], p["num_carry"]
    last = first + carried
    constants, start, xs = arguments[:first], arguments[first:last], arguments[last:]
    body = functools.partial(tracer.closed, p["jaxpr"])
    return _repeated(tracer, p, _size(p["jaxpr"].jaxpr), body, constants, start, xs)


def _repeated(tracer, p, size, body, constants, start, xs):
    """So many turns, each of so many operations."""
    written_out = p["length"] <= TURNS and p["length"] * size <= UNROLLED
    return (_unrolled if written_out else _loop)(tracer, p, body, constants, start, xs)


def _unrolled(tracer, p, body, constants, carry, xs):
    turns = range(p["length"])
    outs = []
    for t in reversed(turns) if p["reverse"] else turns:
        results = body([*constants, *carry, *(x[t] for x in xs)])
        carry = results[: len(carry)]
        outs.append(results[len(carry) :])
    outs = outs[::-1] if p["reverse"] else outs
    if not outs:
        made = p["jaxpr"].out_avals[len(carry) :]
        return [*carry, *(np.zeros((0, *y.shape), np.int32) for y in made)]
    return [*carry, *(np.stack(x) for x in zip(*outs, strict=True))]


def _joined(arrays):
    """All numbers of arrays, one after the other."""
    return np.concatenate([np.zeros(0, np.int32), *(x.ravel() for x in arrays)])


def _parted(flat, arrays):
    ends = np.cumsum([x.size for x in arrays])[:-1]
    parts = np.split(flat, ends) if arrays else []
    return [part.reshape(x.shape) for part, x in zip(parts, arrays, strict=True)]


def _loop(tracer, p, body, constants, start, xs):
    elements, before = tracer.elements, _joined(start)
    rows = np.concatenate(
        [np.zeros((p["length"], 0), np.int32), *(x.reshape(len(x), -1) for x in xs)], axis=1
    )
    same = np.all(rows == rows[:1], axis=0)
    unchanged = elements.is_constant(before)
    while True:
        with tracer.aside() as steps:
            carry = np.where(unchanged, before, elements.variables(before.shape))
            row = np.where(same, rows[0], elements.variables(same.shape))
            now = _parted(row, [x[0] for x in xs])
            results = body([*constants, *_parted(carry, start), *now])
            after = _own(tracer, _joined(results[: len(start)]), carry)
        changed = unchanged & (after != before)
        if not changed.any():
            break
        unchanged &= ~changed
    ys = results[len(start) :]
    told = _joined(ys)
    written = elements.variables((p["length"], told.size))
    written = np.where(elements.is_constant(told), told, written)
    varied = ~elements.is_constant(told)
    tracer.steps.append(
        Loop(
            steps, p["length"], p["reverse"], carry[~unchanged], before[~unchanged],
            after[~unchanged], row[~same], rows[:, ~same], written[:, varied], told[varied],
        )
    )  # fmt: skip
    columns = np.cumsum([0, *(y.size for y in ys)])
    outs = [
        written[:, a:b].reshape(p["length"], *y.shape)
        for a, b, y in zip(columns[:-1], columns[1:], ys, strict=True)
    ]
    return [*_parted(carry, start), *outs]


def _own(tracer, after, carry):
    """Copies of those that are another number of the carry: it is overwritten, one by one."""
    swapped = np.isin(after, carry) & (after != carry)
    return np.where(swapped, _copies(tracer, after), after) if swapped.any() else after


def _copies(tracer, refs):
    return tracer.apply("copy", refs)


def _counted(tracer, p, arguments):
    """The results of a loop over rows, as many as every run has; None for any other loop."""
    first, places = p["body_nconsts"], _turn_and_limit(p)
    if places is None or p["cond_nconsts"]:
        return None
    of_body, start = arguments[:first], arguments[first:]
    number, limit = (start[place] for place in places)
    arrays = [k for k in range(len(start)) if k not in places]
    known = tracer.elements.known(number)
    if known is None or known != 0 or not arrays or not all(start[k].ndim for k in arrays):
        return None
    length = len(start[arrays[0]])
    with tracer.aside() as steps:
        rows, around = RowLoop(tracer.elements, length), tracer.going
        going = tracer.apply("lt", rows.turn, limit)
        tracer.going = going if around is None else tracer.apply("and", going, around)
        tracer.rows.append(rows)
        instead = {k: rows.stand_in(start[k]) for k in arrays}
        carry = [instead.get(k, limit) for k in range(len(start))]
        carry[places[0]] = rows.turn
        results = tracer.closed(p["body_jaxpr"], [*of_body, *carry])
        both = [rows.after(instead[k], results[k], steps) for k in arrays]
        tracer.rows.pop()
        if None not in both:
            old, new = (_joined(x) for x in zip(*both, strict=True))
            new = tracer.apply("select", tracer.going, old, new)
    if None in both:
        return None
    held = np.concatenate([start[k].reshape(length, -1) for k in arrays], axis=1)
    changed = new != old
    told, place = np.unique(
        np.concatenate([new[None], held])[:, changed], axis=1, return_inverse=True
    )
    written = tracer.elements.variables(told[1:].shape)
    after, none = held.copy(), np.zeros(0, np.int32)
    after[:, changed] = written[:, place.ravel()]
    tracer.steps.append(
        Loop(
            steps, length, False, none, none, none, _joined(rows.variables),
            np.concatenate(rows.tables, axis=1), written, told[0], limit.ravel(), told[1:],
        )
    )  # fmt: skip
    sizes = np.cumsum([start[k][0].size for k in arrays])[:-1]
    parts = dict(zip(arrays, np.split(after, sizes, axis=1), strict=True))
    return [parts[k].reshape(x.shape) if k in parts else limit for k, x in enumerate(start)]


def _turn_and_limit(p):
    """The places of the number of a turn, and of where it ends, in what a loop carries; or None."""
    condition, body = (p[name].jaxpr for name in ("cond_jaxpr", "body_jaxpr"))
    carry = body.invars[p["body_nconsts"] :]
    compared = [x for one in condition.eqns for x in one.invars]
    if [x.primitive.name for x in condition.eqns] != ["lt"] or not all(
        x in condition.invars for x in compared if not isinstance(x, Literal)
    ):
        return None
    if any(isinstance(x, Literal) for x in compared):
        return None
    turn, limit = map(condition.invars.index, compared)
    for one in body.eqns:
        if one.outvars[0] is body.outvars[turn] and body.outvars[limit] is carry[limit]:
            by_one = one.primitive.name == "add" and one.invars[0] is carry[turn]
            by_one = by_one and isinstance(one.invars[1], Literal) and one.invars[1].val == 1
            return (turn, limit) if by_one else None
    return None


def _while(tracer, equation, arguments):
    results = _counted(tracer, equation.params, arguments)
    return _repeated_while(tracer, equation.params, arguments) if results is None else results


def _repeated_while(tracer, p, arguments):
    first, last = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    of_condition, of_body, start = arguments[:first], arguments[first:last], arguments[last:]
    before = _joined(start)
    carry = tracer.elements.variables(before.shape)
    with tracer.aside() as condition:
        (going,) = tracer.closed(p["cond_jaxpr"], [*of_condition, *_parted(carry, start)])
        with tracer.aside(going) as steps:
            after = tracer.closed(p["body_jaxpr"], [*of_body, *_parted(carry, start)])
            after = _own(tracer, _joined(after), carry)
    tracer.steps.append(While(condition, steps, carry, before, after, going.ravel()))
    return _parted(carry, start)


RULES: dict[str, Callable[..., Any]] = {
    "iota": _iota,
    "convert_element_type": _convert,
    "add_any": lambda tracer, equation, arguments: tracer.apply("add", *arguments),
    "div": _div,
    "round": _round,
    "select_n": _select,
    "integer_pow": _integer_pow,
    "square": _square,
    "rsqrt": _rsqrt,
    "clamp": _clamp,
    **{name: _only_of_truth(name) for name in ("and", "or", "not")},
    "reduce_sum": _reduced("add", 0.0),
    "reduce_prod": _reduced("mul", 1.0),
    "reduce_max": _reduced("max", -np.inf),
    "reduce_min": _reduced("min", np.inf),
    "reduce_and": _reduced("and", 1.0),
    "reduce_or": _reduced("or", 0.0),
    "argmax": _arg("ge"),
    "argmin": _arg("le"),
    "cumsum": _cumulative("add"),
    "cumprod": _cumulative("mul"),
    "cummax": _cumulative("max"),
    "cummin": _cumulative("min"),
    "sort": _sort,
    "dot_general": _dot,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "scatter": _scatter(None),
    "scatter-add": _scatter("add"),
    "scatter-mul": _scatter("mul"),
    "scatter-min": _scatter("min"),
    "scatter-max": _scatter("max"),
    "cond": _cond,
    "platform_index": _platform_index,
    "scan": _scan,
    "while": _while,
}
