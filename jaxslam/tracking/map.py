"""What a tracker knows: the map that it is in, those that it may come back to, and what it counts.

All are values: whoever keeps one has it, and whoever goes back goes on from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Int

from jaxslam._runtime.programs import in_background
from jaxslam.filters.protocol import AbstractStaged, Belief
from jaxslam.io.calibration import Calibration
from jaxslam.models.motion import Control
from jaxslam.tracking.estimator import Estimator, Predicted
from jaxslam.tracking.landmarks import Landmark, Landmarks, Points
from jaxslam.tracking.observations import Observations, Slots, joined, only
from jaxslam.tracking.patches import Patch, Picture
from jaxslam.tracking.places.descriptors import with_looks
from jaxslam.tracking.places.submaps import (
    Compared,
    Graph,
    LoopClosure,
    Submap,
    compile_graph,
    handed_over,
)
from jaxslam.tracking.pose_with_covariance import Depths, Pixels
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.unit import Join, MapInWorld, Nearness, nearness

NO_SLOTS = np.zeros(0, int)


KEPT = 8
"""Maps that were left, and are known again."""
MOST = 512
"""Submaps of a map: the last one does not end. Memory and the cost of a loop grow with them."""


@dataclass(frozen=True)
class Map:
    """A map: its landmarks, what the filter knows of them, and where it is in the world."""

    state: Belief
    place: MapInWorld = field(default_factory=MapInWorld)
    landmarks: Landmarks = field(default_factory=dict)
    """Those in the map, by their slot of the state."""
    number: int = 0
    """The number of the map, from 0."""
    submap: int = 0
    """The number of the submap that goes on, counted from 0 through all maps."""
    submaps: tuple[Submap, ...] = ()
    """The submaps that ended."""
    loops: tuple[LoopClosure, ...] = ()
    """The loops that join the submaps."""
    earlier: tuple[Map, ...] = ()
    """The map as it was when each submap had just ended."""

    def graph(self, settings: TrackerSettings, slam: AbstractStaged) -> Graph:
        """Return its submaps and loops, of this filter."""
        numbers = slot_numbers(self.landmarks, settings.capacity)
        present, _ = handed_over(slam, self.state, numbers, self.place.camera, number=self.submap)
        return Graph(slam, self.submaps, present, self.loops, settings.wanted)

    def weighed(self, seen: Observations, settings: TrackerSettings) -> Observations:
        """The table with the variances of landmarks that each have their own noise."""
        factors = [self.landmarks[slot].noise_factor for slot in seen.slots.tolist()]
        variances = settings.noisier(seen.variances, np.array(factors, float))
        return seen._replace(variances=variances)

    def learnt(self, loop: LoopClosure, compared: Compared) -> Map:
        """The map with what a loop says, that ends at the camera."""
        place = self.place.corrected(compared.T_bc, compared.covariance)
        moved = place.camera.T_wc @ np.linalg.inv(self.place.camera.T_wc)
        landmarks = {
            slot: replace(one, first_camera=moved @ one.first_camera)
            for slot, one in self.landmarks.items()
        }
        *before, ended = self.submaps
        submaps, loops = (*before, replace(ended, camera=place.camera)), (*self.loops, loop)
        now = replace(self, place=place, landmarks=landmarks, submaps=submaps, loops=loops)
        *earlier, _ = self.earlier
        return replace(now, earlier=(*earlier, replace(now, earlier=tuple(earlier))))


@dataclass(frozen=True)
class TrackerState:
    """All that a tracker knows after a frame, and goes on from."""

    estimator: Estimator = field(compare=False, repr=False)
    """The filter that takes it on, which is no part of it."""
    calibration: Calibration
    """That of the camera."""
    map: Map
    time: float | None = None
    """The time of the latest frame, s."""
    steps: int = 0
    """Frames given so far."""
    unmeasured: int = 0
    """The latest of them, in a row, in which no landmark was measured."""
    elsewhere: bool = False
    """Whether the map was out of view in one of them."""
    searching: bool = False
    """Whether no map has started because a known one may be found."""
    image: Picture | None = None
    """The latest picture that was used."""
    apart: float = 0.0
    """By how many grey levels, RMS, it is another than the one before it."""
    repeats: int = 0
    """How many that were the same have come since, in a row."""
    waiting: float = 0.0
    """The time that they took, s, which is the next picture's."""
    doubtful: bool = False
    """Whether two motions of the camera were as likely when there were matches last."""
    failed: Mapping[str, int] = field(default_factory=dict)
    """How many updates ended in which `Status` that says that their result means nothing."""
    refused: int = 0
    """Places that looked like earlier ones, and that cannot be these."""
    reversed: int = 0
    """Maps that turned out to lie behind the camera, and were given up."""
    joins: tuple[Join, ...] = ()
    """Maps that turned out to be of one world."""
    restarts: int = 0
    """The greatest number of a map that was measured: of those initialised after the first."""
    latest_submap: int = 0
    """The greatest number of a submap so far."""
    finished: tuple[Points, ...] = ()
    """Landmarks that left their maps."""
    charted: Landmarks = field(default_factory=dict)
    """The landmarks of all submaps that ended, by their numbers, as they were last."""
    seen: Map | None = None
    """The map as it was last seen, while the camera is lost and its unit is fixed."""
    left: tuple[Map, ...] = ()
    """The other maps that were left, the latest last."""

    @property
    def landmarks(self) -> Landmarks:
        """The landmarks in the map, by their slot of the filter's state."""
        return self.map.landmarks

    @property
    def deleted(self) -> int:
        """The number of landmarks that were given up so far."""
        return sum(len(points.numbers) for points in self.finished)

    @property
    def created(self) -> int:
        """The number of landmarks so far."""
        return self.deleted + len(self.landmarks)

    def described(self) -> Landmarks:
        """Return the landmarks of all maps that are known, by their numbers."""
        latest = [one for known in self.known() for one in known.landmarks.values()]
        return {**self.charted, **{one.number: one for one in latest}}

    def known(self) -> list[Map]:
        """Return this map as it was last seen, and those that were left, the latest first."""
        return [*([] if self.seen is None else [self.seen]), *reversed(self.left)]

    def places(self) -> list[Map]:
        """Return the maps that are `known`, and these as each submap of them began."""
        latest = self.known()
        earlier = {id(one): one for known in latest for one in known.earlier[::-1]}
        return [*latest, *earlier.values()]

    def with_map(self, **changes: object) -> TrackerState:
        """The state with another map: this one, but for these of its fields."""
        return replace(self, map=replace(self.map, **changes))

    def points(self) -> Points:
        """Return all landmarks, those gone included."""
        return joined([*self.finished, self._recorded(sorted(self.landmarks))])

    def noted(self, seen: Observations, predicted: Predicted | None = None) -> TrackerState:
        """The state after what was found of the landmarks, where that was `predicted` by how much
        it is off, without those that are searched in vain."""
        landmarks, matched = dict(self.landmarks), seen.labelled("matched")
        if predicted is not None and len(matched.slots):
            innovations = self.estimator.each_given_others(predicted, matched)
            for slot, innovation in zip(matched.slots.tolist(), innovations, strict=True):
                landmarks[slot] = landmarks[slot].compared(innovation)
        landmarks = note_found(landmarks, seen, self.estimator.settings)
        vain = failing(landmarks, self.estimator.settings)
        return self.with_map(landmarks=landmarks).given_up(vain)

    def begun(self, image: Picture, pixels: Pixels, depths: Depths | None = None) -> TrackerState:
        """Landmarks at these pixels begin a map that has none; `depths` as `Estimator`'s."""
        slots = self._free(len(pixels))
        state, report = self.estimator.begin(self.map.state, slots, pixels, depths)
        begun = self.with_map(state=state, place=self.map.place.begun(report))
        return begun._with_new(slots, image, pixels)

    def renewed(
        self, image: Picture, pixels: Pixels, kept: Int[np.ndarray, " n"] = NO_SLOTS
    ) -> TrackerState:
        """The state at the end of the filter's frame, with new landmarks at these pixels, for which
        others than those in the slots `kept` make room."""
        now = self._with_room(len(pixels), kept)
        slots = now._free(len(pixels))
        state, report = self.estimator.renew(now.map.state, slots, pixels)
        now = now.with_map(state=state)
        if gone := [slot for slot in now.landmarks if not report.in_map[slot]]:
            # No point of the world is seen there.
            nowhere = np.full((len(gone), 3), np.nan), np.full((len(gone), 3, 3), np.nan)
            now = now.given_up(gone, now._of(gone, *nowhere))
        found = [one.number for one in now.landmarks.values() if one.found]
        place = now.map.place.followed(report, now._nearness(), found)
        now = now.with_map(place=place)._with_new(slots, image, pixels)
        more = place.unit_fixed and now.seen is None and len(now.map.submaps) < MOST
        return now._handed_over(image) if report.left and more else now

    def _handed_over(self, image: Picture) -> TrackerState:
        """The submap ends at the camera, where this picture was taken."""
        landmarks = with_looks(self.landmarks, image)
        settings, slam, map = self.estimator.settings, self.estimator.slam, self.map
        numbers = slot_numbers(landmarks, settings.capacity)
        ended, state = handed_over(slam, map.state, numbers, map.place.camera, number=map.submap)
        number, submaps = self.latest_submap + 1, (*map.submaps, ended)
        map = replace(map, state=state, landmarks=landmarks, submap=number, submaps=submaps)
        count = len(submaps)
        soon = min(count + count // 3 + 2, MOST)
        in_background(compile_graph(slam, state, settings, soon))
        return replace(
            self,
            map=replace(map, earlier=(*map.earlier, map)),
            latest_submap=number,
            charted={**self.charted, **{one.number: one for one in landmarks.values()}},
        )

    def restarted(self) -> TrackerState:
        """The state without landmarks: another map begins where the camera is. One that was never
        measured is none, and has its number."""
        now = self._abandoned()
        return now._begun_anew(now.map.place.restarted(), number=now.restarts + 1)

    def departed(self) -> TrackerState:
        """The state without landmarks: what comes next is in another world, unless it is known."""
        return self.remembered().restarted().with_map(place=MapInWorld())

    def remembered(self) -> TrackerState:
        """The state in which the map is kept as it was in the frame before this one, in which the
        camera is lost, to come back to it; not while a start is being found out, nor one that was
        never measured."""
        map = self.map
        if self.seen is None and map.place.unit_fixed and map.number <= self.restarts:
            return replace(self, seen=map)
        return self

    def come_back(self, known: Map, found: Map) -> TrackerState:
        """Leave this map for one that was `known`, as it is now that it is `found`.

        Where that is an earlier submap, the next one is of another branch than what came after it,
        which is kept as one more map that was left.
        """
        now = self if known is self.seen else self._abandoned()
        left = tuple(one for one in now.left if one is not known)
        if not any(known is one for one in self.known()):
            number = now.latest_submap + 1
            now = replace(now, latest_submap=number)
            found = replace(found, earlier=(*known.earlier, known), submap=number)
        back = [one.number for one in found.landmarks.values()]
        finished = tuple(only(points, ~np.isin(points.numbers, back)) for points in now.finished)
        return replace(now, map=found, left=left, seen=None, finished=finished)

    def fallen_back(self, predicted: Predicted) -> TrackerState:
        """The state without landmarks by what prediction alone says of the camera: the update had a
        covariance that is not positive. The landmarks are those of the frame before."""
        slots = sorted(self.landmarks)
        recorded = self._recorded(slots)
        return self.coasted(predicted).given_up(slots, recorded)

    def coasted(self, predicted: Predicted) -> TrackerState:
        """The state without a measurement; `anew` where that is broken too."""
        state, correction = self.estimator.correct(predicted)
        if correction.failed:
            return self.anew(predicted.control)
        return self.with_map(state=state)

    def anew(self, control: Control) -> TrackerState:
        """The state with an empty filter: the camera is as far from where it was before the motion
        of this control as the prior on a start's velocity lets it be."""
        place = self.map.place.restarted()
        place = replace(place, log_unit=-place.log_scale)  # an empty state is in metres
        now = self._begun_anew(place, number=self.map.number)
        state, correction = self.estimator.correct(self.estimator.predict(now.map.state, control))
        return now if correction.failed else now.with_map(state=state)

    def given_up(self, slots: list[int], recorded: Points | None = None) -> TrackerState:
        """The state without the landmarks in these slots, of which this is `recorded`."""
        if not slots:
            return self
        gone = self._recorded(slots) if recorded is None else recorded
        landmarks = {slot: one for slot, one in self.landmarks.items() if slot not in slots}
        state = self.estimator.remove(self.map.state, slots)
        map = replace(self.map, state=state, landmarks=landmarks)
        return replace(self, map=map, finished=(*self.finished, gone))

    def _abandoned(self) -> TrackerState:
        """The state without landmarks, and with the map as it was seen last among those left."""
        left = (*self.left, *([] if self.seen is None else [self.seen]))[-KEPT:]
        return replace(self.given_up(sorted(self.landmarks)), left=left, seen=None)

    def _begun_anew(self, place: MapInWorld, number: int) -> TrackerState:
        """A map of this number with the landmarks that there are, and of the rest what an inertial
        unit knows."""
        submap = self.latest_submap + 1
        map = Map(self.estimator.empty(self.map.state), place, self.landmarks, number, submap)
        return replace(self, map=map, latest_submap=submap)

    def _with_room(self, count: int, kept: Int[np.ndarray, " n"]) -> TrackerState:
        """Give up landmarks, except those `kept`, until there are slots for so many new ones."""
        missing = count + len(self.landmarks) - self.estimator.settings.capacity
        if missing <= 0:
            return self
        slots = np.setdiff1d(list(self.landmarks), kept)
        points = self._recorded(slots.tolist())
        some = [self.landmarks[slot] for slot in slots.tolist()]
        worst = worst_first(some, points, self.estimator.settings)[:missing]
        return self.given_up(slots[worst].tolist(), only(points, worst))

    def _free(self, count: int) -> Int[np.ndarray, " n"]:
        """The first free slots."""
        slots = range(self.estimator.settings.capacity)
        return np.array([slot for slot in slots if slot not in self.landmarks][:count], int)

    def _with_new(self, slots: Slots, image: Picture, pixels: Pixels) -> TrackerState:
        """The state with landmarks in these slots, and how near all are, by which the next frame's
        unit is found."""
        first, camera = self.created, self.map.place.camera.T_wc
        landmarks = dict(self.landmarks)
        for number, (slot, pixel) in enumerate(zip(slots.tolist(), pixels, strict=True), first):
            landmarks[slot] = Landmark(number, Patch.take(image, pixel), camera, pixel)
        now = self.with_map(landmarks=landmarks)
        return now.with_map(place=replace(now.map.place, near=now._nearness()))

    def _nearness(self) -> Nearness:
        """Return the nearness of all landmarks, as long as the filter's unit is not fixed."""
        if self.map.place.unit_fixed:
            return {}
        numbers = {slot: one.number for slot, one in self.landmarks.items()}
        return nearness(numbers, self.estimator.points(self.map.state)[0])

    def _recorded(self, slots: list[int]) -> Points:
        return self._of(slots, *(part[slots] for part in self.estimator.points(self.map.state)))

    def _of(self, slots: list[int], points: np.ndarray, covariances: np.ndarray) -> Points:
        numbers = np.array([self.landmarks[slot].number for slot in slots], int)
        maps = np.full_like(numbers, self.map.number)
        submaps = np.full_like(numbers, self.map.submap)
        return Points(numbers, maps, submaps, *self.map.place.points(points, covariances))


def slot_numbers(landmarks: Landmarks, capacity: int) -> Int[np.ndarray, " slots"]:
    """Return the numbers of the landmarks in the slots, −1 for none."""
    numbers = np.full(capacity, -1)
    numbers[list(landmarks)] = [one.number for one in landmarks.values()]
    return numbers


def in_view(
    landmarks: Landmarks, slots: Sequence[int] | np.ndarray, settings: TrackerSettings
) -> Bool[np.ndarray, " k"]:
    """Return which of the slots hold landmarks that are found, but for a few searches at most.

    Only these are among the landmarks wanted, and keep new ones at a distance.
    """
    most = settings.absent_after
    return np.array([s in landmarks and landmarks[s].missed <= most for s in slots], bool)


def note_found(
    landmarks: Landmarks, seen: Observations, settings: TrackerSettings
) -> dict[int, Landmark]:
    """Return the landmarks after a search, that matched some of them.

    That nothing at all was found is the camera's failure, and held against no landmark.
    """
    table = seen.slots.tolist(), seen.matched.tolist(), seen.pixels
    rows = zip(*table, strict=True) if seen.matched.any() else ()
    noted = {s: landmarks[s].searched(ok, at, settings.patience) for s, ok, at in rows}
    return {
        slot: noted.get(slot) or replace(one, unseen=one.unseen + 1)
        for slot, one in landmarks.items()
    }


def failing(landmarks: Landmarks, settings: TrackerSettings) -> list[int]:
    """Slots of landmarks that are searched in vain of late."""
    return [slot for slot, one in landmarks.items() if one.success < settings.least_success]


def worst_first(landmarks: Sequence[Landmark], points: Points, settings: TrackerSettings) -> Slots:
    """The order in which to give up landmarks that are not in view; `points` are theirs.

    First those that are searched in vain, then the others by the time since they were seen, times
    the σ of their place relative to their distance from where they were first seen. Known ones
    are worth more, as they determine the camera when it returns.
    """
    away = np.array([one.missed <= settings.absent_after for one in landmarks], bool)
    unseen = np.array([one.unseen for one in landmarks])
    starts = np.array([one.first_camera[:3, 3] for one in landmarks]).reshape(-1, 3)
    distances = np.linalg.norm(points.points - starts, axis=1)
    with np.errstate(invalid="ignore"):  # at infinity, or of unknown depth
        shares = np.sqrt(np.trace(points.in_map, axis1=1, axis2=2)) / distances
    return np.lexsort((-unseen * np.minimum(np.nan_to_num(shares, nan=1.0), 1.0), away))
