"""Simulation: scenarios as data, and runs drawn from them."""

from jaxslam.simulation.scenario import BUILT_IN, Scenario, scenario
from jaxslam.simulation.world import Run, Sightings, features, parameters, sightings, simulate

__all__ = [
    "BUILT_IN",
    "Run",
    "Scenario",
    "Sightings",
    "features",
    "parameters",
    "scenario",
    "sightings",
    "simulate",
]
