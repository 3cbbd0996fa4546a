"""The verdict on recorded logs of other people's filters, and smfeval's own numbers on two of them.

    python benchmarks/real_logs.py

reads $JAXSLAM_DATA/logs (../shared/data by default), and writes `real_logs.json`, with its table
in `docs/rivals.md`. Logs that are not there are left as they are in that file.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from benchmark import RESULTS, Benchmark, data_folder, number, table
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxslam.evaluation import Convention, Evaluation, evaluate_log, evaluate_poses
from jaxslam.evaluation.alignment import associated, similarity
from jaxslam.evaluation.convention import from_right, pose_errors
from jaxslam.evaluation.inputs import squared, whitened
from jaxslam.evaluation.pairing import read
from jaxslam.io.logs.log import interpolated
from jaxslam.statistics.bands import chi2_quantile

BEGIN = "<!-- real_logs.py -->"
TURNS = ("rx", "ry", "rz")


@dataclass(frozen=True)
class RealLog:
    """A log, with the options of `jaxslam evaluate` by which it is evaluated."""

    name: str
    folder: str
    estimate: str
    truth: str
    options: dict[str, Any] = field(default_factory=dict)
    leave_out: tuple[str, ...] = ()
    """Files of a folder of runs that are left out."""

    def evaluated(self, data: Path, **more: Any) -> Evaluation:
        """The verdict on it."""
        folder = data / self.folder
        with runs_of(folder, self.leave_out) as own:
            source = own / self.estimate if self.estimate else own
            return evaluate_log(source, truth=own / self.truth, **self.options, **more)


@contextmanager
def runs_of(folder: Path, leave_out: tuple[str, ...]) -> Generator[Path]:
    """The folder, or one of links to its files but for those that are left out."""
    if not leave_out:
        yield folder
        return
    with TemporaryDirectory() as temporary:
        for path in sorted(folder.iterdir()):
            if path.name not in leave_out:
                (Path(temporary) / path.name).symlink_to(path.resolve())
        yield Path(temporary)


TYPE1, TYPE2 = (f"type{i}_np-0.1_nR-0.1.csv" for i in (1, 2))
LOGS = (
    RealLog("OpenVINS on EuRoC MH_01", "openvins_mh01", "estimate.csv", "truth.csv"),
    RealLog(
        "OpenVINS on EuRoC MH_01, `--align yaw`", "openvins_mh01", "estimate.csv", "truth.csv",
        {"align": "yaw"},
    ),
    RealLog(
        "Point-LIO on Oxford Spires, `--align se3`", "smfeval_point_lio", "est.smfeval", "ref.tum",
        {"align": "se3"},
    ),
    RealLog(
        "Faster-LIO on Oxford Spires, `--align se3`", "smfeval_faster_lio", "est.smfeval",
        "ref.tum", {"align": "se3"},
    ),
    RealLog("RTKLIB on UrbanNav", "rtklib", "whampoa.pos", "truth_novatel.txt"),
    # Run 11 is run 10 without some rows, and one of its stamps goes back.
    RealLog("a filter of cnspy, 6 runs", "cnspy_mc", "", "truth.csv", leave_out=("run11.csv",)),
    RealLog(
        "the same, `--error split --axes mixed`", "cnspy_mc", "", "truth.csv",
        {"stated": {"error": "split", "axes": "mixed"}}, ("run11.csv",),
    ),
    RealLog(
        "cnspy, errors on the right, `--error right`", "relative_pose", TYPE1, "truth.csv",
        {"stated": {"error": "right"}},
    ),
    RealLog(
        "cnspy, errors on the left, `--error right`", "relative_pose", TYPE2, "truth.csv",
        {"stated": {"error": "right"}},
    ),
    RealLog(
        "cnspy, errors on the left, `--error left`", "relative_pose", TYPE2, "truth.csv",
        {"stated": {"error": "left"}},
    ),
)  # fmt: skip
OF_SMFEVAL = ("smfeval_point_lio", "smfeval_faster_lio")


@dataclass(frozen=True, kw_only=True)
class RealLogs(Benchmark):
    """The verdict on every log, and the numbers of smfeval's report, ours and theirs."""

    out: Any = RESULTS / "real_logs.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        results, data = self.found(), data_folder() / "logs"
        for log in LOGS:
            if (data / log.folder).is_dir():
                results.setdefault("logs", {})[log.name] = judged(log, data)
                yield results
        for name in OF_SMFEVAL:
            if (data / name).is_dir():
                both: dict[str, Any] = {
                    "ours": as_smfeval(data / name),
                    "theirs": report_of_smfeval(data / name),
                }
                both["between"] = as_smfeval(data / name, between=True)
                both["known_body"] = with_known_body(data / name)
                both["weighted"] = {
                    what: fitted_by_weight(data / name, arm=what == "arm")
                    for what in ("turn", "arm")
                }
                results.setdefault("smfeval", {})[name] = both
                yield results

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "rivals.md", BEGIN, as_table(results["logs"])


def judged(log: RealLog, data: Path) -> dict[str, Any]:
    """The numbers of a log: of all axes, of the position and of the rotation alone."""
    found = log.evaluated(data)
    parts = {"position": [x for x in found.names if x not in TURNS]}
    parts["rotation"] = [x for x in found.names if x in TURNS]
    return numbers_of(found) | {
        "parts": {
            part: numbers_of(log.evaluated(data, axes_used=axes))["nees"] if axes else None
            for part, axes in parts.items()
        }
    }


