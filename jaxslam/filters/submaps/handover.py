"""A filter that hands its map over: what leaves it is kept, and costs a frame nothing.

When the state is full, or the camera has left the scene in which its submap began, the joint
Gaussian of everything is frozen, and the filter goes on with what it sees: the camera becomes the
new base K, and landmarks that are out of view leave. Given what goes on, the *separator*, the
frozen rest is independent of all that is measured later (Piniés, Tardós, IEEE T-RO 24 (5), 2008:
conditionally independent submaps). Therefore the separator is whole: the velocity at K stays in
the state, unmoving, as long as the submap lasts, and so do landmarks that leave the view.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxslam._numerics.arrays import AnyArray
from jaxslam._numerics.conditional import cond
from jaxslam.filters.ekf import EkfSlam, check_one_gaussian, each_gaussian, ekf_inside, rebased
from jaxslam.filters.forms.state import State
from jaxslam.filters.protocol import (
    AbstractFilter,
    AbstractStaged,
    Belief,
    Corrected,
    EachMoments,
    Expected,
    OfLandmark,
)
from jaxslam.filters.wrappers.wrapper import AbstractWrapper
from jaxslam.models.coordinates import SUBMAP, keyframe_due
from jaxslam.models.motion import Control
from jaxslam.models.observations import Capacity, Features, Slots

PARALLAX = 0.5
"""A submap ends when the camera has moved by this share of its landmarks' harmonic mean distance …
"""
TURN = 0.5
"""… or turned by so many radians: most of what it began with is then out of view."""

SPARE = 24
"""Slots beyond those of the landmarks in view, unless a number is given."""


class Frozen(eqx.Module):
    """The joint Gaussian at the end of a submap; or a batch of them, the oldest first."""

    state: State
    """Landmarks are in the last camera of the submap, which is the next one's base K."""
    carried: Bool[AnyArray, " slots"]
    """The landmarks that the next submap begins with: with the motion's variables and all that is
    constant of the core they are the separator."""
    numbers: Int[AnyArray, " slots"]
    """Which landmark is in each slot, counted from 0 as they came; −1 where none is."""


class SubmapsState(eqx.Module):
    """The filter's state, and what it has handed over."""

    inner: Belief
    slots: Int[Array, " capacity"]
    """Where the base has each landmark that it still sees; its number of slots for none."""
    numbers: Int[Array, " slots"]
    """As `Frozen` has them."""
    created: Int[Array, ""]
    """Landmarks so far."""
    frozen: Frozen
    """The latest submaps, a batch: the k-th of all is in place k modulo their number."""
    count: Int[Array, ""]
    """Submaps so far that have ended."""


