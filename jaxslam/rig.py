"""What a filter is built for: the geometry it lives in, how it moves, what it measures."""

from __future__ import annotations

from dataclasses import dataclass

from jaxslam.geometry import Geometry
from jaxslam.motion import CONSTANT_VELOCITY, Motion
from jaxslam.sensors import CAMERA, Sensor


@dataclass(frozen=True)
class Rig:
    """A sensor that moves; by default a handheld camera."""

    geometry: Geometry
    motion: Motion = CONSTANT_VELOCITY
    sensor: Sensor = CAMERA
