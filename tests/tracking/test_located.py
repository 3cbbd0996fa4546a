"""A located camera carries its covariance: by the adjoint, by derivatives, and by draws."""

import jax
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.geometry import jacobian
from jaxslam.io.tum import poses
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance


def located(seed, sigma):
    """A pose some metres and some tenths of a radian away, with a full covariance."""
    rng = np.random.default_rng(seed)
    pose = poses(rng.normal(0, 2, 3), Rotation.from_rotvec(rng.normal(0, 0.7, 3)).as_quat())[0]
    root = sigma * rng.normal(size=(6, 6))
    return PoseWithCovariance(pose, root @ root.T)


def as_pose(matrix):
    return jaxlie.SE3.from_matrix(jax.numpy.asarray(matrix))


def test_the_composed_covariance_is_that_of_the_derivatives():
    first, step = located(0, 0.1), located(1, 0.05)
    both = first.then(step)
    np.testing.assert_allclose(both.T_wc, first.T_wc @ step.T_wc, rtol=0, atol=1e-13)
    J = jacobian(lambda pair: pair[0] @ pair[1], (as_pose(first.T_wc), as_pose(step.T_wc)))
    P = np.block([[first.covariance, np.zeros((6, 6))], [np.zeros((6, 6)), step.covariance]])
    # Float64, a few operations on numbers of order 1.
    np.testing.assert_allclose(both.covariance, J @ P @ J.T, rtol=0, atol=1e-13)


def test_an_exactly_known_origin_changes_nothing():
    step = located(7, 0.1)
    both = PoseWithCovariance().then(step)
    np.testing.assert_allclose(both.T_wc, step.T_wc, rtol=0, atol=1e-15)
    np.testing.assert_allclose(both.covariance, step.covariance, rtol=0, atol=1e-15)
    assert both.sigma_position == pytest.approx(np.sqrt(np.trace(step.covariance[:3, :3])))


def test_points_carry_the_cameras_covariance():
    camera = located(8, 0.1)
    rng = np.random.default_rng(9)
    points, roots = rng.normal(0, 3, (5, 3)), rng.normal(0, 0.2, (5, 3, 3))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    placed, total = camera.points(points, covariances)
    for point, covariance, found, P in zip(points, covariances, placed, total, strict=True):
        tree = (as_pose(camera.T_wc), jax.numpy.asarray(point))
        J = np.asarray(jacobian(lambda both: both[0] @ both[1], tree))
        expected = J[:, :6] @ camera.covariance @ J[:, :6].T + J[:, 6:] @ covariance @ J[:, 6:].T
        np.testing.assert_allclose(found, tree[0] @ tree[1], rtol=0, atol=1e-12)
        np.testing.assert_allclose(P, expected, rtol=0, atol=1e-12)
