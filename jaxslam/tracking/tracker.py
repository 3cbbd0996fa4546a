"""The tracker: a filter fed with pictures, frame by frame, by active search.

It is a fold: `step` takes a `TrackerState` and a frame to the next state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import cv2
import jax
import numpy as np
from scipy.linalg import LinAlgError

from jaxslam._runtime.threads import in_one_thread
from jaxslam.filters.protocol import AbstractStaged
from jaxslam.io.calibration import Calibration
from jaxslam.io.pictures import as_grey
from jaxslam.io.source import Frame, check_size
from jaxslam.models.observations import Status
from jaxslam.tracking import persistence
from jaxslam.tracking.corners import bare_corners
from jaxslam.tracking.estimator import Correction, Estimator
from jaxslam.tracking.inertial import Inertial
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.map import Map, TrackerState, in_view
from jaxslam.tracking.observations import NOTHING, Lost, Observations
from jaxslam.tracking.places.closing import close_loop
from jaxslam.tracking.places.descriptors import with_looks
from jaxslam.tracking.places.joining import LOOKED_EVERY, join_of, joined, known_elsewhere
from jaxslam.tracking.places.relocalisation import NOTED_EVERY, known_again
from jaxslam.tracking.places.smoothing import smoothed
from jaxslam.tracking.policy import JERK, LEAST_MATCHES, LIVELY, Policy
from jaxslam.tracking.pose_with_covariance import Pixels, Places, Transform
from jaxslam.tracking.report import History, Tracked
from jaxslam.tracking.settings import INERTIAL, TrackerSettings
from jaxslam.tracking.start import places_with_target, trackable
from jaxslam.tracking.target import Target, TargetObservation, sighted

SAME, NEARLY, MOST_APART = 0.5, 0.1, 2.0
"""RMS of the difference of two pictures that are one, in grey levels: always, as a share of what a
picture changed before, and its limit. A camera's own noise is more; what a film's compression
leaves of it is less."""
MOST_REPEATS = 3
"""Pictures in a row that are taken for one which a film has several times."""
Stepped = tuple[TrackerState, Tracked]
"""The state after a frame, and what became of the frame."""


def start(
    slam: AbstractStaged,
    settings: TrackerSettings,
    calibration: Calibration,
    inertial: Inertial | None = None,
) -> TrackerState:
    """The state before the first frame of a camera with this calibration, and maybe a unit whose
    readings tell its motion to a filter that has its model."""
    with jax.enable_x64(True):
        estimator = Estimator(slam, settings, inertial)
        return TrackerState(estimator, calibration, Map(estimator.empty()))


@in_one_thread
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
    before it. A picture that is the one before once more is not used. Raises ValueError for a frame
    of another size than the calibration's, or not later than the one before.
    """
    check_size(f"frame {frame.index}", frame.image, state.calibration)
    before = -np.inf if state.time is None else state.time
    if not before < frame.time < np.inf:
        raise ValueError(
            f"frame {frame.index}: its time, {frame.time} s, is not later than that of the "
            f"previous frame, {before} s"
        )
    waited = 0.0 if state.time is None else frame.time - state.time + state.waiting
    apart, known = _apart(state.image, frame.image), state.landmarks and not state.unmeasured
    if (inertial := state.estimator.inertial) is not None:
        # A picture that stays the same is then of a camera that stands still.
        known = known and state.repeats < MOST_REPEATS
    if known and apart <= max(SAME, min(NEARLY * state.apart, MOST_APART)):
        # The camera is where this picture was taken. What comes after few such pictures has their
        # time too; after many the camera, or the picture, stood still.
        waiting = waited if state.repeats < MOST_REPEATS else 0.0
        after = replace(state, repeats=state.repeats + 1, waiting=waiting)
        tracked = Tracked.of(frame, state.map, repeated=True)
    else:
        with jax.enable_x64(True):
            state = replace(state, estimator=Estimator(slam, settings, inertial))
            try:
                after, tracked = _taken(state, frame, waited, sighting)
            except (FloatingPointError, LinAlgError):
                after, tracked = _broken(state, frame, waited)
        image, apart = frame.image.copy(), apart if np.isfinite(apart) else 0.0
        after = replace(after, image=image, apart=apart, repeats=0, waiting=0.0)
    return replace(after, time=frame.time, steps=state.steps + 1), tracked


