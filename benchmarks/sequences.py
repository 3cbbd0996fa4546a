"""The tracker on every sequence there is: how far it is tracked, how far off, how sure.

    python benchmarks/sequences.py
    python benchmarks/sequences.py ../shared/data/slider_depth --filters recommended world+oc

A sequence is what `jaxslam track` takes. By default all of $JAXSLAM_DATA (../shared/data) are
tracked, and synthetic videos of five seeds, of which the truth is known, and so the NEES of the
pose at the one scale of its map. Elsewhere only NIS says whether a filter believes its measurements
rightly: its mean per degree of freedom is 1 if pixels and motion are as assumed. How far the scale
drifts, in what the filter claims of that, is told wherever there is a reference. Results go to
`sequences.json`; `docs/sequences.md` and a table of `docs/results.md` are written from all of them,
by `--page` from what is there.
"""

from __future__ import annotations

import csv
import itertools
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from benchmark import RESULTS, Benchmark, data_folder, write_page, write_table

from jaxslam.filters.registry import ON_VIDEO
from jaxslam.tracking.settings import TrackerSettings

FRAMES = (30, 149)
"""Whose pose is compared with the truth, where that is known."""
MARK = "<!-- sequences.py -->"
"""Where `summary` stands in `docs/results.md`."""
RENDERED = "\n## Rendered videos\n"
"""Where the part of `docs/sequences.md` begins that is of `rendered.py`."""
LANDMARKS = "inverse_scaling"
SEEDS = range(5)
"""Of synthetic videos."""

WORLD_CENTRIC = ON_VIDEO.replace("scale_gauge", "world_gauge")
"""The recommended filter with landmarks in the base frame."""

Results = dict[str, dict[str, dict[str, Any]]]
"""`results[sequence][filter/landmarks]`, and `/white` where the calibration is not `known`."""


