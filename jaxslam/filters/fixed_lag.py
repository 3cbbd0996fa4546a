"""A fixed-lag smoother around any filter: the last frames are linearised again and again.

The filter's state L frames ago is a Gaussian; what has happened since is kept as it was measured.
With every new frame the variables of the window, y (see `sensitivity`), move by Gauss–Newton
towards the maximum of their posterior, and the oldest frame is absorbed into the Gaussian, with
its Jacobians taken at the smoothed point. Bell (SIAM J. Optim. 1994) shows that an iterated
Kalman smoother is this Gauss–Newton; Dong-Si, Mourikis (ICRA 2011) discuss the marginalisation.

With a lag of one frame, iterated, it is the iterated EKF: always on the original prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxslam.filters import sensitivity
from jaxslam.filters.sensitivity import Compared, Distribution, Point
from jaxslam.filters.slam import Parameters, SlamFilter, check_one_gaussian
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.geometry import Pose, retract
from jaxslam.least_squares import levenberg_marquardt
from jaxslam.linalg import Cholesky, cholesky, semidefinite_root
from jaxslam.rig import Rig

LAG = 10
"""Frames of a lag whose number is not said."""
MOST_STEPS = 30
"""Of Levenberg–Marquardt in one frame."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frames:
    """What happened in some frames, the oldest first."""

    happened: Bool[Array, " frames"]
    """False in the places of frames that are not there yet: nothing moves in them."""
    control: Any
    seen: Features
    new: Features


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LagState:
    """The Gaussian before the window, the window, and what follows from both."""

    before: Distribution
    variables: Float[Array, " N"]
    """Where the window is linearised."""
    frames: Frames
    estimate: State
    """Mean and covariance of the newest state."""


class NormalEquations(NamedTuple):
    """The window at one point: `(I + AᵀA) δ = −g` with g = y − Aᵀ r."""

    newest: Point
    last: Compared
    """What the newest frame compared."""
    information: Cholesky
    """I + AᵀA."""
    gradient: Float[Array, " N"]

    def step(self) -> Float[Array, " N"]:
        """δ."""
        return -self.information.solve(self.gradient)


