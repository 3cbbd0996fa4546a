"""Scenarios: every number of a simulated world, its camera and its noise, as plain data.

A scenario is built in (`scenario("circle")`), read from a TOML file with the same fields, or
either with some fields replaced. All are checked by one function, which names the field.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx

from jaxslam._runtime.lookup import suggestion
from jaxslam.geometry import GEOMETRIES, Geometry
from jaxslam.simulation.trajectories import find

Numbers = tuple[float, ...]

MOTIONS = ("velocity", "odometry")
SENSORS = ("camera", "position")
CALIBRATIONS = ("white", "consider", "estimated", "known")
"""The paper's independent draw of every frame; constant and correlated but not corrected
(Schmidt); constant and estimated; exact."""
TRUE_CALIBRATIONS = ("nominal", "white", "constant")
PLACEMENTS = ("prior", "ring", "room", "rays")
ROOM_LANDMARKS = 72
LARGEST_WHOLE = 2**31 - 1


def _structural(default: Any) -> Any:
    return eqx.field(static=True, default=default)


class Scenario(eqx.Module):
    """A simulated experiment. SI units, radians, pixels; per axis x, (y,) z, then rotation.

    Its numbers are leaves: scenarios that differ in nothing else share their programs.
    """

    name: str = eqx.field(static=True)
    geometry: str = _structural("planar")
    """`planar` or `spatial`."""
    rate: float = 30.0
    """Frames per second."""
    steps: int = _structural(60)
    """Filter steps after frame 0, in which the first landmarks are seen."""
    velocity: Numbers = (1.2, 0.0, 0.0)
    """Nominal velocity in the camera frame, m/s and rad/s: the mean that the filter starts with."""
    velocity_sigma: Numbers = (0.01, 0.01, 0.01)
    """σ of the true initial velocity around the nominal one, and of the filter's."""
    trajectory: str = _structural("")
    """Along what the camera truly moves, from a start drawn at random: a TUM file, or the name of
    one in $JAXSLAM_DATA/trajectories. Empty: it moves as the filter's prior says."""
    still_frames: int = _structural(0)
    """`velocity`: the camera first stands exactly still for so many steps, then moves off with the
    velocity drawn. The filter does not know it."""
    motion: str = _structural("velocity")
    """The filter's motion model. `velocity`: constant velocity, with accelerations drawn.
    `odometry`: the nominal motion is the true one, and its noisy reading the filter's input."""
    acceleration_sigma: Numbers = (0.1, 0.1, 0.1)
    """`velocity`: σ of the true white acceleration, and of the filter's, m/s² and rad/s²."""
    odometry_sigma: Numbers = (0.01, 0.01, 0.01)
    """`odometry`: σ of the reading of one step, and the filter's, m and rad."""
    placement: str = _structural("prior")
    """`prior`: every landmark seen in frame 0, at a uniform pixel and an inverse depth from the
    filter's prior. `ring`: evenly on a horizontal circle around the centre of the nominal path.
    `room`: 72 points along the walls of a square room, on two levels (slamtb). `rays`: always
    as many in view; for one that leaves, which is gone for good, another is thrown along a random
    ray of the camera there."""
    landmarks: int = _structural(12)
    in_view: int = _structural(0)
    """At most so many landmarks are measured at once, and one that leaves the view is a new one
    when it is seen again: a filter needs slots for no more. 0: every landmark has its own slot."""
    first_pixels: tuple[Numbers, ...] = ((20.0, 620.0),)
    """`prior`, `rays`: the interval of each pixel coordinate at first sight."""
    depth_range: Numbers = (1.0, 6.0)
    """`rays`: least and greatest depth on the ray, m; uniform in between."""
    ring_radius: float = 8.0
    """`ring`: its radius, m."""
    nearest_depth: float = 3.0
    """d_min, m: the filter's prior on 1/z is N(1/(2 d_min), (1/(4 d_min))²)."""
    inverse_depth: Numbers = ()
    """Mean and σ of the filter's prior on 1/z, 1/m, where they are not those of d_min."""
    scale_sigma: float = _structural(0.0)
    """σ of the log of the metre in which all this is given; 0 where it is a metre. Only a
    filter with a unit of its own (`scale_gauge`) can heed it."""
    least_inverse_depth: float = 0.001
    """`prior`: truth is drawn from the prior truncated above this, 1/m."""
    first_frame: int = _structural(0)
    """Nothing is measured before this frame."""
    first_landmarks: int = _structural(0)
    """At most so many landmarks are new in frame 0; 0 for all that are visible."""
    new_landmarks: int = _structural(0)
    """At most so many are new in a later frame; 0 for all that are visible."""
    known_landmarks: int = _structural(0)
    """At most so many are measured again in a frame, drawn at random; 0 for all visible."""
    sensor: str = _structural("camera")
    """What is measured: a pixel (`camera`), or the point relative to the sensor (`position`)."""
    visible_depth: float = 0.1
    """`camera`: a point nearer than this along the optical axis is not seen, m."""
    range: Numbers = (0.5, 5.0)
    """`position`: least and greatest distance of a point that is measured, m."""
    position_sigma: float = 0.1
    """`position`: σ of each measured coordinate, m."""
    image: Numbers = (640.0,)
    """Size of the picture, pixels."""
    focal: Numbers = (650.0,)
    centre: Numbers = (320.0,)
    focal_sigma: float = 3.0
    """σ of each focal length, pixels."""
    centre_sigma: float = 2.0
    """σ of each coordinate of the principal point, pixels."""
    pixel_sigma: float = 0.3
    """σ of a measured pixel coordinate."""
    drift_sigma: float = _structural(0.0)
    """σ of an error of a landmark's measurements that stays from frame to frame, pixels or m, as
    of a patch that turns; no filter is told."""
    drift_frames: float = 20.0
    """Frames after which 1/e of it is left."""
    drift_wrong: float = 0.0
    """Share of the landmarks of which it is ten times as large."""
    calibration: str = _structural("known")
    """How the filter treats its calibration, unless stated otherwise."""
    true_calibration: str = _structural("nominal")
    """The true intrinsics: `nominal`, or drawn `white` (every frame) or `constant` (every run)."""

    def __check_init__(self) -> None:
        _check(self)

    @property
    def world(self) -> Geometry:
        """Planar or spatial."""
        return GEOMETRIES[self.geometry]

    @property
    def scale_free(self) -> bool:
        """Whether nothing is measured or given in metres: only priors know the scale."""
        return self.motion == "velocity" and self.sensor == "camera"


