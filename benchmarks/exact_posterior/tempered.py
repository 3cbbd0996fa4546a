"""Draws from a posterior of several modes by tempered sequential Monte Carlo.

One chain knows the mode that it began in. Here many particles begin at draws of the prior, where
all modes are one, and the likelihood is raised to powers β from 0 to 1, in steps so small that
enough particles survive each of them (Del Moral, Doucet, Jasra 2006; Chopin and Papaspiliopoulos
2020, chapter 17). Between two powers every particle moves by Hamiltonian trajectories. The share
of particles in a mode is its weight, and the mean weights of the steps give the evidence.

The trajectories' metric is the mean information of the particles: `E[s sᵀ] = E[−∇² log π]` for the
score s of any density π, by integration by parts. That is narrow where the density is, and unlike
the particles' covariance it does not grow with the distance between modes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import blackjax
import equinox as eqx
import jax
import jax.numpy as jnp
from blackjax.smc.resampling import systematic
from jaxtyping import Array, Bool, Float, Int

from jaxslam.linalg import Cholesky, cholesky

LogLikelihood = Callable[[Float[Array, " n"]], Float[Array, ""]]

FIRST_STEP_SIZE = 0.5
"""Of the adaptation, in variables whitened by the mean information."""
GAIN = 1.0
"""By how much the log of the step size follows a wrong acceptance rate."""
SHORTEST = 0.5
"""Step sizes of single trajectories are uniform from this share of the adapted one to all of it,
so that no variable has their length as its period."""


@dataclass(frozen=True)
class SMC:
    """How many particles move how far: static configuration. Raises ValueError for numbers out of
    range."""

    particles: int = 2048
    moves: int = 2
    """Trajectories of every particle between two powers."""
    leapfrogs: int = 5
    """Leapfrog steps of a trajectory."""
    survivors: float = 0.4
    """Effective share of the particles that the next power is to leave. It is foreseen from the
    particles before they move, so that more than it survive."""
    acceptance: float = 0.8
    """What the adaptation of the step size aims at."""
    last: int = 2
    """How often the particles move at β = 1."""
    most_rounds: int = 60
    """Rounds of resampling and moving at the most; where β = 1 is not reached with them the
    draws are none."""
    landmark_draws: int = 8
    """Draws of every landmark given a path, of which one is kept."""

    def __post_init__(self) -> None:
        least = {"particles": 8, "last": 1, "most_rounds": 2}
        ones = ("moves", "leapfrogs", "landmark_draws")
        for field, value in {**least, **dict.fromkeys(ones, 1)}.items():
            if getattr(self, field) < value:
                raise ValueError(f"{field} must be at least {value}, not {getattr(self, field)}")
        for field in ("survivors", "acceptance"):
            if not 0 < getattr(self, field) < 1:
                raise ValueError(f"{field} must be between 0 and 1, not {getattr(self, field)}")


class Trace(eqx.Module):
    """What happened in every round; NaN after the last."""

    power: Float[Array, "*rounds"]
    """β that the particles have weights for at its end."""
    effective: Float[Array, "*rounds"]
    """Effective share of the particles by these weights."""
    acceptance: Float[Array, "*rounds"]
    """Mean acceptance of its moves, which were at the β of the round before."""
    step_size: Float[Array, "*rounds"]
    distinct: Float[Array, "*rounds"]
    """Share of the particles that its resampling left; the others became copies of them."""


class Particles(eqx.Module):
    """Equally weighted draws of the posterior."""

    position: Float[Array, "s n"]
    """One y each."""
    log_evidence: Float[Array, ""]
    """`log ∫ exp(log likelihood) N(y; 0, I) dy`."""
    reached: Bool[Array, ""]
    """Whether they have moved at β = 1 as often as they should."""
    trace: Trace
    """How β went from 0 to 1."""


class _Carry(NamedTuple):
    key: Array
    state: Any
    log_step: Float[Array, ""]
    log_evidence: Float[Array, ""]
    left: Int[Array, ""]
    """Rounds at β = 1 that are still to come."""
    count: Int[Array, ""]
    trace: Trace


def tempered(settings: SMC, log_likelihood: LogLikelihood, like: Array, key: Array) -> Particles:
    """Draws of the posterior `∝ exp(log_likelihood(y)) N(y; 0, I)` of a y as `like` (n,) is."""
    first_key, key = jax.random.split(key)
    start = jax.random.normal(first_key, (settings.particles, like.size), like.dtype)

    def going(carry):
        return (carry.left > 0) & (carry.count < settings.most_rounds)

    def advance(carry):
        return _advanced(settings, log_likelihood, carry)

    end = jax.lax.while_loop(going, advance, _begun(settings, start, key))
    return Particles(end.state.particles, end.log_evidence, end.left == 0, end.trace)


def _begun(settings: SMC, start: Float[Array, "s n"], key: Array) -> _Carry:
    zero = jnp.zeros((), start.dtype)
    weights = jnp.full(len(start), 1 / len(start), start.dtype)
    state = blackjax.smc.tempered.TemperedSMCState(start, weights, zero)
    nothing = jnp.full(settings.most_rounds, jnp.nan, start.dtype)
    return _Carry(
        key,
        state,
        jnp.log(zero + FIRST_STEP_SIZE),
        zero,
        jnp.asarray(settings.last),
        jnp.asarray(0),
        Trace(*(nothing,) * 5),
    )


def _advanced(settings: SMC, log_likelihood: LogLikelihood, carry: _Carry) -> _Carry:
    """Resampled, moved and weighted for the next power: after 1 it is 1, and weights are equal."""
    key, step_key = jax.random.split(carry.key)
    metric = mean_information(log_likelihood, carry.state)
    shared = {"size": jnp.exp(carry.log_step), **metric._asdict()}
    kernel = blackjax.adaptive_tempered_smc(
        _log_prior,
        log_likelihood,
        _trajectory(settings.leapfrogs),
        blackjax.hmc.init,
        {name: value[None] for name, value in shared.items()},  # of all particles
        systematic,
        settings.survivors,
        num_mcmc_steps=settings.moves,
    )
    state, info = kernel.step(step_key, carry.state)
    accepted = jnp.mean(info.update_info.acceptance_rate)
    trace = Trace(
        state.tempering_param,
        1 / jnp.sum(state.weights**2) / settings.particles,
        accepted,
        jnp.exp(carry.log_step),
        jnp.mean(jnp.bincount(info.ancestors, length=settings.particles) > 0, dtype=accepted.dtype),
    )
    return _Carry(
        key,
        state,
        carry.log_step + GAIN * (accepted - settings.acceptance),
        carry.log_evidence + info.log_likelihood_increment,
        carry.left - (carry.state.tempering_param >= 1),
        carry.count + 1,
        jax.tree.map(lambda all, one: all.at[carry.count].set(one), carry.trace, trace),
    )


def _log_prior(y: Float[Array, " n"]) -> Float[Array, ""]:
    return -y @ y / 2


def mean_information(log_likelihood: LogLikelihood, state: Any) -> Cholesky:
    """The factor of the particles' mean `s sᵀ`, s the score of the tempered density, in y.

    Particles without a likelihood, whose weights are zero, say nothing.
    """
    slopes = jax.vmap(jax.grad(log_likelihood))(state.particles)
    slopes = jnp.where(jnp.isfinite(slopes), slopes, 0.0)
    scores = state.tempering_param * slopes - state.particles
    n = scores.shape[1]
    return cholesky(scores.T @ (state.weights[:, None] * scores) + jnp.eye(n) / len(scores))


def _trajectory(leapfrogs: int) -> Callable[..., Any]:
    """The transition of one particle by a trajectory in x, `y = y₀ + L⁻ᵀ x`, for `L Lᵀ` the metric:
    what a dense mass matrix does, without LAPACK."""
    hmc = blackjax.hmc.build_kernel()

    def move(key, state, log_density, size, root, whitening):
        length_key, key = jax.random.split(key)
        size = size * jax.random.uniform(length_key, (), size.dtype, SHORTEST, 1.0)

        def moved(x):
            return state.position + whitening.T @ x

        y, value, slope = state
        start = blackjax.mcmc.hmc.HMCState(jnp.zeros_like(y), value, whitening @ slope)
        end, info = hmc(
            key, start, lambda x: log_density(moved(x)), size, jnp.ones_like(y), leapfrogs
        )
        x, value, slope = end
        return blackjax.mcmc.hmc.HMCState(moved(x), value, root @ slope), info

    return move
