"""The choice of matches to believe: those that agree, are more than chance, and do not
contradict what the map has proven."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.stats import binom

from jaxslam.filters.association import ASSOCIATIONS, Association, one_point_ransac
from jaxslam.io.calibration import Calibration
from jaxslam.tracking.epipolar import MINIMAL, of_one_motion
from jaxslam.tracking.estimator import Predicted
from jaxslam.tracking.landmarks import Landmark
from jaxslam.tracking.map import Map
from jaxslam.tracking.matching import Matches
from jaxslam.tracking.observations import Observations
from jaxslam.tracking.search import search
from jaxslam.tracking.settings import TrackerSettings

LEAST_MATCHES = 4
"""Fewer do not count as having tracked a frame, and are not believed."""
CHANCE = 0.05
"""Of a landmark that is not in the picture to have a match all the same that agrees …"""
BY_CHANCE = 1e-3
"""… and of a frame to be believed although its landmarks are not there."""
ASTRAY = np.radians(10.0)
"""σ of the directions in which landmarks are expected from which on none is believed: one linear
update from there would be wrong, and sure."""
PROVEN = 10
"""A landmark that was found so often is where the map says: one that is then found elsewhere
contradicts it …"""
CONTRADICTED = 0.2
"""… and no frame is believed while more than this share of them do, of at least `PROVEN`, in one
direction: half of the picture may be a lorry's, or the map is wrong. Chance matches have none."""
_LATELY = 3
"""Frames over which that share is an average."""


Agreement = Callable[..., Bool[np.ndarray, " m"]]
"""A filter's judgement of matches by slots and pixels, `Estimator.believes` of one prediction."""


