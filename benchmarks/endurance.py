"""The tracker on a video that does not end: does a frame cost more, or memory grow, with time?

    python benchmarks/endurance.py ../shared/data/monoslam_desk --frames 10000

The frames of a sequence go to and fro at their own rate. Every thousand frames: the median and the
99 % quantile of the time of one, the memory of the process, the landmarks that left the map.
Results are written to `endurance.json`, and their table to `docs/stress.md`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from pages import write_table

from jaxslam._runtime.files import write_json
from jaxslam.io.opening import open_source
from jaxslam.io.source import Frame
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.tracker import Tracker

BLOCK = 1000
"""Frames of a row."""
MARK = "<!-- by endurance.py -->"


@dataclass(frozen=True)
class Options:
    """What to measure."""

    sequence: Annotated[Path, tyro.conf.Positional] = Path("../shared/data/monoslam_desk")
    """Data set folder or video."""
    frames: int = 10_000
    """Frames in all."""
    filter: str = "recommended"
    """Filter."""
    out: Path = Path("benchmarks/results/endurance.json")
    """The results."""
    page: Path = Path("docs/stress.md")
    """The page."""


def to_and_fro(frames: Sequence[Frame], count: int) -> Iterator[Frame]:
    """So many frames: the first to the last, back to the first, and so on, at an even rate."""
    period = (frames[-1].time - frames[0].time) / (len(frames) - 1)
    there_and_back = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    for index in range(count):
        image = frames[there_and_back[index % len(there_and_back)]].image
        yield Frame(index, index * period, image)


def resident() -> float:
    """Memory of this process that is in use now, MiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


def main() -> None:
    """Print a row for every thousand frames, and write the results."""
    options = tyro.cli(Options, description=__doc__)
    source = open_source(options.sequence)
    tracker = Tracker(source.calibration, TrackerSettings(filter=options.filter))
    tracker.compile()
    rows, seconds, tracked = [], [], []
    for frame in to_and_fro(list(source), options.frames):
        start = time.perf_counter()
        tracked.append(tracker.track(frame).state == "tracked")
        seconds.append(time.perf_counter() - start)
        if len(seconds) == BLOCK:
            median, p99 = 1e3 * np.quantile(seconds, [0.5, 0.99])
            row = frame.index + 1, np.mean(tracked), tracker.restarts + 1, median, p99
            rows.append([round(float(x), 3) for x in (*row, resident(), tracker.deleted)])
            print(rows[-1], flush=True)
            seconds, tracked = [], []
    results = {"sequence": source.name, "filter": tracker.filter_name, "rows": rows}
    write_json(options.out, results)
    write_table(options.page, MARK, table(rows))


def table(rows: list[list[float]]) -> str:
    """As Markdown."""
    head = "| to frame | tracked | maps | ms a frame, p99 | memory, MiB | landmarks that left |"
    of_row = "| {:.0f} | {:.1%} | {:.0f} | {:.1f}, {:.0f} | {:.0f} | {:.0f} |"
    return "\n".join([head, "|---" * 6 + "|", *(of_row.format(*row) for row in rows)])


if __name__ == "__main__":
    main()
