"""Draws from the posterior by Hamiltonian Monte Carlo, in variables whitened at a mode.

The variables are those of `conditional`. Trajectories have quasi-random lengths (Neal 2011,
section 3.2; Hoffman et al. 2021): in whitened variables one knows how long they should be, and need
not find out by doubling as NUTS does. All chains of a batch take the same lengths, so that none
waits long.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import blackjax
import equinox as eqx
import jax
import jax.numpy as jnp
from blackjax.adaptation.step_size import dual_averaging_adaptation
from jaxtyping import Array, Float

from exact_posterior.conditional import (
    centre,
    conditional_log_density,
    conditional_unknowns,
    whitening_root,
)
from exact_posterior.problem import Problem, inverse_depths, last, path
from jaxslam.geometry import Pose

WORST_RHAT = 1.05
LEAST_ESS = 100.0
FIRST_STEP_SIZE = 0.5
"""Of the adaptation, in variables that are nearly N(0, I)."""


LONGEST = math.pi
"""Trajectories last uniformly up to this long; a harmonic oscillator of N(0, I) has period 2π."""
GOLDEN = (math.sqrt(5) - 1) / 2
"""Its multiples modulo 1 are uniform and far from their predecessors."""


@dataclass(frozen=True)
class HMC:
    """How long to sample: static configuration. Raises ValueError for numbers too small."""

    chains: int = 4
    """Independent ones of every problem, by which convergence is seen."""
    warmup: int = 150
    """Steps in which every chain adapts its step size, by dual averaging."""
    draws: int = 300
    """Kept draws of every chain."""
    acceptance: float = 0.85
    """What the adaptation aims at."""
    most_leapfrogs: int = 16
    """Leapfrog steps that a trajectory has at the most, however short they are."""

    def __post_init__(self) -> None:
        least = {"chains": 2, "warmup": 20, "draws": 8, "most_leapfrogs": 1}
        for field, value in least.items():
            if getattr(self, field) < value:
                raise ValueError(f"{field} must be at least {value}, not {getattr(self, field)}")
        if not 0 < self.acceptance < 1:
            raise ValueError(f"acceptance must be between 0 and 1, not {self.acceptance}")


class Chains(eqx.Module):
    """What the chains of one problem drew: axes chain, draw, …; or what one of them did."""

    T_BC: Pose
    """After the last step."""
    velocity: Float[Array, "*chains draws t"]
    """After the last step, in the camera frame."""
    inverse_depths: Float[Array, "*chains draws l"]
    """1/z in frame 0."""
    log_density: Float[Array, "*chains draws"]
    """Of the variables that were sampled, up to a constant."""
    divergent: Float[Array, "*chains"]
    """Share of the transitions that diverged."""
    leapfrogs: Float[Array, "*chains"]
    """Mean number of leapfrog steps of a draw."""


def sample(settings: HMC, problem: Problem, mode: Float[Array, " n"], key: Array) -> Chains:
    """Chains that start at draws of the mode's Gaussian.

    They move in x with `w = centre + R x`, where the posterior is nearly N(0, I), with a unit mass
    matrix, which is better than one estimated from few draws.
    """
    root, origin = whitening_root(problem, mode), centre(problem, mode)

    def target(x):
        return conditional_log_density(problem, mode, origin + root @ x)

    def outcome(x):
        unknown, _ = conditional_unknowns(problem, mode, origin + root @ x)
        return *last(path(problem, unknown.path)), inverse_depths(problem, unknown)

    def chain(key):
        start_key, key = jax.random.split(key)
        start = _possible_start(target, start_key, mode)
        x, *diagnostics = _chain(settings, target, key, start)
        return Chains(*jax.vmap(outcome)(x), *diagnostics)

    return jax.vmap(chain)(jax.random.split(key, settings.chains))


def _chain(
    settings: HMC, target: Callable[[Array], Array], key: Array, start: Float[Array, " n"]
) -> tuple[Array, Array, Array, Array]:
    """Draws, their log densities, share of divergent transitions, mean number of leapfrogs."""
    kernel = blackjax.hmc.build_kernel()
    start_averaging, update_averaging, averaged = dual_averaging_adaptation(settings.acceptance)
    inverse_mass = jnp.ones_like(start)

    # One loop over warm-up and draws, as every copy of the kernel is compiled.
    def step(carry, data):
        state, averaging = carry
        key, length, warming = data
        size = jnp.where(warming, jnp.exp(averaging.log_step_size), averaged(averaging))
        leapfrogs = jnp.ceil(length / size)
        leapfrogs = jnp.clip(leapfrogs, 1, settings.most_leapfrogs).astype(int)
        state, info = kernel(key, state, target, size, inverse_mass, leapfrogs)
        adapted = update_averaging(averaging, info.acceptance_rate)
        averaging = jax.tree.map(partial(jnp.where, warming), adapted, averaging)
        record = state.position, state.logdensity, info.is_divergent, leapfrogs
        return (state, averaging), record

    carry = (
        blackjax.hmc.init(start, target),
        start_averaging(jnp.asarray(FIRST_STEP_SIZE, start.dtype)),
    )
    count = settings.warmup + settings.draws
    lengths = LONGEST * jnp.mod(GOLDEN * jnp.arange(1, count + 1, dtype=start.dtype), 1.0)
    warming = jnp.arange(count) < settings.warmup
    _, records = jax.lax.scan(step, carry, (jax.random.split(key, count), lengths, warming))
    x, values, divergent, leapfrogs = jax.tree.map(lambda r: r[settings.warmup :], records)
    return x, values, jnp.mean(divergent, dtype=x.dtype), jnp.mean(leapfrogs, dtype=x.dtype)


def given_bound(least_inverse_depth: float, chains: Chains) -> tuple[Chains, Float[Array, ""]]:
    """The draws at which no inverse depth is below the bound, 1/m, and the least share of a chain.

    They are draws of the posterior by the prior that is truncated there: the same density, but for
    a factor, where it is not zero. To have the shape of before, draws are repeated evenly, which
    adds to their autocorrelation. A share of 0 says that a chain had none.
    """

    def of_chain(chain: Chains) -> tuple[Chains, Array]:
        above = jnp.all(chain.inverse_depths >= least_inverse_depth, axis=-1)
        count, draws = jnp.sum(above), above.size
        chosen = jnp.argsort(~above, stable=True)[jnp.arange(draws) * count // draws]

        def take(x):
            return x[chosen] if x.ndim else x

        return jax.tree.map(take, chain), count / draws

    kept, shares = jax.vmap(of_chain)(chains)
    return kept, jnp.min(shares)


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
