"""jaxslam: monocular EKF-SLAM whose uncertainty can be believed.

The models are pure functions of one pose and one landmark; the filters, the Monte Carlo study
and the tracker all run on the same ones. Plots, vision and the command line are imported only
when they are asked for: `jaxslam.plots`, `jaxslam.vision`, `jaxslam.cli`.
"""

__version__ = "0.4.0.dev0"

from jaxslam.camera import Camera
from jaxslam.consistency import mean_band, monte_carlo, summarise, table
from jaxslam.filters import (
    FILTERS,
    Features,
    Filter,
    Parameters,
    SlamFilter,
    State,
    make_filters,
)
from jaxslam.geometry import PLANAR, SPATIAL
from jaxslam.landmarks import LANDMARKS
from jaxslam.simulation import Scenario, scenario, simulate

__all__ = [
    "FILTERS",
    "LANDMARKS",
    "PLANAR",
    "SPATIAL",
    "Camera",
    "Features",
    "Filter",
    "Parameters",
    "Scenario",
    "SlamFilter",
    "State",
    "__version__",
    "make_filters",
    "mean_band",
    "monte_carlo",
    "scenario",
    "simulate",
    "summarise",
    "table",
]
