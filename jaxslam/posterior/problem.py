"""The generative model of a simulated run in whitened variables: what its posterior is made of.

The unknowns y are standard normal a priori: the initial velocity, the white acceleration of every
step, and of every landmark its true pixel in frame 0 and its inverse depth. With the measurements
z of the later frames, `−log p(y | z) = ½ |r(y)|² + const` for the residuals
`r = [y; (z − h(y))/σ_px]`, which is all that a sampler or a least-squares solver needs.

The path, the landmarks and the pixels are those of `jaxslam.models`; a
landmark is the homogeneous point (bearing, 1, ω) of frame 0, so that ω = 0 is nothing special.

Two things that the simulator does are left out: a first pixel is drawn inside the picture, and a
landmark outside the picture is not measured. Both are nearly functions of what is measured: they
tell at the most that a noise-free pixel is less than a few σ_px beyond the edge.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr, ndtri
from jaxtyping import Array, Bool, Float

from jaxslam.arrays import cast
from jaxslam.geometry import Pose, homogeneous_apply, identity
from jaxslam.models.camera import bearing
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.sensors import Pinhole
from jaxslam.simulation import Run, Scenario, depth_of, motion_of, sensor_of


class Problem(eqx.Module):
    """What is known of one run: the prior and the measurements. Batched by `vmap`."""

    motion: ConstantVelocity
    sensor: Pinhole
    depth: InverseDepth
    least_inverse_depth: Float[Array, ""]
    """The prior on 1/z is truncated below this, 1/m; −∞ for the whole Gaussian."""
    first: Float[Array, "l p"]
    """Pixels of frame 0."""
    measured: Float[Array, "steps l p"]
    """Pixels of the later frames."""
    visible: Bool[Array, "steps l"]
    """Which of them were measured."""
    controls: Float[Array, " steps"]
    """Seconds of every step."""


class Unknowns(eqx.Module):
    """The physical quantities that the whitened variables stand for."""

    velocity: Float[Array, " t"]
    """Before the first step, in the camera frame, m/s and rad/s."""
    accelerations: Float[Array, "steps t"]
    pixels: Float[Array, "l p"]
    """True pixels of frame 0."""
    inverse_depths: Float[Array, " l"]
    """1/z in frame 0, 1/m."""


def check_scenario(scenario: Scenario) -> None:
    """Raise ValueError unless runs of the scenario have the generative model of this module."""
    wanted = {
        "placement": "prior",
        "motion": "velocity",
        "sensor": "camera",
        "trajectory": "",
        "still_frames": 0,
        "calibration": "known",
        "true_calibration": "nominal",
        "first_frame": 0,
        "first_landmarks": 0,
        "known_landmarks": 0,
    }
    for field, value in wanted.items():
        if getattr(scenario, field) != value:
            raise ValueError(
                f"the exact posterior needs a scenario whose {field} is {value!r}, as in matched; "
                f"{scenario.name} has {getattr(scenario, field)!r}"
            )
    for (low, high), size in zip(scenario.first_pixels, scenario.image, strict=True):
        if low < 0 or high > size:
            raise ValueError(
                f"the exact posterior needs every landmark seen in frame 0: first_pixels "
                f"{(low, high)} of {scenario.name} leave the picture of {size} pixels"
            )


def first_steps(run: Run, steps: int) -> Run:
    """The run up to a step. Raises ValueError unless it has so many."""
    if not 1 <= steps <= len(run.controls):
        raise ValueError(f"the run has {len(run.controls)} steps; steps must be 1 to that many")
    until = slice(steps + 1)
    return replace(
        run,
        poses=jax.tree.map(lambda x: x[until], run.poses),
        measured=run.measured[until],
        visible=run.visible[until],
        controls=run.controls[:steps],
    )


def make_problem(scenario: Scenario, run: Run, *, truncated: bool = True) -> Problem:
    """The run as seen by who knows the scenario and the measurements.

    With `truncated` the prior on 1/z is the one that landmarks are drawn from; without, the whole
    Gaussian that the filters believe, with its mass at ω < 0. Raises ValueError for a scenario of
    another kind.
    """
    check_scenario(scenario)
    pieces = motion_of(scenario), sensor_of(scenario), depth_of(scenario)
    motion, sensor, depth = cast(pieces, run.measured.dtype)
    assert isinstance(motion, ConstantVelocity)
    assert isinstance(sensor, Pinhole)
    return Problem(
        motion=motion,
        sensor=sensor,
        depth=depth,
        least_inverse_depth=jnp.asarray(scenario.least_inverse_depth if truncated else -jnp.inf),
        first=run.measured[0],
        measured=run.measured[1:],
        visible=run.visible[1:],
        controls=run.controls,
    )


def size(problem: Problem) -> int:
    """How many whitened variables there are."""
    steps, landmarks, p = problem.measured.shape[-3:]
    return (steps + 1) * problem.motion.velocity.shape[-1] + landmarks * (p + 1)


def unknowns(problem: Problem, y: Float[Array, " n"]) -> Unknowns:
    """What y stands for."""
    motion, depth = problem.motion, problem.depth
    t, (steps, landmarks, p) = motion.velocity.size, problem.measured.shape
    ends = [t, t * (steps + 1), t * (steps + 1) + landmarks * p]
    velocity, accelerations, pixels, depths = jnp.split(y, ends)
    lower = (problem.least_inverse_depth - depth.mean) / depth.sigma
    return Unknowns(
        velocity=motion.velocity + motion.velocity_sigma * velocity,
        accelerations=motion.noise_sigma * accelerations.reshape(steps, t),
        pixels=problem.first + problem.sensor.sigma * pixels.reshape(landmarks, p),
        inverse_depths=depth.mean + depth.sigma * truncated_normal(depths, lower),
    )


def truncated_normal(y: Float[Array, "*l"], lower: Float[Array, "*#l"]) -> Float[Array, "*l"]:
    """The quantile of N(0, 1) truncated below `lower` at the probability Φ(y).

    It makes a standard normal y a truncated one. Each half is computed from its own tail, so that
    neither loses digits; `lower` = −∞ gives y back.
    """
    # Φ⁻¹(Φ(a) + (1 − Φ(a)) Φ(y)), and by the probabilities above the quantile for y > 0.
    log_above = log_ndtr(-lower)
    tail = jnp.exp(log_above + log_ndtr(-jnp.abs(y)))
    return jnp.where(y < 0, 1.0, -1.0) * ndtri(jnp.where(y < 0, -jnp.expm1(log_above) + tail, tail))


def path(problem: Problem, x: Unknowns) -> tuple[Pose, Float[Array, "steps t"]]:
    """T_BC and the velocity in the camera frame after every step."""
    motion = problem.motion

    def move(carry, data):
        pose, velocity = carry
        acceleration, dt = data
        step = motion.displacement(velocity, acceleration, dt)
        moved = pose @ step, motion.next(velocity, acceleration, dt)
        return moved, moved

    start = identity(motion.geometry, x.velocity.dtype), x.velocity
    return jax.lax.scan(move, start, (x.accelerations, problem.controls))[1]


def residuals(problem: Problem, y: Float[Array, " n"]) -> Float[Array, " k"]:
    """`[y; (z − h(y))/σ_px]`; zero where nothing was measured."""
    return jnp.concatenate([y, pixel_residuals(problem, unknowns(problem, y))])


def pixel_residuals(problem: Problem, x: Unknowns) -> Float[Array, " m"]:
    """`(z − h)/σ_px` of every pixel; zero where nothing was measured."""
    errors, _ = pixel_errors(problem, x, path(problem, x)[0])
    return jnp.where(problem.visible[..., None], errors, 0.0).ravel()


def log_likelihood(problem: Problem, x: Unknowns) -> Float[Array, ""]:
    """`−½ |(z − h)/σ_px|²`, up to a constant; −∞ if a measured landmark is behind the camera."""
    errors, possible = pixel_errors(problem, x, path(problem, x)[0])
    used = problem.visible & possible
    squared = jnp.sum(jnp.where(used[..., None], errors, 0.0) ** 2)
    return jnp.where(jnp.all(possible | ~problem.visible), -squared / 2, -jnp.inf)


def log_density(problem: Problem, y: Float[Array, " n"]) -> Float[Array, ""]:
    """`−½ |r|²`, the log posterior of y up to a constant; −∞ as in `log_likelihood`."""
    return log_likelihood(problem, unknowns(problem, y)) - y @ y / 2


def pixel_errors(
    problem: Problem, x: Unknowns, poses: Pose
) -> tuple[Float[Array, "steps l p"], Bool[Array, "steps l"]]:
    """`(z − h)/σ_px` of every step, seen from the poses T_BC, and whether h is possible."""
    sensor = problem.sensor
    bearings = jax.vmap(bearing, in_axes=(None, 0))(sensor.camera, x.pixels)
    points = jnp.column_stack([bearings, jnp.ones_like(x.inverse_depths)])

    def one(T_CB, point, omega):
        seen = homogeneous_apply(T_CB, point, omega)
        return sensor.measure(seen, omega), sensor.possible(seen)

    of_frame = jax.vmap(one, in_axes=(None, 0, 0))
    predicted, possible = jax.vmap(lambda T_BC: of_frame(T_BC.inverse(), points, x.inverse_depths))(
        poses
    )
    return (problem.measured - predicted) / sensor.sigma, possible
