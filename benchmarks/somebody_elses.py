"""navlie's Monte Carlo example through `jaxslam.evaluate_poses`: its numbers against ours.

    python benchmarks/somebody_elses.py generate runs.npz    # where navlie is installed
    python benchmarks/somebody_elses.py compare runs.npz     # where jaxslam is

The setting is that of navlie's `examples/ex_monte_carlo.py`: a body on SE(3) that is told its
velocity and measures ranges to four anchors from two tags, 10 s at 100 Hz, an EKF from a wrong
start. `generate` needs navlie alone and writes poses, covariances and navlie's own NEES; `compare`
prints and writes by how much ours differ, the verdict, and which convention the data tell.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import sys
from pathlib import Path

import numpy as np

RUNS = 50
ANCHORS = ((1, 0, 0), (-1, 0, 0), (0, 2, 0), (0, 2, 2))
TAGS = ((0.17, 0.17, 0), (-0.17, 0.17, 0))


def generate(path: Path, runs: int) -> None:
    """Run navlie's filter; write T_wc, P, truth and NEES of every tenth of a second."""
    if importlib.util.find_spec("navlie") is None:
        sys.exit("skipped: navlie is not installed (pip install navlie, in an environment apart)")
    navlie, lib = (importlib.import_module(name) for name in ("navlie", "navlie.lib"))
    start = np.diag([0.1**2] * 3 + [0.3**3, 0.3**2, 0.3**2])
    Q = np.diag([0.01**2] * 3 + [0.1] * 3)
    process = lib.BodyFrameVelocity(Q)
    ranges = [lib.RangePoseToAnchor(list(a), list(tag), 0.1**2) for a in ANCHORS for tag in TAGS]

    def velocity(t, x):
        return np.array([np.sin(0.1 * t), np.cos(0.1 * t), np.sin(0.1 * t), 1, 0, 0])

    data = navlie.DataGenerator(process, velocity, Q, 100, ranges, 10)
    true_start = lib.SE3State([0] * 6, stamp=0.0)

    def trial(number: int) -> list[tuple]:
        np.random.seed(number)  # noqa: NPY002, navlie draws from it
        truth, inputs, measured = data.generate(true_start, 0, 10, noise=True)
        guess = true_start.plus(navlie.randvec(start))
        ekf = navlie.ExtendedKalmanFilter(process)
        found = navlie.run_filter(ekf, guess, start, inputs, measured, True)
        results = navlie.GaussianResultList.from_estimates(found, truth)
        kept = range(0, len(results.stamp), 10)
        return [
            (results.state[i].value, results.state_true[i].value, results.covariance[i],
             results.nees[i], results.stamp[i])
            for i in kept
        ]  # fmt: skip

    columns = [[np.stack(c) for c in zip(*trial(i), strict=True)] for i in range(runs)]
    T, truth, P, nees, times = (np.stack(column) for column in zip(*columns, strict=True))
    np.savez(path, estimates=T, truths=truth, covariances=P, nees=nees, times=times[0])


def compare(path: Path, out: Path) -> dict:
    """Ours beside theirs."""
    import jaxslam
    from jaxslam._runtime.files import write_json

    with np.load(path) as file:
        data = dict(file)
    arrays = [data[name] for name in ("estimates", "covariances", "truths")]
    theirs = jaxslam.Convention("right", order="rotation-first")
    found = jaxslam.evaluate_poses(*arrays, theirs, times=data["times"])
    wrong = jaxslam.evaluate_poses(*arrays, jaxslam.Convention(), times=data["times"])
    result = {
        "runs": found.runs,
        "steps": found.steps,
        "mean_nees": {"navlie": float(data["nees"].mean()), "ours": float(found.nees.mean())},
        "largest_relative_difference": float(np.max(abs(found.nees / data["nees"] - 1))),
        "verdict": found.headline,
        "identified": str(found.identified and found.identified.convention),
        "stated_wrongly": str(wrong),
    }
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "navlie.json", result, ensure_ascii=False)
    return result


def main() -> None:
    """One of the two halves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("generate", "compare"))
    parser.add_argument("file", type=Path, help="npz file of poses, covariances and NEES")
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    options = parser.parse_args()
    if options.what == "generate":
        generate(options.file, options.runs)
    else:
        print(json.dumps(compare(options.file, options.out), indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
