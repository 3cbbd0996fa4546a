"""Recorded trajectories as truths: found, smoothed, and sampled without their gaps."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam._numerics.arrays import AnyArray
from jaxslam._runtime.lookup import suggestion
from jaxslam.geometry import Pose
from jaxslam.io.tum import quaternions, read_tum

GAP = 0.15
"""Seconds without a pose that are not bridged; or one and a half of a recording's usual steps."""
CUTOFF = 6.0
"""Hz, of which half the amplitude is kept: faster is how motion capture trembles, at 100 to 300 Hz
by a millimetre, not how cameras move."""
LEAST = 5
"""Poses of a piece that a spline needs."""


class RecordedMotion(eqx.Module):
    """A recorded motion at the frames of a run, with everything that a run can start from."""

    poses: Float[AnyArray, "poses 7"]
    """T_WC as quaternion (w first) and position, evenly in time but for the gaps."""
    starts: Int[AnyArray, " starts"]
    """Poses from which on `steps` others follow without a gap."""
    steps: int = eqx.field(static=True)

    def piece(self, key: Array) -> Pose:
        """T_WC of frames 0 to `steps`, from a start drawn at random."""
        start = jnp.asarray(self.starts)[jax.random.randint(key, (), 0, self.starts.size)]
        return jaxlie.SE3(jnp.asarray(self.poses)[start + jnp.arange(self.steps + 1)])

    def run(self, key: Array) -> Pose:
        """`T_C0,Ck` of the same frames."""
        return from_first(self.piece(key))


def from_first(T_WC: Pose) -> Pose:
    """`T_C0,Ck` of poses T_WC."""
    origin = jax.tree.map(lambda x: x[0], T_WC).inverse()
    return jax.vmap(lambda T: (origin @ T).normalize())(T_WC)


def find(trajectory: str) -> Path:
    """The file of a recording: a file, or the name of one in `$JAXSLAM_DATA/trajectories`.

    Raises ValueError, which says what there is, or that the variable is not set.
    """
    data = os.environ.get("JAXSLAM_DATA")
    folder = Path(data) / "trajectories" if data else None
    for path in (Path(trajectory), *([folder / f"{trajectory}.txt"] if folder else [])):
        if path.is_file():
            return path
    known = sorted(path.stem for path in folder.glob("*.txt")) if folder else []
    there = f"in {folder}: {', '.join(known)}" if known else f"none is in {folder}"
    there = there if folder else "JAXSLAM_DATA, a folder of data, is not set"
    raise ValueError(
        f"no trajectory {trajectory!r}{suggestion(trajectory, known)}; a TUM file is accepted, "
        f"and the name of one in $JAXSLAM_DATA/trajectories ({there})"
    )


def sampled(path: Path, rate: float, steps: int) -> RecordedMotion:
    """The recording at `rate` Hz for runs of so many steps.

    Raises ValueError, naming the file, where it is no trajectory or has no such piece in it.
    """
    file = path.stat() if path.exists() else None
    version = (file.st_mtime_ns, file.st_size, file.st_ino) if file else ()
    return _sampled(path, rate, steps, version)


@lru_cache(maxsize=8)
def _sampled(path: Path, rate: float, steps: int, version: tuple[int, ...]) -> RecordedMotion:
    """The samples of one version of the file, which may be written anew."""
    del version
    pieces = [_evenly(*piece, rate) for piece in _without_gaps(*read_tum(path))]
    ends = np.cumsum([len(piece) for piece in pieces])
    pairs = zip(pieces, ends, strict=True)
    starts = [np.arange(end - len(piece), end - steps) for piece, end in pairs]
    starts = np.concatenate([np.zeros(0, int), *starts])
    if not starts.size:
        longest = max((len(piece) for piece in pieces), default=0) / rate
        raise ValueError(
            f"{path} has no {steps / rate:.3g} s without a gap: its longest piece has {longest:.3g}"
        )
    return RecordedMotion(np.concatenate(pieces), starts, steps)


def _without_gaps(times: Float[np.ndarray, " n"], T: Float[np.ndarray, "n 4 4"]):
    """The pieces between the gaps, each as times and (position, quaternion x, y, z, w)."""
    forward = np.concatenate([[True], times[1:] > np.maximum.accumulate(times)[:-1]])
    times, T = times[forward], T[forward]
    seconds = np.diff(times) if times.size > 1 else np.zeros(1)
    gaps = np.flatnonzero(seconds > max(GAP, 1.5 * float(np.median(seconds)))) + 1
    for part in np.split(np.arange(times.size), gaps):
        if part.size >= LEAST:
            # Neighbours have quaternions of one sign, of the two that say the same.
            turns = quaternions(T[part, :3, :3])
            turns[1:] *= np.cumprod(np.sign(np.sum(turns[1:] * turns[:-1], axis=1)))[:, None]
            yield times[part], np.hstack([T[part, :3, 3], turns])


def _evenly(
    times: Float[np.ndarray, " n"], rows: Float[np.ndarray, "n 7"], rate: float
) -> Float[np.ndarray, "m 7"]:
    """Quaternion (w first) and position of a piece, at `rate` Hz, by smoothing splines.

    The spline that minimises `Σ (y − f)² + λ ∫ f''²`, with poses h apart, keeps `1/(1 + λ h ω⁴)` of
    a wave of ω rad/s.
    """
    # Here, since importing it takes a quarter of the time of importing the package.
    from scipy.interpolate import make_smoothing_spline

    smoothness = 1 / (float(np.median(np.diff(times))) * (2 * np.pi * CUTOFF) ** 4)
    times = times - times[0]
    at = np.arange(int(times[-1] * rate + 1e-6) + 1) / rate
    x, y, z, *turn = (make_smoothing_spline(times, row, lam=smoothness)(at) for row in rows.T)
    qx, qy, qz, qw = np.asarray(turn) / np.linalg.norm(turn, axis=0)
    return np.column_stack([qw, qx, qy, qz, x, y, z])