@dataclass(frozen=True, kw_only=True)
class Sequences(Benchmark):
    """Filters on sequences."""

    sequences: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Data set folders or videos with their calibration beside them; by default all there are."""
    filters: tuple[str, ...] = ("recommended", WORLD_CENTRIC, "robocentric", "world")
    """Filters."""
    landmarks: tuple[str, ...] = ("inverse_scaling",)
    """Landmark parametrizations."""
    calibrations: tuple[str, ...] = ("known",)
    """Treatments of the calibration: known or white."""
    out: Path = RESULTS / "sequences.json"
    double = False

    def measure(self) -> Iterator[Results]:
        results: Results = self.found()
        for source, exact in _sources(self):
            done = results.setdefault(source.name, {})
            for name, landmarks, calibration in itertools.product(
                self.filters, self.landmarks, self.calibrations
            ):
                settings = TrackerSettings(name, landmarks, calibration)
                key = f"{settings.filter}/{landmarks}"
                key += "" if calibration == "known" else f"/{calibration}"
                done[key] = measure(source, settings, exact=exact)
                print(source.name, key, done[key], flush=True)
                yield results

    def report(self, results: Results) -> None:
        path = self.docs / "sequences.md"
        _, mark, rest = path.read_text().partition(RENDERED) if path.exists() else ("", "", "")
        write_page(path, page(results) + mark + rest)
        write_table(self.docs / "results.md", MARK, summary(results))


def measure(source, settings: TrackerSettings, *, exact: bool) -> dict[str, Any]:
    """One filter on one sequence; `exact` where its reference is the truth."""
    from jaxslam.tracking.video import track

    with tempfile.TemporaryDirectory() as folder:
        summary = track(source, folder, settings, overlay=False)
        beyond, drift = _beyond_scale(source, Path(folder))
    nis, ate, rpe = summary["nis"], summary.get("ate"), summary.get("rpe")
    ungated = summary["nis_ungated"]
    return {
        "frames": summary["frames"],
        "tracked": summary["tracked"],
        "maps": summary["maps"],
        "matches_per_frame": round(summary["matches_per_frame"], 2),
        "nis_per_dof": round(nis["mean"] / nis["dof"], 4) if nis["dof"] else None,
        "ungated": [ungated["median"], ungated["beyond95"]] if ungated["matches"] else None,
        "beyond_scale": beyond if exact else None,
        "drift": drift,
        "reversed_tests": summary["reversed_tests"],
        "error": ate and round(ate["rmse"], 5),
        "path": ate and round(ate["path_length"], 3),
        "straight_line": ate and round(ate["straight_line"], 5),
        "sign": ate and round(ate["sign"], 3),
        "orientation": ate and round(ate["orientation_rmse"], 3),
        "relative": rpe and [round(rpe["translation"] / rpe["way"], 5), round(rpe["rotation"], 3)],
        "milliseconds": round(1e3 * summary["seconds"]["per_frame_median"], 1),
        "milliseconds_p99": round(1e3 * summary["seconds"]["per_frame_p99"], 1),
    }


def _beyond_scale(source, folder: Path) -> tuple[dict[str, float], list[float] | None]:
    """NEES of the first map's poses at its one scale by the degrees of freedom, at some frames and
    as a mean; and RMS of the drift of scale, itself and in its claimed σ."""
    import numpy as np

    poses = beyond_scale(source, folder)
    if poses is None:
        return {}, None
    frames, found, normalised = poses
    nees = dict(zip(frames.tolist(), found.nees / 6, strict=True))
    at = {str(frame): float(f"{nees[frame]:.3g}") for frame in FRAMES if frame in nees}
    at["mean"] = float(f"{np.mean(found.nees / 6):.3g}")
    return at, [float(f"{np.sqrt(np.nanmean(x**2)):.3g}") for x in (found.drift, normalised)]


def beyond_scale(source, folder: Path):
    """The frames of the first map whose unit is fixed, what their poses are worth at its one scale
    (`OneScale`), and their drift of scale in its claimed σ; None where nothing is to be said."""
    import numpy as np

    from jaxslam.evaluation import errors_beyond_scale, read_covariances
    from jaxslam.io.tum import read_tum
    from jaxslam.statistics.beyond_scale import one_scale
    from jaxslam.tracking.trajectory import TRACKED

    times, T_wc = read_tum(folder / "trajectory.txt")
    covariances = read_covariances(folder / "covariance.txt").covariances
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    first = np.array([row["map"] == "0" and row["unit_fixed"] == "1" for row in rows])
    first[0] = False  # known exactly
    reference = source.reference
    if reference is None or not first.any():
        return None
    truth = reference.T_wc[[np.argmin(np.abs(reference.times - time)) for time in times]]
    truth = np.linalg.inv(truth[0]) @ truth
    best = errors_beyond_scale(TRACKED, T_wc[first], truth[first], covariances[first])
    found = one_scale(*best)
    return np.flatnonzero(first), found, found.drift / np.asarray(best.sigma)


def page(results: Results) -> str:
    """The Markdown page."""
    lines = [
        "# The tracker on sequences",
        "",
        "Made by `python benchmarks/sequences.py`; do not edit. Settings are those of `jaxslam",
        "track` for all; only the filter changes. *NIS/dof*: mean normalised innovation squared",
        "of the matches by its degrees of freedom, 1 where pixels (σ 0.3) and motion are as",
        "assumed; the tests of the matches take large innovations out, which makes it smaller,",
        "and a camera that sets out fast makes it larger: no linear prediction is for that frame.",
        "*Ungated*: squared innovations of all that was found, what is not believed included:",
        "their median by that of χ², ideally 1, and the share beyond its 95 %, ideally 5 %; less",
        "where the camera did less than its σ allows, more by wrong matches. *At one scale*: NEES",
        "of the pose at the one scale of its map that explains all of them best, by 6 degrees of",
        "freedom, at frames 30 and 149 and as a mean of those with a fixed unit, ideally 1; where",
        "the truth is known exactly. *Drift*: RMS of the log of the scale of one pose by that",
        "of the map, in percent and in the σ that the filter claims of it, at most about 1 where",
        "it claims rightly ([gauge.md](gauge.md)); the real references have errors of their own.",
        "*Error*: RMS of the trajectory, which is smoothed where the filter has submaps",
        "([submaps.md](submaps.md#loops-in-a-video)), after the best similarity, in percent of the",
        "path; a",
        "*straight line* at constant speed, which looks at no picture, has the error beside the",
        "title. *Sign*: the correlation of true with estimated positions, turned by the",
        "orientations: −1 is a world behind the camera. *Orientation*: its RMS error, in degrees.",
        "*In 1 s*: the relative pose error over one second, in percent of the way made in it, and",
        "in degrees. A camera that is lost for 15 frames begins a new *map*, in another unit of",
        "length. Times, without the overlay, are of a machine that others used too.",
    ]
    for name, filters in results.items():
        one = next(iter(filters.values()))
        title = f"{name}, {one['frames']} frames"
        if one["error"] is not None:
            title += f", a straight line {_share(one, 'straight_line')}"
        lines += [
            "",
            f"## {title}",
            "",
            "| filter | tracked | maps | matches a frame | NIS/dof | ungated | at one scale "
            "| drift | error | sign | orientation | in 1 s | ms a frame, p99 |",
            "|---" * 13 + "|",
            *(_row(key, row) for key, row in filters.items()),
        ]
    return "\n".join(lines) + "\n"


def summary(results: Results) -> str:
    """The table of docs/results.md: the recommended filter beside `world`."""
    rows = [
        "| video | frames tracked | error; straight line | sign | orientation | in 1 s "
        "| at one scale | drift of scale | `world` instead |",
        "|---" * 9 + "|",
    ]
    for name, filters in results.items():
        own, world = (filters.get(f"{one}/{LANDMARKS}") for one in (ON_VIDEO, "world"))
        if own is None or world is None:  # not measured yet
            continue
        nees = "–" if not own["beyond_scale"] else f"{own['beyond_scale']['mean']:.2g}"
        rows.append(
            f"| {name} | {own['tracked']} of {own['frames']} | {_share(own, 'error')}; "
            f"{_share(own, 'straight_line')} | {own['sign']:.2f} | {own['orientation']:.2f}° "
            f"| {own['relative'][0]:.1%} | {nees} | {own['drift'][1]:.2g} σ | {_beside(world)} |"
        )
    return "\n".join(rows)


def _beside(r: dict[str, Any]) -> str:
    told = f"{r['tracked']} of {r['frames']}"
    return told if r["maps"] > 1 else f"{told}, {_share(r, 'error')}, sign {r['sign']:.2f}"


def _row(key: str, r: dict[str, Any]) -> str:
    nis = "–" if r["nis_per_dof"] is None else f"{r['nis_per_dof']:.2f}"
    nees = ", ".join(f"{x:.3g}" for x in (r["beyond_scale"] or {}).values()) or "–"
    drift = "–" if not r["drift"] else f"{r['drift'][0]:.1%}, {r['drift'][1]:.2f} σ"
    ungated = "–"
    if r["ungated"]:
        median, beyond = r["ungated"]
        ungated = f"{median:.2f}, {beyond:.1%}"
    error = ("–", "–", "–", "–")
    if r["error"] is not None:
        error = _share(r, "error"), f"{r['sign']:.2f}", f"{r['orientation']:.1f}°", "–"
    if r["relative"]:
        translation, rotation = r["relative"]
        error = *error[:3], f"{translation:.1%}, {rotation:.2f}°"
    return (
        f"| `{key}` | {r['tracked']} | {r['maps']} | {r['matches_per_frame']:.1f} | {nis} "
        f"| {ungated} | {nees} | {drift} | {' | '.join(error)} | {r['milliseconds']:.0f}, "
        f"{r['milliseconds_p99']:.0f} |"
    )


def _share(r: dict[str, Any], key: str) -> str:
    return f"{r[key] / r['path']:.2%}"


def _sources(options: Sequences) -> Iterator[tuple[Any, bool]]:
    """Sources, and whether their reference is exactly the truth."""
    from jaxslam.io.opening import open_source
    from jaxslam.tracking.synthetic import synthetic_source

    there = sorted(path.parent for path in data_folder().glob("*/images"))
    yield from ((open_source(path), False) for path in options.sequences or there)
    if not options.sequences:
        yield from ((synthetic_source(frames=150, seed=seed), True) for seed in SEEDS)


if __name__ == "__main__":
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    Sequences.run()
