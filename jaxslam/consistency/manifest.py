"""The manifest of all that decides a study's results, as JSON, so that no two are ever mixed."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
import os
from collections.abc import Iterator, Mapping
from functools import partial
from importlib.metadata import version
from types import BuiltinFunctionType, CodeType, FunctionType
from typing import Any

import jax
import numpy as np

Manifest = dict[str, Any]
LAYOUT = 8
"""The version of the records that are kept, which are never mixed with those of another."""
MOST_NUMBERS = 64
"""The largest array that is written whole; of a larger one there is a digest."""


def versions() -> dict[str, str]:
    """The versions of the packages that decide the digits of a result."""
    from jaxslam._version import __version__

    return {"jaxslam": __version__, **{name: version(name) for name in ("jax", "jaxlib")}}


def described(value: Any) -> Any:
    """Describe a filter, a model, or any value of numbers, names and functions as JSON.

    Descriptions of equal values are equal, in every process. Of large arrays and of functions that
    are not of this package there is a digest.
    """
    if isinstance(value, str | bool | int | float | None):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _array(np.asarray(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: getattr(value, f.name, None) for f in dataclasses.fields(value)}
        return {"type": _name(type(value)), **described(fields)}
    if isinstance(value, Mapping):
        return {str(key): described(x) for key, x in value.items()}
    if isinstance(value, tuple | list | range):
        return [described(x) for x in value]
    if isinstance(value, partial):
        return [described(x) for x in (value.func, value.args, value.keywords)]
    if isinstance(value, type | BuiltinFunctionType):
        return _name(value)
    if isinstance(value, FunctionType):
        return _function(value)
    return {"type": _name(type(value)), **described(getattr(value, "__dict__", {}))}


def difference(then: Any, now: Any) -> str | None:
    """The first part in which two manifests differ, then and now; None where they are the same."""
    return next(_differences("", then, now), None)


def _differences(where: str, then: Any, now: Any) -> Iterator[str]:
    if isinstance(then, dict) and isinstance(now, dict):
        for key in {**now, **then}:
            yield from _differences(f"{where}.{key}", then.get(key), now.get(key))
    elif json.dumps(then) != json.dumps(now):  # as text, NaN is NaN
        yield f"{where[1:]} ({_short(then)}, now {_short(now)})"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}…"


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _array(x: np.ndarray) -> Any:
    if x.size <= MOST_NUMBERS and x.dtype.kind in "fiub":
        return x.tolist()
    told = hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest()
    return {"shape": list(x.shape), "dtype": x.dtype.name, "sha256": told}


def _function(function: FunctionType) -> Any:
    function = inspect.unwrap(function)
    name = _name(function)
    if name.startswith("jaxslam.") and not function.__closure__:
        return name  # the version says what it does
    closed = [described(cell.cell_contents) for cell in function.__closure__ or ()]
    return {"name": name, "code": _digest(function.__code__), "closed": closed}


def _digest(code: CodeType) -> str:
    digest = hashlib.sha256(code.co_code + repr(code.co_names).encode())
    for constant in code.co_consts:
        told = _digest(constant) if isinstance(constant, CodeType) else repr(constant)
        digest.update(told.encode())
    return digest.hexdigest()
