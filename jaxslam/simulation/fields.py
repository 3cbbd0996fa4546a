"""The flat fields of a scenario: what a TOML file and `--set field=value` may say, with units."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

Value = Any
"""A field's: a word, a number, a list of them, or a piece of one's own."""
LARGEST_WHOLE = 2**31 - 1
POSITIVE, NOT_NEGATIVE = "positive", "not negative"


class Field(NamedTuple):
    """A field: its default, in whose type it is read, what its numbers have to be, what it is."""

    default: Value
    told: str
    least: str = ""
    """`POSITIVE`, `NOT_NEGATIVE`, or nothing."""


FIELDS: dict[str, Field] = {
    "name": Field("", "what tables call it"),
    "geometry": Field("planar", "planar (x, z, θ) or spatial (x, y, z, rotation about them)"),
    "rate": Field(30.0, "frames per second", POSITIVE),
    "steps": Field(60, "steps after frame 0", POSITIVE),
    "velocity": Field(
        (1.2, 0.0, 0.0), "nominal velocity in the camera's axes, m/s and rad/s: the filter's mean"
    ),
    "velocity_sigma": Field(
        (0.01, 0.01, 0.01), "σ of the true initial velocity around it, m/s and rad/s",
        NOT_NEGATIVE,
    ),
    "trajectory": Field(
        "", "what the camera truly moves along, from a random start: a TUM file, or the name of "
        "one in $JAXSLAM_DATA/trajectories; empty: it moves as the motion model says",
    ),
    "still_frames": Field(
        0, "velocity: steps in which the camera first stands still; no filter is told",
        NOT_NEGATIVE,
    ),
    "motion": Field(
        "velocity", "velocity (constant, with white accelerations), odometry (the nominal motion, "
        "read with noise), or one of your own, module:Class",
    ),
    "acceleration_sigma": Field(
        (0.1, 0.1, 0.1), "velocity: σ of the white acceleration, m/s² and rad/s²", POSITIVE
    ),
    "odometry_sigma": Field(
        (0.01, 0.01, 0.01), "odometry: σ of the reading of one step, m and rad", NOT_NEGATIVE
    ),
    "placement": Field(
        "prior", "prior (pixels of frame 0, 1/z of the filter's prior), ring (around the path's "
        "centre), room (72 points along the walls of a square), rays (whenever one leaves the "
        "picture, another comes), points, or one of your own",
    ),
    "landmarks": Field(12, "how many", POSITIVE),
    "in_view": Field(
        0, "the most that are measured at once, where one that comes back is a new one; 0: every "
        "landmark has a slot of its own", NOT_NEGATIVE,
    ),
    "first_pixels": Field(
        ((20.0, 620.0),), "prior, rays: interval of each pixel coordinate at first sight, pixels"
    ),
    "depth_range": Field((1.0, 6.0), "rays: least and greatest depth z of new ones, m", POSITIVE),
    "ring_radius": Field(8.0, "ring: its radius, m", POSITIVE),
    "nearest_depth": Field(
        3.0, "d_min, m: the prior on 1/z is N(1/(2 d_min), (1/(4 d_min))²)", POSITIVE
    ),
    "inverse_depth": Field((), "mean and σ of the prior on 1/z, 1/m, where not those of d_min"),
    "scale_sigma": Field(
        0.0, "σ of the log of the metre in which all is given; 0 where it is a metre",
        NOT_NEGATIVE,
    ),
    "least_inverse_depth": Field(
        0.001, "prior: truth is of the prior truncated above this, 1/m", POSITIVE
    ),
    "first_frame": Field(0, "frame before which nothing is measured", NOT_NEGATIVE),
    "first_landmarks": Field(0, "the most that are new in frame 0; 0: all", NOT_NEGATIVE),
    "new_landmarks": Field(0, "the most that are new in a later frame; 0: all", NOT_NEGATIVE),
    "known_landmarks": Field(
        0, "the most that are measured again in a frame, drawn at random; 0: all", NOT_NEGATIVE
    ),
    "sensor": Field(
        "camera", "camera (a pixel), position (the point relative to the sensor), range_bearing "
        "(in the plane), or one of your own, module:Class",
    ),
    "visible_depth": Field(0.1, "camera: least depth z of what is seen, m", POSITIVE),
    "range": Field(
        (0.5, 5.0), "other sensors: least and greatest distance of what is seen, m", NOT_NEGATIVE
    ),
    "position_sigma": Field(0.1, "position: σ of each coordinate, m", POSITIVE),
    "range_bearing_sigma": Field((0.1, 0.02), "range_bearing: σ of each, m and rad", POSITIVE),
    "image": Field((640.0,), "camera: size of the picture, pixels", POSITIVE),
    "focal": Field((650.0,), "camera: focal length of each coordinate, pixels", POSITIVE),
    "centre": Field((320.0,), "camera: principal point, pixels"),
    "focal_sigma": Field(3.0, "camera: σ of each focal length, pixels", NOT_NEGATIVE),
    "centre_sigma": Field(
        2.0, "camera: σ of each coordinate of the principal point, pixels", NOT_NEGATIVE
    ),
    "pixel_sigma": Field(0.3, "camera: σ of each pixel coordinate", POSITIVE),
    "drift_sigma": Field(
        0.0, "σ of an error of each landmark that stays from frame to frame, pixels, m or rad, as "
        "of a patch that turns; no filter is told", NOT_NEGATIVE,
    ),
    "drift_frames": Field(20.0, "frames after which 1/e of it is left", POSITIVE),
    "drift_wrong": Field(0.0, "share of landmarks of which it is ten times as large", NOT_NEGATIVE),
    "calibration": Field("known", "how filters treat it: white, consider, estimated or known"),
    "true_calibration": Field(
        "nominal", "the true one: nominal, or drawn white (every frame) or constant (every run)"
    ),
    "points": Field((), "points: where they are in the first camera, m, a list of lists"),
    "beacons": Field(
        0, "how many landmarks, spread evenly, are surveyed: the filter knows where they are",
        NOT_NEGATIVE,
    ),
    "beacon_sigma": Field(0.1, "σ of each of their coordinates, m", POSITIVE),
}  # fmt: skip


OWN = ("motion", "sensor", "placement")
"""Fields that may be a piece of one's own: a word `module:Class`, or a table of `type` and what
that takes, or from Python the piece."""
ROWS = ("first_pixels", "points")
"""Fields that are lists of lists."""


def coerced(field: str, value: Value, like: Value) -> Value:
    """`value` in the type of the field; a single number stands for a list of one.

    Raises ValueError, naming the field.
    """

    def wrong(wanted: str) -> ValueError:
        return ValueError(f"scenario field {field} must be {wanted}, not {value!r}")

    value = value.tolist() if isinstance(value, np.ndarray) else value
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if field in OWN and not isinstance(value, int | float | list | tuple):
        return value
    if isinstance(like, str):
        if not isinstance(value, str):
            raise wrong("a word")
        return value
    if field in ROWS and isinstance(like, tuple):
        if not isinstance(value, list | tuple) or any(is_alone(row) for row in value):
            raise wrong("a list of " + ("points" if field == "points" else "[low, high] pairs"))
        return tuple(tuple(coerced(field, x, 0.0) for x in row) for row in value)
    if isinstance(like, tuple):
        values = [value] if is_alone(value) else value
        return tuple(coerced(field, number, 0.0) for number in values)
    if not is_number:
        raise wrong("a number")
    if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
        raise wrong(f"a number up to {LARGEST_WHOLE}")
    if isinstance(like, int) and value != int(value if math.isfinite(value) else 0):
        raise wrong("a whole number")
    return type(like)(value)


def is_alone(value: Value) -> bool:
    """Whether it is no list."""
    return not isinstance(value, list | tuple)


def check_numbers(what: str, value: Value, least: str = "") -> None:
    """Raise ValueError, naming what it is, unless its numbers are finite and of this sign.

    Words, pieces, and numbers that are being traced are let through.
    """
    if isinstance(value, tuple):
        for element in value:
            check_numbers(what, element, least)
    elif isinstance(value, int | float | np.ndarray):
        for number in np.ravel(value).tolist():
            if not math.isfinite(number):
                raise ValueError(f"{what} holds {number}; it must be finite")
            if (least == POSITIVE and number <= 0) or (least == NOT_NEGATIVE and number < 0):
                wanted = "be positive" if least == POSITIVE else "not be negative"
                raise ValueError(f"{what} must {wanted}, not {number}")


def check_signs(piece: Any, positive: Iterable[str], not_negative: Iterable[str] = ()) -> None:
    """Raise ValueError unless these fields of a piece are finite and of these signs."""
    for least, names in ((POSITIVE, positive), (NOT_NEGATIVE, not_negative)):
        for name in names:
            check_numbers(f"{name} of {type(piece).__name__}", getattr(piece, name), least)
