"""The purpose for which a program is traced, where a function's best form depends on it."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar

_gathers_are_free = ContextVar("gathers_are_free", default=False)


def gathers_are_free() -> bool:
    """Return whether gathering costs nothing in what is traced now.

    It does in XLA's programs; not in those of a compiler that resolves indices itself.
    """
    return _gathers_are_free.get()


@contextmanager
def free_gathers() -> Generator[None]:
    """Trace what is within for a compiler that resolves indices itself."""
    token = _gathers_are_free.set(True)
    try:
        yield
    finally:
        _gathers_are_free.reset(token)
