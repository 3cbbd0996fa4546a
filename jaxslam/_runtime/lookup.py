"""Names that users give: looked up in a table, with a word on what a mistyped one meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import TypeVar

T = TypeVar("T")


def suggestion(word: str, known: Iterable[str]) -> str:
    """` (did you mean …?)` for an error message, or nothing where no known name is close."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def as_list(names: str | Iterable[str]) -> list[str]:
    """Names in a list; one alone may be given as it is."""
    return [names] if isinstance(names, str) else list(names)


def lookup(kind: str, names: str | Iterable[str], known: Mapping[str, T]) -> dict[str, T]:
    """The named entries of a table, in the order of the names. Raises ValueError."""
    names = as_list(names)
    if not names:
        raise ValueError(f"{kind} needs at least one name; known: {', '.join(known)}")
    for name in names:
        if name not in known:
            meant = suggestion(name, known)
            raise ValueError(f"unknown {kind} {name!r}{meant}; known: {', '.join(known)}")
    return {name: known[name] for name in names}
