"""Laws: what every filter and every landmark owes its users, to be checked of one of your own.

A filter is run on a few frames in which landmarks come, are missed, leave, and give their slot to
another. The laws compare that run with others: of the same frames written in another way, of a
filter that was pickled, in single precision, taken in stages, differentiated.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxslam._numerics.arrays import cast, is_number
from jaxslam._runtime.programs import QUICK, Program
from jaxslam.filters.protocol import AbstractFilter, AbstractStaged, Belief
from jaxslam.filters.readouts import camera_pose, landmarks_in_camera
from jaxslam.filters.run import Frames, run
from jaxslam.landmarks import check_landmark
from jaxslam.models.observations import Capacity, Features, Innovation
from jaxslam.simulation import FromPrior, World, simulate

__all__ = ["LAWS", "FilterCase", "check_filter", "check_landmark"]

_SLOTS, _STEPS = 3, 5
_BORN = np.array([[0, 0, 2], [-1, 4, -1]])
"""Frames in which each slot gets a landmark: its first, and the one that comes after."""
_GONE = 3
"""The frame before which the landmark of slot 1 is removed."""
_MISSED = (3, 0)
"""A frame in which the landmark of a slot is not seen."""
_STEP = 1e-5
"""By how much the numbers of a filter are changed, relative, for central differences."""


def check_filter(slam: AbstractFilter, world: World | None = None, *, seed: int = 0) -> None:
    """Check that a filter keeps the `LAWS`, on a run of a world of its own motion and sensor.

    For a filter without a `motion` and a `sensor`, or a motion that does not say how to simulate
    it, give a `world`, of which five steps and four landmarks are used.
    Raises ValueError with the first law that does not hold, and by how much.
    """
    case = FilterCase(slam, world, seed)
    for name, law in LAWS.items():
        try:
            law(case)
        except AssertionError as error:
            told = " ".join(str(error).split())[:400]
            raise ValueError(f"{type(slam).__name__}: it is not so that {name}: {told}") from None


class FilterCase:
    """A filter, frames for it, and what it makes of them, computed when a law first asks."""

    def __init__(self, slam: AbstractFilter, world: World | None = None, seed: int = 0) -> None:
        if not isinstance(slam, AbstractFilter):
            raise ValueError(f"a jaxslam.AbstractFilter is accepted, not {type(slam).__name__}")
        if world is None and not (hasattr(slam, "motion") and hasattr(slam, "sensor")):
            raise ValueError(f"{type(slam).__name__} has no motion and sensor; give a world")
        with jax.enable_x64(True):
            if world is None:
                world = _world_of(slam)
            self.slam = cast(slam, "float64")
            self.first, self.frames = Program(partial(_frames_of, world, seed), QUICK)()

    @cached_property
    def lanes(self) -> dict[str, dict[str, np.ndarray]]:
        """What it says of the run, and of changed frames and numbers: one batch, one program."""
        given = self.first, self.frames
        lanes = {
            "run": (self.slam, *given),
            "invalid": (self.slam, *_of_features(_with_other_invalid, given)),
            "order": (self.slam, *_of_features(_in_another_order, given)),
            "slots": (self.slam, *_in_other_slots(given)),
            "blind": (self.slam, self.first, _blind(self.frames)),
            "more": (_changed(self.slam, _STEP), *given),
            "less": (_changed(self.slam, -_STEP), *given),
        }
        with jax.enable_x64(True):
            batch = jax.tree.map(
                lambda *x: jnp.stack(x) if is_number(x[0]) else x[0], *lanes.values()
            )
            found = jax.tree.map(np.asarray, Program(_batched, QUICK)(batch))
        return {name: jax.tree.map(lambda x, i=i: x[i], found) for i, name in enumerate(lanes)}

    @cached_property
    def alone(self) -> dict[str, np.ndarray]:
        """The run, not in a batch and taken in stages where the filter has them."""
        with jax.enable_x64(True):
            found = Program(partial(_run, staged=True), QUICK)(self.slam, self.first, self.frames)
        return jax.tree.map(np.asarray, found)

    @cached_property
    def single(self) -> dict[str, np.ndarray]:
        """The run in single precision."""
        given = jax.tree.map(np.asarray, (self.first, self.frames))
        with jax.enable_x64(False):
            found = Program(_run, QUICK)(cast(self.slam, "float32"), *cast(given, "float32"))
        return jax.tree.map(np.asarray, found)

    @cached_property
    def derivative(self) -> float:
        """The derivative of the `score` in the direction of `_changed`, by JAX."""

        def score(slam, by):
            found = _run(_changed(slam, by), self.first, self.frames)
            return jnp.sum(found["score"])

        def along(slam):
            return jax.jvp(partial(score, slam), (jnp.zeros(()),), (jnp.ones(()),))[1]

        with jax.enable_x64(True):
            return float(Program(along, QUICK)(self.slam))


def _world_of(slam: AbstractFilter) -> World:
    """A world of a filter's own motion and sensor, with what it is told of depth."""
    pieces: Any = slam
    sensor, depth = pieces.sensor, getattr(pieces, "depth", None)
    prior = {} if depth is None else {"depth": depth}
    middle = getattr(sensor, "camera", None)
    if middle is not None:
        placed = {"first": np.outer(np.asarray(middle.centre, float), [0.6, 1.4])}
    else:
        placed = {"first": [[2.0, 5.0]] + [[-0.5, 0.5]] * (sensor.size - 1)}
    return World(
        pieces.motion, sensor, FromPrior(landmarks=_SLOTS + 1, **placed), steps=_STEPS, **prior
    )


