"""The submaps of a map as the tracker keeps them: what ends is frozen, and a loop corrects all.

A filter whose frame is `Submaps` hands over when the camera has left the scene in which its submap
began (`jaxslam.filters.submaps`). A landmark that is given up before the next hand-over is one that
the next submap says nothing of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.arrays import AnyArray
from jaxslam._runtime.programs import Program
from jaxslam.filters.gaussian import each_gaussian, rebased
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.model import COMPOSED, CameraInMap
from jaxslam.filters.protocol import AbstractStaged, Belief, LandmarkView
from jaxslam.filters.submaps.chain import Chain, Link, SubmapMean, base_poses, link
from jaxslam.filters.submaps.closing import Posterior, posterior
from jaxslam.filters.submaps.handover import Frozen
from jaxslam.geometry import difference, retract
from jaxslam.tracking.observations import Slots
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance, Transform
from jaxslam.tracking.settings import TrackerSettings

LEAST = 8
"""Submaps, and loops, for which a program is compiled: twice as many where there are more."""


@dataclass(frozen=True)
class Submap:
    """A submap that ended."""

    frozen: Frozen
    """Landmarks, and the covariance of all, in the filter's unit; their numbers are the map's."""
    points: Float[np.ndarray, "slots 3"]
    """The landmarks in its last camera."""
    covariances: Float[np.ndarray, "slots 3 3"]
    """The covariances of the landmarks, given where that camera is."""
    camera: PoseWithCovariance
    """Its last camera in the world, as it was reported."""
    number: int
    """Its number among those of all maps."""
    links: dict[tuple[object, ...], Link] = field(default_factory=dict, repr=False, compare=False)
    """What it is in a chain, by what that depends on: the latest."""

    def link(
        self, slam: AbstractSlam, after: Int[np.ndarray, " slots"] | None, *, first: bool
    ) -> Link:
        """Return what it is in a chain, in which these are the numbers of the submap `after` it."""
        key = (None if after is None else after.tobytes(), first)
        if key not in self.links:
            # A landmark goes on that is still there when the next submap ends.
            same = False if after is None else self.numbers == after
            frozen = replace(self.frozen, carried=np.asarray(self.frozen.carried) & same)
            self.links.clear()
            self.links[key] = _linked(slam, frozen, *map(np.asarray, (True, after is None, first)))
        return self.links[key]

    @property
    def numbers(self) -> Int[np.ndarray, " slots"]:
        """The numbers of the landmarks in the slots; −1 where none is."""
        return np.asarray(self.frozen.numbers)

    @property
    def told(self) -> PoseWithCovariance:
        """Its last camera from where the map begins, as the filter had it, with the covariance that
        it has from where the submap begins."""
        core = self.frozen.state.core
        T_BC, own = core.pose.camera_pose(), core.part("pose")
        P = self.frozen.state.covariance[own, own][6:, 6:]
        return PoseWithCovariance(np.asarray(T_BC.as_matrix()), np.asarray(P))


class LoopClosure(eqx.Module):
    """The camera at the end of a submap q, as it is found from landmarks of an earlier one, p.

    With h the pixels, T that of q in p by these and X the landmarks, `A = ∂h/∂T`, `B = ∂h/∂X`, a
    pixel's noise leaves of them `R (T_PQ ⊟ T) + Qᵀ B (X − X̄) ~ N(0, σ²)`, with `A = Q R`.
    """

    submaps: Int[AnyArray, "*L 2"]
    """p and q."""
    slots: Int[AnyArray, "*L m"]
    """The slots of the landmarks of p."""
    landmarks: Float[AnyArray, "*L m d"]
    """The landmarks as they were then, X̄."""
    T: Float[AnyArray, "*L 4 4"]
    by_pose: Float[AnyArray, "*L 6 6"]
    """R/σ."""
    by_landmarks: Float[AnyArray, "*L 6 m d"]
    """Qᵀ B/σ; zero of a place that stands for no landmark."""


class Compared(NamedTuple):
    """A loop compared with what is known without it."""

    nis: np.ndarray
    """The NIS by the filter's covariance, with six degrees of freedom and no `unit_variance`."""
    T_bc: Transform
    """The present camera from where the map begins, given the loop to first order."""
    covariance: Float[np.ndarray, "6 6"]
    """The covariance of that camera, in the filter's unit."""


class Solved(NamedTuple):
    """The cameras at the ends of submaps, and the present one behind them, given all loops."""

    T_bc: Float[np.ndarray, "n 4 4"]
    """The camera from where the map begins, in the filter's unit."""
    covariances: Float[np.ndarray, "n 6 6"]
    points: Float[np.ndarray, "n slots 3"]
    """Landmarks in these cameras."""


