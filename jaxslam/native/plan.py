"""The plan of a program: what is computed at all, what is kept in memory and where."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from jaxslam.native.elements import CODES, CONSTANT, NAMES, OPERATIONS, VARIABLE, Refs
from jaxslam.native.fuse import fused
from jaxslam.native.program import (
    Apply,
    Check,
    ElementProgram,
    Loop,
    Product,
    Put,
    Step,
    While,
    read_by,
    read_in_turn,
    written_by,
)

LONGEST = 24
"""Operations in one expression."""


@dataclass
class Plan:
    """The plan of a program, element by element."""

    program: ElementProgram
    live: np.ndarray
    """Whether anything depends on it."""
    inlined: np.ndarray
    """Whether it is only part of another's expression."""
    form: np.ndarray
    """Number of its expression in `forms`."""
    forms: list[tuple[int, ...]]
    """Code, and of every operand a form + 1, or 0 for what is in memory."""
    slot: np.ndarray
    """Where it is in memory, in vectors; −1 for what is not."""
    slots: int = 0
    """In all."""

    def leaves(self, refs: Refs) -> list[Refs]:
        """Return what elements of one form read from memory, in the order of its text."""
        code, *operands = self.forms[self.form[refs[0]]]
        found = []
        for k, operand in enumerate(operands[: arity(code)]):
            argument = self.program.elements.arguments[refs, k]
            found += self.leaves(argument) if operand else [argument]
        return found


def plan(program: ElementProgram) -> Plan:
    """Liveness, expressions and places of a program."""
    program = replace(program, steps=_checked(program))
    live, needed = _live(program)
    inlined, uses = _inlined(program, live, needed)
    form, forms = _forms(program, live, inlined)
    result = Plan(program, live, inlined, form, forms, np.full(live.size, -1, np.int64))
    result.program = replace(program, steps=_near(fused(result, uses), live.size))
    _Places(result).assign()
    return result


CARRIES = ("add", "sub", "mul", "neg", "copy")
"""Operations whose result is not finite where an operand is not."""


def _checked(program: ElementProgram) -> list[Step]:
    """Steps that check, in place of suspects, what is computed of them and used anyway.

    A sum, or a product, is finite only if its operands are: the last of a chain tells of all.
    """
    elements = program.elements
    live, _ = _live(program, checks=False)
    after = np.arange(elements.size)
    codes = [CODES[name] for name in CARRIES]
    made = np.flatnonzero(live & np.isin(elements.code, codes))
    for k in range(2):
        operands = elements.arguments[made, k]
        binary = k == 0 or ~np.isin(elements.code[made], [CODES["neg"], CODES["copy"]])
        same = (elements.region[operands] == elements.region[made]) & binary
        after[operands[same]] = made[same]
    each(program.steps, lambda step: _through_product(elements, live, step, after))
    after[elements.code == CONSTANT] = np.flatnonzero(elements.code == CONSTANT)
    while np.any(after != (farther := after[after])):
        after = farther

    def visit(steps):
        return [one(step) for step in steps]

    def one(step):
        match step:
            case Check():
                here = elements.region[step.refs] == step.region
                return replace(step, refs=np.unique(np.where(here, after[step.refs], step.refs)))
            case Loop():
                return replace(step, steps=visit(step.steps))
            case While():
                return replace(step, condition=visit(step.condition), steps=visit(step.steps))
        return step

    return visit(program.steps)


def _through_product(elements, live, step, after) -> None:
    """Note, for every number of a product's rows, a sum of which it is part."""
    if not isinstance(step, Product):
        return
    alive = live[step.made] & (elements.region[step.made] == elements.region[step.made].flat[0])
    there = [~elements.is_zero(x) for x in (step.left, step.right)]
    sides = (step.left, there[1], alive, step.made), (step.right, there[0], alive.T, step.made.T)
    for refs, other, used, made in sides:
        for k in range(refs.shape[1]):
            part = used & other[:, k]
            of = made[np.arange(len(made)), part.argmax(1)]
            same = part.any(1) & (elements.region[refs[:, k]] == elements.region[of])
            after[refs[same, k]] = of[same]


