"""The information form: the covariance form's steps on Λ = P⁻¹, an update being a sparse sum.

A measurement of landmark i adds to four blocks of Λ, those of the core and of landmark i; two
landmarks are coupled only by what is marginalised between them: the pose and the noises of a step
(Eade, Drummond: Scalable Monocular SLAM, CVPR 2006; Monocular SLAM as a Graph of Coalesced
Observations, ICCV 2007; Thrun et al.: Sparse Extended Information Filters, IJRR 2004). The models,
their blocks and the linearisation points are the covariance form's, and so are the results.

Λ must exist: landmarks have no redundant parameters, what is exactly known counts as known to
`EXACT_SIGMA`, and calibration is not `consider`ed, which is no sum of information.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam._numerics.arrays import AnyArray
from jaxslam._numerics.linalg import Cholesky, cholesky, inverse
from jaxslam.filters.forms.blocks import (
    Blocks,
    NewLandmarks,
    indices,
    masked,
    placed,
    residuals,
    shifted,
    small_products,
)
from jaxslam.filters.forms.form import AbstractGaussian, OfCore
from jaxslam.filters.forms.state import AbstractState
from jaxslam.filters.protocol import Moments
from jaxslam.geometry import jacobian, tangent_dim
from jaxslam.landmarks import LANDMARKS
from jaxslam.models.observations import Innovation, judged

EXACT_SIGMA = 1e-6
"""Least σ that Λ represents: a micrometre, a microradian. A smaller one, as of the pose at the
start, counts as this one. Next to what a step of motion adds it is nothing, and in double
precision no digit that matters is lost to 1/σ²."""


class InformationState(AbstractState):
    """Mean and information matrix.

    Rows and columns of what is not in the state are zero: inactive slots, and the noises between
    steps. Everything else is positive definite.
    """

    information: Float[Array, "n n"]
    memory: PyTree = ()

    @property
    def covariance(self) -> Float[Array, "n n"]:
        """P as `State` has it, zero for what is not in the state. O(n³)."""
        whitened = _whitened(
            self, jnp.diag(_present(self.information).astype(self.landmarks.dtype))
        )
        return whitened.T @ whitened


class Information(AbstractGaussian):
    """Mean and information matrix."""

    innovation_covariance: ClassVar[bool] = False

    def check(self, slam: Any) -> None:
        """Raise ValueError for landmarks with redundant parameters, whose covariance has no
        inverse, for those that change their form, and for a calibration that is considered."""
        n, landmark = slam.motion.geometry.point_dim, slam.landmark
        if landmark.size(n) != n or landmark.convert is not None:
            minimal = ", ".join(p.name for p in LANDMARKS.values() if p.size(n) == n)
            raise ValueError(
                f"the information form needs landmarks of {n} parameters, in one form "
                f"({minimal}), not {landmark.name}"
            )
        if not slam.calibration.corrected:
            raise ValueError("the information form cannot consider a calibration: estimate it")

    def empty(self, core: PyTree, landmarks: Float[Array, "capacity d"]) -> InformationState:
        """A state of slots that hold no landmark yet, and a core that is still to be augmented."""
        n = tangent_dim(core) + landmarks.size
        active = jnp.zeros(landmarks.shape[0], bool)
        return InformationState(core, landmarks, active, jnp.zeros((n, n), landmarks.dtype))

    def augment(self, state: InformationState, start: int, covariance: Float[Array, "k k"]):
        """Give k numbers of the core, from `start`, an independent covariance: its inverse in Λ.

        Variances below `EXACT_SIGMA²` count as that.
        """
        if covariance.size == 0:
            return state
        part = slice(start, start + covariance.shape[0])
        information = cholesky(representable(covariance)).inverse()
        return replace(state, information=state.information.at[part, part].set(information))

    def set_exact(self, state: InformationState, start: int, size: int) -> InformationState:
        """Numbers of the core that are known exactly: a variance of zero, as far as that can be."""
        return self.augment(state, start, jnp.zeros((size, size), state.information.dtype))

    def marginalise(self, state: InformationState, start: int, size: int) -> InformationState:
        """Forget k numbers of the core, by the Schur complement: what they tied becomes coupled."""
        if size == 0:
            return state
        information = _without(state.information, start, jnp.ones(size, bool))
        return replace(state, information=information)

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        """`Λ ← Λ + Σ HᵢᵀR⁻¹Hᵢ` and the mean by `Λ δ = b = Σ HᵢᵀR⁻¹rᵢ`, all features at once.

        Blocks between two landmarks stay as they are, bit for bit. The NIS needs no S:
        `rᵀS⁻¹r = rᵀR⁻¹r − bᵀδ`. Raises ValueError for `considered` numbers.
        """
        if considered.start != considered.stop:
            raise ValueError("the information form cannot consider: its update is a sum")
        predicted, residual, used, H = residuals(model, state, features, context)
        weight = jnp.broadcast_to(cholesky(noise).inverse(), (*used.shape, *noise.shape))
        information = _added(state, H, features.slots, weight)
        weighted = small_products(weight, residual[..., None])[..., 0]
        b = _pulled_back(state, H, features.slots, weighted)
        factor = _factor(information)
        delta = factor.solve(b)
        nis = jnp.sum(residual * weighted) - b @ delta
        state = replace(shifted(state, delta), information=information)
        status = judged(factor.positive, information, state.landmarks)
        return state, Innovation(predicted, residual, None, used, nis, status)

    def transformed(
        self, state: InformationState, J_core: Float[Array, "c c"], J: Blocks | None
    ) -> InformationState:
        """`Λ ← J⁻ᵀ Λ J⁻¹`.

        Parts of the core that are set to a constant keep their old variables in the change, which
        is then invertible, and are marginalised after it.
        """
        spent = jnp.all(J_core == 0, axis=1)
        core_inverse = inverse(J_core + jnp.diag(spent.astype(J_core.dtype)))
        back = None if J is None else _inverted(J, core_inverse, state.active)

        def rows(matrix):
            return _transposed_rows(core_inverse, back, matrix, state.core_dim)

        information = _without(rows(rows(state.information).T), 0, spent)
        return replace(state, information=(information + information.T) / 2)

    def with_new(self, state: InformationState, new: NewLandmarks) -> InformationState:
        """Information `N⁻¹` on `y − J x`, of the landmark y, the core x and the covariance N of y
        given x: the same sum as an update's (P22–P26)."""
        valid = new.slots < state.active.size
        own = small_products(new.root, jnp.swapaxes(new.root, 1, 2))
        own = jnp.where(valid[:, None, None], own, jnp.eye(own.shape[-1], dtype=own.dtype))
        weight = jax.vmap(lambda N: cholesky(N).inverse())(own)
        difference = masked(new.J._replace(by_view=-new.J.by_view), valid)
        return replace(state, information=_added(state, difference, new.slots, weight))

    def remove(
        self, state: InformationState, gone: Bool[AnyArray, " capacity"]
    ) -> InformationState:
        """O(n³), where the covariance form only forgets."""
        numbers = jnp.repeat(gone, state.landmarks.shape[1])
        information = _without(state.information, state.core_dim, numbers)
        return replace(state, active=state.active & ~gone, information=information)

    def local_covariance(self, state: InformationState, J: Blocks, slots) -> Float[Array, "m k k"]:
        """Factors Λ, which the covariance form need not: O(n³), then O(n²) a landmark."""
        m, k, _ = J.by_landmark.shape
        whitened = _whitened(state, placed(J, slots, state.active.size))
        whitened = whitened.reshape(-1, m, k)
        return jnp.einsum("nmk,nml->mkl", whitened, whitened)

    def core_covariance(self, function: OfCore, state: InformationState) -> Moments:
        J = jacobian(function, state.core)
        J = jnp.pad(J, ((0, 0), (0, state.landmarks.size)))
        whitened = _whitened(state, J)
        return function(state.core), whitened.T @ whitened


