"""Draws from the posterior by NUTS, in the variables of `scale` whitened at a mode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import blackjax
import jax
import jax.numpy as jnp
from blackjax.adaptation.step_size import dual_averaging_adaptation
from jaxtyping import Array, Float

from jaxslam.geometry import Pose
from jaxslam.posterior.problem import Problem, path
from jaxslam.posterior.scale import scaled_log_density, scaled_unknowns, whitening_root
from jaxslam.rig import Rig

WORST_RHAT = 1.05
LEAST_ESS = 100.0
FIRST_STEP_SIZE = 0.5
"""Of the adaptation, in variables that are nearly N(0, I)."""


@dataclass(frozen=True)
class NUTS:
    """How long to sample: static configuration."""

    chains: int = 4
    warmup: int = 100
    """Steps in which every chain adapts its step size, by dual averaging."""
    draws: int = 250
    """Kept draws of every chain."""
    acceptance: float = 0.8
    doublings: int = 7
    """A trajectory has at most 2^doublings − 1 leapfrog steps."""

    def __post_init__(self) -> None:
        least = {"chains": 2, "warmup": 20, "draws": 8, "doublings": 1}
        for field, value in least.items():
            if getattr(self, field) < value:
                raise ValueError(f"{field} must be at least {value}, not {getattr(self, field)}")
        if not 0 < self.acceptance < 1:
            raise ValueError(f"acceptance must be between 0 and 1, not {self.acceptance}")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Chains:
    """What the chains of one problem drew: axes chain, draw, …"""

    T_BC: Pose
    """After the last step."""
    velocity: Float[Array, "chains draws t"]
    """After the last step, in the camera frame."""
    inverse_depths: Float[Array, "chains draws l"]
    """1/z in frame 0."""
    log_density: Float[Array, "chains draws"]
    """Of the variables that were sampled, up to a constant."""
    divergent: Float[Array, " chains"]
    """Share of the transitions that diverged."""
    leapfrogs: Float[Array, " chains"]
    """Mean number of leapfrog steps of a draw."""


def sample(
    settings: NUTS, rig: Rig, problem: Problem, mode: Float[Array, " n"], key: Array
) -> Chains:
    """Chains that start at draws of the mode's Gaussian.

    They move in x with `w = mode + R x`, where the posterior is nearly N(0, I): trajectories are
    short, and the unit mass matrix is better than one estimated from few draws.
    """
    root = whitening_root(rig, problem, mode)

    def target(x):
        return scaled_log_density(rig, problem, mode, mode + root @ x)

    def outcome(x):
        unknown, _ = scaled_unknowns(rig, problem, mode, mode + root @ x)
        T_BC, velocity = jax.tree.map(lambda x: x[-1], path(rig, problem, unknown))
        return T_BC, velocity, unknown.inverse_depths

    kernel = blackjax.nuts.build_kernel()
    start_averaging, update_averaging, averaged = dual_averaging_adaptation(settings.acceptance)
    inverse_mass = jnp.ones_like(mode)

    def chain(key):
        start_key, key = jax.random.split(key)
        state = blackjax.nuts.init(_possible_start(target, start_key, mode), target)

        # One loop over warm-up and draws: a second copy of the kernel compiles for a minute.
        def step(carry, data):
            state, averaging = carry
            key, warming = data
            size = jnp.where(warming, jnp.exp(averaging.log_step_size), averaged(averaging))
            state, info = kernel(key, state, target, size, inverse_mass, settings.doublings)
            adapted = update_averaging(averaging, info.acceptance_rate)
            averaging = jax.tree.map(partial(jnp.where, warming), adapted, averaging)
            record = state.position, state.logdensity, info.is_divergent, info.num_integration_steps
            return (state, averaging), record

        carry = state, start_averaging(jnp.asarray(FIRST_STEP_SIZE, mode.dtype))
        keys = jax.random.split(key, settings.warmup + settings.draws)
        warming = jnp.arange(len(keys)) < settings.warmup
        _, records = jax.lax.scan(step, carry, (keys, warming))
        x, values, divergent, leapfrogs = jax.tree.map(lambda r: r[settings.warmup :], records)
        return Chains(
            *jax.vmap(outcome)(x), values, jnp.mean(divergent), jnp.mean(leapfrogs.astype(x.dtype))
        )

    return jax.vmap(chain)(jax.random.split(key, settings.chains))


def _possible_start(
    target: Callable[[Array], Array], key: Array, mode: Float[Array, " n"]
) -> Float[Array, " n"]:
    """A draw of N(0, I), drawn towards 0 until its density is not zero and not absurdly low.

    Where the posterior bends away from its Gaussian a draw of that can be so unlikely that the
    adaptation of the step size starts from a cliff.
    """
    draw = jax.random.normal(key, mode.shape, mode.dtype)
    lowest = target(jnp.zeros_like(mode)) - 2.0 * mode.size
    shrunk = draw * 2.0 ** -jnp.arange(8.0)[:, None]
    likely = jax.vmap(target)(shrunk) > lowest
    return jnp.where(jnp.any(likely), shrunk[jnp.argmax(likely)], jnp.zeros_like(mode))


def diagnose(
    values: Float[Array, "chains draws k"],
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Rank-normalised split R̂ and bulk effective sample size (Vehtari et al. 2021)."""
    return blackjax.diagnostics.rhat(values), blackjax.diagnostics.ess_bulk(values)