def _near(steps: list[Step], size: int) -> list[Step]:
    """Checks right after what they check, among so many elements, was computed."""
    checks = [step for step in steps if isinstance(step, Check)]
    steps = [_near_within(step, size) for step in steps if not isinstance(step, Check)]
    if not checks:
        return steps
    (check,) = checks
    written = [np.concatenate([np.zeros(0, int), *(x.ravel() for x in _made(x))]) for x in steps]
    of = np.full(size, -1)
    for number, made in enumerate(written):
        of[made] = number
    # What is from elsewhere is checked first, before it is written over.
    known = -1 if check.where is None else int(of[check.where].max())
    of = np.maximum(of[check.refs], known)
    parts = [check.refs[of == number] for number in range(-1, len(steps))]
    at = [[replace(check, refs=refs)] if refs.size else [] for refs in parts]
    result: list[Step] = [*at[0]]
    for step, checked in zip(steps, at[1:], strict=True):
        result += [step, *checked]
    return result


def _made(step: Step) -> list[Refs]:
    """What a step writes."""
    return [step.made] if isinstance(step, Apply) else written_by(step)


def _near_within(step: Step, size: int) -> Step:
    match step:
        case Loop():
            return replace(step, steps=_near(step.steps, size))
        case While():
            return replace(
                step, condition=_near(step.condition, size), steps=_near(step.steps, size)
            )
    return step


