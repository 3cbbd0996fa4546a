"""What the tests are worth: faults of one line each, put into the package, and who notices.

    python benchmarks/mutants.py

A mutant is the package with one operator, sign, transpose, bound, constant or term changed, drawn
with a seed over all rooms by their size. The tests of its room are run first, then the others,
until one fails: the mutant is caught; else it has survived. An hour or two, on a copy of the tree.
"""

from __future__ import annotations

import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from benchmark import RESULTS, Benchmark

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "jaxslam"
SWAPPED: dict[type, type] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
OTHER = {"minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min"}
TYPES = ("int", "float", "str", "bool", "list", "tuple", "dict", "set", "bytes")
UNSEEN = (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom, ast.Assert)
"""Statements and words of which no number depends."""


class Site(NamedTuple):
    """A place that can be mutated, and what then stands there."""

    path: str
    line: int
    column: int
    end: int
    kind: str
    text: str


def sites(source: str, path: str) -> Iterator[Site]:
    """Every mutation of one line of a source."""
    for node in _executed(ast.parse(source)):
        if not isinstance(node, ast.expr) or node.lineno != node.end_lineno:
            continue
        for kind, made in _mutated(node):
            yield Site(path, node.lineno, node.col_offset, node.end_col_offset or 0, kind, made)


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes but annotations, docstrings, messages, and imports."""
    if isinstance(node, UNSEEN) or (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    ):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _executed(child)


def _mutated(node: ast.expr) -> Iterator[tuple[str, str]]:
    match node:
        case ast.Compare(ops=[op]) if type(op) in SWAPPED:
            yield "comparison", _with(node, ops=[SWAPPED[type(op)]()])
        case ast.BoolOp(op=op):
            yield "logic", _with(node, op=SWAPPED[type(op)]())
        case ast.BinOp(op=op, left=left) if type(op) in SWAPPED and not _of_types(node):
            yield "operator", _with(node, op=SWAPPED[type(op)]())
            if isinstance(op, ast.Add | ast.Sub):
                yield "dropped term", ast.unparse(left)
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert(), operand=operand):
            yield "sign", ast.unparse(operand)
        case ast.Attribute(attr="T", value=value):
            yield "transpose", ast.unparse(value)
        case ast.Attribute(attr=name) if name in OTHER:
            yield "bound", _with(node, attr=OTHER[name])
        case ast.Constant(value=float(value)) if value not in (0.0, 1.0):
            yield "constant", repr(2 * value)
        case ast.Constant(value=value) if type(value) is int and value > 1:
            yield "constant", repr(value + 1)


def _with(node: ast.expr, **fields) -> str:
    kept = {name: getattr(node, name) for name in node._fields}
    return f"({ast.unparse(type(node)(**kept | fields))})"


def _of_types(node: ast.BinOp) -> bool:
    """Whether types or strings are joined, which no fault of mathematics does."""
    return any(map(_is_type_or_text, ast.walk(node)))


def _is_type_or_text(node: ast.AST) -> bool:
    if isinstance(node, ast.Constant):
        return not isinstance(node.value, int | float)
    if isinstance(node, ast.Name):  # a class is Capitalised; H and PIXELS are numbers
        return node.id in TYPES or (
            node.id[0].isupper() and node.id[1:].lower() == node.id[1:] != ""
        )
    return isinstance(node, ast.JoinedStr)


def drawn(count: int, seed: int) -> list[Site]:
    """Mutants over all rooms: in each as many as its share of places, at least one.

    None of the lengths in a figure, which only eyes can judge.
    """
    rooms: dict[str, list[Site]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = str(path.relative_to(ROOT))
        found = sites(path.read_text(), name)
        rooms.setdefault(_room(name), []).extend(
            site for site in found if (_room(name), site.kind) != ("plots", "constant")
        )
    rng, chosen = random.Random(seed), []
    total = sum(map(len, rooms.values()))
    for room in sorted(rooms):
        if rooms[room]:
            share = max(1, round(count * len(rooms[room]) / total))
            chosen += rng.sample(rooms[room], min(share, len(rooms[room])))
    rng.shuffle(chosen)
    return chosen[:count]


def _room(path: str) -> str:
    return Path(path).with_suffix("").parts[1]


def applied(site: Site, source: str) -> str:
    """The source with that one line changed."""
    lines = source.splitlines(keepends=True)
    line = lines[site.line - 1].encode()
    changed = line[: site.column] + site.text.encode() + line[site.end :]
    lines[site.line - 1] = changed.decode()
    return "".join(lines)


def outcome(site: Site, tree: Path, options: list[str], minutes: float) -> str:
    """The first test that notices the mutant in this copy of the tree, or `survived`."""
    path = tree / site.path
    source = path.read_text()
    path.write_text(applied(site, source))
    room = _room(site.path).lstrip("_")
    own = [f"tests/{x}" for x in (room, f"test_{room}.py", "laws") if (tree / "tests" / x).exists()]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *options]
    try:
        for where in (own, ["tests"]):
            done = subprocess.run(
                [*command, *where], cwd=tree, capture_output=True, text=True,
                timeout=60 * minutes, env={**os.environ, "PYTHONPATH": str(tree)},
            )  # fmt: skip
            if done.returncode not in (0, 5):
                failed = [x for x in done.stdout.splitlines() if x.startswith(("FAILED", "ERROR"))]
                return [*failed, f"pytest ended with {done.returncode}"][0].split(" - ")[0]
    except subprocess.TimeoutExpired:
        return "it did not end"
    finally:
        path.write_text(source)
    return "survived"


@dataclass(frozen=True, kw_only=True)
class Mutants(Benchmark):
    """How many mutants, and the tests that they are shown."""

    count: int = 60
    seed: int = 0
    suite: Literal["quick", "whole"] = "quick"
    """The tests of plain `pytest`, or all."""
    minutes: float = 30.0
    """After which a run of tests is taken not to end."""
    only: tuple[int, ...] = ()
    """Numbers of mutants, to run these alone."""
    out: Path = RESULTS / "mutants.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """Who noticed each mutant, after every one."""
        marks, found = ["-m", ""] if self.suite == "whole" else [], []
        ignored = shutil.ignore_patterns(".git", "__pycache__", ".*cache")
        with tempfile.TemporaryDirectory() as folder:
            tree = Path(folder) / "tree"
            shutil.copytree(ROOT, tree, ignore=ignored)
            for number, site in enumerate(drawn(self.count, self.seed)):
                if not self.only or number in self.only:
                    noticed = outcome(site, tree, marks, self.minutes)
                    found.append({"number": number, **site._asdict(), "caught_by": noticed})
                    survived = [x["number"] for x in found if x["caught_by"] == "survived"]
                    of = {"suite": self.suite, "seed": self.seed, "mutants": len(found)}
                    yield {**of, "survived": survived, "each": found}

    def report(self, results: dict[str, Any]) -> None:
        last = results["each"][-1]
        print(*(last[x] for x in ("number", "path", "line", "kind", "text", "caught_by")))


if __name__ == "__main__":
    Mutants.run()
