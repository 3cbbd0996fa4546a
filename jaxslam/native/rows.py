"""The rows of arrays of one length, of which a loop reads and writes one in every turn."""

from __future__ import annotations

import numpy as np

from jaxslam.native.elements import Elements, Refs
from jaxslam.native.plan import each
from jaxslam.native.program import Apply, Step, read_by, read_in_turn


class RowLoop:
    """Rows that stand one after the other in memory: all runs are at the same, in every turn."""

    def __init__(self, elements: Elements, length: int) -> None:
        self._elements, self._length, self._region = elements, length, elements.region_now()
        self.turn = elements.variables(())
        """Its number."""
        self.tables = [elements.constant(np.arange(length)).reshape(length, 1)]
        """Columns of which every turn reads a row …"""
        self.variables = [self.turn.reshape(1)]
        """… into these."""
        self._rows: dict[bytes, Refs] = {}
        self._instead_of: dict[bytes, Refs] = {}
        self._written: dict[bytes, tuple[Refs, Refs]] = {}

    def stand_in(self, x: Refs) -> Refs:
        """An array in place of one that changes, of which a turn knows nothing but its row."""
        instead = self._elements.variables(x.shape)
        self._instead_of[instead.tobytes()] = x
        return instead

    def read(self, x: Refs, starts: list[Refs], sizes: tuple[int, ...]) -> Refs | None:
        """A slice of x, if it is the row of this turn."""
        if not self._is_row(x, starts, sizes):
            return None
        if x.tobytes() not in self._rows:
            self._rows[x.tobytes()] = self._row(self._instead_of.get(x.tobytes(), x))
        return self._rows[x.tobytes()].reshape(sizes)

    def write(self, x: Refs, new: Refs, starts: list[Refs]) -> Refs | None:
        """An array with another row of this turn, if it stands for one."""
        if x.tobytes() not in self._instead_of or not self._is_row(x, starts, new.shape):
            return None
        made = self._elements.variables(x.shape)
        self._written[made.tobytes()] = x, new.ravel()
        return made

    def after(self, instead: Refs, result: Refs, steps: list[Step]) -> tuple[Refs, Refs] | None:
        """The row before a turn and after it, where the result of its steps has no other change and
        nothing but the row was read."""
        starts = [self.turn, *(self._elements.constant(0.0) for _ in instead.shape[1:])]
        before = self.read(instead, starts, (1, *instead.shape[1:]))
        of, new = self._written.get(result.tobytes(), (result, before))
        used = np.concatenate([x.ravel() for x in (new, *_read(self._elements, steps))])
        if before is None or of.tobytes() != instead.tobytes() or np.isin(used, instead).any():
            return None
        return before.ravel(), new.ravel()

    def _is_row(self, x: Refs, starts: list[Refs], sizes: tuple[int, ...]) -> bool:
        here = self._region == self._elements.region_now() and starts[0].size == 1
        fits = x.ndim > 0 and len(x) == self._length and sizes == (1, *x.shape[1:])
        return bool(here and fits and starts[0].ravel()[0] == self.turn)

    def _row(self, x: Refs) -> Refs:
        table = x.reshape(self._length, -1)
        row, varies = table[0].copy(), np.any(table != table[:1], axis=0)
        turns = np.all(table == self.tables[0], axis=0)
        row[turns], varies = self.turn, varies & ~turns
        if varies.any():
            columns, place = np.unique(table[:, varies], axis=1, return_inverse=True)
            self.tables.append(columns)
            self.variables.append(self._elements.variables(columns.shape[1:]))
            row[varies] = self.variables[-1][place.ravel()]
        return row


def _read(elements: Elements, steps: list[Step]) -> list[Refs]:
    """All that steps read."""
    found: list[Refs] = []

    def visit(step: Step) -> None:
        apply = isinstance(step, Apply)
        found.extend([elements.arguments[step.made]] if apply else read_by(step))
        found.extend(read_in_turn(step))

    each(steps, visit)
    return found
