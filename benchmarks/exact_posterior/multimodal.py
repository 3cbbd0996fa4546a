"""Draws of the exact posterior of a problem whose modes are several: of path and landmarks.

`tempered` draws paths by the likelihood in which the landmarks are integrated out, and `marginal`
the landmarks of every path; the weights that make that exact are spent by a last resampling.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from blackjax.smc.resampling import systematic
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float

from exact_posterior.marginal import landmark_draws, marginal_log_likelihood
from exact_posterior.problem import Problem, Unknowns, path, path_size
from exact_posterior.tempered import SMC, Trace, tempered
from jaxslam.geometry import Pose


class Draws(eqx.Module):
    """Equally weighted draws of one problem's exact posterior, some of them more than once."""

    unknowns: Unknowns
    """Of path and landmarks; first axis draw."""
    T_BC: Pose
    """After every step: axes draw, step."""
    velocity: Float[Array, "draws t"]
    """After the last step, in the camera frame."""
    log_evidence: Float[Array, ""]
    """`log ∫ exp(log_likelihood) p(unknowns)`, up to the constant that `log_likelihood` has."""
    effective: Float[Array, ""]
    """Effective share of the paths by the weights that their landmarks gave them."""
    reached: Bool[Array, ""]
    """Whether the whole likelihood was reached; otherwise these are no draws of the posterior."""
    trace: Trace
    """How the likelihood was reached."""

    @property
    def last(self) -> Pose:
        """T_BC after the last step; first axis draw."""
        return jax.tree.map(lambda x: x[:, -1], self.T_BC)


def tempered_sample(settings: SMC, problem: Problem, key: Array) -> Draws:
    """Draws of the posterior of a problem, however many modes it has."""
    paths_key, landmarks_key, last_key = jax.random.split(key, 3)
    like = jnp.zeros(path_size(problem), problem.record.measured.dtype)
    found = tempered(settings, partial(marginal_log_likelihood, problem), like, paths_key)
    keys = jax.random.split(landmarks_key, settings.particles)
    unknowns, log_weights = jax.vmap(
        partial(landmark_draws, problem, count=settings.landmark_draws)
    )(found.position, keys)
    total = logsumexp(log_weights)
    weights = jnp.exp(log_weights - total)
    chosen = systematic(last_key, weights, settings.particles)
    unknowns = jax.tree.map(lambda x: x[chosen], unknowns)
    at = jax.vmap(partial(path, problem))(unknowns.path)
    return Draws(
        unknowns=unknowns,
        T_BC=jax.tree.map(lambda x: x[:, 1:], at.frames.pose),
        velocity=at.motion[:, -1],
        log_evidence=found.log_evidence + total - jnp.log(settings.particles),
        effective=1 / jnp.sum(weights**2) / settings.particles,
        reached=found.reached,
        trace=found.trace,
    )


def pool(repeats: Draws, key: Array) -> Draws:
    """Independent repeats, the first axis of all arrays, as draws of one: each by its evidence.

    Where few of the first particles find a narrow mode its weight errs by much more than later
    particles can tell. The repeats of more evidence then found more of it, and count by that much.
    """
    count, draws = repeats.velocity.shape[:2]
    weights = jnp.repeat(jax.nn.softmax(repeats.log_evidence), draws) / draws
    chosen = systematic(key, weights, count * draws)

    def taken(x):
        return x.reshape(count * draws, *x.shape[2:])[chosen]

    unknowns, T_BC, velocity = jax.tree.map(
        taken, (repeats.unknowns, repeats.T_BC, repeats.velocity)
    )
    return Draws(
        unknowns=unknowns,
        T_BC=T_BC,
        velocity=velocity,
        log_evidence=logsumexp(repeats.log_evidence) - jnp.log(count),
        effective=jnp.mean(repeats.effective),
        reached=jnp.all(repeats.reached),
        trace=repeats.trace,
    )