class Submaps(AbstractWrapper):
    """Submaps of `base`, a filter that is one Gaussian, or a sum of them, in `SUBMAP` coordinates
    (`with_submaps`). Raises ValueError for another, and for numbers out of range."""

    base: AbstractStaged
    spare: int = eqx.field(static=True)
    """Slots beyond those of the landmarks in view: of what is out of view until the submap ends."""
    history: int = eqx.field(static=True, default=1)
    """Submaps that the state keeps. A tracker takes each as it ends; a batch of runs keeps all."""

    def __check_init__(self) -> None:
        super().__check_init__()
        ekf = self.ekf
        check_one_gaussian(ekf, "a filter with submaps", corrected=True)
        if ekf.coordinates is not SUBMAP or ekf.landmark.anchored:
            raise ValueError(
                "submaps are of a filter in SUBMAP coordinates, whose landmarks have no anchor; "
                f"not in {ekf.coordinates.name} ones, of {ekf.landmark.name}"
            )
        if self.spare < 0 or self.history < 1:
            raise ValueError(
                f"submaps have 0 spare slots and a history of 1 at least, not {self.spare} and "
                f"{self.history}"
            )

    @property
    def ekf(self) -> EkfSlam:
        """The filter whose model the submaps are of."""
        return ekf_inside(self.base, "submaps are")

    def init(self, capacity: int | Capacity, first: Features | None = None) -> SubmapsState:
        room = Capacity.of(capacity)
        own = room.landmarks + self.spare
        inner = self.base.init(room._replace(landmarks=own), first)
        none = jnp.full(room.landmarks, own)
        empty = jnp.full(own, -1)
        _, one = self.base.gaussian(inner, None)
        frozen = Frozen(one, jnp.zeros(own, bool), empty)
        frozen = jax.tree.map(lambda x: jnp.zeros((self.history, *x.shape), x.dtype), frozen)
        zero = jnp.zeros((), int)
        state = SubmapsState(inner, none, empty, zero, frozen, zero)
        if first is None:
            return state
        return _placed(state, first, jnp.where(first.valid, first.slots, own))

    def base_state(self, state: SubmapsState) -> Belief:
        return state.inner

    def with_base_state(self, state: SubmapsState, inner: Belief) -> SubmapsState:
        return replace(state, inner=inner)

    def gaussian(
        self, state: SubmapsState, control: Control
    ) -> tuple[AbstractStaged, SubmapsState]:
        base, one = self.base.gaussian(state.inner, control)
        return replace(self, base=base), replace(state, inner=one)

    def predict_features(self, state: SubmapsState, control: Control, slots: Slots) -> Expected:
        own = state.slots[slots]
        seen = self.base.predict_features(state.inner, control, own)
        return seen._replace(possible=seen.possible & (own < state.numbers.size))

    def update(self, state: SubmapsState, control: Control, seen: Features) -> Corrected:
        return super().update(state, control, _of_base(state, seen))

    def close(self, state: SubmapsState, new: Features) -> SubmapsState:
        """End the submap where that is due, and insert new landmarks into slots that are free."""
        capacity = state.slots.size
        # A landmark in whose place another comes is seen no more.
        gone = jnp.zeros(capacity, bool).at[new.slots].set(new.valid)
        state = self.remove(state, gone)
        state = self._handed_over(state, self._due(state, new))
        free = jnp.argsort(state.numbers >= 0, stable=True)
        rank = jnp.cumsum(new.valid) - 1
        own = jnp.where(new.valid, free[rank], state.numbers.size)
        state = _placed(state, new, own)
        return replace(state, inner=self.base.close(state.inner, _of_base(state, new)))

    def remove(self, state: SubmapsState, gone: Bool[AnyArray, " capacity"]) -> SubmapsState:
        """Free slots. The base keeps their landmarks until the submap ends."""
        return replace(state, slots=jnp.where(gone, state.numbers.size, state.slots))

    def landmark_marginal(
        self, state: SubmapsState, function: OfLandmark, slots: Slots
    ) -> EachMoments:
        return self.base.landmark_marginal(state.inner, function, state.slots[slots])

    def in_map(self, state: SubmapsState) -> Bool[Array, " capacity"]:
        return state.slots < state.numbers.size

    def _due(self, state: SubmapsState, new: Features) -> Bool[Array, ""]:
        _, one = self.base.gaussian(state.inner, None)
        T_KC = one.core.pose.keyframe_from_camera
        left = keyframe_due(T_KC, self.ekf.model.inverse_distances(one), TURN, PARALLAX)
        full = jnp.sum(state.numbers < 0) < jnp.sum(new.valid)
        return full | (left & self.unit_fixed(state))

    def _handed_over(self, state: SubmapsState, due: Bool[Array, ""]) -> SubmapsState:
        """Freeze the submap, and begin the next one. Where a start is still being found out there
        is nothing that could be frozen: what is out of view is then forgotten."""
        carried = jnp.zeros(state.numbers.size, bool).at[state.slots].set(True, mode="drop")
        ended = due & self.unit_fixed(state)

        def frozen(_, inner):
            return Frozen(self.base.gaussian(inner, None)[1], carried, state.numbers)

        def begun(inner):
            inner = self.base.remove(inner, ~carried)
            return each_gaussian(inner, lambda one: rebased(self.ekf, one))

        # Apart from what is conditional: a batch would copy all that is kept in every frame.
        place = state.count % self.history
        before = jax.tree.map(lambda x: x[place], state.frozen)
        newest = cond(ended, frozen, before, state.inner)
        return replace(
            state,
            inner=cond(due, begun, state.inner),
            numbers=jnp.where(due & ~carried, -1, state.numbers),
            frozen=jax.tree.map(lambda all, one: all.at[place].set(one), state.frozen, newest),
            count=state.count + ended,
        )


def with_submaps(slam: AbstractFilter, spare: int = SPARE, history: int = 1) -> Submaps:
    """The filter with submaps: all that is around its `EkfSlam` stays. Raises ValueError."""
    return Submaps(in_submaps(slam), spare, history)


def in_submaps(slam: AbstractFilter) -> AbstractStaged:
    """The same filter in `SUBMAP` coordinates. Raises ValueError for one that is not in stages."""
    if isinstance(slam, EkfSlam):
        return replace(slam, coordinates=SUBMAP)
    if not isinstance(slam, AbstractWrapper):
        raise ValueError(f"{type(slam).__name__} has no submaps: it is not in stages")
    return replace(slam, base=in_submaps(slam.base))


def _of_base(state: SubmapsState, features: Features) -> Features:
    """The features with the slots that the base has for them."""
    own = state.slots[features.slots]
    there = own < state.numbers.size
    return replace(features, slots=jnp.where(there, own, 0), valid=features.valid & there)


def _placed(state: SubmapsState, new: Features, own: Slots) -> SubmapsState:
    """The state with new landmarks in these slots of the base."""
    number = state.created + jnp.cumsum(new.valid) - 1
    capacity = state.slots.size
    return replace(
        state,
        slots=state.slots.at[jnp.where(new.valid, new.slots, capacity)].set(own, mode="drop"),
        numbers=state.numbers.at[own].set(number, mode="drop"),
        created=state.created + jnp.sum(new.valid),
    )
