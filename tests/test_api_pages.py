"""Every public name is on the pages of the API, with its shapes, its fields and its errors."""

import ast
import dataclasses
import importlib
import importlib.util
import inspect
import re
import textwrap
from pathlib import Path

import jaxslam

ROOT = Path(__file__).parents[1]
ROOMS = (
    "consistency", "evaluation", "simulation", "landmarks", "linalg", "tracking", "triangulation"
)  # fmt: skip
"""Those that say what they export."""
NO_SHAPE = re.compile(r"\bArrayLike\b|\bArray$|ndarray'?>?$")
"""Annotations of arrays that do not say of which shape."""
SHAPE = r"[^.]*?\([\w…]+( [\w…]+)*,[^)]*\)"
"""As in `points` (k, 3), in the same sentence."""


def site_sources():
    spec = importlib.util.spec_from_file_location("site_sources", ROOT / "docs/site_sources.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def public():
    """`(where it is exported, name, value)` of everything that a user imports."""
    named = [("jaxslam", name) for name in sorted({*jaxslam.__all__, "Tracker", "TrackerSettings"})]
    for room in ROOMS:
        module = importlib.import_module(f"jaxslam.{room}")
        named += [(f"jaxslam.{room}", name) for name in module.__all__]
    for file in sorted((ROOT / "jaxslam/plots").glob("[a-z]*.py")):
        module = importlib.import_module(f"jaxslam.plots.{file.stem}")
        own = (
            n for n, v in vars(module).items() if getattr(v, "__module__", "") == module.__name__
        )
        named += [(module.__name__, name) for name in own if name.startswith("plot_")]
    seen: set[int] = set()
    for where, name in named:
        value = getattr(importlib.import_module(where), name)
        if name != "__version__" and (id(value) not in seen or not callable(value)):
            seen.add(id(value))
            yield where, name, value


PUBLIC = list(public())
FUNCTIONS = {f"{where}.{name}": value for where, name, value in PUBLIC if inspect.isfunction(value)}
CLASSES = {f"{where}.{name}": value for where, name, value in PUBLIC if inspect.isclass(value)}


def words(value) -> str:
    """Its own docstring; that of a class with those of its fields."""
    if not inspect.isclass(value):
        return value.__doc__ or ""
    own = vars(value).get("__doc__") or ""
    made = own.startswith(f"{value.__name__}(")  # by dataclass, in place of one
    return ("" if made else own) + "\n" + "\n".join(field_words(value))


def field_words(cls) -> list[str]:
    """What is said of fields in the body of a class: a string below each, or a comment beside."""
    body = textwrap.dedent(inspect.getsource(cls))
    tree = ast.parse(body).body[0]
    assert isinstance(tree, ast.ClassDef)
    lines, found = body.splitlines(), []
    for before, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        if not isinstance(before, ast.AnnAssign) or not isinstance(before.target, ast.Name):
            continue
        told = lines[(before.end_lineno or before.lineno) - 1][before.end_col_offset or 0 :]
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            told += str(after.value.value)
        if told.strip():
            found.append(f"{before.target.id}: {told}")
    return found


def test_what_users_import_is_on_the_pages():
    made = site_sources()
    pages = {room: made._room_page(room) for room in made.ROOMS}
    first = made._public_page()
    for where, name, value in PUBLIC:
        home = getattr(value, "__module__", "")
        if where == "jaxslam" and not name.startswith("Tracker"):
            entry = rf"^\.\. auto\w+:: jaxslam\.(\w+\.)*{name}$"
            assert re.search(entry, first, re.MULTILINE), name
        elif hasattr(value, "__qualname__"):
            assert f".. automodule:: {home}\n" in pages[home.split(".")[1]], (where, name)
        else:
            linked = rf"``{name}``|`{name} <"
            assert re.search(linked, pages[where.split(".")[1]]), (where, name)


def test_all_are_explained():
    assert not [name for name, v in {**FUNCTIONS, **CLASSES}.items() if len(words(v).split()) < 3]


def shapeless(function) -> list[str]:
    """Its arguments that are arrays of nobody knows which shape."""
    told, found = words(function), []
    for name, parameter in inspect.signature(function).parameters.items():
        annotation = parameter.annotation
        text = annotation if isinstance(annotation, str) else str(annotation)
        if name == "key":  # of random numbers
            continue
        if NO_SHAPE.search(text) and not re.search(rf"\b{name}\b{SHAPE}", told, re.DOTALL):
            found.append(name)
    return found


def test_arrays_have_a_shape():
    """In the annotation, or after the argument's name in the docstring: `points` (k, 3)."""
    assert not {name: found for name, f in FUNCTIONS.items() if (found := shapeless(f))}


def unexplained(cls) -> list[str]:
    """Its fields of which neither a string of their own nor the class' says anything."""
    if not dataclasses.is_dataclass(cls):
        return []
    own, told = vars(cls).get("__annotations__", {}), words(cls)
    names = [f.name for f in dataclasses.fields(cls) if f.name in own]
    return [n for n in names if not n.startswith("_") and not re.search(rf"\b{n}\b", told)]


def test_every_field_is_explained():
    assert not {name: found for name, cls in CLASSES.items() if (found := unexplained(cls))}


def raises(function) -> bool:
    """Whether it says by itself that an argument is wrong."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    return any(
        isinstance(node, ast.Raise)
        and isinstance(node.exc, ast.Call)
        and getattr(node.exc.func, "id", "") == "ValueError"
        for node in ast.walk(tree)
    )


def silent(value) -> list[str]:
    """Of a function or a class, what raises ValueError by itself and does not say so."""
    if inspect.isfunction(value):
        return ["it"] if raises(value) and "ValueError" not in words(value) else []
    methods = {name: getattr(m, "__func__", m) for name, m in vars(value).items()}
    found = []
    for name, method in methods.items():
        if inspect.isfunction(method) and is_written(method) and raises(method):
            made = name in ("__post_init__", "__check_init__", "__init__")
            told = words(value) + (method.__doc__ or "")
            if (made or not name.startswith("_")) and "ValueError" not in told:
                found.append(name)
    return found


def is_written(function) -> bool:
    """In the package, and not made by `dataclass`."""
    code = inspect.unwrap(function).__code__
    return code.co_filename.startswith(str(ROOT / "jaxslam"))


def test_errors_are_told():
    every = {**FUNCTIONS, **CLASSES}
    assert not {name: found for name, value in every.items() if (found := silent(value))}


def mute(cls) -> list[str]:
    """Its methods of which nothing says what they do: they, their class, or one above."""
    return [
        name
        for name, value in vars(cls).items()
        if not name.startswith("_")
        and inspect.isfunction(method := getattr(value, "__func__", value))
        and not method.__doc__
        and not is_inherited(cls, name)
        and f"`{name}`" not in words(cls)
    ]


def test_methods_are_explained():
    assert not {name: found for name, cls in CLASSES.items() if (found := mute(cls))}


def is_inherited(cls, name: str) -> bool:
    """Whether a class above says what it does."""
    return any(getattr(vars(above).get(name), "__doc__", None) for above in cls.__mro__[1:])
