"""The tracker from many starts of a sequence: how often it is lost, reversed, or believes a lie.

    python benchmarks/starts.py
    python benchmarks/starts.py ../shared/data/kitti06_first51 --starts 8 --frames 40

Starts are spread evenly; each is a tracker of its own, with the settings of `jaxslam track`. A
*lie* is a frame whose NEES beyond scale is that of an error of 5 σ, of those that are looked at;
the reference counts as known to 0.3 % of the farthest distance from the start and to 0.06°. Whether
it is, `benchmarks/reference.py` says. Results are added to `starts.json`, and their table to
`docs/stress.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from benchmark import RESULTS, Benchmark, data_folder, table, write_table
from scipy.stats import chi2, norm

from jaxslam.evaluation import errors_beyond_scale
from jaxslam.io.opening import open_source
from jaxslam.statistics.beyond_scale import one_scale
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.trajectory import TRACKED, absolute_trajectory_error

REFERENCE = 0.003, np.radians(0.06)
"""σ of the reference's position, of the farthest distance from the start, and orientation."""
LIE = 2 * norm.sf(5)
"""The share of NEES beyond scale that is larger than that of an error of 5 σ."""
EVERY = 10
"""Frames from one that is looked at to the next."""


MARK = "<!-- by starts.py -->"


@dataclass(frozen=True, kw_only=True)
class Starts(Benchmark):
    """Trackers that begin at other places of a sequence."""

    sequences: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Data set folders with a reference; by default all there are in $JAXSLAM_DATA."""
    starts: int = 20
    """Starts."""
    frames: int = 100
    """Frames that are tracked from each; of a video that is not much longer, half of it."""
    filter: str = "recommended"
    """Filter."""
    out: Path = RESULTS / "starts.json"
    double = False

    def measure(self) -> Iterator[dict[str, Any]]:
        results, there = self.found(), data_folder().glob("*/images")
        for sequence in self.sequences or sorted(path.parent for path in there):
            results[sequence.name] = starts(sequence, self)
            yield results

    def report(self, results: dict[str, Any]) -> None:
        write_table(self.docs / "stress.md", MARK, as_table(results))


class Outcome(NamedTuple):
    """Of one start."""

    tracked: float
    """Share of the frames after the first."""
    maps: int
    sign: float
    error: float
    """Of the first map, % of its path."""
    beyond: float
    """Median NEES beyond scale by its degrees of freedom."""
    lies: float
    """Share of the frames that are looked at."""


def outcome(source, frames, settings: TrackerSettings) -> Outcome:
    """What becomes of a tracker that is given these frames."""
    tracker = Tracker(source.calibration, settings)
    results = [tracker.track(frame) for frame in frames]
    times = np.array([result.time for result in results])
    reference = source.reference
    nearest = np.array([np.argmin(np.abs(reference.times - time)) for time in times])
    truth = np.linalg.inv(reference.T_wc[nearest[0]]) @ reference.T_wc[nearest]
    first = np.array([result.map == 0 for result in results])
    tracked = np.array([result.state == "tracked" for result in results])
    T_wc = np.stack([result.T_wc for result in results])
    P = np.stack([result.covariance for result in results])
    looked = np.flatnonzero(first & tracked)
    looked = looked[looked % EVERY == 0]
    whole = Outcome(tracked[1:].mean(), tracker.restarts + 1, np.nan, np.nan, np.nan, np.nan)
    if first.sum() < 3 or not len(looked):
        return whole
    ate = absolute_trajectory_error(times[first], T_wc[first], times[first], truth[first])
    # In the unit of the map: as far as the estimate comes, where the reference does.
    far = np.linalg.norm(T_wc[first, :3, 3], axis=1).max()
    floor = np.diag([(REFERENCE[0] * far) ** 2] * 3 + [REFERENCE[1] ** 2] * 3)
    fixed = np.array([results[k].unit_fixed for k in looked])
    best = errors_beyond_scale(TRACKED, T_wc[looked], truth[looked], P[looked] + floor)
    nees = one_scale(*best, fixed).nees
    dof = np.where(fixed, 6, 5)
    return whole._replace(
        sign=ate["sign"],
        error=100 * ate["rmse"] / ate["path_length"],
        beyond=float(np.median(nees / dof)),
        lies=float(np.mean(chi2.sf(nees, dof) < LIE)),
    )


def starts(sequence: Path, options: Starts) -> dict[str, Any]:
    """Outcomes from all starts of one sequence, printed as they come."""
    source = open_source(sequence)
    if source.reference is None:
        raise SystemExit(f"{sequence}: there is no reference")
    images, settings = list(source), TrackerSettings(filter=options.filter)
    frames = min(options.frames, len(images) // 2)
    begins = np.unique(np.linspace(0, len(images) - frames, options.starts).astype(int))
    print(f"{source.name}\nstart  tracked  maps   sign  error, %  beyond scale  lies")
    line = "{:>5}  {:7.2f}  {:4.1f}  {:5.2f}  {:8.2f}  {:12.2f}  {:4.2f}".format
    found = {}
    for begin in begins.tolist():
        one = outcome(source, images[begin : begin + frames], settings)
        print(line(begin, *one), flush=True)
        found[str(begin)] = [None if np.isnan(x) else round(float(x), 4) for x in one]
    return {"filter": settings.filter, "frames": frames, "starts": found}


def as_table(results: dict[str, dict[str, Any]]) -> str:
    """Of all sequences, as Markdown."""
    header = (
        "sequence",
        "starts × frames",
        "tracked; maps",
        "reversed",
        "error, median, worst",
        "NEES/dof",
        "beyond 5 σ",
    )
    return table(header, (_row(name, result) for name, result in results.items()))


def _row(name: str, result: dict[str, Any]) -> list[str]:
    of_start = np.array(list(result["starts"].values()), float)
    tracked, maps, sign, error, beyond, lies = of_start.T
    return [
        name,
        f"{len(of_start)} × {result['frames']}",
        f"{tracked.mean():.1%}; {maps.mean():.2g}",
        f"{np.sum(sign < 0)}",
        f"{np.nanmedian(error):.2f} %, {np.nanmax(error):.1f} %",
        f"{np.nanmedian(beyond):.2g}",
        f"{np.nanmean(lies):.1%}",
    ]


if __name__ == "__main__":
    Starts.run()