def _apart(one: np.ndarray | None, other: np.ndarray) -> float:
    """RMS of the difference of two pictures, grey levels."""
    return np.inf if one is None else cv2.norm(one, other, cv2.NORM_L2) / math.sqrt(other.size)


def _taken(
    state: TrackerState, frame: Frame, seconds: float, sighting: TargetObservation | None
) -> Stepped:
    """The frame, so many seconds after the latest one that was used."""
    policy = Policy.of(state.calibration, state.estimator)
    if state.time is None:
        state.estimator.compile(policy.in_wide)
    if state.searching:
        return _searching(state, frame, policy)
    if state.time is not None:
        return _next(state, frame, policy, seconds)
    pixels, depths = _corners(state, frame), None
    if sighting is not None:
        pixels, depths = places_with_target(sighting, pixels, state.estimator.settings)
    state = state.begun(frame.image, pixels, depths)
    return state, Tracked.of(frame, state.map, created=pixels, starts=True)


def _broken(state: TrackerState, frame: Frame, seconds: float) -> Stepped:
    """A frame that leads to numbers which are not finite: a new map where the camera was."""
    state = _with_failure(state, "not_finite").remembered()
    state = replace(state, unmeasured=state.unmeasured + 1)
    try:
        begun = state.given_up(sorted(state.landmarks)).anew(
            state.estimator.control(frame.time, seconds)
        )
        return _lost(begun, frame, Lost.NOT_FINITE)
    except (FloatingPointError, LinAlgError):
        return state, Tracked.of(frame, state.map, reason=Lost.NOT_FINITE)


def _corners(state: TrackerState, frame: Frame, occupied: Pixels | None = None) -> Places:
    return bare_corners(frame.image, state.estimator.settings, occupied)


def _searching(state: TrackerState, frame: Frame, policy: Policy) -> Stepped:
    """Look for a map that is known; begin another where there was none for long."""
    found = known_again(frame.image, policy, state)
    if found is not None:
        return _back(frame, *found)
    state, corners = replace(state, unmeasured=state.unmeasured + 1), _corners(state, frame)
    if state.unmeasured <= state.estimator.settings.lost_for or len(corners) < LEAST_MATCHES:
        return state, Tracked.of(frame, state.map, reason=Lost.NOTHING_EXPECTED)
    state = replace(state, unmeasured=0, searching=False).begun(frame.image, corners)
    return state, Tracked.of(frame, state.map, created=corners, starts=True)


