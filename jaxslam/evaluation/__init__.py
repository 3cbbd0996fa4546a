"""The evaluation of any filter: from errors and covariances, in arrays or files, to a verdict."""

from jaxslam.evaluation.convention import (
    CHOICES,
    Convention,
    converted,
    pose_errors,
    read_covariances,
    write_covariances,
)
from jaxslam.evaluation.convention_search import Identification
from jaxslam.evaluation.inputs import read_pose_log
from jaxslam.evaluation.log_files import evaluate_log
from jaxslam.evaluation.poses import evaluate_poses
from jaxslam.evaluation.result import Evaluation, advice, evaluate, evaluate_nees
from jaxslam.evaluation.scale import errors_beyond_scale

__all__ = [
    "CHOICES",
    "Convention",
    "Evaluation",
    "Identification",
    "advice",
    "converted",
    "errors_beyond_scale",
    "evaluate",
    "evaluate_log",
    "evaluate_nees",
    "evaluate_poses",
    "pose_errors",
    "read_covariances",
    "read_pose_log",
    "write_covariances",
]
