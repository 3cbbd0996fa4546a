"""Tests of the keyframe's frame, and of the information form against the covariance form."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import close, each_geometry, named, quick_jit

from jaxslam.filters.ekf import context_of, reanchored
from jaxslam.filters.forms import information
from jaxslam.filters.forms.covariance import Covariance
from jaxslam.filters.forms.information import EXACT_SIGMA, Information, InformationState
from jaxslam.filters.forms.state import State
from jaxslam.filters.readouts import camera_pose, landmarks_in_camera, landmarks_in_world
from jaxslam.filters.registry import FILTERS
from jaxslam.geometry import PLANAR, SPATIAL, difference, exp, identity, joined, tangent_dim
from jaxslam.landmarks import IMAGE_PLANE, INVERSE_SCALING
from jaxslam.models.calibration import TREATMENTS
from jaxslam.models.camera import Camera
from jaxslam.models.coordinates import KEYFRAME_PARALLAX, KEYFRAME_TURN, keyframe_due
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Features
from jaxslam.models.sensors import Pinhole

CAPACITY, STEPS, DT = 5, 10, 0.1
# Landmark of each slot: the frame in which it is new, and that after which it is removed.
LIVES = ((0, None), (0, None), (3, None), (0, 5), (6, None))


class AsExact(Covariance):
    """The covariance form, knowing nothing better than the information form can say."""

    def augment(self, state, start, covariance):
        return super().augment(state, start, information.representable(covariance))

    def set_exact(self, state, start, size):
        return self.augment(state, start, jnp.zeros((size, size)))


def axes(geometry, planar, spatial):
    return jnp.array(planar if geometry is PLANAR else spatial)


def velocity(geometry):
    """Sideways, turning: 0.014 rad a step, so that the fourth and the eighth make keyframes."""
    return axes(geometry, [0.3, 0.1, 0.14], [0.3, 0.0, 0.1, 0.0, -0.14, 0.02])


def make(kind, geometry, calibration="white", scale=1.0, landmark=IMAGE_PLANE):
    """A filter, every σ of which is times a scale."""
    p, t = geometry.pixel_dim, geometry.tangent_dim
    return FILTERS[kind](
        motion=ConstantVelocity(
            scale * np.full(t, 0.3), velocity(geometry), scale * np.full(t, 0.02)
        ),
        sensor=Pinhole(Camera(np.full(p, 400.0), np.full(p, 300.0)), scale * 1.0),
        landmark=landmark,
        calibration=TREATMENTS[calibration](scale * np.full(2 * p, 2.0)),
        depth=InverseDepth(0.25, scale * 0.05),
    )


@cache
def world(geometry, scale=1.0):
    """New and known features, and removed landmarks, of every frame; all errors times a scale."""
    rng = np.random.default_rng(3)
    slam, p = make("keyframe", geometry, scale=scale), geometry.pixel_dim
    still, poses = jnp.zeros(geometry.tangent_dim), [identity(geometry, jnp.float64)]
    started = velocity(geometry) + scale * 0.02 * rng.normal(size=geometry.tangent_dim)
    step = slam.motion.displacement(started, still, DT)
    for _ in range(STEPS):
        poses.append(poses[-1] @ step)
    # The depths that the prior speaks of are those in the camera that sees a landmark first.
    depths = 1 / (0.25 + scale * 0.05 * rng.normal(size=CAPACITY))
    bearings = np.column_stack([rng.uniform(-0.3, 0.3, (CAPACITY, p)), np.ones(CAPACITY)])
    seen_first = zip(LIVES, depths, bearings, strict=True)
    points = jnp.stack([poses[born] @ (depth * ray) for (born, _), depth, ray in seen_first])

    new, seen, gone = [], [], []
    for k, pose in enumerate(poses):
        inside = jax.vmap(pose.inverse().apply)(points)
        pixels = jax.vmap(slam.sensor.measure, in_axes=(0, None))(inside, 1.0)
        pixels += scale * rng.normal(size=pixels.shape)
        slots = jnp.arange(CAPACITY)
        unseen = k % 3 == np.arange(CAPACITY) % 3  # every landmark is missed now and then
        known = np.array([born < k and (end is None or k <= end) for born, end in LIVES])
        new.append(Features(slots, pixels, jnp.array([born == k for born, _ in LIVES])))
        seen.append(Features(slots, pixels, jnp.asarray(known & np.logical_not(unseen))))
        gone.append(jnp.array([end == k for _, end in LIVES]))
    return tuple(jax.tree.map(lambda *x: jnp.stack(x), *part) for part in (new, seen, gone))


def run(slam, pose_sigma, new, seen, gone):
    """States, covariances, NIS and camera poses of every step, from an uncertain pose."""
    state = slam.init(CAPACITY)
    size = tangent_dim(state.core.pose)
    state = slam.form.augment(state, 0, pose_sigma**2 * jnp.eye(size))
    if slam.calibration.each_frame:
        drawn = jnp.diag(slam.calibration.sigma**2)
        state = slam.form.augment(state, state.core.part("calibration").start, drawn)
    state = slam.close(state, jax.tree.map(lambda x: x[0], new))

    def step(state, frame):
        new, seen, gone = frame
        state, innovation = slam.step(state, jnp.array(DT), seen, new)
        state = slam.remove(state, gone)
        return state, (state, state.covariance, innovation.nis, camera_pose(slam, state))

    later = jax.tree.map(lambda x: x[1:], (new, seen, gone))
    return jax.lax.scan(step, state, later)[1]


@cache
def compiled(kind, geometry, form=None, calibration="white", scale=1.0):
    slam = make(kind, geometry, calibration, scale)
    slam = slam if form is None else replace(slam, form=form)
    return quick_jit(partial(run, slam))


@cache
def followed(kind, geometry, form=None):
    """A run, exact quantities being known to 0.1 mm: a well-conditioned Λ."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(information, "EXACT_SIGMA", 1e-4)
        return compiled(kind, geometry, form)(jnp.array(1e-2), *world(geometry))


