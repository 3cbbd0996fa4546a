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
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxslam._numerics.arrays import cast, precision
from jaxslam._numerics.conditional import cond, map_where
from jaxslam.filters.layer import AbstractLayer, AbstractSlam
from jaxslam.filters.linear.state import State
from jaxslam.filters.mixture.mixture import Mixture
from jaxslam.filters.mixture.sum_state import SumState
from jaxslam.filters.window import record as window
from jaxslam.filters.window.modes import Found, Mean, Modes, at_rest, searched, sought
from jaxslam.filters.window.problem import PathLayout
from jaxslam.filters.window.record import Record
from jaxslam.filters.window.subsample import thinned, tied
from jaxslam.filters.window.to_filter import gauge_state
from jaxslam.geometry import PLANAR, Geometry
from jaxslam.models.observations import Capacity


class Schedule(eqx.Module):
    """When a start seeks minima, in how many frames, and when the sum goes on alone.

    Raises ValueError for windows that are too short or not in order, and for no direction.
    """

    sizes: tuple[int, ...] = eqx.field(static=True)
    """Frames of the windows that are compiled; the smallest that holds all is computed."""
    directions: int = eqx.field(static=True)
    """The number of directions in which the search starts, besides the start from rest."""
    searches: tuple[int, ...] = eqx.field(static=True)
    """Frames after which minima are sought anew, from all starts."""
    in_turn: int = eqx.field(static=True)
    """The number of starts, in turn, after every other frame: no frame waits for them all."""
    searched: int = eqx.field(static=True)
    """Frames in which they are sought, spread over the window."""
    renewed: tuple[int, ...] = eqx.field(static=True)
    """By window: the sum begins anew in every frame whose number this divides."""
    divided: bool = eqx.field(static=True)
    """Whether the sum is divided anew in every frame, or its members are the modes and what becomes
    of them: halves of a Gaussian, each linearised off its middle, can be worse than the whole."""
    given_up: float = eqx.field(static=True, default=10.0)
    """Log evidence: modes so much less likely than the likeliest end with the window. What has been
    weighed without a linearisation is not to be overturned by one."""
    least_steps: int = eqx.field(static=True, default=8)
    """Steps since frame 0 before the sum may go on alone."""
    known: float = eqx.field(static=True, default=0.03)
    """σ of the translation, in translations, given the scale: below it parallax is there."""
    moved: float = eqx.field(static=True, default=0.1)
    """The same, below which a camera has done more than turn."""
    doubtful: float = eqx.field(static=True, default=4.0)
    """σ of a landmark that is given up, one in a frame: what is seen there is no point in space."""

    def __check_init__(self) -> None:
        if min(self.sizes, default=0) < 3 or list(self.sizes) != sorted(set(self.sizes)):
            raise ValueError(
                "a start from rest keeps windows of 3 frames and more (frame 0 and at least 2 "
                f"after it), each larger than the one before, not {self.sizes}"
            )
        if self.directions < 1:
            raise ValueError(f"a search sets out in 1 direction at least, not {self.directions}")

    @staticmethod
    def of(geometry: Geometry, frames: int | None = None) -> Schedule:
        """The schedule for a planar or a spatial world, of windows of at most so many frames after
        frame 0."""
        made = _PLANAR if geometry is PLANAR else _SPATIAL
        if frames is None:
            return made
        sizes = (*(size for size in made.sizes if size < frames + 1), frames + 1)
        return replace(made, sizes=sizes)


_PLANAR = Schedule((25, 61), 16, (1, 2, 3, 4, 6, 8, 11, 15, 20, 26, 34), 0, 13, (2, 4), True)
_SPATIAL = Schedule((31,), 8, (1, 2, 3), 1, 9, (1,), False)


class RestState(eqx.Module):
    """The sum, and what it is initialised anew from as long as the window is open."""

    sum: SumState
    record: Record
    modes: Modes
    open: Bool[Array, ""]


