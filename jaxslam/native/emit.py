"""The program in C++: loops over numbers of one form, products of matrices by tiles."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxslam.native.elements import CONSTANT, NAMES, OPERATIONS, Refs
from jaxslam.native.plan import Plan, arity
from jaxslam.native.program import Apply, Check, Loop, Product, Put, Sort, Step, Take, While

PRELUDE = Path(__file__).with_name("prelude.hpp")
FEW = 4
"""Numbers of one form up to which no loop is written."""
TOGETHER = 40
"""Steps in one function of the program: compilers are slow on long ones."""
TILES = ((4, 6), (6, 4), (4, 4), (3, 8), (8, 3), (2, 10), (10, 2), (1, 14), (14, 1))
"""Sums that a product keeps in registers, of which there are 32 with vectors of 64 bytes …"""
TILES_OF_FEW = ((3, 4), (4, 3), (3, 3), (2, 6), (6, 2), (1, 10), (10, 1))
"""… and 16 with shorter ones."""
PART = 250_000
"""Characters that one compiler is given: so many work at a time."""
PUTS = {None: "'='", "add": "'+'", "mul": "'*'", "min": "'<'", "max": "'>'"}
"""What `put` in the prelude makes of two numbers at one place."""
VECTOR_MATH = {64: ("e", "__AVX512F__"), 32: ("d", "__AVX2__")}
"""The letter by which glibc calls its functions of vectors of so many bytes, and what they need."""


class CppSource(NamedTuple):
    """A program in C++, and the constant arrays that it finds in the file `TABLES`.

    Its functions are those of several parts; `PART` says which of them is compiled.
    """

    text: str
    parts: int
    tables: bytes


def source(plan: Plan, kinds: tuple[list[tuple[Any, bool]], list[Any]], vector: int) -> CppSource:
    """The whole program, of vectors of so many bytes; `kinds` are the types of what goes in, and
    whether every run has its own, and the types of what comes out."""
    writer = _Writer(plan, vector)
    body = writer.function(plan.program.steps)
    entry = _entry(writer, body, *kinds)
    double = writer.elements.dtype == np.float64
    width = vector // writer.elements.dtype.itemsize
    head = [f"#define SCALAR {'double' if double else 'float'}", f"#define WIDTH {width}"]
    if vector in VECTOR_MATH:
        letter, needed = VECTOR_MATH[vector]
        name = f"_ZGV{letter}N{width}v_##x{'' if double else '##f'}"
        head += [f"#if defined({needed}) && defined(__x86_64__) && defined(__gnu_linux__)"]
        head += [f"#define VECTOR_MATH(x) {name}", "#endif"]
    head.append(PRELUDE.read_text())
    ends = np.cumsum([len(x) for x in (*writer.functions, entry)])
    head += [f"HIDDEN void f{k}(char *m);" for k in range(len(writer.functions))]
    pieces = [
        f"#if PART == {end // PART}\n{text}\n#endif"
        for end, text in zip(ends, (*writer.functions, entry), strict=True)
    ]
    return CppSource("\n".join([*head, *pieces]), int(ends[-1]) // PART + 1, writer.tables.data)


class _Tables:
    """Constant arrays, each of them once, in one piece of memory: compilers are slow on lists."""

    def __init__(self, scalar: Any) -> None:
        self._kinds = {"int": np.int32, "int16_t": np.int16, "SCALAR": scalar}
        self._pieces: list[bytes] = []
        self._places: dict[Any, int] = {}
        self._size = 0

    def __call__(self, values: Any, kind: str = "int") -> str:
        data = np.ravel(values).astype(self._kinds[kind]).tobytes()
        if (kind, data) not in self._places:
            self._places[kind, data] = self._size
            self._pieces.append(data + bytes(-len(data) % 8))
            self._size += len(self._pieces[-1])
        return f"((const {kind} *)(jaxslam_tables + {self._places[kind, data]}))"

    @property
    def data(self) -> bytes:
        """All of them."""
        return b"".join(self._pieces)


class _Writer:
    def __init__(self, plan: Plan, vector: int) -> None:
        self.plan, self.elements, self.bytes = plan, plan.program.elements, vector
        self.tables = _Tables(self.elements.dtype)
        self.functions: list[str] = []
        self.texts: dict[int, str] = {}
        self.local: dict[int, str] = {}
        self.count = 0

    def offset(self, refs: Refs) -> Any:
        """Bytes."""
        slots = self.plan.slot[refs]
        assert np.all(slots >= 0), "a number is not in memory"
        return slots * self.bytes

    def function(self, steps: list[Step]) -> str:
        """Calls of functions that take these steps."""
        calls = []
        for k in range(0, len(steps), TOGETHER):
            outer, self.local = self.local, {}
            body = [self.step(step) for step in steps[k : k + TOGETHER]]
            self.local = outer
            name = f"f{len(self.functions)}"
            text = "\n".join(x for x in body if x)
            self.functions.append(f"HIDDEN void {name}(char *m) {{\n{text}\n}}")
            calls.append(f"{name}(m);")
        return " ".join(calls)

    def step(self, step: Step) -> str:
        if isinstance(step, Apply):
            return self.apply(step)
        if isinstance(step, Check):
            return self.check(step)
        self.local.clear()  # it writes where they were
        text = self.other(step)
        self.local.clear()  # and over what it has copied first
        return text

    def other(self, step: Take | Put | Sort | Loop | While | Product) -> str:
        match step:
            case Loop():
                return self.loop(step)
            case While():
                return self.repeat(step)
            case Product():
                return self.product(step) if self.wanted(step).any() else ""
        if not self.plan.live[step.made].any():
            return ""
        made = self.tables(self.offset(step.made))
        match step:
            case Take():
                table, which = (self.tables(self.offset(x)) for x in (step.table, step.which))
                of = "row_" if step.table.ndim > 1 else ""
                return f"{of}take(m, {made}, {table}, {which}, {step.made.size});"
            case Put():
                which, values = (self.tables(self.offset(x)) for x in (step.which, step.values))
                of = "row_put" if step.table.ndim > 1 else f"put<{PUTS[step.by]}>"
                put = f"{of}(m, {made}, {which}, {values}, {step.values.size});"
                return f"{self.copied(step.made, step.table)} {put}"
            case Sort():
                sizes = ", ".join(map(str, step.made.shape))
                return (
                    f"{self.copied(step.made, step.given)} sort(m, {made}, {sizes}, {step.keys});"
                )
        raise AssertionError(step)

    def check(self, step: Check) -> str:
        """Notes the runs in which a suspect is not finite."""
        found = f"doubts(m, {self.tables(self.offset(step.refs))}, {step.refs.size})"
        if step.where is not None:
            found = f"(AT({int(self.offset(step.where.ravel())[0])}) != ZERO ? {found} : ZERO)"
        return f"AT({self.doubt}) += {found};"

    def copied(self, to: Refs, source: Refs) -> str:
        """Numbers in memory at another place."""
        to, source = (self.offset(x).ravel() for x in (to, source))
        return self.loop_over([source[to != source]], to[to != source], "{0}")

    def moved(self, step: Loop | While) -> np.ndarray:
        """Which numbers of a carry are elsewhere after a turn."""
        return self.plan.slot[step.after] != self.plan.slot[step.carry]

    def apply(self, step: Apply) -> str:
        plan = self.plan
        made = step.made[plan.live[step.made] & ~plan.inlined[step.made]]
        forms = plan.form[made]
        return "\n".join(
            self.of_form(made[forms == form], form) for form in np.unique(forms).tolist()
        )

    def of_form(self, refs: Refs, form: int) -> str:
        """Numbers of one form."""
        sources = self.plan.leaves(refs)
        places = [self.literal(x) or self.offset(x) for x in sources]
        return self.loop_over(places, self.offset(refs), self.text(form))

    def literal(self, refs: Refs) -> str | None:
        """A constant that is the same for all."""
        if self.elements.code[refs[0]] != CONSTANT or np.any(refs != refs[0]):
            return None
        return f"C({_number(self.elements.value[refs[0]])})"

    def text(self, form: int) -> str:
        """Return the text of an expression, with its leaves as {0}, {1}, …."""
        if form not in self.texts:
            self.texts[form] = self._text(form, 0)[0]
        return self.texts[form]

    def _text(self, form: int, leaf: int) -> tuple[str, int]:
        code, *operands = self.plan.forms[form]
        texts = []
        for operand in operands[: arity(code)]:
            if operand:
                text, leaf = self._text(operand - 1, leaf)
            else:
                text, leaf = f"{{{leaf}}}", leaf + 1
            texts.append(text)
        return OPERATIONS[NAMES[code - 2]].text.format(*texts), leaf

    def loop_over(self, places: list[Any], to: np.ndarray, text: str) -> str:
        """`to[e] = text` of the numbers at places, which are bytes or literals."""
        if to.size <= FEW:
            return "\n".join(self.one(places, to, text, e) for e in range(to.size))
        for place in to.tolist():
            self.local.pop(place, None)
        arrays = np.stack([x for x in places if not isinstance(x, str)] + [to])
        inner = _inner(arrays)
        rows = arrays.reshape(len(arrays), -1, inner)
        strides = (rows[:, 0, 1] - rows[:, 0, 0]).tolist() if inner > 1 else [0] * len(arrays)
        starts = rows[:, :, 0]
        lines, names = [], []
        for k, (start, stride) in enumerate(zip(starts, strides, strict=True)):
            step = set(np.diff(start).tolist())
            if len(step) <= 1:
                begin = f"{start[0]} + o * {step.pop() if step else 0}"
            else:
                begin = f"{self.tables(start)}[o]"
            if inner == 1 or (stride == 0 and k < len(starts) - 1):
                lines.append(f"  const long p{k} = {begin};")
                names.append(f"AT(p{k})")
                if inner > 1:
                    lines.append(f"  const V c{k} = AT(p{k});")
                    names[-1] = f"c{k}"
            else:
                lines.append(f"  char *const p{k} = m + {begin};")
                names.append(f"(*(V *)(p{k} + i * {stride}))")
        given = iter(names[:-1])
        filled = text.format(*(x if isinstance(x, str) else next(given) for x in places))
        body = f"{names[-1]} = {filled};"
        if inner > 1:
            body = f"for (long i = 0; i < {inner}; ++i) {body}"
        return "\n".join(
            [f"for (long o = 0; o < {rows.shape[1]}; ++o) {{", *lines, f"  {body}", "}"]
        )

    def one(self, places: list[Any], to: np.ndarray, text: str, e: int) -> str:
        """One number."""
        names = [
            x if isinstance(x, str) else self.local.get(int(x[e]), f"AT({x[e]})") for x in places
        ]
        name = f"x{self.count}"
        self.count += 1
        self.local[int(to[e])] = name
        return f"const V {name} = {text.format(*names)}; AT({to[e]}) = {name};"

    def wanted(self, step: Product) -> np.ndarray:
        """Return which numbers of a product are used."""
        return (step.made >= 0) & self.plan.live[step.made]

    def product(self, step: Product) -> str:
        """Return the code of a product, by the cheapest tiles and without what is zero."""
        alive = self.wanted(step)
        rows, columns = alive.any(1), alive.any(0)
        made = np.where(alive, step.made, -1)[np.ix_(rows, columns)]
        addend = made if step.addend is None else step.addend[np.ix_(rows, columns)]
        left, right = step.left[rows], step.right[columns]
        there = [~self.elements.is_zero(x) for x in (left, right)]
        sizes = TILES if self.bytes == 64 else TILES_OF_FEW
        tiled = [(_cost(*there, *tile), tile) for tile in sizes]
        _, (M, N) = min(tiled)
        tables, tiles = self.tiled(left, M), self.tiled(right, N)
        lists, starts, chosen, places, added = [], {}, [], [], []
        groups = [_padded(x, size) for x, size in zip(there, (M, N), strict=True)]
        near, plus = (_padded_places(x, M, N) for x in (made, addend))
        # Columns outside: theirs stay in the nearest cache.
        for j, column in enumerate(groups[1]):
            for i, row in enumerate(groups[0]):
                k = np.flatnonzero(row.any(0) & column.any(0)).astype(np.int16)
                if k.tobytes() not in starts:
                    starts[k.tobytes()] = sum(map(len, lists))
                    lists.append(k)
                begin = starts[k.tobytes()]
                if np.all(near[i, j] < 0):
                    continue
                chosen.append((i * left.shape[1] * M, j * right.shape[1] * N, begin, len(k)))
                places.append(near[i, j])
                added.append(plus[i, j])
        to, plus = (self.or_trash(np.array(x)) for x in (places, added))
        arguments = [tables, tiles, self.tables(to), self.tables(np.concatenate(lists), "int16_t")]
        arguments += [self.tables(np.array(chosen)), str(len(chosen))]
        sign = 0 if step.addend is None else step.sign
        arguments += [self.tables(plus) if sign else "nullptr"]
        return f"product<{M}, {N}, {sign}>(m, {', '.join(arguments)});"

    def or_trash(self, refs: Refs) -> np.ndarray:
        """Bytes, of −1 where nothing is, and of what is not used."""
        slots = self.plan.slot[refs]
        return np.where((refs < 0) | (slots < 0), self.trash, slots * self.bytes)

    def tiled(self, refs: Refs, size: int) -> str:
        """Places of a tile's rows for every k."""
        groups = _padded(self.offset(refs), size, self.trash)
        return self.tables(np.swapaxes(groups, 1, 2))

    @property
    def trash(self) -> int:
        """The offset of memory that is written but never read."""
        return self.plan.slots * self.bytes

    @property
    def doubt(self) -> int:
        """NaN in the runs that are not to be computed by this program, else 0."""
        return self.trash + self.bytes

    def loop(self, step: Loop) -> str:
        """A loop in C++."""
        live = self.plan.live
        read, told = live[step.read], live[step.written].any(0)
        if not step.carry.size and not told.any():
            return ""
        body, moved = self.function(step.steps), self.moved(step)
        begin = self.copied(step.carry, step.before)
        stop = ""
        if step.count is not None and step.held is not None:
            begin += self.copied(step.written[:, told], step.held[:, told])
            count = int(self.offset(step.count)[0])
            stop = f"if (!l_any((C(t) < AT({count})) ? ONE : ZERO)) break;"
            self.local.clear()
        turn = f"{step.length - 1} - t" if step.reverse else "t"
        lines = [
            begin,
            f"for (long t = 0; t < {step.length}; ++t) {{ {stop}",
            f"const long turn = {turn};",
        ]
        lines.append(self.row(step.rows[:, read], step.read[read], True))
        lines.append(body)
        lines.append(self.row(step.written[:, told], step.results[told], False))
        self.local.clear()
        lines.append(self.copied(step.carry[moved], step.after[moved]))
        self.local.clear()
        return "\n".join([*lines, "}"])

    def row(self, table: Refs, refs: Refs, reading: bool) -> str:
        """Numbers from a row of a table, or to it."""
        if not refs.size:
            return ""
        places = self.offset(table) if reading else self.or_trash(table)
        here = self.tables(self.offset(refs))
        step = np.diff(places, axis=0)
        if np.all(step == (step[:1, :1] if len(step) else 0)):
            by = int(step[0, 0]) if len(step) else 0
            base, there = f"m + turn * {by}", self.tables(places[0])
            far = f"*(V *)({base} + {there}[e])"
        else:
            far = f"AT({self.tables(places)}[turn * {refs.size} + e])"
        near = f"AT({here}[e])"
        one = f"{near} = {far}" if reading else f"{far} = {near}"
        return f"for (long e = 0; e < {refs.size}; ++e) {one};"

    def repeat(self, step: While) -> str:
        """A loop that every run leaves when it is done."""
        condition, body = self.function(step.condition), self.function(step.steps)
        moved = self.moved(step)
        places = [np.repeat(self.offset(step.going), moved.sum())]
        places += [self.offset(x[moved]) for x in (step.carry, step.after)]
        select = self.loop_over(places, places[1], "(({0} != ZERO) ? {2} : {1})")
        self.local.clear()
        begin = self.copied(step.carry, step.before)
        going = f"AT({int(self.offset(step.going)[0])})"
        self.local.clear()
        turn = [condition, f"if (!l_any({going})) break;", body, select]
        return "\n".join([begin, "for (;;) {", *turn, "}"])


