"""Splits and mergers of the members of a Gaussian sum.

In every frame the members whose linearisation costs most are split, and the pairs whose merger
costs least are merged (split and merge: Ueda et al. 2000; for filters Faubel et al. 2009). Where a
split gains nothing there are fewer members, and only those that are there are computed.

What costs is the product of the camera's displacement t with inverse depths. In a measurement
h(X − ω t), with X and ω as they are at the estimate, errors of both neglect `−(∂h/∂X) δt δω`. So a
member's cost is the squared pixels `tr(M P_t)`, with its own variance P_t of the displacement and

    M = Σᵢ σ_ωᵢ² (∂h/∂X)ᵀ (∂h/∂X),   over the landmarks i in view.

Splits and mergers keep the sum's mean and covariance. Members that differ along t differ in scale,
of which the amplitude of innovations says something, wrongly where the prior on depth is wrong: so
once the cost is small they are split across t alone (`ACROSS`). As soon as one linearisation
serves, the sum ends in one Gaussian (`ENOUGH`), and is one until that costs more than `ACROSS`
across t: along it the cost grows with the error of the scale, which nothing observes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.conditional import at_places, cond, map_or_zero
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.blocks import minus, plus
from jaxslam.filters.linear.covariance import landmark_moments
from jaxslam.filters.linear.state import State
from jaxslam.filters.mixture.sum_state import SumState, member, moments
from jaxslam.filters.model import COMPOSED, Context, Core
from jaxslam.geometry import jacobian, log
from jaxslam.linalg import cholesky, eigh
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features
from jaxslam.models.sensors import AbstractSensor, noises

WORTH = 3e-5
"""What a split has to gain, in σ² of a measured pixel, summed over the landmarks; two members
whose merger costs less than a quarter of it are one."""
FEW = 7
"""Members up to which that is so. Of k members it is `(k/FEW)⁴` times as much, as every one costs
the same time."""
ACROSS, ENOUGH = 1e-2, 1e-4
"""Costs of a sum as one Gaussian, σ² of a pixel for all landmarks together. Below the first, splits
are across the displacement alone; below the second the sum ends: pairs are merged whatever it
costs, and no member is split. The only member is, where it costs the first across."""
SPLIT = 0.8
"""Halves of a split member are ± so many of its σ from its mean."""


def divided(slam: AbstractSlam, state: SumState, control: Control, seen: Features) -> SumState:
    """A predicted sum after splits, and as many mergers of other members: each takes three."""
    cost = _root_of_cost(slam, state.likeliest, seen)

    def pixels_at(at: Core) -> Pixels:
        context = slam.model.given(at, Context(control))
        # Of the logarithm: a turn is not to be split for what it does to the translation.
        return lambda core: cost @ log(slam.model.displacement(core, context))[: len(cost)]

    return _split_and_merged(_parts(pixels_at, state), max(1, state.log_weights.size // 3))


def _root_of_cost(slam: AbstractSlam, likeliest: State, seen: Features) -> Float[Array, "n n"]:
    """C with `CᵀC = M` of the landmarks that are seen, at the likeliest member."""
    model = slam.model

    def view_of(core):
        return model.view(core, COMPOSED)

    def inverse_depth(view, landmark):
        return model.camera_point(view, landmark)[1][None]

    _, variances = landmark_moments(view_of, inverse_depth, likeliest, seen.slots)
    view = view_of(likeliest.core)
    sensor = model.sensor_at(view.calibration)

    def by_point(landmark):
        point, omega = model.camera_point(view, landmark)
        # With the measurement that is predicted.
        return jax.jacfwd(lambda point: (sensor.measure(point, omega),) * 2, has_aux=True)(point)

    slopes, predicted = jax.vmap(by_point)(likeliest.landmarks[seen.slots])
    slopes = _whitening(sensor, predicted, seen.valid) @ slopes
    counted = jnp.where(seen.valid, variances[:, 0, 0], 0.0)
    M = jnp.einsum("m,mpi,mpj->ij", counted, slopes, slopes)
    # Nearly singular where one landmark is seen, and zero where none is.
    total = jnp.maximum(jnp.trace(M), jnp.finfo(M.dtype).tiny)
    return jnp.sqrt(total) * cholesky(M / total + 1e-6 * jnp.eye(len(M), dtype=M.dtype)).root.T


def _whitening(
    sensor: AbstractSensor, measured: Float[Array, "m p"], valid: Bool[Array, " m"]
) -> Float[Array, "p p"] | Float[Array, "m p p"]:
    """L⁻¹ of the noise `L Lᵀ` of all measurements, or of each that is valid."""
    noise = noises(sensor, measured)
    if noise.ndim == 2:
        return cholesky(noise).whitening
    noise = jnp.where(valid[:, None, None], noise, jnp.eye(sensor.size, dtype=noise.dtype))
    return jax.vmap(cholesky)(noise).whitening


class _Parts(NamedTuple):
    """A sum, and functions of the core of every member: values, Jacobians, and covariances."""

    sum: SumState
    values: Float[Array, "k n"]
    by_core: Float[Array, "k n c"]
    covariances: Float[Array, "k n n"]


Pixels = Callable[[Core], Float[Array, " n"]]


def _described(
    pixels_at: Callable[[Core], Pixels], core: Core, covariance: Float[Array, "c c"]
) -> tuple[Array, Array, Array]:
    pixels = pixels_at(core)
    by_core = jacobian(pixels, core)
    return pixels(core), by_core, by_core @ covariance @ by_core.T


def _parts(pixels_at: Callable[[Core], Pixels], state: SumState) -> _Parts:
    c = state.likeliest.core_dim
    of = state.members.core, state.members.covariance[:, :c, :c]
    return _Parts(state, *map_or_zero(lambda of: _described(pixels_at, *of), of, state.alive))


def _split_and_merged(parts: _Parts, rounds: int) -> SumState:
    """So many times, each of other members: the one of the greatest cost split, and two of the
    others merged, if that is a gain; else two merged, if that costs nothing."""
    alone = jnp.sum(parts.sum.alive) == 1
    parts, cost = _as_late(parts, alone)
    one_serves = cost < jnp.where(alone, ACROSS, ENOUGH)
    no = jnp.zeros(rounds, bool)
    places, due, divided = cond(
        ~(alone & one_serves),
        lambda _, *told: _planned(*told, rounds),
        (jnp.zeros((rounds, 3), int), no, no),
        *(parts.sum.log_weights, parts.values, parts.covariances, one_serves),
    )
    split = jnp.any(divided & (places[:, 2] == jnp.arange(parts.sum.alive.size)[:, None]), axis=1)
    return at_places(_replaced, parts.sum, (parts.by_core, split), places, due, None)


def _as_late(parts: _Parts, alone: Bool[Array, ""]) -> tuple[_Parts, Float[Array, ""]]:
    """What a split may reach: near the end, and of the only member, only what is across the values,
    the displacement; and what the sum costs as one Gaussian, or the only member across."""

    def as_one(parts):
        return jnp.trace(moments(parts.sum.log_weights, parts.values, parts.covariances)[1])

    late = alone | (as_one(parts) < ACROSS)

    def across(value, by_core, P):
        squared = value @ value
        share = jnp.where(late, 1.0, 0.0) / jnp.where(squared > 0, squared, 1.0)
        left = jnp.eye(value.size, dtype=value.dtype) - share * jnp.outer(value, value)
        return value, left @ by_core, left @ P @ left

    left = _Parts(parts.sum, *jax.vmap(across)(*parts[1:]))
    return left, jnp.where(alone, as_one(left), as_one(parts))


def _planned(
    log_weights: Float[Array, " k"],
    values: Float[Array, "k n"],
    covariances: Float[Array, "k n n"],
    one_serves: Bool[Array, ""],
    rounds: int,
) -> tuple[Int[Array, "w 3"], Bool[Array, " w"], Bool[Array, " w"]]:
    """The places of two that are merged and of one that is split, so many times; whether that is
    due, and whether the split is. Where one Gaussian serves, pairs are merged alone.

    The cost of the sum is `Σ w tr(P)` of the members' `pixels(core)`, in σ² of a pixel. A split
    lessens it by `w δ² λ` with the greatest eigenvalue λ; a merger adds
    `wᵢ wⱼ/(wᵢ + wⱼ) |pᵢ − pⱼ|²`, and nothing with a member without weight, whose place it frees.
    """
    weights, alive = jnp.exp(log_weights), jnp.isfinite(log_weights)
    variances = jax.vmap(lambda P: eigh(P)[0][-1])(covariances)
    gains = jnp.where(alive, weights * SPLIT**2 * variances, 0.0)

    tiny, index = jnp.finfo(weights.dtype).tiny, jnp.arange(weights.size)
    shared = weights[:, None] * weights / jnp.maximum(weights[:, None] + weights, tiny)
    apart = jnp.sum((values[:, None] - values) ** 2, axis=-1)
    loss = jnp.where(shared > 0, shared * apart, 0.0)
    loss = jnp.where(index[:, None] < index, loss, jnp.inf)
    both = alive[:, None] & alive

    def turn(carry, _):
        free, count = carry
        left = jnp.where(free[:, None] & free, loss, jnp.inf)
        split = jnp.argmax(jnp.where(free, gains, -jnp.inf))
        gain, one = gains[split], index == split
        others, cost = _cheapest(jnp.where(one[:, None] | one, jnp.inf, left))
        alike, least = _cheapest(jnp.where(both, left, jnp.inf))
        worth = jnp.where(one_serves, jnp.inf, WORTH * jnp.maximum(1.0, count / FEW) ** 4)
        divided = (gain > cost) & (gain > worth)
        due = divided | (least < worth / 4)
        pair = jnp.where(divided, others, alike)
        # A merger alone needs no third place, but places are different.
        third = jnp.argmax(free & (index != pair[0]) & (index != pair[1]))
        places = jnp.append(pair, jnp.where(divided, split, third))
        used = jnp.any(index[:, None] == places, axis=1)
        merged = jnp.all(alive[pair])
        count = count + jnp.where(due, divided.astype(int) - merged, 0)
        return (free & ~(used & due), count), (places, due, divided)

    start = jnp.ones_like(alive), jnp.sum(alive)
    return jax.lax.scan(turn, start, length=rounds)[1]


def _replaced(
    three: SumState, told: tuple[Float[Array, "3 n c"], Bool[Array, " 3"]], _: None
) -> SumState:
    """The first two merged in the first place, and the third split into the others; if it is to be
    split, or else the second place is free."""
    members, log_weights = three.members, three.log_weights
    by_core, divided = (x[2] for x in told)
    merged = collapsed(member(members, np.s_[:2]), log_weights[:2])
    halves = _halves(member(members, 2), by_core)
    old = member(members, np.s_[1:])
    two = jax.tree.map(lambda half, old: jnp.where(divided, half, old), halves, old)
    half = log_weights[2] - jnp.log(2.0)
    weights = jnp.where(divided, half, jnp.stack([-jnp.full_like(half, jnp.inf), log_weights[2]]))
    members = jax.tree.map(lambda one, two: jnp.concatenate([one[None], two]), merged, two)
    # Two that weigh nothing weigh nothing together; log 0 has no derivative.
    weigh = jnp.any(jnp.isfinite(log_weights[:2]))
    together = jnp.logaddexp(*jnp.where(weigh, log_weights[:2], 0.0))
    return SumState(members, jnp.append(jnp.where(weigh, together, -jnp.inf), weights))


def _cheapest(loss: Float[Array, "k k"]) -> tuple[Int[Array, " 2"], Float[Array, ""]]:
    """The pair that is merged at the least loss, and that; ∞ without a pair."""
    pair = jnp.stack(jnp.unravel_index(jnp.argmin(loss), loss.shape))
    return pair, loss[tuple(pair)]


def _halves(parent: State, by_core: Float[Array, "n c"]) -> State:
    """N(x, P) as ½ N(x + δ c, P − δ² c cᵀ) + ½ N(x − δ c, …), with `c = P g/√(gᵀ P g)`: a batch.

    g is the combination of the `n` functions of the core that varies most.
    """
    c = by_core.shape[-1]
    slopes = parent.covariance[:, :c] @ by_core.T
    values, vectors = eigh(by_core @ slopes[:c])
    sigma = jnp.sqrt(jnp.maximum(values[-1], jnp.finfo(values.dtype).tiny))
    away = SPLIT * slopes @ vectors[:, -1] / sigma
    parent = replace(parent, covariance=parent.covariance - jnp.outer(away, away))
    return jax.vmap(lambda sign: plus(parent, sign * away))(jnp.array([-1.0, 1.0], away.dtype))


def collapsed(members: State, log_weights: Float[Array, " k"]) -> State:
    """The Gaussian with the mean and the covariance of a sum, of any total weight.

    The mean is to first order in the members' distances from the likeliest.
    """
    likeliest = jnp.argmax(log_weights)
    centre = member(members, likeliest)
    total = jax.nn.logsumexp(log_weights)
    alone = jnp.where(jnp.arange(log_weights.size) == likeliest, 0.0, -jnp.inf)
    log_weights = jnp.where(jnp.isfinite(total), log_weights - total, alone)

    away = jax.vmap(minus, in_axes=(0, None))(members, centre)
    mean, covariance = moments(log_weights, away, members.covariance)
    return replace(plus(centre, mean), covariance=covariance)
