"""The start of an inertial unit by its first readings: at rest, or moving."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import AnyArray
from jaxslam.geometry import retract
from jaxslam.models.imu import Imu, InertialState, increments

RESTLESS = 3.0
"""The scatter of readings at rest is less than so many times what their density allows."""
FAR = 4.0
"""Readings at rest are off by less than so many σ of a bias."""
STILL = 0.01
"""σ of each number of the velocity of a unit at rest, m/s."""
_increments = jax.jit(increments)
_ANYWHERE = 1.0
"""σ of a direction before anything is read, rad: so wide that it does not matter."""

Durations = Float[AnyArray, " m"]
Readings = Float[AnyArray, "m 3"]


def at_rest(imu: Imu, seconds: Durations, gyroscope: Readings, accelerometer: Readings) -> Imu:
    """The model with the start that readings at rest tell, which hold for so many seconds each; the
    start is at their end.

    Of T seconds the mean rate is `b_g` and the mean force `b_a − g d`, with d the direction of
    gravity, but for white noise of density/√T and for what the biases walked since. That is one
    Kalman update of the model's own biases, from which `b_a` and d are correlated. Raises
    ValueError, saying why, for readings that are not of rest.
    """
    T = seconds.sum()
    rate, force = seconds @ gyroscope / T, seconds @ accelerometer / T
    for what, read, mean, density in (
        ("rates", gyroscope, rate, imu.density[0]),
        ("specific forces", accelerometer, force, imu.density[1]),
    ):
        scatter = float(jnp.sqrt(jnp.mean((read - mean) ** 2 * seconds[:, None], axis=0)).max())
        if scatter > RESTLESS * density:
            told = f"{what} scatter as of a density of {scatter:.2g}, {float(density):.2g} is given"
            raise ValueError(f"the unit is not at rest: {told}")
    off = np.array(
        [jnp.linalg.norm(rate - imu.bias[:3]), jnp.linalg.norm(force - imu.bias[3:]) - imu.gravity]
    )
    if (np.abs(off) > FAR * np.hypot(imu.bias_sigma, imu.density / np.sqrt(T))).any():
        told = f"its mean rate is off by {off[0]:.2g} rad/s, its mean force by {off[1]:.2g} m/s²"
        raise ValueError(f"the unit is not at rest: {told}")
    sigma = jnp.hypot(imu.density / jnp.sqrt(T), imu.walk * jnp.sqrt(T / 3))
    begun = replace(imu, velocity=np.zeros(3), start_sigma=(STILL, _ANYWHERE), root=None)

    def read(now: InertialState) -> Float[Array, " 6"]:
        return jnp.concatenate([now.gyroscope_bias, _force(imu, now)])

    return _given(begun, force, read, jnp.concatenate([rate, force]), jnp.repeat(sigma, 3))


def moving(imu: Imu, seconds: Durations, gyroscope: Readings, accelerometer: Readings) -> Imu:
    """The model with the start that readings in motion tell, at their beginning.

    The force of T seconds in the axes of their beginning is `b_a − g d + (v_T − v_0)/T`, with both
    velocities of the model's σ. The biases are known no better than before.
    """
    of = _increments(seconds, gyroscope, accelerometer, imu.bias)
    T, speed = of.seconds, imu.start_sigma[0]
    force = of.sped / T
    begun = replace(imu, velocity=np.zeros(3), start_sigma=(speed, _ANYWHERE), root=None)

    def read(now: InertialState) -> Float[Array, " 3"]:
        return _force(imu, now) - now.velocity / T - imu.bias[3:]

    sigma = jnp.hypot(imu.density[1] / jnp.sqrt(T), speed / T)
    return _given(begun, force + imu.bias[3:], read, force, jnp.repeat(sigma, 3))


def _force(imu: Imu, now: InertialState) -> Float[Array, " 3"]:
    """The specific force at rest."""
    return now.accelerometer_bias - imu.gravity * now.down / jnp.linalg.norm(now.down)


def _given(imu: Imu, force, read, found: Float[Array, " m"], sigma: Float[Array, " m"]) -> Imu:
    """The start of a model given that `read` of its variables is `found` with this σ, where the
    mean specific force tells the direction of gravity."""
    down = imu.bias[3:] - force
    imu = replace(imu, down=down / jnp.linalg.norm(down))
    mean, root = imu.start()
    off = jnp.zeros(len(root), root.dtype)
    H = jax.jacfwd(lambda off: read(retract(mean, off)))(off)
    P = root @ root.T
    gain = jnp.linalg.solve(H @ P @ H.T + jnp.diag(sigma**2), H @ P).T
    wide = jnp.hstack([root - gain @ (H @ root), gain * sigma])
    now = retract(mean, gain @ (found - read(mean)))
    now = replace(now, down=now.down / jnp.linalg.norm(now.down))
    return imu.begun(now, jnp.linalg.qr(wide.T, mode="r").T)
