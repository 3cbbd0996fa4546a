"""The map's upkeep: its landmarks and the filter's slots for them, where they are and which go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Int

from jaxslam._runtime.programs import in_background
from jaxslam.filters.protocol import AbstractStaged, Belief
from jaxslam.tracking.estimator import Estimator, Predicted
from jaxslam.tracking.landmarks import Landmark, Points, joined
from jaxslam.tracking.observations import Observations, Slots
from jaxslam.tracking.patches import Patch, Picture, Pixels
from jaxslam.tracking.places.descriptors import note_looks
from jaxslam.tracking.places.submaps import (
    Compared,
    Graph,
    LoopClosure,
    Submap,
    compile_graph,
    handed_over,
)
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.unit import MapInWorld, Nearness, nearness

NO_SLOTS = np.zeros(0, int)


KEPT = 8
"""Maps that were left, and are known again."""
MOST = 512
"""Submaps of a map: the last one does not end. Memory and the cost of a loop grow with them."""


@dataclass(frozen=True)
class Remembered:
    """A map as it was in the latest frame in which it was seen."""

    number: int
    submap: int
    """The number of the submap that goes on."""
    state: Belief
    landmarks: dict[int, Landmark]
    place: MapInWorld
    submaps: tuple[Submap, ...] = ()
    """The submaps that ended."""
    loops: tuple[LoopClosure, ...] = ()
    """The loops that join the submaps."""
    earlier: tuple[Remembered, ...] = ()
    """The map as it was when each submap had just ended."""

    def graph(self, settings: TrackerSettings, slam: AbstractStaged) -> Graph:
        """Return its submaps and loops, of this filter."""
        numbers = slot_numbers(self.landmarks, settings.capacity)
        present, _ = handed_over(slam, self.state, numbers, self.place.camera, number=self.submap)
        return Graph(slam, self.submaps, present, self.loops, settings.wanted)


@dataclass
class Map:
    """The landmarks of one map after another, beside the filter that estimates them."""

    settings: TrackerSettings
    estimator: Estimator
    place: MapInWorld = field(default_factory=MapInWorld)
    landmarks: dict[int, Landmark] = field(default_factory=dict)
    """Those in the map, by their slot of the state."""
    finished: list[Points] = field(default_factory=list)
    """Those that left it."""
    number: int = 0
    """The number of the map, from 0."""
    latest: int = 0
    """The greatest number so far."""
    seen: Remembered | None = None
    """The map as it was last seen, while the camera is lost and its unit is fixed."""
    left: list[Remembered] = field(default_factory=list)
    """The other maps that were left, the latest last."""
    submap: int = 0
    """The number of the submap, counted from 0 through all maps."""
    latest_submap: int = 0
    """The greatest number of a submap so far."""
    submaps: tuple[Submap, ...] = ()
    """The submaps of this map that ended."""
    loops: tuple[LoopClosure, ...] = ()
    """The loops that join these submaps."""
    earlier: tuple[Remembered, ...] = ()
    """The map as it was when each of these submaps had just ended."""
    charted: dict[int, Landmark] = field(default_factory=dict)
    """The landmarks of all submaps that ended, by their numbers, as they were last."""

    @property
    def deleted(self) -> int:
        """The number of landmarks that were given up so far."""
        return sum(len(points.numbers) for points in self.finished)

    @property
    def created(self) -> int:
        """The number of landmarks so far."""
        return self.deleted + len(self.landmarks)

    def points(self) -> Points:
        """Return all landmarks, those gone included."""
        return joined([*self.finished, self._recorded(sorted(self.landmarks))])

    def described(self) -> dict[int, Landmark]:
        """Return the landmarks of all maps that are known, by their numbers."""
        latest = [one for known in self.known() for one in known.landmarks.values()]
        return self.charted | {one.number: one for one in latest}

    def weighed(self, seen: Observations) -> Observations:
        """The table with the variances of landmarks that each have their own noise."""
        factors = [self.landmarks[slot].noise_factor for slot in seen.slots.tolist()]
        variances = self.settings.noisier(seen.variances, np.array(factors, float))
        return seen._replace(variances=variances)

    def note(self, seen: Observations, predicted: Predicted | None = None) -> None:
        """Note what was found of the landmarks, where that was `predicted` by how much it is off,
        and give up those that are searched in vain."""
        matched = seen.labelled("matched")
        if predicted is not None and len(matched.slots):
            innovations = self.estimator.each_given_others(predicted, matched)
            for slot, innovation in zip(matched.slots.tolist(), innovations, strict=True):
                self.landmarks[slot].compared(innovation)
        note_found(self.landmarks, seen, self.settings)
        self.give_up(failing(self.landmarks, self.settings))

    def begin(
        self, image: Picture, pixels: Pixels, depths: tuple[np.ndarray, np.ndarray] | None = None
    ) -> None:
        """Begin with landmarks at these pixels, a map that has none; `depths` as `Estimator`'s."""
        slots = self._free(len(pixels))
        self.place.begin(self.estimator.begin(slots, pixels, depths))
        self._add(slots, image, pixels)

    def renew(self, image: Picture, pixels: Pixels, kept: Int[np.ndarray, " n"] = NO_SLOTS) -> None:
        """New landmarks at these pixels, for which others than those in the slots `kept` make room.
        Ends the filter's frame."""
        self._make_room(len(pixels), kept)
        slots = self._free(len(pixels))
        report = self.estimator.renew(slots, pixels)
        if gone := [slot for slot in self.landmarks if not report.in_map[slot]]:
            self.give_up(gone, self._nowhere(gone))
        found = [one.number for one in self.landmarks.values() if one.found]
        self.place.follow(report, self._nearness(), found)
        self._add(slots, image, pixels)
        more = self.place.unit_fixed and self.seen is None and len(self.submaps) < MOST
        if report.left and more:
            self._hand_over(image)

    def _hand_over(self, image: Picture) -> None:
        """End the submap at the camera, where this picture was taken."""
        note_looks(self.landmarks.values(), image)
        estimator, numbers = self.estimator, slot_numbers(self.landmarks, self.settings.capacity)
        ended, state = handed_over(
            estimator.slam, estimator.state, numbers, self.place.camera, number=self.submap
        )
        estimator.state = state
        self.submaps = (*self.submaps, ended)
        self._begin_submap()
        self.earlier = (*self.earlier, self.now())
        self.charted |= {one.number: replace(one) for one in self.landmarks.values()}
        count = len(self.submaps)
        soon = min(count + count // 3 + 2, MOST)
        in_background(compile_graph(estimator.slam, state, self.settings, soon))

    def learn(self, loop: LoopClosure, compared: Compared) -> None:
        """Take over what a loop says, that ends at the camera."""
        self.loops = (*self.loops, loop)
        moved = self.place.correct(compared.T_bc, compared.covariance)
        for one in self.landmarks.values():
            one.first_camera = moved @ one.first_camera
        *before, ended = self.submaps
        self.submaps = (*before, replace(ended, camera=self.place.camera))
        self.earlier = (*self.earlier[:-1], replace(self.now(), earlier=self.earlier[:-1]))

    def _begin_submap(self) -> None:
        """Give a number to the submap that begins."""
        self.latest_submap += 1
        self.submap = self.latest_submap

    def restart(self) -> None:
        """Give up all landmarks: another map begins where the camera is."""
        self.give_up(sorted(self.landmarks))
        self._keep()
        self.latest += 1
        self.number = self.latest
        self.place.restart()
        self._begin_chain()

    def leave(self) -> None:
        """Give up all landmarks: what comes next is in another world, unless it is known."""
        self.remember()
        self.restart()
        self.place = MapInWorld()

    def _keep(self) -> None:
        """Keep the map as it was last seen among those that were left."""
        if self.seen is not None:
            self.left = [*self.left, self.seen][-KEPT:]
        self.seen = None

    def remember(self) -> None:
        """Note the map as it was in the frame before this one, in which the camera is lost, to come
        back to it; not while a start is being found out."""
        if self.seen is None and self.place.unit_fixed:
            self.seen = self.now()

    def now(self) -> Remembered:
        """Return the map as it is."""
        kept = {slot: replace(one) for slot, one in self.landmarks.items()}
        place, state = replace(self.place), self.estimator.state
        chain = self.submaps, self.loops, self.earlier
        return Remembered(self.number, self.submap, state, kept, place, *chain)

    def known(self) -> list[Remembered]:
        """Return this map as it was last seen, and those that were left, the latest first."""
        return [*([] if self.seen is None else [self.seen]), *reversed(self.left)]

    def places(self) -> list[Remembered]:
        """Return the maps that are `known`, and these as each submap of them began."""
        latest = self.known()
        earlier = {id(one): one for known in latest for one in known.earlier[::-1]}
        return [*latest, *earlier.values()]

    def become(self, known: Remembered) -> None:
        """Be the map that was remembered."""
        self.number, self.submap, self.estimator.state = known.number, known.submap, known.state
        self.landmarks = {slot: replace(one) for slot, one in known.landmarks.items()}
        self.place = replace(known.place)
        self.submaps, self.loops, self.earlier = known.submaps, known.loops, known.earlier

    def come_back(self, known: Remembered, found: Remembered) -> None:
        """Leave this map for one that was `known`, as it is now that it is `found`.

        Where that is an earlier submap, the next one is of another branch than what came after it,
        which is kept as one more map that was left.
        """
        latest = any(known is one for one in self.known())
        if known is not self.seen:
            self.give_up(sorted(self.landmarks))
            self._keep()
        self.left = [one for one in self.left if one is not known]
        self.become(found)
        if not latest:
            self.earlier = (*known.earlier, known)
            self._begin_submap()
        self.seen = None
        back = [one.number for one in found.landmarks.values()]
        self.finished = [points.only(~np.isin(points.numbers, back)) for points in self.finished]

    def _begin_chain(self) -> None:
        """Begin with nothing."""
        self._begin_submap()
        self.submaps, self.loops, self.earlier = (), (), ()
        self.estimator.clear()

    def fall_back(self, predicted: Predicted) -> None:
        """Give up all landmarks and go on by what prediction alone says of the camera: the update
        had a covariance that is not positive. The landmarks are those of the frame before."""
        slots = sorted(self.landmarks)
        recorded = self._recorded(slots)
        self.coast(predicted)
        self.give_up(slots, recorded)

    def coast(self, predicted: Predicted) -> None:
        """Go on without a measurement. Where that is broken too, the camera is as far from where it
        was last as the prior on a start's velocity lets it be."""
        if self.estimator.correct(predicted).failed:
            self.place.restart()
            self.place.log_unit = -self.place.log_scale  # its state is empty: in metres
            self._begin_chain()
            self.estimator.correct(self.estimator.predict(predicted.dt))

    def give_up(self, slots: list[int], recorded: Points | None = None) -> None:
        """Take landmarks out of the map, of which this is `recorded`."""
        if slots:
            self.finished.append(self._recorded(slots) if recorded is None else recorded)
            for slot in slots:
                del self.landmarks[slot]
            self.estimator.remove(slots)

    def measure_unit(self) -> None:
        """Note how near the landmarks are now, by which the next frame's unit is found."""
        self.place.near = self._nearness()

    def _make_room(self, count: int, kept: Int[np.ndarray, " n"]) -> None:
        """Give up landmarks, except those `kept`, until there are slots for so many new ones."""
        missing = count + len(self.landmarks) - self.settings.capacity
        if missing <= 0:
            return
        slots = np.setdiff1d(list(self.landmarks), kept)
        points = self._recorded(slots.tolist())
        worst = worst_first([self.landmarks[slot] for slot in slots], points, self.settings)
        self.give_up(slots[worst[:missing]].tolist(), points.only(worst[:missing]))

    def _free(self, count: int) -> Int[np.ndarray, " n"]:
        """The first free slots."""
        free = [slot for slot in range(self.settings.capacity) if slot not in self.landmarks]
        return np.array(free[:count], int)

    def _add(self, slots: Slots, image: Picture, pixels: Pixels) -> None:
        first, camera = self.created, self.place.camera.T_wc
        for number, (slot, pixel) in enumerate(zip(slots.tolist(), pixels, strict=True), first):
            self.landmarks[slot] = Landmark(number, Patch.take(image, pixel), camera, pixel)
        self.measure_unit()

    def _nearness(self) -> Nearness:
        """Return the nearness of all landmarks, as long as the filter's unit is not fixed."""
        if self.place.unit_fixed:
            return {}
        numbers = {slot: one.number for slot, one in self.landmarks.items()}
        return nearness(numbers, self.estimator.points()[0])

    def _nowhere(self, slots: list[int]) -> Points:
        """Landmarks that the filter gave up, since no point of the world is seen there."""
        n = len(slots)
        return self._of(slots, np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan))

    def _recorded(self, slots: list[int]) -> Points:
        return self._of(slots, *(part[slots] for part in self.estimator.points()))

    def _of(self, slots: list[int], points: np.ndarray, covariances: np.ndarray) -> Points:
        numbers = np.array([self.landmarks[slot].number for slot in slots], int)
        maps = np.full_like(numbers, self.number)
        submaps = np.full_like(numbers, self.submap)
        return Points(numbers, maps, submaps, *self.place.points(points, covariances))


