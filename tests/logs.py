"""Logs of filters that tests make up: errors and poses, with the covariances that are theirs."""

from functools import cache

import jax
import numpy as np
import verdicts as benchmark
from cases import quick_jit
from scipy import stats
from scipy.spatial.transform import Rotation

from jaxslam.evaluation import Convention
from jaxslam.evaluation.convention import write_covariances
from jaxslam.geometry import SPATIAL
from jaxslam.io.tum import write_tum

FALSE_ALARM = 1e-4


def drawn(runs=60, steps=7, n=3, factor=1.0, seed=0):
    """Errors, `factor` times as large as the covariances say, correlated axes."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(runs, steps, n, n)) + 2 * np.eye(n)
    noise = factor * rng.normal(size=(runs, steps, n, 1))
    return (root @ noise)[..., 0], root @ np.swapaxes(root, -1, -2)


@cache
def exponential(geometry):
    """Of tangents (k, t) the matrices, compiled."""
    return quick_jit(jax.vmap(lambda x: geometry.group.exp(x).as_matrix()))


def some(geometry, shape, seed=0, spread=1.0):
    """Poses (…, d, d)."""
    rng = np.random.default_rng(seed)
    size = int(np.prod(shape))
    T = exponential(geometry)(spread * rng.normal(size=(size, geometry.tangent_dim)))
    return np.asarray(T).reshape(*shape, *T.shape[1:])


def covariance(t, seed=0, size=0.05):
    root = np.diag(size * 10 ** np.linspace(-1, 0, t)) @ (
        np.eye(t) + 0.3 * np.random.default_rng(seed).normal(size=(t, t))
    )
    return root @ root.T


def logged(convention, geometry=SPATIAL, runs=40, steps=6, seed=0, spread=1.0, factor=1.0):
    """Poses, covariances and truths whose errors in the convention are drawn from them."""
    T, t = some(geometry, (runs, steps), seed, spread), geometry.tangent_dim
    P = np.broadcast_to(covariance(t), (runs, steps, t, t))
    noise = np.random.default_rng(seed + 1).normal(size=(runs, steps, t))
    errors = factor * noise @ np.linalg.cholesky(covariance(t)).T
    return T, P, benchmark.displaced(T, errors, convention)


def consistent(nees, dof):
    """Whether a sum of independent NEES is χ², up to a false alarm in 10 000."""
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], nees.size * dof)
    return low < nees.sum() < high


def planar(runs=50, steps=12, factor=1.0, other=1e-6, vertical=2, seed=0):
    """A robot in a plane as people write it in six axes, and its NEES in three; errors split."""
    rng = np.random.default_rng(seed)
    flat = [axis for axis in range(3) if axis != vertical]
    used = [*flat, 3 + vertical]
    root = np.diag([0.05, 0.03, 0.01]) @ np.array([[1, 0, 0], [0.3, 1, 0], [0.4, -0.3, 1]])
    e = np.zeros((runs, steps, 6))
    e[..., used] = rng.normal(size=(runs, steps, 3)) @ root.T
    P = other * np.eye(6)
    P[np.ix_(used, used)] = factor**2 * root @ root.T
    angle = np.zeros((runs * steps, 3))
    angle[:, vertical] = np.tile(np.linspace(0, 3, steps), runs)
    T = np.tile(np.eye(4), (runs, steps, 1, 1))
    T[..., :3, :3] = Rotation.from_rotvec(angle).as_matrix().reshape(runs, steps, 3, 3)
    T[..., flat, 3] = 5 * np.stack([np.sin(angle[:steps, vertical]), np.linspace(0, 1, steps)], 1)
    truth = benchmark.displaced(T, e, Convention("split"))
    inverse = np.linalg.inv(P[np.ix_(used, used)])
    nees = np.einsum("rki,ij,rkj->rk", e[..., used], inverse, e[..., used])
    return T, np.broadcast_to(P, (runs, steps, 6, 6)), truth, nees


def write_runs(folder, T, P, truth, convention):
    """A sub-folder of files for every run."""
    times = np.arange(T.shape[1]) / 10
    for run in range(len(T)):
        own = folder / f"run{run:02}"
        own.mkdir(parents=True)
        write_tum(own / "estimate.txt", times, T[run])
        write_covariances(own / "covariance.txt", times, P[run], convention)
        write_tum(own / "truth.txt", times + 0.004, truth[run])


def one_run(folder, steps=40, offset=0.0, shown=None):
    """Files of one run of ten poses a second; the truth is later, and times are as they are shown
    in the files that are named."""
    T, P, truth = (x[0] for x in logged(Convention(), runs=1, steps=steps))
    folder.mkdir(parents=True, exist_ok=True)
    times = 1.4e9 + np.arange(steps) / 10
    write_tum(folder / "estimate.txt", times, T)
    write_covariances(folder / "covariance.txt", times, P, Convention())
    write_tum(folder / "truth.txt", times + offset, truth)
    for name, of in (shown or {}).items():
        rows = [line.split(maxsplit=1) for line in (folder / name).read_text().splitlines()[1:]]
        (folder / name).write_text("".join(f"{of(float(t))} {rest}\n" for t, rest in rows))
    return folder


TRACKED = Convention("split", "body", scale="given")
UNFIXED, FIXED, LOST = ("tracked", 0, 1.5), ("tracked", 1, 1.0), ("lost", 1, 4.0)
"""State, unit_fixed, and the length of the unit in which the pose is written."""


def tracked_run(folder, maps):
    """Files of a folder as the tracker writes them: of each map its frames. Poses and truths."""
    told = [(number, *frame) for number, frames in enumerate(maps) for frame in frames]
    T, P, truth = (x[0].copy() for x in logged(TRACKED, runs=1, steps=len(told), spread=0.5))
    T[0], truth[0], P[0] = np.eye(4), np.eye(4), 0  # known exactly
    truth[:, :3, 3] *= np.array([unit for *_, unit in told])[:, None]
    times = np.arange(len(told)) / 30
    write_tum(folder / "trajectory.txt", times, T)
    write_covariances(folder / "covariance.txt", times, P, TRACKED)
    write_tum(folder / "groundtruth.txt", times, truth)
    rows = [
        f"{i},{times[i]:.9f},{state},{number},9,1.5,18,0.1,,,{fixed}"
        for i, (number, state, fixed, _) in enumerate(told)
    ]
    header = "frame,time,state,map,matches,nis,nis_dof,sigma_position,log_scale,more,unit_fixed"
    (folder / "frames.csv").write_text("\n".join([header, *rows]) + "\n")
    return T[None], P[None], truth[None]
