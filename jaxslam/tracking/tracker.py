"""The tracker: a filter fed with pictures, frame by frame, by active search."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import jax
import numpy as np

from jaxslam.filters.protocol import AbstractStaged
from jaxslam.io.calibration import Calibration
from jaxslam.io.pictures import as_grey
from jaxslam.io.source import Frame, check_size
from jaxslam.models.observations import Status
from jaxslam.tracking import persistence
from jaxslam.tracking.corners import bare_corners
from jaxslam.tracking.estimator import Correction, Estimator
from jaxslam.tracking.landmarks import Landmark, Points
from jaxslam.tracking.map import Map, in_view
from jaxslam.tracking.observations import NOTHING, Lost, Observations
from jaxslam.tracking.places.closing import close_loop
from jaxslam.tracking.places.descriptors import note_looks
from jaxslam.tracking.places.joining import LOOKED_EVERY, Join, join_of, joined, known_elsewhere
from jaxslam.tracking.places.relocalisation import NOTED_EVERY, known_again
from jaxslam.tracking.places.smoothing import smoothed
from jaxslam.tracking.policy import JERK, LEAST_MATCHES, Policy
from jaxslam.tracking.report import Tracked
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.start import trackable, with_target
from jaxslam.tracking.target import Target, TargetObservation


@dataclass
class Tracker:
    """Tracks a camera: `step(image, time)` or `track(frame)` for each frame of a video, in order.

    A camera that is lost moves as the filter predicts. One lost for long, or a filter whose
    covariance is not positive any more, begins a new map where the picture has the corners for
    it: exactly known in its own frame, and in the world as surely as its start is. Its unit of
    length is another, which no covariance here knows of. Within a map there is one unit, whatever
    the filter makes of the scale meanwhile (docs/gauge.md).

    The mutable part is this object and its pieces; all mathematics is in pure, jitted functions of
    the filter's state. Raises ValueError for a filter that cannot track, or cannot begin with the
    target.
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
    time: float | None = field(default=None, init=False)
    """The time of the latest frame, s."""
    steps: int = field(default=0, init=False)
    """Frames given so far."""
    unmeasured: int = field(default=0, init=False)
    """The latest of them, in a row, in which no landmark was measured."""
    elsewhere: bool = field(default=False, init=False)
    """Whether the map was out of view in one of them."""
    searching: bool = field(default=False, init=False)
    """Whether no map has started because a known one may be found."""
    failed: Counter[str] = field(default_factory=Counter, init=False)
    """How many updates ended in which `Status` that says that their result means nothing."""
    refused: int = field(default=0, init=False)
    """Places that looked like earlier ones, and that cannot be these."""
    reversed: int = field(default=0, init=False)
    """Maps that turned out to lie behind the camera, and were given up."""
    joins: tuple[Join, ...] = field(default=(), init=False)
    """Maps that turned out to be of one world."""
    map: Map = field(init=False, repr=False)
    """Its landmarks and where it is in the world."""
    policy: Policy = field(init=False, repr=False)
    """Which matches are believed."""

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
        self.policy = Policy(self.calibration, settings, made.ambiguous_start)
        with jax.enable_x64(True):
            self.map = Map(settings, Estimator(made, settings))

    @property
    def landmarks(self) -> dict[int, Landmark]:
        """The landmarks in the map, by their slot of the filter's state."""
        return self.map.landmarks

    @property
    def created(self) -> int:
        """The number of landmarks so far."""
        return self.map.created

    @property
    def deleted(self) -> int:
        """The number of landmarks that were given up."""
        return self.map.deleted

    @property
    def restarts(self) -> int:
        """The number of maps initialised after the first."""
        return self.map.latest

    def track(self, frame: Frame) -> Tracked:
        """Predict, search, update, and renew the map. Raises ValueError, and changes nothing, for
        a frame of another size than the calibration's, or not later than the one before."""
        check_size(f"frame {frame.index}", frame.image, self.calibration)
        before = -np.inf if self.time is None else self.time
        if not before < frame.time < np.inf:
            raise ValueError(
                f"frame {frame.index}: its time, {frame.time} s, is not later than that of the "
                f"previous frame, {before} s"
            )
        with jax.enable_x64(True):
            tracked = self._first(frame) if self.time is None else self._next(frame, self.time)
        self.time = frame.time
        self.steps += 1
        return tracked

    def step(self, image: np.ndarray, time: float) -> Tracked:
        """`track` a picture taken at `time` (s): grey, or in colour in OpenCV's order (BGR), uint8
        or floats from 0 to 1."""
        return self.track(Frame(self.steps, float(time), as_grey(image)))

    def compile(self) -> None:
        """Compile all programs now; else the first frames wait for it, and a camera does not."""
        with jax.enable_x64(True):
            for thread in self.map.estimator.compile(self.policy.in_wide):
                thread.join()

    def points(self) -> Points:
        """Return all landmarks, those gone included."""
        with jax.enable_x64(True):
            return self.map.points()

    def smoothed(self, history: Sequence[Tracked]) -> tuple[list[Tracked], Points]:
        """Return the frames so far, and all landmarks, as all that was seen later has them: loops
        that closed, and maps that were joined, included (docs/submaps.md)."""
        with jax.enable_x64(True):
            return joined(self.joins, *smoothed(self.map, history))

    def camera(self) -> tuple[str, np.ndarray, np.ndarray] | None:
        """Return how the calibration is treated, and fx, fy, cx, cy with their covariance, pixels,
        as far as this map tells; None for a filter without a pinhole camera."""
        with jax.enable_x64(True):
            return self.map.estimator.camera()

    def save(self, path: str | Path) -> None:
        """Write all that is needed to go on from here (.npz), whole or not at all.

        Raises ValueError before the first frame, when there is nothing to go on from.
        """
        if self.time is None:
            raise ValueError("a tracker without any frame has nothing to save")
        persistence.save(path, self, None if self.filter is None else self.filter_name)

    @classmethod
    def load(cls, path: str | Path, filter: AbstractStaged | None = None) -> Tracker:
        """The tracker that was saved, which goes on as that would have: digit by digit.

        If it had a `filter` of your own, pass that again. Raises ValueError for a file
        that is none, or of another filter.
        """
        return persistence.load(path, partial(cls, filter=filter), own_filter=filter is not None)

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
            tracker.map.leave()
        tracker.time, tracker.steps, tracker.unmeasured = None, 0, 1
        tracker.searching = True
        tracker.joins = tuple(replace(one, step=-1) for one in tracker.joins)
        tracker.policy.forget()
        return tracker

    def _searching(self, frame: Frame) -> Tracked:
        """Look for a map that is known; begin another where there was none for long."""
        found = known_again(frame.image, self.map, self.policy)
        if found is not None:
            return self._back(frame, *found)
        self.unmeasured += 1
        corners = bare_corners(frame.image, self.settings)
        if self.unmeasured <= self.settings.lost_for or len(corners) < LEAST_MATCHES:
            return Tracked.of(frame, self.map, reason=Lost.NOTHING_EXPECTED)
        self.map.begin(frame.image, corners)
        self.unmeasured, self.searching = 0, False
        return Tracked.of(frame, self.map, created=corners, starts=True)

    def _first(self, frame: Frame) -> Tracked:
        """Begin the first map with the first frame."""
        self.map.estimator.compile(self.policy.in_wide)
        if self.searching:
            return self._searching(frame)
        pixels, depths = bare_corners(frame.image, self.settings), None
        if self.target is not None:
            self.sighting, pixels, depths = with_target(
                self.target, frame.image, pixels, self.calibration, self.settings
            )
        self.map.begin(frame.image, pixels, depths)
        return Tracked.of(frame, self.map, created=pixels, starts=True)

    def _next(self, frame: Frame, before: float) -> Tracked:
        """Track a frame after one of the time `before`."""
        if self.searching:
            return self._searching(frame)
        last = self.map.place.camera.T_wc
        predicted = self.map.estimator.predict(frame.time - before)
        ahead, behind = predicted.view.sides
        if behind > ahead and behind >= LEAST_MATCHES:
            self.reversed += 1
            self.map.seen = None  # nobody is to come back to it
            self.map.coast(predicted)
            return self._lost(frame, Lost.REVERSED)
        lost, policy = self.unmeasured > 0, replace(self.policy)
        seen, reason = self.policy.observed(frame.image, self.map, predicted, lost=lost)
        if not lost and self.map.place.unit_fixed:
            jerked = self.map.estimator.predict(predicted.dt, JERK)
            if reason is not None or self.map.estimator.likelier(jerked, predicted, seen):
                found, why = policy.observed(frame.image, self.map, jerked, lost=lost)
                if why is None:
                    self.policy, predicted, seen, reason = policy, jerked, found, None
        if reason is not None:
            self.map.remember()
        # Of two motions that contradict each other a place that is known says no more: it is one of
        # both.
        self.elsewhere |= reason in (Lost.NOTHING_EXPECTED, Lost.FEW_AGREE)
        self.elsewhere &= reason is not None
        if self.elsewhere and self.unmeasured:
            found = known_again(frame.image, self.map, self.policy)
            if found is not None:
                return self._back(frame, *found)
        seen = self.map.weighed(seen)
        correction = self.map.estimator.correct(predicted, seen)
        if correction.failed:
            self.map.remember()
            self.failed[Status(int(correction.status)).name.lower()] += 1
            self.map.fall_back(predicted)
            return self._lost(frame, Lost.NOT_POSITIVE)
        seen = seen.but_for(correction.used)
        self.map.note(seen, predicted)
        if reason is None and not seen.matched.any():
            reason = Lost.REFUSED
        self.unmeasured = 0 if reason is None else self.unmeasured + 1
        if reason is None:
            self.map.seen = None
        if not self.landmarks or self.unmeasured > self.settings.lost_for:
            return self._lost(frame, reason or Lost.NOTHING_EXPECTED, seen)
        kept = in_view(self.landmarks, seen.slots, self.settings)
        # What a lost camera sees may be another place: it is not put into this map.
        created = np.zeros((0, 2))
        if reason is None:
            created = bare_corners(frame.image, self.settings, seen.places[kept])
        ended = len(self.map.submaps)
        self.map.renew(frame.image, created, seen.slots[kept])
        if reason is None and self.steps % LOOKED_EVERY == 0:
            found = known_elsewhere(frame.image, self.map, self.policy, self.joins)
            if found is not None:
                return self._joined(frame, last, *found)
        closed = None
        if len(self.map.submaps) > ended:
            closed = close_loop(frame.image, self.map, self.calibration)
            self.refused += closed is not None and not closed.believed
        if reason is None and self.steps % NOTED_EVERY == 0:
            note_looks(self.landmarks.values(), frame.image)
        nis, nis_dof = float(correction.nis), int(correction.nis_dof)
        found = {"nis": nis, "nis_dof": nis_dof, "reason": reason}
        if closed is not None and closed.believed:
            found["loop"] = closed.submap
        return Tracked.of(frame, self.map, seen, created=created, **found)

    def _joined(
        self, frame: Frame, last: np.ndarray, seen: Observations, correction: Correction
    ) -> Tracked:
        """Go on in another map, which this one is joined to; `last` is T of the camera before."""
        before = self.map.left[-1]
        tracked = self._back(frame, seen, correction)
        join = join_of(before, self.map, self.steps, last)
        self.joins += () if join is None else (join,)
        return tracked

    def _back(self, frame: Frame, seen: Observations, correction: Correction) -> Tracked:
        """Go on in a map in which the camera was found again."""
        self.map.note(seen)
        self.map.renew(frame.image, np.zeros((0, 2)))
        self.map.estimator.at_rest()
        self.unmeasured, self.searching = 0, False
        self.policy.forget()
        nis, nis_dof = float(correction.nis), int(correction.nis_dof)
        return Tracked.of(frame, self.map, seen, nis=nis, nis_dof=nis_dof, relocalised=True)

    def _lost(self, frame: Frame, reason: Lost, seen: Observations = NOTHING) -> Tracked:
        """Begin a new map at the camera as it is predicted, or wait for a picture with corners."""
        corners = bare_corners(frame.image, self.settings)
        self.map.renew(frame.image, corners[:0])
        if len(corners) < LEAST_MATCHES:
            return Tracked.of(frame, self.map, seen, reason=reason)
        self.map.restart()
        self.map.begin(frame.image, corners)
        self.unmeasured = 0
        self.policy.forget()
        return Tracked.of(frame, self.map, seen, created=corners, reason=reason, starts=True)
