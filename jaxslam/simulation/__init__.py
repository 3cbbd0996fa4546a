"""Simulation: scenarios as data, and runs drawn from them."""

from jaxslam.simulation.scenario import BUILT_IN, Scenario, scenario
from jaxslam.simulation.world import (
    Prior,
    Run,
    Sightings,
    features,
    parameters,
    sightings,
    simulate,
    structure,
)

__all__ = [
    "BUILT_IN",
    "Prior",
    "Run",
    "Scenario",
    "Sightings",
    "features",
    "parameters",
    "scenario",
    "sightings",
    "simulate",
    "structure",
]
