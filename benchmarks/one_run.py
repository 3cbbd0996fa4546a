"""How often one run of a right filter is called over-confident, and how often a wrong one is.

    python benchmarks/one_run.py

draws whitened errors of runs, correlated in many ways, and writes `one_run.json`, with its table
in `docs/one-run.md`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy
from benchmark import RESULTS, Benchmark, table
from scipy.signal import lfilter

from jaxslam.statistics import run_verdict
from jaxslam.statistics.one_run import FEWEST, OneRun, one_run_of_nees

BEGIN = "<!-- how often one run is called over-confident -->"
AT_ONCE = 100
"""Runs that are drawn together."""
TIMES = (0, 1, 3, 10, 30, 100, 300)
"""Steps after which the correlation of errors has fallen to 1/e; white at 0."""
EFFECTIVE = 30
"""The number of independent steps of runs whose σ is wrong."""
WRONG = (1.3, 1.6, 2.0)

Draw = Callable[[np.random.Generator, int, int, int], np.ndarray]
"""Whitened errors (steps, runs, n) of a right filter, from a generator and that shape."""


def autoregressive(
    time: float, rng: np.random.Generator, steps: int, runs: int, n: int
) -> np.ndarray:
    """Errors whose correlation is exp(−k/time) after k steps: of a first-order filter."""
    noise = rng.normal(size=(steps, runs, n))
    if not time:
        return noise
    kept = math.exp(-1 / time)
    noise[1:] *= math.sqrt(1 - kept**2)
    return lfilter([1], [1, -kept], noise, axis=0)


def local_level(rng: np.random.Generator, steps: int, runs: int, n: int) -> np.ndarray:
    """Kalman filters of n random walks with σ of .05 a step, measured with a σ of 1."""
    P, noise = 1.0, 0.05**2
    error = rng.normal(size=(runs, n))
    whitened = np.empty((steps, runs, n))
    for step in range(steps):
        error += math.sqrt(noise) * rng.normal(size=error.shape)
        P += noise
        gain = P / (P + 1)
        error -= gain * (error + rng.normal(size=error.shape))
        P *= 1 - gain
        whitened[step] = error / math.sqrt(P)
    return whitened


def constant_velocity(rng: np.random.Generator, steps: int, runs: int, n: int) -> np.ndarray:
    """Kalman filters of position and velocity, n/2 of them, positions measured with a σ of 1.

    Where n is odd, the last axis is one of position alone.
    """
    axes = -(-n // 2)
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([1.0, 0.0])
    Q = 1e-4 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    P, root = np.eye(2), np.linalg.cholesky(Q)
    error = rng.normal(size=(runs, axes, 2))
    whitened = np.empty((steps, runs, n))
    for step in range(steps):
        error = error @ F.T + rng.normal(size=error.shape) @ root.T
        P = F @ P @ F.T + Q
        gain = P @ H / (H @ P @ H + 1)
        error = error - (error @ H + rng.normal(size=error.shape[:2]))[..., None] * gain
        P = P - np.outer(gain, H @ P)
        P = (P + P.T) / 2
        own = np.linalg.solve(np.linalg.cholesky(P), error[..., None])[..., 0]
        whitened[step] = own.reshape(runs, -1)[:, :n]
    return whitened


def dead_reckoning(rng: np.random.Generator, steps: int, runs: int, n: int) -> np.ndarray:
    """Errors that are a random walk, and covariances that grow with it."""
    walk = np.cumsum(rng.normal(size=(steps, runs, n)), axis=0)
    return walk / np.sqrt(np.arange(1, steps + 1))[:, None, None]


def partly_constant(
    share: float, rng: np.random.Generator, steps: int, runs: int, n: int
) -> np.ndarray:
    """A share of the variance stays the same all along a run, as that of a start does."""
    constant = rng.normal(size=(1, runs, n))
    others = autoregressive(3, rng, steps, runs, n)
    return math.sqrt(share) * constant + math.sqrt(1 - share) * others


def unlike_axes(rng: np.random.Generator, steps: int, runs: int, n: int) -> np.ndarray:
    """Axes that forget in 1, 10 and 100 steps."""
    axes = [autoregressive(10.0 ** (axis % 3), rng, steps, runs, 1) for axis in range(n)]
    return np.concatenate(axes, axis=-1)


def oscillating(rng: np.random.Generator, steps: int, runs: int, n: int) -> np.ndarray:
    """Errors that swing with a period of 40 steps, and forget in 60."""
    kept, turn = math.exp(-1 / 60), 2 * math.pi / 40
    noise = rng.normal(size=(steps + 600, runs, n))
    swing = lfilter([1], [1, -2 * kept * math.cos(turn), kept**2], noise, axis=0)[600:]
    impulse = lfilter([1], [1, -2 * kept * math.cos(turn), kept**2], np.eye(1, 5000)[0])
    return swing / math.sqrt(np.sum(impulse**2))


def heavy_tails(rng: np.random.Generator, steps: int, runs: int, n: int) -> np.ndarray:
    """Student's t with 5 degrees of freedom, of the right variance, at independent steps."""
    scale = np.sqrt(3 / rng.chisquare(5, (steps, runs, 1)))
    return scale * rng.normal(size=(steps, runs, n))


