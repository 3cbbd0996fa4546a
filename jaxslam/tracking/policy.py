"""The choice of matches to believe: those that agree, are more than chance, and do not
contradict what the map has proven."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import binom, chi2

from jaxslam.filters.association import ASSOCIATIONS, Association, one_point_ransac
from jaxslam.io.calibration import Calibration
from jaxslam.tracking.epipolar import MINIMAL, of_one_motion
from jaxslam.tracking.estimator import Estimator, Predicted
from jaxslam.tracking.landmarks import Landmark, Landmarks
from jaxslam.tracking.map import TrackerState
from jaxslam.tracking.matching import GATE, Matches
from jaxslam.tracking.observations import Lost, Observations, Prediction, Slots, distances, only
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.search import search
from jaxslam.tracking.settings import TrackerSettings

LEAST_MATCHES = 4
"""Fewer do not count as having tracked a frame, and are not believed."""
CHANCE = 0.05
"""The probability that a landmark that is not in the picture has a match that agrees."""
CHANCE_LOST = 0.25
"""The probability of such a match where the camera was lost and is searched for widely."""
BY_CHANCE = 1e-3
"""The probability that a frame is believed although its landmarks are not there."""
WIDE = 6.0
"""σ of the predicted pixels of most landmarks from which on they are searched twice, the second
time given what agreed, pixels."""
PROVEN = 10
"""The number of matches after which a landmark is proven. The others are believed only if together
they are likely, given the proven ones."""
TOGETHER = 0.01
"""The least likelihood of all landmarks together. No frame is believed where the proven ones are
less likely than `BY_CHANCE`."""
MOST = 2 / 3
"""The share of the proven landmarks searched that must agree before a frame after such a one is
believed."""
MISFIT = (0.7 / 6) ** 2
"""The variance from which on a window fits badly if it is also four times the median, pixels²: of
first matches that do, a quarter were more than 2 pixels off, of others 1 % (docs/sequences.md).
Where nothing is proven yet, nothing contradicts them."""
JERK = 4.0
"""σ of the accelerations of a camera that is jerked, in that of others: motions have tails."""
LIVELY = 20.0
"""The fall of NIS that makes a livelier prediction likelier: one of four times the σ in six
directions has log det S larger by at most 12 log 4 = 17."""


Agreement = Callable[..., Bool[np.ndarray, " m"]]
"""A filter's judgement of matches and their slots, `Estimator.believes` of one prediction."""
Surprise = Callable[[Observations], tuple[float, int]]
"""NIS of what was seen and its degrees of freedom, `Estimator.nis` of one prediction."""


