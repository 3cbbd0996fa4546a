"""The public names and their modules, for type checkers and for `__init__.py`, which reads them."""

from jaxslam._numerics.arrays import cast
from jaxslam._version import __version__
from jaxslam.consistency import monte_carlo, summarise, table
from jaxslam.evaluation import Convention, Evaluation, evaluate, evaluate_log, evaluate_poses
from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.forms.state import State
from jaxslam.filters.protocol import (
    AbstractFilter,
    AbstractStaged,
    CameraView,
    Expected,
    LandmarkView,
)
from jaxslam.filters.readouts import (
    camera_pose,
    landmark_samples,
    landmarks_from_above,
    landmarks_in_camera,
    landmarks_in_world,
)
from jaxslam.filters.registry import FILTERS, make_filter, make_filters
from jaxslam.filters.run import Frames, run
from jaxslam.filters.wrappers.fixed_lag import FixedLag
from jaxslam.filters.wrappers.gaussian_sum import GaussianSum
from jaxslam.geometry import PLANAR, SPATIAL
from jaxslam.landmarks import LANDMARKS, Parametrization, check_landmark
from jaxslam.models.calibration import AbstractCalibration, Considered, Estimated, Known, White
from jaxslam.models.camera import Camera
from jaxslam.models.coordinates import KEYFRAME, ROBOCENTRIC, WORLD
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import AbstractMotion, ConstantVelocity, Odometry
from jaxslam.models.observations import Capacity, Features, Innovation, PriorMap, Status
from jaxslam.models.scale import Metre, ScaleGauge
from jaxslam.models.sensors import AbstractSensor, Pinhole, Position, RangeBearing
from jaxslam.simulation import (
    AbstractPlacement,
    FromPrior,
    GivenPoints,
    Rays,
    Ring,
    Scenario,
    World,
    scenario,
    simulate,
)
from jaxslam.statistics import mean_band
from jaxslam.tracking.settings import TrackerSettings as TrackerSettings
from jaxslam.tracking.tracker import Tracker as Tracker

__all__ = [
    "FILTERS",
    "KEYFRAME",
    "LANDMARKS",
    "PLANAR",
    "ROBOCENTRIC",
    "SPATIAL",
    "WORLD",
    "AbstractCalibration",
    "AbstractFilter",
    "AbstractMotion",
    "AbstractPlacement",
    "AbstractSensor",
    "AbstractStaged",
    "Camera",
    "CameraView",
    "Capacity",
    "Considered",
    "ConstantVelocity",
    "Convention",
    "EkfSlam",
    "Estimated",
    "Evaluation",
    "Expected",
    "Features",
    "FixedLag",
    "Frames",
    "FromPrior",
    "GaussianSum",
    "GivenPoints",
    "Innovation",
    "InverseDepth",
    "Known",
    "LandmarkView",
    "Metre",
    "Odometry",
    "Parametrization",
    "Pinhole",
    "Position",
    "PriorMap",
    "RangeBearing",
    "Rays",
    "Ring",
    "ScaleGauge",
    "Scenario",
    "State",
    "Status",
    "White",
    "World",
    "__version__",
    "camera_pose",
    "cast",
    "check_landmark",
    "evaluate",
    "evaluate_log",
    "evaluate_poses",
    "landmark_samples",
    "landmarks_from_above",
    "landmarks_in_camera",
    "landmarks_in_world",
    "make_filter",
    "make_filters",
    "mean_band",
    "monte_carlo",
    "run",
    "scenario",
    "simulate",
    "summarise",
    "table",
]
