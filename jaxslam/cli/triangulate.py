"""`jaxslam triangulate`: what parametrizations make of a point seen twice (Figs 1 and 2)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam._runtime.files import write_json
from jaxslam.triangulation import Comparison, TwoViews, compare, summarise, table
from jaxslam.triangulation.comparison import MEASUREMENTS, PARTICLES, check_sizes


@dataclass(frozen=True)
class TriangulateOptions:
    """Options of the command; every field is an option."""

    depth: float = TwoViews.depth
    """True depth of the point, m."""
    baseline: float = TwoViews.baseline
    """Sideways motion between the two views, exactly known, m."""
    pixel: float = TwoViews.pixel
    """Where the first view sees the point; by default the principal point, on the axis."""
    nearest_depth: float = TwoViews.nearest_depth
    """d_min of the prior on inverse depth, m."""
    calibration: Annotated[str, tyro.conf.arg(metavar="NAME")] = TwoViews.calibration
    """How the intrinsics err: white (drawn in each view), shared (drawn once for both), or known
    (not at all)."""
    particles: int = PARTICLES
    """Samples of the truth, and of every estimate."""
    measurements: int = MEASUREMENTS
    """Noisy measurements that distances are averaged over; 0 for the exact pixels only."""
    seed: int = 0
    """Of the noise, and of the samples."""
    out: Path = Path("results")
    """Folder for triangulation.json and triangulation.png."""

    def run(self) -> None:
        """Compare, print the table, write the files."""
        from jaxslam.plots.triangulation import plot_triangulation

        comparison = self._comparison()
        summary = summarise(comparison)
        write_json(self.out / "triangulation.json", summary, allow_nan=False)
        plot_triangulation(comparison, self.out / "triangulation.png")
        print(table(summary))
        print(f"wrote {self.out / 'triangulation.json'} and {self.out / 'triangulation.png'}")

    def _comparison(self) -> Comparison:
        from jaxslam._runtime.progress import bar

        views = TwoViews(
            depth=self.depth,
            baseline=self.baseline,
            pixel=self.pixel,
            nearest_depth=self.nearest_depth,
            calibration=self.calibration,
        )
        check_sizes(self.particles, self.measurements, self.seed)
        self.out.mkdir(parents=True, exist_ok=True)
        with bar(self.measurements, "measurement") as shown:
            return compare(
                views,
                particles=self.particles,
                measurements=self.measurements,
                seed=self.seed,
                progress=shown.update,
            )
