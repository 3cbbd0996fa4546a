"""How often mistakes of logging are recognised, and how often right logs are taken for mistaken.

`python benchmarks/mistakes.py` draws studies of a robot in the plane, of 8 to 60 runs of 20 to 60
steps that are correlated: right ones, ones whose σ is wrong by a factor from .1 to 10, ones with
up to half of the runs losing their heading, and ones with each of the mistakes of logging. Of those
with a mistake it counts the ones for which it is named, and named alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import RESULTS, Benchmark

from jaxslam.evaluation import evaluate

SIGMA = np.array([0.1, 0.1, 0.02])
UNITS = np.array([1, 1, 180 / np.pi])
KINDS = {
    "right": "",
    "sigma wrong": "",
    "angle not wrapped": "wrapped",
    "errors in degrees": "degrees",
    "covariances in degrees": "degrees",
    "steps before runs": "interchanged",
    "heading lost": "",
}
"""A word that names the mistake; none where there is none."""


def study(kind: str, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors and covariances of one study."""
    rng = np.random.default_rng([list(KINDS).index(kind), number])
    runs, steps = int(rng.integers(8, 61)), int(rng.integers(20, 61))
    correlation = rng.choice([0.9, 0.97, 0.99] if "steps" in kind else [0.0, 0.5, 0.9, 0.97, 0.99])
    errors, now = np.empty((runs, steps, 3)), rng.normal(size=(runs, 3))
    for step in range(steps):
        errors[:, step] = SIGMA * now
        new = rng.normal(size=now.shape)
        now = correlation * now + np.sqrt(1 - correlation**2) * new
    P = np.tile(np.diag(SIGMA**2), (runs, steps, 1, 1))
    if kind == "sigma wrong":
        errors *= 10 ** rng.uniform(-1, 1)
    if kind == "angle not wrapped":
        errors[rng.integers(runs), rng.integers(steps) :, 2] += rng.choice([-1, 1]) * 2 * np.pi
    if kind == "errors in degrees":
        errors *= UNITS
    if kind == "covariances in degrees":
        P = P * UNITS * UNITS[:, None]
    if kind == "steps before runs":
        errors, P = np.swapaxes(errors, 0, 1), np.swapaxes(P, 0, 1)
    if kind == "heading lost":
        for run in rng.choice(runs, rng.integers(1, runs // 2 + 1), replace=False):
            errors[run, rng.integers(steps) :, 2] *= 10 ** rng.uniform(1, 3)
    return errors, P


def named(kind: str, number: int, names: tuple[str, ...]) -> bool:
    """Whether what is said of a study is just what is wrong with it."""
    found = evaluate(*study(kind, number), names=names).mistakes
    if not KINDS[kind]:
        return bool(found)
    return len(found) == 1 and KINDS[kind] in found[0].what


@dataclass(frozen=True, kw_only=True)
class Mistakes(Benchmark):
    """Shares of the studies of which just what is wrong is said."""

    studies: int = 1000
    """Of every kind."""
    out: Path = RESULTS / "mistakes.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        result: dict[str, Any] = {"studies": self.studies}
        axes = {"named axes": ("x", "y", "heading"), "axes without names": ()}
        for words, names in axes.items():
            result[words] = {
                kind: sum(named(kind, i, names) for i in range(self.studies)) / self.studies
                for kind in KINDS
            }
            yield result


if __name__ == "__main__":
    Mistakes.run()