def sigmas(P):
    """σ of every number, 1 where it is not in the state."""
    variances = np.diagonal(P)
    return np.sqrt(np.where(variances > 0, variances, 1.0))


def agree(P, Q, relative):
    """Covariances within `relative` of the product of the σ: a bound for every entry alike."""
    sigma = sigmas(P)
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(Q / scale, P / scale, rtol=0, atol=relative)


@pytest.mark.slow
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_run_in_information_form_is_the_run_in_covariance_form(geometry):
    states, covariances, nis, poses = followed("keyframe", geometry, AsExact())
    others = followed("information", geometry)
    for k in range(STEPS):
        state, other = (jax.tree.map(lambda x, k=k: x[k], x) for x in (states, others[0]))
        shift = difference(
            (state.core, state.landmarks.ravel()), (other.core, other.landmarks.ravel())
        )
        assert np.abs(shift / sigmas(covariances[k])).max() < 1e-9
        agree(covariances[k], others[1][k], 1e-9)
        agree(poses[1][k], others[3][1][k], 1e-9)
    np.testing.assert_allclose(others[2], nis, rtol=1e-9)
    np.testing.assert_array_equal(others[0].active, states.active)


in_the_plane_quickly = pytest.mark.parametrize(
    "geometry", [PLANAR, pytest.param(SPATIAL, marks=pytest.mark.slow)], ids=named
)
"""Where the run is the subject: in space it takes as long again, by the same functions."""


@in_the_plane_quickly
def test_the_run_has_keyframes_new_landmarks_and_removed_ones(geometry):
    states = followed("information", geometry)[0]
    keyframes = np.asarray(states.core.pose.base_from_keyframe.translation())
    assert np.sum(np.abs(np.diff(keyframes[:, 0])) > 0.05) == 2
    assert np.asarray(states.active).sum(axis=1).tolist() == [3, 3, 4, 4, 3, 4, 4, 4, 4, 4]


@in_the_plane_quickly
def test_what_is_not_in_the_state_has_no_information_at_all(geometry):
    states = followed("information", geometry)[0]
    last = jax.tree.map(lambda x: x[-1], states)
    t, c = geometry.tangent_dim, last.core_dim
    absent = np.zeros(len(last.information), bool)
    absent[3 * t : c] = True  # noise and white calibration
    absent[c:] = np.repeat(~np.asarray(last.active), geometry.point_dim)
    assert not np.any(np.asarray(last.information)[absent])
    assert not np.any(np.asarray(last.information)[:, absent])
    assert np.all(np.diagonal(last.information)[~absent] > 0)


# --- one update ---------------------------------------------------------------------------------


