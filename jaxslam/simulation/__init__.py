"""Simulation: worlds of pieces, scenarios by name, and runs drawn from them."""

from jaxslam._runtime import imported
from jaxslam.simulation.draw import as_data, simulate, trajectory_of, with_own
from jaxslam.simulation.placement import Cloister, FromPrior, GivenPoints, Rays, Ring
from jaxslam.simulation.run import Room, Run, features, gone, sightings
from jaxslam.simulation.scenario import BUILT_IN, as_scenario, scenario
from jaxslam.simulation.trajectories import RecordedMotion
from jaxslam.simulation.world import (
    AbstractPlacement,
    AbstractTrueCalibration,
    ConstantCalibration,
    Drift,
    Limits,
    NominalCalibration,
    WhiteCalibration,
    World,
)

Scenario = World
"""The name of a world in versions before 0.6."""

__all__ = imported(globals())
