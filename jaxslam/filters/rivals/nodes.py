"""A map of nodes in information form (Eade, Drummond, ICCV 2007).

A node is a camera in which landmarks are one Gaussian by its information, in (x/z, y/z, 1/z). What
a frame sees is *coalesced* into the active node: its camera and the landmarks are found together
by Gauss–Newton, then the camera is marginalised. So the map knows what frames say of landmarks, and
cameras are not in it; the motion says where an iteration begins.

When the camera has left its node, another begins there, whose map begins anew. The maps are
independent, as a measurement is in one of them, and the similarity between them, an *edge*, is
found by least squares from the landmarks that they share. The camera's pose is that of the chain
of edges and of the active node, with the sum of their covariances, carried by adjoints. They are
taken as independent, as published, although an edge is found from maps of which the next edge and
the pose in the node are found too.

Choices where the publication leaves or needs them:

- The first node is in metres by the motion's start, which says how far its second camera is. Of no
  other camera the motion says anything: its velocity is that between the last two.
- The unit of a later node is that in which the mean of its first landmarks' 1/z, weighted by 1/z,
  is as the earlier node has it: else its scale would be in doubt by its priors, and count twice.
- A landmark that begins again has a prior on 1/z around what the earlier node knows, with four
  times the σ: a sixteenth of that information is used twice, but the iteration begins near.
- A calibration that is drawn in every frame is marginalised with the frame's camera.
- Without a closed loop the graph is a chain, in which there is nothing to optimise, and nodes but
  the last two leave only their edges. Of a landmark that is seen again later nothing is known.

It needs float64: in single precision the information of pixels leaves nothing of that on depth.
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
from jaxslam.filters.gaussian import check_features, noise_of
from jaxslam.filters.layer import AbstractSlam
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
from jaxslam.filters.slam import Slam
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
from jaxslam.models.frame import Keyframe, KeyframePose
from jaxslam.models.motion import ConstantVelocity, Control, check_control
from jaxslam.models.observations import Capacity, Features, Innovation, PriorMap, Slots, judged

_PLANE = ImagePlane()
_UNIT = 1e-3
"""σ of a later node's unit of length, as a share of it."""
_LOOSE = 4.0
"""σ of 1/z of a landmark that begins again, in the earlier node's."""
_NOTHING = 1e3
"""σ of what nothing is known of: a velocity, or an edge."""

Similarity = tuple[Pose, Float[Array, " 1"]]
"""(T, λ): X is at `T (e^λ X)`."""


class MapNode(eqx.Module):
    """A map in the camera N in which it began, and the last camera C."""

    landmarks: Float[Array, "slots d"]
    """(x/z, y/z, 1/z) in N; of a landmark that is not held, where an iteration begins."""
    information: Float[Array, "slots*d slots*d"]
    held: Bool[Array, " slots"]
    camera: Pose
    """T_NC."""
    covariance: Float[Array, "s s"]
    """The covariance of the camera and of all landmarks."""


class NodeGraph(eqx.Module):
    """The active node, and the way to it."""

    node: MapNode
    velocity: Float[Array, " t"]
    """In the camera's axes and the node's unit."""
    velocity_root: Float[Array, "t t"]
    """R of its covariance `R Rᵀ`."""
    earlier: MapNode
    """The node before, as it was left."""
    edge: Similarity
    """The active node in the earlier one."""
    edge_covariance: Float[Array, "u u"]
    chain: Similarity
    """The earlier node in B."""
    chain_covariance: Float[Array, "u u"]


