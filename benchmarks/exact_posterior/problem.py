"""The generative model of a simulated run in whitened variables: what its posterior is made of.

It is that of `jaxslam.filters.window`, with all frames in the window and every landmark first seen
in frame 0. Its unknowns are one vector y here, standard normal a priori: those of the path (the
initial velocity, and the white acceleration of every step), then the true pixels of all landmarks
in frame 0, then their inverse depths. With the measurements z of the later frames, `−log p(y | z) =
½ |r(y)|² + const` for the residuals `r = [y; (z − h(y))/σ_px]`, which is all that a sampler or a
least-squares solver needs.

One thing is added: landmarks are drawn from a prior on 1/z that is truncated. A standard normal
number of y is made a truncated one, and that is the window's.

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
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import cast
from jaxslam.filters.slam import Slam
from jaxslam.filters.window import problem as window
from jaxslam.filters.window.problem import Path, PathLayout
from jaxslam.filters.window.record import Record, whole
from jaxslam.geometry import Pose
from jaxslam.simulation import Run, Scenario


class Problem(eqx.Module):
    """What is known of one run: the prior and the measurements. Batched by `vmap`."""

    slam: Slam
    """A filter that is told the scenario's motion, sensor and prior on 1/z; only these count."""
    record: Record
    """What was measured in all frames."""
    least_inverse_depth: Float[Array, ""]
    """The prior on 1/z is truncated below this, 1/m; −∞ for the whole Gaussian."""

    @property
    def landmarks(self) -> int:
        """How many there are."""
        return self.record.first.size

    @property
    def lowest(self) -> Float[Array, ""]:
        """The bound in the whitened number of an inverse depth."""
        depth = self.slam.depth
        return (self.least_inverse_depth - depth.mean) / depth.sigma


class Unknowns(eqx.Module):
    """The whitened numbers of `jaxslam.filters.window`."""

    path: Float[Array, " N"]
    """The initial velocity and the accelerations, in σ of their prior."""
    landmarks: Float[Array, "l q"]
    """Of each its true pixel in frame 0, then its inverse depth."""


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
        "beacons": 0,
    }
    found = scenario.fields
    for field, value in wanted.items():
        if found[field] != value:
            raise ValueError(
                f"the exact posterior needs a scenario whose {field} is {value!r}, as in matched; "
                f"{scenario.name} has {found[field]!r}"
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
    slam = Slam(motion=scenario.motion, sensor=scenario.sensor, depth=scenario.depth)
    record = whole(run.controls, run.measured, run.visible, jnp.zeros(run.visible.shape[1], int))
    least = jnp.asarray(scenario.least_inverse_depth if truncated else -jnp.inf)
    return Problem(cast(slam, run.measured.dtype), record, least)


def path_size(problem: Problem) -> int:
    """How many of the whitened variables are the path's."""
    return PathLayout.of(problem.slam).size(problem.record.frames)


def size(problem: Problem) -> int:
    """How many whitened variables there are."""
    return path_size(problem) + problem.landmarks * (problem.slam.sensor.size + 1)


def unknowns(problem: Problem, y: Float[Array, " n"]) -> Unknowns:
    """What y stands for."""
    x, pixels, depths = jnp.split(y, [path_size(problem), y.size - problem.landmarks])
    depths = truncated_normal(depths, problem.lowest)
    return Unknowns(x, jnp.column_stack([pixels.reshape(problem.landmarks, -1), depths]))


def truncated_normal(y: Float[Array, "*l"], lower: Float[Array, "*#l"]) -> Float[Array, "*l"]:
    """The quantile of N(0, 1) truncated below `lower` at the probability Φ(y).

    It makes a standard normal y a truncated one. Each half is computed from its own tail, so that
    neither loses digits; `lower` = −∞ gives y back.
    """
    # Φ⁻¹(Φ(a) + (1 − Φ(a)) Φ(y)), and by the probabilities above the quantile for y > 0.
    log_above = log_ndtr(-lower)
    tail = jnp.exp(log_above + log_ndtr(-jnp.abs(y)))
    return jnp.where(y < 0, 1.0, -1.0) * ndtri(jnp.where(y < 0, -jnp.expm1(log_above) + tail, tail))


def path(problem: Problem, x: Float[Array, " N"]) -> Path:
    """Poses and velocities of all frames."""
    return window.path(problem.slam, problem.record, x)


def last(at: Path) -> tuple[Pose, Float[Array, " t"]]:
    """T_BC and the velocity in the camera frame after the last step."""
    return jax.tree.map(lambda x: x[-1], (at.frames.pose, at.motion))


def inverse_depths(problem: Problem, x: Unknowns) -> Float[Array, " l"]:
    """1/z in frame 0, 1/m."""
    return window.hidden(problem.slam, jnp.zeros(0), x.landmarks[:, -1])


def residuals(problem: Problem, y: Float[Array, " n"]) -> Float[Array, " k"]:
    """`[y; (z − h(y))/σ_px]`; zero where nothing was measured."""
    return jnp.concatenate([y, pixel_residuals(problem, unknowns(problem, y))])


def pixel_residuals(problem: Problem, x: Unknowns) -> Float[Array, " m"]:
    """`(z − h)/σ_px` of every pixel after frame 0; zero where nothing was measured."""
    at = path(problem, x.path)
    return window.residuals(problem.slam, problem.record, at, x.landmarks)[1:].ravel()


def landmark_costs(problem: Problem, at: Path, landmarks: Float[Array, "l q"]) -> Array:
    """Of every landmark `|y|² + |(z − h)/σ_px|²`, y its own numbers; ∞ if it is measured where it
    is behind the camera."""
    return window.landmark_slopes(problem.slam, problem.record, at, landmarks)[2]


def log_likelihood(problem: Problem, x: Unknowns) -> Float[Array, ""]:
    """`−½ |(z − h)/σ_px|²`, up to a constant; −∞ if a measured landmark is behind the camera."""
    costs = landmark_costs(problem, path(problem, x.path), x.landmarks)
    return -jnp.sum(costs - jnp.sum(x.landmarks**2, axis=1)) / 2


def log_density(problem: Problem, y: Float[Array, " n"]) -> Float[Array, ""]:
    """`−½ |r|²`, the log posterior of y up to a constant; −∞ as in `log_likelihood`."""
    return log_likelihood(problem, unknowns(problem, y)) - y @ y / 2
