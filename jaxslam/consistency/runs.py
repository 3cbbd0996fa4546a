"""A filter on a simulated run: frame by frame, and the records of every step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxslam.filters.protocol import AbstractFilter, Belief
from jaxslam.filters.readouts import (
    camera_pose,
    camera_pose_in_unit,
    landmarks_from_above,
    landmarks_in_camera,
)
from jaxslam.filters.run import MeasuredRun
from jaxslam.filters.run import run as run_filter
from jaxslam.geometry import Pose, difference
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features, Innovation
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import Room, Run, features, gone
from jaxslam.statistics.bands import normalised_squared
from jaxslam.statistics.beyond_scale import SCALE, beyond_scale, reversal

Output = TypeVar("Output")


class SimulatedFrame(NamedTuple):
    """The data that a filter is given of a frame after frame 0, and the truth; or of all frames."""

    control: Control
    """The control of the motion model, such as seconds or the reading of an odometry."""
    seen: Features
    """The features of landmarks in the map."""
    new: Features
    """The features of landmarks to insert."""
    gone: Bool[Array, "*frames slots"] | None
    """Slots whose landmark will not be seen again; None where landmarks keep theirs."""
    pose: Pose
    """The true T_BC."""
    points: Float[Array, "*frames slots n"]
    """The true points in B that the slots stand for now."""


def run_through(
    slam: AbstractFilter,
    room: Room,
    run: Run,
    output: Callable[[Belief, Innovation, SimulatedFrame], Output],
) -> tuple[Belief, Output]:
    """Return the last state, and `output(state, innovation, frame)` of every frame but 0.

    Landmarks that are gone are removed before the step. Raises ValueError for a filter that
    cannot, where a run uses slots again.
    """
    given = of_simulation(room, run)
    return run_filter(slam, given.frames, given.start(slam), output)


def of_simulation(room: Room, run: Run) -> MeasuredRun:
    """Return what a filter is given of a simulated run, with the truth."""
    first, seen, new = features(run, room)
    poses, points = jax.tree.map(lambda x: x[1:], (run.poses, run.points_by_frame))
    frames = SimulatedFrame(run.controls, seen, new, gone(run, room), poses, points)
    return MeasuredRun(frames, room.capacity, first, run.known, poses, run.motion)


def filter_run(
    slam: AbstractFilter, room: Room, sensor: AbstractSensor, run: Run
) -> tuple[dict[str, Array], Pose, Belief]:
    """Return the records of every step of a simulated run, the estimated path, the last state.

    The records of every step are:

    - `nees`: the NEES of the pose;
    - `log_scale`: the scale of the truth at which it is least; `log_scale_sigma`: the σ that the
      filter claims of it, with the metre in doubt;
    - `beyond_scale`, `unit_log_scale`, `unit_log_scale_sigma`: the same in the filter's own unit,
      from which `one_scale` makes NEES at one scale per run; `unit_fixed`: whether it has a unit;
    - `reversed`: whether the displacement points away from the truth, NaN without one;
    - `nis`, `nis_dof`, `status`: what the update reports;
    - `error`, `variance`: those of the camera's position, in camera axes, and orientation;
    - `landmark_nees`: the mean of the landmarks seen, in the sensor's chart, where it is finite;
      `landmark_count`: their number; `landmark_not_finite`: of how many it is not.
    """

    def records_and_pose(state, innovation, frame: SimulatedFrame):
        T_BC = frame.pose
        estimate, covariance = camera_pose(slam, state)
        records = {
            "nees": normalised_squared(*slam.pose_error(state, T_BC)),
            **scale_records(slam, state, T_BC),
            "reversed": reversal(estimate, T_BC),
            "nis": innovation.nis,
            "nis_dof": innovation.nis_dof.astype(innovation.nis.dtype),
            "status": innovation.status,
            "error": _camera_error(estimate, T_BC),
            "variance": jnp.diagonal(covariance),
            **_landmark_records(slam, sensor, state, frame),
        }
        return records, estimate

    state, (records, path) = run_through(slam, room, run, records_and_pose)
    return records, path, state


def scale_records(
    slam: AbstractFilter, state: Belief, T_BC: Pose, truth_sigma: np.ndarray | None = None
) -> dict[str, Array]:
    """Return the records of one pose's scale: in metres, and `SCALE` in the filter's own unit.

    For a truth that is itself known with σ only see `beyond_scale`.
    """
    metric = in_unit = beyond_scale(partial(slam.pose_error, state), T_BC, truth_sigma)
    if slam.model is not None and slam.model.scale.free:
        seen = camera_pose_in_unit(slam, state)
        in_unit = beyond_scale(
            lambda truth: (difference(truth, seen.pose), seen.covariance), T_BC, truth_sigma
        )
    own = zip(SCALE, (*in_unit, slam.unit_fixed(state).astype(metric.nees.dtype)), strict=True)
    return {"log_scale": metric.log_scale, "log_scale_sigma": metric.sigma, **dict(own)}


def _camera_error(estimate: Pose, truth: Pose) -> Array:
    """The position error in the estimated camera's axes, then `Log(R_est⁻¹ R_true)`."""
    rotation = estimate.rotation().inverse()
    moved = rotation @ (truth.translation() - estimate.translation())
    return jnp.concatenate([moved, (rotation @ truth.rotation()).log()])


def _landmark_records(
    slam: AbstractFilter, sensor: AbstractSensor, state: Belief, frame: SimulatedFrame
) -> dict[str, Array]:
    """The mean of the finite NEES of the landmarks seen that are in the map, and both counts."""
    seen = frame.seen
    counted = seen.valid & slam.in_map(state)[seen.slots]
    truth = jax.vmap(frame.pose.inverse().apply)(frame.points[seen.slots])
    truth = jax.vmap(sensor.chart)(truth, jnp.ones_like(truth[:, 0]))
    chart, covariance = landmarks_in_camera(slam, state, seen.slots, sensor)
    error = jnp.where(counted[:, None], truth - chart, 0.0)  # nothing is made of the others
    covariance = jnp.where(counted[:, None, None], covariance, jnp.eye(error.shape[1]))
    nees = jax.vmap(normalised_squared)(error, covariance)
    finite = counted & jnp.isfinite(nees)
    total = jnp.sum(jnp.where(finite, nees, 0.0))
    return {
        "landmark_nees": total / jnp.maximum(jnp.sum(finite), 1),
        "landmark_count": jnp.sum(counted).astype(nees.dtype),
        "landmark_not_finite": jnp.sum(counted & ~finite).astype(nees.dtype),
    }


def map_and_path(
    slam: AbstractFilter, room: Room, path: Pose, state: Belief, run: Run
) -> dict[str, Array]:
    """Return the map and the path that `filter_run` found in a run, and the true ones."""
    landmarks, covariance = landmarks_from_above(slam, state, jnp.arange(room.landmarks))
    return {
        "path": jax.vmap(lambda pose: pose.as_matrix())(path),
        "true_path": jax.vmap(lambda pose: pose.as_matrix())(run.poses),
        "points": run.points_by_frame[-1],
        "landmarks": landmarks,
        "landmarks_covariance": covariance,
        "active": slam.in_map(state),
    }