def _entry(writer: _Writer, body: str, inputs: list[tuple[Any, bool]], outputs: list[Any]) -> str:
    """The function that is called from outside, for `count` runs from `first` on."""
    program, lines = writer.plan.program, []
    constants = np.flatnonzero(writer.plan.live & (writer.elements.code == CONSTANT))
    values = writer.tables(writer.elements.value[constants], "SCALAR")
    places = writer.tables(writer.offset(constants))
    lines.append(f"for (long e = 0; e < {constants.size}; ++e) AT({places}[e]) = C({values}[e]);")
    lines.append(f"AT({writer.trash}) = AT({writer.doubt}) = ZERO;")
    for k, (refs, (kind, own)) in enumerate(zip(program.inputs, inputs, strict=True)):
        if refs.size and writer.plan.live[refs].any():
            begin, each = int(writer.offset(refs.ravel()[:1])[0]), int(own)
            call = f"(m, in[{k}], {refs.size}, {begin}, first, count, {each});"
            lines.append(f"load<{_type(kind)}>{call}")
    lines.append(body)
    for k, (refs, kind) in enumerate(zip(program.outputs, outputs, strict=True)):
        if refs.size:
            at = writer.tables(writer.offset(refs))
            lines.append(f"store<{_type(kind)}>(m, out[{k}], {refs.size}, {at}, first, count);")
    lines.append(
        f"for (long l = 0; l < count; ++l) doubted[first + l] = AT({writer.doubt})[l] != 0;"
    )
    size = (writer.plan.slots + 2) * writer.bytes
    return "\n".join([
        f'extern "C" long arena() {{ return {size}; }}',
        'extern "C" void run(char *m, const void *const *in, void *const *out, bool *doubted, '
        "long first, long count) {", *lines, "}\n",
    ])  # fmt: skip


