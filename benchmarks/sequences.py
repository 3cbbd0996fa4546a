"""The tracker on every sequence there is: how far it is tracked, how far off, how sure.

    python benchmarks/sequences.py
    python benchmarks/sequences.py ../shared/data/slider_depth --filters recommended+drift world+oc

A sequence is what `jaxslam track` takes. By default all of $JAXSLAM_DATA (../shared/data) are
tracked, and synthetic videos of five seeds, of which the truth is known, and so the NEES of the
pose at the one scale of its map. Elsewhere only NIS says whether a filter believes its measurements
rightly: its mean per degree of freedom is 1 if pixels and motion are as assumed. How far the scale
drifts, in what the filter claims of that, is told wherever there is a reference. Results go to
`sequences.json`; `docs/sequences.md` and what `docs/results.md` says are written from all of them,
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
from benchmark import RESULTS, Benchmark, data_folder, number, table, write_table

from jaxslam.tracking.settings import TrackerSettings

FRAMES = (30, 149)
"""Whose pose is compared with the truth, where that is known."""
MARK = "<!-- sequences.py, in words -->"
"""Where `words` stand in both pages."""
LANDMARKS = "inverse_scaling"
SEEDS = range(5)
"""Of synthetic videos."""

ON_VIDEO = "scale_gauge+oc+scene50+drift+mixture3+rest8"
"""What `recommended+drift` is of a video, whose start nobody knows: the tracker's own filter."""
WORLD_CENTRIC = ON_VIDEO.replace("scale_gauge", "world_gauge")
"""The recommended filter with landmarks in the base frame."""
OWN = f"{ON_VIDEO}/{LANDMARKS}"

Results = dict[str, dict[str, dict[str, Any]]]
"""`results[sequence][filter/landmarks]`, and `/white` where the calibration is not `known`."""


@dataclass(frozen=True, kw_only=True)
class Sequences(Benchmark):
    """Filters on sequences."""

    sequences: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Data set folders or videos with their calibration beside them; by default all there are."""
    filters: tuple[str, ...] = (ON_VIDEO, WORLD_CENTRIC, "robocentric", "world")
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
        for mark, part in PARTS.items():
            write_table(self.docs / "sequences.md", mark, part(results))
        write_table(self.docs / "results.md", MARK, words(results))


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


SHORT = {
    ON_VIDEO: "recommended",
    WORLD_CENTRIC: "world_gauge",
    "robocentric": "robocentric",
    "world": "world",
}
"""Filters as the tables name them, in their order."""


def words(results: Results) -> str:
    """What the recommended filter reaches, in words."""
    own = {name: f[OWN] for name, f in results.items() if OWN in f and f[OWN]["error"]}
    frames = sum(r["frames"] for r in own.values())
    tracked = sum(r["tracked"] for r in own.values())
    errors = {name: r["error"] / r["path"] for name, r in own.items()}
    worst = max(errors, key=lambda name: errors[name])
    median = sorted(errors.values())[len(errors) // 2]
    upright = all(r["sign"] > 0 for r in own.values())
    straight = [f"`{name}`" for name, r in own.items() if r["straight_line"] <= r["error"]]
    return (
        f"`jaxslam track` follows {tracked} of {frames} frames of {len(own)} videos with one "
        f"setting for all. After alignment by a similarity, the RMS error of the trajectory is "
        f"{median:.2%} of the path on the median video, and {errors[worst]:.2%} on the worst, "
        f"`{worst}`. A straight line at constant speed, which uses no image, is at least as good "
        f"on {' and '.join(straight) or 'none'}.{' No world is reversed.' * upright}"
    ).replace("%", " %")


def errors_table(results: Results) -> str:
    """The error of every filter on every video, and of a straight line."""
    return _by_filter(results, _error, "straight line", lambda r: _share(r, "straight_line"))


def claims_table(results: Results) -> str:
    """How right every filter is about its error, where that is known."""
    return _by_filter(results, _claims)


def _by_filter(results: Results, cell, beside: str = "", other=None) -> str:
    """A row for each video, a column for each filter that was measured on all."""
    keys = {name: f"{name}/{LANDMARKS}" for name in SHORT}
    keys = {n: key for n, key in keys.items() if all(key in f for f in results.values())}
    rows = [
        [name, *([other(next(iter(found.values())))] if other else [])]
        + [cell(found[key]) for key in keys.values()]
        for name, found in results.items()
    ]
    return table(["video", *([beside] if other else []), *(SHORT[n] for n in keys)], rows)


def _error(r: dict[str, Any]) -> str:
    if r["error"] is None:
        return "–"
    lost = f"; {r['tracked']} of {r['frames']} frames, {r['maps']} maps" if r["maps"] > 1 else ""
    return _share(r, "error") + lost


def _claims(r: dict[str, Any]) -> str:
    drift = f"{r['drift'][1]:.2f} σ" if r["drift"] else "–"
    return f"{r['beyond_scale']['mean']:.2g}; {drift}" if r["beyond_scale"] else drift


def details_table(results: Results) -> str:
    """All else of the recommended filter."""
    header = ("video", "matches", "orientation", "in 1 s", "NIS/dof", "ungated", "drift", "ms; p99")
    return table(header, (_details(n, f[OWN]) for n, f in results.items() if OWN in f))


def _details(name: str, r: dict[str, Any]) -> list[str]:
    relative = r["relative"]
    return [
        name,
        f"{r['matches_per_frame']:.1f}",
        f"{r['orientation']:.1f}°",
        f"{relative[0]:.1%}, {relative[1]:.2f}°" if relative else "–",
        number(r["nis_per_dof"]),
        f"{r['ungated'][0]:.2f}, {r['ungated'][1]:.1%}" if r["ungated"] else "–",
        f"{r['drift'][0]:.1%}" if r["drift"] else "–",
        f"{r['milliseconds']:.0f}; {r['milliseconds_p99']:.0f}",
    ]


PARTS = {
    MARK: words,
    "<!-- sequences.py, errors -->": errors_table,
    "<!-- sequences.py, claims -->": claims_table,
    "<!-- sequences.py, details -->": details_table,
}
"""Marks of `docs/sequences.md`, and what stands behind each."""


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
