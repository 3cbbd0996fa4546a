"""The update by measurements: the Kalman update, its iterations, and their base class.

A correction is a piece of `Slam`. The remedies for an inconsistent filter are others
(`jaxslam.filters.remedies`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam.filters.linear.blocks import Model, Noise, minus, observed, plus, residuals
from jaxslam.filters.linear.covariance import curvature
from jaxslam.filters.linear.state import State
from jaxslam.linalg import cholesky, symmetric_part
from jaxslam.models.observations import Features, Innovation, Slots, judged

ROUNDING = 4.0
"""Units in the last place of its own that every variance gets back in an update.

Differences of matrices are positive up to rounding only, and what rounding takes from an
unobserved direction in single precision adds up over hundreds of steps. With this, eigenvalues of
the correlations stay above `−n ε` however many there are (measured over 600 steps).
"""


class AbstractCorrection(eqx.Module):
    """A correction of the state by the features seen.

    A correction of your own is one class with `update`; what it cannot go with it says by its class
    variables (`jaxslam.filters.compatible` reads them).
    """

    name: ClassVar[str] = "the correction"
    """The correction as messages call it."""
    divisible: ClassVar[bool] = True
    """Whether the state then is mean and covariance of `x ⊞ δ`, to be divided and merged."""
    world_centric: ClassVar[bool] = False
    """Whether it is for landmarks held in the base frame only."""
    metric: ClassVar[bool] = False
    """Whether it is for a filter whose unit of length is the metre."""
    one_form: ClassVar[bool] = False
    """Whether it is for landmarks written in one form, in themselves: neither anchored nor
    converted."""
    knows_gauge: ClassVar[bool] = False
    """Whether it reads the gauge of the frame, which is not known of keyframes."""

    @property
    def base(self) -> AbstractCorrection:
        """The correction that decides what this goes with: itself, unless it is around another."""
        return self

    @abstractmethod
    def update(
        self,
        model: Model,
        state: State,
        features: Features,
        noise: Noise,
        context: PyTree,
        considered: slice = slice(0, 0),
    ) -> tuple[State, Innovation]:
        """Correct by all features at once (P16, P17), and the innovation.

        `noise` is the covariance R of one measurement, or one for each feature. A feature that is
        not valid, not in the map or predicted behind the camera changes nothing. The `considered`
        numbers of the core count with their covariance but have no gain (Schmidt, 1966).
        """

    def remember(self, state: State, slots: Slots) -> State:
        """Keep what is needed of landmarks that were just written in these slots, of which those
        out of bounds are none."""
        del slots
        return state


def checked_steps(steps: int) -> int:
    """The steps. Raises ValueError for less than one of Gauss–Newton."""
    if steps < 1:
        raise ValueError(f"an update takes at least 1 step of Gauss–Newton, not {steps}")
    return steps


class Kalman(AbstractCorrection):
    """The extended Kalman filter's (P16, P17); of several steps, the iterated one's (Bell, Cathey:
    The Iterated Kalman Filter Update as a Gauss–Newton Method, IEEE TAC 1993)."""

    steps: int = eqx.field(static=True, default=1, converter=checked_steps)
    """Steps of Gauss–Newton to the maximum of the posterior, all on the prior of the frame."""
    mean: bool = eqx.field(static=True, default=False)
    """Whether every step ends at the mean in place of the maximum (`to_mean`), so that the next one
    is linearised there."""

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        data = features, noise, context, considered, self.mean
        return gauss_newton(model, state, self.steps, lambda before, after: after, *data)


def gauss_newton(
    model: Model,
    state: State,
    steps: int,
    corrected: Callable[[State, State], State],
    *data: PyTree,
) -> tuple[State, Innovation]:
    """Take so many steps to the maximum of the posterior. Every step, from `before` to `after`,
    is then `corrected(before, after)`. `data` are what `kalman_update` asks for.

    Gauss–Newton on whitened states, as optimistix has it, knows no blocks: three steps then take
    three times as long (64 runs of `matched` with `robocentric+iterated3`), and compile for longer.
    """
    at, offset = state, None
    for _ in range(steps - 1):
        after, _ = kalman_update(model, at, offset, *data)
        at = corrected(at, replace(after, covariance=at.covariance))
        offset = minus(state, at)
    after, innovation = kalman_update(model, at, offset, *data)
    return corrected(at, after), innovation


def kalman_update(
    model: Model,
    state: State,
    offset: Float[Array, " n"] | None,
    features: Features,
    noise: Noise,
    context: PyTree,
    considered: slice = slice(0, 0),
    mean: bool = False,
) -> tuple[State, Innovation]:
    """The update by all features at once (P16, P17), in Joseph's form, of the prediction
    x ⊞ offset, with H and the residuals of the state x; None is no offset. With `mean` the
    estimate is then moved by `to_mean`."""
    predicted, residual, used, blocks = residuals(model, state, features, context)
    P = state.covariance
    R = noise if noise.shape[-1] > residual.shape[1] else noise_matrix(noise, used)
    HP = observed(blocks, features.slots, P)
    S = observed(blocks, features.slots, HP.T).T + R
    factor = cholesky(S)
    whitening = factor.whitening
    K = ((HP.T @ whitening.T) @ whitening).at[considered].set(0.0)
    if offset is not None:
        moved = observed(blocks, features.slots, offset[:, None])
        residual = residual - moved.reshape(residual.shape)
    whitened = whitening @ residual.ravel()

    # Joseph's (I - KH) P (I - KH)ᵀ + K R Kᵀ, multiplied out from the left: two products of
    # rank m, and none of n × n matrices. An error of K then counts by its square only; what
    # rounding does to the differences is made good by `ROUNDING`.
    left = P - K @ HP
    covariance = left + (K @ R - observed(blocks, features.slots, left.T).T) @ K.T
    lost = ROUNDING * jnp.finfo(P.dtype).eps * jnp.diagonal(P).at[considered].set(0.0)
    delta = K @ residual.ravel()
    corrected = replace(state, covariance=symmetric_part(covariance) + jnp.diag(lost))
    if mean:
        delta += to_mean(model, corrected, features.slots, used, K, context).at[considered].set(0.0)
    state = plus(corrected, delta if offset is None else offset + delta)
    variances = jnp.diagonal(covariance) + lost
    status = judged(factor.positive & jnp.all(variances >= 0), variances, state.landmarks)
    nis = whitened @ whitened
    return state, Innovation(predicted, residual, S, used, nis, status, factor.log_det())


def to_mean(
    model: Model,
    state: State,
    slots: Slots,
    used: Bool[Array, " m"],
    gain: Float[Array, "n mp"],
    context: PyTree,
) -> Float[Array, " n"]:
    """δ from the maximum of a posterior to its mean, `−P Σ_a ∂²h_a K_a`: −P times the gradient of
    ½ log det P⁻¹, with the covariance P after the update and its gain `K = P Hᵀ R⁻¹` (Lindley,
    *Approximate Bayesian Methods*, 1980; Tierney, Kadane, JASA 1986).

    What multiplies an unknown number, such as the displacement that makes a new landmark's
    parallax, is on the average less than where it is likeliest. Of the second order this is what
    the maximum leaves out; `−½ K tr(∂²h P)`, which moves what is measured, made no estimate better.
    Where δ is longer than 1 σ, derivatives say little: it is shortened to less.
    """
    hessian, local = curvature(model, state, slots, context)
    m, p, k = hessian.shape[:3]
    hessian = jnp.where(used[:, None, None, None], hessian, 0.0)
    own = observed(local, slots, gain).reshape(m, k, m, p)[jnp.arange(m), :, jnp.arange(m)]
    slope = jnp.sum(hessian * jnp.swapaxes(own, 1, 2)[:, :, None], axis=(1, 3)).ravel()
    moved = observed(local, slots, state.covariance).T @ slope
    squared = slope @ observed(local, slots, moved[:, None])[:, 0]
    return -moved / jnp.sqrt(1 + squared)


def noise_matrix(noise: Noise, used: Bool[Array, " m"]) -> Float[Array, "mp mp"]:
    """Block-diagonal R, with an identity block where a feature is not used."""
    m, p = used.size, noise.shape[-1]
    blocks = jnp.where(used[:, None, None], noise, jnp.eye(p, dtype=noise.dtype))
    R = jnp.zeros((m, p, m, p), noise.dtype)
    return R.at[jnp.arange(m), :, jnp.arange(m), :].set(blocks).reshape(m * p, m * p)
