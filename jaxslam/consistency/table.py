"""The table of a study's results, as text and as HTML for a notebook."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from jaxslam.consistency.results import FilterResult, Nees, Results, Steps
from jaxslam.statistics import sentences


class FilterTable(NamedTuple):
    """A table with a filter a row."""

    title: str
    """The title of the column of filters."""
    columns: Mapping[str, tuple[int, Callable[[FilterResult], str]]]
    """The width in characters of every other column, and its cell for a filter."""

    def rows(self, results: Results) -> Iterator[list[str]]:
        """Yield the titles, and the cells of every filter."""
        yield [self.title, *self.columns]
        for name, result in results.items():
            yield [name, *(cell(result) for _, cell in self.columns.values())]


def as_text(results: Results) -> str:
    """Return the verdict on every filter, then the numbers of the last step, a filter a line."""
    told, wide = [], max(31, *map(len, results)) + 1
    for block in _blocks(results):
        if isinstance(block, FilterTable):
            widths = [-wide, *(width for width, _ in block.columns.values())]
            rows = [zip(row, widths, strict=True) for row in block.rows(results)]
            told += ["", *("".join(map(_aligned, row)) for row in rows)]
        else:
            told += block
    return "\n".join(told)


def as_html(results: Results) -> str:
    """Return the same as HTML."""

    def row(cells: list[str], tag: str) -> str:
        return "".join(f"<{tag}>{html.escape(x.strip())}</{tag}>" for x in cells)

    told = []
    for block in _blocks(results):
        if isinstance(block, FilterTable):
            head, *body = block.rows(results)
            rows = [row(head, "th"), *(row(cells, "td") for cells in body)]
            told.append(f"<table><tr>{'</tr><tr>'.join(rows)}</tr></table>")
        else:
            told.append(f"<p>{'<br>'.join(html.escape(line.strip()) for line in block)}</p>")
    return "".join(told)


def _aligned(cell: tuple[str, int]) -> str:
    text, width = cell
    return text.ljust(-width) if width < 0 else f" {text.rjust(width - 1)}"


def _blocks(results: Results) -> Iterator[list[str] | FilterTable]:
    """The paragraphs, as lines, and the tables between them."""
    for name, result in results.items():
        yield [f"{name}:", *(f"    {line}" for line in sentences(result.verdict))]
    yield _MAIN
    yield [
        f"last of {results.steps} steps, {results.runs} runs of seed {results.seed}; "
        f"a consistent filter has mean NEES {results.reference.nees.dof}; verdicts: "
        "of all steps, the last and each third together, [99 % interval]",
        "lost: NEES above the 99.99 % quantile of χ² now; ever: NEES above a stricter limit at "
        "some step (so `ever` can be smaller than `lost`); others: mean NEES of the runs not lost "
        "now",
    ]
    if results.scale_free:
        dof = results.reference.beyond_scale.dof
        yield _AT_ONE_SCALE
        yield [
            f"at the one scale of the truth that explains all poses of a run best: a right NEES is "
            f"{dof - 1} to {dof}; reversed: displaced away from the truth; drift of log-scale "
            "along a run, and its error in metres: rms, claimed σ: median"
        ]
    # Remarks on what the means of the table leave out.
    for name, result in results.items():
        if result.diverged and result.survivors:
            runs = result.survivors
            yield [f"{name}: means and band are of the {runs} runs that did not diverge"]
        if result.diverged and not result.survivors:
            yield [f"{name}: every run diverged, so that there is no mean"]
        if count := int(np.sum(result.landmark_nees.not_finite)):
            yield [f"{name}: {count} NEES of landmarks are not finite, and not in their mean"]


def _nis(result: FilterResult) -> str:
    dof = np.nansum(result.nis.dof)  # a filter that compares nothing has none
    nis = np.nansum(result.nis.mean) / dof if dof else math.nan
    return "–" if math.isnan(nis) else f"{nis:.3f}"


def _band(nees: Nees) -> str:
    low, high = nees.band
    return f"{low:.3f}–{high:.3f}" if np.isfinite(nees.mean).any() else "–"


def _words(result: FilterResult) -> str:
    drift = result.scale_drift.verdict
    return f"  {result.beyond_scale.verdict.word}; {'–' if drift is None else drift.word}"


def _last(values: Steps, digits: int) -> str:
    value = values[-1]
    if not math.isfinite(value):
        return "–"
    fits = not value or 10**-digits <= abs(value) < 1e4
    return f"{value:.{digits}f}" if fits else f"{value:.2g}"


def _share(values: Steps) -> str:
    return f"{values[-1]:.1%}" if math.isfinite(values[-1]) else "–"


_MAIN = FilterTable("filter/landmarks", {
    "NEES mean": (10, lambda r: _last(r.nees.mean, 3)),
    "95 % band": (14, lambda r: _band(r.nees)),
    "median": (8, lambda r: _last(r.nees.median, 2)),
    "others": (8, lambda r: _last(r.not_lost, 3)),
    "lost": (7, lambda r: _share(r.lost)),
    "ever": (7, lambda r: _share(r.lost_ever)),
    "diverged": (9, lambda r: str(r.diverged)),
    "NIS/dof": (8, _nis),
    "RMSE m": (8, lambda r: _last(r.rmse.position, 3)),
    "σ m": (8, lambda r: _last(r.sigma.position, 3)),
    "seconds": (9, lambda r: f"{r.seconds.compile + r.seconds.run:.1f}"),
})  # fmt: skip
_AT_ONE_SCALE = FilterTable("at one scale a run", {
    "NEES mean": (10, lambda r: _last(r.beyond_scale.mean, 3)),
    "95 % band": (14, lambda r: _band(r.beyond_scale)),
    "median": (8, lambda r: _last(r.beyond_scale.median, 2)),
    "lost": (7, lambda r: _share(r.beyond_scale.lost)),
    "reversed": (10, lambda r: _share(r.reversed)),
    "drift": (8, lambda r: _last(r.scale_drift.rms, 3)),
    "drift/σ": (9, lambda r: _last(r.scale_drift.normalised_rms, 2)),
    "log-scale error": (17, lambda r: _last(r.log_scale.error_rms, 3)),
    "claimed σ": (11, lambda r: _last(r.log_scale.sigma_median, 3)),
    "error/σ": (9, lambda r: _last(r.log_scale.normalised_rms, 2)),
    "  verdict; on the drift": (0, _words),
})  # fmt: skip
