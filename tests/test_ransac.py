"""Tests of jaxslam.slam.ransac: both gates, and that the best hypothesis decides."""

from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit

from jaxslam.forms.state import Features
from jaxslam.slam.ransac import LOW_INNOVATION, RESCUE, inliers

SIGMA = 0.3


@cache
def matched():
    """A filter, the predicted state of its second frame, and the pixels of six landmarks there."""
    case = Case("matched-6dof", steps=1, landmarks=6)
    slam, control = case.filter("robocentric"), case.controls()[0]
    sigma = slam.motion.velocity_sigma.copy()
    sigma[4] = 0.5  # a turn to the side by 17 mrad, 11 pixels
    slam = replace(slam, motion=replace(slam.motion, velocity_sigma=sigma))

    def predicted(first):
        state = slam.predict(slam.init(case.capacity, first), control)
        return state, slam.predict_features(state, control, jnp.arange(6)).measured

    state, pixels = quick_jit(predicted)(case.frames(0)[0])
    return slam, state, control, pixels


@cache
def compiled(**gates):
    slam, _, control, _ = matched()
    return quick_jit(lambda state, seen: inliers(slam, state, control, seen, **gates))


def agree(state, offsets, valid=None, **gates):
    """Which of six matches agree, that are off by these pixels from where they are predicted."""
    pixels = matched()[-1] + jnp.asarray(offsets)
    valid = np.ones(6, bool) if valid is None else valid
    return compiled(**gates)(state, Features(jnp.arange(6), pixels, jnp.asarray(valid))).tolist()


def certain():
    """The state without uncertainty: no hypothesis moves it, and S is R."""
    state = matched()[1]
    return replace(state, covariance=jnp.zeros_like(state.covariance))


def test_a_match_agrees_within_the_low_innovation_in_pixels():
    """The length of the error counts: (1.5, 1.5) is too far."""
    near, far = LOW_INNOVATION - 0.01, LOW_INNOVATION + 0.01
    offsets = [[0, 0], [near, 0], [0, -near], [far, 0], [0, -far], [1.5, 1.5]]
    assert agree(certain(), offsets, rescue=0.0) == [True, True, True, False, False, False]


def test_a_match_is_rescued_within_its_ellipse():
    reach = SIGMA * np.sqrt(RESCUE)
    near, far = 0.99 * reach, 1.01 * reach
    offsets = [[0, 0], [near, 0], [0, -near], [far, 0], [0, -far], [0.8 * near, 0.8 * near]]
    found = agree(certain(), offsets, low_innovation=1e-6)
    assert found == [True, True, True, False, False, False]


def test_what_the_filter_does_not_know_is_no_outlier():
    """All are off by one turn of the camera: each explains the others, but not the stranger."""
    offsets = np.tile([4.0, 0.0], (6, 1))
    offsets[2] = [-30.0, 20.0]
    assert agree(matched()[1], offsets) == [True, True, False, True, True, True]


@pytest.mark.parametrize("gates", [{}, {"low_innovation": 1e-6}], ids=["low", "rescued"])
def test_a_match_that_is_not_valid_never_agrees(gates):
    valid = np.arange(6) != 3
    assert agree(certain(), np.zeros((6, 2)), valid, **gates) == valid.tolist()
