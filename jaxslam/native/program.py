"""The steps of a program on elements: operations, and what is more than an operation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from jaxslam.native.elements import Elements, Refs


@dataclass(frozen=True)
class Apply:
    """Operations that do not depend on one another."""

    made: Refs


@dataclass(frozen=True)
class Product:
    """`A Bᵀ`, or `C ± A Bᵀ`."""

    made: Refs
    """m × n; −1 where none is wanted."""
    left: Refs
    """m × k."""
    right: Refs
    """n × k."""
    addend: Refs | None = None
    """C."""
    sign: int = 1


@dataclass(frozen=True)
class Take:
    """`made[e] = table[which[e]]`, in every run another; or, of a table in rows, one row."""

    made: Refs
    table: Refs
    which: Refs


@dataclass(frozen=True)
class Put:
    """A copy of `table` with `values[e]` at `which[e]`, or what an operation makes of both there;
    dropped where −1. Of a table in rows one row is put."""

    made: Refs
    table: Refs
    which: Refs
    values: Refs
    by: str | None
    """`add`, `mul`, `min` or `max`."""


@dataclass(frozen=True)
class Sort:
    """Rows of all arrays by the first `keys` of them, stable."""

    made: Refs
    """arrays × rows × n."""
    given: Refs
    keys: int


@dataclass(frozen=True)
class Check:
    """A run in which one of these is not finite is not to be computed by this program."""

    refs: Refs
    region: int
    """The loop in which they are checked."""
    where: Refs | None
    """Only in runs in which this is true."""


@dataclass(frozen=True)
class Loop:
    """`length` times: `carry ← after`; carry is `before` at first."""

    steps: list[Step]
    length: int
    reverse: bool
    carry: Refs
    before: Refs
    after: Refs
    read: Refs
    """Variables, of which in turn t is row t of `rows`."""
    rows: Refs
    written: Refs
    """Row t is what `results` are in turn t."""
    results: Refs
    count: Refs | None = None
    """One number: the turns that a run has, `length` or fewer."""
    held: Refs | None = None
    """This stays in `written` where a run has no further turn."""


@dataclass(frozen=True)
class While:
    """`carry ← after` as long as `going`, in every run for itself."""

    condition: list[Step]
    steps: list[Step]
    carry: Refs
    before: Refs
    after: Refs
    going: Refs
    """One."""


Step: TypeAlias = Apply | Product | Take | Put | Sort | Check | Loop | While


@dataclass(frozen=True)
class ElementProgram:
    """A function of arrays: elements, how they are computed, and what goes in and out."""

    elements: Elements
    steps: list[Step]
    inputs: list[Refs]
    outputs: list[Refs]


def read_by(step: Step) -> list[Refs]:
    """Elements that have to be in memory for a step that is not an `Apply`; a loop's last."""
    match step:
        case Product():
            added = [] if step.addend is None else [step.addend[step.made >= 0]]
            return [step.left, step.right, *added]
        case Take():
            return [step.table, step.which]
        case Put():
            return [step.table, step.which, step.values]
        case Sort():
            return [step.given]
        case Check():
            return [step.refs, *([] if step.where is None else [step.where.ravel()])]
        case Loop():
            return [step.before, *(x for x in (step.count, step.held) if x is not None)]
        case While():
            return [step.before]
    return []


def read_in_turn(step: Step) -> list[Refs]:
    """Return what a loop reads in every turn, besides its steps."""
    match step:
        case Loop():
            return [step.rows, step.after, step.results]
        case While():
            return [step.after, step.going]
    return []


def written_by(step: Step) -> list[Refs]:
    """Elements that a step writes itself."""
    match step:
        case Loop():
            return [step.carry, step.read, step.written]
        case While():
            return [step.carry]
        case Check():
            return []
    return [step.made[step.made >= 0]]
