"""How often the checker of conventions is right, on cases whose answer is known.

`python benchmarks/conventions.py` constructs 200 cases of 50 runs: poses, covariances of one
convention, strongly anisotropic or not, errors drawn from them (or from others, of another σ), and
a convention that is stated, mostly a wrong one. The answer is the convention of the errors, or that
it cannot be told: where covariances look the same along all axes, where poses do not turn, or where
σ is wrong under every convention.

Then the convention is stated rightly and σ is wrong, by the same factor throughout or by others of
position and rotation: no other convention should be suggested, nor the stated one be doubted.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from benchmark import RESULTS, Benchmark
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxslam._numerics.arrays import AnyArray
from jaxslam.evaluation.convention import Convention, alternatives, geometry_of, turning
from jaxslam.evaluation.poses import evaluate_poses
from jaxslam.geometry import PLANAR, SPATIAL, Geometry, exp

KINDS = ("anisotropic",) * 6 + ("isotropic", "still", "over-confident", "under-confident")
STEPS = 8
CORRELATION = 0.9
"""Of a run's errors from one step to the next."""


class Case(NamedTuple):
    """Poses, covariances and truths, what is stated, and what the checker should answer."""

    kind: str
    estimates: np.ndarray
    covariances: np.ndarray
    truths: np.ndarray
    stated: Convention
    answer: Convention | None


@dataclass(frozen=True, kw_only=True)
class Conventions(Benchmark):
    """Constructed cases, and how each is judged."""

    cases: int = 200
    """Constructed cases, six of ten with an answer."""
    runs: int = 50
    """Runs of each."""
    sets: int = 100
    """Cases with 50 runs of every wrong σ; with more runs so many fewer."""
    out: Path = RESULTS / "conventions.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        cases = [constructed(number, self.runs) for number in range(self.cases)]
        by_kind = {kind: Counter() for kind in dict.fromkeys(KINDS)}
        for case in cases:
            by_kind[case.kind][judged(case)] += 1
        right = sum(count["right"] for count in by_kind.values())
        result: dict[str, Any] = {
            "cases": self.cases,
            "runs": self.runs,
            "right": right / self.cases,
        }
        result["kinds"] = {kind: dict(count) for kind, count in by_kind.items()}
        result["wrong_sigma"] = []
        for position, rotation in (*((f, f) for f in FACTORS), *OPPOSITE):
            for runs in STUDIES:
                sets = max(self.sets * STUDIES[0] // runs, 1)
                result["wrong_sigma"].append(blamed(position, rotation, runs, sets))
                yield result

    def report(self, results: dict[str, Any]) -> None:
        *_, last = results["wrong_sigma"]
        print(json.dumps({**results, "wrong_sigma": last}), flush=True)


def constructed(number: int, runs: int) -> Case:
    """The case of a number; the same in any number of them."""
    rng = np.random.default_rng(number)
    kind, geometry = KINDS[number % len(KINDS)], (SPATIAL, SPATIAL, PLANAR)[number % 3]
    kinds = alternatives(Convention(("right", "split")[rng.integers(2)]), geometry)
    true, stated = (kinds[i] for i in rng.integers(len(kinds), size=2))
    T = _poses(rng, geometry, runs, 0.0 if kind == "still" else 1.0)
    P = _covariances(rng, geometry, T.shape[:2], isotropic=kind == "isotropic")
    sigma = {"over-confident": 1.3, "under-confident": 0.7}.get(kind, 1.0)
    noise = sigma * _series(rng, (*T.shape[:2], P.shape[-1]))
    errors = np.einsum("...ij,...j->...i", np.linalg.cholesky(P), noise)
    answer = true if kind == "anisotropic" else None
    return Case(kind, T, P, displaced(T, errors, true), stated, answer)


def displaced(T: np.ndarray, errors: np.ndarray, convention: Convention) -> np.ndarray:
    """Truths whose errors in a convention are these, poses (…, d, d)."""
    n = T.shape[-1] - 1
    own = np.linalg.solve(turning(convention, T), errors[..., None])[..., 0]
    with jax.enable_x64(True):
        E = np.asarray(_exp(geometry_of(T), own.reshape(-1, own.shape[-1]))).reshape(T.shape)
    if convention.error == "left":
        return E @ T
    if convention.error == "right":
        return T @ E
    truth = T.copy()
    truth[..., :n, :n] = T[..., :n, :n] @ E[..., :n, :n]
    truth[..., :n, n] += own[..., :n]
    return truth


@eqx.filter_jit
def _exp(geometry: Geometry, own: Float[AnyArray, "k t"]) -> Array:
    return jax.vmap(lambda delta: exp(geometry.group, delta).as_matrix())(own)


def _poses(rng: np.random.Generator, geometry: Geometry, runs: int, spread: float) -> np.ndarray:
    n, shape = geometry.point_dim, (runs, STEPS)
    T = np.broadcast_to(np.eye(n + 1), (*shape, n + 1, n + 1)).copy()
    turn = spread * rng.normal(size=(*shape, 3)) * (1 if n == 3 else (0, 0, 1))
    turned = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*shape, 3, 3)
    T[..., :n, :n] = turned[..., :n, :n]
    T[..., :n, n] = 5 * spread * rng.normal(size=(*shape, n))
    return T


