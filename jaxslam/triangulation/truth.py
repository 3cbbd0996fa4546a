"""The posterior of a point given two measured pixels: exact, by particles.

Two answers are called the truth. *Triangulation* is the paper's: every particle is where two rays
meet, through the measured pixels less their noise and intrinsics as they may be. *Posterior* is
Bayes's with the prior on inverse depth that Inverse Scaling and Unified Inverse Depth use: the
same particles with weights. A filter with a prior can at best have the second; the first-order
Gaussian of a Cartesian point, which has no prior, the first.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam.geometry import Scalar
from jaxslam.models.camera import bearing
from jaxslam.triangulation.samples import Samples, draw
from jaxslam.triangulation.views import Given, TwoViews, errors


def intersect(
    calibration: str, given: Given, normal: Float[Array, " 6"]
) -> tuple[Float[Array, " 2"], Scalar, Scalar]:
    """The point where two rays meet: (x, z, ω) = (b₂, 1, (b₁ − b₂)/baseline), b = (u − c)/f.

    In the second camera, with the errors that belong to the standard normal numbers; at infinity
    or beyond where the rays do not meet (ω ≤ 0). Third, the logarithm of the posterior's density
    relative to that of the particles: `N(1/z) / f₂`, the prior and |∂(1/z)/∂u₂|, without constants.
    The prior is flat in the ideal first pixel, as it is when a filter takes it for the landmark's.
    """
    pixel_errors, intrinsics_errors = errors(calibration, given, normal)
    cameras = jax.vmap(given.sensor.camera.perturbed)(intrinsics_errors)
    first, second = jax.vmap(bearing)(cameras, (given.pixels + pixel_errors)[:, None])[:, 0]
    inverse_depth = (first - second) / given.baseline
    surprise = (inverse_depth - given.depth.mean) / given.depth.sigma
    log_weight = -(surprise**2) / 2 - jnp.log(cameras.focal[1, 0])
    return jnp.stack([second, jnp.ones_like(second)]), inverse_depth, log_weight


def particles(
    views: TwoViews, pixels: Float[Array, " 2"], count: int, seed: int
) -> dict[str, Samples]:
    """`triangulation` and `posterior` given two measured pixels."""
    posterior = draw(intersect, views.calibration, views.given(pixels), count, seed)
    alike = posterior._replace(weight=np.ones_like(posterior.weight))
    return {"triangulation": alike, "posterior": posterior}
