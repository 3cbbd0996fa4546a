"""How often a drift of scale is found, and how often one is claimed where there is none.

`python benchmarks/scale_drift.py` constructs sets of runs of a camera that knows its first pose and
not its scale, and lets `jaxslam.evaluate_poses(…, align="sim3")` judge each set. Errors of a pose
are drawn with a σ of 5 cm and .5°, and along scale with σ_scale, in one of these ways:
`independent` of each other; `common`, one for a run; `walk`, a random walk whose σ grows to σ_scale
at the end; `drift`, of −D/2 at the beginning of a run to D/2 at its end, of which the covariance
says nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import RESULTS, Benchmark
from conventions import displaced
from scipy.spatial.transform import Rotation

from jaxslam.evaluation.convention import Convention
from jaxslam.evaluation.inputs import checked_poses
from jaxslam.evaluation.poses import as_stated

SPLIT = Convention("split", "world")
SIGMA = np.array([0.05] * 3 + [np.radians(0.5)] * 3)
RIGHT = ("independent", "common", "walk")
DRIFTS = (0.05, 0.1, 0.2, float(np.log(4)))


@dataclass(frozen=True, kw_only=True)
class ScaleDrift(Benchmark):
    """Sets of runs, and how each is judged."""

    sets: int = 400
    """Sets of runs of every right kind; of every drift a quarter."""
    runs: int = 50
    steps: int = 100
    scale_sigma: float = 0.01
    out: Path = RESULTS / "scale_drift.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        cases = [(kind, 0.0, self.sets) for kind in RIGHT]
        cases += [("drift", drift, max(self.sets // 4, 1)) for drift in DRIFTS]
        result = []
        for kind, drift, sets in cases:
            found = [judged(kind, drift, self, seed) for seed in range(sets)]
            words = Counter(word for word, _ in found)
            shares = {word: count / sets for word, count in words.items()}
            named = sum(drifts for _, drifts in found) / sets
            result.append(
                {"kind": kind, "drift": drift, "sets": sets, "words": shares, "named": named}
            )
            yield {"runs": self.runs, "cases": result}


def constructed(
    kind: str, drift: float, options: ScaleDrift, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimates, covariances and truths; the first pose of every run is known."""
    rng = np.random.default_rng(seed)
    shape = (options.runs, options.steps)
    truth, noise = _circle(*shape), rng.normal(size=(*shape, 6))
    steps = np.arange(options.steps) / (options.steps - 1)
    along = {
        "independent": lambda: (rng.normal(size=shape), 1.0),
        "common": lambda: (np.repeat(rng.normal(size=(shape[0], 1)), shape[1], axis=1), 1.0),
        "walk": lambda: (
            np.cumsum(rng.normal(size=shape), axis=1) / np.sqrt(shape[1]),
            np.arange(1, shape[1] + 1) / shape[1],
        ),
        "drift": lambda: (np.zeros(shape), 1.0),
    }
    scale, variance = along[kind]()
    log_scale = options.scale_sigma * scale + drift * (steps - 0.5)
    estimate = truth.copy()
    estimate[..., :3, 3] *= np.exp(log_scale)[..., None]
    g = np.zeros((*shape, 6))
    g[..., :3] = estimate[..., :3, 3]
    P = np.diag(SIGMA**2) + np.zeros((*shape, 1, 1))
    P = P + (options.scale_sigma**2 * np.broadcast_to(variance, shape))[..., None, None] * (
        g[..., :, None] * g[..., None, :]
    )
    estimate = displaced(estimate, SIGMA * noise, SPLIT)
    P[:, 0], estimate[:, 0] = 0, truth[:, 0]
    return estimate, P, truth


def _circle(runs: int, steps: int) -> np.ndarray:
    """T_wc of a camera that leaves the origin and goes round a circle of 8 m."""
    angle = np.linspace(0, 2 * np.pi, steps, endpoint=False)
    T = np.tile(np.eye(4), (steps, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * [0, 1.0, 0]).as_matrix()
    T[:, :3, 3] = 8 * np.stack([1 - np.cos(angle), 0.1 * np.sin(3 * angle), np.sin(angle)], axis=1)
    return np.tile(T, (runs, 1, 1, 1))


def judged(kind: str, drift: float, options: ScaleDrift, seed: int) -> tuple[str, bool]:
    """The word on a set, and whether the drift was named."""
    poses = checked_poses(*constructed(kind, drift, options, seed))
    found = as_stated(poses, SPLIT, "sim3")
    if found.scale is None:
        raise RuntimeError("a Sim(3) has a scale")
    return found.verdict["word"], found.scale.disproved


if __name__ == "__main__":
    ScaleDrift.run()
