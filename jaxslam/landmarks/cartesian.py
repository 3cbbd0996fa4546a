"""Cartesian points (X, Y, Z): the classical Gaussian, undelayed by a prior on depth."""

from __future__ import annotations

import jax.numpy as jnp

from jaxslam.landmarks.parametrization import Parametrization


def initialise(bearing, inverse_depth, focal):
    """`(x/z, y/z, 1) z`, with the depth z = 1/inverse_depth. `focal` is not used."""
    del focal
    return jnp.append(bearing, 1.0) / inverse_depth


def transform(T_ab, landmark):
    """`X' = R X + t`."""
    return T_ab @ landmark


def homogeneous(landmark):
    """`(X, 1)`: never at infinity."""
    return landmark, jnp.ones((), landmark.dtype)


CARTESIAN = Parametrization(
    name="cartesian",
    size=lambda n: n,
    initialise=initialise,
    transform=transform,
    homogeneous=homogeneous,
)
