"""The flat fields of a scenario: what a TOML file and `--set field=value` may say, with units."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxslam._numerics.arrays import check_numbers
from jaxslam.geometry import Geometry

Value = Any
"""The value of a field: a word, a number, a list of them, or a piece of your own."""
MOST = 2**31 - 1


class Field(NamedTuple):
    """A field of a scenario, as `fields.toml` says it."""

    default: Value
    """The default, in whose type it is read."""
    told: str
    """The sentence that says what it is."""
    least: str = ""
    """`positive`, `not negative`, or nothing: what its numbers have to be."""
    at: tuple[str, ...] = ()
    """The places of a world that it says: the word of a piece, and an attribute of that."""
    count: str | int = 0
    """The count of its numbers, or the attribute of a geometry that is it; 0 where any is right."""

    def length(self, geometry: Geometry) -> int:
        """Return how many numbers it has in a world of this geometry; 0 where any is right."""
        count = self.count
        return count if isinstance(count, int) else getattr(geometry, count)

    def within(self, geometry: Geometry) -> Value:
        """Return the default in a world of this geometry."""
        in_each = isinstance(self.count, str)
        return self.default[:1] * self.length(geometry) if in_each else self.default


def _tuples(value: Value) -> Value:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


_TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
FIELDS = {name: Field(**{k: _tuples(v) for k, v in x.items()}) for name, x in _TABLES.items()}
"""The fields by their names, of `fields.toml`."""
PLACES: dict[str, dict[str, str]] = {}
"""The attribute of every field in a piece, by the word for the piece."""
for _name, _field in FIELDS.items():
    for _word, _, _place in (at.partition(".") for at in _field.at):
        PLACES.setdefault(_word, {})[_name] = _place
OWN = ("motion", "sensor", "placement")
"""Fields that may be a piece of your own: a word `module:Class`, or a table of `type` and what
that takes, or from Python the piece."""
_REFUSED = {int: ("a whole number", (str, list, tuple, float)), float: ("a number", (str, list))}
"""The kinds that the number of a piece must not be of, by the type of its default."""
ROWS = ("first_pixels", "points")
"""Fields that are lists of lists."""


def coerced(field: str, value: Value, like: Value) -> Value:
    """`value` in the type of the field; a single number stands for a list of one.

    Raises ValueError, naming the field.
    """

    def check(right: bool, wanted: str) -> None:
        if not right:
            raise ValueError(f"scenario field {field} must be {wanted}, not {value!r}")

    value = value.tolist() if isinstance(value, np.ndarray) else value
    if field in OWN and not isinstance(value, int | float | list | tuple):
        return value
    if isinstance(like, str):
        check(isinstance(value, str), "a word")
        return value
    if field in ROWS and isinstance(like, tuple):
        rows = "a list of " + ("points" if field == "points" else "[low, high] pairs")
        check(not is_alone(value) and not any(map(is_alone, value)), rows)
        return tuple(tuple(coerced(field, x, 0.0) for x in row) for row in value)
    if isinstance(like, tuple):
        return tuple(coerced(field, x, 0.0) for x in ([value] if is_alone(value) else value))
    check(isinstance(value, int | float) and not isinstance(value, bool), "a number")
    check(isinstance(value, float) or abs(value) <= MOST, f"a number up to {MOST}")
    check(isinstance(like, float) or value % 1 == 0, "a whole number")
    return type(like)(value)


def is_alone(value: Value) -> bool:
    """Whether it is no list."""
    return not isinstance(value, list | tuple)


def check_signs(piece: object, word: str) -> None:
    """Raise ValueError unless the fields of a piece are of the signs and kinds of the table."""
    for field, place in PLACES[word].items():
        if "." not in place:
            what, value = f"{place} of {type(piece).__name__}", getattr(piece, place)
            told, wrong = _REFUSED.get(type(FIELDS[field].default), ("", ()))
            if isinstance(value, wrong):
                raise ValueError(f"{what} must be {told}, not {value!r}")
            check_numbers(what, value, FIELDS[field].least)
