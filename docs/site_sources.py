"""What the site is made of beside its pages: the notebooks, and the API from docstrings.

Docstrings are written in the Markdown of the pages; autodoc reads reStructuredText.
"""

import importlib
import pkgutil
import re
import shutil
from pathlib import Path

import jaxslam

ROOMS = (
    "evaluation", "consistency", "statistics", "simulation", "filters", "models", "landmarks",
    "testing", "triangulation", "plots", "io", "tracking", "cli", "geometry", "linalg",
    "_numerics", "_runtime", "native",
)  # fmt: skip
"""Rooms and files of the package in the order of the site: what users meet first comes first."""


def write_tutorials(notebooks: Path, place: Path) -> None:
    """Copy the executed notebooks to the site; their links to pages go to the site's."""
    for path in sorted(notebooks.glob("*.ipynb")):
        text = path.read_text().replace("](../docs/", "](../")
        _write(place / path.name, text)


def write_api(place: Path) -> None:
    """One page for the names of `jaxslam`, and one for each room with all its modules."""
    shutil.rmtree(place, ignore_errors=True)
    listed = "\n".join(f"   {name}" for name in ("jaxslam", *ROOMS))
    _write(place / "index.rst", f"{_title('API')}\n.. toctree::\n   :maxdepth: 1\n\n{listed}\n")
    _write(place / "jaxslam.rst", _public_page())
    for room in ROOMS:
        _write(place / f"{room}.rst", _room_page(room))


def _public_page() -> str:
    parts = [_title("jaxslam"), ".. automodule:: jaxslam\n   :no-members:\n"]
    for name in sorted(jaxslam.__all__, key=str.lower):
        value = getattr(jaxslam, name)
        kind = "class" if isinstance(value, type) else "function" if callable(value) else "data"
        options = "   :members:\n" if kind == "class" else ""
        if kind != "data":
            parts.append(f".. auto{kind}:: jaxslam.{name}\n{options}")
        elif name != "__version__":
            home = _home(name)
            parts.append(f".. autodata:: {home}.{name}\n   :no-value:\n")
    return "\n".join(parts)


def _home(name: str) -> str:
    """The module that defines a constant of `jaxslam`."""
    for module in _modules("jaxslam"):
        source = Path(module.__file__ or "").read_text()
        if re.search(rf"^{name}(:.*)? = ", source, re.MULTILINE):
            return module.__name__
    raise LookupError(name)


def _room_page(room: str) -> str:
    parts = [_title(f"jaxslam.{room}")]
    for module in _modules(f"jaxslam.{room}"):
        if exported := getattr(module, "__all__", ()):
            links = ", ".join(_link(module, name) for name in exported)
            parts.append(f"To be imported from ``{module.__name__}``: {links}.\n")
        if not module.__name__.endswith(room):
            parts.append(_title(module.__name__.removeprefix("jaxslam."), "-"))
        parts.append(f".. automodule:: {module.__name__}\n   :ignore-module-all:\n")
    return "\n".join(parts)


def _link(module, name: str) -> str:
    """A name that a room exports, with the place where it is explained."""
    value = getattr(module, name)
    if name in jaxslam.__all__:
        return f":py:obj:`{name} <jaxslam.{name}>`"
    home = getattr(value, "__module__", None)
    return f":py:obj:`{name} <{home}.{name}>`" if hasattr(value, "__qualname__") else f"``{name}``"


def _modules(name: str) -> list:
    """A module and those in it."""
    module = importlib.import_module(name)
    inside = pkgutil.walk_packages(getattr(module, "__path__", []), f"{name}.")
    return [module, *(importlib.import_module(m.name) for m in inside if "__main__" not in m.name)]


def _title(text: str, line: str = "=") -> str:
    text = text.replace("_", "\\_")
    return f"{text}\n{line * len(text)}\n"


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def with_links_of_the_site(app, name: str, source: list[str]) -> None:
    """Notebooks are pages of the site."""
    source[0] = re.sub(r"\]\(\.\./notebooks/(\w+)\.py\)", r"](tutorials/\1.ipynb)", source[0])


PUBLIC = {id(getattr(jaxslam, name)) for name in jaxslam.__all__}


def skipped(app, what: str, name: str, obj, skip: bool, options) -> bool | None:
    """Names of `jaxslam` are on its own page, and only there; those of others nowhere."""
    if what != "module":
        return None
    on_own_page = id(obj) in PUBLIC and not isinstance(obj, str | tuple)
    ours = getattr(obj, "__module__", "jaxslam").startswith("jaxslam")
    return True if on_own_page or not ours else None


def docstring_as_rst(app, what: str, name: str, obj, options, lines: list[str]) -> None:
    """Markdown's code, lists and indented formulas in reStructuredText."""
    paragraphs = re.split(r"\n\s*\n", "\n".join(lines).strip("\n"))
    lines[:] = "\n\n".join(_paragraph(p) for p in paragraphs).splitlines()


def _paragraph(text: str) -> str:
    rows = text.splitlines()
    if rows and all(row.startswith("    ") for row in rows):
        return "::\n\n" + "\n".join(f"   {row}" for row in rows)
    return "".join(
        f"\\ ``{part.strip()}``\\ " if i % 2 else re.sub(r"([\\*|_])", r"\\\1", part)
        for i, part in enumerate(text.split("`"))
    )