class Nodes(AbstractFilter):
    """A map of nodes. Raises ValueError for pieces of which there is none.

    The camera of a frame is found from the same numbers: NIS has as many degrees of freedom fewer
    than are counted as a camera has.
    """

    slam: AbstractSlam
    """The motion, the sensor, its calibration and the prior on 1/z."""
    left: Keyframe = Keyframe(turn=0.5, parallax=0.5)
    """How far the camera may be from its node."""
    share: float = eqx.field(static=True, default=0.5)
    """A node also ends when less than this share of its landmarks is seen."""
    steps: int = eqx.field(static=True, default=3)
    """Steps of Gauss–Newton in a frame."""

    def __check_init__(self) -> None:
        slam, calibration = self.slam, self.slam.calibration
        for wrong, why in (
            (slam.landmark != _PLANE, f"of image_plane landmarks, not {slam.landmark.name}"),
            (slam.sensor.hidden != 1, f"of a camera, not of {type(slam.sensor).__name__}"),
            (type(slam.motion) is not ConstantVelocity, "of a camera whose velocity is constant"),
            (
                calibration.sigma.size and not calibration.each_frame,
                "with a calibration that is known, or drawn in every frame",
            ),
            (slam.sensor.rolling, "of a global shutter: cameras of a frame are one"),
            (slam.depth.common is not None, "with priors on depth that have nothing in common"),
            (self.steps < 1, f"found in 1 step of Gauss–Newton at least, not {self.steps}"),
        ):
            if wrong:
                raise ValueError(f"nodes are {why}")

    def init(
        self, capacity: int | Capacity, first: Features | None = None, known: PriorMap | None = None
    ) -> NodeGraph:
        """Raises ValueError for a prior map, which has no frames that could be coalesced."""
        if known is not None:
            raise ValueError("a map of nodes takes no prior map; leave out known")
        slam = cast(self.slam, precision(self.slam))
        velocity, root = slam.motion.start()
        count, here = Capacity.of(capacity).landmarks, identity(slam.motion.geometry, root.dtype)
        d, t = slam.motion.geometry.point_dim, len(root)
        landmarks = jnp.zeros((count, d), root.dtype).at[:, -1].set(slam.depth.mean)
        P, sure = (jnp.zeros((x, x), root.dtype) for x in (t + count * d, t + 1))
        node = MapNode(landmarks, P[t:, t:], jnp.zeros(count, bool), here, P)
        same = here, sure[0, :1]
        state = NodeGraph(node, velocity, root, node, same, sure, same, sure)
        if first is None:
            return state
        check_features(slam, first, count)
        return replace(state, node=self._coalesced(state, first, jnp.array(True), root)[0])

    def step(self, state: NodeGraph, control: Control, seen: Features, new: Features) -> Corrected:
        """Measurements have noise factors in both, or in none."""
        slam, velocity = cast(self.slam, state.velocity.dtype), state.velocity
        check_control(slam.motion, control)
        check_features(slam, seen)
        check_features(slam, new)
        features = jax.tree.map(lambda *x: jnp.concatenate(x), seen, new)
        told, before = (velocity, jnp.zeros_like(velocity)), state.node.camera
        J = jacobian(lambda told: slam.motion.displacement(*told, control), told)
        J = J @ block_diag(state.velocity_root, jnp.diag(slam.motion.noise_sigma))
        moved = before @ slam.motion.displacement(*told, control)
        state = replace(state, node=replace(state.node, camera=moved.normalize()))
        due = self._due(state.node, features)
        state = jax.tree.map(partial(jnp.where, due), self._begun(state, features), state)
        node, innovation = self._coalesced(state, features, due, J @ J.T, len(seen.slots))
        still = due | (control <= 0)
        found = log(before.inverse() @ node.camera) / jnp.where(still, 1.0, control)
        velocity, root = jnp.where(still, velocity, found), _NOTHING * jnp.eye(len(velocity))
        state = replace(state, node=node, velocity=velocity, velocity_root=root)
        shared = jnp.any(node.held & state.earlier.held)
        return jax.lax.cond(shared, lambda x: self._joined(x), lambda x: x, state), innovation

    def remove(self, state: NodeGraph, gone: Bool[AnyArray, " slots"]) -> NodeGraph:
        """Marginalise landmarks and free their slots. An edge that was found from them stays."""
        node, earlier, t = state.node, state.earlier, state.velocity.size
        rows = jnp.append(jnp.ones(t, bool), jnp.repeat(~gone & node.held, node.landmarks.shape[1]))
        P = _only(node.covariance, rows)
        kept = _only(cholesky((P + jnp.diag(~rows))[t:, t:]).inverse(), rows[t:])
        kept = jnp.where(jnp.any(gone & node.held), kept, node.information)
        stays = earlier.held & ~gone & ~jnp.any(gone & node.held & earlier.held)
        node = replace(node, information=kept, held=node.held & ~gone, covariance=P)
        return replace(state, node=node, earlier=replace(earlier, held=stays))

    def in_map(self, state: NodeGraph) -> Bool[Array, " slots"]:
        """Those of the active node."""
        return state.node.held

    def marginal(self, state: NodeGraph, function: OfCamera) -> Moments:
        return _moments(lambda pose, *_: function(CameraView(pose)), state, 0)

    def landmark_marginal(
        self, state: NodeGraph, function: OfLandmark, slots: Slots
    ) -> EachMoments:
        def value(pose, log_scale, camera, landmark):
            point, omega = _seen(camera, landmark)
            return function(LandmarkView(pose, point, omega * jnp.exp(-log_scale[0])))

        return jax.vmap(partial(_moments, value, state))(slots)

    def _due(self, node: MapNode, features: Features) -> Bool[Array, ""]:
        """Whether the predicted camera has left the node, and sees enough of it for an edge."""
        again, (_, d) = jnp.sum(_again(node, features)), node.landmarks.shape
        points, omegas = jax.vmap(_PLANE.homogeneous)(node.landmarks)
        distances = jnp.where(node.held, jnp.abs(omegas) / jnp.linalg.norm(points, axis=1), 0.0)
        left = self.left.left(KeyframePose(node.camera, node.camera), distances)
        few = again < self.share * jnp.sum(node.held)
        return (left | few) & (d * again > self.slam.motion.geometry.tangent_dim)

    def _begun(self, state: NodeGraph, features: Features) -> NodeGraph:
        """A node at the predicted camera, with nothing in it but its unit."""
        old, way = state.node, (state.chain, state.edge)
        moved = jax.vmap(partial(_PLANE.transform, old.camera.inverse()))(old.landmarks)
        landmarks = jnp.where(old.held[:, None], moved, old.landmarks)
        weight = jnp.where(_again(old, features), landmarks[:, -1], 0.0)
        weight = weight / jnp.maximum(weight @ weight, 1e-9) / _UNIT
        unit = jnp.zeros_like(landmarks).at[:, -1].set(weight).ravel()
        here = identity(self.slam.motion.geometry, weight.dtype)
        node = MapNode(landmarks, unit[:, None] * unit, old.held & False, here, old.covariance * 0)
        (T, log_scale), J = _composed(*way), jacobian(lambda way: _composed(*way), way)
        return replace(
            state,
            node=node,
            earlier=old,
            edge=(old.camera, 0 * log_scale),
            edge_covariance=_NOTHING**2 * jnp.eye(len(J), dtype=weight.dtype),
            chain=(T.normalize(), log_scale),
            chain_covariance=J @ block_diag(state.chain_covariance, state.edge_covariance) @ J.T,
        )

    def _coalesced(self, state: NodeGraph, features: Features, pinned, told, again: int = 0):
        """The node with the frame's measurements in it, the first `again` of which may be of
        landmarks in the map, and their innovation. `pinned`: the camera is the node's own; else
        `told` is the covariance of its pose by the motion."""
        node, slots, slam = state.node, features.slots, cast(self.slam, state.velocity.dtype)
        sensor, t, p, (count, d) = slam.sensor, len(told), slam.sensor.size, node.landmarks.shape
        measured = jnp.where(features.valid[:, None], features.measured, 0.0)
        sigma, unit = jnp.asarray(slam.calibration.sigma), jnp.exp(state.chain[1] + state.edge[1])
        size = t + sigma.size

        def begun(measured, landmark, known, sigma):
            """A landmark, and mean and σ of its prior on 1/z."""
            mean, own = slam.depth.mean * unit, slam.depth.sigma * unit[0]
            before = sensor.chart(*_seen(node.camera, landmark))[-1:]
            known &= before[0] > 0
            mean, own = (
                jnp.where(known, before, mean),
                jnp.where(known, jnp.minimum(own, sigma), own),
            )
            point, omega = sensor.locate(measured, mean)
            return _PLANE.transform(node.camera, _PLANE.initialise(point, omega, omega)), mean, own

        def observed(both):
            camera, error, landmark = both
            point, omega = _seen(camera, landmark)
            pixel = slam.calibration.sensor(sensor, sigma * error).measure(point, omega)
            return jnp.append(pixel, sensor.chart(point, omega)[-1])

        def improved(found):
            """A step of Gauss–Newton, and what it is made of."""

            def compared(landmark, measured, mean):
                both = *found[:2], landmark
                predicted, J = observed(both), jacobian(observed, both)
                residual = sensor.residual(measured, predicted[:p])
                return jnp.append(residual, mean - predicted[p]), J.at[:, :t].multiply(~pinned)

            r, J = jax.vmap(compared)(found[2][slots], measured, mean)
            own, off = jnp.einsum("mia,mij,mjb->mab", J, weight, J), difference(found, prior_mean)
            M = prior.at[index[:, :, None], index[:, None]].add(own)
            g = (-prior @ off).at[index].add(jnp.einsum("mia,mij,mj->ma", J, weight, r))
            factor = cholesky(M + jnp.diag(~rows))
            step = jnp.where(rows, factor.solve(g), 0.0)
            cost = jnp.einsum("mi,mij,mj", r, weight, r) + off @ prior @ off - g @ step
            return retract(found, step), (M, factor, cost, r)

        earlier = _LOOSE * jnp.sqrt(jnp.diagonal(state.earlier.covariance)[t + d - 1 :: d])
        known = state.earlier.held[slots]
        start, mean, own = jax.vmap(begun)(measured, node.landmarks[slots], known, earlier[slots])
        begins = features.valid & ~node.held[slots]
        start = node.landmarks.at[jnp.where(begins, slots, count)].set(start, mode="drop")
        points, _ = jax.vmap(partial(_seen, node.camera))(start[slots])
        used = features.valid & jax.vmap(sensor.possible)(points)
        held = node.held.at[jnp.where(used, slots, count)].set(True, mode="drop")
        noise = jnp.broadcast_to(
            noise_of(slam, replace(features, measured=measured)), (*slots.shape, p, p)
        )
        noise = jax.vmap(block_diag)(noise, own[:, None, None] ** 2)
        weight = jax.vmap(lambda R: cholesky(R).inverse())(noise) * used[:, None, None]
        weight = weight.at[:, p, p].multiply(begins)
        told = jnp.where(pinned, jnp.eye(t), told + 1e-12 * jnp.eye(t))
        prior = block_diag(cholesky(told).inverse(), jnp.eye(sigma.size), node.information)
        rows = jnp.append(jnp.ones(size, bool), jnp.repeat(held, d))
        index = jnp.broadcast_to(jnp.arange(size), (len(slots), size))
        index = jnp.append(index, size + slots[:, None] * d + jnp.arange(d), axis=1)
        prior_mean = node.camera, jnp.zeros(sigma.size, unit.dtype), node.landmarks
        found = jax.lax.fori_loop(
            1, self.steps, lambda _, found: improved(found)[0], (*prior_mean[:2], start)
        )
        (camera, _, landmarks), (M, factor, cost, r) = improved(found)
        across = M[size:, :size]
        information = M[size:, size:] - across @ cholesky(M[:size, :size]).solve(across.T)
        rows, kept = rows.at[:t].set(~pinned), jnp.append(jnp.arange(t), jnp.arange(size, len(M)))
        P = _only(factor.inverse(), rows)[kept[:, None], kept]
        information = symmetric_part(_only(information, rows[size:]))
        before = (used & ~begins)[:again]
        r = jnp.where(before[:, None], r[:again, :p], 0.0)
        told = before, jnp.where(jnp.any(before), cost, 0.0), judged(factor.positive, landmarks, P)
        innovation = Innovation(measured[:again] - r, r, None, *told)
        return MapNode(landmarks, information, held, camera, P), innovation

    def _joined(self, state: NodeGraph) -> NodeGraph:
        """The edge between the active node and the earlier one, from the landmarks they share."""
        node, earlier, t = state.node, state.earlier, state.velocity.size
        rows, u = jnp.repeat(node.held & earlier.held, node.landmarks.shape[1]), t + 1

        def moved(both):
            (pose, log_scale), landmarks = both
            scale = jnp.exp(log_scale[0])
            return jax.vmap(lambda x: _PLANE.transform(pose, _PLANE.scale(scale, x)))(landmarks)

        def improved(_, found):
            both = found[0], node.landmarks
            J = jnp.where(rows[:, None], jacobian(moved, both), 0.0)
            r = jnp.where(rows, (earlier.landmarks - moved(both)).ravel(), 0.0)
            P = J[:, u:] @ node.covariance[t:, t:] @ J[:, u:].T + _only(
                earlier.covariance[t:, t:], rows
            )
            factor, X = cholesky(P + jnp.diag(~rows)), J[:, :u]
            Q = cholesky(X.T @ factor.solve(X) + jnp.eye(u) / _NOTHING**2).inverse()
            return retract(found[0], Q @ (X.T @ factor.solve(r))), Q

        found = state.edge, state.edge_covariance
        edge, Q = jax.lax.fori_loop(0, self.steps, improved, found)
        return replace(state, edge=edge, edge_covariance=Q)