class FromWindow(AbstractLayer):
    """The start of a mixture that looks for itself how the camera moves."""

    schedule: Schedule
    """When minima are sought, and when the sum goes on alone."""

    def ambiguous_start(self, slam):
        return True

    def init(self, slam, capacity, first, known):
        """Raises ValueError for a prior map, of which a window knows nothing."""
        if known is not None:
            raise ValueError("a start from a window takes no prior map; leave out start, or known")
        one, (landmarks, *_) = slam.one, Capacity.of(capacity)
        dtype, sizes = precision(one), self.schedule.sizes
        begun = window.empty(one.motion, sizes[-1], landmarks, one.sensor.size, dtype)
        if first is not None:
            begun = window.begun(begun, first)
        member = one.init(capacity, first)
        modes = at_rest(cast(one, dtype), begun, slam.mixture.members, dtype)
        count = len(modes.log_weights)
        members = jax.tree.map(lambda x: jnp.tile(x, (count, *(1,) * x.ndim)), member)
        return RestState(SumState(members, modes.log_weights), begun, modes, jnp.ones((), bool))

    def inside(self, state: RestState) -> SumState:
        return state.sum

    def around(self, state: RestState, inner: SumState) -> RestState:
        return replace(state, sum=inner)

    def update(self, slam, state, control, seen):
        mixture: Mixture = slam.mixture
        update = mixture.update if self.schedule.divided else mixture.update_members
        after, innovation = update(slam.inner, state.sum, control, seen)
        stepped = window.stepped(state.record, control, seen, slam.sensor.noise)
        return replace(state, sum=after, record=stepped), innovation

    def close(self, slam, state, new):
        """End the frame, and begin the sum anew from the window's modes while that is open."""
        schedule = self.schedule
        after = slam.inner.close(state.sum, new)
        state = replace(state, sum=after, record=window.begun(state.record, new))
        # Where nothing was ever seen there is nothing to begin anew from.
        anew = state.open & jnp.any(state.record.seen) & (state.record.last > 0)
        due = self._due(state.record, self._moved(slam, state, schedule.moved)) & anew
        found = searched(slam.one, state.record, state.modes, due, schedule.searched)
        least, now = 1, jnp.zeros((), bool)
        for index, frames in enumerate(schedule.sizes):
            last = state.record.last
            wanted = anew & (last >= least) & (last < frames)
            period = schedule.renewed[min(index, len(schedule.renewed) - 1)]
            wanted &= (last % period == 0) | jnp.any(due) | state.record.full
            state = self._anew(slam, state, found, frames, wanted)
            least, now = frames, now | wanted
        ready = now & self._ready(slam, state)
        likely = _likely(state.sum, ready, schedule.given_up)
        state = replace(state, sum=likely, open=state.open & ~ready)
        thinned = partial(self._thinned, slam)
        return cond(state.open & state.record.full, thinned, state)

    def remove(self, slam, state, gone):
        modes = state.modes
        y = jnp.where(gone[:, None], 0.0, modes.minima.y)
        return RestState(
            slam.inner.remove(state.sum, gone),
            window.removed(state.record, gone),
            replace(modes, minima=replace(modes.minima, y=y)),
            state.open,
        )

    def unit_fixed(self, slam, state):
        return ~state.open

    def _anew(
        self,
        slam: AbstractSlam,
        state: RestState,
        found: Found,
        frames: int,
        wanted: Bool[Array, ""],
    ) -> RestState:
        """The modes of a window of so many frames, those that were `found` among them, and the sum
        of them, without the landmark that contradicts all of them most."""
        one, record, schedule = slam.one, state.record.cut(frames), self.schedule
        size = PathLayout.of(one).size(frames)

        def cut(minima):
            return replace(minima, x=minima.x[:, :size])

        def solved(state, record, found):
            x = state.modes.minima.x
            modes = replace(state.modes, minima=cut(state.modes.minima))
            found = found._replace(minima=cut(found.minima))
            modes, means, explained = sought(one, record, modes, found)
            like = state.sum.likeliest
            members = _members(one, record, modes, means, state.sum.members, like)
            begun = SumState(members, modes.log_weights)
            begun = jax.tree.map(lambda new, old: jnp.where(explained, new, old), begun, state.sum)
            wrong = explained & _doubted(modes, schedule)
            x = x.at[:, :size].set(modes.minima.x)
            modes = replace(modes, minima=replace(modes.minima, x=x))
            return self.remove(slam, replace(state, sum=begun, modes=modes), wrong)

        return cond(wanted, solved, state, record, found)

    def _due(self, record: Record, moved: Bool[Array, ""]) -> Bool[Array, " starts"]:
        """The starts from which minima are sought after this frame. Of a camera that has `moved`
        the reversal is always one of those in turn: the window is about to end, and nothing is as
        like the truth."""
        count, together = 2 + self.schedule.directions, self.schedule.in_turn
        steps = record.steps.astype(int) - 4
        turn = (jnp.arange(count) - 1 - together * steps) % count < together
        turn |= (jnp.arange(count) == 1) & moved & bool(together)
        whole = jnp.any(record.last == jnp.array(self.schedule.searches))
        return (whole | turn) & ~record.standing

    def _thinned(self, slam: AbstractSlam, state: RestState) -> RestState:
        record, minima = thinned(slam.one, state.record, state.modes.minima)
        return replace(state, record=record, modes=replace(state.modes, minima=minima))

    def _ready(self, slam: AbstractSlam, state: RestState) -> Bool[Array, ""]:
        """Whether one mode is left whose translation is known; or, where there is no room, whether
        there is a translation, or with fewer frames too few landmarks would tie them."""
        schedule = self.schedule
        enough = state.record.steps >= schedule.least_steps
        alone = state.sum.log_weights[0] > -1e-3
        over = self._moved(slam, state, schedule.moved) | ~tied(state.record)
        known = self._moved(slam, state, schedule.known)
        return (enough & alone & known) | (state.record.full & over)

    def _moved(self, slam: AbstractSlam, state: RestState, share: float) -> Bool[Array, ""]:
        """Whether the σ of the translation is less than such a share of it."""
        member = state.sum.likeliest
        part = member.core.part("pose")
        n = slam.motion.geometry.point_dim
        position = slice(part.start, part.start + n)
        variance = jnp.trace(member.covariance[position, position])
        squared = jnp.sum(slam.model.camera_pose(member.core).translation() ** 2)
        return variance < share**2 * squared


def _likely(members: SumState, now: Bool[Array, ""], given_up: float) -> SumState:
    """The members without those that are given up, if that is now."""
    unlikely = members.log_weights < jnp.max(members.log_weights) - given_up
    weights = jnp.where(now & unlikely, -jnp.inf, members.log_weights)
    return replace(members, log_weights=weights)


def _members(
    one: AbstractSlam, record: Record, modes: Modes, means: Mean, members: State, like: State
) -> State:
    """The Gaussians of the modes; of what a window leaves open, as in a state that is up to date,
    which members without weight are not."""

    def begun(data, record, like):
        mean, _ = data
        return mean, gauge_state(one, record, *mean, like)

    alive = jnp.isfinite(modes.log_weights)
    return map_where(begun, (means, members), alive, record, like)[1]


def _doubted(modes: Modes, schedule: Schedule) -> Bool[Array, " m"]:
    """The landmark that is most doubtful in all modes that count, if it is too doubtful."""
    likely = modes.log_weights >= -schedule.given_up
    doubts = jnp.min(jnp.where(likely[:, None], modes.doubts, jnp.inf), axis=0)
    return (jnp.arange(len(doubts)) == jnp.argmax(doubts)) & (doubts > schedule.doubtful)
