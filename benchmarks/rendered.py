"""The tracker on rendered videos that have what real ones have, and an exact truth.

    python benchmarks/rendered.py --videos /tmp/videos
    python benchmarks/rendered.py --only orbit turn+blur --seeds 0 1
    python benchmarks/rendered.py films --films /tmp/films

The settings are those of `jaxslam track`. Results are added to `rendered.json`, and their table to
`docs/sequences.md`; those of films that somebody else's renderer made to `films.json`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import RESULTS, Benchmark, number, run_one, table
from rendered_videos import KINDS, READOUT, rendered_source
from scipy.stats import chi2
from sequences import SETS, tracked
from stress import LIE

from jaxslam.io.opening import open_source
from jaxslam.tracking.settings import TrackerSettings

MARK = "<!-- by rendered.py -->"
"""Where the table stands in `docs/sequences.md`."""
OF_FILMS = "<!-- rendered.py films -->"
VIDEOS = (*KINDS, "turn+blur+exposure")

Results = dict[str, dict[str, dict[str, Any]]]
"""`results[video][seed]`."""


@dataclass(frozen=True, kw_only=True)
class Rendered(Benchmark):
    """The default tracker on rendered videos."""

    only: tuple[str, ...] = VIDEOS
    """Kinds of videos, each with any of `rendered_videos.MODIFIERS` after a +."""
    seeds: tuple[int, ...] = (0,)
    """One video each."""
    videos: Path | None = None
    """A folder that keeps the pictures, since rendering is slow."""
    out: Path = RESULTS / "rendered.json"
    double = False

    def measure(self) -> Iterator[Results]:
        results: Results = self.found()
        for seed in self.seeds:
            for name in self.only:
                told = "rolling" in name and "untold" not in name
                settings = TrackerSettings(readout=READOUT if told else 0.0)
                done = measure(rendered_source(name, seed, folder=self.videos), settings)
                results.setdefault(name, {})[str(seed)] = done
                print(name, seed, done, flush=True)
                yield results

    def tables(self, results: Results) -> Iterator[tuple[str, str, str]]:
        yield "sequences.md", MARK, as_table(results)


@dataclass(frozen=True, kw_only=True)
class Films(Benchmark):
    """The default tracker on films of another renderer."""

    films: Path
    """A folder of data sets `KIND_NUMBER`, each as `jaxslam track` takes it, with its truth."""
    out: Path = RESULTS / "films.json"
    double = False

    def measure(self) -> Iterator[Results]:
        results: Results = self.found()
        for truth in sorted(self.films.glob("*_*/groundtruth.txt")):
            kind, _, seed = truth.parent.name.rpartition("_")
            if seed not in results.setdefault(kind, {}):
                results[kind][seed] = measure(open_source(truth.parent), TrackerSettings())
                print(kind, seed, results[kind][seed], flush=True)
                yield results

    def tables(self, results: Results) -> Iterator[tuple[str, str, str]]:
        yield "sequences.md", OF_FILMS, films_table(results)


def measure(source, settings: TrackerSettings) -> dict[str, Any]:
    """The numbers of one video."""
    summary, found = tracked(source, settings)
    numbers = {
        key: summary[key]
        for key in ("frames", "tracked", "maps", "loops", "loops_refused", "matches_per_frame")
    }
    ate = summary.get("ate")
    if ate and ate["path_length"]:
        numbers["error"] = ate["rmse"] / ate["path_length"]
        numbers["causal"] = summary["ate_causal"]["rmse"] / ate["path_length"]
        numbers["straight_line"] = ate["straight_line"] / ate["path_length"]
        numbers["sign"] = ate["sign"]
        numbers["orientation"] = ate["orientation_rmse"]
    if found is not None:
        nees = found.mean[np.isfinite(found.mean)]
        numbers["beyond_scale"] = float(np.mean(nees / found.dof))
        numbers["median_beyond_scale"] = float(np.median(nees / found.dof))
        numbers["lies"] = float(np.mean(chi2.sf(nees, found.dof) < LIE))
        numbers |= {f"inside{name}": share for name, share in found.coverage.items()}
        if found.scale is not None and np.isfinite(found.scale.factor):  # of a camera that moves
            numbers["drift"] = found.scale.factor
    return {key: float(f"{value:.4g}") for key, value in numbers.items()}


def as_table(results: Results) -> str:
    """As Markdown: what the kinds are, and a row for each, with the range over its seeds."""
    kinds = dict.fromkeys(name.partition("+")[0] for name in results)
    said = "\n".join(f"- `{kind}`: {KINDS[kind].words}" for kind in kinds)
    header = ("video", "seeds", "lost; maps", "loops", "error as it went", "at the end")
    header += ("orientation", "NEES/dof", "beyond 5 σ", "drift")
    rows = (_row(name, list(seeds.values())) for name, seeds in results.items())
    return f"{said}\n\n{table(header, rows)}"


def films_table(results: Results) -> str:
    """As Markdown, a film a row."""
    header = ("film", "lost frames", "path", *(f"in {x} % sets" for x in SETS), "NEES/dof")
    header += ("σ should be ×", "beyond 5 σ", "drift of scale")
    films = ((f"{kind} {k}", film) for kind, of in results.items() for k, film in of.items())
    return table(header, (_film(*film) for film in films))


def _film(name: str, film: dict[str, Any]) -> list[str]:
    """The numbers of a film; of one whose unit is never fixed there are no NEES."""
    nees, lost = film.get("beyond_scale", np.nan), film["frames"] - film["tracked"]
    shares = [film["error"], *(film.get(f"inside{x}", np.nan) for x in SETS)]
    numbers = [*(f"{100 * x:.3g} %" for x in shares), f"{nees:.2g}", f"{nees**0.5:.2g}"]
    last = f"{100 * film.get('lies', np.nan):.3g} %", f"{film.get('drift', np.nan):.2g} σ"
    cells = [f"{lost:.0f} of {film['frames']:.0f}", *numbers, *last]
    return [name, *("–" if "nan" in cell else cell for cell in cells)]


def _row(name: str, videos: list[dict[str, Any]]) -> list[str]:
    """The numbers of a kind; a camera on the spot has no path, and so no error in its share."""

    def shown(key: str, form: str, unit: str = "", times: float = 1.0) -> str:
        values = [times * video[key] for video in videos if key in video]
        if not values:
            return "–"
        ends = dict.fromkeys(number(x, form) for x in (min(values), max(values)))
        return "–".join(ends) + unit

    lost = [1 - video["tracked"] / video["frames"] for video in videos]
    return [
        name.replace("+", " + "),
        str(len(videos)),
        f"{max(lost):.0%}; {shown('maps', '.0f')}",
        shown("loops", ".0f"),
        *(shown(key, ".2f", " %", 100) for key in ("causal", "error")),
        shown("orientation", ".1f", "°"),
        shown("beyond_scale", ".2g"),
        shown("lies", ".0f", " %", 100),
        shown("drift", ".2g", "\u00a0σ"),
    ]


if __name__ == "__main__":
    run_one(Rendered, Films)