def scenario(
    name: str | Path = "circle", overrides: Mapping[str, Any] | None = None, **fields: Any
) -> Scenario:
    """A built-in scenario or one from a TOML file, with fields replaced.

    A TOML file may name a built-in scenario to start from: `base = "circle"`.
    Raises ValueError for an unknown name or field and for a value that makes no sense.
    """
    chosen = _read(Path(name)) if str(name).endswith(".toml") else _named(str(name))
    if chosen is None:
        raise ValueError(
            f"unknown scenario {str(name)!r}{suggestion(str(name), BUILT_IN)}; known: "
            f"{', '.join(BUILT_IN)}, {HANDHELD}NAME of a trajectory, or a .toml file"
        )
    return _replaced(chosen, {**(overrides or {}), **fields})


def as_scenario(given: Scenario | str) -> Scenario:
    """A scenario, or the one of this name. Raises ValueError."""
    return given if isinstance(given, Scenario) else scenario(given)


def _named(name: str) -> Scenario | None:
    """A built-in scenario, or one along a trajectory of this name."""
    if not name.startswith(HANDHELD):
        return BUILT_IN.get(name)
    trajectory = name.removeprefix(HANDHELD)
    find(trajectory)  # or say now what is known
    numbers = _OUTDOORS if trajectory in _OUTDOOR_TRAJECTORIES else {}
    return dataclasses.replace(BUILT_IN["handheld"], name=name, trajectory=trajectory, **numbers)


def parse_override(text: str) -> tuple[str, Any]:
    """`field=value` with the value as in TOML; a bare word is a string."""
    field, sign, value = text.partition("=")
    if not sign or not field.strip():
        raise ValueError(f"{text!r} is not of the form field=value")
    try:
        return field.strip(), tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return field.strip(), value.strip()


def _read(path: Path) -> Scenario:
    try:
        fields = tomllib.loads(path.read_text())
    except FileNotFoundError:
        raise ValueError(f"scenario file {path} does not exist") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"scenario file {path}: {error}") from None
    base = fields.pop("base", None)
    start = _named(base) if base else Scenario(name=path.stem)
    if start is None:
        raise ValueError(f"{path}: unknown base {base!r}; known: {', '.join(BUILT_IN)}")
    return _replaced(start, {"name": path.stem, **fields})


