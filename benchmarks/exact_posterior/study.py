"""Many problems at once: their exact posteriors, what approximates them, and how far filters are.

Problem i is run i of `monte_carlo` with the same scenario and seed, cut after `steps` steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from exact_posterior.laplace import Laplace, laplace, minima, pose_gaussian, starts
from exact_posterior.mixtures import filter_mixture, mixture_divergence
from exact_posterior.modes import main_direction, share_against
from exact_posterior.moments import (
    covariance,
    gaussian_divergence,
    in_base_axes,
    pose_moments,
    to_base_axes,
)
from exact_posterior.problem import Problem, check_scenario, first_steps, make_problem
from exact_posterior.sampler import (
    HMC,
    LEAST_ESS,
    WORST_RHAT,
    Chains,
    diagnose,
    given_bound,
    sample,
)
from jaxslam._numerics.arrays import cast
from jaxslam._runtime.watchdog import finished
from jaxslam.consistency import filter_run
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.readouts import camera_pose
from jaxslam.geometry import Pose, difference, log
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import Room, Run, Scenario, as_data, simulate
from jaxslam.statistics.bands import normalised_squared

Records = dict[str, Array]

STREAM = 0x706F7374
"""What is folded into a run's key for the draws that are not the run's own. `simulate` splits that
key, and `split(key, n)[i]` *is* `fold_in(key, i)`: a small number would be one of its parts."""


@dataclass(frozen=True)
class Study:
    """What to compute for every problem: static configuration.

    Raises ValueError for a scenario of another generative model, and for numbers out of range.
    """

    scenario: Scenario
    """The world of all problems."""
    steps: int
    """After so many the posterior is taken."""
    hmc: HMC = field(default_factory=HMC)
    """How long to sample."""
    starts: int = 4
    """Starts of Levenberg–Marquardt: the prior mean, and draws from the prior."""

    def __post_init__(self) -> None:
        check_scenario(self.scenario)
        if not 1 <= self.steps <= self.scenario.steps:
            raise ValueError(
                f"steps must be 1 to the {self.scenario.steps} of {self.scenario.name}, "
                f"not {self.steps}"
            )
        if self.starts < 1:
            raise ValueError(f"starts must be at least 1, not {self.starts}")


def draw_runs(study: Study, seed: int, indices: range) -> Run:
    """The runs of these numbers, as `monte_carlo` draws them, up to the study's last step."""
    return _draw_runs(
        study.steps, as_data(study.scenario), jax.random.key(seed), jnp.asarray(indices)
    )


@partial(jax.jit, static_argnums=0)
def _draw_runs(steps: int, scenario: Scenario, key: Array, indices: Array) -> Run:
    def one(index):
        return first_steps(simulate(scenario, jax.random.fold_in(key, index)), steps)

    return jax.vmap(one)(indices)


def reference(study: Study, runs: Run, seed: int, indices: range) -> tuple[Records, Chains]:
    """Records of the posteriors, and of MAP and Laplace beside them; and the exact draws.

    `exact_…` is the posterior by the truncated prior on 1/z that landmarks are drawn from;
    `gaussian_prior_…` the one by the whole Gaussian that the filters believe. The first is the
    second given that no landmark is beyond the bound, so that its draws are some of the second's.
    All have a leading axis of runs.
    """
    modes_keys, chains_keys = _keys(seed, indices)
    records: Records = {}

    def record(kind: str, found: Records) -> None:
        records.update({f"{kind}_{name}": value for name, value in found.items()})

    problems = jax.vmap(partial(make_problem, study.scenario, truncated=False))(runs)
    where = f"modes of {study.scenario.name}, runs {indices}"
    modes = finished(_modes(study.starts, problems, modes_keys), where)
    record("gaussian_prior_laplace", _laplace_errors(problems, modes, runs))
    where = f"chains of {study.scenario.name}, runs {indices}"
    chains = finished(_sample(study.hmc, problems, modes.mode, chains_keys), where)
    exact, share = jax.vmap(partial(given_bound, study.scenario.least_inverse_depth))(chains)
    record("gaussian_prior", _posterior_errors(chains, runs))
    record("exact", _posterior_errors(exact, runs))
    records["exact_share"] = share
    return records, exact


def _keys(seed: int, indices: range) -> tuple[Array, Array]:
    """Of every run, one key for the starts of Levenberg–Marquardt and one for the chains."""

    def one(index):
        run = jax.random.fold_in(jax.random.key(seed), index)
        return jax.random.split(jax.random.fold_in(run, STREAM))

    keys = jax.vmap(one)(jnp.asarray(indices))
    return keys[:, 0], keys[:, 1]


@partial(jax.jit, static_argnums=0)
def _modes(count: int, problems: Problem, keys: Array) -> Laplace:
    def one(problem, key):
        ends, values, converged = minima(problem, starts(problem, key, count))
        best = jnp.argmax(values)
        return laplace(problem, ends[best], converged[best])

    return jax.vmap(one)(problems, keys)


@partial(jax.jit, static_argnums=0)
def _sample(settings: HMC, problems: Problem, modes: Array, keys: Array) -> Chains:
    return jax.vmap(partial(sample, settings))(problems, modes, keys)