@dataclass(frozen=True)
class FixedLag:
    """The smoother around `base`, a filter in covariance form whose landmarks enter undelayed."""

    base: SlamFilter
    lag: int
    """L: frames that are linearised again with every new one."""
    iterations: int = 1
    """Gauss–Newton steps in a frame."""
    converge: bool = False
    """Levenberg–Marquardt to the maximum of the posterior first."""

    def __post_init__(self) -> None:
        if not isinstance(self.base, SlamFilter):
            raise ValueError("a fixed lag is around a filter, not around another window or a sum")
        if self.lag < 1 or self.iterations < 1:
            raise ValueError(
                f"a fixed lag has at least 1 frame and 1 iteration, not {self.lag} and "
                f"{self.iterations}"
            )
        check_one_gaussian(self.base, "a fixed lag")
        if self.base.calibration == "consider":
            raise ValueError("a fixed lag cannot consider a calibration: estimate it")

    @property
    def rig(self) -> Rig:
        return self.base.rig

    @property
    def calibration(self) -> str:
        return self.base.calibration

    def start(
        self,
        parameters: Parameters,
        capacity: int,
        velocity: Float[Array, " v"],
        velocity_sigma: Float[Array, " v"] | Float[Array, "v v"],
        features: tuple[int, int] | None = None,
    ) -> LagState:
        """The base filter's start, and an empty window.

        `features` says how many a frame has at the most, of landmarks in the map and of new ones;
        by default as many as there are slots.
        """
        state = self.base.start(parameters, capacity, velocity, velocity_sigma)
        known, new = (capacity, capacity) if features is None else features
        return self._begun(state, self._no_frames(state, known, new))

    def first(self, state: LagState, parameters: Parameters, new: Features) -> LagState:
        """Frame 0, which needs no smoothing: everything that is seen in it is new."""
        return self._begun(self.base.first(state.estimate, parameters, new), state.frames)

    def step(
        self,
        state: LagState,
        parameters: Parameters,
        control: Array,
        seen: Features,
        new: Features,
    ) -> tuple[LagState, Innovation]:
        """Absorb the oldest frame of the window, add this one, and smooth."""
        before, variables = self._absorbed(state, parameters)
        frames = _appended(state.frames, Frames(jnp.ones((), bool), control, seen, new))
        if self.converge:
            variables = self._maximum(parameters, before, variables, frames)
        window = self._normal_equations(parameters, before, variables, frames)
        innovation = _innovation(window, self.base.noise(parameters))
        for _ in range(self.iterations - 1):
            variables = variables + window.step()
            window = self._normal_equations(parameters, before, variables, frames)
        state = LagState(before, variables + window.step(), frames, _estimate(window))
        return state, innovation

    def remove(self, state: LagState, gone: Bool[Array, " capacity"]) -> LagState:
        """Marginalise landmarks, with what the window measured of them, and free their slots."""
        before, frames = state.before, state.frames
        n, c = before.offset.size, state.estimate.core_dim
        kept = jnp.repeat(~gone, before.landmarks.shape[1])
        kept = jnp.concatenate([jnp.ones(c, bool), kept])
        before = replace(
            before,
            active=before.active & ~gone,
            offset=jnp.where(kept, before.offset, 0.0),
            root=jnp.where(kept[:, None] & kept, before.root, 0.0),
        )

        def without(features):
            return replace(features, valid=features.valid & ~gone[features.slots])

        return LagState(
            before,
            state.variables.at[:n].set(jnp.where(kept, state.variables[:n], 0.0)),
            replace(frames, seen=without(frames.seen), new=without(frames.new)),
            self.base.remove(state.estimate, gone),
        )

    def reported(self, state: LagState) -> State:
        """The newest state as the base filter's."""
        return self.base.reported(state.estimate)

    def pose_error(self, state: LagState, T_BC: Pose) -> tuple[Float[Array, " t"], Array]:
        """As the base filter's, of the newest state; so are the following."""
        return self.base.pose_error(state.estimate, T_BC)

    def camera_pose(self, state: LagState) -> tuple[Pose, Float[Array, "t t"]]:
        return self.base.camera_pose(state.estimate)

    def landmarks_in_camera(self, state: LagState, parameters: Parameters, slots: Array):
        return self.base.landmarks_in_camera(state.estimate, parameters, slots)

    def landmarks_from_above(self, state: LagState, parameters: Parameters, slots: Array):
        return self.base.landmarks_from_above(state.estimate, parameters, slots)

    def landmarks_in_world(self, state: LagState, parameters: Parameters, slots: Array):
        return self.base.landmarks_in_world(state.estimate, parameters, slots)

    def _begun(self, state: State, frames: Frames) -> LagState:
        n = state.covariance.shape[0]
        root = semidefinite_root(state.covariance).root
        before = Distribution(
            state.core, state.landmarks, state.active, jnp.zeros(n, root.dtype), root
        )
        size = n + self.lag * self._noises(state)
        return LagState(before, jnp.zeros(size, root.dtype), frames, state)

    def _noises(self, state: State | Distribution) -> int:
        """How many variables a frame has of its own."""
        core = state.core
        return core.noise.size + (core.calibration.size if self.calibration == "white" else 0)

    def _no_frames(self, state: State, known: int, new: int) -> Frames:
        dtype, rig = state.landmarks.dtype, self.rig

        def features(count):
            return Features(
                jnp.zeros((self.lag, count), int),
                jnp.zeros((self.lag, count, rig.sensor.size(rig.geometry)), dtype),
                jnp.zeros((self.lag, count), bool),
            )

        still = rig.motion.no_control(rig.geometry, dtype)
        control = jax.tree.map(lambda x: jnp.tile(x, (self.lag, *(1,) * x.ndim)), still)
        return Frames(jnp.zeros(self.lag, bool), control, features(known), features(new))

    def _advance(self, parameters: Parameters, point: Point, frame: Frames):
        """One frame of the base filter, as a function of the variables."""

        def drawn(sigma):
            return jnp.where(frame.happened, sigma, 0.0)

        parameters = replace(
            parameters,
            motion_sigma=drawn(parameters.motion_sigma),
            intrinsics_sigma=drawn(parameters.intrinsics_sigma),
        )
        base: Any = replace(self.base, engine=sensitivity)
        return base.step(point, parameters, frame.control, frame.seen, frame.new)

    def _normal_equations(self, parameters, before, variables, frames) -> NormalEquations:
        point, compared = jax.lax.scan(
            lambda point, frame: self._advance(parameters, point, frame),
            sensitivity.begin(before, variables),
            frames,
        )
        A = compared.slope.reshape(-1, variables.size)
        information = A.T @ A + jnp.eye(variables.size, dtype=A.dtype)
        gradient = variables - compared.residual.ravel() @ A
        return NormalEquations(
            point,
            jax.tree.map(lambda x: x[-1], compared),
            cholesky(information),
            gradient,
        )

    def _absorbed(self, state: LagState, parameters: Parameters) -> tuple[Distribution, Array]:
        """The Gaussian after the oldest frame, linearised where the window has it, and the
        variables of the frames that are left and of one to come, at the same point."""
        before, y = state.before, state.variables
        n, q = before.offset.size, self._noises(before)
        own = y[: n + q]
        oldest = jax.tree.map(lambda x: x[0], state.frames)
        point, compared = self._advance(parameters, sensitivity.begin(before, own), oldest)
        A, S = compared.slope, point.sensitivity
        information = cholesky(A.T @ A + jnp.eye(n + q, dtype=A.dtype))
        offset = S @ information.solve(compared.residual @ A - own)
        V = information.whitening @ S.T
        root, whitening = semidefinite_root(V.T @ V)
        after = Distribution(point.core, point.landmarks, point.active, offset, root)
        return after, jnp.concatenate([-whitening @ offset, y[n + q :], jnp.zeros(q, y.dtype)])

    def _maximum(self, parameters, before, variables, frames) -> Array:
        """The maximum of the window's posterior, by Levenberg–Marquardt."""

        def residuals(variables, _):
            _, compared = jax.lax.scan(
                lambda point, frame: self._advance(parameters, point, frame),
                sensitivity.begin(before, variables),
                frames,
            )
            return jnp.concatenate([variables, compared.residual.ravel()])

        solution = optx.least_squares(
            residuals, levenberg_marquardt(1e-6), variables, max_steps=MOST_STEPS, throw=False
        )
        return solution.value