def correlated(geometry, calibration="white"):
    """A keyframe filter's state in both forms, all of it correlated; slots 1 and 4 are empty."""
    slam = make("keyframe", geometry, calibration)
    state = slam.init(CAPACITY)
    rng = np.random.default_rng(1)
    active = np.array([True, False, True, True, False])
    d, c = geometry.point_dim, state.core_dim
    present = np.concatenate([np.ones(c, bool), np.repeat(active, d)])
    root = 0.01 * rng.normal(size=(present.sum(), 2 * present.sum()))
    P, L = np.zeros((2, len(present), len(present)))
    P[np.ix_(present, present)] = root @ root.T
    L[np.ix_(present, present)] = np.linalg.inv(root @ root.T)
    T_KC = exp(geometry.group, jnp.asarray(rng.uniform(-0.2, 0.2, geometry.tangent_dim)))
    held = replace(state.core.pose, keyframe_from_camera=T_KC)
    landmarks = np.column_stack([rng.uniform(-0.3, 0.3, (CAPACITY, d - 1)), np.full(CAPACITY, 0.3)])
    landmarks = jnp.asarray(landmarks)
    mean = replace(state.core, pose=held), landmarks, jnp.asarray(active)
    P, L = jnp.asarray(P), jnp.asarray(L)
    return slam, State(*mean, P), InformationState(*mean, L)


def sighting(geometry):
    """Slot 2, the middle landmark, is seen; 0 is not, nor is the empty slot 1."""
    pixels = jnp.full((3, geometry.pixel_dim), 310.0).at[1].set(jnp.nan)
    return Features(jnp.array([2, 0, 1]), pixels, jnp.array([True, False, True]))