def _live(program: ElementProgram, checks: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return which elements are used, and which of them not only by operations."""
    elements = program.elements
    live, needed = (np.zeros(elements.size, bool) for _ in range(2))
    arguments = elements.arguments

    def need(refs):
        live[refs] = needed[refs] = True

    def visit(steps):
        for step in reversed(steps):
            match step:
                case Apply():
                    live[arguments[step.made[live[step.made]]]] = True
                case Loop():
                    told = live[step.written].any(0)
                    if not step.carry.size and not told.any():
                        continue
                    need(step.carry)
                    need(step.after)
                    need(step.results[told])
                    if step.count is not None and step.held is not None:
                        need(step.count)
                        need(step.held[:, told])
                    visit(step.steps)
                    need(step.before)
                    need(step.rows[:, live[step.read]])
                case While():
                    need(step.carry)
                    need(step.after)
                    visit(step.steps)
                    need(step.going)
                    visit(step.condition)
                    need(step.before)
                case Product():
                    alive = live[step.made]
                    need(step.left[alive.any(1)])
                    need(step.right[alive.any(0)])
                case Check():
                    for refs in read_by(step) if checks else ():
                        need(refs)
                case _ if live[step.made].any():
                    live[step.made] = True
                    for refs in read_by(step):
                        need(refs)

    for refs in program.outputs:
        need(refs)
    visit(program.steps)
    return live, needed


def _inlined(program: ElementProgram, live, needed) -> tuple[np.ndarray, np.ndarray]:
    """Operations that only one other operation uses, in the same loop; and numbers of uses.

    What is added to a product of matrices is not among them, but part of that product.
    """
    elements = program.elements
    computed = np.flatnonzero(live & (elements.code > VARIABLE))
    arguments = elements.arguments[computed]
    uses, user = np.zeros(elements.size, np.int64), np.zeros(elements.size, np.int64)
    np.add.at(uses, arguments, 1)
    user[arguments] = computed[:, None]
    uses += needed
    once = live & (elements.code > VARIABLE) & (uses == 1) & ~needed
    product, added = np.zeros(elements.size, bool), [CODES["add"], CODES["sub"]]
    each(program.steps, lambda step: _mark(step, product))
    once &= ~(np.isin(elements.code, added) & product[elements.arguments].any(1))
    return once & (elements.region == elements.region[user]), uses


def _mark(step: Step, product: np.ndarray) -> None:
    if isinstance(step, Product):
        product[step.made] = True


def _forms(program: ElementProgram, live, inlined) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Form the expressions; what is too long for one is split."""
    elements = program.elements
    form, size = np.zeros(elements.size, np.int64), np.zeros(elements.size, np.int64)
    forms: dict[tuple[int, ...], int] = {}

    def visit(step):
        if not isinstance(step, Apply):
            return
        made = step.made[live[step.made]]
        arguments = elements.arguments[made]
        within = inlined[arguments]
        length = 1 + np.where(within, size[arguments], 0).sum(1)
        inlined[arguments[length > LONGEST]] = False
        within = inlined[arguments]
        size[made] = 1 + np.where(within, size[arguments], 0).sum(1)
        keys = np.concatenate(
            [elements.code[made][:, None], np.where(within, form[arguments] + 1, 0)], axis=1
        )
        form[made] = [forms.setdefault(tuple(key), len(forms)) for key in keys.tolist()]

    each(program.steps, visit)
    return form, list(forms)


def each(steps: list[Step], visit: Callable[[Step], None]) -> None:
    """Every step in the order of the program, a loop before what is in it."""
    for step in steps:
        visit(step)
        for inner in inside(step):
            each(inner, visit)


def inside(step: Step) -> list[list[Step]]:
    """The lists of steps in a step."""
    match step:
        case Loop():
            return [step.steps]
        case While():
            return [step.condition, step.steps]
    return []


def arity(code: int) -> int:
    """Operands of an operation."""
    text = OPERATIONS[NAMES[code - 2]].text
    return 3 if "{2}" in text else 2 if "{1}" in text else 1


@dataclass
class _Block:
    refs: Refs
    start: int
    end: int
    first: int = -1
    enclosing: tuple[tuple[int, int], ...] = ()


@dataclass
class _Places:
    """Blocks of memory, from the step that writes to the last that reads.

    What is written last, over what nothing reads any more, stays where that was: a row of a table,
    or a number that a loop carries.
    """

    plan: Plan
    blocks: list[_Block] = field(default_factory=list)
    clock: int = 0

    def __post_init__(self) -> None:
        self.operations: dict[int, tuple[Refs, Refs]] = {}
        self.block_of, self.over, self.born, self.last = (
            np.full(self.plan.live.size, -1, np.int64) for _ in range(4)
        )
        self.elsewhere = np.zeros(self.plan.live.size, bool)
        """What is not to be written over anything."""
        self.ended, self.within = (np.full_like(self.last, -1) for _ in range(2))
        """When the loop that carries a number ends, and when it is read the last time there."""
        self.read_last: np.ndarray | None = None
        """When a number is read the last time, once that is known."""

    def assign(self) -> None:
        """Slots of all that is in memory."""
        self.passed()
        while True:
            self.read_last = self.last
            self.blocks, self.clock = [], 0
            for array in (self.block_of, self.over, self.born):
                array[:] = -1
            self.last = np.full_like(self.last, -1)
            self.passed()
            self.fit()
            before = self.elsewhere.sum()
            each(self.plan.program.steps, self.swapped)
            if self.elsewhere.sum() == before:
                return

    def swapped(self, step: Step) -> None:
        """Note what is copied to where something else is carried, but stands where another is."""
        if isinstance(step, Loop | While):
            live = self.plan.live[step.carry]
            to, source = (self.plan.slot[x[live]] for x in (step.carry, step.after))
            wrong = (to != source) & np.isin(source, to)
            self.elsewhere[step.after[live][wrong]] = True

    def passed(self) -> None:
        """The blocks of the whole program, in its order."""
        program, elements = self.plan.program, self.plan.program.elements
        kept = self.plan.live & (elements.code == CONSTANT)
        self.write(np.flatnonzero(kept), ())
        for refs in program.inputs:
            self.write(refs.ravel() if self.plan.live[refs].any() else refs.ravel()[:0], ())
        self.visit(program.steps, ())
        self.clock += 1
        for refs in [np.flatnonzero(kept), *program.outputs]:
            self.read(refs, ())

    def write(self, refs: Refs, around) -> None:
        """A block for these numbers, from now on."""
        new = refs[self.block_of[refs] < 0]
        if new.size:
            self.block_of[new], self.born[new] = len(self.blocks), self.clock
            self.blocks.append(_Block(new, self.clock, self.clock, enclosing=around))

    def write_over(self, made: Refs, old: Refs, apart: Refs) -> None:
        """Write numbers where others were, if these are read no more and are not `apart`."""
        if self.read_last is None:
            return
        made, old = made.ravel(), old.ravel()
        elements = self.plan.program.elements
        fits = self.plan.live[made] & (elements.code[old] != CONSTANT) & ~self.elsewhere[made]
        carried = self.clock <= self.ended[old]
        last = np.where(carried, self.within[old], self.read_last[old])
        fits &= (last <= self.clock) & ~np.isin(old, apart)
        once, count = np.unique(old, return_counts=True)
        fits &= np.isin(old, once[count == 1]) & (self.block_of[made] < 0)
        made, old = made[fits], old[fits]
        self.over[made], self.block_of[made] = old, self.block_of[old]
        self.born[made] = self.clock

    def read(self, refs: Refs, around, held: bool = False) -> None:
        """They are used now, or in every turn of the loops around that began after them; or they
        are only held."""
        for number in np.unique(self.block_of[refs]).tolist():
            if number < 0:
                continue
            block = self.blocks[number]
            ends = [end for begin, end in around if block.start < begin]
            block.end = max(block.end, self.clock, *ends[:1])
        if held:
            return
        when = np.full(refs.shape, self.clock)
        for begin, end in reversed(around):
            when = np.where(self.born[refs] < begin, end, when)
        np.maximum.at(self.last, refs, when)

    def visit(self, steps, around) -> None:
        for step in steps:
            self.clock += 1
            if isinstance(step, Apply):
                self.apply(step, around)
                continue
            for refs in read_by(step):
                self.read(self.used(refs), around)
            self.in_place(step, around)
            for refs in written_by(step):
                refs = np.asarray(refs).ravel()
                self.write(refs[self.plan.live[refs]], around)
            if inside(step):
                self.loop(step, around)

    def in_place(self, step: Step, around) -> None:
        """What a step writes over what it has read."""
        none = np.zeros(0, np.int64)
        match step:
            case Put():
                apart = np.concatenate([step.which.ravel(), step.values.ravel()])
                self.write_over(step.made, step.table, apart)
            case Loop() | While():
                self.write_over(step.carry, step.before, none)
                if isinstance(step, Loop) and step.held is not None:
                    self.read(self.used(step.rows), around)
                    row = np.full(self.plan.live.size, -1)
                    row[step.held] = np.arange(step.length)[:, None]
                    of = row[step.rows]
                    other = (of >= 0) & (of != np.arange(step.length)[:, None])
                    self.write_over(step.written, step.held, step.rows[other])

    def used(self, refs):
        return refs[self.plan.live[refs]]

    def apply(self, step, around) -> None:
        made, used = self.operations.get(id(step)) or self.described(step)
        self.write(made, around)
        self.read(used, around)

    def described(self, step: Apply) -> tuple[Refs, Refs]:
        """What is in memory of operations: their results, and what these are of."""
        plan = self.plan
        made = step.made[plan.live[step.made] & ~plan.inlined[step.made]]
        forms = plan.form[made]
        used = [x for form in np.unique(forms) for x in plan.leaves(made[forms == form])]
        self.operations[id(step)] = made, np.concatenate([made[:0], *used])
        return self.operations[id(step)]

    def loop(self, step, around) -> None:
        begin = self.clock
        self.clock += 1
        end = begin + 2 + sum(_duration(inner) for inner in inside(step))
        within = (*around, (begin + 1, end))
        counted = isinstance(step, Loop) and step.held is not None
        own = (step.carry, step.read) if isinstance(step, Loop) else (step.carry,)
        for refs in own:
            self.born[refs] = self.clock
        for inner in inside(step):
            self.visit(inner, within)
        self.clock = end
        for refs in read_in_turn(step):
            self.read(self.used(refs), within, held=counted and refs is step.rows)
        if self.read_last is None:
            self.ended[step.carry], self.within[step.carry] = end, self.last[step.carry]
        for refs in written_by(step):
            self.read(self.used(refs), within, held=True)

    def fit(self) -> None:
        """The first gap that is free for as long."""
        taken: list[tuple[int, int, int]] = []
        self.plan.slots = 0
        for block in self.blocks:
            taken = [x for x in taken if x[2] >= block.start]
            block.first, size = 0, len(block.refs)
            for first, last, _ in sorted(taken):
                if first - block.first >= size:
                    break
                block.first = max(block.first, last)
            taken.append((block.first, block.first + size, block.end))
            self.plan.slot[block.refs] = block.first + np.arange(size)
            self.plan.slots = max(self.plan.slots, block.first + size)
        there = np.flatnonzero(self.over >= 0)
        root = self.over[there]
        while np.any(again := self.over[root] >= 0):
            root[again] = self.over[root[again]]
        self.plan.slot[there] = self.plan.slot[root]


def _duration(steps) -> int:
    """Ticks of the clock."""
    return sum(1 + (2 + sum(map(_duration, inside(x))) if inside(x) else 0) for x in steps)
