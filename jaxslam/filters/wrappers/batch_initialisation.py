"""A Gaussian sum that starts from rest: a growing window of all frames, until parallax is there.

The initial velocity is unknown. The posterior of the first frames then has several modes, and a
filter that linearises at its own estimate picks one of them by the first pixel's noise. Therefore
all frames since frame 0 are kept and linearised again with every new one
(`jaxslam.filters.window`), each mode for itself, and the members of the sum are the Gaussians of
the modes, weighed by their evidence. When the translation is known to a fraction of itself, the
sum goes on alone.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxslam._numerics.arrays import AnyArray, cast, precision
from jaxslam._numerics.conditional import cond, map_where
from jaxslam.filters.ekf import EkfSlam, ekf_inside
from jaxslam.filters.forms.state import State
from jaxslam.filters.protocol import Corrected
from jaxslam.filters.window import record as window
from jaxslam.filters.window.modes import Found, Mean, Modes, at_rest, searched, sought
from jaxslam.filters.window.problem import PathLayout
from jaxslam.filters.window.record import Record
from jaxslam.filters.window.subsample import thinned, tied
from jaxslam.filters.window.to_filter import gauge_state
from jaxslam.filters.wrappers.gaussian_sum import GaussianSum
from jaxslam.filters.wrappers.sum_state import SumState
from jaxslam.filters.wrappers.wrapper import AbstractWrapper
from jaxslam.models.motion import Control
from jaxslam.models.observations import Capacity, Features

SIZES = {"planar": (25, 61), "spatial": (31,)}
"""Frames of the windows that are compiled; the smallest that holds all is computed."""
DIRECTIONS = {"planar": 16, "spatial": 8}
"""The number of directions in which the search starts, besides the start from rest."""
SEARCHES = {"planar": (1, 2, 3, 4, 6, 8, 11, 15, 20, 26, 34), "spatial": (1, 2, 3)}
"""Frames after which minima are sought anew, from all starts …"""
IN_TURN = {"planar": 0, "spatial": 1}
"""… and from how many of them after every other frame, in turn: no frame waits for them all."""
SEARCHED = {"planar": 13, "spatial": 9}
"""Frames in which they are sought, spread over the window."""
RENEWED = {"planar": (2, 4), "spatial": (1,)}
"""In which frames the sum begins anew, by window: every so manieth."""
DIVIDED = {"planar": True, "spatial": False}
"""Whether the sum is divided anew in every frame, or its members are the modes and what becomes of
them: halves of a Gaussian, each linearised off its middle, can be worse than the whole."""
GIVEN_UP = 10.0
"""Of log evidence: modes so much less likely than the likeliest end with the window. What has been
weighed without a linearisation is not to be overturned by one."""
LEAST_STEPS = 8
"""Since frame 0 before the sum may go on alone."""
KNOWN = 0.03
"""σ of the translation, in translations, given the scale: below it parallax is there."""
MOVED = 0.1
"""The same, below which a camera has done more than turn."""
DOUBTFUL = 4.0
"""σ of a landmark that is given up, one a frame: what is seen there is no point of the world."""


class RestState(eqx.Module):
    """The sum, and what it is initialised anew from as long as the window is open."""

    sum: SumState
    record: Record
    modes: Modes
    open: Bool[Array, ""]


class BatchInitialisation(AbstractWrapper):
    """The start of `base`."""

    base: GaussianSum  # ty: ignore[incompatible-mutable-override]
    sizes: tuple[int, ...] = eqx.field(static=True)
    directions: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if not (isinstance(self.base, GaussianSum) and self.base.split):
            raise ValueError(
                "a start from rest is of a Gaussian sum that is split (mixture), "
                f"not of a {type(self.base).__name__} that is not"
            )
        _check_base(self.ekf)
        if min(self.sizes, default=0) < 3 or list(self.sizes) != sorted(set(self.sizes)):
            raise ValueError(
                "a start from rest keeps windows of 3 frames and more (frame 0 and at least 2 "
                f"after it), each larger than the one before, not {self.sizes}"
            )
        if self.directions < 1:
            raise ValueError(f"a search sets out in 1 direction at least, not {self.directions}")

    @property
    def ekf(self) -> EkfSlam:
        """Each member of the sum."""
        return ekf_inside(self.base, "a start from rest is")

    @property
    def ambiguous_start(self) -> bool:
        """It does: the window looks for what explains a start."""
        return True

    def init(self, capacity: int | Capacity, first: Features | None = None) -> RestState:
        ekf, count = self.ekf, self.base.members
        dtype, (landmarks, *_) = precision(ekf), Capacity.of(capacity)
        begun = window.empty(ekf.motion, self.sizes[-1], landmarks, ekf.sensor.size, dtype)
        if first is not None:
            begun = window.begun(begun, first)
        member = ekf.init(capacity, first)
        members = jax.tree.map(lambda x: jnp.tile(x, (count, *(1,) * x.ndim)), member)
        modes = at_rest(cast(ekf, dtype), begun, count, dtype)
        return RestState(SumState(members, modes.log_weights), begun, modes, jnp.ones((), bool))

    def base_state(self, state: RestState) -> SumState:
        return state.sum

    def with_base_state(self, state: RestState, inner: SumState) -> RestState:
        return replace(state, sum=inner)

    def update(self, state: RestState, control: Control, seen: Features) -> Corrected:
        divided = DIVIDED[self.ekf.motion.geometry.name]
        update = self.base.update if divided else self.base.update_members
        after, innovation = update(state.sum, control, seen)
        stepped = window.stepped(state.record, control, seen, self.ekf.sensor.noise)
        return replace(state, sum=after, record=stepped), innovation

    def close(self, state: RestState, new: Features) -> RestState:
        """End the frame, and begin the sum anew from the window's modes while that is open."""
        after = self.base.close(state.sum, new)
        state = replace(state, sum=after, record=window.begun(state.record, new))
        # Where nothing was ever seen there is nothing to begin anew from.
        anew = state.open & jnp.any(state.record.seen) & (state.record.last > 0)
        due = self._due(state.record, self._moved(state, MOVED)) & anew
        frames = SEARCHED[self.ekf.motion.geometry.name]
        found = searched(self.ekf, state.record, state.modes, due, frames)
        periods, least, now = RENEWED[self.ekf.motion.geometry.name], 1, jnp.zeros((), bool)
        for index, frames in enumerate(self.sizes):
            last = state.record.last
            wanted = anew & (last >= least) & (last < frames)
            period = periods[min(index, len(periods) - 1)]
            wanted &= (last % period == 0) | jnp.any(due) | state.record.full
            state = self._anew(state, found, frames, wanted)
            least, now = frames, now | wanted
        ready = now & self._ready(state)
        state = replace(state, sum=_likely(state.sum, ready), open=state.open & ~ready)
        return cond(state.open & state.record.full, self._thinned, state)

    def remove(self, state: RestState, gone: Bool[AnyArray, " capacity"]) -> RestState:
        modes = state.modes
        y = jnp.where(gone[:, None], 0.0, modes.minima.y)
        return RestState(
            self.base.remove(state.sum, gone),
            window.removed(state.record, gone),
            replace(modes, minima=replace(modes.minima, y=y)),
            state.open,
        )

    def unit_fixed(self, state: RestState) -> Bool[Array, ""]:
        return ~state.open

    def _anew(
        self, state: RestState, found: Found, frames: int, wanted: Bool[Array, ""]
    ) -> RestState:
        """The modes of a window of so many frames, those that were `found` among them, and the sum
        of them, without the landmark that contradicts all of them most."""
        ekf, record = self.ekf, state.record.cut(frames)
        size = PathLayout.of(ekf).size(frames)

        def cut(minima):
            return replace(minima, x=minima.x[:, :size])

        def solved(state, record, found):
            x = state.modes.minima.x
            modes = replace(state.modes, minima=cut(state.modes.minima))
            found = found._replace(minima=cut(found.minima))
            modes, means, explained = sought(ekf, record, modes, found)
            like = state.sum.likeliest
            members = _members(ekf, record, modes, means, state.sum.members, like)
            begun = SumState(members, modes.log_weights)
            begun = jax.tree.map(lambda new, old: jnp.where(explained, new, old), begun, state.sum)
            wrong = explained & _doubted(modes)
            x = x.at[:, :size].set(modes.minima.x)
            modes = replace(modes, minima=replace(modes.minima, x=x))
            return self.remove(replace(state, sum=begun, modes=modes), wrong)

        return cond(wanted, solved, state, record, found)

    def _due(self, record: Record, moved: Bool[Array, ""]) -> Bool[Array, " starts"]:
        """The starts from which minima are sought after this frame. Of a camera that has `moved`
        the reversal is always one of those in turn: the window is about to end, and nothing is as
        like the truth."""
        name = self.ekf.motion.geometry.name
        count, together = 2 + self.directions, IN_TURN[name]
        steps = record.steps.astype(int) - 4
        turn = (jnp.arange(count) - 1 - together * steps) % count < together
        turn |= (jnp.arange(count) == 1) & moved & bool(together)
        whole = jnp.any(record.last == jnp.array(SEARCHES[name]))
        return (whole | turn) & ~record.standing

    def _thinned(self, state: RestState) -> RestState:
        record, minima = thinned(self.ekf, state.record, state.modes.minima)
        return replace(state, record=record, modes=replace(state.modes, minima=minima))

    def _ready(self, state: RestState) -> Bool[Array, ""]:
        """Whether one mode is left whose translation is known; or, where there is no room, whether
        there is a translation, or with fewer frames too few landmarks would tie them."""
        enough = state.record.steps >= LEAST_STEPS
        alone = state.sum.log_weights[0] > -1e-3
        over = self._moved(state, MOVED) | ~tied(state.record)
        return (enough & alone & self._moved(state, KNOWN)) | (state.record.full & over)

    def _moved(self, state: RestState, share: float) -> Bool[Array, ""]:
        """Whether the σ of the translation is less than such a share of it."""
        ekf, member = self.ekf, state.sum.likeliest
        part = member.core.part("pose")
        n = ekf.motion.geometry.point_dim
        position = slice(part.start, part.start + n)
        variance = jnp.trace(member.covariance[position, position])
        squared = jnp.sum(ekf.model.camera_pose(member.core).translation() ** 2)
        return variance < share**2 * squared


