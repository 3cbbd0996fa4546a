"""The public names and their modules, for type checkers and for `__init__.py`, which reads them."""

from jaxslam._numerics.arrays import cast
from jaxslam._version import __version__
from jaxslam.consistency import Tuning, monte_carlo, summarise, table, tune
from jaxslam.evaluation import Convention, Evaluation, evaluate, evaluate_log, evaluate_poses
from jaxslam.filters.gate import Gate
from jaxslam.filters.linear.kalman import AbstractCorrection, Kalman
from jaxslam.filters.linear.state import State
from jaxslam.filters.mixture.mixture import Mixture
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
from jaxslam.filters.recommended import paper, recommended
from jaxslam.filters.remedies.first_estimates import FirstEstimates
from jaxslam.filters.remedies.invariant import Invariant
from jaxslam.filters.remedies.observability_constrained import ObservabilityConstrained
from jaxslam.filters.remedies.random_walk import RandomWalk
from jaxslam.filters.run import Frames, MeasuredRun, measured_run, run
from jaxslam.filters.slam import Slam
from jaxslam.filters.window.start import FromWindow, Schedule
from jaxslam.filters.words import FILTERS, make_filter, make_filters
from jaxslam.geometry import PLANAR, SPATIAL
from jaxslam.landmarks import (
    LANDMARKS,
    AbstractLandmark,
    AnchoredHomogeneous,
    Cartesian,
    FramedHomogeneous,
    ImagePlane,
    InverseDepthToCartesian,
    InverseScaling,
    ParallaxAngle,
    UnifiedInverseDepth,
    UnitHomogeneous,
    check_landmark,
)
from jaxslam.models.calibration import AbstractCalibration, Considered, Estimated, Known, White
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.frame import AbstractFrame, Keyframe, Robocentric, Submaps, WorldCentric
from jaxslam.models.imu import Imu, Increments, increments
from jaxslam.models.lens import AbstractLens, Fisheye, Ideal, RadialTangential, Rational
from jaxslam.models.motion import AbstractMotion, ConstantVelocity, Odometry
from jaxslam.models.observations import Capacity, Features, Innovation, PriorMap, Status
from jaxslam.models.scale import AbstractScale, Metre, ScaleGauge
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
    "LANDMARKS",
    "PLANAR",
    "SPATIAL",
    "AbstractCalibration",
    "AbstractCorrection",
    "AbstractFilter",
    "AbstractFrame",
    "AbstractLandmark",
    "AbstractLens",
    "AbstractMotion",
    "AbstractPlacement",
    "AbstractScale",
    "AbstractSensor",
    "AbstractStaged",
    "AnchoredHomogeneous",
    "Camera",
    "CameraView",
    "Capacity",
    "Cartesian",
    "Considered",
    "ConstantVelocity",
    "Convention",
    "Estimated",
    "Evaluation",
    "Expected",
    "Features",
    "FirstEstimates",
    "Fisheye",
    "FramedHomogeneous",
    "Frames",
    "FromPrior",
    "FromWindow",
    "Gate",
    "GivenPoints",
    "Ideal",
    "ImagePlane",
    "Imu",
    "Increments",
    "Innovation",
    "Invariant",
    "InverseDepth",
    "InverseDepthToCartesian",
    "InverseScaling",
    "Kalman",
    "Keyframe",
    "Known",
    "LandmarkView",
    "MeasuredRun",
    "Metre",
    "Mixture",
    "ObservabilityConstrained",
    "Odometry",
    "ParallaxAngle",
    "Pinhole",
    "Position",
    "PriorMap",
    "RadialTangential",
    "RandomWalk",
    "RangeBearing",
    "Rational",
    "Rays",
    "Ring",
    "Robocentric",
    "ScaleGauge",
    "Scenario",
    "Schedule",
    "Slam",
    "State",
    "Status",
    "Submaps",
    "Tuning",
    "UnifiedInverseDepth",
    "UnitHomogeneous",
    "White",
    "World",
    "WorldCentric",
    "__version__",
    "camera_pose",
    "cast",
    "check_landmark",
    "evaluate",
    "evaluate_log",
    "evaluate_poses",
    "increments",
    "landmark_samples",
    "landmarks_from_above",
    "landmarks_in_camera",
    "landmarks_in_world",
    "make_filter",
    "make_filters",
    "mean_band",
    "measured_run",
    "monte_carlo",
    "paper",
    "recommended",
    "run",
    "scenario",
    "simulate",
    "summarise",
    "table",
    "tune",
]