def _covariances(
    rng: np.random.Generator, geometry: Geometry, shape: tuple[int, ...], *, isotropic: bool
) -> np.ndarray:
    """Of σ up to .3 and down to .003; correlated as well, but for those that are isotropic."""
    t = geometry.tangent_dim
    if isotropic:
        return np.broadcast_to(0.02**2 * np.eye(t), (*shape, t, t))
    sigma = 0.1 * 10 ** rng.uniform(-1.5, 0.0, size=t)
    root = sigma[:, None] * (np.eye(t) + 0.4 * rng.normal(size=(t, t)))
    root = root * 10 ** rng.uniform(-0.2, 0.2, size=(*shape, 1, 1))
    return root @ np.swapaxes(root, -1, -2)


def _series(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Standard normal numbers (runs, steps, n), correlated from step to step."""
    noise = rng.normal(size=shape)
    for step in range(1, shape[1]):
        new = np.sqrt(1 - CORRELATION**2) * noise[:, step]
        noise[:, step] = CORRELATION * noise[:, step - 1] + new
    return noise


FACTORS = (0.7, 0.8, 0.9, 0.95, 1.0, 1.03, 1.06, 1.08, 1.12, 1.2, 1.35, 1.5)
OPPOSITE = ((0.8, 1.25), (1.25, 0.8), (0.9, 1.1), (1.1, 0.9), (0.7, 1.5), (1.5, 0.7))
"""Errors of position and rotation in σ that is claimed."""
STUDIES = (50, 100, 300, 1500)
"""Runs."""


def with_factors(number: int, runs: int, position: float, rotation: float) -> Case:
    """A convention that is stated rightly, and errors that are so many times their σ."""
    rng = np.random.default_rng([number, runs])
    geometry = (SPATIAL, SPATIAL, PLANAR)[number % 3]
    kinds = alternatives(Convention(("right", "split")[rng.integers(2)]), geometry)
    true = kinds[rng.integers(len(kinds))]
    T = _poses(rng, geometry, runs, 1.0)
    P = _covariances(rng, geometry, T.shape[:2], isotropic=False)
    noise = _series(rng, (*T.shape[:2], P.shape[-1]))
    errors = np.einsum("...ij,...j->...i", np.linalg.cholesky(P), noise)
    turns = [name.startswith("r") for name in true.names(geometry)]
    errors *= np.where(turns, rotation, position)
    return Case("wrong σ", T, P, displaced(T, errors, true), true, true)


def blamed(position: float, rotation: float, runs: int, sets: int) -> dict[str, float]:
    """Shares of such cases in which another convention is suggested, or this doubted."""
    wrong, doubtful = 0, 0
    for number in range(sets):
        case = with_factors(number, runs, position, rotation)
        found = evaluate_poses(*case[1:4], case.stated).identified
        wrong += found is not None and found.suggested is not None
        doubtful += found is not None and found.doubtful
    return {
        "position": position, "rotation": rotation, "runs": runs, "sets": sets,
        "suggested": wrong / sets, "doubtful": doubtful / sets,
    }  # fmt: skip


def judged(case: Case) -> str:
    """`right`, `guessed` where nothing or another should have been said, or `silent`."""
    found = evaluate_poses(case.estimates, case.covariances, case.truths, case.stated).identified
    said = None if found is None else found.convention
    if _kind(said) == _kind(case.answer):
        return "right"
    return "silent" if said is None else "guessed"


def _kind(convention: Convention | None) -> Convention | None:
    """Split errors as right ones, which are the same to first order."""
    if convention is None or convention.error != "split":
        return convention
    return replace(convention, error="right")


if __name__ == "__main__":
    Conventions.run()