def numbers_of(found: Evaluation) -> dict[str, Any]:
    """What the evaluation says, in numbers and words."""
    verdict, nees = found.verdict, found.nees[found.logged]
    return {
        "runs": found.runs,
        "steps": found.steps,
        "dof": found.dof,
        "nees": float(np.mean(nees)),
        "median": float(np.median(nees)),
        "sigma_factor": math.sqrt(float(np.mean(nees)) / found.dof),
        "interval99": list(verdict["interval99"]),
        "effective": verdict.get("effective"),
        "coverage90": found.coverage["90"],
        "word": verdict["word"],
        "causes": [
            {
                "cause": x.what,
                "evidence": x.told,
                "numbers": [float(y) for y in re.findall(r"\d+\.?\d*(?:e[-+]\d+)?", x.told)],
            }
            for x in found.causes
        ],
    }


def moved_bodies(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The transform from the body of the truth to that of the estimate, and its adjoint's inverse.

    The first is T of `T_wl = T_wi T`; the second takes right errors of T_wi to those of T_wl.
    """
    told = json.loads((folder / "imu_to_lidar.json").read_text())
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.reshape(told["R"], (3, 3)), told["t"]
    # The adjoint of a pose takes its right errors to left ones.
    return T, from_right(Convention("left"), np.linalg.inv(T))


def right_errors(
    folder: Path, *, between: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Estimates in the body of the truth, aligned by their positions; truths; right errors; P.

    The truth is the nearest within 10 ms, or interpolated `between` its stamps, of the same poses.
    """
    estimate, truth = read(folder / "est.smfeval"), read(folder / "ref.tum")
    at, of = associated(estimate.times, truth.times)
    T, adjoint = moved_bodies(folder)
    poses, true = estimate.poses[at] @ T, truth.poses[of]
    if between:
        true = interpolated(truth.times, truth.poses, estimate.times[at])
    P = adjoint @ estimate.covariances[at] @ adjoint.T
    fit = similarity(poses[:, :3, 3], true[:, :3, 3], scaled=False)
    poses = fit.moved(poses)
    return poses, true, pose_errors(Convention("right"), poses, true), P


def as_smfeval(folder: Path, *, between: bool = False) -> dict[str, float]:
    """What smfeval 0.4.0 computes of positions: ANEES, median, coverage of the 90 % set.

    Truth is the nearest within 10 ms; the estimate, moved to the body of the truth, is aligned by
    its positions; the errors are the first three numbers of `log(T̂⁻¹ T)`, and covariances stay as
    they are in the alignment.
    """
    _, _, e, P = right_errors(folder, between=between)
    nees = squared(whitened(e[None, :, :3], P[None, :, :3, :3]))[0]
    return {
        "n": len(nees),
        "anees": float(np.mean(nees)),
        "median_nees": float(np.median(nees)),
        "k": float(np.median(nees) / chi2_quantile(0.5, 3)),
        "coverage": float(np.mean(nees <= chi2_quantile(0.9, 3))),
    }


def fitted_by_weight(folder: Path, *, arm: bool) -> list[float]:
    """NEES of position and of rotation, where a world and a body between both make that of all axes
    the least: a turn of the body, and an `arm` of it."""
    poses, true, _, P = right_errors(folder, between=True)
    poses, true = poses.copy(), true.copy()
    for x in (poses, true):
        x[:, :3, 3] -= poses[:, :3, 3].mean(axis=0)
    whitening = np.linalg.inv(np.linalg.cholesky(P))

    def errors(x: np.ndarray) -> np.ndarray:
        world, body = np.tile(np.eye(4), (2, 1, 1))
        world[:3, :3], world[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:6]
        body[:3, :3] = Rotation.from_rotvec(x[6:9]).as_matrix()
        body[:3, 3] = x[9:] if arm else 0.0
        return pose_errors(Convention("right"), world @ poses @ body, true)

    best = least_squares(
        lambda x: np.einsum("kij,kj->ki", whitening, errors(x)).ravel(), np.zeros(12 if arm else 9)
    )
    e = errors(best.x)
    parts = slice(0, 3), slice(3, 6)
    return [float(np.mean(squared(whitened(e[None, :, x], P[None, :, x, x])))) for x in parts]


def report_of_smfeval(folder: Path) -> dict[str, float]:
    """The same numbers of its own report."""
    told = json.loads((folder / "expected_report.json").read_text())
    return {name: told[name] for name in ("n", "median_nees", "k", "coverage")} | {
        "anees": told["anees"]["anees"]
    }


def with_known_body(folder: Path) -> dict[str, Any]:
    """The verdict with truths of the body of the estimate, by the transform that its authors give,
    interpolated to its stamps."""
    estimate, truth = read(folder / "est.smfeval"), read(folder / "ref.tum")
    T, _ = moved_bodies(folder)
    true = interpolated(truth.times, truth.poses, estimate.times) @ np.linalg.inv(T)
    found = evaluate_poses(
        estimate.poses[None], estimate.covariances[None], true[None], align="se3"
    )
    return numbers_of(found)


def as_table(logs: dict[str, Any]) -> str:
    """A row of every log."""
    header = (
        "log", "NEES: all; position; rotation", "σ should be ×", "worth steps", "in 90 % sets",
        "said",
    )  # fmt: skip
    rows = []
    for name, x in logs.items():
        parts = (None if x["parts"][y] is None else x["parts"][y] for y in ("position", "rotation"))
        nees = "; ".join(number(y, ".3g") for y in (x["nees"], *parts))
        of = f"{nees} (of {x['dof']})"
        said = x["causes"][0]["cause"] if x["causes"] else x["word"]
        worth = number(x["effective"], ".0f")
        factor = number(x["sigma_factor"], ".3g")
        rows.append((name, of, factor, worth, f"{x['coverage90']:.1%}", said))
    return table(header, rows)


if __name__ == "__main__":
    RealLogs.run()
