"""The lens of a camera of which at most the field of view is known, from how its video begins.

A filter linearises where it believes the lens to be: of a wide guess it becomes sure of a focal
length that is several σ off. The first frames are tracked with the guess, a bundle of them is
adjusted with the lens free, and tracking begins again with what that found.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from jaxslam.io.calibration import LENS_SIGMA, Calibration
from jaxslam.io.source import Source
from jaxslam.tracking.focal import BetterLens, better_lens
from jaxslam.tracking.report import Tracked, add_latest
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.tracker import Tracker

FRAMES = 100
"""Frames that are tracked to find the lens."""
SURE = 3.0
"""σ of a bundle's lens, of what it would be if errors were independent and the frames were not to
be used again."""


def finds_lens(source: Source, settings: TrackerSettings) -> bool:
    """Whether the lens is a guess, which the tracker estimates, of a recording, and of a global
    shutter: a bundle knows no other."""
    estimated = settings.calibration in (None, "estimated") and not settings.readout
    return source.calibration.guessed and source.clock is None and estimated


def with_lens_found(source: Source, settings: TrackerSettings, out: Path) -> Source:
    """The source with the lens that fits its first frames, whose files are in `out` meanwhile; as
    it is where they tell less of the focal length than the guess did."""
    given, history = source.calibration, list[Tracked]()
    tracker = Tracker(given, settings)
    out.mkdir(parents=True, exist_ok=True)
    with suppress(ValueError):  # which the tracking that follows meets again
        for frame in islice(source, FRAMES):
            history.append(tracker.track(frame))
            add_latest(out, history)
    camera = tracker.camera()
    if camera is None or not history:
        return source
    fx, fy, cx, cy, *distortion = camera[1].tolist()
    here = replace(given, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))
    better = better_lens(history, tracker.points(), here)
    return replace(source, calibration=combined(given, here, better))


def combined(given: Calibration, here: Calibration, better: BetterLens) -> Calibration:
    """The guess that was given and what a bundle makes of a lens `here`, by their σ; the guess
    where the bundle tells less of the focal length."""
    guess = np.array([np.log(given.fx), given.distortion[0]])
    found = np.array([np.log(here.fx * better.focal), here.distortion[0] + better.k1])
    by_guess = np.array([given.fx / given.sigma[0], 1 / LENS_SIGMA[0]]) ** 2
    by_bundle = 1 / (SURE * better.sigma) ** 2
    if by_bundle[0] < by_guess[0]:
        return given
    information = by_guess + by_bundle
    logarithm, k1 = (by_guess * guess + by_bundle * found) / information
    f = float(np.exp(logarithm))
    sigma = f * float(information[0]) ** -0.5
    return replace(
        given,
        fx=f,
        fy=f,
        distortion=(float(k1), *here.distortion[1:]),
        sigma=(sigma, sigma, *given.sigma[2:]),
    )
