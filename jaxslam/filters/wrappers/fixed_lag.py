"""A fixed-lag smoother around an EKF: the last frames are linearised again and again.

The filter's state L frames ago is a Gaussian; what has happened since is kept as it was measured.
With every new frame the variables of the window, y (see `sensitivity`), move by Gauss–Newton
towards the maximum of their posterior, and the oldest frame is absorbed into the Gaussian, with
its Jacobians taken at the smoothed point. Bell (SIAM J. Optim. 1994) shows that an iterated
Kalman smoother is this Gauss–Newton; Dong-Si, Mourikis (ICRA 2011) discuss the marginalisation.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.filters.ekf import EkfSlam, check_features, check_one_gaussian, correct
from jaxslam.filters.forms.blocks import shifted
from jaxslam.filters.forms.sensitivity import (
    Distribution,
    Point,
    Sensitivity,
    WhitenedResiduals,
    begin,
)
from jaxslam.filters.forms.state import State
from jaxslam.filters.protocol import (
    AbstractFilter,
    Corrected,
    EachMoments,
    Moments,
    OfCamera,
    OfLandmark,
    PoseError,
)
from jaxslam.geometry import Pose
from jaxslam.linalg import Cholesky, cholesky, semidefinite_root
from jaxslam.models.motion import Control, check_control
from jaxslam.models.observations import Capacity, Features, Innovation, Slots, judged

LAG = 10
"""Frames of a lag whose number is not said."""


class LagFrames(eqx.Module):
    """The events of some frames, the oldest first, or of one."""

    happened: Bool[Array, "*frames"]
    """False in the places of frames that are not there yet: nothing moves in them."""
    control: Control
    seen: Features
    new: Features


class LagState(eqx.Module):
    """The Gaussian before the window, the window, and what follows from both."""

    before: Distribution
    variables: Float[Array, " N"]
    """Where the window is linearised."""
    frames: LagFrames
    estimate: State
    """Mean and covariance of the newest state."""


class NormalEquations(NamedTuple):
    """The window at one point: `(I + AᵀA) δ = −g` with g = y − Aᵀ r."""

    newest: Point
    sensitivity: Float[Array, "n N"]
    """Of the newest point, S."""
    last: WhitenedResiduals
    """What the newest frame compared."""
    slope: Float[Array, "mp N"]
    """Of the newest frame, A."""
    information: Cholesky
    """I + AᵀA."""
    gradient: Float[Array, " N"]

    def step(self) -> Float[Array, " N"]:
        """δ."""
        return -self.information.solve(self.gradient)


class FixedLag(AbstractFilter):
    """The smoother around `base`, a filter in covariance form whose landmarks enter undelayed.

    It cannot free slots: without the measurements that the window has of landmarks that left the
    view, those that stayed would look too far away, as near ones leave first.

    Raises ValueError for another base, and for numbers out of range.
    """

    base: EkfSlam
    frames: int = eqx.field(static=True, default=LAG)
    """L: frames that are linearised again with every new one."""

    def __check_init__(self) -> None:
        check_one_gaussian(self.base, "a fixed lag")
        if self.frames < 1:
            raise ValueError(f"a fixed lag has at least 1 frame, not {self.frames}")
        if not self.base.calibration.corrected:
            raise ValueError("a fixed lag cannot consider a calibration: estimate it")

    @property
    def unwrapped(self) -> AbstractFilter:
        return self.base

    def init(self, capacity: int | Capacity, first: Features | None = None) -> LagState:
        """The base filter's, and an empty window. Frame 0 needs no smoothing: everything that is
        seen in it is new."""
        state = self.base.init(capacity, first)
        _, known, new = Capacity.of(capacity)
        frames = self._no_frames(state, known, new)
        n = state.covariance.shape[0]
        root = semidefinite_root(state.covariance).root
        before = Distribution(
            state.core, state.landmarks, state.active, jnp.zeros(n, root.dtype), root
        )
        size = n + self.frames * self._noises(state)
        return LagState(before, jnp.zeros(size, root.dtype), frames, state)

    def step(self, state: LagState, control: Control, seen: Features, new: Features) -> Corrected:
        """Absorb the oldest frame of the window, add this one, and smooth."""
        check_control(self.base.motion, control)
        before, variables = self._absorbed(state)
        frames = _appended(state.frames, LagFrames(jnp.ones((), bool), control, seen, new))
        window = self._normal_equations(before, variables, frames)
        innovation = _innovation(window, self.base.sensor.noise)
        state = LagState(before, variables + window.step(), frames, _estimate(window))
        status = judged(window.information.positive, state.estimate.covariance, state.variables)
        return state, replace(innovation, status=status)

    def marginal(self, state: LagState, function: OfCamera) -> Moments:
        """The marginal of the newest state, as the base filter's; so are the following."""
        return self.base.marginal(state.estimate, function)

    def landmark_marginal(self, state: LagState, function: OfLandmark, slots: Slots) -> EachMoments:
        return self.base.landmark_marginal(state.estimate, function, slots)

    def in_map(self, state: LagState) -> Bool[Array, " capacity"]:
        return self.base.in_map(state.estimate)

    def pose_error(self, state: LagState, T_BC: Pose) -> PoseError:
        return self.base.pose_error(state.estimate, T_BC)

    def _noises(self, state: State | Distribution) -> int:
        """The number of variables that a frame has of its own."""
        core = state.core
        return core.noise.size + (core.calibration.size if self.base.calibration.each_frame else 0)

    def _no_frames(self, state: State, known: int, new: int) -> LagFrames:
        dtype, base = state.landmarks.dtype, self.base

        def features(count):
            return Features(
                jnp.zeros((self.frames, count), int),
                jnp.zeros((self.frames, count, base.sensor.size), dtype),
                jnp.zeros((self.frames, count), bool),
            )

        still = base.motion.still(dtype)
        control = jax.tree.map(lambda x: jnp.tile(x, (self.frames, *(1,) * x.ndim)), still)
        return LagFrames(jnp.zeros(self.frames, bool), control, features(known), features(new))

    def _advance(
        self, before: Distribution, point: Point, frame: LagFrames
    ) -> tuple[Point, WhitenedResiduals]:
        """One frame of the base filter, as a function of the variables."""
        base = replace(self.base, form=Sensitivity(before, frame.happened))
        check_features(base, frame.seen)
        predicted = base.predict(point, frame.control)
        compared_at, compared = correct(base, predicted, frame.control, frame.seen)
        return base.close(base.compose(compared_at, frame.control), frame.new), compared

    def _normal_equations(self, before, variables, frames) -> NormalEquations:
        point, compared = self._through(before, variables, frames)
        A = jax.tree.map(lambda x: jax.lax.collapse(x, 0, 2), compared.slope).by_variables(before)
        information = A.T @ A + jnp.eye(variables.size, dtype=A.dtype)
        gradient = variables - compared.residual.ravel() @ A
        return NormalEquations(
            point,
            point.sensitivity(before),
            jax.tree.map(lambda x: x[-1], compared),
            A[-compared.residual.shape[1] :],
            cholesky(information),
            gradient,
        )

    def _through(self, before, variables, frames) -> tuple[Point, WhitenedResiduals]:
        """The window, frame by frame."""
        return jax.lax.scan(partial(self._advance, before), begin(before, variables), frames)

    def _absorbed(self, state: LagState) -> tuple[Distribution, Array]:
        """The Gaussian after the oldest frame, linearised where the window has it, and the
        variables of the frames that are left and of one to come, at the same point."""
        before, y = state.before, state.variables
        n, q = before.offset.size, self._noises(before)
        own = y[: n + q]
        oldest = jax.tree.map(lambda x: x[0], state.frames)
        point, compared = self._advance(before, begin(before, own), oldest)
        A, S = compared.slope.by_variables(before), point.sensitivity(before)
        information = cholesky(A.T @ A + jnp.eye(n + q, dtype=A.dtype))
        offset = S @ information.solve(compared.residual @ A - own)
        V = information.whitening @ S.T
        root, whitening = semidefinite_root(V.T @ V)
        after = Distribution(point.core, point.landmarks, point.active, offset, root)
        return after, jnp.concatenate([-whitening @ offset, y[n + q :], jnp.zeros(q, y.dtype)])