def _frames_of(world: World, seed: int) -> tuple[Features, Frames]:
    """The features of frame 0, and the frames after it."""
    if world.landmarks <= _SLOTS or world.steps < _STEPS:
        raise ValueError(
            f"a world of at least {_SLOTS + 1} landmarks and {_STEPS} steps is accepted"
        )
    drawn = simulate(world, jax.random.key(seed))
    frame, slots = np.arange(_STEPS + 1)[:, None], np.arange(_SLOTS)
    again = (_BORN[1] >= 0) & (frame >= _BORN[1])
    point = np.where(again, _SLOTS, slots)
    born = np.where(again, _BORN[1], _BORN[0])
    there = (frame >= born) & ~((frame >= _GONE) & ~again & (_BORN[1] >= 0))
    measured, visible = (x[frame, point] for x in (drawn.measured, drawn.visible))
    missed = (frame == _MISSED[0]) & (slots == _MISSED[1])
    numbers = jnp.broadcast_to(slots, point.shape)
    seen = Features(numbers, measured, jnp.asarray(there & (frame > born) & ~missed) & visible)
    new = Features(numbers, measured, jnp.asarray(there & (frame == born)))
    gone = jnp.asarray((frame == _GONE) & (_BORN[1] >= 0))
    first, seen, new, gone = (
        jax.tree.map(lambda x, at=at: x[at], part)
        for part, at in ((new, 0), (seen, np.s_[1:]), (new, np.s_[1:]), (gone, np.s_[1:]))
    )
    controls = jax.tree.map(lambda x: x[:_STEPS], drawn.controls)
    return first, Frames(controls, seen, new, gone)


def _run(
    slam: AbstractFilter, first: Features, frames: Frames, staged: bool = False
) -> dict[str, Array]:
    """What a filter says after every frame."""
    slots = jnp.arange(_SLOTS)

    def told(state: Belief, innovation: Innovation, frame: Frames) -> dict[str, Array]:
        pose, P = camera_pose(slam, state)
        log_det = 0.0 if innovation.log_det is None else innovation.log_det
        found = {
            "pose": pose.parameters(),
            "covariance": P,
            "nis": innovation.nis,
            "nis_dof": innovation.nis_dof,
            "status": innovation.status,
            "in_map": slam.in_map(state),
            "error": jnp.append(*slam.pose_error(state, pose)[:1], 0.0),
            "score": -(innovation.nis + log_det) / 2,
        }
        sensor = getattr(slam, "sensor", None)
        if sensor is not None:
            chart, own = landmarks_in_camera(slam, state, slots, sensor)
            here = slam.in_map(state)
            found["landmarks"] = jnp.where(here[:, None], chart, 0.0)
            found["landmarks_covariance"] = jnp.where(here[:, None, None], own, 0.0)
        return found

    capacity = Capacity(_SLOTS, _SLOTS, _SLOTS)
    stepped = _Staged(slam) if staged and isinstance(slam, AbstractStaged) else slam
    return run(stepped, frames, slam.init(capacity, first), told)[1]