@dataclass(frozen=True)
class Policy:
    """Decides which matches of each frame of a map are believed."""

    calibration: Calibration
    settings: TrackerSettings
    ambiguous_start: bool
    """Whether the filter welcomes matches of a start that no linear prediction expects."""

    @classmethod
    def of(cls, calibration: Calibration, estimator: Estimator) -> Policy:
        """That of a filter and its settings."""
        return cls(calibration, estimator.settings, estimator.slam.ambiguous_start)

    @property
    def in_wide(self) -> list[Association]:
        """The associations that are tried where ellipses are wide: the quick one first."""
        if not self.ambiguous_start:
            return []
        return list(dict.fromkeys((one_point_ransac, ASSOCIATIONS[self.settings.association])))

    def observed(
        self, image: Picture, state: TrackerState, predicted: Predicted, *, lost: bool
    ) -> tuple[Observations, Lost | None, bool]:
        """The landmarks that a picture is searched for, and which matches of them are believed; or
        why none are; and whether another motion is as likely. What was known before the search is
        what the table says of each."""
        map, estimator, doubtful = state.map, state.estimator, state.doubtful
        expected = map.place.expected(predicted.view)
        look = partial(search, image, map.landmarks)
        # One linear update from matches that no linear prediction expects would be wrong, and sure.
        searched = look(expected, self.calibration, self.settings, several=self.ambiguous_start)
        agree = partial(estimator.believes, predicted)
        seen = self.agreeing(*searched, map.landmarks, agree, lost=lost)
        if seen.matched.any() and _sigma(seen.covariances) > WIDE:
            given = estimator.given(predicted, seen.labelled("matched"))
            closer = self._closer(seen, map.place.expected(given))
            if _explained(seen, closer):
                searched = look(closer, self.calibration, self.settings, several=False)
                again = self.agreeing(*searched, map.landmarks, agree, lost=lost)
                seen = again if again.matched.any() else seen
        nis = partial(estimator.nis, predicted)
        if not self._likely_given_proven(seen, map.landmarks, nis):
            of_proven = partial(_of_proven, map.landmarks, agree)
            seen = self.agreeing(*searched, map.landmarks, of_proven, lost=lost)
        reason, doubtful = self.reason(seen, map.landmarks, agree, nis, doubtful=doubtful)
        if reason is not None:
            seen = seen._replace(labels=np.where(seen.matched, "outlier", seen.labels))
        prior = expected.pixels[seen.slots], expected.covariances[seen.slots]
        return seen._replace(predicted=prior[0], covariances=prior[1]), reason, doubtful

    def agreeing(
        self,
        seen: Observations,
        matches: Matches,
        landmarks: Landmarks,
        agree: Agreement,
        *,
        lost: bool,
    ) -> Observations:
        """The table with the places that agree, `matched`, and the first one of each other
        landmark that was found, an `outlier`. A camera that was `lost` needs more of them."""
        rows = len(seen.slots)
        labels = np.full(rows, "unmatched")
        labels[matches.owner] = "outlier"
        # A camera that was lost searches ever wider, and something always looks alike.
        least, found = more_than_chance(rows), len(np.unique(matches.owner))
        least = max(least, more_than_chance(found, CHANCE_LOST)) if lost else least
        if len(matches.owner) > found:
            chosen = self._of_several(seen.slots, matches, landmarks, agree, least)
        else:
            chosen = np.flatnonzero(agree(seen.slots[matches.owner], matches))
        agreed, variances = only(matches, chosen).first_of_each(rows)
        believed = np.isfinite(agreed[:, 0])
        fits = variances <= max(MISFIT, 4 * np.median(variances[believed] if chosen.size else 0))
        found_before = np.array([landmarks[slot].found for slot in seen.slots], int)
        believed &= fits | (found_before > 0) | (found_before.max(initial=0) >= PROVEN)
        if believed.sum() < least:
            believed[:] = False
        labels[believed] = "matched"
        first, others = matches.first_of_each(rows)
        pixels = np.where(believed[:, None], agreed, first)
        variances = np.where(believed, variances, others)
        return seen._replace(pixels=pixels, variances=variances, labels=labels)

    def _closer(self, seen: Observations, given: Prediction) -> Prediction:
        """Return the prediction given what is matched, as far as it is to be trusted."""
        # To first order a turn moves all pixels alike; to second, by its square / 2f more.
        turned = np.median(seen.pixels[seen.matched] - seen.predicted[seen.matched], axis=0)
        # σ of that second search beside what is still unknown then, pixels.
        sigma = 1.5 + turned @ turned / (2 * self.calibration.fx)
        return given._replace(covariances=given.covariances + sigma**2 * np.eye(2))

    def _likely_given_proven(self, seen: Observations, landmarks: Landmarks, nis: Surprise) -> bool:
        """Return whether what is matched of landmarks that are not proven is likely, all together,
        given what is matched of those that are: each by itself may be within its gate, and all of
        them be moved alike."""
        matched = seen.labelled("matched")
        whole, dof = nis(matched)
        old, known = nis(only(matched, proven(matched.slots, landmarks)))
        asked = 2 * LEAST_MATCHES <= known < dof
        return not asked or bool(chi2.sf(whole - old, dof - known) > TOGETHER)

    def reason(
        self,
        seen: Observations,
        landmarks: Landmarks,
        agree: Agreement,
        nis: Surprise,
        *,
        doubtful: bool = False,
    ) -> tuple[Lost | None, bool]:
        """Return why nothing of a table is believed, if so, and whether another motion is as
        likely, which it may have been before (`doubtful`)."""
        if not len(seen.slots):
            return Lost.NOTHING_EXPECTED, doubtful
        if not seen.matched.any():
            return Lost.FEW_AGREE, doubtful
        known = only(seen, proven(seen.slots, landmarks))
        agreed = known.labelled("matched")
        few = len(agreed.slots) <= MOST * len(known.slots)
        another = self._another(known.labelled("outlier"), len(agreed.slots), agree)
        doubtful = another or (doubtful and few)
        wrong = doubtful or chi2.sf(*nis(agreed)) < BY_CHANCE
        return Lost.CONTRADICTED if wrong else None, doubtful

    def _another(self, others: Observations, agreed: int, agree: Agreement) -> bool:
        """Return whether most of these, and many beside those that `agreed`, do so with another
        motion of the camera: then it cannot be told which is the world's."""
        rows = np.arange(len(others.slots))
        # The share of those that agree from which on as many that agree with another motion refute
        # a frame: half of the picture may be a lorry's, or the map is wrong.
        least = max(MOST * len(rows), (1 / 3) * agreed, LEAST_MATCHES)
        if len(rows) < least:
            return False
        matches = Matches(rows, others.pixels, np.ones(len(rows), np.float32), others.variances)
        return bool(agree(others.slots, matches).sum() >= least)

    def _of_several(
        self, slots: Slots, matches: Matches, landmarks: Landmarks, agree: Agreement, least: int
    ) -> Int[np.ndarray, " m"]:
        """Return those that agree, of landmarks with several places each, if they are `least` at
        least.

        Where ellipses are wide, depth and direction make of a prediction what is not linear: those
        that agree but for that, and with one motion, are what a linear test is given. One that puts
        out most of them is not believed: the filter is one of an `ambiguous_start`.
        """
        for association in self.in_wide:
            places = np.flatnonzero(agree(slots[matches.owner], matches, association))
            some = only(matches, places)
            lately, rigid = self._rigid([landmarks[slots[row]] for row in some.owner], some.pixels)
            tested = places[_alone(some.owner, rigid | ~lately)]
            rigid = np.isin(tested, places[rigid])
            linear = agree(slots[matches.owner[tested]], only(matches, tested))
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