def _appended(frames: LagFrames, newest: LagFrames) -> LagFrames:
    return jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), frames, newest)


def _estimate(window: NormalEquations) -> State:
    """The newest state, to first order in the step that is left."""
    S = window.sensitivity
    point, V = shifted(window.newest, S @ window.step()), window.information.whitening @ S.T
    return State(point.core, point.landmarks, point.active, V.T @ V)


def _innovation(window: NormalEquations, noise: Float[Array, "p p"]) -> Innovation:
    """The newest frame against its prediction from all frames before.

    What is left of the residual after the step, e, and `W = I − A C Aᵀ`, with the covariance C
    after it, give the whitened innovation W⁻¹ e and its covariance W⁻¹.
    """
    last, A = window.last, window.slope
    left = last.residual - A @ window.step()
    V = window.information.whitening @ A.T
    W = jnp.eye(left.size, dtype=A.dtype) - V.T @ V
    factor, of_one = cholesky(W), cholesky(noise)
    inverse_root = factor.whitening
    whitened = inverse_root @ left
    m, p = last.predicted.shape
    unwhiten = jnp.kron(jnp.eye(m, dtype=A.dtype), of_one.root)
    root = unwhiten @ inverse_root.T
    return Innovation(
        last.predicted,
        (root @ whitened).reshape(m, p),
        root @ root.T,
        last.used,
        whitened @ whitened,
        judged(factor.positive, whitened),
        m * of_one.log_det() - factor.log_det(),
    )
