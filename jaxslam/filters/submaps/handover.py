"""A filter that hands its map over: what leaves it is kept, and costs a frame nothing.

When the state is full, or the camera has left the scene in which its submap began, the joint
Gaussian of everything is frozen. The filter goes on with what it sees: the camera becomes the
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
from jaxslam.filters.gaussian import each_gaussian, rebased
from jaxslam.filters.layer import AbstractLayer, AbstractSlam
from jaxslam.filters.linear.state import State
from jaxslam.filters.protocol import Belief
from jaxslam.models.frame import Submaps
from jaxslam.models.observations import Capacity, Features, Slots


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
    """Where the inner filter has each landmark that it still sees; its number of slots for none."""
    numbers: Int[Array, " slots"]
    """As `Frozen` has them."""
    created: Int[Array, ""]
    """Landmarks so far."""
    frozen: Frozen
    """The latest submaps, a batch: the k-th of all is in place k modulo their number."""
    count: Int[Array, ""]
    """Submaps so far that have ended."""


class Handover(AbstractLayer):
    """The layer of a filter whose frame is `Submaps`: slots, and what is frozen."""

    frame: Submaps

    def init(self, slam, capacity, first, known):
        room = Capacity.of(capacity)
        own = room.landmarks + (self.frame.spare or 0)
        inner = slam.inner.init(room._replace(landmarks=own), first, known)
        none = jnp.full(room.landmarks, own)
        empty = jnp.full(own, -1)
        _, one = slam.inner.gaussian(inner, None)
        frozen = Frozen(one, jnp.zeros(own, bool), empty)
        history = self.frame.history
        frozen = jax.tree.map(lambda x: jnp.zeros((history, *x.shape), x.dtype), frozen)
        zero = jnp.zeros((), int)
        state = SubmapsState(inner, none, empty, zero, frozen, zero)
        if known is not None:
            slots = jnp.asarray(known.slots)
            state = _placed(state, slots, jnp.ones_like(slots, bool), slots)
        if first is None:
            return state
        own = jnp.where(first.valid, first.slots, own)
        return _placed(state, first.slots, first.valid, own)

    def inside(self, state: SubmapsState) -> Belief:
        return state.inner

    def around(self, state: SubmapsState, inner: Belief) -> SubmapsState:
        return replace(state, inner=inner)

    def gaussian(self, slam, state, control):
        base, one = slam.inner.gaussian(state.inner, control)
        return replace(base, frame=self.frame), replace(state, inner=one)

    def predict_features(self, slam, state, control, slots):
        own = state.slots[slots]
        seen = slam.inner.predict_features(state.inner, control, own)
        return seen._replace(possible=seen.possible & (own < state.numbers.size))

    def update(self, slam, state, control, seen):
        return super().update(slam, state, control, _of_inner(state, seen))

    def close(self, slam, state, new):
        """End the submap where that is due, and insert new landmarks into slots that are free."""
        capacity = state.slots.size
        # A landmark in whose place another comes is seen no more.
        gone = jnp.zeros(capacity, bool).at[new.slots].set(new.valid)
        state = self.remove(slam, state, gone)
        state = self._handed_over(slam, state, self._due(slam, state, new))
        free = jnp.argsort(state.numbers >= 0, stable=True)
        rank = jnp.cumsum(new.valid) - 1
        own = jnp.where(new.valid, free[rank], state.numbers.size)
        state = _placed(state, new.slots, new.valid, own)
        return replace(state, inner=slam.inner.close(state.inner, _of_inner(state, new)))

    def remove(self, slam, state, gone):
        """Free slots. The inner filter keeps their landmarks until the submap ends."""
        return replace(state, slots=jnp.where(gone, state.numbers.size, state.slots))

    def landmark_marginal(self, slam, state, function, slots):
        return slam.inner.landmark_marginal(state.inner, function, state.slots[slots])

    def in_map(self, slam, state):
        return state.slots < state.numbers.size

    def _due(self, slam: AbstractSlam, state: SubmapsState, new: Features) -> Bool[Array, ""]:
        _, one = slam.inner.gaussian(state.inner, None)
        full = jnp.sum(state.numbers < 0) < jnp.sum(new.valid)
        return full | (slam.model.keyframe_left(one) & self.unit_fixed(slam, state))

    def _handed_over(
        self, slam: AbstractSlam, state: SubmapsState, due: Bool[Array, ""]
    ) -> SubmapsState:
        """Freeze the submap, and begin the next one. Where a start is still being found out there
        is nothing that could be frozen: what is out of view is then forgotten."""
        carried = jnp.zeros(state.numbers.size, bool).at[state.slots].set(True, mode="drop")
        ended = due & self.unit_fixed(slam, state)

        def frozen(_, inner):
            return Frozen(slam.inner.gaussian(inner, None)[1], carried, state.numbers)

        def begun(inner):
            return each_gaussian(slam.inner.remove(inner, ~carried), rebased)

        # Apart from what is conditional: a batch would copy all that is kept in every frame.
        place = state.count % self.frame.history
        before = jax.tree.map(lambda x: x[place], state.frozen)
        newest = cond(ended, frozen, before, state.inner)
        return replace(
            state,
            inner=cond(due, begun, state.inner),
            numbers=jnp.where(due & ~carried, -1, state.numbers),
            frozen=jax.tree.map(lambda all, one: all.at[place].set(one), state.frozen, newest),
            count=state.count + ended,
        )


def _of_inner(state: SubmapsState, features: Features) -> Features:
    """The features with the slots that the inner filter has for them."""
    own = state.slots[features.slots]
    there = own < state.numbers.size
    return replace(features, slots=jnp.where(there, own, 0), valid=features.valid & there)


def _placed(
    state: SubmapsState, slots: Int[AnyArray, " m"], valid: Bool[AnyArray, " m"], own: Slots
) -> SubmapsState:
    """The state with new landmarks of these slots in slots of the inner filter's own."""
    number = state.created + jnp.cumsum(valid) - 1
    capacity = state.slots.size
    return replace(
        state,
        slots=state.slots.at[jnp.where(valid, slots, capacity)].set(own, mode="drop"),
        numbers=state.numbers.at[own].set(number, mode="drop"),
        created=state.created + jnp.sum(valid),
    )