def _replaced(chosen: Scenario, fields: Mapping[str, Any]) -> Scenario:
    known = {field.name: getattr(chosen, field.name) for field in dataclasses.fields(Scenario)}
    for field, value in fields.items():
        if field not in known:
            raise ValueError(
                f"unknown scenario field {field!r}{suggestion(field, known)}; "
                f"known: {', '.join(known)}"
            )
        known[field] = _coerced(field, value, known[field])
    return Scenario(**known)


def _coerced(field: str, value: Any, like: Any) -> Any:
    """`value` in the type of the field; a single number stands for a list of one."""

    def wrong(wanted: str) -> ValueError:
        return ValueError(f"scenario field {field} must be {wanted}, not {value!r}")

    if isinstance(like, str):
        if not isinstance(value, str):
            raise wrong("a word")
        return value
    if isinstance(like, tuple) and like and isinstance(like[0], tuple):
        if not isinstance(value, list | tuple) or not all(
            isinstance(pair, list | tuple) for pair in value
        ):
            raise wrong("a list of [low, high] pairs")
        return tuple(_coerced(field, pair, like[0]) for pair in value)
    if isinstance(like, tuple):
        values = value if isinstance(value, list | tuple) else [value]
        return tuple(_coerced(field, number, 0.0) for number in values)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise wrong("a number")
    if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
        raise wrong(f"a number up to {LARGEST_WHOLE}")
    if isinstance(like, int) and value != int(value if math.isfinite(value) else 0):
        raise wrong("a whole number")
    return type(like)(value)


def _check(s: Scenario) -> None:
    """Raise ValueError, naming the field, unless the scenario can be simulated."""
    for field, known in (
        ("geometry", tuple(GEOMETRIES)),
        ("motion", tuple(MOTIONS)),
        ("sensor", tuple(SENSORS)),
        ("placement", PLACEMENTS),
        ("calibration", CALIBRATIONS),
        ("true_calibration", TRUE_CALIBRATIONS),
    ):
        if getattr(s, field) not in known:
            raise ValueError(
                f"scenario field {field} is {getattr(s, field)!r}; known: {', '.join(known)}"
            )
    t, p = s.world.tangent_dim, s.world.pixel_dim
    lengths = {
        "velocity": t, "velocity_sigma": t, _NOISE_OF[s.motion]: t, "range": 2,
        "image": p, "focal": p, "centre": p, "first_pixels": p,
    }  # fmt: skip
    for field, length in lengths.items():
        if len(getattr(s, field)) != length:
            raise ValueError(
                f"scenario field {field} needs {length} values in a {s.geometry} world, "
                f"not {len(getattr(s, field))}"
            )
    for field in dataclasses.fields(s):
        _check_numbers(field.name, getattr(s, field.name))
    if any(len(pair) != 2 or pair[0] >= pair[1] for pair in s.first_pixels):
        raise ValueError(f"scenario field first_pixels needs [low, high] pairs: {s.first_pixels}")
    if s.inverse_depth and (len(s.inverse_depth) != 2 or s.inverse_depth[1] <= 0):
        raise ValueError(f"scenario field inverse_depth needs a mean and a σ: {s.inverse_depth}")
    if len(s.depth_range) != 2 or s.depth_range[0] >= s.depth_range[1]:
        raise ValueError(
            f"scenario field depth_range needs a least and a greatest depth: {s.depth_range}"
        )
    if s.range[0] >= s.range[1]:
        raise ValueError(f"scenario field range needs a least and a greatest one: {s.range}")
    if s.sensor == "position" and s.calibration != "known":
        raise ValueError("scenario field calibration: a position sensor has none; use known")
    if s.motion == "odometry" and (s.still_frames or s.trajectory):
        field = "still_frames" if s.still_frames else "trajectory"
        raise ValueError(f"scenario field {field}: odometry has the nominal motion; leave it out")
    if s.trajectory and s.geometry != "spatial":
        raise ValueError(
            f"scenario field trajectory is for a spatial world, not a {s.geometry} one"
        )
    _check_placement(s)


def _check_placement(s: Scenario) -> None:
    if s.placement == "room" and (s.geometry != "spatial" or s.landmarks != ROOM_LANDMARKS):
        raise ValueError(
            f"placement room is for a spatial geometry and {ROOM_LANDMARKS} landmarks, "
            f"not {s.geometry} and {s.landmarks}"
        )
    if s.placement == "rays":
        _check_rays(s)
    if s.in_view and (s.placement == "rays" or _limits(s)):
        raise ValueError(
            "scenario field in_view: not with placement rays, first_landmarks, new_landmarks or "
            "known_landmarks"
        )
    if s.placement == "ring" and s.velocity[-1 if s.geometry == "planar" else 4] == 0:
        raise ValueError(
            "placement ring needs a nominal path that turns: velocity[-1], in space velocity[4], "
            "is 0"
        )