@cache
def updated(geometry):
    slam, *states = correlated(geometry)

    def update(form, state):
        made = replace(slam, form=form)
        dt, seen = jnp.array(DT), sighting(geometry)
        after, innovation = made.update(state, dt, seen)
        search = made.predict_features(state, dt, jnp.array([3, 0]))
        return after, after.covariance, innovation, search[:3]

    return [
        (state, *quick_jit(partial(update, form))(state))
        for form, state in zip((Covariance(), Information()), states, strict=True)
    ]


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_an_update_in_information_form_is_that_in_covariance_form(geometry):
    (before, after, P, innovation, search), other = updated(geometry)
    assert np.abs(P - before.covariance).max() > 1e-5
    agree(P, other[2], 1e-9)
    a, b = after, other[1]
    shift = difference((a.core, a.landmarks.ravel()), (b.core, b.landmarks.ravel()))
    assert np.abs(shift / sigmas(P)).max() < 1e-9
    assert innovation.used.tolist() == other[3].used.tolist() == [True, False, False]
    np.testing.assert_allclose(other[3].nis, innovation.nis, rtol=1e-9)
    for a, b in zip(search, other[4], strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_an_update_touches_no_block_between_two_landmarks(geometry):
    before, after = updated(geometry)[1][:2]
    c, d = before.core_dim, geometry.point_dim
    touched = np.zeros((CAPACITY, CAPACITY), bool)
    touched[2, 2] = True
    old, new = (
        np.asarray(x.information)[c:, c:].reshape(CAPACITY, d, CAPACITY, d).swapaxes(1, 2)
        for x in (before, after)
    )
    np.testing.assert_array_equal(new[~touched], old[~touched])
    assert np.all(old[0, 2] != 0)
    assert np.all(new[touched] != old[touched])
    cross = [np.asarray(x.information)[:c, c:].reshape(c, CAPACITY, d) for x in (before, after)]
    np.testing.assert_array_equal(np.delete(cross[1], 2, axis=1), np.delete(cross[0], 2, axis=1))
    assert np.any(cross[1][:, 2] != cross[0][:, 2])


def test_landmarks_are_coupled_by_marginalising_the_pose_and_not_before():
    slam = make("information", PLANAR, "known")
    new, seen, _ = world(PLANAR)

    @quick_jit
    def coupling(new, seen):
        first = slam.init(CAPACITY, new)
        seen, dt = replace(seen, valid=first.active), jnp.array(DT)
        again, _ = slam.update(first, dt, seen)
        moved, _ = slam.update(slam.predict(first, dt), dt, seen)
        c = first.core_dim
        states = (again, reanchored(slam, moved))
        return [state.information[c : c + 2, c + 2 : c + 4] for state in states]

    before, after = coupling(*(jax.tree.map(lambda x: x[0], f) for f in (new, seen)))
    np.testing.assert_array_equal(before, np.zeros((2, 2)))
    assert np.all(np.abs(after) > 1e-9)


# --- keyframes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_reanchoring_changes_neither_the_camera_nor_the_points(geometry):
    slam, state, _ = correlated(geometry, "known")
    slots = jnp.array([0, 2, 3])

    def told(state):
        points = landmarks_in_world(slam, state, slots)
        return (
            camera_pose(slam, state),
            points,
            landmarks_in_camera(slam, state, slots, slam.sensor),
        )

    after = quick_jit(partial(reanchored, slam))(state)
    told = quick_jit(told)
    for a, b in zip(jax.tree.leaves(told(after)), jax.tree.leaves(told(state)), strict=True):
        close(a, b, 1e-12)
    t = geometry.tangent_dim
    np.testing.assert_array_equal(after.covariance[t : 2 * t], np.zeros_like(after.covariance[:t]))
    held = after.core.pose.keyframe_from_camera
    np.testing.assert_array_equal(held.as_matrix(), np.eye(geometry.point_dim + 1))
    assert np.abs(after.landmarks - state.landmarks)[slots].min(axis=1).max() > 0.01


def test_keyframe_and_world_filter_differ_to_second_order():
    apart = []
    for scale in (0.1, 0.01):
        data = (jnp.array(0.0), *world(PLANAR, scale))
        runs = [
            compiled(kind, PLANAR, None, "known", scale)(*data) for kind in ("keyframe", "world")
        ]
        (ours, P), (theirs, _) = (run[3] for run in runs)
        shift = jax.vmap(difference)(ours, theirs)
        apart.append(np.abs(shift / np.sqrt(np.diagonal(P, axis1=1, axis2=2)))[-1].max())
    # Errors of second order, by a σ that is of first.
    assert 0 < apart[1] < apart[0] / 5
    assert apart[1] < 1e-2


def test_a_keyframe_is_due_after_a_turn_or_a_baseline():
    near, far = jnp.array([0.5, 0.0, 0.5]), jnp.array([0.01, 0.0, 0.0])
    moved, turned = jnp.array([0.3, 0.4, 0.0]), jnp.array([0.0, 0.0, 1.1 * KEYFRAME_TURN])
    pose = PLANAR.group.exp
    assert KEYFRAME_PARALLAX < 0.5 * 0.5
    assert keyframe_due(pose(moved), near)
    assert not keyframe_due(pose(moved), far)
    assert not keyframe_due(pose(moved), jnp.zeros(3))
    assert keyframe_due(pose(turned), far)
    assert not keyframe_due(pose(0.8 * turned), near)


@pytest.mark.parametrize("landmark", [INVERSE_SCALING, IMAGE_PLANE], ids=named)
def test_a_parallax_is_the_way_from_the_keyframe_by_the_distance_of_the_map(landmark):
    """Whatever length a parametrization gives to a ray, and of landmarks in the map alone."""
    slam = make("keyframe", PLANAR, "known", landmark=landmark)
    distance = 5.0
    ray = jnp.array([0.75, 1.0])
    seen = landmark.initialise(ray, jnp.asarray(1.25 / distance), jnp.asarray(650.0))

    def due(way, inverse_depth):
        state = slam.init(3)
        empty = landmark.initialise(ray, jnp.asarray(inverse_depth), jnp.asarray(650.0))
        there = joined(state.core.pose.keyframe_from_camera.rotation(), jnp.array([0.0, way]))
        pose = replace(state.core.pose, keyframe_from_camera=there)
        state = replace(
            state,
            core=replace(state.core, pose=pose),
            landmarks=jnp.stack([seen, seen, empty]),
            active=jnp.array([True, True, False]),
        )
        return bool(slam.model.reanchoring_due(state))

    least = KEYFRAME_PARALLAX * distance
    assert not due(0.99 * least, 100.0)
    assert due(1.01 * least, 100.0)


# --- what the information form cannot do ----------------------------------------------------------


def test_an_exact_start_is_known_to_the_least_sigma():
    slam = make("information", PLANAR)
    covariance = quick_jit(lambda: camera_pose(slam, slam.init(1)))()[1]
    np.testing.assert_allclose(covariance, 2 * EXACT_SIGMA**2 * np.eye(3), rtol=1e-12, atol=1e-24)


def test_redundant_landmarks_and_considered_calibration_are_refused():
    with pytest.raises(ValueError, match=r"image_plane.*not inverse_scaling"):
        make("information", PLANAR, "known", landmark=INVERSE_SCALING)
    with pytest.raises(ValueError, match="consider"):
        make("information", PLANAR, "consider")
    slam, _, state = correlated(PLANAR, "consider")
    with pytest.raises(ValueError, match="consider"):
        replace(slam, form=Information())
    seen, context = sighting(PLANAR), context_of(slam, jnp.array(DT))
    with pytest.raises(ValueError, match="consider"):
        Information().update(
            slam.model, state, seen, slam.sensor.noise, context, state.core.part("calibration")
        )
