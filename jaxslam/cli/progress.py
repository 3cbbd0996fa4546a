"""How far a long command is: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

EVERY = 60.0
"""Seconds between two lines of a log; what is shorter stays silent."""


class Progress:
    """Finished runs of so many, and the time left, on standard error."""

    def __init__(
        self,
        total: int,
        done: int = 0,
        *,
        stream: Any = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.stream = sys.stderr if stream is None else stream
        self.total, self.done, self.clock = total, done, clock
        self._before, self._began = done, clock()
        self._told = self._began
        self._bar = _bar(total, done, self.stream) if self.stream.isatty() else None

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, name: str, runs: int) -> None:
        """So many more are finished; none: the filter is now compiled."""
        self.done += runs
        if self._bar is not None:
            self._bar.set_description(name if runs else f"{name}, compiling", refresh=not runs)
            self._bar.update(runs)
        elif self.clock() - self._told >= EVERY:
            self._told = self.clock()
            print(f"jaxslam: {self._line(name, runs)}", file=self.stream, flush=True)

    def _line(self, name: str, runs: int) -> str:
        share = f"{self.done} of {self.total} runs ({self.done / self.total:.0%})"
        doing = name if runs else f"{name}, compiling"
        return f"{doing}: {share}{self._left()}"

    def _left(self) -> str:
        # At the rate since the start, compilation among it.
        here = self.done - self._before
        if not here:
            return ""
        seconds = (self.clock() - self._began) * (self.total - self.done) / here
        return f", {spoken(seconds)} left"


def spoken(seconds: float) -> str:
    """A duration for people: `40 s`, `12 min`, `3 h 20 min`."""
    minutes = round(seconds / 60)
    if minutes < 2:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def _bar(total: int, done: int, stream: Any) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, initial=done, unit="run", file=stream)