def _next(state: TrackerState, frame: Frame, policy: Policy, seconds: float) -> Stepped:
    """Track a frame so many seconds after the one before."""
    estimator, lost = state.estimator, state.unmeasured > 0
    predicted = estimator.predict(state.map.state, estimator.control(frame.time, seconds))
    ahead, behind = predicted.view.sides
    if behind > ahead and behind >= LEAST_MATCHES:
        # Nobody is to come back to it.
        state = replace(state, reversed=state.reversed + 1, seen=None)
        return _lost(state.coasted(predicted), frame, Lost.REVERSED)
    seen, reason, doubtful = policy.observed(frame.image, state, predicted, lost=lost)
    # What an inertial unit feels is no jerk.
    if not lost and estimator.inertial is None and state.map.place.unit_fixed:
        matched = seen.labelled("matched")
        nis, _ = estimator.nis(predicted, matched)
        # One that is less than the fall by which another prediction is likelier cannot fall so.
        if reason is not None or nis > LIVELY:
            jerked = estimator.predict(state.map.state, predicted.control, JERK)
            if reason is not None or nis - estimator.nis(jerked, matched)[0] > LIVELY:
                found, why, wavers = policy.observed(frame.image, state, jerked, lost=lost)
                if why is None:
                    predicted, seen, reason, doubtful = jerked, found, None, wavers
    # Of two motions that contradict each other a place that is known says no more: it is one of
    # both.
    elsewhere = state.elsewhere or reason in (Lost.NOTHING_EXPECTED, Lost.FEW_AGREE)
    state = replace(state, doubtful=doubtful, elsewhere=elsewhere and reason is not None)
    if reason is not None:
        state = state.remembered()
    if state.elsewhere and lost:
        found = known_again(frame.image, policy, state)
        if found is not None:
            return _back(frame, *found)
    seen = state.map.weighed(seen, estimator.settings)
    belief, correction = estimator.correct(predicted, seen)
    if correction.failed:
        state = _with_failure(state, Status(int(correction.status)).name.lower())
        return _lost(state.remembered().fallen_back(predicted), frame, Lost.NOT_POSITIVE)
    seen = seen.but_for(correction.used)
    after = state.with_map(state=belief).noted(seen, predicted)
    after = replace(after, seen=None if reason is None else after.seen)
    if reason is None and not seen.matched.any():
        reason = Lost.REFUSED
    kept = in_view(after.landmarks, seen.slots, estimator.settings)
    if reason is None:
        after = replace(after, unmeasured=0, restarts=max(after.restarts, after.map.number))
    else:
        after = replace(after, unmeasured=after.unmeasured + 1)
    if not after.landmarks or after.unmeasured > estimator.settings.lost_for:
        return _lost(after, frame, reason or Lost.NOTHING_EXPECTED, seen)
    # What a lost camera sees may be another place: it is not put into this map.
    created = np.zeros((0, 2)) if reason else _corners(after, frame, seen.places[kept])
    after = after.renewed(frame.image, created, seen.slots[kept])
    loop = None
    if reason is None and state.steps % LOOKED_EVERY == 0:
        found = known_elsewhere(frame.image, policy, after)
        if found is not None:
            return _joined(frame, state.map.place.camera.T_wc, *found)
    if len(after.map.submaps) > len(state.map.submaps):
        after, loop = close_loop(frame.image, after)
    if reason is None and state.steps % NOTED_EVERY == 0:
        after = after.with_map(landmarks=with_looks(after.landmarks, frame.image))
    outcome = {"created": created, "reason": reason, "loop": loop}
    return after, Tracked.of(frame, after.map, seen, correction, **outcome)


def _joined(
    frame: Frame, last: Transform, state: TrackerState, seen: Observations, correction: Correction
) -> Stepped:
    """Go on in another map, which this one is joined to; `last` is T of the camera before."""
    before = state.left[-1]
    state, tracked = _back(frame, state, seen, correction)
    join = join_of(before, state, last)
    return replace(state, joins=state.joins + (() if join is None else (join,))), tracked


def _back(frame: Frame, state: TrackerState, seen: Observations, correction: Correction) -> Stepped:
    """Go on in a map in which the camera was found again."""
    state = state.noted(seen).renewed(frame.image, np.zeros((0, 2)))
    state = state.with_map(state=state.estimator.at_rest(state.map.state))
    state = replace(state, unmeasured=0, searching=False, doubtful=False)
    return state, Tracked.of(frame, state.map, seen, correction, relocalised=True)


