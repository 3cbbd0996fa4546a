"""The start of an inertial unit in motion, by the pictures of a window.

Corners are tracked from picture to picture (Lucas, Kanade 1981); what they tell of the start is
found by all of them at once (`jaxslam.filters.window.in_motion`). The tracker goes on after the
window, so that no measurement is used twice.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.filters.window.in_motion import InertialWindow, at_end, minimum
from jaxslam.filters.window.modes import directions
from jaxslam.io.calibration import Calibration
from jaxslam.io.source import Source, selected
from jaxslam.models.imu import Imu, Increments
from jaxslam.tracking.corners import bare_corners
from jaxslam.tracking.inertial import Inertial
from jaxslam.tracking.optics import camera_of
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.settings import TrackerSettings

WINDOW = 1.5
"""Its seconds."""
STEPS = 12
"""Steps of a window: pictures between are used to track corners alone."""
SURE = 0.04
"""σ of the velocity, m/s, with which a filter starts."""
SPEED = 0.7
"""m/s, in every direction in which the search starts, besides the start from rest."""
DIRECTIONS = 6
TRACKED = 2.0
"""σ of a corner that is tracked from picture to picture, in that of a match."""
FEWEST = 8
"""Corners that are seen to the end."""


def begun(source: Source, inertial: Inertial, settings: TrackerSettings) -> tuple[Source, Inertial]:
    """The part of a video, and the unit with its start there, from which a tracker goes on: all of
    it where the unit is at rest in the beginning, and else what follows the window.

    Raises ValueError where the window does not tell the start.
    """
    if not inertial.why_moving:
        return source, inertial
    last = int(np.searchsorted(source.times, source.times[0] + WINDOW))
    which = np.unique(np.linspace(0, last, STEPS + 1).round().astype(int))
    times = source.times[: last + 1][which[which < len(source.times)]]
    pictures = [frame.image for frame in itertools.islice(source, last + 1)]
    try:
        if last >= len(source.times):
            raise ValueError(f"the video is shorter than {WINDOW} s")
        with jax.enable_x64(True):
            controls = [inertial.control(*map(float, step)) for step in itertools.pairwise(times)]
            seen = tracks(pictures, settings)[which]
            imu = start_in_motion(inertial.imu, controls, seen, source.calibration, settings)
    except ValueError as error:
        told = f"{inertial.why_moving}, and its start in motion is not found: {error}"
        raise ValueError(f"{source.name}: {told}; begin elsewhere, as by --start") from None
    return selected(source, start=float(times[-1] - times[0])), replace(inertial, imu=imu)


def tracks(
    pictures: Sequence[Picture], settings: TrackerSettings
) -> Float[np.ndarray, "frames m 2"]:
    """Pixels of corners of the first picture in all; NaN from where they are lost."""
    flow = partial(cv2.calcOpticalFlowPyrLK, winSize=(15, 15), maxLevel=4)
    corners = bare_corners(pictures[0], settings).astype(np.float32)
    found = [corners]
    for before, after in itertools.pairwise(pictures):
        known = np.nan_to_num(found[-1])
        there, ok, _ = flow(before, after, known, known.copy())
        back, again, _ = flow(after, before, there, there.copy())
        same = np.linalg.norm(back - known, axis=1) < 0.5  # pixels
        good = np.logical_and(ok, again)[:, 0] & same & np.isfinite(found[-1]).all(axis=1)
        found.append(np.where(good[:, None], there, np.nan).astype(np.float32))
    return np.array(found, float)


def start_in_motion(
    imu: Imu,
    controls: Sequence[Increments],
    seen: Float[np.ndarray, "frames m 2"],
    calibration: Calibration,
    settings: TrackerSettings,
) -> Imu:
    """The model with the start that a window tells, at its end, from the start of `imu` at its
    first frame; controls lead from each frame to the next, in which these pixels are `seen`.

    Raises ValueError where too little is seen, or the velocity stays too uncertain.
    """
    some = np.isfinite(seen[-1]).all(axis=1)
    if some.sum() < FEWEST:
        raise ValueError(f"only {some.sum()} corners are seen through the window")
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *controls)
    pixels, sigma = seen[:, some], np.asarray(TRACKED * settings.pixel_sigma)
    window = InertialWindow(imu, stacked, camera_of(calibration), settings.depth, pixels, sigma)
    starts = np.zeros(3), *SPEED * directions(3, DIRECTIONS)
    best = min((minimum(window, velocity) for velocity in starts), key=lambda one: one.cost)
    now, root = at_end(window, best)
    if (off := float(jnp.linalg.norm(root[:3], axis=1).max())) > SURE:
        raise ValueError(f"at the window's end the velocity is known to {off:.2g} m/s only")
    return imu.begun(now, root)