def _number(value: float) -> str:
    if value != value:
        return "NAN"
    return {np.inf: "INFINITY", -np.inf: "-INFINITY"}.get(value, repr(float(value)))


def _type(kind: Any) -> str:
    kind = np.dtype(kind)
    return {"f": {4: "float", 8: "double"}, "b": {1: "bool"}}.get(kind.kind, {}).get(
        kind.itemsize, f"{'u' if kind.kind == 'u' else ''}int{8 * kind.itemsize}_t"
    )


def _inner(arrays: np.ndarray) -> int:
    """The longest stretch, of equal length everywhere, in which places are evenly spaced."""
    n = arrays.shape[1]
    for size in [k for k in range(n, 2, -1) if n % k == 0]:
        steps = np.diff(arrays.reshape(len(arrays), -1, size), axis=2)
        if np.all(steps == steps[:, :1, :1]):
            return size
    return 1


def _padded(x: np.ndarray, size: int, filling: Any = 0) -> np.ndarray:
    """Groups of so many rows; the last is filled up."""
    short = -len(x) % size
    x = np.concatenate([x, np.full((short, *x.shape[1:]), filling, x.dtype)])
    return x.reshape(-1, size, *x.shape[1:])


def _padded_places(made: np.ndarray, M: int, N: int) -> np.ndarray:
    """Tiles × tiles × M × N."""
    full = np.full((made.shape[0] + -made.shape[0] % M, made.shape[1] + -made.shape[1] % N), -1)
    full[: made.shape[0], : made.shape[1]] = made
    full = full.reshape(full.shape[0] // M, M, full.shape[1] // N, N)
    return np.swapaxes(full, 1, 2)


def _cost(left: np.ndarray, right: np.ndarray, M: int, N: int) -> float:
    """Half cycles of a product by tiles, of these that are not zero: two sums or two loads a cycle,
    and one of a tile's rows, which come from farther away, in two cycles."""
    rows, columns = (np.any(_padded(x, size), axis=1) for x, size in ((left, M), (right, N)))
    terms = float((rows.astype(float) @ columns.T.astype(float)).sum())
    return terms * max(M * N, 1.15 * (M + N), 4 * M) + 8.0 * rows.shape[0] * columns.shape[0]
