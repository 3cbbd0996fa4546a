"""Simulation: scenarios as data, and runs drawn from them."""

from jaxslam.simulation.pieces import calibration_sigma_of, depth_of, motion_of, sensor_of
from jaxslam.simulation.run import Room, Run, Sightings, features, gone, sightings
from jaxslam.simulation.scenario import BUILT_IN, Scenario, as_scenario, scenario
from jaxslam.simulation.trajectories import RecordedMotion
from jaxslam.simulation.world import as_data, simulate, trajectory_of

__all__ = [
    "BUILT_IN",
    "RecordedMotion",
    "Room",
    "Run",
    "Scenario",
    "Sightings",
    "as_data",
    "as_scenario",
    "calibration_sigma_of",
    "depth_of",
    "features",
    "gone",
    "motion_of",
    "scenario",
    "sensor_of",
    "sightings",
    "simulate",
    "trajectory_of",
]
