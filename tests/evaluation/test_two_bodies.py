"""A truth of another body of the same robot: the rotation and the lever arm between both."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxslam

STEPS = 400
SIGMA = np.repeat([0.005, 0.002], 3)


def rigid(rotvec, position):
    T = np.tile(np.eye(4), (*np.shape(rotvec)[:-1], 1, 1))
    T[..., :3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[..., :3, 3] = position
    return T


def moving(tilt=0.4):
    """A body that turns about all axes; errors of the right size, along its axes."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, 20, STEPS)
    angles = np.column_stack([tilt * np.sin(t), tilt * np.cos(1.3 * t), 0.3 * t])
    T = rigid(
        Rotation.from_euler("xyz", angles).as_rotvec(),
        np.column_stack([3 * np.sin(0.3 * t), 2 * np.cos(0.2 * t), 0.5 * np.sin(0.5 * t)]),
    )
    noise = SIGMA * rng.normal(size=(STEPS, 6))
    return T, T @ rigid(noise[:, 3:], noise[:, :3])


@pytest.mark.parametrize("align", ["none", "se3"])
def test_both_are_found_and_without_them_the_filter_is_right(align):
    T, truth = moving()
    world = rigid(
        [0.0, 0.0, 0.8 if align != "none" else 0.0],
        float(align != "none") * np.array([4.0, 1.0, 2.0]),
    )
    arm = np.array([0.12, -0.05, 0.09])
    truth = world @ truth @ rigid([0.03, 0.0, -0.02], arm)
    P = np.tile(np.diag(SIGMA**2), (STEPS, 1, 1))
    found = jaxslam.evaluate_poses(T[None], P[None], truth[None], align=align)
    (cause,) = found.causes
    assert cause.what == "estimate and truth are of two bodies"
    turn, metres = map(
        float, re.findall(r"rotation of ([\d.]+)° and a lever arm of ([\d.]+) m", cause.told)[0]
    )
    assert turn == pytest.approx(np.degrees(np.hypot(0.03, 0.02)), rel=0.02)
    assert metres == pytest.approx(np.linalg.norm(arm), rel=0.02)
    position, rotation = map(
        float, re.findall(r"position ([\d.]+) of 3, rotation ([\d.]+) of 3", cause.told)[0]
    )
    assert abs(position - 3) < 0.6
    assert abs(rotation - 3) < 0.6


def test_a_direction_that_is_not_determined_has_no_lever_arm():
    """A robot that turns about the vertical alone: a height of the truth is its world's."""
    T, truth = moving(tilt=0.0)
    truth = truth @ rigid(np.zeros(3), [0.1, 0.0, 0.3])
    P = np.tile(np.diag(SIGMA**2), (STEPS, 1, 1))
    found = jaxslam.evaluate_poses(T[None], P[None], truth[None], align="se3")
    (cause,) = found.causes
    assert float(re.findall(r"a lever arm of ([\d.]+) m", cause.told)[0]) == pytest.approx(
        0.1, rel=0.03
    )
