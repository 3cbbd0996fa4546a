"""The structure that a newcomer may rely on: imports one way, short functions, small rooms."""

import ast
import builtins
import importlib
import io
import re
import statistics
import subprocess
import sys
import tokenize
from pathlib import Path

import equinox as eqx
import pytest

import jaxslam
from jaxslam.filters.layer import AbstractLayer
from jaxslam.filters.protocol import AbstractFilter, AbstractStaged
from jaxslam.filters.slam import Slam

PACKAGE = Path(jaxslam.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
ORDER = (
    "_version", "_numerics", "linalg", "_runtime", "geometry", "native", "landmarks", "models",
    "io", "simulation", "statistics", "filters", "testing", "consistency", "evaluation",
    "triangulation", "plots", "tracking", "cli",
)  # fmt: skip
"""Rooms, each of which imports only those before it."""
NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER,
}  # fmt: skip
IMPORT = re.compile(
    r"^ *(?:from (?P<of>jaxslam[\w.]*) import (?P<names>\([^)]*\)|.*)"
    r"|import (?P<all>jaxslam[\w.]*))",
    re.MULTILINE,
)


def room(module):
    """The room that a module is in; the package itself has none."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else None


def imports(path):
    """Modules of the package that a file imports, wherever it does so."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxslam"):
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                place = PACKAGE.parent / whole.replace(".", "/")
                is_module = place.is_dir() or place.with_suffix(".py").exists()
                yield whole if is_module else node.module
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.startswith("jaxslam."))


def functions():
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                body = node.body
                if isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
                    body = body[1:]
                yield sum((n.end_lineno or n.lineno) - n.lineno + 1 for n in body)


def code_lines(path):
    """Lines of a file that are neither blank nor comments, docstrings or imports."""
    text, beside = path.read_text(), set()
    for node in ast.walk(ast.parse(text)):
        told = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.Import | ast.ImportFrom) or (
            told and isinstance(node.value.value, str)
        ):
            beside |= set(range(node.lineno, (node.end_lineno or 0) + 1))
    lines = {
        line
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in NO_CODE
        for line in range(token.start[0], token.end[0] + 1)
    }
    return len(lines - beside)


def test_imports_go_one_way_between_rooms():
    wrong = []
    for path in FILES:
        own = path.relative_to(PACKAGE).with_suffix("").parts[0]
        if own == "__init__":
            continue
        for module in imports(path):
            if room(module) != own and ORDER.index(room(module)) > ORDER.index(own):
                wrong.append(f"{path.relative_to(PACKAGE)} imports {module}")
    assert not wrong


def test_only_the_table_of_backends_knows_the_compiler():
    knowing = {
        path.relative_to(PACKAGE).as_posix()
        for path in FILES
        if any(room(module) == "native" for module in imports(path))
    }
    assert {x for x in knowing if not x.startswith("native/")} == {"consistency/backends.py"}


def test_no_files_import_one_another_in_a_circle():
    graph = {}
    for path in FILES:
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        graph[name] = set(imports(path)) - {name}
    done = set()

    def visit(name, above):
        assert name not in above, " → ".join([*above, name])
        if name not in done:
            for other in graph.get(name, ()):
                visit(other, [*above, name])
            done.add(name)

    for name in graph:
        visit(name, [])


def files_of(module):
    """The file of a module, and those of the rooms that it is in, without the package's own."""
    path = PACKAGE.parent / module.replace(".", "/")
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    yield path
    yield from (up / "__init__.py" for up in path.parents if PACKAGE in up.parents)


def test_evaluation_needs_few_files():
    """Geometry, statistics and text alone: what judges a filter is not what filters."""
    reached, left = set(), set((PACKAGE / "evaluation").glob("*.py"))
    while left:
        path = left.pop()
        reached.add(path)
        left |= {file for module in imports(path) for file in files_of(module)} - reached
    rooms = {path.relative_to(PACKAGE).with_suffix("").parts[0] for path in reached}
    assert rooms <= {
        "_numerics", "_runtime", "_version", "evaluation", "geometry", "io", "linalg", "statistics"
    }  # fmt: skip
    formats = set((PACKAGE / "io" / "logs").glob("*.py"))  # one file each
    assert len(reached - formats) <= 34, sorted(str(path.relative_to(PACKAGE)) for path in reached)


def test_no_two_classes_have_one_name():
    places = {}
    for path in FILES:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(path.relative_to(PACKAGE).as_posix())
    assert not {name: files for name, files in places.items() if len(files) > 1}


def test_rooms_and_functions_are_small():
    lines = {}
    for path in FILES:
        lines[path.parent] = lines.get(path.parent, 0) + len(path.read_text().splitlines())
    biggest = max(lines, key=lambda room: lines[room])
    assert lines[biggest] <= 0.18 * sum(lines.values()), (biggest, lines)
    assert statistics.median(functions()) <= 8


def test_the_house_does_not_grow():
    """What was reached is kept: whoever needs more room makes it (CONTRIBUTING.md)."""
    rooms = {path.relative_to(PACKAGE).with_suffix("").parts[0] for path in FILES} - {"__init__"}
    assert len(rooms - {"_version"}) <= 18, rooms
    arrows = {
        (path.relative_to(PACKAGE).with_suffix("").parts[0], room(module))
        for path in FILES
        for module in imports(path)
    }
    assert len({(above, below) for above, below in arrows if above != below}) <= 81
    assert sum(code_lines(path) for path in FILES if "native" not in path.parts) <= 20_900
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                assert (node.end_lineno or 0) - node.lineno < 300, (path, node.name)


