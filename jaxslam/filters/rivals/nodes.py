"""A map of nodes in information form (Eade, Drummond, ICCV 2007).

A node is a camera in which landmarks are one Gaussian by its information, in (x/z, y/z, 1/z). What
a frame sees is *coalesced* into the active node: its camera and the landmarks are found together
by Gauss–Newton, then the camera is marginalised. So the map says what frames say of landmarks;
cameras are not in it, and nothing is said by a motion, whose velocity is where an iteration begins.

When the camera has left its node, another begins there, whose map begins anew. Both maps are
independent, since a measurement is in one of them, and the similarity between them, an *edge*, is
found by least squares from the landmarks that they share. The camera's pose is that of the chain of
edges and of the active node, with the sum of their covariances, carried by adjoints: they are taken
as independent, as published, though an edge is found from maps that the next edge and the pose in
the node are found from too.

Choices where the publication leaves or needs them:

- The first node is in metres by the prior on 1/z. A later one has no unit but by what it is given:
  the mean of its first landmarks' 1/z, weighted by 1/z, is as the earlier node has it.
- What an earlier node knows of a landmark is where the iteration begins, and the mean of a prior on
  1/z; its σ is that of any new landmark, or of the same share of 1/z where that is more.
- A calibration that is drawn in every frame is marginalised with the frame's camera.
- Without a closed loop the graph is a chain, in which there is nothing to optimise, and nodes but
  the last two leave nothing but their edges. A landmark that is seen again after that is new.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.arrays import AnyArray, cast, precision
from jaxslam.filters.gaussian import check_features
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.kalman import Kalman
from jaxslam.filters.protocol import (
    AbstractFilter,
    CameraView,
    Corrected,
    EachMoments,
    LandmarkView,
    Moments,
    OfCamera,
    OfLandmark,
)
from jaxslam.geometry import (
    Homogeneous,
    Pose,
    difference,
    homogeneous_apply,
    identity,
    jacobian,
    log,
    retract,
    scaled,
)
from jaxslam.landmarks import ImagePlane
from jaxslam.linalg import cholesky, symmetric_part
from jaxslam.models.calibration import AbstractCalibration, Known
from jaxslam.models.depth import InverseDepth
from jaxslam.models.frame import Keyframe, KeyframePose, Robocentric
from jaxslam.models.motion import ConstantVelocity, Control, check_control
from jaxslam.models.observations import (
    Capacity,
    Features,
    Innovation,
    PriorMap,
    Slots,
    judged,
)
from jaxslam.models.sensors import AbstractSensor, noises

_PLANE = ImagePlane()
_UNIT = 1e-3
"""σ of a later node's unit of length, as a share of it."""
_LOOSE = 4.0
"""σ of 1/z where a landmark begins again, in the earlier node's."""
_FLOOR = 1e-3
"""Information on a pose of which nothing is seen, and on an edge."""

Similarity = tuple[Pose, Float[Array, " 1"]]
"""(T, λ): X is at `T (e^λ X)`."""


class Node(eqx.Module):
    """A map in the camera N in which it began, and the last camera C."""

    landmarks: Float[Array, "slots d"]
    """(x/z, y/z, 1/z) in N; of a landmark that is not held, where an iteration begins."""
    information: Float[Array, "slots*d slots*d"]
    held: Bool[Array, " slots"]
    camera: Pose
    """T_NC."""
    covariance: Float[Array, "s s"]
    """Of camera and landmarks."""


class Graph(eqx.Module):
    """The active node, and the way to it."""

    node: Node
    velocity: Float[Array, " t"]
    """In the camera's axes and the node's unit."""
    first: Bool[Array, ""]
    """Whether the next camera is the second."""
    earlier: Node
    """The node before, as it was left."""
    edge: Similarity
    """The active node in the earlier one."""
    edge_covariance: Float[Array, "u u"]
    chain: Similarity
    """The earlier node in B."""
    chain_covariance: Float[Array, "u u"]


class Coalesced(Innovation):
    """How a frame and the map disagree once the camera is found, which takes numbers of its own."""

    camera_dim: int = eqx.field(static=True, default=0)

    @property
    def nis_dof(self) -> Int[Array, ""]:
        return jnp.maximum(self.residual.shape[-1] * jnp.sum(self.used) - self.camera_dim, 0)


