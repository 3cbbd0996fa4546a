"""The manifest of all that decides a study's results, as JSON, so that no two are ever mixed."""

from __future__ import annotations

import builtins
import dataclasses
import dis
import hashlib
import inspect
import json
import os
import sys
from collections.abc import Iterator, Mapping
from functools import cache, cached_property, partial
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.util import find_spec
from pathlib import Path
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Manifest = dict[str, Any]
LAYOUT = 8
"""The version of the records that are kept, which are never mixed with those of another."""


def versions() -> dict[str, str]:
    """The versions of the packages that decide the digits of a result."""
    from jaxslam._runtime import __version__

    return {"jaxslam": __version__, **{name: version(name) for name in ("jax", "jaxlib")}}


UNSEEN = "code that cannot be seen"
"""The mark, in a description, of what decides a result and cannot be described."""


def described(value: object) -> Any:
    """Describe a filter, a model, or any value of numbers, names and functions as JSON.

    Descriptions of equal values are equal, in every process, in a script and in a notebook. Of
    large arrays there is a digest. A function or class of the user's is its own code and all that
    this calls: functions, classes and values by their global names, and from closures. What is of
    this package, of Python, or of an installed package is a name, and a version where it has one.
    `unseen` tells what is none of these.
    """
    return _Description().of(value)


def unseen(description: object) -> set[str]:
    """The names, in a description, of code that could not be seen."""
    if isinstance(description, dict):
        own = {description[UNSEEN]} if UNSEEN in description else set()
        return own.union(*map(unseen, description.values()))
    return set().union(*map(unseen, description)) if isinstance(description, list) else set()


class _Description:
    """A walk through a value, in which nothing of the user's is described twice."""

    def __init__(self) -> None:
        self._seen: dict[int, Any] = {}
        """What was described, kept alive so that nothing else gets the same id."""

    def of(self, value: object) -> Any:
        for kinds, told in _RULES:
            if isinstance(value, kinds):
                return told(self.of, value)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, FunctionType) or _wraps_function(value):
            return self._function(value)
        return self._instance(value)

    def _first_time(self, value: object) -> bool:
        first = id(value) not in self._seen
        self._seen[id(value)] = value
        return first

    def _instance(self, value: object) -> Any:
        kind = type(value)
        if dataclasses.is_dataclass(value):
            fields = {f.name: getattr(value, f.name, None) for f in dataclasses.fields(value)}
            return {"type": self._class(kind), **self.of(fields)}
        fields = {} if _package(kind.__module__) == PYTHON else getattr(value, "__dict__", {})
        if not fields and callable(value) and not isinstance(kind.__call__, FunctionType):
            return {"type": _name(kind), UNSEEN: f"{getattr(value, '__name__', _name(kind))}(…)"}
        first = self._first_time(value)  # before its class, which may have it as a member
        return {"type": self._class(kind), **(self.of(fields) if first else {})}

    def _class(self, kind: type) -> Any:
        """The name of a class, and the members of one that is the user's."""
        if _package(kind.__module__) is not None:
            return _name(kind)
        if not self._first_time(kind):
            return kind.__qualname__
        members: dict[str, Any] = {}
        for base in reversed([x for x in kind.__mro__ if _package(x.__module__) is None]):
            members.update(vars(base))
        return {
            "name": kind.__qualname__,
            "members": {
                name: self.of(member)
                for name, member in members.items()
                if name != "_abc_impl" and (not name.startswith("__") or name in _OPERATORS)
            },
        }

    def _function(self, given: Any) -> Any:
        rules = [getattr(given, name, None) for name in ("jvp", "fwd", "bwd")]  # of `custom_jvp`
        function = inspect.unwrap(given)
        package, name = _package(function.__module__), _name(function)
        closed = self.of(function.__closure__ or ())
        told: dict[str, Any] = {"name": name, "code": _digest(function.__code__), "closed": closed}
        if package is not None:
            versioned = name if package in _NAMED else [name, package]
            return told if closed and package == JAXSLAM else versioned
        if not self._first_time(function):
            return function.__qualname__
        given = function.__defaults__, function.__kwdefaults__, *filter(callable, rules)
        more = {"given": self.of(given), "calls": self._called(function.__code__, function)}
        return {**told, **more, "name": function.__qualname__}

    def _called(self, code: CodeType, function: FunctionType) -> dict[str, Any]:
        """All that the code loads by a global name, and what it takes of the user's modules."""
        found: dict[str, Any] = {}
        module = None
        for step in dis.get_instructions(code):
            name, value = step.argval, _NOTHING
            if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
                value = function.__globals__.get(name, getattr(builtins, name, _NOTHING))
            elif step.opname in ("LOAD_ATTR", "LOAD_METHOD") and module is not None:
                value = getattr(module, name, _NOTHING)
            elif step.opname == "IMPORT_NAME" and _package(name) is None:
                found[name] = {UNSEEN: f"import {name} in {function.__qualname__}"}
            # Functions behind which there may be code that is not named.
            if any(value is x for x in (getattr, eval, exec, globals, __import__, compile)):
                found[name] = {UNSEEN: f"{name}(…) in {function.__qualname__}"}
            elif value is not _NOTHING and not isinstance(value, ModuleType):
                found[name] = self.of(value)
            module = value if isinstance(value, ModuleType) else None
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                found.update(self._called(constant, function))
        return found