def _batched(lanes: PyTree) -> dict[str, Array]:
    arrays, rest = eqx.partition(lanes, is_number)
    return jax.vmap(lambda one: _run(*eqx.combine(one, rest)))(arrays)


class _Staged(AbstractFilter):
    """A filter whose `step` is its stages, written out."""

    inside: AbstractStaged

    def init(self, capacity, first=None, known=None):
        return self.inside.init(capacity, first, known)

    def step(self, state, control, seen, new):
        state = self.inside.predict(state, control)
        state, innovation = self.inside.update(state, control, seen)
        return self.inside.close(self.inside.compose(state, control), new), innovation

    def remove(self, state, gone):
        return self.inside.remove(state, gone)

    def marginal(self, state, function):
        return self.inside.marginal(state, function)

    def landmark_marginal(self, state, function, slots):
        return self.inside.landmark_marginal(state, function, slots)


def _of_features(change: Callable[[Features], Features], given: PyTree) -> PyTree:
    """First features and frames, with all features changed."""
    first, frames = given
    return change(first), frames._replace(seen=change(frames.seen), new=change(frames.new))


def _with_other_invalid(features: Features) -> Features:
    """What is not valid has other numbers, none at all, and another's slot."""
    other = jnp.where(features.valid[..., None], features.measured, jnp.nan)
    slots = jnp.where(features.valid, features.slots, (features.slots + 1) % _SLOTS)
    return Features(slots, other, features.valid)


def _in_another_order(features: Features) -> Features:
    turned = jax.tree.map(lambda x: jnp.roll(x, 1, axis=-1), (features.slots, features.valid))
    return Features(turned[0], jnp.roll(features.measured, 1, axis=-2), turned[1])


def _in_other_slots(given: PyTree) -> PyTree:
    """The landmark of each slot in the one before."""
    first, frames = _of_features(lambda x: replace(x, slots=(x.slots - 1) % _SLOTS), given)
    return first, frames._replace(gone=jnp.roll(frames.gone, -1, axis=-1))


def _blind(frames: Frames) -> Frames:
    """Nothing is seen again after frame 0."""
    return frames._replace(seen=replace(frames.seen, valid=jnp.zeros_like(frames.seen.valid)))


def _changed(slam: AbstractFilter, by: Array | float) -> AbstractFilter:
    """A filter with every number of it larger or smaller by a share of its own, times `by`."""
    leaves, structure = jax.tree.flatten(slam)
    rng = np.random.default_rng(0)
    changed = [
        x * (1 + by * rng.uniform(-1, 1, np.shape(x)))
        if is_number(x) and jnp.issubdtype(x.dtype, jnp.floating)
        else x
        for x in leaves
    ]
    return jax.tree.unflatten(structure, changed)


def _close(found: dict, wanted: dict, tolerance: float, *keys: str, order=slice(None)) -> None:
    """Every number within a tolerance of the largest of its kind, in every frame."""
    for key in keys or wanted:
        if key in wanted:
            a, b = np.asarray(found[key], float), np.asarray(wanted[key], float)
            if key in ("in_map", "landmarks", "landmarks_covariance"):
                a = a[:, order]
            off = np.abs(a - b).max(initial=0.0)
            most = tolerance * max(1.0, np.abs(b).max(initial=0.0))
            assert off <= most, f"{key} differs by {off:.3g}, where {most:.3g} is accepted"


def _finite(case: FilterCase) -> None:
    for name in ("run", "blind"):
        for key, value in case.lanes[name].items():
            assert np.isfinite(value).all(), f"{key} is not finite in frames {_where(value)}"
        P = case.lanes[name]["covariance"]
        assert (case.lanes[name]["status"] == 0).all(), case.lanes[name]["status"]
        np.testing.assert_allclose(P, P.swapaxes(1, 2), rtol=0, atol=1e-12 * np.abs(P).max())
        least = np.linalg.eigvalsh(P).min()
        assert least >= -1e-12 * np.abs(P).max(), f"a variance of a pose is {least:.3g}"