class Nodes(AbstractFilter):
    """A camera's map of nodes. Raises ValueError for pieces of which there is none."""

    motion: ConstantVelocity
    """Its velocity at the start is where the first iteration begins; nothing else is used."""
    sensor: AbstractSensor
    calibration: AbstractCalibration = Known()
    depth: InverseDepth = InverseDepth.beyond(1.0)
    left: Keyframe = Keyframe(turn=0.5, parallax=0.5)
    """How far the camera may be from the node's."""
    share: float = eqx.field(static=True, default=0.5)
    """A node also ends when less than this share of its landmarks is seen."""
    steps: int = eqx.field(static=True, default=3)
    """Steps of Gauss–Newton in a frame."""

    def __check_init__(self) -> None:
        for wrong, why in (
            (self.sensor.hidden != 1, f"of a camera, not of {type(self.sensor).__name__}"),
            (type(self.motion) is not ConstantVelocity, "of a camera with a velocity alone"),
            (
                self.calibration.sigma.size and not self.calibration.each_frame,
                "with a calibration that is known, or drawn in every frame",
            ),
            (self.depth.common is not None, "with priors on depth that have nothing in common"),
            (self.steps < 1, f"found in 1 step of Gauss–Newton at least, not {self.steps}"),
        ):
            if wrong:
                raise ValueError(f"nodes are {why}")

    def init(
        self, capacity: int | Capacity, first: Features | None = None, known: PriorMap | None = None
    ) -> Graph:
        """Raises ValueError for a prior map, which has no frames that could be coalesced."""
        if known is not None:
            raise ValueError("a map of nodes takes no prior map; leave out known")
        count, geometry, dtype = (
            Capacity.of(capacity).landmarks,
            self.motion.geometry,
            precision(self),
        )
        d, t = geometry.point_dim, geometry.tangent_dim
        landmarks = jnp.zeros((count, d), dtype).at[:, -1].set(self.depth.mean)
        P, here = jnp.zeros((t + count * d, t + count * d), dtype), identity(geometry, dtype)
        node = Node(landmarks, P[t:, t:], jnp.zeros(count, bool), here, P)
        velocity, sure = jnp.asarray(self.motion.velocity, dtype), jnp.zeros((t + 1, t + 1), dtype)
        none = here, sure[0, :1]
        state = Graph(node, velocity, jnp.array(True), node, none, sure, none, sure)
        if first is None:
            return state
        check_features(self, first)
        return replace(state, node=self._coalesced(state, first, jnp.array(True), jnp.eye(t))[0])

    def step(self, state: Graph, control: Control, seen: Features, new: Features) -> Corrected:
        check_control(self.motion, control)
        dtype = state.velocity.dtype
        for features in (seen, new):
            check_features(self, features)
        seen, new = (replace(x, noise_factor=_noise_factor(x)) for x in (seen, new))
        features = jax.tree.map(lambda *x: jnp.concatenate(x), seen, new)
        before, velocity, motion = state.node.camera, state.velocity, cast(self.motion, dtype)
        parts = velocity, jnp.zeros_like(velocity)
        root = block_diag(motion.start()[1], jnp.diag(motion.noise_sigma))
        J = jacobian(lambda parts: motion.displacement(*parts, control), parts) @ root
        told = cholesky(J @ J.T + 1e-12 * jnp.eye(len(J))).inverse()
        told = jnp.where(state.first, told, _FLOOR * jnp.eye(len(J)))
        step = motion.displacement(*parts, control)
        node = replace(state.node, camera=(before @ step).normalize())
        due = self._due(node, features)
        state = replace(state, node=node)
        state = jax.tree.map(partial(jnp.where, due), self._begun(state, features), state)
        node, innovation = self._coalesced(state, features, due, told, len(seen.slots))
        still = due | (control <= 0)
        found = log(before.inverse() @ node.camera) / jnp.where(still, 1.0, control)
        velocity = jnp.where(still, velocity, found)
        state = replace(state, node=node, velocity=velocity, first=jnp.array(False))
        shared = jnp.any(node.held & state.earlier.held)
        return jax.lax.cond(shared, lambda x: self._joined(x), lambda x: x, state), innovation

    def remove(self, state: Graph, gone: Bool[AnyArray, " slots"]) -> Graph:
        """Marginalise landmarks and free their slots. An edge that was found from them stays."""
        node, earlier, t = state.node, state.earlier, state.velocity.size
        held = node.held & ~gone
        rows = jnp.repeat(held, node.landmarks.shape[1])
        P = _only(node.covariance[t:, t:], rows)
        kept = _only(cholesky(P + jnp.diag(~rows)).inverse(), rows)
        information = jnp.where(jnp.any(gone & node.held), kept, node.information)
        covariance = _only(node.covariance, jnp.append(jnp.ones(t, bool), rows))
        stays = earlier.held & ~gone & ~jnp.any(gone & node.held & earlier.held)
        node = replace(node, information=information, held=held, covariance=covariance)
        return replace(state, node=node, earlier=replace(earlier, held=stays))

    def in_map(self, state: Graph) -> Bool[Array, " slots"]:
        """Those of the active node."""
        return state.node.held

    def marginal(self, state: Graph, function: OfCamera) -> Moments:
        def value(parts):
            return function(CameraView(_chained(*parts)[0]))

        t = state.velocity.size
        return _moments(value, state, (state.node.camera,), state.node.covariance[:t, :t])

    def landmark_marginal(self, state: Graph, function: OfLandmark, slots: Slots) -> EachMoments:
        node, t, d = state.node, state.velocity.size, state.node.landmarks.shape[1]

        def value(parts):
            pose, log_scale = _chained(*parts[:3])
            point, omega = _seen(*parts[2:])
            return function(LandmarkView(pose, point, omega * jnp.exp(-log_scale[0])))

        def of(slot):
            index = jnp.append(jnp.arange(t), t + slot * d + jnp.arange(d))
            own = node.camera, node.landmarks[slot]
            return _moments(value, state, own, node.covariance[index[:, None], index])

        return jax.vmap(of)(slots)

    def _due(self, node: Node, features: Features) -> Bool[Array, ""]:
        """Whether the predicted camera has left the node, and sees enough of it for an edge."""
        again, (_, d) = jnp.sum(_again(node, features)), node.landmarks.shape
        points, omegas = jax.vmap(_PLANE.homogeneous)(node.landmarks)
        distances = jnp.where(node.held, jnp.abs(omegas) / jnp.linalg.norm(points, axis=1), 0.0)
        left = self.left.left(KeyframePose(node.camera, node.camera), distances)
        few = again < self.share * jnp.sum(node.held)
        return (left | few) & (d * again > self.motion.geometry.tangent_dim)

    def _begun(self, state: Graph, features: Features) -> Graph:
        """A node at the predicted camera, with nothing in it but its unit."""
        old, way, here = (
            state.node,
            (state.chain, state.edge),
            identity(self.motion.geometry, state.velocity.dtype),
        )
        moved = jax.vmap(partial(_PLANE.transform, old.camera.inverse()))(old.landmarks)
        landmarks = jnp.where(old.held[:, None], moved, old.landmarks)
        weight = jnp.where(_again(old, features), landmarks[:, -1], 0.0)
        weight = weight / jnp.maximum(weight @ weight, 1e-9) / _UNIT
        unit = jnp.zeros_like(landmarks).at[:, -1].set(weight).ravel()
        node = Node(landmarks, unit[:, None] * unit, old.held & False, here, old.covariance * 0)
        (T, log_scale), J = _composed(*way), jacobian(lambda way: _composed(*way), way)
        P = J @ block_diag(state.chain_covariance, state.edge_covariance) @ J.T
        free, chain = jnp.eye(len(P), dtype=P.dtype) / _FLOOR, (T.normalize(), log_scale)
        edge = old.camera, 0 * log_scale
        return Graph(node, state.velocity, state.first, old, edge, free, chain, P)

    def _coalesced(
        self,
        state: Graph,
        features: Features,
        pinned: Bool[Array, ""],
        told: Float[Array, "t t"],
        again: int = 0,
    ) -> tuple[Node, Coalesced]:
        """The node with the frame's measurements in it, the first `again` of which may be of
        landmarks in the map. `pinned`: the camera is the node's own, exactly."""
        node, slots, t, p = state.node, features.slots, state.velocity.size, self.sensor.size
        (count, d), dtype = node.landmarks.shape, node.landmarks.dtype
        slam = cast(self, dtype)
        calibration, sensor, sigma = (
            slam.calibration,
            slam.sensor,
            jnp.asarray(slam.calibration.sigma),
        )
        measured = jnp.where(features.valid[:, None], features.measured, 0.0)
        unit = jnp.exp(state.chain[1][0] + state.edge[1][0])

        def begun(measured, landmark, known, sigma):
            """A landmark, and mean and σ of its prior on 1/z."""
            mean, own = slam.depth.mean * unit, slam.depth.sigma * unit
            before = sensor.chart(*_seen(node.camera, landmark))[-1]
            known &= before > mean * 1e-3
            sigma = jnp.minimum(own * jnp.maximum(before / mean, 1.0), _LOOSE * sigma)
            own = jnp.where(known, sigma, own)
            mean = jnp.where(known, before, mean)
            point, omega = sensor.locate(measured, mean[None])
            landmark = _PLANE.transform(node.camera, _PLANE.initialise(point, omega, omega))
            return landmark, mean, own

        begins = features.valid & ~node.held[slots]
        earlier = jnp.sqrt(jnp.diagonal(state.earlier.covariance)[t:][d - 1 :: d])
        start, mean, own = jax.vmap(begun)(
            measured, node.landmarks[slots], state.earlier.held[slots], earlier[slots]
        )
        start = node.landmarks.at[jnp.where(begins, slots, count)].set(start, mode="drop")
        points, _ = jax.vmap(partial(_seen, node.camera))(start[slots])
        used = features.valid & jax.vmap(sensor.possible)(points)
        held = node.held.at[jnp.where(used, slots, count)].set(True, mode="drop")
        noise = jnp.broadcast_to(noises(sensor, measured), (len(slots), p, p))
        noise = noise * _noise_factor(features)[:, None, None]
        noise = jax.vmap(block_diag)(noise, (own**2)[:, None, None])
        weight = jax.vmap(lambda R: cholesky(R).inverse())(noise)
        weight = weight.at[:, p, p].multiply(begins) * used[:, None, None]
        told = jnp.where(pinned, jnp.eye(t), told)
        floor = block_diag(told, jnp.eye(sigma.size))
        rows = jnp.repeat(held, d)

        def observed(both):
            (camera, error), landmark = both
            point, omega = _seen(camera, landmark)
            pixel = calibration.sensor(sensor, sigma * error).measure(point, omega)
            return jnp.append(pixel, sensor.chart(point, omega)[-1])

        def compared(frame, landmark, measured, mean):
            predicted = observed((frame, landmark))
            residual = sensor.residual(measured, predicted[:p])
            return jnp.append(residual, mean - predicted[p]), jacobian(observed, (frame, landmark))

        def improved(frame, landmarks):
            """A step of Gauss–Newton, and the information that it is made of."""
            r, J = jax.vmap(partial(compared, frame))(landmarks[slots], measured, mean)
            J = J.at[..., :t].multiply(~pinned)
            H, G = J[..., : len(floor)], J[..., len(floor) :]
            A = floor + jnp.einsum("mia,mij,mjb->ab", H, weight, H)
            each = jnp.einsum("mia,mij,mjb->amb", H, weight, G)
            B = jnp.zeros((len(floor), count, d), dtype).at[:, slots].add(each)
            B = B.reshape(len(floor), count * d)
            own = jnp.einsum("mia,mij,mjb->mab", G, weight, G)
            M = node.information.reshape(count, d, count, d).at[slots, :, slots].add(own)
            M = M.reshape(count * d, count * d)
            off = (landmarks - node.landmarks).ravel()
            away = floor @ jnp.append(difference(node.camera, frame[0]), -frame[1])
            a = away + jnp.einsum("mia,mij,mj->a", H, weight, r)
            b = jnp.zeros((count, d), dtype)
            b = b.at[slots].add(jnp.einsum("mia,mij,mj->ma", G, weight, r)).ravel()
            b = b - node.information @ off
            factor = cholesky(M + jnp.diag(~rows))
            X = factor.solve(jnp.column_stack([B.T, b]))
            X, y = X[:, :-1], X[:, -1]
            Q = cholesky(A - B @ X).inverse()
            of_frame = Q @ (a - B @ y)
            of_landmarks = jnp.where(rows, y - X @ of_frame, 0.0)
            cost = jnp.einsum("mi,mij,mj", r, weight, r) + off @ node.information @ off
            cost = cost - a @ of_frame - b @ of_landmarks
            found = retract(frame, of_frame), landmarks + of_landmarks.reshape(count, d)
            return found, (A, B, M, X, Q, factor, cost, r)

        frame = node.camera, jnp.zeros(sigma.size, dtype)
        frame, landmarks = jax.lax.fori_loop(
            1, self.steps, lambda _, found: improved(*found)[0], (frame, start)
        )
        (frame, landmarks), (A, B, M, X, Q, factor, cost, r) = improved(frame, landmarks)
        P = jnp.block([[Q, -Q @ X.T], [-X @ Q, factor.inverse() + X @ Q @ X.T]])
        index = jnp.append(jnp.arange(t), len(floor) + jnp.arange(count * d))
        P = _only(P[index[:, None], index], jnp.append(jnp.full(t, ~pinned), rows))
        information = _only(M - B.T @ cholesky(A).solve(B), rows)
        node = Node(landmarks, symmetric_part(information), held, frame[0], symmetric_part(P))
        before = (used & ~begins)[:again]
        r = jnp.where(before[:, None], r[:again, :p], 0.0)
        status = judged(factor.positive, landmarks, P)
        nis = jnp.where(jnp.any(before), cost, 0.0)
        return node, Coalesced(measured[:again] - r, r, None, before, nis, status, camera_dim=t)

    def _joined(self, state: Graph) -> Graph:
        """The edge between the active node and the earlier one, from the landmarks they share."""
        node, earlier, t = state.node, state.earlier, state.velocity.size
        (count, d), u = node.landmarks.shape, t + 1
        rows = jnp.repeat(node.held & earlier.held, d)
        own = node.covariance[t:, t:].reshape(count, d, count, d)

        def moved(both):
            (pose, log_scale), landmark = both
            return _PLANE.transform(pose, _PLANE.scale(jnp.exp(log_scale[0]), landmark))

        def improved(edge):
            here = jax.vmap(lambda x: moved((edge, x)))(node.landmarks)
            J = jax.vmap(lambda x: jacobian(moved, (edge, x)))(node.landmarks)
            J = jnp.where(rows.reshape(count, d, 1), J, 0.0)
            P = jnp.einsum("aij,ajbk,blk->aibl", J[..., u:], own, J[..., u:])
            P = _only(P.reshape(count * d, -1) + earlier.covariance[t:, t:], rows)
            factor, X = cholesky(P + jnp.diag(~rows)), J[..., :u].reshape(count * d, u)
            r = jnp.where(rows, (earlier.landmarks - here).ravel(), 0.0)
            Q = cholesky(X.T @ factor.solve(X) + _FLOOR * jnp.eye(u)).inverse()
            return retract(edge, Q @ (X.T @ factor.solve(r))), Q

        start = state.edge, state.edge_covariance
        edge, Q = jax.lax.fori_loop(0, self.steps, lambda _, found: improved(found[0]), start)
        return replace(state, edge=edge, edge_covariance=Q)


