"""The table of a study's results, as text and as HTML for a notebook."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Sequence

import numpy as np

from jaxslam.consistency.results import FilterResult, Nees, Results, Steps
from jaxslam.statistics import sentences

_COLUMNS = {
    "NEES mean": 10, "95 % band": 14, "median": 8, "others": 8, "lost": 7, "ever": 7,
    "diverged": 9, "NIS/dof": 8, "RMSE m": 8, "σ m": 8, "seconds": 9,
}  # fmt: skip
_OF_SCALE = {
    "NEES mean": 10, "95 % band": 14, "median": 8, "lost": 7, "reversed": 10, "drift": 8,
    "drift/σ": 9, "log-scale error": 17, "claimed σ": 11, "error/σ": 9,
    "  verdict; on the drift": 0,
}  # fmt: skip
"""The columns of the two tables, and their widths in characters."""


def as_text(results: Results) -> str:
    """Return the verdict on every filter, then the numbers of the last step, a filter a line."""
    wide = max(31, *map(len, results)) + 1

    def lines(title: str, columns: dict[str, int], rows: dict[str, list[str]]) -> Iterator[str]:
        for name, cells in {title: [*columns], **rows}.items():
            pairs = zip(cells, columns.values(), strict=True)
            yield f"{name:<{wide}}" + "".join(f"{cell:>{width}}" for cell, width in pairs)

    told = ["\n    ".join([f"{n}:", *sentences(r.verdict)]) for n, r in results.items()]
    told += ["", *lines("filter/landmarks", _COLUMNS, _rows(results)), *_explained(results)]
    if results.scale_free:
        told += ["", *lines("at one scale a run", _OF_SCALE, _rows_of_scale(results))]
        told.append(_explained_scale(results))
    return "\n".join([*told, *_notes(results)])


def as_html(results: Results) -> str:
    """Return the same as HTML."""

    def rows(title: str, columns: dict[str, int], rows: dict[str, list[str]]) -> str:
        head = "".join(f"<th>{html.escape(x)}</th>" for x in (title, *columns))
        body = (
            "".join(f"<td>{html.escape(x.strip())}</td>" for x in (name, *cells))
            for name, cells in rows.items()
        )
        return f"<table><tr>{head}</tr><tr>{'</tr><tr>'.join(body)}</tr></table>"

    def text(lines: Sequence[str]) -> str:
        return f"<p>{'<br>'.join(map(html.escape, lines))}</p>"

    told = [text([f"{name}:", *sentences(result.verdict)]) for name, result in results.items()]
    told += [rows("filter/landmarks", _COLUMNS, _rows(results)), text(_explained(results))]
    if results.scale_free:
        told.append(rows("at one scale a run", _OF_SCALE, _rows_of_scale(results)))
        told.append(text([_explained_scale(results)]))
    return "".join([*told, *(text([note]) for note in _notes(results))])


def _explained(results: Results) -> list[str]:
    return [
        f"last of {results.steps} steps, {results.runs} runs of seed {results.seed}; "
        f"a consistent filter has mean NEES {results.reference.nees.dof}; verdicts: "
        "of all steps, the last and each third together, [99 % interval]",
        "lost: NEES above the 99.99 % quantile of χ² now; ever: NEES above a stricter limit at "
        "some step (so `ever` can be smaller than `lost`); others: mean NEES of the runs not lost "
        "now",
    ]


def _explained_scale(results: Results) -> str:
    dof = results.reference.beyond_scale.dof
    return (
        f"at the one scale of the truth that explains all poses of a run best: a right NEES is "
        f"{dof - 1} to {dof}; reversed: displaced away from the truth; drift of log-scale along a "
        "run, and its error in metres: rms, claimed σ: median"
    )


def _rows(results: Results) -> dict[str, list[str]]:
    return {name: _row(result) for name, result in results.items()}


def _row(result: FilterResult) -> list[str]:
    dof = np.nansum(result.nis.dof)  # a filter that compares nothing has none
    nis = np.nansum(result.nis.mean) / dof if dof else math.nan
    return [
        *_of_nees(result.nees),
        _last(result.not_lost, 3),
        _share(result.lost),
        _share(result.lost_ever),
        str(result.diverged),
        "–" if math.isnan(nis) else f"{nis:.3f}",
        _last(result.rmse.position, 3),
        _last(result.sigma.position, 3),
        f"{result.seconds.compile + result.seconds.run:.1f}",
    ]


def _of_nees(nees: Nees) -> list[str]:
    low, high = nees.band
    band = f"{low:.3f}–{high:.3f}" if np.isfinite(nees.mean).any() else "–"
    return [_last(nees.mean, 3), band, _last(nees.median, 2)]


def _rows_of_scale(results: Results) -> dict[str, list[str]]:
    """The errors that are not of scale, and those of the scale, at the last step."""
    rows = {}
    for name, result in results.items():
        drift, scale = result.scale_drift, result.log_scale
        word = "–" if drift.verdict is None else drift.verdict.word
        rows[name] = [
            *_of_nees(result.beyond_scale),
            _share(result.beyond_scale.lost),
            _share(result.reversed),
            _last(drift.rms, 3),
            _last(drift.normalised_rms, 2),
            _last(scale.error_rms, 3),
            _last(scale.sigma_median, 3),
            _last(scale.normalised_rms, 2),
            f"  {result.beyond_scale.verdict.word}; {word}",
        ]
    return rows


def _notes(results: Results) -> Iterator[str]:
    """Remarks on what the means of the table leave out."""
    for name, result in results.items():
        if result.diverged and result.survivors:
            yield f"{name}: means and band are of the {result.survivors} runs that did not diverge"
        if result.diverged and not result.survivors:
            yield f"{name}: every run diverged, so that there is no mean"
        if count := int(np.sum(result.landmark_nees.not_finite)):
            yield f"{name}: {count} NEES of landmarks are not finite, and not in their mean"


def _last(values: Steps, digits: int) -> str:
    value = values[-1]
    if not math.isfinite(value):
        return "–"
    return f"{value:.{digits}f}" if abs(value) < 1e4 else f"{value:.2g}"


def _share(values: Steps) -> str:
    return f"{values[-1]:.1%}" if math.isfinite(values[-1]) else "–"
