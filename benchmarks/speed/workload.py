"""What is computed: a filter whose runs see every landmark in every frame, NEES of each step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxslam
from jaxslam._numerics.arrays import cast, is_number
from jaxslam.filters.linear.state import State
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.slam import Slam
from jaxslam.geometry import Pose
from jaxslam.models.observations import Features
from jaxslam.native import batched
from jaxslam.simulation import Scenario, features, simulate
from jaxslam.simulation.run import Room
from jaxslam.statistics.bands import normalised_squared


@dataclass(frozen=True)
class Workload:
    """Robocentric Inverse Scaling, the calibration's error drawn anew in every frame."""

    name: str
    scenario: str
    landmarks: int
    runs: int
    steps: int

    def reduced(self, runs: int, steps: int) -> Workload:
        """No more runs and steps than these."""
        return Workload(
            self.name, self.scenario, self.landmarks, min(runs, self.runs), min(steps, self.steps)
        )


WORKLOADS = {
    "A": Workload("A", "matched", 12, runs=1024, steps=100),
    "B": Workload("B", "matched-6dof", 30, runs=128, steps=50),
}
"""Planar, and with six degrees of freedom."""


class Inputs(NamedTuple):
    """The same for everybody: a batch of states after frame 0, and what follows."""

    slam: Slam
    seconds: Float[np.ndarray, ""]
    """Of a step."""
    start: State
    pixels: Float[np.ndarray, "runs steps m p"]
    poses: Pose
    """T_BC, true, of every step."""


Records = tuple[Float[np.ndarray, "runs steps"], Float[np.ndarray, "runs n n"]]
"""NEES of the pose in every step, and the last covariance, of pose, velocity and landmarks."""


def scenario_of(work: Workload) -> Scenario:
    """Away from the landmarks, before a picture without edges: nothing is lost.

    A longer run is the same way in more frames: farther off, landmarks are not told from infinity.
    """
    p = 1 if "6dof" not in work.scenario else 2
    finer = max(1.0, work.steps / WORKLOADS[work.name].steps)
    rate = finer * jaxslam.scenario(work.scenario).rate
    return jaxslam.scenario(
        work.scenario, steps=work.steps, landmarks=work.landmarks, calibration="white",
        velocity=(*(0.0,) * p, -0.6, *(0.0,) * (2 * p - 1)), image=(1e4,) * p, centre=(5e3,) * p,
        first_pixels=((4.7e3, 5.3e3),) * p, rate=rate,
    )  # fmt: skip


def filters_of(scenario: Scenario) -> dict[str, AbstractFilter]:
    """The one that is measured, by its name."""
    return jaxslam.make_filters(scenario, ["robocentric"], ["inverse_scaling"])


def prepared(work: Workload) -> Inputs:
    """Simulated runs, the first ones whose landmarks are all seen in every frame."""
    scenario = scenario_of(work)
    (slam,) = filters_of(scenario).values()
    assert isinstance(slam, Slam)
    room = Room(work.landmarks, work.landmarks, work.landmarks, 1)

    def one(index):
        run = simulate(scenario, jax.random.fold_in(jax.random.key(0), index))
        first, _, _ = features(run, room)
        run_poses = jax.tree.map(lambda x: x[1:], run.poses)
        seen = jnp.all(run.visible)
        return seen, (slam.init(room.capacity, first), run.measured[1:], run_poses)

    seen, drawn = jax.jit(jax.vmap(one))(jnp.arange(work.runs + work.runs // 4 + 8))
    chosen = np.flatnonzero(np.asarray(seen))[: work.runs]
    assert len(chosen) == work.runs, f"only {len(chosen)} runs see every landmark"
    start, pixels, poses = jax.tree.map(lambda x: np.asarray(x[chosen]), drawn)
    return Inputs(slam, np.asarray(1 / scenario.rate), start, pixels, poses)


def kept(slam: Slam, start: State) -> np.ndarray:
    """Where pose, velocity and landmarks are in the state's error."""
    core = jax.tree.map(lambda x: x[0], start.core)
    c = core.part("calibration").stop
    gone = np.r_[core.part("noise"), core.part("calibration")]
    return np.setdiff1d(np.arange(c + start.landmarks[0].size), gone)


def filtered_run(
    slam: Slam, seconds: Array, start: State, pixels: Array, poses: Pose
) -> tuple[Array, Array]:
    """NEES of every step, and the last covariance, of one run."""
    m = pixels.shape[1]
    nothing = Features(
        jnp.zeros(1, int), jnp.zeros((1, pixels.shape[2]), pixels.dtype), jnp.zeros(1, bool)
    )

    def step(state, frame):
        measured, T_BC = frame
        seen = Features(jnp.arange(m), measured, jnp.ones(m, bool))
        state, _ = slam.step(state, seconds, seen, nothing)
        return state, normalised_squared(*slam.pose_error(state, T_BC))

    last, nees = jax.lax.scan(step, start, (pixels, poses))
    return nees, last.covariance


@partial(eqx.filter_jit, donate="none")
def filtered(
    slam: Slam, seconds: Array, start: State, pixels: Array, poses: Pose
) -> tuple[Array, Array]:
    """The same of a batch of runs."""
    return jax.vmap(partial(filtered_run, slam, seconds))(start, pixels, poses)


def ours(inputs: Inputs) -> Callable[[], Records]:
    """The package's filter, compiled."""
    data = jax.tree.map(jnp.asarray, tuple(inputs[1:]))
    compiled: Any = filtered.lower(inputs.slam, *data).compile()  # ty: ignore[missing-attribute]
    index = kept(inputs.slam, inputs.start)

    def call() -> Records:
        nees, covariance = jax.block_until_ready(compiled(inputs.slam, *data))
        return np.asarray(nees), np.asarray(covariance[:, index[:, None], index])

    return call


def by_native(inputs: Inputs, dtype: str = "float64", threads: int = 1) -> Callable[[], Records]:
    """The same by the native backend. Raises ValueError without a C++ compiler."""
    index = kept(inputs.slam, inputs.start)
    with jax.enable_x64(dtype == "float64"):
        numbers, static = eqx.partition(cast(inputs.slam, dtype), is_number)
        seconds, *runs = jax.tree.map(np.asarray, cast(tuple(inputs[1:]), dtype))

        def one(shared, run):
            numbers, seconds = shared
            return filtered_run(eqx.combine(numbers, static), seconds, *run)

        batch = batched(one, (numbers, seconds), tuple(runs))

    def call() -> Records:
        nees, covariance = batch((numbers, seconds), tuple(runs), threads=threads)
        return nees, covariance[:, index[:, None], index]

    return call