def _sigma(ellipses: Float[np.ndarray, "k 2 2"]) -> float:
    """Return how widely most landmarks are expected: the median of the ellipses' longer σ,
    pixels."""
    return float(np.median(np.sqrt(np.linalg.eigvalsh(ellipses)[:, -1])))


def _explained(seen: Observations, given: Prediction) -> bool:
    """Return whether a linear prediction given what is believed explains most of that."""
    slots = seen.slots[seen.matched]
    off = seen.pixels[seen.matched] - given.pixels[slots]
    # The share that a linear prediction must explain for that second search.
    return bool(np.mean(distances(off, given.covariances[slots]) < GATE) > 0.8)


def more_than_chance(searched: int, chance: float = CHANCE) -> int:
    """Matches of so many landmarks searched that do not agree by chance."""
    return max(LEAST_MATCHES, int(binom.isf(BY_CHANCE, searched, chance)) + 1)


def _alone(owner: Int[np.ndarray, " m"], among: Bool[np.ndarray, " m"]) -> Int[np.ndarray, " n"]:
    """Return those among these whose owner has no other one there."""
    some = np.flatnonzero(among)
    _, of, count = np.unique(owner[some], return_inverse=True, return_counts=True)
    return some[count[of] == 1]


def proven(slots: Slots, landmarks: Landmarks) -> Bool[np.ndarray, " k"]:
    """Return which of the slots hold landmarks that are proven."""
    return np.array([landmarks[slot].found >= PROVEN for slot in slots], bool)


def _of_proven(
    landmarks: Landmarks,
    agree: Agreement,
    slots: Int[np.ndarray, " m"],
    matches: Matches,
    *association: Association,
) -> Bool[np.ndarray, " m"]:
    """Return which matches of proven landmarks agree; none of the others does."""
    believed = proven(slots, landmarks)
    old = np.flatnonzero(believed)
    believed[old] = agree(slots[old], only(matches, old), *association)
    return believed