def _where(value: np.ndarray) -> list[int]:
    finite = np.isfinite(value).reshape(len(value), -1).all(axis=1)
    return (np.flatnonzero(~finite) + 1).tolist()


def _counted(case: FilterCase) -> None:
    used = np.asarray(case.frames.seen.valid).sum(axis=1) * case.frames.seen.measured.shape[-1]
    found = case.lanes["run"]["nis_dof"]
    assert (found <= used).all(), f"{found.tolist()} numbers were used of {used.tolist()}"
    blind = case.lanes["blind"]
    for key in ("nis", "nis_dof"):
        assert not blind[key].any(), f"{key} of nothing is {blind[key].tolist()}"


def _slots_are_used_again(case: FilterCase) -> None:
    new = np.asarray(case.frames.new.valid) | np.asarray(case.frames.seen.valid)
    found = case.lanes["run"]["in_map"]
    gone = np.asarray(case.frames.gone) & ~np.asarray(case.frames.new.valid)
    assert not found[gone].any(), "a landmark that was removed is in the map"
    assert found[-1].tolist() == [True] * _SLOTS or not new[-1].all(), found.tolist()


def _invalid(case: FilterCase) -> None:
    _close(case.lanes["invalid"], case.lanes["run"], 1e-11)


def _order(case: FilterCase) -> None:
    _close(case.lanes["order"], case.lanes["run"], 1e-8)


def _numbers_of_slots(case: FilterCase) -> None:
    moved = (np.arange(_SLOTS) - 1) % _SLOTS
    _close(case.lanes["slots"], case.lanes["run"], 1e-8, order=moved)


def _batch(case: FilterCase) -> None:
    _close(case.lanes["run"], case.alone, 1e-8)


def _error(case: FilterCase) -> None:
    found = case.lanes["run"]["error"]
    assert np.abs(found).max() < 1e-9, f"the error of the estimate itself is {found.max():.3g}"


def _single(case: FilterCase) -> None:
    wanted, found = case.lanes["run"], case.single
    sigma = np.sqrt(np.diagonal(wanted["covariance"], axis1=1, axis2=2))
    t = sigma.shape[1]
    n = 2 if t == 3 else 3
    off = np.abs(found["pose"] - wanted["pose"])[:, -n:] / sigma[:, :n]
    assert found["covariance"].dtype == np.float32, found["covariance"].dtype
    assert off.max() < 0.1, f"a position is off by {off.max():.3g} of its σ"


def _pickles(case: FilterCase) -> None:
    again = pickle.loads(pickle.dumps(case.slam))
    here, there = jax.tree.structure(case.slam), jax.tree.structure(again)
    assert here == there, f"{there} is not {here}"
    for a, b in zip(jax.tree.leaves(case.slam), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)


def _differentiates(case: FilterCase) -> None:
    ends = [case.lanes[name]["score"].sum() for name in ("more", "less")]
    difference = (ends[0] - ends[1]) / (2 * _STEP)
    assert abs(case.derivative - difference) <= 1e-4 * max(1.0, abs(difference)), (
        f"the derivative is {case.derivative:.6g}, by differences {difference:.6g}"
    )


LAWS: dict[str, Callable[[FilterCase], None]] = {
    "all that it says is finite, and covariances are": _finite,
    "it counts what it used, and nothing seen is no innovation": _counted,
    "a landmark that is removed leaves its slot to another": _slots_are_used_again,
    "what is not valid changes nothing": _invalid,
    "the order of measurements changes nothing": _order,
    "the numbers of the slots change nothing": _numbers_of_slots,
    "the estimate has no error against itself": _error,
    "a batch is its runs, and a step its stages": _batch,
    "single precision is close": _single,
    "it pickles": _pickles,
    "its derivative by its own numbers is that of differences": _differentiates,
}
"""Each law in words, and its check: a function of a `FilterCase` that asserts it."""