def _likely(members: SumState, now: Bool[Array, ""]) -> SumState:
    """The members without those that are `GIVEN_UP`, if that is now."""
    unlikely = members.log_weights < jnp.max(members.log_weights) - GIVEN_UP
    weights = jnp.where(now & unlikely, -jnp.inf, members.log_weights)
    return replace(members, log_weights=weights)


def _members(
    ekf: EkfSlam, record: Record, modes: Modes, means: Mean, members: State, like: State
) -> State:
    """The Gaussians of the modes; of what a window leaves open, as in a state that is up to date,
    which members without weight are not."""

    def begun(data, record, like):
        mean, _ = data
        return mean, gauge_state(ekf, record, *mean, like)

    alive = jnp.isfinite(modes.log_weights)
    return map_where(begun, (means, members), alive, record, like)[1]


def _doubted(modes: Modes) -> Bool[Array, " m"]:
    """The landmark that is most doubtful in all modes that count, if it is too doubtful."""
    likely = modes.log_weights >= -GIVEN_UP
    doubts = jnp.min(jnp.where(likely[:, None], modes.doubts, jnp.inf), axis=0)
    return (jnp.arange(len(doubts)) == jnp.argmax(doubts)) & (doubts > DOUBTFUL)


def _check_base(ekf: EkfSlam) -> None:
    """Raise ValueError unless a window can say all that the filter keeps."""
    for wrong, why in (
        (not ekf.motion.has_velocity, f"of a velocity, which {type(ekf.motion).__name__} lacks"),
        (not ekf.sensor.hidden, f"for a camera; {type(ekf.sensor).__name__} measures metres"),
        (ekf.landmark.anchored, f"without anchors, which {ekf.landmark.name} has"),
    ):
        if wrong:
            raise ValueError(f"a start from rest is {why}")


def from_rest(base: GaussianSum, frames: int | None = None) -> BatchInitialisation:
    """The sum with a start that looks for itself how the camera moves, within so many frames after
    frame 0. Raises ValueError for what does not go together."""
    name = ekf_inside(base, "a start from rest is").motion.geometry.name
    sizes = SIZES[name]
    if frames is not None:
        sizes = (*(size for size in sizes if size < frames + 1), frames + 1)
    return BatchInitialisation(base, sizes, DIRECTIONS[name])
