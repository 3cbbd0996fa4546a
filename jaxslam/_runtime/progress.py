"""The display of progress: a bar at a terminal and in a notebook, lines in a log."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

from jaxslam._runtime.extras import missing

LINE_SECONDS = 10.0
"""Seconds between two lines of a log; what takes less has none."""
_UNTIMED = "{desc}: {n_fmt}/{total_fmt} [{elapsed}]"


def bar(total: int | None, unit: str, desc: str | None = None, done: int = 0) -> Any:
    """A bar of tqdm with the time left, to be updated and closed, or used in a `with` block; so
    many are `done` already.

    Where standard error is neither a terminal nor a notebook's it is lines, `LINE_SECONDS` apart: a
    file would keep all that is drawn over at a terminal. Raises ValueError without the extra `cli`.
    """
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        raise missing("a progress bar needs", "cli", error) from None
    if sys.stderr.isatty() or "ipykernel" in sys.modules:
        return tqdm(total=total, unit=unit, desc=desc, initial=done)
    shown = tqdm(
        total=total, unit=unit, desc=desc, initial=done, file=_Lines(sys.stderr), ncols=80,
        ascii=True, mininterval=LINE_SECONDS, maxinterval=LINE_SECONDS,
    )  # fmt: skip
    # Nothing else calls while a program is compiled.
    first = threading.Timer(LINE_SECONDS, lambda: shown.disable or shown.refresh())
    first.daemon = True
    first.start()
    return shown


def _begin_timing(shown, desc: str) -> None:
    """Judge the time left by what is done from now on: what came before it had to compile."""
    shown.bar_format = None
    shown.initial = shown.last_print_n = shown.n
    shown.start_t = shown.last_print_t = time.time()
    shown.set_description(desc)


@contextmanager
def warming_bar(
    total: int | None, unit: str, first: str, warm_up: int, then: str
) -> Generator[Callable[[int], None]]:
    """Return the update of a bar that says `first`, and no time left, until `warm_up` are done;
    `then` what is left is judged by what follows."""
    with bar(total, unit, first) as shown:
        smoothing, shown.smoothing, shown.bar_format = shown.smoothing, 0.0, _UNTIMED

        def update(count: int) -> None:
            shown.update(count)
            if shown.n == warm_up:
                shown.smoothing = smoothing
                _begin_timing(shown, then)

        yield update


class StudyBar:
    """A bar for `monte_carlo(…, progress=StudyBar(runs × filters))`, closed when all are done; so
    many are `done` already. While a filter is compiled it says so, and no time left, which is then
    judged by the runs of that filter alone."""

    def __init__(self, total: int, done: int = 0) -> None:
        self._bar = bar(total, "run", done=done)
        self._bar.smoothing, self._compiling = 0.0, ""  # chunks end several at a time

    def __enter__(self) -> StudyBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, name: str, runs: int) -> None:
        """Show that so many more runs of this filter are done. None means that it is now being
        compiled, until the next call, whatever that says."""
        if not runs and name != self._compiling:
            self._compiling, self._bar.bar_format = name, _UNTIMED
            self._bar.set_description_str(f"{name}, compiling")
            return
        if not runs:
            _begin_timing(self._bar, name)
        elif name != self._bar.desc.removesuffix(": "):  # on a cluster
            self._bar.set_description(name, refresh=False)
        self._bar.update(runs)
        if self._bar.n >= self._bar.total:
            self._bar.close()


class _Lines:
    """A file to which what would be drawn anew is a line more, from `LINE_SECONDS` on."""

    def __init__(self, file: Any) -> None:
        self._file, self._begin = file, time.monotonic() + LINE_SECONDS

    def write(self, text: str) -> None:
        told = text.replace("\r", "").strip()
        if told and time.monotonic() >= self._begin:
            self._file.write(f"{told}\n")

    def flush(self) -> None:
        self._file.flush()