def _lost(state: TrackerState, frame: Frame, reason: Lost, seen: Observations = NOTHING) -> Stepped:
    """Begin a new map at the camera as it is predicted, or wait for a picture with corners."""
    corners, number = _corners(state, frame), state.map.number
    state = state.renewed(frame.image, corners[:0])
    if len(corners) < LEAST_MATCHES:
        return state, Tracked.of(frame, state.map, seen, reason=reason)
    state = replace(state.restarted(), unmeasured=0, doubtful=False).begun(frame.image, corners)
    starts = state.map.number != number
    return state, Tracked.of(frame, state.map, seen, created=corners, reason=reason, starts=starts)


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
    inertial: Inertial | None = None
    """The readings of an inertial unit beside the camera: then lengths are metres, and the filter
    of the default settings is `INERTIAL`."""
    sighting: TargetObservation | None = field(default=None, init=False)
    """Where the first frame saw the target."""
    filter_name: str = field(init=False)
    """The name in the settings, or the class of your own filter."""
    state: TrackerState = field(init=False, repr=False)
    """All that is known after the latest frame."""

    def __post_init__(self) -> None:
        if not isinstance(self.calibration, Calibration):
            raise ValueError(
                f"calibration must be a Calibration, not a {type(self.calibration).__name__}; "
                "jaxslam.io.read_calibration reads one from a file"
            )
        own, motion = self.filter, None
        if self.inertial is not None:
            motion = self.inertial.imu
            if self.settings.filter == TrackerSettings.filter:
                self.settings = replace(self.settings, filter=INERTIAL)
        settings = self.settings
        self.filter_name = settings.filter if own is None else type(own).__name__
        made = settings.make_filter(self.calibration, motion) if own is None else own
        made = trackable(self.filter_name, made, settings, self.target)
        self.state = start(made, settings, self.calibration, self.inertial)

    def __getattr__(self, name: str):
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
        policy = Policy.of(self.calibration, self.estimator)
        with jax.enable_x64(True):
            for thread in self.estimator.compile(policy.in_wide):
                thread.join()

    def points(self) -> Points:
        """Return all landmarks, those gone included."""
        with jax.enable_x64(True):
            return self.state.points()

    def smoothed(self, history: History) -> tuple[list[Tracked], Points]:
        """Return the frames so far, and all landmarks, as all that was seen later has them: loops
        that closed, and maps that were joined, included (docs/submaps.md)."""
        with jax.enable_x64(True):
            return joined(self.state.joins, *smoothed(self.state, history))

    @property
    def unit(self) -> str:
        """The unit of length, `m` with an inertial unit, else `map`: each map has its own."""
        return "map" if self.inertial is None else "m"

    def camera(self) -> tuple[str, np.ndarray, np.ndarray] | None:
        """Return how the calibration is treated, and fx, fy, cx, cy in pixels, and k1 and k2 of a
        lens that has them, with their covariance, as far as this map tells; None for a filter
        without a pinhole camera."""
        with jax.enable_x64(True):
            return self.estimator.camera(self.state.map.state)

    def biases(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the biases of an inertial unit, gyroscope (rad/s) before accelerometer (m/s²), and
        how much its clock is ahead (s), beside what is known, where that is estimated; and their
        σ."""
        with jax.enable_x64(True):
            return self.estimator.biases(self.state.map.state)

    def save(self, path: str | Path) -> None:
        """Write all that is needed to go on from here (.npz), whole or not at all.

        Raises ValueError before the first frame, when there is nothing to go on from.
        """
        if self.state.time is None:
            raise ValueError("a tracker without any frame has nothing to save")
        own = None if self.filter is None else self.filter_name
        if self.inertial is not None:
            own = f"{self.filter_name} and an inertial unit"
        persistence.save(path, self.state, self.settings, own)

    @classmethod
    def load(
        cls,
        path: str | Path,
        filter: AbstractStaged | None = None,
        inertial: Inertial | None = None,
    ) -> Tracker:
        """The tracker that was saved, which goes on as that would have: digit by digit.

        If it had a `filter` of your own or an inertial unit, pass that again. Raises ValueError for
        a file that is none, or of another filter.
        """
        own = filter is not None or inertial is not None
        return persistence.load(
            path, partial(cls, filter=filter, inertial=inertial), own_filter=own
        )

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
            state = tracker.state.departed()
        joins = tuple(replace(one, step=-1) for one in state.joins)
        tracker.state = replace(
            state,
            joins=joins,
            time=None,
            steps=0,
            unmeasured=1,
            searching=True,
            doubtful=False,
            image=None,
        )
        return tracker
