"""The command `jaxslam evaluate`: test whether any filter is consistent."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from jaxslam._runtime.files import Json, json_numbers, write_atomically, write_json
from jaxslam.cli.consistency import ConsistencyOptions
from jaxslam.cli.extra import seconds
from jaxslam.consistency.suite import SUITE, SuiteScenario, read_suite, write_suite
from jaxslam.consistency.summary import summarise
from jaxslam.evaluation import CHOICES, Convention, Evaluation, evaluate_poses
from jaxslam.evaluation.inputs import read_pose_log
from jaxslam.evaluation.log_files import evaluate_log, named
from jaxslam.evaluation.result import latex

RIVALS = ("recommended", "robocentric", "invariant", "world")
_OF_ONE_LOG = (
    "covariance", "truth", "estimate", "truth_sigma", "innovations", "nis", "against",
)  # fmt: skip


@dataclass(frozen=True)
class EvaluateOptions:
    """Test the consistency of your own filter from its errors."""

    source: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
    """Arrays, a trajectory, a folder or ROS bags. Arrays: FILE.npz (or .mat) with errors and
    covariances, innovations and covariances, or estimates, covariances and truths; FILE.csv with
    lines of run, step, errors, upper triangle. Trajectory: any text whose titles name t, x, y, z,
    qx … qw; TUM; t x y θ; OpenVINS; EuRoC; VINS-Mono; KITTI; g2o; RTKLIB; SQUARE. Folder:
    estimate.txt, covariance.txt and truth.txt, or OpenVINS's state_estimate.txt,
    state_deviation.txt and state_groundtruth.txt, or one sub-folder of these per run, or
    trajectories with their covariances beside one truth.txt. Runs may differ in length."""
    covariance: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Covariances of the trajectory's poses (docs/covariance-format.md). Default: those in its own
    lines."""
    truth: Annotated[str | None, tyro.conf.arg(metavar="FILE|TOPIC")] = None
    """True trajectory of any of these formats; for a folder, the truth of all runs. For a bag: its
    topic, or BAG:TOPIC of another bag; default: the only topic that fits."""
    estimate: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Topic of a bag with the estimated poses and covariances. Default: the only one that fits."""
    error: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Which error the covariance describes: right (T = est Exp(e)), left (T = Exp(e) est) or split
    (position and rotation separately). Default: what the file says, otherwise right."""
    axes: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Axes of that error: body, world, mixed (position along the world's axes, rotation about the
    body's) or rpy (position along the world's, and roll, pitch and yaw). Default: body for right,
    world for left and split."""
    order: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Order of its components: position-first or rotation-first. Default: what the file says,
    otherwise position-first."""
    scale: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Whether the covariance is marginal (the default) or given the scale of the world; with given,
    NEES is computed at that scale."""
    align: Annotated[str, tyro.conf.arg(metavar="NAME")] = "none"
    """How the estimate is aligned with the truth: none, first (at the first pose), yaw (position
    and yaw, which no camera with an IMU knows), se3 or sim3. The last three use the first pose
    where its σ is small, otherwise all poses."""
    time_offset: Annotated[str, tyro.conf.arg(metavar="TIME|auto")] = "0"
    """By how much the estimate's stamps are late, such as 50ms; auto finds it by the rotations of
    both."""
    axes_used: Annotated[str, tyro.conf.arg(metavar="NAMES")] = ""
    """Axes that the filter estimates, such as x,y,rz for a robot in the plane. Default: all axes
    whose errors are not always zero."""
    truth_sigma: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="METRES DEG")] = None
    """σ of the true poses, if the truth was measured, along the body's axes; it is added to the
    covariances. Default: the truth is exact."""
    innovations: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Innovations of the same filter and their covariances (npz or CSV): NEES and NIS together show
    whether Q or R is wrong."""
    nis: bool = False
    """Treat the errors in a CSV or npz file as innovations, and the covariances as theirs."""
    out: Path = Path("results")
    """Output folder for evaluation.json and evaluation.png."""
    against: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Another filter's log of the same run, with its covariances, in place of a truth: the
    covariances of both are added."""
    latex: bool = False
    """Also write evaluation.tex, the table for LaTeX."""
    pdf: bool = False
    """Also write evaluation.pdf, one column (3.4 in) wide for print, with embedded fonts."""

    suite: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Compare your filter with those of jaxslam (docs/suite.md). Without SOURCE: write measurements
    of simulated runs to FOLDER. With it: evaluate the poses your filter estimated from them,
    SOURCE/NAME.csv for each scenario."""
    scenario: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME …")] = SUITE
    """With --suite: scenarios to write, as for jaxslam consistency."""
    runs: int = 100
    """With --suite: number of runs to write for each scenario."""
    seed: int | None = None
    """With --suite: random seed of the runs, by default 0; must be given again after
    --hide-truth."""
    hide_truth: bool = False
    """With --suite: write neither the true poses nor the seed."""
    filters: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME …")] = RIVALS
    """With --suite: filters to compare with, as for jaxslam consistency."""

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
        if self.latex:
            with write_atomically(self.out / "evaluation.tex") as path:
                path.write_text(latex(found), encoding="utf-8")
        too = " and evaluation.pdf" * self.pdf + " and evaluation.tex" * self.latex
        print(f"wrote {written} and, beside it, evaluation.png{too}")

    def _stated(self) -> dict[str, str]:
        told = {name: getattr(self, name) for name in CHOICES}
        return {name: value for name, value in told.items() if value is not None}

    def _run_suite(self, folder: Path) -> None:
        for name in _OF_ONE_LOG:
            if getattr(self, name) not in (None, False):
                raise ValueError(
                    f"--{name.replace('_', '-')} applies to one log; it cannot be used with --suite"
                )
        if self.source is None:
            seed, truth = self.seed or 0, not self.hide_truth
            write_suite(folder, self.scenario, runs=self.runs, seed=seed, truth=truth)
            print(f"wrote {folder}: {self.runs} runs of each scenario, seed {seed}")
            return
        paths = {path.stem: path for path in sorted(self.source.glob("*.csv"))}
        if not paths:
            names = sorted(path.parent.name for path in folder.glob("*/scenario.json")) or ["NAME"]
            expected = ", ".join(f"{name}.csv" for name in names)
            raise ValueError(f"{self.source} has no log: expected {expected}")
        suite, told = read_suite(folder, paths, self.seed), {}
        found = {name: self._of_log(paths[name], one) for name, one in suite.items()}
        for name, (yours, content) in found.items():
            told[name] = {"yours": content, **self._of_filters(name, suite[name])}
            lines = _comparison(f"{name}, {suite[name].runs} runs", told[name])
            doubt = [yours.identified.sentence] if yours.identified and yours.suggested else []
            print(*lines, f"yours: {yours.headline}", *doubt, "", sep="\n")
        write_json(self.out / "suite.json", {"schema": 1, "scenarios": told}, allow_nan=False)
        print(f"wrote {self.out / 'suite.json'}")

    def _of_log(self, path: Path, suite: SuiteScenario) -> tuple[Evaluation, dict[str, Json]]:
        (_, _, _, *axes), rows = suite.tables["truth.csv"]
        times, truths = np.split(rows.reshape(suite.runs, -1, 3 + len(axes))[:, 1:, 2:], [1], -1)
        poses, P = read_pose_log(path, *truths.shape[:2], axes)
        compare = partial(evaluate_poses, poses, P, truths, Convention(**self._stated()))
        compare = partial(compare, align=self.align, axes_used=self.axes_used, times=times[0, :, 0])
        found = named(path, compare, steps=[f"step {k + 1}" for k in range(len(times[0]))])
        off = (poses - truths)[..., : suite.scenario.geometry.point_dim]
        rmse = json_numbers(np.sqrt(np.mean(np.sum(off**2, axis=-1), axis=0)))
        return found, found.asdict() | {"rmse": {"position": rmse}}

    def _of_filters(self, name: str, suite: SuiteScenario) -> dict[str, Json]:
        """The numbers of the filters here, by a study that is kept, and gone on with."""
        options = ConsistencyOptions(
            filters=self.filters, landmarks=("inverse_scaling",), out=self.out / name,
            runs=suite.runs, seed=suite.seed, resume=True,
        )  # fmt: skip
        return summarise(options.study(suite.scenario))["filters"]

    def _evaluation(self) -> Evaluation:
        if self.source is None:
            raise ValueError("no SOURCE given; expected a log, or --suite FOLDER")
        of_log = {name: getattr(self, name) for name in (*_OF_ONE_LOG, "align", "axes_used")}
        own = self.time_offset
        of_log["time_offset"] = own if own == "auto" else seconds("--time-offset", own)
        return evaluate_log(self.source, stated=self._stated(), **of_log)


def _comparison(title: str, filters: dict[str, Json]) -> list[str]:
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
