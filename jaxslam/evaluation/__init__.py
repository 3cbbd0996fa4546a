"""Anybody's filter: errors and covariances, from arrays or files, to a verdict."""

from jaxslam.evaluation.convention import CHOICES, Convention, converted, pose_errors
from jaxslam.evaluation.covariance_text import read_covariances, write_covariances
from jaxslam.evaluation.evaluate import Evaluation, evaluate
from jaxslam.evaluation.identify import Identification
from jaxslam.evaluation.logs import evaluate_log
from jaxslam.evaluation.poses import evaluate_poses

__all__ = [
    "CHOICES",
    "Convention",
    "Evaluation",
    "Identification",
    "converted",
    "evaluate",
    "evaluate_log",
    "evaluate_poses",
    "pose_errors",
    "read_covariances",
    "write_covariances",
]
