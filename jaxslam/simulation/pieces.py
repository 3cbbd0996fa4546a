"""A scenario's numbers as the pieces of a filter: those of the truth, which the filter is given."""

from __future__ import annotations

from dataclasses import replace

from jaxslam._numerics.arrays import AnyArray, numbers
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import AbstractMotion, ConstantVelocity, Odometry
from jaxslam.models.sensors import AbstractSensor, Pinhole, Position
from jaxslam.simulation.scenario import Scenario


def motion_of(scenario: Scenario) -> AbstractMotion:
    """The motion model, with the noise of the truth and its start."""
    if scenario.motion == "odometry":
        return Odometry(scenario.odometry_sigma)
    return ConstantVelocity(scenario.acceleration_sigma, scenario.velocity, scenario.velocity_sigma)


def sensor_of(scenario: Scenario) -> AbstractSensor:
    """The sensor, of nominal calibration."""
    if scenario.sensor == "position":
        return Position(scenario.position_sigma, point_dim=scenario.world.point_dim)
    return Pinhole(Camera(scenario.focal, scenario.centre), scenario.pixel_sigma)


def calibration_sigma_of(scenario: Scenario) -> AnyArray:
    """σ of (f, c) or (fx, fy, cx, cy), pixels."""
    p = scenario.world.pixel_dim
    return numbers((scenario.focal_sigma,) * p + (scenario.centre_sigma,) * p)


def depth_of(scenario: Scenario) -> InverseDepth:
    """The prior on 1/z."""
    if scenario.inverse_depth:
        depth = InverseDepth(*scenario.inverse_depth)
    else:
        depth = InverseDepth.beyond(scenario.nearest_depth)
    return replace(depth, unit=numbers(scenario.scale_sigma)) if scenario.scale_sigma else depth
