"""The command `jaxslam evaluate`: test whether any filter is consistent."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam.evaluation import CHOICES, Evaluation, evaluate_log
from jaxslam.evaluation.alignment import ALIGNMENTS


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the command; every field is an option."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Arrays (FILE.npz with errors and covariances, innovations and covariances, or estimates,
    covariances and truths; FILE.csv with lines of run, step, errors, upper triangle), a trajectory
    (t tx ty tz qx qy qz qw, s and m; t x y θ; OpenVINS; KITTI), or a folder: one run, or one a
    sub-folder, of estimate.txt, covariance.txt and truth.txt, or of OpenVINS's state_estimate.txt,
    state_deviation.txt and state_groundtruth.txt; or ROS bags. Runs need not be equally long."""
    covariance: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Covariances of the trajectory's poses, docs/covariance-format.md."""
    truth: Annotated[str | None, tyro.conf.arg(metavar="FILE|TOPIC")] = None
    """True trajectory in TUM format; of a folder, that of all runs. Of a bag its topic, or
    BAG:TOPIC of another; by default the only one that fits."""
    estimate: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Of a bag: the topic of poses with covariance; by default the only one that fits."""
    error: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="NAME",
            help="Of which error the covariance is: right (T = est Exp(e)), left (T = Exp(e) est) "
            "or split (position and rotation apart). By default what the file says, else right.",
        ),
    ] = None
    axes: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="NAME",
            help="Along which it is written: body, world, or mixed (position along the world's, "
            "rotation about the body's). By default the error's own: right body, left and split "
            "world.",
        ),
    ] = None
    order: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="NAME", help=f"{' or '.join(CHOICES['order'])}, the default if no file says it."
        ),
    ] = None
    scale: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="NAME",
            help="Whether the covariance is marginal (the default) or given the scale of the "
            "world, at which NEES then is.",
        ),
    ] = None
    align: Annotated[
        str,
        tyro.conf.arg(
            metavar="NAME",
            help=f"How the estimate is laid on the truth: {', '.join(ALIGNMENTS)}; by the first "
            "pose where its covariance is zero, else to all positions.",
        ),
    ] = "none"
    axes_used: Annotated[
        str,
        tyro.conf.arg(
            metavar="NAMES",
            help="Axes of the poses that the filter estimates, as x,y,rz of a robot in the plane. "
            "By default all whose errors are not zero throughout.",
        ),
    ] = ""
    truth_sigma: Annotated[
        tuple[float, float] | None,
        tyro.conf.arg(
            metavar="METRES DEGREES",
            help="σ of the true poses themselves, of a measured truth, along the axes of the body. "
            "It is added to the covariances. By default the truth is exact.",
        ),
    ] = None
    innovations: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Innovations of the same filter and their covariances (npz or CSV): NEES and NIS together say
    whether Q or R is wrong."""
    nis: bool = False
    """The errors of a CSV or npz file are innovations, and the covariances theirs."""
    out: Path = Path("results")
    """Folder for evaluation.json and evaluation.png."""
    pdf: bool = False
    """Write evaluation.pdf too: one column for print, 3.4 in wide, its letters embedded."""

    def run(self) -> None:
        """Evaluate, print the verdict and the table, write the files."""
        from jaxslam.plots.evaluation import plot_evaluation

        found = self._evaluation()
        written = found.save(self.out)
        plot_evaluation(found, self.out / "evaluation.png")
        if self.pdf:
            plot_evaluation(found, self.out / "evaluation.pdf", column=True)
        print(found)
        print(
            f"wrote {written}, evaluation.png{' and evaluation.pdf' if self.pdf else ''} beside it"
        )

    def _evaluation(self) -> Evaluation:
        stated = {name: getattr(self, name) for name in CHOICES}
        return evaluate_log(
            self.source,
            covariance=self.covariance,
            truth=self.truth,
            estimate=self.estimate,
            stated={name: value for name, value in stated.items() if value is not None},
            align=self.align,
            axes_used=self.axes_used,
            nis=self.nis,
            truth_sigma=self.truth_sigma,
            innovations=self.innovations,
        )