@jax.jit
def _laplace_errors(problems: Problem, modes: Laplace, runs: Run) -> Records:
    def one(problem, at, run):
        T_CB, P = pose_gaussian(problem, at)
        truth = _last(run)
        error = difference(truth.inverse(), T_CB)
        estimate = T_CB.inverse()
        # The right tangent of T_BC is minus the adjoint of that of T_CB.
        adjoint = T_CB.adjoint()
        P_BC = adjoint @ P @ adjoint.T
        return {
            "nees": normalised_squared(error, P),
            "error": _base_error(truth, estimate),
            "covariance": to_base_axes(estimate, P_BC),
            "position": estimate.translation(),
        }

    return jax.vmap(one)(problems, modes, runs)


@jax.jit
def _posterior_errors(chains: Chains, runs: Run) -> Records:
    def one(chains: Chains, run: Run):
        T_BC, shape = pooled(chains), chains.log_density.shape
        truth = _last(run)
        T_CB, P, tangents = pose_moments(T_BC.inverse())
        estimate, _, _ = pose_moments(T_BC)
        base = in_base_axes(T_BC, estimate)
        velocity = chains.velocity.reshape(base.shape[0], -1)
        scalars = jnp.column_stack([base, velocity])
        watched = jnp.column_stack([tangents, velocity, chains.log_density.ravel()])
        rhat, ess = diagnose(watched.reshape(*shape, -1))
        behind = jnp.any(chains.inverse_depths < 0, axis=-1)
        return {
            "nees": normalised_squared(difference(truth.inverse(), T_CB), P),
            "error": _base_error(truth, estimate),
            "covariance": covariance(base),
            "position": estimate.translation(),
            "truth": jnp.concatenate([_base_error(truth, estimate), _last_velocity(run)]),
            "draws": scalars,
            "behind_infinity": jnp.mean(behind, dtype=P.dtype),
            "rhat": jnp.max(rhat),
            "ess": jnp.min(ess),
            "divergent": jnp.mean(chains.divergent),
            "leapfrogs": jnp.mean(chains.leapfrogs),
        }

    return jax.vmap(one)(chains, runs)


def converged(records: Mapping[str, Any], name: str) -> np.ndarray:
    """Which problems' chains agree and have drawn enough: R̂ and effective sample size."""
    rhat, ess = np.asarray(records[f"{name}_rhat"]), np.asarray(records[f"{name}_ess"])
    return (rhat <= WORST_RHAT) & (ess >= LEAST_ESS) & (np.asarray(records["exact_share"]) > 0)


Comparison = Callable[[AbstractFilter, Any, Pose, Pose], Records]
"""Of a filter, its state after the last step, the true T_BC there, and draws of it."""


def one_gaussian(slam: AbstractFilter, state: Any, truth: Pose, T_BC: Pose) -> Records:
    """The filter's mean and covariance beside draws of the exact posterior.

    NEES and KL are in the filter's own error, the one of its `pose_error`; σ and error in position
    along the axes of B and orientation.
    """
    error, P = slam.pose_error(state, truth)
    own = jax.vmap(lambda pose: slam.pose_error(state, pose)[0])(T_BC)
    estimate, P_BC = camera_pose(slam, state)
    P_base = to_base_axes(estimate, P_BC)
    return {
        "nees": normalised_squared(error, P),
        "kl": gaussian_divergence(own, P),
        "error": _base_error(truth, estimate),
        "covariance": P_base,
        "position": estimate.translation(),
    }


def gaussian_sum(slam: AbstractFilter, state: Any, truth: Pose, T_BC: Pose) -> Records:
    """Also all Gaussians of a sum: KL of the draws' density from theirs, and how much of either
    lies on the other side of the origin than most draws do."""
    mixture, ahead = filter_mixture(slam, state), main_direction(T_BC)
    return {
        **one_gaussian(slam, state, truth, T_BC),
        "kl_of_sum": mixture_divergence(T_BC, mixture),
        "reversed": share_against(mixture, ahead),
        "exact_reversed": jnp.mean(T_BC.translation() @ ahead < 0, dtype=ahead.dtype),
    }


def against_filter(
    study: Study,
    slam: AbstractFilter,
    runs: Run,
    exact: Pose,
    comparison: Comparison = one_gaussian,
) -> Records:
    """A filter on the same runs, beside draws of the exact posterior: T_BC, axes run and draw."""
    slam, sensor = cast((slam, study.scenario.sensor), runs.measured.dtype)
    landmarks = study.scenario.landmarks
    room = Room(landmarks, landmarks, landmarks, 1)
    return _compared(comparison, room, slam, sensor, runs, exact)


@eqx.filter_jit
def _compared(
    comparison: Comparison,
    room: Room,
    slam: AbstractFilter,
    sensor: AbstractSensor,
    runs: Run,
    exact: Pose,
) -> Records:
    def one(run, T_BC):
        _, _, state = filter_run(slam, room, sensor, run)
        return comparison(slam, state, _last(run), T_BC)

    return jax.vmap(one)(runs, exact)


def pooled(chains: Chains) -> Pose:
    """T_BC of all chains of one problem, one after the other."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), chains.T_BC)


def _last(run: Run) -> Pose:
    return jax.tree.map(lambda x: x[-1], run.poses)


def _last_velocity(run: Run) -> Array:
    """Of the last step, by its displacement Exp(v Δt)."""
    before = jax.tree.map(lambda x: x[-2], run.poses)
    return log(before.inverse() @ _last(run)) / run.controls[-1]


def _base_error(truth: Pose, estimate: Pose) -> Array:
    """Position along the axes of B, and `Log(R̂⁻¹ R)`."""
    turned = estimate.rotation().inverse() @ truth.rotation()
    return jnp.concatenate([truth.translation() - estimate.translation(), log(turned)])
