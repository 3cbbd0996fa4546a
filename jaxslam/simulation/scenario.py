"""Scenarios: worlds by name, from TOML files, or either with some flat fields replaced.

A field that makes no sense is named. The fields, with units, are those of `fields.FIELDS`.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx

from jaxslam._numerics.arrays import check_numbers
from jaxslam._runtime.lookup import lookup, suggestion
from jaxslam.geometry import GEOMETRIES
from jaxslam.models.calibration import TREATMENTS
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.sensors import FieldOfView, Pinhole
from jaxslam.simulation.fields import FIELDS, OWN, PLACES, Value, coerced
from jaxslam.simulation.placement import PLACEMENTS, Rays
from jaxslam.simulation.trajectories import find
from jaxslam.simulation.world import (
    CALIBRATIONS,
    MOTIONS,
    SENSORS,
    Drift,
    Limits,
    World,
)

HANDHELD = "handheld-"
"""What a trajectory's name follows in the name of its scenario."""
_WORDS: dict[str, Mapping] = {
    "geometry": GEOMETRIES,
    "motion": MOTIONS,
    "sensor": SENSORS,
    "placement": PLACEMENTS,
    "calibration": TREATMENTS,
    "true_calibration": CALIBRATIONS,
}
_NESTED = {"camera": Camera, "through": Pinhole}
"""Classes of what a piece has in it."""


def scenario(
    name: str | Path | World = "circle",
    /,
    overrides: Mapping[str, Any] | None = None,
    **fields: Any,
) -> World:
    """The world of a built-in scenario, of a TOML file, or one given, with flat fields replaced.

    A TOML file may name a built-in scenario to start from: `base = "circle"`. A motion, a sensor or
    a placement of your own is `module:Class` or `file.py:Class`, in the current folder too, or a
    table of `type` and what it takes, `{type = "mine:Sonar", sigma = 0.1}`, or from Python the
    piece. Raises ValueError for an unknown name or field and for a value that makes no sense.
    """
    changes = {**(overrides or {}), **fields}
    if isinstance(name, World):
        return _world(name.fields | _checked(changes)) if changes else name
    if not isinstance(name, str | Path):
        raise ValueError(f"a scenario is a World or the name of one, not {name!r}")
    chosen = _read(Path(name)) if str(name).endswith(".toml") else _named(str(name))
    if chosen is None:
        raise ValueError(
            f"unknown scenario {str(name)!r}{suggestion(str(name), BUILT_IN)}; known: "
            f"{', '.join(BUILT_IN)}, {HANDHELD}NAME of a trajectory, or a .toml file"
        )
    return _world(chosen | _checked(changes))


scenario.__doc__ = f"{scenario.__doc__}\n    Fields, each with its default:\n\n" + "".join(
    f"    - `{name}` ({field.default!r}): {field.told}\n" for name, field in FIELDS.items()
)


as_scenario = scenario
"""The same function, where an argument is called `scenario`."""


def parse_override(text: str) -> tuple[str, Any]:
    """`field=value` with the value as in TOML; a bare word is a string."""
    field, sign, value = text.partition("=")
    if not sign or not field.strip():
        raise ValueError(f"{text!r} is not of the form field=value")
    try:
        return field.strip(), tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return field.strip(), value.strip()


def _named(name: str) -> dict[str, Value] | None:
    """The fields of a built-in scenario, or of one along a trajectory of this name."""
    if name.startswith(HANDHELD):
        trajectory = name.removeprefix(HANDHELD)
        find(trajectory)  # or say now what is known
        return _FIELDS.get(name, _FIELDS["handheld"]) | {"name": name, "trajectory": trajectory}
    return _FIELDS.get(name)


def _read(path: Path) -> dict[str, Value]:
    try:
        fields = tomllib.loads(path.read_text())
    except FileNotFoundError:
        raise ValueError(f"scenario file {path} does not exist") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"scenario file {path}: {error}") from None
    base = fields.pop("base", None)
    start = _named(base) if base else _DEFAULTS
    if start is None:
        raise ValueError(f"{path}: unknown base {base!r}; known: {', '.join(BUILT_IN)}")
    return start | _checked({"name": path.stem, **fields})


_DEFAULTS = {name: field.default for name, field in FIELDS.items()}


def _checked(changes: Mapping[str, Any]) -> dict[str, Value]:
    """Fields in the types that they have. Raises ValueError, naming the field."""
    found = {}
    for name, value in changes.items():
        lookup("scenario field", [name], FIELDS)
        found[name] = coerced(name, value, FIELDS[name].default)
        check_numbers(f"scenario field {name}", found[name], FIELDS[name].least)
        word, words = found[name], _WORDS.get(name, ())
        is_own = name in OWN and (not isinstance(word, str) or ":" in word)
        if words and not is_own and word not in words:
            own = ", or module:Class" if name in OWN else ""
            raise ValueError(f"scenario field {name} is {word!r}; known: {', '.join(words)}{own}")
    return found


