"""Simulation: scenarios as data, and runs drawn from them."""

from jaxslam.simulation.pieces import (
    calibration_sigma_of,
    depth_of,
    motion_of,
    sensor_of,
)
from jaxslam.simulation.scenario import BUILT_IN, Scenario, scenario
from jaxslam.simulation.world import (
    Room,
    Run,
    Sightings,
    as_data,
    features,
    sightings,
    simulate,
)

__all__ = [
    "BUILT_IN",
    "Room",
    "Run",
    "Scenario",
    "Sightings",
    "as_data",
    "calibration_sigma_of",
    "depth_of",
    "features",
    "motion_of",
    "scenario",
    "sensor_of",
    "sightings",
    "simulate",
]