def _check_rays(s: Scenario) -> None:
    if s.sensor != "camera":
        raise ValueError(f"placement rays is for a camera, not for a {s.sensor} sensor")
    for field in ("first_frame", *_limits(s)):
        if getattr(s, field):
            raise ValueError(f"scenario field {field}: placement rays has no limits; use 0")


def _limits(s: Scenario) -> list[str]:
    """The fields by which a scenario limits what is measured."""
    fields = ("first_landmarks", "new_landmarks", "known_landmarks")
    return [field for field in fields if getattr(s, field)]


_NOISE_OF = {"velocity": "acceleration_sigma", "odometry": "odometry_sigma"}
_POSITIVE = (
    "rate", "steps", "landmarks", "ring_radius", "nearest_depth", "image", "focal",
    "pixel_sigma", "least_inverse_depth", "visible_depth", "depth_range",
    "acceleration_sigma", "position_sigma", "drift_frames",
)  # fmt: skip
_NOT_NEGATIVE = (
    "velocity_sigma", "focal_sigma", "centre_sigma", "odometry_sigma", "range",
    "scale_sigma", "still_frames", "first_frame", "first_landmarks", "new_landmarks",
    "known_landmarks", "drift_sigma", "drift_wrong", "in_view",
)  # fmt: skip


def _check_numbers(field: str, value: Any) -> None:
    if isinstance(value, str):
        return
    if isinstance(value, tuple):
        for element in value:
            _check_numbers(field, element)
        return
    if not math.isfinite(value):
        raise ValueError(f"scenario field {field} holds {value}; it must be finite")
    if field in _POSITIVE and value <= 0:
        raise ValueError(f"scenario field {field} must be positive, not {value}")
    if field in _NOT_NEGATIVE and value < 0:
        raise ValueError(f"scenario field {field} must not be negative, not {value}")


_PLANAR_NOISE = {
    # acceleration σ, initial velocity σ
    "-tight": ((0.02,) * 3, (0.002,) * 3),
    "": ((0.1,) * 3, (0.01,) * 3),
    "-loose": ((0.5, 0.5, 0.3), (0.1, 0.1, 0.05)),
    "-very-loose": ((3.0, 3.0, 1.0), (0.1, 0.1, 0.05)),
}
_SPATIAL_NOISE = {
    "-tight": ((0.02,) * 6, (0.002,) * 6),
    "": ((0.1,) * 6, (0.01,) * 6),
    "-loose": ((0.5,) * 3 + (0.3,) * 3, (0.1,) * 3 + (0.05,) * 3),
    "-very-loose": ((3.0,) * 3 + (1.0,) * 3, (0.1,) * 3 + (0.05,) * 3),
}
_SPATIAL: dict[str, Any] = {
    "geometry": "spatial",
    "landmarks": 30,
    "first_pixels": ((20.0, 620.0), (20.0, 460.0)),
    "image": (640.0, 480.0),
    "focal": (650.0, 650.0),
    "centre": (320.0, 240.0),
}
"""The world and the camera of 6-DoF scenarios."""
_CIRCLE_NOISE = {
    "-tight": _PLANAR_NOISE["-tight"],
    "": _PLANAR_NOISE[""],
    "-loose": ((0.3, 0.3, 0.5), (0.05, 0.05, 0.1)),
}


HANDHELD = "handheld-"
"""What a trajectory's name follows in the name of its scenario."""
_OUTDOORS: dict[str, Any] = {
    "depth_range": (5.0, 50.0),
    "nearest_depth": 5.0,
    "velocity_sigma": (10.0,) * 3 + (1.0,) * 3,
}
_OUTDOOR_TRAJECTORIES = ("kitti_00",)
"""Of a car on a road."""


def _family(family: str, noises: Mapping[str, tuple[Numbers, Numbers]], **fields: Any):
    for suffix, (acceleration, velocity) in noises.items():
        yield Scenario(
            name=family + suffix, acceleration_sigma=acceleration, velocity_sigma=velocity, **fields
        )