def with_nodes(slam: AbstractFilter, parallax: int = 50) -> Nodes:
    """The map of nodes of these pieces, a node of which ends after so much parallax, %.

    Raises ValueError for a filter with pieces that it has no use for.
    """
    if isinstance(slam, AbstractSlam):
        pieces = {
            x: getattr(slam, x) for x in ("motion", "sensor", "landmark", "calibration", "depth")
        }
        if slam == Slam(**pieces):
            return Nodes(slam, Keyframe(0.5, parallax / 100))
    raise ValueError("nodes take the place of all pieces but these: robocentric+nodes is accepted")


def _again(node: MapNode, features: Features) -> Bool[Array, " slots"]:
    """The node's landmarks that are seen."""
    places = features.places(node.held.size)
    return jnp.zeros_like(node.held).at[places].set(True, mode="drop") & node.held


def _seen(T_NC: Pose, landmark: Float[Array, " d"]) -> Homogeneous:
    point, omega = _PLANE.homogeneous(landmark)
    return homogeneous_apply(T_NC.inverse(), point, omega), omega


def _composed(first: Similarity, second: Similarity) -> Similarity:
    (T, a), (V, b) = first, second
    return T @ scaled(V, jnp.exp(a[0])), a + b


def _moments(
    function: Callable[..., PyTree], state: NodeGraph, slot: Int[Array, ""] | int
) -> Moments:
    """Of a function of T_BC, log of the node's unit in metres, T_NC, and the landmark in a slot."""
    node, t, d = state.node, state.velocity.size, state.node.landmarks.shape[1]

    def value(parts):
        chain, edge, camera, landmark = parts
        pose, log_scale = _composed(_composed(chain, edge), (camera, 0 * edge[1]))
        return function(pose, log_scale, camera, landmark)

    index = jnp.append(jnp.arange(t), t + slot * d + jnp.arange(d))
    parts = state.chain, state.edge, node.camera, node.landmarks[slot]
    own, J = node.covariance[index[:, None], index], jacobian(value, parts)
    P = block_diag(state.chain_covariance, state.edge_covariance, own)
    return value(parts), symmetric_part(J @ P @ J.T)


def _only(matrix: Float[Array, "n n"], rows: Bool[Array, " n"]) -> Float[Array, "n n"]:
    return jnp.where(rows[:, None] & rows, matrix, 0.0)
