"""The tools without mathematics: files, kept programs, progress, look-ups and the watchdog."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def exported(room: str, names: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a room, given the names that it has of each module in it."""
    module_of = {name: module for module, own in names.items() for name in own}

    def attribute(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        return getattr(import_module(f"{room}.{module_of[name]}"), name)

    return attribute


def plotted(name: str) -> Callable[..., Any]:
    """Return a function of `jaxslam.plots`, for an object that draws itself.

    Figures are made above what they show, so that matplotlib is imported with the first one.
    """
    return getattr(import_module("jaxslam.plots"), name)