def test_filters_seldom_ask_of_what_class_a_thing_is():
    """A piece says by itself what goes with it, and a function is told what it is given."""
    asked = [
        (path.name, ast.unparse(node))
        for path in (PACKAGE / "filters").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance"
        if not hasattr(builtins, ast.unparse(node.args[1]))
    ]
    assert len(asked) <= 5, asked


def test_annotations_say_what_a_thing_is():
    """`Any` is for what truly may be anything: a JSON file, an argument handed on."""
    lines = [line for path in FILES for line in path.read_text().splitlines()]
    assert sum(bool(re.search(r": Any\b", line)) for line in lines) <= 60
    assert sum(len(re.findall(r"\bAny\b", line)) for line in lines) <= 240


def public(cls):
    return {name for name in dir(cls) if not name.startswith("_")} - {
        name for name, value in vars(cls).items() if name in cls.__dataclass_fields__
    }


def test_a_filter_is_four_functions_and_one_that_tracks_six_more():
    assert AbstractFilter.__abstractmethods__ == {"init", "step", "marginal", "landmark_marginal"}
    assert AbstractStaged.__abstractmethods__ == {
        "init", "marginal", "landmark_marginal", "predict", "predict_features", "update", "compose",
        "close", "remove",
    }  # fmt: skip
    methods = {n for n in public(Slam) if callable(getattr(Slam, n, None))}
    assert len(methods - set(Slam.__dataclass_fields__)) <= 15


def modules(cls=eqx.Module):
    """Every class of the package below one; of files that are there without an extra."""
    for below in cls.__subclasses__():
        if below.__module__.startswith("jaxslam."):
            yield below
        yield from modules(below)


def test_a_class_is_abstract_or_final():
    """As in equinox: what a class does is then read in one place."""
    for path in (PACKAGE / "filters").rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        importlib.import_module(".".join(parts).removesuffix(".__init__"))
    found = set(modules())
    assert len(found) > 50
    for cls in found:
        for above in cls.__mro__[1:]:
            assert above not in found or above.__name__.startswith("Abstract"), (cls, above)


def test_a_layer_hands_on_all_that_a_filter_says():
    """Flags too: one that the protocol gains and the layers do not would be lost in them."""
    said = {name for name in dir(AbstractStaged) if not name.startswith("_")}
    own = {name for name in vars(AbstractLayer) if not name.startswith("_")}
    assert said - own == {"model"}  # of the record, whatever is around its Gaussian
    assert said <= set(vars(Slam)) | {"model"}


PAGES = [
    PACKAGE.parent / "README.md",
    *PACKAGE.parent.glob("docs/*.md"),
    *PACKAGE.parent.glob("notebooks/*.py"),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_pages_import_what_rooms_export_and_nothing_else(page):
    for found in IMPORT.finditer(page.read_text()):
        module, names = found["of"] or found["all"], found["names"]
        assert module.count(".") <= 1, found[0]
        assert "._" not in module, found[0]
        exported = getattr(importlib.import_module(module), "__all__", None)
        if names and exported is not None:
            told = {name.split(" as ")[0].strip() for name in names.strip("() \n,").split(",")}
            assert told <= set(exported), found[0]


@pytest.mark.parametrize("room", ["io", "plots", "tracking"])
def test_a_room_has_what_it_exports(room):
    pytest.importorskip("cv2")
    found = importlib.import_module(f"jaxslam.{room}")
    for name in found.__all__:
        assert getattr(found, name).__name__ == name if callable(getattr(found, name)) else True
    with pytest.raises(AttributeError, match="has no attribute 'nobody'"):
        found.nobody  # noqa: B018


def modules_after(statement):
    """The modules that a new process has imported after the statement, which warns of nothing."""
    program = f"import sys; {statement}; print(*sys.modules)"
    command = [sys.executable, "-W", "error", "-c", program]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120)
    return done.stdout.split()


def test_importing_the_package_imports_no_other():
    assert not {"jax", "numpy", "equinox"} & set(modules_after("import jaxslam"))


def test_evaluating_needs_no_filter_and_a_study_no_compiler():
    def rooms(statement):
        return {room(module) for module in modules_after(statement) if "jaxslam." in module}

    filters = {"filters", "models", "landmarks", "simulation", "consistency", "native", "tracking"}
    assert not filters & rooms("from jaxslam import evaluate, evaluate_poses, evaluate_log")
    beside = {"native", "tracking", "plots", "cli", "triangulation", "evaluation"}
    assert not beside & rooms("from jaxslam import make_filters, monte_carlo, summarise, run")


def test_the_public_names_are_light():
    """No figures, commands, bars or solvers; no device, no configuration. Nor do the options of
    commands bring OpenCV: what it is to be silent about comes first."""
    modules = modules_after(
        "import jax; before = dict(jax.config.values); from jaxslam import *;"
        "assert not jax._src.xla_bridge._backends; assert dict(jax.config.values) == before"
    )
    heavy = {"matplotlib", "tyro", "tqdm", "optimistix", "cv2", "evo", "pandas"}
    assert not (heavy | {"scipy.special", "scipy.spatial"}) & set(modules)
    assert not {"cv2", "evo"} & set(modules_after("import jaxslam.cli.commands"))
