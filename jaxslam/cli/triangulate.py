"""`jaxslam triangulate`: what parametrizations make of a point seen twice (Figs 1 and 2)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam._runtime.files import write_json
from jaxslam._runtime.progress import bar
from jaxslam.triangulation import (
    MEASUREMENTS,
    PARTICLES,
    TwoViews,
    check_sizes,
    compare,
    summarise,
    table,
)  # fmt: skip


@dataclass(frozen=True)
class TriangulateOptions:
    """How well do two views determine a depth, and is the estimate consistent?"""  # noqa: D400

    depth: float = TwoViews.depth
    """True depth of the point, m."""
    baseline: float = TwoViews.baseline
    """Sideways motion between the two views, exactly known, m."""
    pixel: float = TwoViews.pixel
    """Pixel of the point in the first view. Default: the principal point, on the axis."""
    nearest_depth: float = TwoViews.nearest_depth
    """d_min of the prior on inverse depth, m."""
    calibration: Annotated[str, tyro.conf.arg(metavar="NAME")] = "white"
    """How the intrinsics err: white (drawn in each view), shared (once for both), known (exact)."""
    particles: int = PARTICLES
    """Number of samples of the truth and of every estimate."""
    measurements: int = MEASUREMENTS
    """Number of noisy measurements over which distances are averaged; 0 for exact pixels only."""
    seed: int = 0
    """Random seed of the noise and of the samples."""
    out: Path = Path("results")
    """Output folder for triangulation.json and triangulation.png."""

    def run(self) -> None:
        """Compare, print the table, write the files."""
        from jaxslam.plots.triangulation import plot_triangulation

        five = self.depth, self.baseline, self.pixel, self.nearest_depth, self.calibration
        sizes = {"particles": self.particles, "measurements": self.measurements, "seed": self.seed}
        views = TwoViews(*five)
        check_sizes(**sizes)
        self.out.mkdir(parents=True, exist_ok=True)
        with bar(self.measurements, "measurement") as shown:
            comparison = compare(views, **sizes, progress=shown.update)
        summary = summarise(comparison)
        write_json(self.out / "triangulation.json", summary, allow_nan=False)
        plot_triangulation(comparison, self.out / "triangulation.png")
        print(table(summary))
        print(f"wrote {self.out / 'triangulation.json'} and {self.out / 'triangulation.png'}")