def handed_over(
    slam: AbstractStaged,
    state: Belief,
    numbers: np.ndarray,
    camera: PoseWithCovariance,
    *,
    number: int,
) -> tuple[Submap, Belief]:
    """The submap of this number that ends at this camera in the world, and the state of the next
    one; `numbers` are those of the landmarks in the slots, −1 for none."""
    (frozen, *landmarks), state = _handed_over(slam, state, numbers)
    points, covariances = jax.device_get(landmarks)
    return Submap(frozen, points, covariances, camera, number), state


def shapes(slam: AbstractStaged, state: Belief, capacity: int) -> PyTree:
    """The shapes of the arrays of a submap that ended: `frozen`, `points` and `covariances`."""
    return jax.eval_shape(_handed_over.function, slam, state, jnp.zeros(capacity, int))[0]


def in_submaps(slam: AbstractStaged) -> bool:
    """Whether a filter has submaps."""
    return slam.model is not None and slam.model.frame.begins_submaps


def left(slam: AbstractStaged, state: Belief) -> Bool[Array, ""]:
    """Whether the camera has left the scene in which its submap began; never without submaps."""
    if slam.model is None or not in_submaps(slam):
        return jnp.zeros((), bool)
    return slam.model.keyframe_left(slam.gaussian(state, None)[1])


def _one(slam: AbstractStaged) -> AbstractSlam:
    """The Gaussian of a filter that has submaps."""
    assert isinstance(slam, AbstractSlam)
    return slam.one


def loop_of(
    slam: AbstractStaged,
    submaps: Sequence[Submap],
    which: tuple[int, int],
    slots: Slots,
    T: Transform,
    sigma: float,
    most: int,
) -> LoopClosure:
    """The loop that at most `most` of k landmarks of submap p close, seen from a camera
    at T from p's last one: that is the last one of submap q. σ of a pixel."""
    p, q = which
    k = min(len(slots), most)
    padded = np.pad(slots[:k], (0, most - k))
    X, there = submaps[p].frozen.state.landmarks[padded], np.arange(most) < k
    calibration = submaps[q].frozen.state.core.calibration
    by = _slopes(_one(slam), X, there, calibration, T, np.asarray(sigma))
    return LoopClosure(np.array(which), padded, X, T, *by)


@dataclass(frozen=True)
class Graph:
    """The submaps of a map, and the loops that join them."""

    slam: AbstractStaged
    submaps: Sequence[Submap]
    present: Submap
    """The one that goes on, as it would be if it ended now."""
    loops: Sequence[LoopClosure]
    most: int
    """Landmarks of a loop."""

    def with_loop(self, new: LoopClosure) -> Compared:
        """A loop compared with all that is known, and what it says of the present camera."""
        known, more = self._known()
        new = replace(new, submaps=new.submaps + more)
        return Compared(*jax.device_get(_compared(known, new)))

    def solved(self) -> Solved:
        """All cameras."""
        known, more = self._known()
        return Solved(*(np.asarray(x)[more:] for x in _solved(known)))

    def _known(self) -> tuple[Posterior, int]:
        """The chain given its loops, and how many submaps are in front that are none."""
        chain, loops, more = self._padded()
        return _given(chain, loops), more

    def _padded(self) -> tuple[Chain, LoopClosure, int]:
        """The chain of all submaps, with some in front that are none; its loops, with some behind
        them that say nothing; and how many are in front. Sizes are few, since each has programs of
        its own."""
        slam, ended, last = _one(self.slam), self.submaps, self.present
        later = [one.numbers for one in (*ended, last)[1:]]
        links = [
            one.link(slam, after, first=i == 0)
            for i, (one, after) in enumerate(zip(ended, later, strict=True))
        ]
        links.append(last.link(slam, None, first=not ended))
        more = _size(len(ended)) - len(ended)
        none = _linked(slam, last.frozen, *map(np.asarray, (False, False, False)))
        loops = [replace(one, submaps=one.submaps + more) for one in self.loops]
        nothing = no_loop(self.most, last.frozen.state.landmarks.shape[1], more + len(ended))
        loops += [nothing] * (_size(len(loops)) - len(loops))
        return Chain(slam, _stacked([*[none] * more, *links])), _stacked(loops), more


def compile_graph(
    slam: AbstractStaged, state: Belief, settings: TrackerSettings, submaps: int = 1
) -> Callable[[], None]:
    """What compiles all that a graph of so many submaps needs."""
    one, flag = _one(slam), np.asarray(False)

    def several(tree: PyTree, count: int) -> PyTree:
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape), x.dtype), tree)

    def compile() -> None:
        (frozen, *_), _ = _handed_over.compile(slam, state, np.zeros(settings.capacity, int))
        link = _linked.compile(one, frozen, flag, flag, flag)
        chain = Chain(one, several(link, _size(submaps) + 1))
        nothing = no_loop(settings.wanted, frozen.state.landmarks.shape[1])
        known = _given.compile(chain, several(nothing, _size(0)))
        _solved.compile(known)
        _compared.compile(known, nothing)

    return compile


