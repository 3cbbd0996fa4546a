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
from jaxslam.filters.run import Frames
from jaxslam.landmarks import check_landmark
from jaxslam.models.observations import Capacity, Features
from jaxslam.simulation import World, simulate

__all__ = ["LAWS", "FilterCase", "check_filter", "check_landmark"]

Told = dict[str, np.ndarray]
"""What a filter says after every frame, by name."""
_SLOTS, _STEPS = 3, 5
_BORN = np.array([[0, 0, 2], [-1, 4, -1]])
"""Frames in which each slot gets a landmark: its first, and the one that comes after."""
_GONE = 3
"""The frame before which the landmark of slot 1 is removed."""
_MISSED = (3, 0)
"""A frame in which the landmark of a slot is not seen."""
_STEP = 1e-5
"""By how much the numbers of a filter are changed, relative, for central differences."""


def check_filter(slam: AbstractFilter, world: World, *, seed: int = 0) -> None:
    """Check that a filter keeps the `LAWS`, on five steps and four landmarks of a world.

    Raises ValueError with the first law that does not hold, and by how much.
    """
    if not isinstance(slam, AbstractFilter):
        raise ValueError(f"a jaxslam.AbstractFilter is accepted, not {type(slam).__name__}")
    case = FilterCase(slam, world, seed)
    for name, law in LAWS.items():
        try:
            law(case)
        except AssertionError as error:
            told = " ".join(str(error).split())[:400]
            raise ValueError(f"{type(slam).__name__}: it is not so that {name}: {told}") from None


class FilterCase:
    """A filter, frames for it, and what it makes of them, computed when a law first asks."""

    def __init__(self, slam: AbstractFilter, world: World, seed: int = 0) -> None:
        self.slam = cast(slam, np.float64)
        with jax.enable_x64(True):
            given = Program(partial(_frames_of, world, seed), QUICK)()
        self.first, self.frames = self.given = jax.tree.map(np.asarray, given)

    @cached_property
    def lanes(self) -> dict[str, Told]:
        """What it says of the run, and of changed frames and numbers: one batch, one program."""
        lanes = {
            "run": (self.slam, *self.given),
            "invalid": (self.slam, *_of_features(_with_other_invalid, self.given)),
            "order": (self.slam, *_of_features(_in_another_order, self.given)),
            "slots": (self.slam, *_in_other_slots(self.given)),
            "blind": (self.slam, self.first, _blind(self.frames)),
            "more": (_changed(self.slam, _STEP), *self.given),
            "less": (_changed(self.slam, -_STEP), *self.given),
        }
        batch = jax.tree.map(lambda *x: np.stack(x) if is_number(x[0]) else x[0], *lanes.values())
        found = _computed(_batched, batch)
        return {name: jax.tree.map(lambda x, i=i: x[i], found) for i, name in enumerate(lanes)}

    @cached_property
    def alone(self) -> Told:
        """The run, not in a batch, and taken in stages where the filter has them."""
        return _computed(partial(_run, staged=True), self.slam, *self.given)

    @cached_property
    def single(self) -> Told:
        """The run in single precision."""
        return _computed(_run, *cast((self.slam, *self.given), np.float32), double=False)

    @cached_property
    def derivative(self) -> float:
        """The derivative of the `score` in the direction of `_changed`, by JAX."""

        def score(slam, by):
            return jnp.sum(_run(_changed(slam, by), *self.given)["score"])

        def along(slam):
            return jax.jvp(partial(score, slam), (jnp.zeros(()),), (jnp.ones(()),))[1]

        return float(_computed(along, self.slam))


def _computed(function: Callable, *given: PyTree, double: bool = True) -> Any:
    with jax.enable_x64(double):
        return jax.tree.map(np.asarray, Program(function, QUICK)(*given))


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
    slots, sensor, one = jnp.arange(_SLOTS), getattr(slam, "sensor", None), slam.step
    if staged and isinstance(slam, AbstractStaged):  # whatever its own `step` does
        one = partial(AbstractStaged.step, slam)

    def step(state: Belief, frame: Frames) -> tuple[Belief, dict[str, Array]]:
        if callable(remove := getattr(slam, "remove", None)):
            state = remove(state, frame.gone)
        state, innovation = one(state, *frame[:3])
        pose, P = camera_pose(slam, state)
        log_det = 0.0 if innovation.log_det is None else innovation.log_det
        here = slam.in_map(state)
        found = {
            "pose": pose.parameters(), "covariance": P, "nis": innovation.nis,
            "nis_dof": innovation.nis_dof, "status": innovation.status, "in_map": here,
            "error": slam.pose_error(state, pose)[0], "score": -(innovation.nis + log_det) / 2,
        }  # fmt: skip
        if sensor is not None:
            chart, own = landmarks_in_camera(slam, state, slots, sensor)
            found["landmarks"] = jnp.where(here[:, None], chart, 0.0)
            found["landmarks_covariance"] = jnp.where(here[:, None, None], own, 0.0)
        return state, found

    state = slam.init(Capacity(_SLOTS, _SLOTS, _SLOTS), first)
    return jax.lax.scan(step, state, frames)[1]


def _batched(lanes: PyTree) -> dict[str, Array]:
    arrays, rest = eqx.partition(lanes, is_number)
    return jax.vmap(lambda one: _run(*eqx.combine(one, rest)))(arrays)