def with_nodes(slam: AbstractFilter, parallax: int | None = None) -> Nodes:
    """The map of nodes of these pieces, a node of which ends after so much parallax, %.

    Raises ValueError for a filter with pieces that it has no use for.
    """
    if not isinstance(slam, AbstractSlam) or slam.layered:
        raise ValueError("nodes are made of the pieces of one Gaussian, without others around it")
    for wrong, why in (
        (slam.landmark != _PLANE, f"of image_plane landmarks, not {slam.landmark.name}"),
        (
            slam.frame != Robocentric(),
            f"frames of their own: robocentric+nodes, not {slam.frame.name}",
        ),
        (slam.scale.free or slam.correction != Kalman(), "without a scale gauge or a remedy"),
    ):
        if wrong:
            raise ValueError(f"nodes are {why}")
    made = Nodes(slam.motion, slam.sensor, slam.calibration, slam.depth)
    return made if parallax is None else replace(made, left=Keyframe(0.5, parallax / 100))


def _noise_factor(features: Features) -> Float[Array, " m"]:
    if features.noise_factor is None:
        return jnp.ones(features.valid.shape, features.measured.dtype)
    return features.noise_factor


def _again(node: Node, features: Features) -> Bool[Array, " slots"]:
    """The node's landmarks that are seen."""
    places = features.places(node.held.size)
    return jnp.zeros_like(node.held).at[places].set(True, mode="drop") & node.held


def _seen(T_NC: Pose, landmark: Float[Array, " d"]) -> Homogeneous:
    point, omega = _PLANE.homogeneous(landmark)
    return homogeneous_apply(T_NC.inverse(), point, omega), omega


def _composed(first: Similarity, second: Similarity) -> Similarity:
    (T, a), (V, b) = first, second
    return T @ scaled(V, jnp.exp(a[0])), a + b


def _chained(chain: Similarity, edge: Similarity, camera: Pose) -> Similarity:
    """The camera in B, and its node's unit in metres."""
    return _composed(_composed(chain, edge), (camera, 0 * edge[1]))


def _moments(value: Callable, state: Graph, own: PyTree, covariance: Array) -> Moments:
    """Of a function of chain, edge, and what is the active node's own."""
    parts = state.chain, state.edge, *own
    J = jacobian(value, parts)
    P = block_diag(state.chain_covariance, state.edge_covariance, covariance)
    return value(parts), symmetric_part(J @ P @ J.T)


def _only(matrix: Float[Array, "n n"], rows: Bool[Array, " n"]) -> Float[Array, "n n"]:
    return jnp.where(rows[:, None] & rows, matrix, 0.0)