def slot_numbers(landmarks: Mapping[int, Landmark], capacity: int) -> Int[np.ndarray, " slots"]:
    """Return the numbers of the landmarks in the slots, −1 for none."""
    numbers = np.full(capacity, -1)
    numbers[list(landmarks)] = [one.number for one in landmarks.values()]
    return numbers


def in_view(
    landmarks: Mapping[int, Landmark], slots: Sequence[int] | np.ndarray, settings: TrackerSettings
) -> Bool[np.ndarray, " k"]:
    """Return which of the slots hold landmarks that are found, but for a few searches at most.

    Only these are among the landmarks wanted, and keep new ones at a distance.
    """
    most = settings.absent_after
    return np.array([s in landmarks and landmarks[s].missed <= most for s in slots], bool)


def note_found(
    landmarks: Mapping[int, Landmark], seen: Observations, settings: TrackerSettings
) -> None:
    """Note which of the landmarks searched were matched, and where.

    That nothing at all was found is the camera's failure, and held against no landmark.
    """
    for landmark in landmarks.values():
        landmark.unseen += 1
    if seen.matched.any():
        for slot, ok, pixel in zip(seen.slots, seen.matched, seen.pixels, strict=True):
            landmarks[slot].searched(bool(ok), pixel, settings.patience)


def failing(landmarks: Mapping[int, Landmark], settings: TrackerSettings) -> list[int]:
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