def _world(f: dict[str, Value]) -> World:
    """The world of all flat fields. Raises ValueError, naming the field."""
    geometry = GEOMETRIES[f["geometry"]]
    p = geometry.pixel_dim

    def values(word: str) -> dict[str, Value]:
        """The fields of a piece by their places in it, each of the right length."""
        for field in PLACES.get(word, {}):
            length = FIELDS[field].length(geometry)
            if length and len(f[field]) != length:
                raise ValueError(
                    f"scenario field {field} needs {length} values in a {geometry.name} world, "
                    f"not {len(f[field])}"
                )
        found = {place: f[field] for field, place in PLACES.get(word, {}).items()}
        return found | ({"point_dim": geometry.point_dim} if word == "position" else {})

    def piece(kind: str) -> Value:
        word = f[kind]
        if isinstance(word, str) and word in _WORDS[kind]:
            return _made(_WORDS[kind][word], values(word))
        return own_piece(kind, word)

    is_camera = f["sensor"] == "camera"
    prior = f["inverse_depth"]
    if prior and (len(prior) != 2 or prior[1] <= 0):
        raise ValueError(f"scenario field inverse_depth needs a mean and a σ: {prior}")
    depth = InverseDepth(*prior) if prior else InverseDepth.beyond(f["nearest_depth"])
    sigmas = (f["focal_sigma"],) * p + (f["centre_sigma"],) * p
    Rays(depth_range=f["depth_range"])  # checked where it is not used, too
    made = World(
        motion=piece("motion"),
        sensor=piece("sensor"),
        placement=piece("placement"),
        calibration=CALIBRATIONS[f["true_calibration"]](sigmas if is_camera else ()),
        depth=replace(depth, unit=f["scale_sigma"] or None),
        trajectory=f["trajectory"] or None,
        view=FieldOfView(**values("view"), **(values("picture") if is_camera else {})),
        limits=Limits(**values("limits")),
        drift=Drift(**values("drift")) if f["drift_sigma"] else None,
        **values("world"),
    )
    if made.geometry is not geometry:
        raise ValueError(
            f"scenario field geometry is {geometry.name}; the motion "
            f"{type(made.motion).__name__} is for a {made.geometry.name} world"
        )
    return made


def _made(kind: type, values: Mapping[str, Value]) -> Value:
    """A piece of values by their places in it, `camera.focal`."""
    flat = {place: value for place, value in values.items() if "." not in place}
    for head, nested in _NESTED.items():
        start = f"{head}."
        inside = {x.removeprefix(start): values[x] for x in values if x.startswith(start)}
        flat |= {head: _made(nested, inside)} if inside else {}
    return kind(**flat)


def own_piece(kind: str, given: Value) -> Value:
    """A piece of your own: itself, `module:Class`, or a table of `type` and what that takes.

    Raises ValueError, naming the field, for what cannot be found or made.
    """
    if isinstance(given, eqx.Module):
        return given
    options = dict(given) if isinstance(given, Mapping) else {"type": given}
    word = options.pop("type", None)
    if options and isinstance(word, str) and word in PLACES:
        own = ", ".join(PLACES[word])
        raise ValueError(
            f"{word} takes no {', '.join(options)}; its fields of a scenario are {own}"
        )
    if not isinstance(word, str) or word.count(":") != 1:
        raise ValueError(
            f"scenario field {kind} is a word, module:Class, a table of type and what that takes, "
            f"or a piece, not {given!r}"
        )
    where, _, name = word.partition(":")
    try:
        return getattr(_module(where), name)(**options)
    except (ImportError, OSError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"scenario field {kind}: {word}: {error}") from error


def _module(where: str) -> ModuleType:
    """A module by its name, of the current folder too, or by its file."""
    if where.endswith(".py"):
        path = Path(where)
        spec = spec_from_file_location(path.stem, path)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[path.stem] = module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
    sys.path.insert(0, str(Path.cwd()))
    try:
        return import_module(where)
    finally:
        sys.path.remove(str(Path.cwd()))


def _built_in() -> dict[str, dict[str, Value]]:
    tables = tomllib.loads(Path(__file__).with_name("scenarios.toml").read_text())

    def fields(name: str) -> dict[str, Value]:
        table = dict(tables[name])
        base = table.pop("base", None)
        return (fields(base) if base else _DEFAULTS) | _checked({**table, "name": name})

    return {name: fields(name) for name in tables}


_FIELDS = _built_in()
BUILT_IN: dict[str, World] = {
    name: _world(dict(fields)) for name, fields in _FIELDS.items() if not name.startswith(HANDHELD)
}
