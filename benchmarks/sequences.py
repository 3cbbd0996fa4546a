"""Filters on real sequences: NIS of the matches, frames tracked, trajectory error.

    python benchmarks/sequences.py ../shared/data/slider_depth ../shared/data/kitti06_first51

A sequence is what `jaxslam track` takes; without one, the synthetic video is tracked, of which the
truth is known, and so the NEES of the pose. Elsewhere only NIS says whether a filter believes its
measurements rightly: its mean per degree of freedom is 1 if pixels and motion are as assumed.
Results are added to `sequences.json`; `docs/sequences.md` is written from all of them.
"""

from __future__ import annotations

import itertools
import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxslam.files import write_atomically
from jaxslam.vision.settings import TrackerSettings

NEES_FRAMES = (10, 45, 149)
"""Frames whose pose is compared with the truth, where that is known."""

Results = dict[str, dict[str, dict[str, Any]]]
"""`results[sequence][filter/landmarks]`, and `/white` where the calibration is not `known`."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    sequences: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Data set folders or videos with their calibration beside them; none for the synthetic one."""
    filters: tuple[str, ...] = (
        "world", "world+oc", "keyframe", "robocentric", "robocentric+oc", "scale_gauge",
        "invariant",
    )  # fmt: skip
    """Filters."""
    landmarks: tuple[str, ...] = ("inverse_scaling",)
    """Landmark parametrizations."""
    calibrations: tuple[str, ...] = ("known",)
    """Treatments of the calibration: known or white."""
    out: Path = Path("benchmarks/results/sequences.json")
    """The results, added to."""
    page: Path = Path("docs/sequences.md")
    """The page."""


def measure(source, settings: TrackerSettings, *, metric: bool) -> dict[str, Any]:
    """One filter on one sequence; `metric` where its reference is in the unit of the map."""
    from jaxslam.vision.track import track

    with tempfile.TemporaryDirectory() as folder:
        summary = track(source, folder, settings)
        nees = _nees(source, Path(folder)) if metric else None
    nis, ate = summary["nis"], summary.get("ate")
    return {
        "frames": summary["frames"],
        "tracked": summary["tracked"],
        "maps": summary["maps"],
        "matches_per_frame": round(summary["matches_per_frame"], 2),
        "nis_per_dof": round(nis["mean"] / nis["dof"], 4) if nis["dof"] else None,
        "nees": nees,
        "error": ate and round(ate["rmse"], 5),
        "path": ate and round(ate["path_length"], 3),
        "straight_line": ate and round(ate["straight_line"], 5),
        "sign": ate and round(ate["sign"], 3),
        "orientation": ate and round(ate["orientation_rmse"], 3),
        "milliseconds": round(1e3 * summary["seconds"]["per_frame_median"], 1),
    }


def _nees(source, folder: Path) -> dict[str, float]:
    """Of the pose, at some frames; frame 0 is known."""
    from jaxslam.tum import read_tum
    from jaxslam.vision.trajectory import pose_nees, read_covariances

    _, T_wc = read_tum(folder / "trajectory.txt")
    _, covariances = read_covariances(folder / "covariance.txt")
    frames = [frame for frame in NEES_FRAMES if frame < len(T_wc)]
    nees = pose_nees(T_wc[frames], covariances[frames], source.reference.T_wc[frames])
    return {str(frame): float(f"{x:.4g}") for frame, x in zip(frames, nees, strict=True)}


def page(results: Results) -> str:
    """The Markdown page."""
    lines = [
        "# Filters on real sequences",
        "",
        "Made by `python benchmarks/sequences.py`; do not edit. Tracker and settings are those of",
        "`jaxslam track`; only the filter changes. *NIS/dof*: mean normalised innovation squared",
        "of the matches by its degrees of freedom, 1 where pixels (σ 0.3) and motion are as",
        "assumed; active search and RANSAC take the large innovations out, which makes it smaller.",
        "*NEES* of the pose, ideally 6, at frames 10, 45 and 149, where truth and unit are known.",
        "*Error*: RMS of the trajectory after the best similarity, in percent of the path; a",
        "*straight line* at constant speed, which looks at no picture, has the error beside the",
        "title. *Sign*: the correlation of true with estimated positions, turned by the",
        "orientations: −1 is a world behind the camera. *Orientation*: its RMS error, in degrees.",
        "A camera that is lost for 15 frames begins a new *map*, in another unit of length.",
        "The time is that of a machine that others used too. The settings are those for a hand:",
        "with them no filter follows the car of kitti06 through all frames.",
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
            "| filter | tracked | maps | matches a frame | NIS/dof | NEES | error | sign "
            "| orientation | ms a frame |",
            "|---|---|---|---|---|---|---|---|---|---|",
            *(_row(key, row) for key, row in filters.items()),
        ]
    return "\n".join(lines) + "\n"


def _row(key: str, r: dict[str, Any]) -> str:
    nis = "–" if r["nis_per_dof"] is None else f"{r['nis_per_dof']:.2f}"
    nees = ", ".join(f"{x:.0f}" for x in (r["nees"] or {}).values()) or "–"
    error = ("–", "–", "–")
    if r["error"] is not None:
        error = _share(r, "error"), f"{r['sign']:.2f}", f"{r['orientation']:.1f}°"
    return (
        f"| `{key}` | {r['tracked']} | {r['maps']} | {r['matches_per_frame']:.1f} | {nis} | {nees} "
        f"| {' | '.join(error)} | {r['milliseconds']:.0f} |"
    )


def _share(r: dict[str, Any], key: str) -> str:
    return f"{r[key] / r['path']:.2%}"


def main() -> None:
    """Measure and write."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from jaxslam.video.opening import open_source
    from jaxslam.vision.synthetic import synthetic_source

    options = tyro.cli(Options, description=__doc__)
    results: Results = json.loads(options.out.read_text()) if options.out.exists() else {}
    sources = [open_source(path) for path in options.sequences] or [synthetic_source(frames=150)]
    metric = not options.sequences
    for source in sources:
        done = results.setdefault(source.name, {})
        for name, landmarks, calibration in itertools.product(
            options.filters, options.landmarks, options.calibrations
        ):
            key = f"{name}/{landmarks}" + ("" if calibration == "known" else f"/{calibration}")
            settings = TrackerSettings(name, landmarks, calibration)
            done[key] = measure(source, settings, metric=metric)
            print(source.name, key, done[key], flush=True)
            with write_atomically(options.out) as path:
                path.write_text(json.dumps(results, indent=1) + "\n")
    with write_atomically(options.page) as path:
        path.write_text(page(results))


if __name__ == "__main__":
    main()
