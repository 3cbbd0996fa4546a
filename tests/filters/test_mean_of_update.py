"""The update that ends at the mean of the posterior: the estimate is not biased, on the average."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from cases import quick_jit

from jaxslam.filters.linear.kalman import Kalman
from jaxslam.filters.slam import Slam
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import Odometry
from jaxslam.models.observations import Features
from jaxslam.models.sensors import Pinhole

COUNT, DRAWS = 8, 1000
DEPTH = InverseDepth(0.25, 0.05)


def one_draw(slam, key):
    """Errors of a camera's displacement to the side, of which odometry knows a tenth, past
    landmarks of unknown depth, in σ: of the posterior's maximum, and of its mean."""
    keys = jax.random.split(key, 4)
    depths = 1 / (DEPTH.mean + DEPTH.sigma * jax.random.normal(keys[0], (COUNT,)))
    points = jnp.stack([jnp.linspace(-0.5, 0.5, COUNT) * depths, depths], axis=1)
    control = jnp.array([0.4, 0.0, 0.0])
    off = slam.motion.noise_sigma * jax.random.normal(keys[1], (3,))
    T = slam.motion.displacement((), off, control)

    def seen(points, key):
        pixels = jax.vmap(lambda x: slam.sensor.measure(x, 1.0))(points)
        pixels += slam.sensor.sigma * jax.random.normal(key, pixels.shape)
        return Features(jnp.arange(COUNT), pixels, jnp.ones(COUNT, bool))

    before = slam.predict(slam.init(COUNT, seen(points, keys[2])), control)
    now = seen(jax.vmap(lambda point: T.inverse() @ point)(points), keys[3])

    def error(mean):
        one = replace(slam, correction=Kalman(3, mean=mean))
        state, _ = one.update(before, control, now)
        error, P = one.pose_error(one.compose(state, control), T)
        return error[0] / jnp.sqrt(P[0, 0])

    return error(False), error(True)


def test_the_mean_of_a_posterior_is_not_biased_where_its_maximum_is():
    """Parallax is a product of two unknowns, likeliest at too long a displacement."""
    sensor = Pinhole(Camera([400.0], [320.0]), 0.5)
    slam = Slam(Odometry([0.04, 0.01, 0.001]), sensor, depth=DEPTH)
    keys = jax.random.split(jax.random.key(3), DRAWS)
    of_maximum, of_mean = map(np.asarray, quick_jit(jax.vmap(partial(one_draw, slam)))(keys))
    assert of_maximum.mean() > 0.25
    assert abs(of_mean.mean()) < 0.1
    assert abs(np.mean(of_mean**2) - 1) < 0.15
