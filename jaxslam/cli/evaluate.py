"""The command `jaxslam evaluate`: test whether any filter is consistent."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from jaxslam._runtime.files import json_numbers, write_json
from jaxslam.cli.consistency import ConsistencyOptions
from jaxslam.consistency.suite import SUITE, SuiteScenario, read_suite, write_suite
from jaxslam.consistency.summary import summarise
from jaxslam.evaluation import CHOICES, Convention, Evaluation, evaluate_poses
from jaxslam.evaluation.inputs import read_pose_log
from jaxslam.evaluation.log_files import evaluate_log, named

RIVALS = ("recommended", "robocentric", "invariant", "world")
_OF_ONE_LOG = ("covariance", "truth", "estimate", "truth_sigma", "innovations", "nis")


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the command; every field is an option."""

    source: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
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
    error: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Of which error the covariance is: right (T = est Exp(e)), left (T = Exp(e) est) or split
    (position and rotation apart). By default what the file says, else right."""
    axes: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Along which it is written: body, world, or mixed (position along the world's, rotation about
    the body's). By default the error's own: right body, left and split world."""
    order: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """position-first, the default if no file says it, or rotation-first."""
    scale: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Whether the covariance is marginal (the default) or given the scale of the world, at which
    NEES then is."""
    align: Annotated[str, tyro.conf.arg(metavar="NAME")] = "none"
    """How the estimate is laid on the truth: none, se3 or sim3; by the first pose where its
    covariance is zero, else to all positions."""
    axes_used: Annotated[str, tyro.conf.arg(metavar="NAMES")] = ""
    """Axes of the poses that the filter estimates, as x,y,rz of a robot in the plane. By default
    all whose errors are not zero throughout."""
    truth_sigma: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="METRES DEG")] = None
    """σ of the true poses themselves, of a measured truth, along the axes of the body. It is added
    to the covariances. By default the truth is exact."""
    innovations: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Innovations of the same filter and their covariances (npz or CSV): NEES and NIS together say
    whether Q or R is wrong."""
    nis: bool = False
    """The errors of a CSV or npz file are innovations, and the covariances theirs."""
    out: Path = Path("results")
    """Folder for evaluation.json and evaluation.png."""
    pdf: bool = False
    """Write evaluation.pdf too: one column for print, 3.4 in wide, its letters embedded."""

    suite: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Compare with filters here, docs/suite.md: first write measurements of simulated runs into
    FOLDER, then read the poses that your filter makes of them, NAME.csv of each in SOURCE."""
    scenario: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME …")] = SUITE
    """Of --suite: scenarios to write, as of jaxslam consistency."""
    runs: int = 100
    """Of --suite: runs of each scenario to write."""
    seed: int | None = None
    """Of --suite: what draws the runs, by default 0; needed again after --hide-truth."""
    hide_truth: bool = False
    """Of --suite: write neither the true poses nor the seed."""
    filters: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME …")] = RIVALS
    """Of --suite: filters here to compare with, as of jaxslam consistency."""

    def run(self) -> None:
        """Evaluate, print the verdict and the table, write the files."""
        if self.suite is not None:
            return self._run_suite(self.suite)
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

    def _stated(self) -> dict[str, str]:
        told = {name: getattr(self, name) for name in CHOICES}
        return {name: value for name, value in told.items() if value is not None}

    def _run_suite(self, folder: Path) -> None:
        for name in _OF_ONE_LOG:
            if getattr(self, name) not in (None, False):
                raise ValueError(f"--{name.replace('_', '-')} is of one log; --suite goes without")
        if self.source is None:
            seed, truth = self.seed or 0, not self.hide_truth
            write_suite(folder, self.scenario, runs=self.runs, seed=seed, truth=truth)
            print(f"wrote {folder}: {self.runs} runs of each scenario, drawn by --seed {seed}")
            return
        paths = {path.stem: path for path in sorted(self.source.glob("*.csv"))}
        if not paths:
            raise ValueError(f"{self.source}: holds no NAME.csv of a scenario; some are accepted")
        suite, told = read_suite(folder, paths, self.seed), {}
        found = {name: self._of_log(paths[name], one) for name, one in suite.items()}
        for name, (yours, numbers) in found.items():
            told[name] = {"yours": numbers, **self._of_filters(name, suite[name])}
            lines = _comparison(f"{name}, {suite[name].runs} runs", told[name])
            doubt = [yours.identified.sentence] if yours.identified and yours.suggested else []
            print(*lines, f"yours: {yours.headline}", *doubt, "", sep="\n")
        write_json(self.out / "suite.json", {"schema": 1, "scenarios": told}, allow_nan=False)
        print(f"wrote {self.out / 'suite.json'}")

    def _of_log(self, path: Path, suite: SuiteScenario) -> tuple[Evaluation, dict[str, Any]]:
        (_, _, _, *axes), rows = suite.tables["truth.csv"]
        times, truths = np.split(rows.reshape(suite.runs, -1, 3 + len(axes))[:, 1:, 2:], [1], -1)
        poses, P = read_pose_log(path, *truths.shape[:2], axes)
        compare = partial(evaluate_poses, poses, P, truths, Convention(**self._stated()))
        compare = partial(compare, align=self.align, axes_used=self.axes_used, times=times[0, :, 0])
        found = named(path, compare, steps=[f"step {k + 1}" for k in range(len(times[0]))])
        off = (poses - truths)[..., : suite.scenario.geometry.point_dim]
        rmse = json_numbers(np.sqrt(np.mean(np.sum(off**2, axis=-1), axis=0)))
        return found, found.asdict() | {"rmse": {"position": rmse}}

    def _of_filters(self, name: str, suite: SuiteScenario) -> dict[str, Any]:
        """The numbers of the filters here, by a study that is kept, and gone on with."""
        options = ConsistencyOptions(
            filters=self.filters, landmarks=("inverse_scaling",), out=self.out / name,
            runs=suite.runs, seed=suite.seed, resume=True,
        )  # fmt: skip
        return summarise(options.study(suite.scenario))["filters"]

    def _evaluation(self) -> Evaluation:
        if self.source is None:
            raise ValueError("SOURCE is missing; a log is accepted, or --suite FOLDER")
        of_log = {name: getattr(self, name) for name in (*_OF_ONE_LOG, "align", "axes_used")}
        return evaluate_log(self.source, stated=self._stated(), **of_log)


def _comparison(title: str, filters: dict[str, Any]) -> list[str]:
    """A line of each filter: NEES and error at the last step, the factor of σ as in its verdict."""
    lines = [f"{title:<32}NEES/dof  95 % band     σ ×    lost  RMSE m  verdict"]
    for name, x in filters.items():
        verdict, last = x["verdict"], x["nees"][-1]
        numbers = last and last / x["dof"], verdict["sigma_factor"], x["rmse"]["position"][-1]
        nees, factor, rmse = (f"{'–' if y is None else f'{y:.3g}':>8}" for y in numbers)
        band = "–".join(f"{bound / x['dof']:.2f}" for bound in x["band95"])
        told = f"{nees}  {band}{factor}{verdict['lost']:>8.1%}{rmse}  {verdict['word']}"
        lines.append(f"{name.removesuffix('/inverse_scaling'):<32}{told}")
    return lines