@dataclass
class Policy:
    """Decides which matches of each frame of a map are believed."""

    calibration: Calibration
    settings: TrackerSettings
    ambiguous_start: bool
    """Whether the filter welcomes matches of a start that no linear prediction expects."""
    proven: float = 0.0
    """Proven landmarks found in a frame, on an average of the latest …"""
    elsewhere: float = 0.0
    """… and how many of them were found elsewhere, in one direction."""

    def forget(self) -> None:
        """Begin with a new map."""
        self.proven = self.elsewhere = 0.0

    @property
    def in_wide(self) -> list[Association]:
        """The associations that are tried where ellipses are wide: the quick one first."""
        if not self.ambiguous_start:
            return []
        return list(dict.fromkeys((one_point_ransac, ASSOCIATIONS[self.settings.association])))

    def observed(
        self, image: UInt8[np.ndarray, "h w"], map: Map, predicted: Predicted, *, lost: bool
    ) -> Observations:
        """The landmarks that a picture is searched for, and which matches of them are believed."""
        expected = map.place.expected(predicted.view)
        # One linear update from matches that no linear prediction expects would be wrong, and sure.
        several = self.ambiguous_start
        searched = search(
            image, map.landmarks, expected, self.calibration, self.settings, several=several
        )
        agree = partial(map.estimator.believes, predicted)
        return self.judged(*searched, map.landmarks, agree, lost=lost)

    def judged(
        self,
        seen: Observations,
        matches: Matches,
        landmarks: Mapping[int, Landmark],
        agree: Agreement,
        *,
        lost: bool,
    ) -> Observations:
        """The table with the places that are believed, `matched`, and the first one of each other
        landmark that was found, an `outlier`. A camera that was `lost` needs more of them."""
        rows = len(seen.slots)
        labels = np.full(rows, "unmatched")
        labels[matches.owner] = "outlier"
        if self._astray(seen.covariances):
            return seen._replace(labels=labels)
        least = more_than_chance(rows)
        if lost:
            # A camera that was lost searches ever wider, and something always looks alike.
            least = max(least, rows // 2)
        if len(matches.owner) > len(np.unique(matches.owner)):
            chosen = self._of_several(seen.slots, matches, landmarks, agree, least)
        else:
            chosen = np.flatnonzero(agree(seen.slots[matches.owner], matches.pixels))
        agreed = matches.only(chosen).first_of_each(rows)
        if np.isfinite(agreed[:, 0]).sum() < least:
            agreed[:] = np.nan
        pixels = np.where(np.isfinite(agreed), agreed, matches.first_of_each(rows))
        believed, moved = np.isfinite(agreed[:, 0]), pixels - seen.predicted
        if not self.contradicted([landmarks[slot] for slot in seen.slots], moved, believed):
            labels[believed] = "matched"
        return seen._replace(pixels=pixels, labels=labels)

    def contradicted(
        self,
        landmarks: list[Landmark],
        moved: Float[np.ndarray, "k 2"],
        agree: Bool[np.ndarray, " k"],
    ) -> bool:
        """Return whether too many proven landmarks are found elsewhere than those that agree;
        `moved` is where all were found from where they were expected, NaN of those that were
        not."""
        if agree.any():
            proven = np.array([one.found >= PROVEN for one in landmarks], bool)
            proven &= np.isfinite(moved[:, 0])
            aside = moved[proven & ~agree] - np.median(moved[agree], axis=0)
            directions = aside / np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
            self.proven += (proven.sum() - self.proven) / _LATELY
            alike = float(np.linalg.norm(directions.sum(axis=0)))
            self.elsewhere += (alike - self.elsewhere) / _LATELY
        return bool(self.elsewhere > CONTRADICTED * max(self.proven, PROVEN))

    def _of_several(
        self,
        slots: Int[np.ndarray, " k"],
        matches: Matches,
        landmarks: Mapping[int, Landmark],
        agree: Agreement,
        least: int,
    ) -> Int[np.ndarray, " m"]:
        """Return those that agree, of landmarks with several places each, if they are `least` at
        least.

        Where ellipses are wide, depth and direction make of a prediction what is not linear: those
        that agree but for that, and with one motion, are what a linear test is given. One that puts
        out most of them is not believed: the filter is one of an `ambiguous_start`.
        """
        for association in self.in_wide:
            places = np.flatnonzero(agree(slots[matches.owner], matches.pixels, association))
            some = matches.only(places)
            lately, rigid = self._rigid([landmarks[slots[row]] for row in some.owner], some.pixels)
            tested = places[_alone(some.owner, rigid | ~lately)]
            rigid = np.isin(tested, places[rigid])
            linear = agree(slots[matches.owner[tested]], matches.pixels[tested])
            predictable = 2 * (linear & rigid).sum() >= rigid.sum()
            best = tested[linear if predictable else rigid]
            if len(best) >= least + (0 if predictable else MINIMAL):
                return best
        return np.zeros(0, int)

    def _rigid(
        self, landmarks: list[Landmark], pixels: Float[np.ndarray, "m 2"]
    ) -> tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
        """Return which landmarks were seen when any was seen last, and which of these agree with
        one motion since then."""
        s = self.settings
        unseen = np.array([one.unseen for one in landmarks], int)
        before = np.array([one.seen_at for one in landmarks]).reshape(-1, 2)
        lately = unseen == unseen.min(initial=unseen.max(initial=0))
        rigid = np.zeros_like(lately)
        rigid[lately] = of_one_motion(
            before[lately], pixels[lately], self.calibration, s.tolerance * s.pixel_sigma
        )
        return lately, rigid

    def _astray(self, ellipses: Float[np.ndarray, "k 2 2"]) -> bool:
        """Return whether most landmarks are expected too widely."""
        if not len(ellipses):
            return False
        longest = np.sqrt(np.linalg.eigvalsh(ellipses)[:, -1])
        return bool(np.median(longest) > ASTRAY * self.calibration.fx)


def more_than_chance(searched: int) -> int:
    """Matches of so many landmarks searched that do not agree by chance."""
    return max(LEAST_MATCHES, int(binom.isf(BY_CHANCE, searched, CHANCE)) + 1)


def _alone(owner: Int[np.ndarray, " m"], among: Bool[np.ndarray, " m"]) -> Int[np.ndarray, " n"]:
    """Return those among these whose owner has no other one there."""
    some = np.flatnonzero(among)
    _, of, count = np.unique(owner[some], return_inverse=True, return_counts=True)
    return some[count[of] == 1]
