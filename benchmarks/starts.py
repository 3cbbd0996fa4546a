"""The tracker from many starts of a sequence: how often it is lost, reversed, or believes a lie.

    python benchmarks/starts.py ../shared/data/kitti06_first51 --starts 8 --frames 40

Starts are spread evenly; each is a tracker of its own, with the settings of `jaxslam track`. A
*lie* is a frame whose NEES beyond scale is that of an error of 5 σ, of those that are looked at;
the reference counts as known to 0.3 % of the farthest distance from the start and to 0.06°. Whether
it is, `benchmarks/reference.py` says.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro
from scipy.stats import chi2, norm

from jaxslam.video.opening import open_source
from jaxslam.vision.settings import TrackerSettings
from jaxslam.vision.tracker import Tracker
from jaxslam.vision.trajectory import absolute_trajectory_error, nees_beyond_scale

REFERENCE = 0.003, np.radians(0.06)
"""σ of the reference's position, of the farthest distance from the start, and orientation."""
LIE = chi2.isf(2 * norm.sf(5), 5)
"""NEES beyond scale of an error of 5 σ."""
EVERY = 10
"""Frames from one that is looked at to the next."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    sequence: Annotated[Path, tyro.conf.Positional]
    """Data set folder with a reference."""
    starts: int = 20
    """Starts."""
    frames: int = 100
    """Frames that are tracked from each."""
    filter: str = "recommended"
    """Filter."""


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
    nees, _ = nees_beyond_scale(T_wc[looked], P[looked] + floor, truth[looked])
    return whole._replace(
        sign=ate["sign"],
        error=100 * ate["rmse"] / ate["path_length"],
        beyond=float(np.median(nees)) / 5,
        lies=float(np.mean(nees > LIE)),
    )


def main() -> None:
    """Print a line for each start, and one for all."""
    options = tyro.cli(Options, description=__doc__)
    source = open_source(options.sequence)
    if source.reference is None:
        raise SystemExit(f"{options.sequence}: there is no reference")
    frames, settings = list(source), TrackerSettings(filter=options.filter)
    last = max(0, len(frames) - options.frames)
    begins = np.unique(np.linspace(0, last, options.starts).astype(int))
    print("start  tracked  maps   sign  error, %  beyond scale  lies")
    line = "{:>5}  {:7.2f}  {:4.1f}  {:5.2f}  {:8.2f}  {:12.2f}  {:4.2f}".format
    outcomes = []
    for begin in begins:
        outcomes.append(outcome(source, frames[begin : begin + options.frames], settings))
        print(line(begin, *outcomes[-1]), flush=True)
    tracked, maps, sign, error, beyond, lies = np.array(outcomes).T
    means = np.nanmean(maps), np.nanmin(sign), np.nanmedian(error), np.nanmedian(beyond)
    print(line("all", tracked.mean(), *means, np.nanmean(lies)), "(mean, least sign, medians)")
    print(f"reversed: {np.sum(sign < 0)} of {len(outcomes)}")


if __name__ == "__main__":
    main()