def representable(covariance: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """The covariance with its variances raised to `EXACT_SIGMA²`, where they are less."""
    variances = jnp.diagonal(covariance)
    return covariance + jnp.diag(jnp.maximum(EXACT_SIGMA**2 - variances, 0.0))


def _added(state, J: Blocks, slots, weight: Float[Array, "m k k"]) -> Float[Array, "n n"]:
    """`Λ + Σ JᵢᵀWᵢJᵢ`, by the blocks that are not zero."""
    c, V = state.core_dim, J.view_by_core
    weighted_view = small_products(weight, J.by_view)
    weighted_own = small_products(weight, J.by_landmark)
    by_view_T, by_landmark_T = jnp.swapaxes(J.by_view, 1, 2), jnp.swapaxes(J.by_landmark, 1, 2)
    core = V.T @ jnp.sum(small_products(by_view_T, weighted_view), axis=0) @ V
    cross = V.T @ small_products(by_view_T, weighted_own)
    own = small_products(by_landmark_T, weighted_own)

    index, numbers = indices(slots, state), jnp.arange(c)
    information = state.information.at[:c, :c].add(core)
    information = information.at[numbers[:, None], index[:, None, :]].add(cross, mode="drop")
    information = information.at[index[:, None, :], numbers[:, None]].add(cross, mode="drop")
    return information.at[index[:, :, None], index[:, None, :]].add(own, mode="drop")


def _pulled_back(state, J: Blocks, slots, weighted: Float[Array, "m k"]) -> Float[Array, " n"]:
    """`Σ Jᵢᵀ wᵢ`."""
    core = J.view_by_core.T @ jnp.einsum("mkv,mk->v", J.by_view, weighted)
    own = jnp.einsum("mkd,mk->md", J.by_landmark, weighted)
    b = jnp.zeros(state.information.shape[0], weighted.dtype).at[: state.core_dim].set(core)
    return b.at[indices(slots, state)].add(own)


def _inverted(J: Blocks, core_inverse: Float[Array, "c c"], active) -> Blocks:
    """Blocks of the inverse change of one that is zero in inactive slots; the identity there."""
    identity = jnp.eye(J.by_landmark.shape[-1], dtype=core_inverse.dtype)
    own = jax.vmap(inverse)(jnp.where(active[:, None, None], J.by_landmark, identity))
    return Blocks(J.view_by_core @ core_inverse, -small_products(own, J.by_view), own)


def _transposed_rows(core: Float[Array, "c c"], J: Blocks | None, B, c: int):
    """`AᵀB` for A = [core, 0; by_view · view_by_core, by_landmark], landmark by landmark."""
    if J is None:
        return jnp.concatenate([core.T @ B[:c], B[c:]])
    capacity, d, v = J.by_view.shape
    below = B[c:].reshape(capacity, d, -1)
    by_view = J.by_view.reshape(capacity * d, v)
    above = core.T @ B[:c] + J.view_by_core.T @ (by_view.T @ B[c:])
    own = small_products(jnp.swapaxes(J.by_landmark, 1, 2), below)
    return jnp.concatenate([above, own.reshape(B[c:].shape)])


def _without(information: Float[Array, "n n"], start: int, gone: Bool[Array, " k"]):
    """Λ with the marked ones of k numbers, from `start`, marginalised: their rows are zero.

    `Λ − Λ_rg Λ_gg⁻¹ Λ_gr`, with an identity in place of what stays.
    """
    part = slice(start, start + gone.size)
    both = gone[:, None] & gone[None, :]
    block = jnp.where(both, information[part, part], 0.0)
    rows = jnp.where(gone[:, None], information[part], 0.0)
    whitened = _factor(block).whitening @ rows
    kept = jnp.ones(information.shape[0], bool).at[part].set(~gone)
    left = information - whitened.T @ whitened
    return jnp.where(kept[:, None] & kept[None, :], left, 0.0)


def _present(information: Float[Array, "n n"]) -> Bool[Array, " n"]:
    """Whether each number is in the state."""
    return jnp.diagonal(information) != 0


def _factor(information: Float[Array, "n n"]) -> Cholesky:
    """Λ's, with an identity in place of what is not in the state."""
    absent = ~_present(information)
    return cholesky(information + jnp.diag(absent.astype(information.dtype)))


def _whitened(state: InformationState, J: Float[Array, "k n"]) -> Float[Array, "n k"]:
    """`L⁻¹Jᵀ`, so that a covariance `J Λ⁻¹ Jᵀ` is its square."""
    return _factor(state.information).whitening @ J.T