def _size(count: int) -> int:
    """As many as there are, or more: a power of two."""
    return max(LEAST, 1 << max(count - 1, 0).bit_length())


def _stacked(trees: Sequence[PyTree]) -> PyTree:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def no_loop(most: int, d: int, submap: int = 0) -> LoopClosure:
    """A loop that says nothing, of landmarks of d numbers each."""
    of_landmarks = np.zeros((most, d)), np.eye(4), np.zeros((6, 6)), np.zeros((6, most, d))
    return LoopClosure(np.full(2, submap), np.zeros(most, int), *of_landmarks)


def _row(tree: PyTree, k: int | Array) -> PyTree:
    return jax.tree.map(lambda x: x[k], tree)


@Program
def _handed_over(
    slam: AbstractStaged, state: Belief, numbers: Array
) -> tuple[tuple[Frozen, Array, Array], Belief]:
    _, one = slam.gaussian(state, None)

    def point(view: LandmarkView) -> Array:
        assert view.log_scale is None or view.log_scale.ndim == 1
        metres = 0.0 if view.log_scale is None else jnp.sum(view.log_scale)
        return jnp.exp(-metres) * view.point / view.omega

    there = one.active & (numbers >= 0)
    points = slam.landmark_marginal(state, point, jnp.arange(numbers.size))
    return (Frozen(one, there, numbers), *points), each_gaussian(state, rebased)


@Program
def _linked(slam: AbstractSlam, frozen: Frozen, there: Array, newest: Array, first: Array) -> Link:
    return link(slam, frozen, there, newest, first)


@Program
def _slopes(
    slam: AbstractSlam, X: Array, there: Array, calibration: Array, T: Array, sigma: Array
) -> tuple[Float[Array, "6 6"], Float[Array, "6 m d"]]:
    """R/σ and Qᵀ B/σ of a loop."""
    T_PQ = jaxlie.SE3.from_matrix(T)

    def pixels(delta: Array, X: Array) -> Array:
        view = CameraInMap(T_PQ @ jaxlie.SE3.exp(delta), calibration)
        seen = jax.vmap(lambda one: slam.model.observe(view, one, COMPOSED)[0])(X)
        return jnp.where(there[:, None], seen, 0.0).ravel() / sigma

    by_pose, by_landmarks = jax.jacfwd(pixels, (0, 1))(jnp.zeros(6), X)
    Q, R = jnp.linalg.qr(by_pose)
    return R, jnp.tensordot(Q, by_landmarks, (0, 0))


def _error(chain: Chain, loop: LoopClosure, states: SubmapMean) -> Float[Array, " 6"]:
    """What a loop says is noise, of variance 1."""
    poses = base_poses(chain, states)
    T_BP, T_BQ = (_row(poses, submap) for submap in loop.submaps)
    moved = difference(T_BP.inverse() @ T_BQ, jaxlie.SE3.from_matrix(loop.T))
    X = states.landmarks[loop.submaps[0], loop.slots]
    return loop.by_pose @ moved + jnp.tensordot(loop.by_landmarks, X - loop.landmarks, 2)


@Program
def _given(chain: Chain, loops: LoopClosure) -> Posterior:
    def errors(states: SubmapMean) -> Array:
        return jax.vmap(lambda loop: _error(chain, loop, states))(loops).ravel()

    return posterior(chain, errors, 1.0)


@Program
def _compared(known: Posterior, new: LoopClosure) -> tuple[Array, Array, Array]:
    def both(states: SubmapMean) -> PyTree:
        return _row(base_poses(known.chain, states), -1), _error(known.chain, new, states)

    (T_BC, error), P = known.marginal(both)
    P = P / known.unit_variance()
    S = P[6:, 6:] + jnp.eye(6)
    gain = jnp.linalg.solve(S, P[6:, :6]).T
    T_BC, left = retract(T_BC, -gain @ error), P[:6, :6] - gain @ P[6:, :6]
    nis = error @ jnp.linalg.solve(S, error)
    return nis, T_BC.as_matrix(), known.unit_variance(nis, 6) * left


@Program
def _solved(known: Posterior) -> tuple[Array, Array, Array]:
    poses, covariances = known.cameras()
    landmarks = jax.vmap(jax.vmap(known.chain.slam.landmark.homogeneous))
    X, omega = landmarks(known.states.landmarks)
    return poses.as_matrix(), covariances, X / omega[..., None]