def with_lag(base: SlamFilter, frames: int | None) -> FixedLag:
    """The filter with a fixed lag of so many frames."""
    return FixedLag(base, LAG if frames is None else frames)


def iterated(base: SlamFilter | FixedLag, steps: int | None = None) -> FixedLag:
    """The filter, linearised at the maximum of the posterior; or after so many steps of
    Gauss–Newton. With no lag it is the iterated EKF: one frame, always on the original prior."""
    lagged = base if isinstance(base, FixedLag) else FixedLag(base, 1)
    if steps is None:
        return replace(lagged, converge=True)
    return replace(lagged, iterations=steps)


def _appended(frames: Frames, newest: Frames) -> Frames:
    return jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), frames, newest)


def _estimate(window: NormalEquations) -> State:
    """The newest state, to first order in the step that is left."""
    point, S = window.newest, window.newest.sensitivity
    delta, c = S @ window.step(), point.core_dim
    V = window.information.whitening @ S.T
    return State(
        retract(point.core, delta[:c]),
        point.landmarks + delta[c:].reshape(point.landmarks.shape),
        point.active,
        V.T @ V,
    )


def _innovation(window: NormalEquations, noise: Float[Array, "p p"]) -> Innovation:
    """The newest frame against its prediction from all frames before.

    What is left of the residual after the step, e, and `W = I − A C Aᵀ`, with the covariance C
    after it, give the whitened innovation W⁻¹ e and its covariance W⁻¹.
    """
    last = window.last
    A = last.slope
    left = last.residual - A @ window.step()
    V = window.information.whitening @ A.T
    W = jnp.eye(left.size, dtype=A.dtype) - V.T @ V
    inverse_root = cholesky(W).whitening
    whitened = inverse_root @ left
    m, p = last.predicted.shape
    unwhiten = jnp.kron(jnp.eye(m, dtype=A.dtype), cholesky(noise).root)
    root = unwhiten @ inverse_root.T
    return Innovation(
        last.predicted,
        (root @ whitened).reshape(m, p),
        root @ root.T,
        last.used,
        whitened @ whitened,
    )