def _built_in():
    around: dict[str, Any] = {**_SPATIAL, "landmarks": 144}
    yield from _family("matched", _PLANAR_NOISE)
    towards = {suffix: _PLANAR_NOISE[suffix] for suffix in ("", "-loose")}
    yield from _family("matched-forward", towards, velocity=(0.0, 1.2, 0.0))
    yield from _family("matched-turn", towards, velocity=(0.0, 1.2, 0.3))
    yield from _family(
        "matched-6dof", _SPATIAL_NOISE, velocity=(1.2, 0.0, 0.0, 0.0, 0.0, 0.0), **_SPATIAL
    )
    yield Scenario(
        name="standstill",
        velocity=(0.0,) * 3,
        velocity_sigma=(0.5, 0.5, 0.2),
        acceleration_sigma=_PLANAR_NOISE["-loose"][0],
    )
    yield Scenario(
        name="standstill-6dof",
        velocity=(0.0,) * 6,
        velocity_sigma=(0.5,) * 3 + (0.2,) * 3,
        acceleration_sigma=_SPATIAL_NOISE["-loose"][0],
        **_SPATIAL,
    )
    yield Scenario(
        name="handheld",
        steps=150,
        velocity=(0.0,) * 6,
        velocity_sigma=(1.0,) * 6,
        acceleration_sigma=(4.0,) * 3 + (6.0,) * 3,
        placement="rays",
        nearest_depth=1.0,
        scale_sigma=0.4,
        **_SPATIAL,
    )
    yield Scenario(
        name="drifting-patches",
        steps=150,
        velocity=(1.2, 0.0, 0.0, 0.0, 0.0, 0.0),
        velocity_sigma=_SPATIAL_NOISE["-loose"][1],
        acceleration_sigma=_SPATIAL_NOISE["-loose"][0],
        placement="rays",
        nearest_depth=1.0,
        drift_sigma=0.2,
        drift_wrong=0.05,
        **_SPATIAL,
    )
    yield from _family(
        "circle",
        _CIRCLE_NOISE,
        steps=200,
        velocity=(0.0, 1.2, 0.3),
        placement="ring",
        landmarks=36,
        calibration="white",
        true_calibration="white",
    )
    yield Scenario(
        name="laps",
        steps=3150,
        velocity=(0.0, 1.2, 0.3),
        acceleration_sigma=(0.02,) * 3,
        placement="ring",
        landmarks=144,
        in_view=24,
    )
    yield Scenario(
        name="laps-6dof",
        rate=10.0,
        steps=1050,
        placement="ring",
        velocity=(0.0, 0.0, 1.2, 0.0, -0.3, 0.0),
        velocity_sigma=(0.0,) * 6,
        acceleration_sigma=(0.1,) * 6,
        motion="odometry",
        odometry_sigma=(0.005,) * 3 + (math.radians(0.05),) * 3,
        in_view=20,
        **around,
    )
    yield from _with_odometry()


def _with_odometry():
    """The settings of two published studies, for comparison with their numbers."""
    degree = math.radians(1)
    yield Scenario(
        name="room",
        geometry="spatial",
        rate=10.0,
        steps=200,
        velocity=(0.0, 0.0, 0.8, 0.0, -9 * degree, 0.0),
        velocity_sigma=(0.0,) * 6,
        motion="odometry",
        odometry_sigma=(0.005,) * 3 + (0.05 * degree,) * 3,
        acceleration_sigma=(0.1,) * 6,
        placement="room",
        landmarks=ROOM_LANDMARKS,
        first_pixels=((0.0, 640.0), (0.0, 480.0)),
        image=(640.0, 480.0),
        focal=(320.0, 320.0),
        centre=(320.0, 240.0),
        pixel_sigma=1.0,
        inverse_depth=(0.01, 0.5),
        first_landmarks=10,
        new_landmarks=1,
        known_landmarks=10,
    )
    for suffix, sigma in (("", 0.02), ("-loose", 0.04)):
        yield Scenario(
            name="positions" + suffix,
            rate=1.0,
            steps=400,
            velocity=(0.0, 0.25, 0.075),
            velocity_sigma=(0.0,) * 3,
            motion="odometry",
            # Wheels do not slip sideways; a millimetre keeps the covariance positive definite.
            odometry_sigma=(0.001, sigma / math.sqrt(2), 2 * math.sqrt(2) * sigma),
            placement="ring",
            landmarks=15,
            ring_radius=0.25 / 0.075 + 2.5,
            sensor="position",
            first_frame=1,
        )


BUILT_IN: dict[str, Scenario] = {s.name: s for s in _built_in()}