def _of_features(change: Callable[[Features], Features], given: PyTree) -> PyTree:
    """First features and frames, with all features changed."""
    first, frames = given
    return change(first), frames._replace(seen=change(frames.seen), new=change(frames.new))


def _with_other_invalid(of: Features) -> Features:
    """What is not valid has no number and another's slot."""
    slots = np.where(of.valid, of.slots, (of.slots + 1) % _SLOTS)
    return replace(of, slots=slots, measured=np.where(of.valid[..., None], of.measured, np.nan))


def _in_another_order(of: Features) -> Features:
    slots, valid = (np.roll(x, 1, axis=-1) for x in (of.slots, of.valid))
    return Features(slots, np.roll(of.measured, 1, axis=-2), valid)


def _in_other_slots(given: PyTree) -> PyTree:
    """The landmark of each slot in the one before."""
    first, frames = _of_features(lambda of: replace(of, slots=(of.slots - 1) % _SLOTS), given)
    return first, frames._replace(gone=np.roll(frames.gone, -1, axis=-1))


def _blind(frames: Frames) -> Frames:
    """Nothing is seen again after frame 0."""
    return frames._replace(seen=replace(frames.seen, valid=np.zeros_like(frames.seen.valid)))


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


def _close(found: Told, wanted: Told, tolerance: float, slots: Any = slice(None)) -> None:
    """Every number within a tolerance of the largest of its kind, in every frame."""
    for key in wanted:
        a, b = (np.asarray(x[key], float) for x in (found, wanted))
        if key in ("in_map", "landmarks", "landmarks_covariance"):
            a = a[:, slots]
        off, most = np.abs(a - b).max(), tolerance * max(1e-6, np.abs(b).max())
        _hold(off <= most, f"{key} differs by {off:.3g}, where {most:.3g} is accepted")


def _hold(held: Any, told: str) -> None:
    """An `assert` that optimised Python keeps."""
    if not held:
        raise AssertionError(told)


def _finite(case: FilterCase) -> None:
    for told in (case.lanes["run"], case.lanes["blind"]):
        for key, value in told.items():
            _hold(np.isfinite(value).all(), f"{key} is {value.tolist()}")
        _hold(not told["status"].any(), f"an update has the status {told['status'].tolist()}")
        P = told["covariance"]
        rounding = 1e-12 * np.abs(P).max()
        np.testing.assert_allclose(P, P.swapaxes(1, 2), rtol=0, atol=rounding)
        least = np.linalg.eigvalsh(P).min()
        _hold(least >= -rounding, f"a variance is {least:.3g}")


def _counted(case: FilterCase) -> None:
    seen, found = case.frames.seen, case.lanes["run"]["nis_dof"]
    used = seen.valid.sum(axis=1) * seen.measured.shape[-1]
    _hold((found <= used).all(), f"{found.tolist()} numbers were used of {used.tolist()}")
    for key in ("nis", "nis_dof"):
        value = case.lanes["blind"][key]
        _hold(not value.any(), f"{key} of nothing is {value.tolist()}")


def _slots_are_used_again(case: FilterCase) -> None:
    found = case.lanes["run"]["in_map"]
    if hasattr(case.slam, "remove"):
        _hold(not found[case.frames.gone].any(), "a landmark that was removed is in the map")
    _hold(found[-1].all(), f"of the landmarks that came last {found[-1].tolist()} are in the map")


def _invalid(case: FilterCase) -> None:
    _close(case.lanes["invalid"], case.lanes["run"], 1e-10)


def _order(case: FilterCase) -> None:
    _close(case.lanes["order"], case.lanes["run"], 1e-6)


def _numbers_of_slots(case: FilterCase) -> None:
    _close(case.lanes["slots"], case.lanes["run"], 1e-6, (np.arange(_SLOTS) - 1) % _SLOTS)


def _batch(case: FilterCase) -> None:
    _close(case.lanes["run"], case.alone, 1e-6)


def _error(case: FilterCase) -> None:
    largest = np.abs(case.lanes["run"]["error"]).max()
    _hold(largest < 1e-9, f"the error of the estimate itself is {largest:.3g}")


def _single(case: FilterCase) -> None:
    wanted, found = case.lanes["run"], case.single
    sigma = np.sqrt(np.diagonal(wanted["covariance"], axis1=1, axis2=2))
    n = 2 if sigma.shape[1] == 3 else 3
    off = (np.abs(found["pose"] - wanted["pose"])[:, -n:] / sigma[:, :n]).max()
    dtype = found["covariance"].dtype
    _hold(dtype == np.float32, f"it computes in {dtype}")
    _hold(off < 0.1, f"a position is off by {off:.3g} of its σ")


def _pickles(case: FilterCase) -> None:
    again = pickle.loads(pickle.dumps(case.slam))
    _hold(jax.tree.structure(again) == jax.tree.structure(case.slam), f"{again} comes back")
    jax.tree.map(np.testing.assert_array_equal, again, case.slam)


def _differentiates(case: FilterCase) -> None:
    ends = [case.lanes[name]["score"].sum() for name in ("more", "less")]
    difference = (ends[0] - ends[1]) / (2 * _STEP)
    _hold(
        abs(case.derivative - difference) <= 1e-4 * max(1.0, abs(difference)),
        f"the derivative is {case.derivative:.6g}, by differences {difference:.6g}",
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
