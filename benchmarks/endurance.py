"""The tracker on a video that does not end: does a frame cost more, or memory grow, with time?

    python benchmarks/endurance.py ../shared/data/monoslam_desk --frames 10000

The frames of a sequence go to and fro at their own rate. Every thousand frames: the median and the
99 % quantile of the CPU time of one, of all threads, the memory of the process, the landmarks that
left the map, and the error of the path so far. Writes `endurance.json`, and the table of
`docs/stress.md`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from benchmark import RESULTS, Benchmark, data_folder, table, write_table

from jaxslam.io.opening import open_source
from jaxslam.io.source import Frame, Source
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.trajectory import absolute_trajectory_error

BLOCK = 1000
"""Frames of a row."""
MARK = "<!-- by endurance.py -->"


@dataclass(frozen=True, kw_only=True)
class Endurance(Benchmark):
    """A long video, and what tracks it."""

    sequence: Annotated[Path, tyro.conf.Positional] = field(
        default_factory=lambda: data_folder() / "monoslam_desk"
    )
    """Data set folder or video."""
    frames: int = 10_000
    """Frames in all."""
    filter: str = "recommended"
    """Filter."""
    out: Path = RESULTS / "endurance.json"
    double = False

    def measure(self) -> Iterator[dict[str, Any]]:
        """A row for every thousand frames."""
        source = open_source(self.sequence)
        tracker = Tracker(source.calibration, TrackerSettings(filter=self.filter))
        tracker.compile()
        rows, seconds, tracked, cameras = [], [], [], {}
        still = to_and_fro(list(source), self.frames)
        for index, (frame, when) in enumerate(still):
            start = time.process_time()
            result = tracker.track(frame)
            seconds.append(time.process_time() - start)
            tracked.append(result.state == "tracked")
            if tracked[-1] and result.map == 0:
                cameras[index] = when, result.T_wc
            if len(seconds) == BLOCK:
                median, p99 = 1e3 * np.quantile(seconds, [0.5, 0.99])
                row = frame.index + 1, np.mean(tracked), tracker.restarts + 1, median, p99
                row = *row, resident(), tracker.deleted, _error(cameras, source)
                rows.append([round(float(x), 3) for x in row])
                print(rows[-1], flush=True)
                seconds, tracked = [], []
                yield {"sequence": source.name, "filter": tracker.filter_name, "rows": rows}

    def report(self, results: dict[str, Any]) -> None:
        header = (
            "to frame",
            "tracked",
            "maps",
            "ms of CPU a frame, p99",
            "memory, MiB",
            "landmarks that left",
            "error so far, %",
        )
        of_row = "{:.0f}|{:.1%}|{:.0f}|{:.1f}, {:.0f}|{:.0f}|{:.0f}|{:.2f}".format
        rows = [of_row(*row).split("|") for row in results["rows"][1::2]]
        write_table(self.docs / "stress.md", MARK, table(header, rows))


def _error(cameras: dict[int, tuple[float, np.ndarray]], source: Source) -> float:
    """RMS of all positions of the first map so far, aligned by one Sim(3), in percent of the
    length of the sequence once through; NaN without a reference."""
    if source.reference is None:
        return np.nan
    times, true = source.reference
    pairs = [(T, true[np.argmin(np.abs(times - when))]) for when, T in cameras.values()]
    each = np.arange(len(pairs), dtype=float)
    estimate, reference = (np.array(part) for part in zip(*pairs, strict=True))
    error = absolute_trajectory_error(each, estimate, each, reference)["rmse"]
    return 100 * error / float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum())


def to_and_fro(frames: Sequence[Frame], count: int) -> Iterator[tuple[Frame, float]]:
    """So many frames, and when each was taken: the first to the last, back to the first, and so
    on, at an even rate."""
    period = (frames[-1].time - frames[0].time) / (len(frames) - 1)
    there_and_back = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    for index in range(count):
        taken = frames[there_and_back[index % len(there_and_back)]]
        yield Frame(index, index * period, taken.image), taken.time


def resident() -> float:
    """Memory of this process that is in use now, MiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


if __name__ == "__main__":
    Endurance.run()
