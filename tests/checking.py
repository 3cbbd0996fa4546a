"""Types and shapes are checked in the first call of every kind, and in no other of that kind.

A check of the package takes longer than many of its functions, and looks at nothing of an array
but its type, dtype and shape. Calls are of one kind if all that their checks look at is the same;
what they return is looked at each time, and checked if it is of another kind than before.
"""

from collections.abc import Callable
from functools import cache, partial, wraps
from types import CodeType, FunctionType
from typing import Any

import jax
import jaxtyping
import numpy as np

_each_call = jaxtyping.jaxtyped
_ARRAYS = np.ndarray, jax.Array, jax.ShapeDtypeStruct
_ITEMS = 32
"""Of a list or table of more, each call is checked."""


class _UnknownError(Exception):
    """Of a value of which no kind tells all that a check might look at."""


def _kind(x: Any) -> Any:
    kind = type(x)
    try:
        look = _looks[kind]
    except KeyError:
        look = _looks[kind] = _look(x)
    return kind if look is None else (kind, *look(x))


_looks: dict[type, Callable[[Any], Any] | None] = {}
"""Of each type what a check looks at beside it: whether it is an array takes JAX a while to say."""


def _look(x: Any) -> Callable[[Any], Any] | None:
    if isinstance(x, _ARRAYS):
        return lambda x: (x.shape, x.dtype)
    if isinstance(x, tuple):
        return partial(map, _kind)
    if isinstance(x, type):
        return lambda x: (x,)
    return _items if isinstance(x, list | dict | set | frozenset) else None


def _items(x: Any) -> Any:
    if len(x) > _ITEMS:
        raise _UnknownError
    return *map(_kind, x), *map(_kind, x.values() if isinstance(x, dict) else ())


def _checked_result(function: FunctionType, typechecker: Any, result: Any) -> Callable[..., Any]:
    """The check of the function's arguments and of this result, without its call."""

    def given(*args: Any, **named: Any) -> Any:
        return result

    there = FunctionType(given.__code__, function.__globals__, closure=given.__closure__)
    return _each_call(wraps(function)(there), typechecker=typechecker)


_seen: dict[CodeType, dict[Any, set[Any]]] = {}
"""Of every function the kinds of calls, and what those returned. A function within another is made
anew in each call of that, with the same annotations."""


def _decorated(function: Any, typechecker: Any) -> Any:
    if not isinstance(function, FunctionType):
        return _each_call(function, typechecker=typechecker)
    seen = _seen.setdefault(function.__code__, {})

    @cache
    def checked() -> Callable[..., Any]:  # made when it is needed first, as it takes a while
        return _each_call(function, typechecker=typechecker)

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        __tracebackhide__ = True
        if jaxtyping.config.jaxtyping_disable:
            return function(*args, **named)
        try:
            key = *map(_kind, args), *named, *map(_kind, named.values())
        except _UnknownError:
            return checked()(*args, **named)
        results = seen.get(key)
        result = (function if results else checked())(*args, **named)
        try:
            of_result = _kind(result)
        except _UnknownError:
            of_result = None
        if results and of_result not in results:
            _checked_result(function, typechecker, result)(*args, **named)
        if of_result is None:
            seen.pop(key, None)
        else:
            seen.setdefault(key, set()).add(of_result)
        return result

    return call


def jaxtyped(*function: Any, typechecker: Any = None, **options: Any) -> Any:
    """`jaxtyping.jaxtyped`, which the import hook of pytest's option puts above every function."""
    if function or options or typechecker is None:
        return _each_call(*function, typechecker=typechecker, **options)
    return partial(_decorated, typechecker=typechecker)


setattr(jaxtyping, "jaxtyped", jaxtyped)  # noqa: B010 - for its many overloads
