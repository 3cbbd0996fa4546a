"""What the tests are worth: faults of one line each, put into the package, and who notices.

    python -m benchmarks.mutants --out benchmarks/results/mutants.json

A mutant is the package with one operator, sign, transpose, bound, constant or term changed, drawn
with a seed over all rooms by their size. The tests of its room are run first, then the others,
until one fails: the mutant is caught; else it has survived. An hour or two, on a copy of the tree.
"""

from __future__ import annotations

import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import tyro

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
    if isinstance(node, UNSEEN) or _is_text(node):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _executed(child)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


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
    own = [f"tests/{x}" for x in (room, f"test_{room}.py", "laws")]
    own = [path for path in own if (tree / path).exists()]
    try:
        for where in (own, ["tests"]):
            command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
            try:
                done = subprocess.run(
                    [*command, *options, *where], cwd=tree, capture_output=True, text=True,
                    timeout=60 * minutes, env={**os.environ, "PYTHONPATH": str(tree)},
                )  # fmt: skip
            except subprocess.TimeoutExpired:
                return "it did not end"
            if done.returncode not in (0, 5):
                failed = [x for x in done.stdout.splitlines() if x.startswith(("FAILED", "ERROR"))]
                return (
                    failed[0].split(" - ")[0] if failed else f"pytest ended with {done.returncode}"
                )
        return "survived"
    finally:
        path.write_text(source)


@dataclass(frozen=True)
class Mutants:
    """How many mutants, and the tests that they are shown."""

    count: int = 60
    seed: int = 0
    suite: Literal["quick", "whole"] = "quick"
    """The tests of plain `pytest`, or all."""
    minutes: float = 30.0
    """After which a run of tests is taken not to end."""
    only: tuple[int, ...] = ()
    """Numbers of mutants, to run these alone."""
    out: Path = ROOT / "benchmarks" / "results" / "mutants.json"


def main(options: Mutants) -> None:
    """Run the tests on every mutant; results are written after each."""
    chosen, found = drawn(options.count, options.seed), []
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".git", "__pycache__", ".*cache"))
        for number, site in enumerate(chosen):
            if options.only and number not in options.only:
                continue
            marks = ["-m", ""] if options.suite == "whole" else []
            noticed = outcome(site, tree, marks, options.minutes)
            found.append({"number": number, **site._asdict(), "caught_by": noticed})
            told = f"{number:3} {site.path}:{site.line} {site.kind}: {site.text}: {noticed}"
            print(told, flush=True)
            survived = [x["number"] for x in found if x["caught_by"] == "survived"]
            result = {
                "suite": options.suite, "seed": options.seed, "mutants": len(found),
                "caught": len(found) - len(survived), "survived": survived,
                "kinds": dict(Counter(x["kind"] for x in found)), "each": found,
            }  # fmt: skip
            options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Mutants, description=__doc__))
