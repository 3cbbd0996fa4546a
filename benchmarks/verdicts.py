"""How often what evaluation says is wrong, and how often it finds what is, on made-up logs.

    python benchmarks/verdicts.py verdicts
    python benchmarks/verdicts.py conventions
    python benchmarks/verdicts.py mistakes
    python benchmarks/verdicts.py scale-drift

Each writes a JSON file of its name; `verdicts` the table in `docs/consistency.md` as well.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from benchmark import RESULTS, Benchmark, run_one, table
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxslam._numerics.arrays import AnyArray
from jaxslam.evaluation import evaluate
from jaxslam.evaluation.comparison import compared
from jaxslam.evaluation.convention import Convention, alternatives, geometry_of, turning
from jaxslam.evaluation.inputs import checked_poses
from jaxslam.evaluation.poses import evaluate_poses
from jaxslam.geometry import PLANAR, SPATIAL, Geometry, exp
from jaxslam.statistics import PowerSums, Tally, not_disproved
from jaxslam.statistics.verdict import THIRDS


def correlated(noise: np.ndarray, correlation: float) -> np.ndarray:
    """Standard normal numbers (steps, …), made correlated from one step to the next in place."""
    for last, now in itertools.pairwise(noise):
        now *= math.sqrt(1 - correlation**2)
        now += correlation * last
    return noise


BEGIN = "<!-- how often a verdict is wrong -->"
STEPS = 12
SERIES = {"white": (STEPS, 0.0), "correlated": (STEPS, 0.98), "one step": (1, 0.0)}
"""Steps, and the correlation of errors from one to the next."""
WRONG = (1.1, 1.3, 2.0)
"""Factors that σ is too small by; too large by the same ones."""
SHARE, TIMES = 0.01, 20.0
"""Of heavy tails: so many runs have so many times the variance."""


@dataclass(frozen=True, kw_only=True)
class Verdicts(Benchmark):
    """How often a verdict is wrong, and how often it finds what is: NEES drawn as a filter's are.

    Studies of runs of 12 steps whose errors are independent (`white`), correlated by .98 from step
    to step, or of one step.
    """

    runs: tuple[int, ...] = (1, 2, 3, 5, 10, 30, 100, 200, 300, 1000)
    """Runs of a study."""
    dof: tuple[int, ...] = (1, 2, 3, 6)
    """Degrees of freedom of a NEES."""
    studies: int = 20000
    """Of a right filter; a fifth of them of one that is wrong, a tenth of those of 1000 runs."""
    out: Path = RESULTS / "verdicts.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        rng = np.random.default_rng(0)
        yield {of.__name__: of(self, rng) for of in (by_factor, ramps, heavy)}

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "consistency.md", BEGIN, as_table(results)


def series(
    rng: np.random.Generator, runs: int, dof: int, steps: int, correlation: float
) -> np.ndarray:
    """NEES of a right filter, (runs, steps): χ² at every step, its errors correlated so."""
    if not correlation:
        return rng.chisquare(dof, (runs, steps))
    error = correlated(rng.normal(size=(steps + 1, runs, dof)), correlation)
    return np.sum(error[:-1] ** 2, axis=2).T


def tallies(nees: np.ndarray, dof: int) -> Iterator[Tally]:
    """`Tally.of` each study of NEES (studies, runs, steps), but for its lost runs; all at once."""
    count, runs, steps = nees.shape
    third = len(THIRDS) * np.arange(steps) // steps
    parts = [nees.mean(axis=2), nees[..., -1]]
    if steps >= len(THIRDS):
        parts += [nees[..., third == i].mean(axis=2) for i in range(len(THIRDS))]
    powers = np.array([[np.sum(x**k, axis=1) for k in (1, 2, 3)] for x in parts])
    for study in range(count):
        average, end, *rest = (PowerSums(runs, *map(float, x)) for x in powers[..., study])
        first, second, last = rest or (PowerSums(),) * 3
        yield Tally(dof, runs, 0, 0, average, end, average, thirds=(first, second, last))


def words(
    rng: np.random.Generator,
    name: str,
    dof: int,
    runs: int,
    studies: int,
    scale: float | np.ndarray,
) -> dict[str, float]:
    """Shares of the words of so many studies, NEES so many times a right filter's at every step."""
    found: Counter[str] = Counter()
    at_once = max(1, 100000 // runs)
    for start in range(0, studies, at_once):
        count = min(at_once, studies - start)
        nees = scale * series(rng, count * runs, dof, *SERIES[name])
        for tally in tallies(nees.reshape(count, runs, -1), dof):
            found[tally.decisive().word] += 1
    return {word: number / studies for word, number in sorted(found.items())}


def wrong_share(found: dict[str, float]) -> float:
    """Studies that are called inconsistent."""
    return sum(share for word, share in found.items() if not not_disproved({"word": word}))


def by_factor(options: Verdicts, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Words where σ is right, and where all of it is wrong by a factor."""
    rows = []
    for dof in options.dof:
        for runs in options.runs:
            for name in SERIES:
                studies = options.studies // (10 if runs >= 1000 else 1)
                found = {}
                for factor in (1.0, *WRONG, *(1 / x for x in WRONG)):
                    count = studies if factor == 1 else max(studies // 5, 1)
                    found[f"{factor:.3g}"] = words(rng, name, dof, runs, count, factor**2)
                row = {"dof": dof, "runs": runs, "series": name, "studies": studies}
                rows.append(row | {"words": found})
                print(dof, runs, name, f"{wrong_share(found['1']):.4f}", flush=True)
    return rows


def ramps(options: Verdicts, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Opposite faults: NEES/dof from .7 at the beginning to 1.3 at the end, of 3 dof."""
    rows = []
    for runs in options.runs:
        for name in ("white", "correlated"):
            studies = max(options.studies // (50 if runs >= 1000 else 5), 1)
            told = words(rng, name, 3, runs, studies, np.linspace(0.7, 1.3, STEPS))
            rows.append({"runs": runs, "series": name, "words": told})
    return rows


def heavy(options: Verdicts, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Heavy tails: how often the interval of the mean holds the truth, of 3 dof.

    `covered`: it does; `covered_or_not_told`: it does, or the word is `cannot tell`.
    """
    truth, rows = 1 - SHARE + SHARE * TIMES, []
    for runs in options.runs:
        for name, (steps, correlation) in SERIES.items():
            studies, covered, told = max(options.studies // 10, 1), 0, 0
            for _ in range(studies):
                nees = series(rng, runs, 3, steps, correlation)
                nees[rng.random(runs) < SHARE] *= TIMES
                tally = Tally.of(nees, 3)
                low, high = tally.looks()[0].interval
                covered += low <= truth <= high
                told += low <= truth <= high or tally.decisive().word == "cannot tell"
            shares = {"covered": covered / studies, "covered_or_not_told": told / studies}
            rows.append({"runs": runs, "series": name, "studies": studies} | shares)
    return rows


def as_table(results: dict[str, Any]) -> str:
    """The worst of all degrees of freedom and series, by the number of runs."""
    header = (
        "runs", "consistent filter called inconsistent", "σ wrong by 1.3 called consistent",
        "σ wrong by 1.1 found", "by 1.3", "by 2", "opposite faults found",
        "heavy tails, truth in interval",
    )  # fmt: skip
    lines = []
    for runs in sorted({row["runs"] for row in results["by_factor"]}):
        cells = [row["words"] for row in results["by_factor"] if row["runs"] == runs]
        missed = [w[f].get("consistent", 0.0) for w in cells for f in ("1.3", "0.769")]
        found = [
            _range([wrong_share(w[f"{f:.3g}"]) for w in cells for f in (x, 1 / x)]) for x in WRONG
        ]
        ramp = [wrong_share(row["words"]) for row in results["ramps"] if row["runs"] == runs]
        held = [row["covered"] for row in results["heavy"] if row["runs"] == runs]
        right = f"{max(wrong_share(w['1']) for w in cells):.2%}"
        lines.append((runs, right, f"{max(missed):.2%}", *found, _range(ramp), _range(held)))
    return table(header, lines)


def _range(shares: list[float]) -> str:
    low, high = f"{min(shares):.0%}", f"{max(shares):.0%}"
    return low if low == high else f"{low.removesuffix('%')}–{high}"


CASES = ("anisotropic",) * 6 + ("isotropic", "still", "over-confident", "under-confident")
FEW_STEPS = 8
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
    """How often the checker of conventions is right, on cases whose answer is known.

    Cases of 50 runs are constructed: poses, covariances of one convention, strongly anisotropic or
    not, errors drawn from them (or from others, of another σ), and a convention that is stated,
    mostly a wrong one. The answer is the convention of the errors, or that it cannot be told: where
    covariances look the same along all axes, where poses do not turn, or where σ is wrong under
    every convention.

    Then the convention is stated rightly and σ is wrong, by the same factor throughout or by others
    of position and rotation: no other should be suggested, nor the stated one be doubted.
    """

    cases: int = 200
    """Constructed cases, six of ten with an answer."""
    runs: int = 50
    """Runs of each."""
    sets: int = 100
    """Cases with 50 runs of every wrong σ; with more runs so many fewer."""
    out: Path = RESULTS / "conventions.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        cases = [constructed(number, self.runs) for number in range(self.cases)]
        by_kind = {kind: Counter() for kind in dict.fromkeys(CASES)}
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


def constructed(number: int, runs: int) -> Case:
    """The case of a number; the same in any number of them."""
    rng = np.random.default_rng(number)
    kind, geometry = CASES[number % len(CASES)], (SPATIAL, SPATIAL, PLANAR)[number % 3]
    kinds = alternatives(Convention(("right", "split")[rng.integers(2)]), geometry)
    true, stated = (kinds[i] for i in rng.integers(len(kinds), size=2))
    T, P, errors = _drawn(rng, geometry, runs, kind)
    errors *= {"over-confident": 1.3, "under-confident": 0.7}.get(kind, 1.0)
    answer = true if kind == "anisotropic" else None
    return Case(kind, T, P, displaced(T, errors, true), stated, answer)


def displaced(T: np.ndarray, errors: np.ndarray, convention: Convention) -> np.ndarray:
    """Truths whose errors in a convention are these, poses (…, d, d)."""
    n = T.shape[-1] - 1
    own = np.linalg.solve(turning(convention, T), errors[..., None])[..., 0]
    flat, count = own.reshape(-1, own.shape[-1]), own[..., 0].size
    # Filled up to a power of two, so that few programs serve all sizes.
    filled = np.resize(flat, (1 << (count - 1).bit_length(), flat.shape[-1]))
    with jax.enable_x64(True):
        E = np.asarray(_exp(geometry_of(T), filled))[:count].reshape(T.shape)
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


def _drawn(
    rng: np.random.Generator, geometry: Geometry, runs: int, kind: str = ""
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses, covariances, and errors drawn from these."""
    T = _poses(rng, geometry, runs, 0.0 if kind == "still" else 1.0)
    P = _covariances(rng, geometry, T.shape[:2], isotropic=kind == "isotropic")
    noise = _series(rng, (*T.shape[:2], P.shape[-1]))
    return T, P, np.einsum("...ij,...j->...i", np.linalg.cholesky(P), noise)


def _poses(rng: np.random.Generator, geometry: Geometry, runs: int, spread: float) -> np.ndarray:
    n, shape = geometry.point_dim, (runs, FEW_STEPS)
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
    return np.swapaxes(correlated(np.swapaxes(rng.normal(size=shape), 0, 1), CORRELATION), 0, 1)


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
    T, P, errors = _drawn(rng, geometry, runs)
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


AXIS_SIGMA = np.array([0.1, 0.1, 0.02])
UNITS = np.array([1, 1, 180 / np.pi])
MISTAKES = {
    "right": "",
    "sigma wrong": "",
    "angle not wrapped": "wrapped",
    "errors in degrees": "degrees",
    "covariances in degrees": "degrees",
    "steps before runs": "swapped",
    "heading lost": "",
}
"""A word that names the mistake; none where there is none."""


def study(kind: str, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors and covariances of one study."""
    rng = np.random.default_rng([list(MISTAKES).index(kind), number])
    runs, steps = int(rng.integers(8, 61)), int(rng.integers(20, 61))
    correlation = rng.choice([0.9, 0.97, 0.99] if "steps" in kind else [0.0, 0.5, 0.9, 0.97, 0.99])
    noise = correlated(rng.normal(size=(steps + 1, runs, 3)), correlation)
    errors = AXIS_SIGMA * np.swapaxes(noise[:-1], 0, 1)
    P = np.tile(np.diag(AXIS_SIGMA**2), (runs, steps, 1, 1))
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
    if not MISTAKES[kind]:
        return bool(found)
    return len(found) == 1 and MISTAKES[kind] in found[0].what


@dataclass(frozen=True, kw_only=True)
class Mistakes(Benchmark):
    """How often mistakes of logging are named, and how often right logs are taken for mistaken.

    Studies of a robot in the plane, of 8 to 60 runs of 20 to 60 steps that are correlated: right
    ones, ones whose σ is wrong by a factor from .1 to 10, ones with up to half of the runs losing
    their heading, and ones with each of the mistakes, which is to be named, and named alone.
    """

    studies: int = 1000
    """Of every kind."""
    out: Path = RESULTS / "mistakes.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        result: dict[str, Any] = {"studies": self.studies}
        axes = {"named axes": ("x", "y", "heading"), "axes without names": ()}
        for words, names in axes.items():
            result[words] = {
                kind: sum(named(kind, i, names) for i in range(self.studies)) / self.studies
                for kind in MISTAKES
            }
            yield result


SPLIT = Convention("split", "world")
POSE_SIGMA = np.array([0.05] * 3 + [np.radians(0.5)] * 3)
RIGHT = ("independent", "common", "walk")
DRIFTS = (0.05, 0.1, 0.2, float(np.log(4)))


@dataclass(frozen=True, kw_only=True)
class ScaleDrift(Benchmark):
    """How often a drift of scale is found, and how often one is claimed where there is none.

    Sets of runs of a camera that knows its first pose and not its scale are judged by
    `jaxslam.evaluate_poses(…, align="sim3")`. Errors of a pose are drawn with a σ of 5 cm and .5°,
    and along scale with σ_scale, in one of these ways: `independent` of each other; `common`, one
    for a run; `walk`, a random walk whose σ grows to σ_scale at the end; `drift`, of −D/2 at the
    beginning of a run to D/2 at its end, of which the covariance says nothing.
    """

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
            found = [judged_drift(kind, drift, self, seed) for seed in range(sets)]
            words = Counter(word for word, _ in found)
            shares = {word: count / sets for word, count in words.items()}
            named = sum(drifts for _, drifts in found) / sets
            result.append(
                {"kind": kind, "drift": drift, "sets": sets, "words": shares, "named": named}
            )
            yield {"runs": self.runs, "cases": result}


def drifting(
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
    P = np.diag(POSE_SIGMA**2) + np.zeros((*shape, 1, 1))
    P = P + (options.scale_sigma**2 * np.broadcast_to(variance, shape))[..., None, None] * (
        g[..., :, None] * g[..., None, :]
    )
    estimate = displaced(estimate, POSE_SIGMA * noise, SPLIT)
    P[:, 0], estimate[:, 0] = 0, truth[:, 0]
    return estimate, P, truth


def _circle(runs: int, steps: int) -> np.ndarray:
    """T_wc of a camera that leaves the origin and goes round a circle of 8 m."""
    angle = np.linspace(0, 2 * np.pi, steps, endpoint=False)
    T = np.tile(np.eye(4), (steps, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * [0, 1.0, 0]).as_matrix()
    T[:, :3, 3] = 8 * np.stack([1 - np.cos(angle), 0.1 * np.sin(3 * angle), np.sin(angle)], axis=1)
    return np.tile(T, (runs, 1, 1, 1))


def judged_drift(kind: str, drift: float, options: ScaleDrift, seed: int) -> tuple[str, bool]:
    """The word on a set, and whether the drift was named."""
    poses = checked_poses(*drifting(kind, drift, options, seed), SPLIT)
    found = compared(poses._replace(align="sim3"))
    if found.scale is None:
        raise RuntimeError("a Sim(3) has a scale")
    return found.verdict["word"], found.scale.disproved


if __name__ == "__main__":
    run_one(Verdicts, Conventions, Mistakes, ScaleDrift)