_NOTHING = object()
JAXSLAM, PYTHON = "jaxslam", "python"
_NAMED = (JAXSLAM, PYTHON)
"""Of whose functions there is the name alone: the manifest has the version of the package, and no
result depends on that of Python."""
_OPERATORS = ("__call__", "__add__", "__sub__", "__mul__", "__matmul__", "__getitem__", "__neg__")


def _wraps_function(value: object) -> bool:
    """Whether it is a function that a decorator made, as `jax.jit`."""
    wrapped = getattr(value, "__wrapped__", None)
    return callable(value) and isinstance(wrapped, FunctionType) and not isinstance(value, type)


def _content(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # it is not filled yet
        return None


def _in_c(function: BuiltinFunctionType | np.ufunc) -> Any:
    """The name of a function in C, and the version of its package, if it is of any."""
    owner = getattr(function, "__self__", None)
    module = getattr(function, "__module__", None) or getattr(type(owner), "__module__", "numpy")
    name, package = f"{module}.{function.__name__}", _package(module)
    if package is None:
        return {"name": function.__name__, UNSEEN: f"{function.__name__}(…)"}
    return name if package in _NAMED else [name, package]


@cache
def _package(module: str | None) -> str | None:
    """`jaxslam`, `python`, or an installed package with its version; None for the user's code."""
    top = (module or "__main__").partition(".")[0]
    if top in (JAXSLAM, "__main__"):
        return JAXSLAM if top == JAXSLAM else None
    if top in sys.stdlib_module_names:
        return PYTHON
    try:
        path = getattr(sys.modules.get(top) or find_spec(top), "__file__", None) or ""
    except ValueError:  # a module that was made by hand
        path = ""
    if not {"site-packages", "dist-packages"} & set(Path(path).parts):
        return None
    try:
        return f"{top} {version(top)}"
    except PackageNotFoundError:
        names = packages_distributions().get(top)
        return f"{top} {version(names[0])}" if names else top


def difference(then: object, now: Any) -> str | None:
    """The first part in which two manifests differ, then and now; None where they are the same."""
    return next(_differences("", then, now), None)


def _differences(where: str, then: object, now: Any) -> Iterator[str]:
    if isinstance(then, dict) and isinstance(now, dict):
        for key in {**now, **then}:
            yield from _differences(f"{where}.{key}", then.get(key), now.get(key))
    elif json.dumps(then) != json.dumps(now):  # as text, NaN is NaN
        yield f"{where[1:]} ({_short(then)}, now {_short(now)})"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}…"


def _name(value: type | FunctionType) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _array(value: Any) -> Any:
    is_key = jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key)
    x = np.asarray(jax.random.key_data(jnp.asarray(value)) if is_key else value)
    # An array of at most so many numbers is written whole; of a larger one there is a digest.
    if x.size <= 64 and x.dtype.kind in "fiub":
        return x.tolist()
    told = hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest()
    return {"shape": list(x.shape), "dtype": x.dtype.name, "sha256": told}


def _digest(code: CodeType) -> str:
    digest = hashlib.sha256(code.co_code + repr(code.co_names).encode())
    for constant in code.co_consts:
        if isinstance(constant, frozenset):  # in an order that differs between processes
            constant = sorted(map(repr, constant))
        told = _digest(constant) if isinstance(constant, CodeType) else repr(constant)
        digest.update(told.encode())
    return digest.hexdigest()


_RULES: tuple[tuple, ...] = (
    (str | bool | int | float | None, lambda of, x: x),
    (os.PathLike, lambda of, x: os.fspath(x)),
    (np.ndarray | np.generic | jax.Array, lambda of, x: _array(x)),
    (Mapping, lambda of, x: {str(key): of(y) for key, y in x.items()}),
    (tuple | list | range, lambda of, x: [of(y) for y in x]),
    (bytes | complex | slice | np.dtype, lambda of, x: repr(x)),
    (set | frozenset, lambda of, x: sorted(map(repr, x))),
    (partial, lambda of, x: of([x.func, x.args, x.keywords])),
    (ModuleType, lambda of, x: x.__name__),
    (MethodType, lambda of, x: of([x.__self__, x.__func__])),
    (BuiltinFunctionType | np.ufunc, lambda of, x: _in_c(x)),
    (CellType, lambda of, x: of(_content(x))),
    (property, lambda of, x: of([x.fget, x.fset])),
    (cached_property, lambda of, x: of(x.func)),
    (staticmethod | classmethod, lambda of, x: of(x.__func__)),
)
"""What is said of values that are neither classes nor functions of the user's nor instances."""