def with_gaps(rng: np.random.Generator, steps: int, runs: int, n: int) -> np.ndarray:
    """Errors that forget in 10 steps, a third of them missing: every tenth, and a quarter."""
    errors = autoregressive(10, rng, steps, runs, n)
    errors[::10] = np.nan
    errors[steps // 2 : 3 * steps // 4] = np.nan
    return errors


RIGHT: dict[str, Draw] = {
    **{f"AR(1), τ = {time}" if time else "white": partial(autoregressive, time) for time in TIMES},
    "Kalman filter, level": local_level,
    "Kalman filter, velocity": constant_velocity,
    "dead reckoning": dead_reckoning,
    "a tenth constant": partial(partly_constant, 0.1),
    "a third constant": partial(partly_constant, 1 / 3),
    "axes unlike": unlike_axes,
    "oscillating": oscillating,
    "heavy tails": heavy_tails,
    "gaps": with_gaps,
}


def independent(whitened: np.ndarray) -> OneRun:
    """Every step counts as independent, as in smfeval."""
    nees = np.nansum(whitened**2, axis=1)[~np.isnan(whitened[:, 0])]
    return _chi2(nees, whitened.shape[1], len(nees))


def by_nees(whitened: np.ndarray) -> OneRun:
    """The effective number of samples by the autocorrelation of NEES about its mean (Geyer)."""
    nees = np.nansum(whitened**2, axis=1)[~np.isnan(whitened[:, 0])]
    steps = len(nees)
    transformed = np.fft.rfft(nees - np.mean(nees), 2 * steps)
    correlation = np.fft.irfft(np.abs(transformed) ** 2)[: steps // 2]
    pairs = (correlation / correlation[0])[: steps // 4 * 2].reshape(-1, 2).sum(axis=1)
    pairs = np.minimum.accumulate(pairs[: np.argmax(np.append(pairs, 0) <= 0)])
    return _chi2(nees, whitened.shape[1], steps / max(2 * np.sum(pairs) - 1, 1.0))


def _chi2(nees: np.ndarray, n: int, samples: float) -> OneRun:
    mean = float(np.mean(nees))
    p = 2 * float(scipy.special.gammaincc(n * samples / 2, samples * mean / 2))
    return OneRun(p < 0.01, p, math.sqrt(mean / n), (math.nan, math.nan), samples)


def of_nees(whitened: np.ndarray) -> OneRun:
    """The test of the package where only NEES was logged."""
    return one_run_of_nees(np.sum(whitened**2, axis=1), whitened.shape[1])


TESTS: dict[str, Callable[[np.ndarray], OneRun]] = {
    "one_run_of_nees": of_nees,
    "by_nees": by_nees,
    "independent": independent,
}


@dataclass(frozen=True, kw_only=True)
class OneRunStudy(Benchmark):
    """How often one run is called over-confident, by each test, of filters right and wrong."""

    steps: tuple[int, ...] = (1000, 5000)
    """Steps of a run."""
    dof: tuple[int, ...] = (3, 6)
    """Axes of an error."""
    draws: int = 2000
    """Runs of each kind; of more than 1000 steps half as many."""
    seed: int = 0
    """Of the numbers that are drawn."""
    out: Any = RESULTS / "one_run.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        results: dict[str, Any] = {"seed": self.seed, "right": [], "wrong": []}
        for steps in self.steps:
            runs = self.draws if steps <= 1000 else self.draws // 2
            for n in self.dof:
                for number, (name, draw) in enumerate(RIGHT.items()):
                    rng = np.random.default_rng([self.seed, steps, n, number])
                    row = {"name": name, "steps": steps, "dof": n, "runs": runs}
                    results["right"].append(row | counted(draw, rng, steps, runs, n, 1.0))
                    print(results["right"][-1], flush=True)
                    yield results
            draw = partial(autoregressive, 1 / math.atanh(EFFECTIVE / steps))
            for number, factor in enumerate(WRONG):
                rng = np.random.default_rng([self.seed, steps, 3, len(RIGHT) + number])
                row = {"factor": factor, "steps": steps, "dof": 3, "runs": runs}
                results["wrong"].append(row | counted(draw, rng, steps, runs, 3, factor))
                print(results["wrong"][-1], flush=True)
                yield results

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "one-run.md", BEGIN, as_table(results)


def counted(
    draw: Draw, rng: np.random.Generator, steps: int, runs: int, n: int, factor: float
) -> dict[str, Any]:
    """The share of runs that each test and the verdict call over-confident; in which the verdict
    says another word than `cannot tell`; and in which NEES is too small for the effective number of
    samples, by as rare a chance. Their median."""
    found: dict[str, list[bool]] = {name: [] for name in (*TESTS, "verdict")}
    other, cautious, samples = [], [], []
    for start in range(0, runs, AT_ONCE):
        for whitened in np.moveaxis(draw(rng, steps, min(AT_ONCE, runs - start), n), 1, 0):
            whitened *= factor
            for name, test in TESTS.items():
                found[name].append(test(whitened).over_confident)
            nees = np.sum(whitened**2, axis=1)[None]
            told = run_verdict(nees, n, logged=~np.isnan(nees), whitened=whitened[None])
            found["verdict"].append(told.word == "over-confident")
            other.append(told.word not in ("over-confident", "cannot tell"))
            total = told.effective * float(np.nanmean(nees))
            rare = scipy.special.gammainc(n * told.effective / 2, total / 2) < 0.005
            cautious.append(rare and told.effective >= FEWEST)
            samples.append(told.effective)
    return {
        "samples": float(np.median(samples)),
        "over_confident": {name: float(np.mean(values)) for name, values in found.items()},
        "other_word": float(np.mean(other)),
        "cautious": float(np.mean(cautious)),
    }


def as_table(results: dict[str, Any]) -> str:
    """The largest share of the degrees of freedom; of runs of each number of steps."""
    header = (
        "errors", "independent steps", "whitened errors", "NEES alone", "correlation of NEES",
        "every step independent",
    )  # fmt: skip
    rows = [*results["right"]]
    rows += [row | {"name": f"σ too small by {row['factor']:g}"} for row in results["wrong"]]
    lines = []
    for name in dict.fromkeys(row["name"] for row in rows):
        own = [row for row in rows if row["name"] == name]
        cells = {
            steps: [row for row in own if row["steps"] == steps]
            for steps in sorted({row["steps"] for row in own})
        }
        samples = (f"{max(row['samples'] for row in each):.0f}" for each in cells.values())
        shares = (
            "; ".join(f"{largest(each, test):.1%}" for each in cells.values())
            for test in ("verdict", "one_run_of_nees", "by_nees", "independent")
        )
        lines.append((name, "; ".join(samples), *shares))
    return table(header, lines)


def largest(rows: list[dict[str, Any]], test: str) -> float:
    """The largest share of runs that a test calls over-confident."""
    return max(row["over_confident"][test] for row in rows)


if __name__ == "__main__":
    OneRunStudy.run()
