"""The tracker: a filter fed with pictures, frame by frame, by active search.

It is a fold: `step` takes a `TrackerState` and a frame to the next state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.linalg import LinAlgError

from jaxslam.filters.protocol import AbstractStaged
from jaxslam.io.calibration import Calibration
from jaxslam.io.pictures import as_grey
from jaxslam.io.source import Frame, check_size
from jaxslam.models.observations import Status
from jaxslam.tracking import persistence
from jaxslam.tracking.corners import bare_corners
from jaxslam.tracking.estimator import Correction, Estimator
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.map import Map, TrackerState, in_view
from jaxslam.tracking.observations import NOTHING, Lost, Observations
from jaxslam.tracking.places.closing import close_loop
from jaxslam.tracking.places.descriptors import with_looks
from jaxslam.tracking.places.joining import LOOKED_EVERY, join_of, joined, known_elsewhere
from jaxslam.tracking.places.relocalisation import NOTED_EVERY, known_again
from jaxslam.tracking.places.smoothing import smoothed
from jaxslam.tracking.policy import LEAST_MATCHES, Policy
from jaxslam.tracking.report import Tracked
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.start import places_with_target, trackable
from jaxslam.tracking.target import Target, TargetObservation, sighted

Stepped = tuple[TrackerState, Tracked]
"""The state after a frame, and what became of the frame."""


def start(
    slam: AbstractStaged, settings: TrackerSettings, calibration: Calibration
) -> TrackerState:
    """The state before the first frame of a camera with this calibration."""
    with jax.enable_x64(True):
        return TrackerState(calibration, Map(Estimator.of(slam, settings).empty()))


def step(
    slam: AbstractStaged,
    settings: TrackerSettings,
    state: TrackerState,
    frame: Frame,
    sighting: TargetObservation | None = None,
) -> Stepped:
    """Predict, search, update, and renew the map; the first frame may have a `sighting` of points
    that are known.

    A frame after which the camera's pose is not finite is lost: the tracker goes on from the state
    before it. Raises ValueError for a frame of another size than the calibration's, or not later
    than the one before.
    """
    check_size(f"frame {frame.index}", frame.image, state.calibration)
    before = -np.inf if state.time is None else state.time
    if not before < frame.time < np.inf:
        raise ValueError(
            f"frame {frame.index}: its time, {frame.time} s, is not later than that of the "
            f"previous frame, {before} s"
        )
    with jax.enable_x64(True):
        now = _Step(Estimator.of(slam, settings), frame)
        try:
            after, tracked = now.taken(state, sighting)
        except (FloatingPointError, LinAlgError):
            after, tracked = now.broken(state)
    return replace(after, time=frame.time, steps=state.steps + 1), tracked


@dataclass(frozen=True)
class _Step:
    """What a frame makes of a state."""

    estimator: Estimator
    frame: Frame

    def taken(self, state: TrackerState, sighting: TargetObservation | None) -> Stepped:
        """The frame, whatever is known."""
        if state.searching:
            return self._searching(state)
        if state.time is None:
            return self._first(state, sighting)
        return self._next(state, self.frame.time - state.time)

    def broken(self, state: TrackerState) -> Stepped:
        """A frame that leads to numbers which are not finite: a new map where the camera was."""
        state = replace(
            _with_failure(state, "not_finite").remembered(), unmeasured=state.unmeasured + 1
        )
        try:
            # Of a frame that may not have been the filter's first.
            dt = np.asarray(0.0 if state.time is None else self.frame.time - state.time)
            begun = state.given_up(self.estimator, sorted(state.landmarks))
            return self._lost(begun.anew(self.estimator, dt), Lost.NOT_FINITE)
        except (FloatingPointError, LinAlgError):
            return state, Tracked.of(self.frame, state.map, reason=Lost.NOT_FINITE)

    def _corners(self, occupied: np.ndarray | None = None) -> np.ndarray:
        return bare_corners(self.frame.image, self.estimator.settings, occupied)

    def _policy(self, state: TrackerState) -> Policy:
        estimator = self.estimator
        return Policy(state.calibration, estimator.settings, estimator.slam.ambiguous_start)

    def _searching(self, state: TrackerState) -> Stepped:
        """Look for a map that is known; begin another where there was none for long."""
        found = known_again(self.frame.image, self.estimator, self._policy(state), state)
        if found is not None:
            return self._back(*found)
        state, corners = replace(state, unmeasured=state.unmeasured + 1), self._corners()
        waits = state.unmeasured <= self.estimator.settings.lost_for
        if waits or len(corners) < LEAST_MATCHES:
            return state, Tracked.of(self.frame, state.map, reason=Lost.NOTHING_EXPECTED)
        state = replace(state, unmeasured=0, searching=False)
        return self._begun(state, corners, starts=True)

    def _first(self, state: TrackerState, sighting: TargetObservation | None) -> Stepped:
        """Begin the first map with the first frame."""
        self.estimator.compile(self._policy(state).in_wide)
        pixels, depths = self._corners(), None
        if sighting is not None:
            pixels, depths = places_with_target(sighting, pixels, self.estimator.settings)
        return self._begun(state, pixels, depths, starts=True)

    def _begun(
        self,
        state: TrackerState,
        pixels: np.ndarray,
        depths: tuple[np.ndarray, np.ndarray] | None = None,
        **found: Any,
    ) -> Stepped:
        """Begin a map with landmarks at these pixels."""
        state = state.begun(self.estimator, self.frame.image, pixels, depths)
        return state, Tracked.of(self.frame, state.map, created=pixels, **found)

    def _next(self, state: TrackerState, seconds: float) -> Stepped:
        """Track a frame so many seconds after the one before."""
        frame, estimator, policy = self.frame, self.estimator, self._policy(state)
        predicted = estimator.predict(state.map.state, seconds)
        ahead, behind = predicted.view.sides
        if behind > ahead and behind >= LEAST_MATCHES:
            # Nobody is to come back to it.
            state = replace(state, reversed=state.reversed + 1, seen=None)
            return self._lost(state.coasted(estimator, predicted), Lost.REVERSED)
        lost, doubtful = state.unmeasured > 0, state.doubtful
        seen, reason, doubtful = policy.observed(
            frame.image, state.map, estimator, predicted, lost=lost, doubtful=doubtful
        )
        # Of two motions that contradict each other a place that is known says no more: it is one of
        # both.
        elsewhere = state.elsewhere or reason in (Lost.NOTHING_EXPECTED, Lost.FEW_AGREE)
        state = replace(state, doubtful=doubtful, elsewhere=elsewhere and reason is not None)
        if reason is not None:
            state = state.remembered()
        if state.elsewhere and lost:
            found = known_again(frame.image, estimator, policy, state)
            if found is not None:
                return self._back(*found)
        seen = state.map.weighed(seen, estimator.settings)
        belief, correction = estimator.correct(predicted, seen)
        if correction.failed:
            state = _with_failure(state, Status(int(correction.status)).name.lower())
            fallen = state.remembered().fallen_back(estimator, predicted)
            return self._lost(fallen, Lost.NOT_POSITIVE)
        seen = seen.but_for(correction.used)
        last = state.map.place.camera.T_wc
        state = state.with_map(state=belief).noted(estimator, seen, predicted)
        if reason is None:
            state = replace(state, seen=None)
        if reason is None and not seen.matched.any():
            reason = Lost.REFUSED
        return self._corrected(state, last, seen, correction, reason)

    def _corrected(
        self,
        state: TrackerState,
        last: np.ndarray,
        seen: Observations,
        correction: Correction,
        reason: Lost | None,
    ) -> Stepped:
        """Renew the map after an update, and look for places that are known; `last` is T of the
        camera before."""
        frame, estimator, settings = self.frame, self.estimator, self.estimator.settings
        if reason is None:
            measured = max(state.restarts, state.map.number)
            state = replace(state, unmeasured=0, restarts=measured)
        else:
            state = replace(state, unmeasured=state.unmeasured + 1)
        if not state.landmarks or state.unmeasured > settings.lost_for:
            return self._lost(state, reason or Lost.NOTHING_EXPECTED, seen)
        kept = in_view(state.landmarks, seen.slots, settings)
        # What a lost camera sees may be another place: it is not put into this map.
        created = np.zeros((0, 2)) if reason is not None else self._corners(seen.places[kept])
        ended = len(state.map.submaps)
        state = state.renewed(estimator, frame.image, created, seen.slots[kept])
        if reason is None and state.steps % LOOKED_EVERY == 0:
            found = known_elsewhere(frame.image, estimator, self._policy(state), state)
            if found is not None:
                return self._joined(last, *found)
        loop = None
        if len(state.map.submaps) > ended:
            closed = close_loop(frame.image, estimator, state)
            if closed is not None:
                state, place = closed
                state = replace(state, refused=state.refused + (not place.believed))
                loop = place.submap if place.believed else None
        if reason is None and state.steps % NOTED_EVERY == 0:
            state = state.with_map(landmarks=with_looks(state.landmarks, frame.image))
        return state, Tracked.of(
            frame, state.map, seen, correction, created=created, reason=reason, loop=loop
        )

    def _joined(
        self, last: np.ndarray, state: TrackerState, seen: Observations, correction: Correction
    ) -> Stepped:
        """Go on in another map, which this one is joined to."""
        before = state.left[-1]
        state, tracked = self._back(state, seen, correction)
        join = join_of(self.estimator, before, state.map, state.steps, last)
        return replace(state, joins=state.joins + (() if join is None else (join,))), tracked

    def _back(self, state: TrackerState, seen: Observations, correction: Correction) -> Stepped:
        """Go on in a map in which the camera was found again."""
        estimator, nothing = self.estimator, np.zeros((0, 2))
        state = state.noted(estimator, seen).renewed(estimator, self.frame.image, nothing)
        state = state.with_map(state=estimator.at_rest(state.map.state))
        state = replace(state, unmeasured=0, searching=False, doubtful=False)
        return state, Tracked.of(self.frame, state.map, seen, correction, relocalised=True)

    def _lost(self, state: TrackerState, reason: Lost, seen: Observations = NOTHING) -> Stepped:
        """Begin a new map at the camera as it is predicted, or wait for a picture with corners."""
        corners, number = self._corners(), state.map.number
        state = state.renewed(self.estimator, self.frame.image, corners[:0])
        if len(corners) < LEAST_MATCHES:
            return state, Tracked.of(self.frame, state.map, seen, reason=reason)
        state = replace(state.restarted(self.estimator), unmeasured=0, doubtful=False)
        starts = state.map.number != number
        return self._begun(state, corners, observations=seen, reason=reason, starts=starts)


def _with_failure(state: TrackerState, name: str) -> TrackerState:
    """One more update that failed so."""
    return replace(state, failed={**state.failed, name: state.failed.get(name, 0) + 1})


@dataclass
class Tracker:
    """Tracks a camera: `step(image, time)` or `track(frame)` for each frame of a video, in order.

    A camera that is lost moves as the filter predicts. One lost for long, or a filter whose
    covariance is not positive any more, begins a new map where the picture has the corners for
    it: exactly known in its own frame, and in the world as surely as its start is. Its unit of
    length is another, which no covariance here knows of. Within a map there is one unit, whatever
    the filter makes of the scale meanwhile (docs/gauge.md).

    It holds the `state` that `jaxslam.tracking.tracker.step` goes on from, and what that knows it
    has too: `steps`, `created`, `deleted`, `landmarks`, `restarts` and the others. Raises
    ValueError for a filter that cannot track, or cannot begin with the target.
    """

    calibration: Calibration
    """The calibration of the camera, for the size of its pictures."""
    settings: TrackerSettings = field(default_factory=TrackerSettings)
    filter: AbstractStaged | None = None
    """One's own, in place of the filter that the settings name."""
    target: Target | None = None
    """Points of known positions, m, that the first frame sees: then the first map is in metres, the
    unit of `nearest_depth`. For a `Slam` of one Gaussian, in metres, of no common depth."""
    sighting: TargetObservation | None = field(default=None, init=False)
    """Where the first frame saw the target."""
    filter_name: str = field(init=False)
    """The name in the settings, or the class of your own filter."""
    estimator: Estimator = field(init=False, repr=False)
    """The filter."""
    state: TrackerState = field(init=False, repr=False)
    """All that is known after the latest frame."""

    def __post_init__(self) -> None:
        if not isinstance(self.calibration, Calibration):
            raise ValueError(
                f"calibration must be a Calibration, not a {type(self.calibration).__name__}; "
                "jaxslam.io.read_calibration reads one from a file"
            )
        settings, own = self.settings, self.filter
        self.filter_name = settings.filter if own is None else type(own).__name__
        made = settings.make_filter(self.calibration) if own is None else own
        made = trackable(self.filter_name, made, settings, self.target)
        self.state = start(made, settings, self.calibration)
        self.estimator = Estimator.of(made, settings)

    def __getattr__(self, name: str) -> Any:
        """What the state says."""
        if name == "state":  # not made yet
            raise AttributeError(name)
        return getattr(self.state, name)

    def track(self, frame: Frame) -> Tracked:
        """Predict, search, update, and renew the map. Raises ValueError, and changes nothing, for
        a frame of another size than the calibration's, or not later than the one before."""
        sighting = None
        if self.target is not None and self.state.time is None:
            sighting = sighted(
                self.target, frame.image, self.calibration, self.settings.pixel_sigma
            )
        self.state, tracked = step(self.estimator.slam, self.settings, self.state, frame, sighting)
        self.sighting = self.sighting if sighting is None else sighting
        return tracked

    def step(self, image: np.ndarray, time: float) -> Tracked:
        """`track` a picture taken at `time` (s): grey, or in colour in OpenCV's order (BGR), uint8
        or floats from 0 to 1."""
        return self.track(Frame(self.steps, float(time), as_grey(image)))

    def compile(self) -> None:
        """Compile all programs now; else the first frames wait for it, and a camera does not."""
        policy = Policy(self.calibration, self.settings, self.estimator.slam.ambiguous_start)
        with jax.enable_x64(True):
            for thread in self.estimator.compile(policy.in_wide):
                thread.join()

    def points(self) -> Points:
        """Return all landmarks, those gone included."""
        with jax.enable_x64(True):
            return self.state.points(self.estimator)

    def smoothed(self, history: Sequence[Tracked]) -> tuple[list[Tracked], Points]:
        """Return the frames so far, and all landmarks, as all that was seen later has them: loops
        that closed, and maps that were joined, included (docs/submaps.md)."""
        with jax.enable_x64(True):
            return joined(self.state.joins, *smoothed(self.estimator, self.state, history))

    def camera(self) -> tuple[str, np.ndarray, np.ndarray] | None:
        """Return how the calibration is treated, and fx, fy, cx, cy with their covariance, pixels,
        as far as this map tells; None for a filter without a pinhole camera."""
        with jax.enable_x64(True):
            return self.estimator.camera(self.state.map.state)

    def save(self, path: str | Path) -> None:
        """Write all that is needed to go on from here (.npz), whole or not at all.

        Raises ValueError before the first frame, when there is nothing to go on from.
        """
        if self.state.time is None:
            raise ValueError("a tracker without any frame has nothing to save")
        own = None if self.filter is None else self.filter_name
        persistence.save(path, self.state, self.settings, own)

    @classmethod
    def load(cls, path: str | Path, filter: AbstractStaged | None = None) -> Tracker:
        """The tracker that was saved, which goes on as that would have: digit by digit.

        If it had a `filter` of your own, pass that again. Raises ValueError for a file
        that is none, or of another filter.
        """
        saved = persistence.read(path, own_filter=filter is not None)
        tracker = cls(saved.calibration, saved.settings, filter)
        tracker.state = saved.state(tracker.estimator)
        return tracker

    @classmethod
    def localising(
        cls, path: str | Path, calibration: Calibration, filter: AbstractStaged | None = None
    ) -> Tracker:
        """A tracker of another video that looks for the maps which were saved, and goes on in the
        first that it finds; where it finds none in as many frames as a camera may be lost, it
        begins its own. Raises ValueError as `load`, and for a map of another camera."""
        tracker = cls.load(path, filter)
        if tracker.calibration != calibration:
            both = (tracker.calibration, calibration)
            theirs, ours = (f"{one.width} × {one.height}, fx {one.fx:g}" for one in both)
            raise ValueError(
                f"{path} is a map of another camera ({theirs}), not of this one ({ours})"
            )
        with jax.enable_x64(True):
            state = tracker.state.departed(tracker.estimator)
        joins = tuple(replace(one, step=-1) for one in state.joins)
        tracker.state = replace(
            state,
            joins=joins,
            time=None,
            steps=0,
            unmeasured=1,
            searching=True,
            doubtful=False,
        )
        return tracker
