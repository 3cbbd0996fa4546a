"""The least squares of a window by variable projection: the landmarks always at their best.

Jointly, path and inverse depths are bilinear, and Levenberg–Marquardt creeps along the bent valleys
of that. Here every landmark is minimised anew for each path (variable projection: Golub, Pereyra
1973; Hong, Fitzgibbon 2015 for bundle adjustment). The valley of scale is then a straight line
through the origin, and most starts of most windows converge in ten steps. optimistix has no
variable projection: its solvers take the unknowns jointly.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.conditional import forward_only
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.window.problem import (
    Path,
    Reduced,
    X,
    Y,
    cholesky_each,
    landmark_slopes,
    path,
    reduced,
    residuals,
)
from jaxslam.filters.window.record import Record
from jaxslam.geometry import Scalar
from jaxslam.linalg import cholesky

TOLERANCE = 1e-3
"""A minimum is found when a step lessens half the sum of squares by less than this."""
NO_REVERSE = (
    "a start from rest has no derivatives in reverse mode, since its search ends when it "
    "converges: use forward mode (jax.jvp, jax.jacfwd), or a filter without +rest"
)
LANDMARK_STEPS = 3
"""Steps of the landmarks for every step of the path."""
TURN_STEPS = 4
"""Steps of the rotation that fits a start."""


class Minimum(eqx.Module):
    """The state of a minimisation, or of a batch of them."""

    x: Float[Array, "*k N"]
    y: Float[Array, "*k m q"]
    cost: Float[Array, "*k"]
    """|x|² + |y|² + |r|²; ∞ before the first step, and where nothing is possible."""
    damping: Float[Array, "*k"]
    converged: Bool[Array, "*k"]


def started(x: X, y: Y) -> Minimum:
    """The state of a minimisation before the first step."""
    cost, damping = jnp.asarray(jnp.inf, x.dtype), jnp.asarray(1e-3, x.dtype)
    return Minimum(x, y, cost, damping, jnp.asarray(False))


def minimised(
    slam: AbstractSlam, record: Record, start: Minimum, steps: int | Int[Array, ""]
) -> tuple[Minimum, Reduced]:
    """The state of a minimisation after at most so many steps, and the quadratic there."""
    shapes = jax.eval_shape(lambda at: reduced(slam, record, at.x, at.y), start)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def going(carry):
        step, now, _ = carry
        return (step < steps) & ~now.converged

    def once(carry):
        step, *now = carry
        return step + 1, *_step(slam, record, *now)

    last = jax.lax.while_loop(going, once, (jnp.zeros((), int), start, nothing))[1:]
    return forward_only(last, NO_REVERSE)


def _step(
    slam: AbstractSlam, record: Record, now: Minimum, local: Reduced
) -> tuple[Minimum, Reduced]:
    """One of Levenberg–Marquardt; the first only brings the landmarks to their best."""
    fresh = jnp.isinf(now.cost)
    H, g = local.information, local.gradient
    damped = H + jnp.diag(now.damping * jnp.diagonal(H))
    step = jnp.where(fresh, 0.0, cholesky(damped).solve(g))
    promised = g @ step - step @ (H @ step) / 2
    x = now.x - step
    y, cost = landmarks(slam, record, path(slam, record, x), now.y, LANDMARK_STEPS)
    cost = cost + x @ x
    gained = (now.cost - cost) / 2
    better = jnp.isfinite(cost) & (fresh | (gained > 0))
    settled = ~fresh & (better & (gained < TOLERANCE) & (promised < 5 * TOLERANCE))
    eased = now.damping * jnp.where(gained > promised / 2, 0.1, 0.5)
    eased = jnp.where(fresh, now.damping, eased)
    damping = jnp.where(better, eased, jnp.maximum(5 * now.damping, 1e-4))
    there, here = (x, y, cost), (now.x, now.y, now.cost)
    at = jax.tree.map(lambda new, old: jnp.where(better, new, old), there, here)
    local = jax.tree.map(
        lambda new, old: jnp.where(fresh | better, new, old), reduced(slam, record, x, y), local
    )
    return Minimum(*at, damping, settled | (damping > 1e8)), local


def landmarks(slam: AbstractSlam, record: Record, at: Path, y: Y, steps: int) -> tuple[Y, Scalar]:
    """Every landmark at its best given the path, by damped Gauss–Newton; and |y|² + |r|²."""
    eye = jnp.eye(y.shape[1], dtype=y.dtype)

    def once(carry, _):
        damping, (kept, information, slope, cost) = carry
        damped = information * (1 + damping[:, None, None] * eye)
        tried = kept - jax.vmap(lambda A, b: A.solve(b))(cholesky_each(damped), slope)
        there = tried, *landmark_slopes(slam, record, at, tried)
        better = there[-1] <= cost
        best = jax.tree.map(
            lambda new, old: jnp.where(better.reshape(-1, *(1,) * (new.ndim - 1)), new, old),
            there,
            (kept, information, slope, cost),
        )
        damping = jnp.where(better, damping / 10, jnp.maximum(10 * damping, 1e-3))
        return (damping, best), None

    # A step of nothing first: the slopes are then one piece of the program and not two.
    m = len(y)
    start = y, jnp.broadcast_to(eye, (m, *eye.shape)), jnp.zeros_like(y), jnp.full(m, jnp.inf)
    carry = jnp.zeros(m, y.dtype), jax.tree.map(lambda x: x.astype(y.dtype), start)
    (_, (y, _, _, cost)), _ = jax.lax.scan(once, carry, length=steps + 1)
    return y, jnp.sum(cost)


def turned(slam: AbstractSlam, record: Record, x: X, y: Y) -> X:
    """The start of the motion with the rotation that fits its translation best.

    Only the initial angular velocity moves: it takes up the mean flow.
    """
    n, t = slam.motion.geometry.point_dim, slam.motion.geometry.tangent_dim

    def wrong(turn):
        moved = x.at[n:t].add(turn)
        r = residuals(slam, record, path(slam, record, moved), y).ravel()
        return r, r

    def once(turn, _):
        J, r = jax.jacfwd(wrong, has_aux=True)(turn)
        information = J.T @ J + 1e-6 * jnp.eye(t - n, dtype=x.dtype)
        return turn - cholesky(information).solve(J.T @ r), None

    turn, _ = jax.lax.scan(once, jnp.zeros(t - n, x.dtype), length=TURN_STEPS)
    return x.at[n:t].add(jnp.where(jnp.all(jnp.isfinite(turn)), turn, 0.0))
