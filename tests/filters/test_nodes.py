"""Tests of a map of nodes: its information, its edges, and what it is not made of."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import close, each_geometry, named, quick_jit, quick_rows

from jaxslam.filters.readouts import camera_pose, landmarks_in_camera
from jaxslam.filters.rivals.nodes import Nodes
from jaxslam.filters.slam import Slam
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import PLANAR, difference, homogeneous_apply, identity, jacobian, log, retract
from jaxslam.landmarks import Cartesian, ImagePlane
from jaxslam.models.calibration import White
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Features, PriorMap
from jaxslam.models.sensors import Pinhole
from jaxslam.simulation import scenario

DT, COUNT, FOCAL, SIGMA = 0.1, 6, 400.0, 0.5
INVERSE_DEPTH, DEPTH_SIGMA = 0.25, 0.05
BORN = np.array([0, 0, 0, 0, 0, 2])
"""The frame in which each landmark is new."""
VELOCITIES = {"planar": [0.6, 0.1, 0.05], "spatial": [0.6, 0.1, 0.2, 0.02, 0.05, 0.03]}


def the_filter(geometry, sigma=SIGMA, **pieces):
    p, t = geometry.pixel_dim, geometry.tangent_dim
    velocity = np.array(VELOCITIES[geometry.name])
    motion = ConstantVelocity(np.full(t, 0.2), velocity, np.linspace(0.01, 0.02, t))
    sensor = Pinhole(Camera(np.full(p, FOCAL), np.full(p, 300.0)), sigma)
    depth = InverseDepth(INVERSE_DEPTH, DEPTH_SIGMA)
    slam = Slam(motion=motion, sensor=sensor, landmark=ImagePlane(), depth=depth, **pieces)
    return Nodes(slam)


@cache
def path(geometry, steps):
    """T_BC of a camera with its mean velocity."""

    @quick_jit
    def poses():
        velocity, still = jnp.array(VELOCITIES[geometry.name]), jnp.zeros(geometry.tangent_dim)
        step = the_filter(geometry).slam.motion.displacement(velocity, still, DT)
        first = identity(geometry, jnp.float64)
        later = jax.lax.scan(lambda T, _: (T @ step,) * 2, first, length=steps)[1]
        return jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), first, later)

    every = jax.device_get(poses())
    return [jax.tree.map(lambda x, k=k: x[k], every) for k in range(steps + 1)]


def world(geometry, steps, depths):
    """Points in B, of these depths in the camera that sees them first."""
    rng = np.random.default_rng(1)
    poses = path(geometry, steps)
    rays = np.column_stack(
        [rng.uniform(-0.3, 0.3, (len(depths), geometry.pixel_dim)), depths * 0 + 1]
    )
    born = np.resize(BORN, len(depths))
    each = list(zip(born, depths, rays, strict=True))
    return quick_jit(lambda: jnp.stack([poses[k] @ jnp.asarray(z * ray) for k, z, ray in each]))()


def frames_of(slam, geometry, steps, depths):
    """Noise-free features of every frame: of landmarks in the map, and of new ones."""
    points, slots = world(geometry, steps, depths), np.arange(len(depths))
    born, seen, new = np.resize(BORN, len(depths)), [], []

    @quick_jit
    def seen_from(pose):
        inside = jax.vmap(pose.inverse().apply)(points)
        return jax.vmap(slam.slam.sensor.measure, in_axes=(0, None))(inside, 1.0)

    for k, pose in enumerate(path(geometry, steps)):
        pixels = np.asarray(seen_from(pose))
        seen.append(Features(slots, pixels, born < k))
        new.append(Features(slots, pixels, born == k))
    return [jax.tree.map(lambda *x: jnp.stack(x), *part) for part in (seen, new)]


def run(slam, seen, new):
    """The states of all frames after frame 0, and their innovations."""
    first = jax.tree.map(lambda x: x[0], new)

    def step(state, frame):
        state, innovation = slam.step(state, jnp.array(DT), *frame)
        return state, (state, innovation, camera_pose(slam, state))

    later = jax.tree.map(lambda x: x[1:], (seen, new))
    return jax.lax.scan(step, slam.init(first.slots.size, first), later)[1]


LEVEL = np.full(COUNT, 1 / INVERSE_DEPTH)
"""Depths that are those of the prior: linearisation is at the truth."""


@cache
def level_run(geometry):
    slam = the_filter(geometry)
    return quick_jit(partial(run, slam))(*frames_of(slam, geometry, 4, LEVEL))


def last(tree):
    return jax.tree.map(lambda x: x[-1], tree)


def batch(slam, geometry):
    """The information of all cameras but the first, and of all landmarks, by their definitions."""
    poses, points = path(geometry, 4), world(geometry, 4, LEVEL)
    plane, t, sigma = ImagePlane(), geometry.tangent_dim, slam.slam.motion
    one = jnp.ones(())
    landmarks = quick_jit(jax.vmap(lambda x: plane.initialise(x, one, one)))(points)
    told = jnp.asarray(sigma.velocity), jnp.zeros(t)
    J = quick_jit(partial(jacobian, lambda told: sigma.displacement(*told, DT)))(told)
    J = J @ jnp.diag(jnp.concatenate([sigma.velocity_sigma, sigma.noise_sigma]))
    root = jnp.asarray(np.linalg.inv(np.linalg.cholesky(J @ J.T)))

    def whitened(delta):
        moves, values = delta[: 4 * t].reshape(4, t), landmarks + delta[4 * t :].reshape(COUNT, -1)
        cameras = [poses[0], *(retract(T, move) for T, move in zip(poses[1:], moves, strict=True))]
        rows = [root @ difference(cameras[1], poses[1])]
        for k, T in enumerate(cameras):
            for slot in np.flatnonzero(k >= BORN):
                point, omega = plane.homogeneous(values[slot])
                point = homogeneous_apply(T.inverse(), point, omega)
                rows.append(slam.slam.sensor.measure(point, omega) / SIGMA)
                if BORN[slot] == k:
                    rows.append((omega / point[-1:]) / DEPTH_SIGMA)
        return jnp.concatenate(rows)

    J = quick_jit(jax.jacfwd(whitened))(jnp.zeros(4 * t + landmarks.size))
    return np.asarray(J.T @ J), landmarks


@pytest.mark.parametrize("geometry", quick_rows(1, each_geometry), ids=named)
def test_the_information_of_a_node_is_that_of_all_its_frames_without_their_cameras(geometry):
    """Of the last camera too, which leaves the map with the next frame."""
    slam, cameras, t = the_filter(geometry), 4 * geometry.tangent_dim, geometry.tangent_dim
    whole, landmarks = batch(slam, geometry)
    across = whole[cameras:, :cameras]
    wanted = whole[cameras:, cameras:] - across @ np.linalg.solve(
        whole[:cameras, :cameras], across.T
    )
    states, innovation, (_, covariances) = level_run(geometry)
    assert np.sum(innovation.used, axis=1).tolist() == [5, 5, 6, 6]
    assert np.all(np.abs(innovation.nis) < 1e-9)  # a frame as the map has it is no news
    state = last(states)
    close(state.node.landmarks, landmarks, 1e-7)
    scale = np.sqrt(np.diagonal(wanted))
    np.testing.assert_allclose(
        state.node.information / np.outer(scale, scale), wanted / np.outer(scale, scale), atol=1e-5
    )
    P = np.linalg.inv(whole)[cameras - t :, cameras - t :]
    np.testing.assert_allclose(covariances[-1], P[:t, :t], rtol=1e-4, atol=1e-10)


DEPTHS = np.linspace(3.6, 4.4, 8)


@cache
def long_run(geometry):
    slam = the_filter(geometry, 0.02)
    return slam, quick_jit(partial(run, slam))(*frames_of(slam, geometry, 40, DEPTHS))


@pytest.mark.parametrize("geometry", quick_rows(1, each_geometry), ids=named)
def test_a_chain_of_nodes_follows_a_run_without_noise(geometry):
    """And its landmarks are seen in metres from a later node."""
    slam, (states, _, (poses, covariances)) = long_run(geometry)
    earlier = np.any(np.asarray(states.earlier.held), axis=1).tolist()
    began = np.flatnonzero(np.asarray(jax.vmap(log)(states.node.camera) == 0).all(axis=1))
    assert len(began) >= 1
    assert earlier == [k >= began[0] for k in range(40)]
    truth = jax.tree.map(lambda *x: jnp.stack(x), *path(geometry, 40)[1:])
    apart = np.abs(jax.vmap(difference)(poses, truth))
    way = float(np.linalg.norm(truth.translation()[-1]))
    assert way > 2
    assert apart.max() < 5e-3 * way
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    assert (apart < 3 * sigma + 1e-6).all()
    # The metre is known no better in a later node than in the first.
    assert (np.diff(sigma[:, 0]) > -0.2 * sigma[1:, 0]).all()

    slots = jnp.arange(len(DEPTHS))
    told = quick_jit(lambda x: landmarks_in_camera(slam, x, slots, slam.slam.sensor))
    chart, covariance = told(last(states))
    inside = jax.vmap(path(geometry, 40)[-1].inverse().apply)(world(geometry, 40, DEPTHS))
    wanted = np.column_stack([inside[:, :-1], np.ones(len(inside))]) / inside[:, -1:]
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert slam.in_map(last(states)).all()
    assert (np.abs(chart - wanted) < 3 * sigma + 1e-6).all()
    assert (sigma[:, -1] < 0.2 * wanted[:, -1]).all()
    (chain, log_scale), state = last(states).chain, last(states)
    larger, _ = told(replace(state, chain=(chain, log_scale + 0.5)))
    np.testing.assert_allclose(larger, chart * np.exp([*[0.0] * (chart.shape[1] - 1), -0.5]))

    # An edge stays when a landmark leaves that it was found from.
    after = quick_jit(lambda *x: slam.remove(*x))(last(states), slots == 3)
    assert not after.earlier.held.any()
    np.testing.assert_array_equal(after.edge_covariance, last(states).edge_covariance)


def test_a_landmark_is_marginalised_and_its_slot_is_free():
    slam, state, d = the_filter(PLANAR), last(level_run(PLANAR)[0]), 2
    gone = np.arange(COUNT) == 1
    after = quick_jit(lambda *x: slam.remove(*x))(state, jnp.asarray(gone))
    assert slam.in_map(after).tolist() == (~gone).tolist()
    rows = np.repeat(gone, d)
    whole = np.asarray(state.node.information)
    across = whole[np.ix_(~rows, rows)]
    wanted = whole[np.ix_(~rows, ~rows)] - across @ np.linalg.solve(
        whole[np.ix_(rows, rows)], across.T
    )
    close(np.asarray(after.node.information)[np.ix_(~rows, ~rows)], wanted, 1e-6)
    assert not np.asarray(after.node.information)[rows].any()
    pose = quick_jit(partial(camera_pose, slam))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-12), pose(after), pose(state))


def test_a_calibration_that_is_drawn_in_every_frame_is_no_information():
    """A camera that may be off tells less of landmarks in every direction."""
    off = the_filter(PLANAR, calibration=White([3.0, 2.0]))
    states, *_ = quick_jit(partial(run, off))(*frames_of(off, PLANAR, 4, LEVEL))
    more, less = last(level_run(PLANAR)[0]).node, last(states).node
    lost = np.linalg.eigvalsh(more.information - less.information)
    assert lost[0] > -1e-6 * lost[-1]
    assert lost[-1] > 0.1 * np.linalg.eigvalsh(more.information)[-1]


NODES = "robocentric+nodes"


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("world+nodes", {}, "robocentric.nodes is accepted"),
        ("robocentric+oc+nodes", {}, "robocentric.nodes is accepted"),
        ("robocentric+mixture+nodes", {}, "robocentric.nodes is accepted"),
        (NODES, {"sensor": "position"}, "a camera, not of Position"),
        (NODES, {"motion": "odometry", "odometry_sigma": [0.1] * 3}, "whose velocity is constant"),
        (NODES, {"calibration": "consider"}, "drawn in every frame"),
        ("robocentric+scene+nodes", {}, "on depth that have nothing in common"),
    ],
)
def test_what_has_no_nodes_is_refused(name, changes, message):
    with pytest.raises(ValueError, match=message):
        make_filter(name, landmark="image_plane", **scenario_pieces(scenario("matched", changes)))


def test_nodes_are_of_image_planes_and_take_no_prior_map_and_a_step_at_least():
    slam = the_filter(PLANAR)
    known = PriorMap(jnp.arange(1), jnp.ones((1, 2)), jnp.eye(2))
    rolling = replace(slam.slam, sensor=replace(slam.slam.sensor, line=1e-4))
    for call, message in (
        (lambda: slam.init(1, known=known), "takes no prior map"),
        (lambda: replace(slam, steps=0), "at least, not 0"),
        (lambda: replace(slam, slam=rolling), "nodes are of a global shutter"),
        (lambda: replace(slam, slam=replace(slam.slam, landmark=Cartesian())), "not cartesian"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
