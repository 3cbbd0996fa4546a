"""The tools without mathematics: files, kept programs, progress, look-ups and the watchdog."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any

from jaxslam._version import __version__ as __version__


def exported(room: str, names: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a room, given the names that it has of each module in it."""
    module_of = {name: module for module, own in names.items() for name in own}

    def attribute(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        return getattr(import_module(f"{room}.{module_of[name]}"), name)

    return attribute


def imported(room: Mapping[str, object]) -> list[str]:
    """The `__all__` of a room that exports what it imports, and its tables: its public names."""
    ours = {x for x, value in room.items() if not x.startswith("_") and value is not imported}
    return sorted(x for x in ours if not isinstance(room[x], ModuleType))


def plotted(name: str) -> Callable[..., Any]:
    """Return a function of `jaxslam.plots`, for an object that draws itself.

    Figures are made above what they show, so that matplotlib is imported with the first one.
    """
    return getattr(import_module("jaxslam.plots"), name)
