"""Estimates from two measured pixels: a Gaussian of the landmark's parameters.

Inverse Scaling and Unified Inverse Depth come out of the library's own robocentric filter, a
Cartesian point out of classical first-order triangulation. Each Gaussian is in parameters of its
own; pushed through `homogeneous` it is bent as the parametrization bends it.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.filters.slam import Slam
from jaxslam.geometry import Scalar
from jaxslam.landmarks import LANDMARKS, AbstractLandmark
from jaxslam.linalg import semidefinite_root
from jaxslam.models.observations import Features
from jaxslam.triangulation.samples import Samples, draw
from jaxslam.triangulation.truth import intersect
from jaxslam.triangulation.views import NOISE_DIM, Given, TwoViews

FILTERED = ("inverse_scaling", "inverse_depth")
ESTIMATES = (*FILTERED, "cartesian")
"""Names of the estimates, which are those of their parametrizations."""

Gaussian = tuple[Float[Array, " d"], Float[Array, "d d"]]
"""Mean and covariance of a landmark's parameters in the second camera."""


def estimate(name: str, views: TwoViews, pixels: Float[Array, " 2"]) -> Gaussian:
    """The named estimate from two measured pixels."""
    given = views.given(pixels)
    if name == "cartesian":
        return triangulated(views.calibration, given)
    return filtered(given.filter(views.calibration, LANDMARKS[name]), given.pixels)


@eqx.filter_jit
def filtered(slam: Slam, pixels: Float[Array, " 2"]) -> Gaussian:
    """The landmark after a filter's first two frames, one second apart: seen new, seen again."""

    def seen(pixels):
        slots = jnp.zeros(pixels.size, int)
        return Features(slots, pixels[:, None], jnp.ones(pixels.size, bool))

    state = slam.init(1, seen(pixels[:1]))
    state, _ = slam.step(state, jnp.ones(()), seen(pixels[1:]), seen(pixels[2:]))
    own = slice(state.core_dim, None)
    return state.landmarks[0], state.covariance[own, own]


@partial(jax.jit, static_argnames="calibration")
def triangulated(calibration: str, given: Given) -> Gaussian:
    """(x, z) where the measured rays meet, and `J Jᵀ`, J its Jacobian by the standardised errors.

    The classical Gaussian of a Cartesian point, to first order; it needs rays that meet.
    """

    def point(normal):
        numerator, omega, _ = intersect(calibration, given, normal)
        return numerator / omega

    exact = jnp.zeros(NOISE_DIM)
    J = jax.jacfwd(point)(exact)
    return point(exact), J @ J.T


def pushed(
    landmark: AbstractLandmark, gaussian: Gaussian, normal: Float[Array, " k"]
) -> tuple[Float[Array, " 2"], Scalar, Scalar]:
    """One sample of a Gaussian of a landmark, as a homogeneous point, with weight 1.

    `gaussian` holds the mean and a root of the covariance.
    """
    mean, root = gaussian
    point, omega = landmark.homogeneous(mean + root @ normal[: mean.size])
    return point, omega, jnp.zeros_like(omega)


def push(name: str, gaussian: Gaussian, count: int, seed: int) -> Samples:
    """`count` points of the named estimate."""
    mean, covariance = gaussian
    return draw(
        pushed, LANDMARKS[name], (mean, jax.jit(semidefinite_root)(covariance).root), count, seed
    )
