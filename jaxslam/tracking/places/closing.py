"""The end of a loop: a picture shows landmarks of an earlier submap.

Descriptors say which corners may be which landmarks, a pose with RANSAC which can be, all at once,
and their patches, searched for from there, where they are to a part of a pixel. A loop is believed
where the chain of submaps, with its covariance, says that it can be.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from scipy.stats import chi2

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.map import TrackerState
from jaxslam.tracking.observations import Prediction, Slots
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.places.descriptors import ByNumber, candidates, described_corners
from jaxslam.tracking.places.relocalisation import FEWEST, MOST_OF, TRIED, pose_of, well_known
from jaxslam.tracking.places.submaps import Submap, loop_of
from jaxslam.tracking.pointcloud import seen_from
from jaxslam.tracking.pose_with_covariance import Transform
from jaxslam.tracking.search import search

APART = 3
"""The fewest submaps from the end of one loop to that of the next, besides an eighth of all: the
cost of a loop grows with their number."""
GATE = 9 * float(chi2.ppf(0.999, 6))
"""NIS beyond which a loop is not believed: that of three times the σ of the way round it. On real
pictures a drift is up to 2.5 times what its σ says; another place is off by ten times that."""


def close_loop(image: Picture, state: TrackerState) -> tuple[TrackerState, int | None]:
    """Return the state, which has learnt of the earlier submap that the picture at the end of the
    latest one shows, and the number of that submap; None where there is none, or not to be believed
    (`refused`)."""
    map, settings, slam = state.map, state.estimator.settings, state.estimator.slam
    *earlier, latest = map.submaps
    if map.loops and len(earlier) - int(map.loops[-1].submaps[1]) < max(APART, len(earlier) // 8):
        return state, None
    kept = state.charted.keys() - set(latest.numbers.tolist())
    if not kept:
        return state, None
    gone = {number: state.charted[number] for number in kept}
    by_number = candidates(gone, described_corners(image))
    shown = [sum(n in by_number for n in one.numbers.tolist()) for one in earlier]
    for p in np.argsort(shown)[::-1][:TRIED].tolist():
        if shown[p] < FEWEST:
            return state, None
        found = _seen_in(image, earlier[p], by_number, state)
        if found is None:
            continue
        which = p, len(earlier)
        # σ of a landmark where its patch is found, pixels: it is seen from elsewhere, or later.
        loop = loop_of(slam, map.submaps, which, *found, 1.0, settings.wanted)
        compared = map.graph(settings, slam).with_loop(loop)
        if not compared.nis < GATE:
            return replace(state, refused=state.refused + 1), None
        return replace(state, map=map.learnt(loop, compared)), earlier[p].number
    return state, None


def _seen_in(
    image: Picture, submap: Submap, by_number: ByNumber, state: TrackerState
) -> tuple[Slots, Transform] | None:
    """The slots of the landmarks of a submap in a picture, and where its camera is from the last of
    the submap."""
    sure = well_known(submap.points, submap.covariances) & np.asarray(submap.frozen.carried)
    numbers, calibration = submap.numbers.tolist(), state.calibration
    settings = state.estimator.settings
    known = [slot for slot, n in enumerate(numbers) if sure[slot] and n in by_number]
    at = np.array([by_number[numbers[slot]] for slot in known]).reshape(-1, 2)
    posed = pose_of(submap.points[known], at, calibration)
    if posed is None:
        return None
    landmarks = {s: state.charted[numbers[s]] for s in np.flatnonzero(sure).tolist()}
    expected = _expected(submap, posed[0], sure, state.map.place.unit, calibration)
    seen, matches = search(image, landmarks, expected, calibration, settings, several=False)
    if len(matches.owner) < max(FEWEST, MOST_OF * len(seen.slots)):
        return None
    slots = seen.slots[matches.owner]
    posed = pose_of(submap.points[slots], matches.pixels, calibration)
    return None if posed is None else (slots[posed[1]], posed[0])


def _expected(
    submap: Submap,
    T: Transform,
    sure: Bool[np.ndarray, " slots"],
    unit: float,
    calibration: Calibration,
) -> Prediction:
    """What a camera at T from the last one of a submap sees of its landmarks."""
    pixels, spread = seen_from(T, submap.points, submap.covariances, calibration)
    in_unit = T.copy()
    in_unit[:3, 3] *= unit
    X = (submap.points - T[:3, 3]) @ T[:3, :3] * unit
    # σ of the place of a landmark seen from the pose that its descriptors tell, pixels.
    spread = spread + 3.0**2 * np.eye(2)
    usable, T_wc = sure & np.isfinite(pixels[:, 0]), submap.camera.T_wc @ in_unit
    return Prediction(pixels, spread, usable, T_wc, X, np.ones(len(X)))
