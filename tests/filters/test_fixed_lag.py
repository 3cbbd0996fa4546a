"""The scale gauge, the fixed lag and the iterated filter."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, central, close, pose_run, quick_jit

from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.forms.sensitivity import begin
from jaxslam.filters.readouts import camera_pose, landmarks_in_camera
from jaxslam.filters.registry import make_filter
from jaxslam.filters.wrappers.fixed_lag import FixedLag, _appended, _estimate
from jaxslam.geometry import difference
from jaxslam.models.sensors import Position

SHORT = {"steps": 6, "landmarks": 4}


@cache
def case(name="matched-loose", **fields):
    return Case(name, **{**SHORT, **fields})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robocentric", "scale_gauge", "world"])
def test_where_nothing_is_uncertain_all_are_one_filter(name):
    """With tiny noise every filter is linear: the lag and the gauge change nothing."""
    of = case(
        "matched",
        acceleration_sigma=(1e-5,) * 3,
        velocity_sigma=(1e-5,) * 3,
        pixel_sigma=1e-3,
        inverse_depth=(1 / 6, 1e-6),
    )
    _, (plain, plain_P, plain_nis, _) = pose_run(of, of.filter("robocentric"))
    _, (lagged, lagged_P, lagged_nis, _) = pose_run(of, of.filter(f"{name}+lag3"))
    sigma = np.sqrt(np.diagonal(plain_P, axis1=1, axis2=2))
    away = jax.vmap(lambda a, b: (a.inverse() @ b).log())(plain, lagged)
    assert np.abs(away / sigma).max() < 2e-3
    np.testing.assert_allclose(np.sqrt(np.diagonal(lagged_P, axis1=1, axis2=2)), sigma, rtol=2e-3)
    np.testing.assert_allclose(lagged_nis, plain_nis, rtol=5e-3)


@pytest.mark.slow
def test_one_frame_of_lag_is_the_filter_itself_at_the_first_step():
    """Nothing has been absorbed, and one Gauss–Newton step from the prediction is the EKF's."""
    of = case()
    _, (plain, plain_P, plain_nis, plain_residual) = pose_run(of, of.filter("robocentric"), count=1)
    _, (lagged, lagged_P, lagged_nis, residual) = pose_run(
        of, of.filter("robocentric+lag1"), count=1
    )
    # The update is the same; the composition is linearised before it or after it.
    np.testing.assert_allclose(lagged_nis, plain_nis, rtol=1e-6)
    np.testing.assert_allclose(residual, plain_residual, atol=1e-6)
    np.testing.assert_allclose(lagged.translation(), plain.translation(), atol=1e-4)
    close(lagged_P, plain_P, 0.03)


@pytest.mark.slow
@pytest.mark.parametrize("landmarks", ["inverse_scaling", "inverse_depth"])
@pytest.mark.parametrize(
    ("name", "scenario_name"),
    [("robocentric", "circle"), ("world", "matched-loose")],
)
def test_the_sensitivities_are_the_derivatives(name, scenario_name, landmarks):
    """S and A against central differences, with landmarks that enter and a white calibration."""
    of = case(scenario_name, landmarks=12 if scenario_name == "circle" else 4)
    slam = FixedLag(of.filter(name, landmarks), 3)
    state, _ = pose_run(of, slam)

    def replayed(y):
        return slam._through(state.before, y, state.frames)

    y = np.array(state.variables)
    origin, compared = quick_jit(replayed)(y)

    @quick_jit
    def values(y):
        point, compared = replayed(y)
        moved = difference(point.core, origin.core)
        landmarks = (point.landmarks - origin.landmarks).ravel()
        return jnp.concatenate([moved, landmarks, -compared.residual.ravel()])

    sensitivity = origin.sensitivity(state.before)
    S, A = np.split(central(values, y, 1e-4), [len(sensitivity)])
    close(sensitivity, S, 2e-5)
    slope = jax.tree.map(lambda x: jnp.concatenate(list(x)), compared.slope)
    close(slope.by_variables(state.before), A, 2e-5)


@pytest.mark.slow
def test_the_estimate_of_a_window_that_holds_everything_is_the_maximum_of_the_posterior():
    """Step by step, with no frame absorbed: the gradient of ½|y|² + ½ Σ|r|² becomes zero."""
    of = case()
    slam = of.filter("robocentric+lag6")
    state, _ = pose_run(of, slam)
    *before, last = stepped(slam, state, 4)
    first = before[0]
    assert np.abs(last.gradient).max() < 1e-6 * np.abs(last.information.root).max()
    assert np.abs(last.gradient).max() < 1e-3 * np.abs(first.gradient).max()


def stepped(slam, state, count):
    """The window after each of so many more steps of Gauss–Newton."""
    normal_equations = quick_jit(lambda y: slam._normal_equations(state.before, y, state.frames))
    y, windows = state.variables, []
    for _ in range(count):
        windows.append(normal_equations(y))
        y = y + windows[-1].step()
    return windows


@pytest.mark.slow
def test_an_iterated_filter_uses_a_measurement_once():
    """Position sensor, nothing moves: a scalar prior of 1 and a noise of 1 end at P = 1/2.

    An iteration that took its own posterior for a prior would end at 1/3.
    """
    of = case("matched", steps=1, landmarks=1)
    base = of.filter("robocentric+iterated")
    state, _ = pose_run(of, base)
    robocentric = of.filter("robocentric")
    plain, _ = pose_run(of, robocentric)
    # The depth is hardly seen after one frame; the pixel is seen twice, σ² → σ²/2.
    slot = jnp.array([0])
    _, iterated_P = landmarks_in_camera(base, state, slot, robocentric.sensor)
    _, plain_P = landmarks_in_camera(robocentric, plain, slot, robocentric.sensor)
    np.testing.assert_allclose(iterated_P, plain_P, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("coordinates", ["robocentric", "scale_gauge"])
def test_the_iterated_filter_in_stages_is_the_window_of_one_frame(coordinates):
    """After the first frame, of which both have the same prior: three steps of Gauss–Newton."""
    of = case("matched-loose", steps=1)
    ways = "+iterated3", "+lag1", ""
    staged, window, plain = (of.filter(f"{coordinates}{way}") for way in ways)
    assert isinstance(staged, EkfSlam)
    found, once = (pose_run(of, slam)[1] for slam in (staged, plain))
    *_, last = stepped(window, pose_run(of, window)[0], 2)
    expected, P = camera_pose(plain, _estimate(last))
    away = (expected.inverse() @ pose(found)).log() / np.sqrt(np.diagonal(P))
    np.testing.assert_allclose(away, 0, atol=1e-6)
    close(found[1][0], P, 1e-6)
    assert np.abs((expected.inverse() @ pose(once)).log()).max() > 1e-6
    assert np.abs(P / once[1][0] - 1).max() > 1e-4


def pose(told):
    """The first pose of what `pose_run` tells."""
    return jax.tree.map(lambda x: x[0], told[0])


def test_an_update_has_one_step_at_least():
    with pytest.raises(ValueError, match="an update takes a number of steps of at least 1, not 0"):
        case().filter("world+iterated0")


@pytest.mark.slow
def test_absorbing_the_oldest_frame_keeps_its_point_and_all_that_is_known_of_the_newest():
    """Marginalisation is exact at one point of linearisation: a frame in which nothing happens
    after that leaves the newest mean and covariance as they were."""
    of = case()
    slam = of.filter("scale_gauge+lag3")
    state, _ = pose_run(of, slam)
    oldest, nothing = (
        jax.tree.map(f, state.frames) for f in (lambda x: x[0], lambda x: jnp.zeros_like(x[0]))
    )

    @quick_jit
    def both(state):
        window = slam._normal_equations(state.before, state.variables, state.frames)
        before, variables = slam._absorbed(state)
        frames = _appended(state.frames, nothing)
        absorbed = slam._normal_equations(before, variables, frames)
        n = before.offset.size + slam._noises(before)
        own = begin(state.before, state.variables[:n])
        point = slam._advance(state.before, own, oldest)[0], begin(before, variables)
        return point, (_estimate(window), _estimate(absorbed))

    def apart(a, b):
        return difference((b.core, b.landmarks.ravel()), (a.core, a.landmarks.ravel()))

    point, (expected, found) = both(state)
    close(point[1].landmarks, point[0].landmarks, 1e-7)
    np.testing.assert_allclose(apart(*point)[: expected.core_dim], 0, rtol=0, atol=1e-7)
    sigma = np.sqrt(np.diagonal(expected.covariance))
    known = sigma > 0
    assert np.abs(apart(expected, found)[known] / sigma[known]).max() < 1e-4
    close(found.covariance, expected.covariance, 1e-6)


def test_the_gauge_is_not_seen_by_a_camera():
    """Nothing that is measured depends on λ."""
    of = case()
    slam = of.filter("scale_gauge")
    state, _ = pose_run(of, slam)
    other = replace(state, core=replace(state.core, log_scale=state.core.log_scale + 0.5))
    slots = jnp.arange(of.capacity)
    control = of.controls()[0]
    pixels = [slam.predict_features(s, control, slots).measured for s in (state, other)]
    np.testing.assert_array_equal(*pixels)
    poses = [camera_pose(slam, s)[0].translation() for s in (state, other)]
    np.testing.assert_allclose(poses[1], poses[0] * np.exp(0.5))


@pytest.mark.parametrize(
    ("modifier", "own", "common"), [("scene", 2.0, 1.0), ("scene50", 1.25, 0.25)]
)
def test_depths_have_their_own_variance_and_what_is_common(modifier, own, common):
    """In variances of one prior, to which `scene` adds."""
    of = case("matched")
    slam = of.filter(f"robocentric+{modifier}")
    first, _, _ = of.frames(0)
    state = slam.init(of.capacity, first)
    c = state.core_dim
    index = c + 3 * np.arange(of.capacity) + 2
    P = np.asarray(state.covariance)[np.ix_(index, index)] / 650**2
    variance = float(slam.depth.sigma) ** 2
    np.testing.assert_allclose(np.diagonal(P), own * variance, rtol=1e-9)
    np.testing.assert_allclose(P[0, 1:], common * variance, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "landmarks", "calibration", "message"),
    [
        ("robocentric+lag0", "inverse_scaling", "known", "at least 1 frame"),
        ("robocentric+lag5", "inverse_scaling", "consider", "cannot consider"),
        ("world+lag5", "inverse_depth_to_cartesian", "known", "cannot switch the form"),
        ("world+particles+lag5", "cartesian", "known", "delayed"),
        ("world+particles+scene50", "cartesian", "known", "delayed initialisation"),
        ("robocentric+scene50+particles", "cartesian", "known", "delayed initialisation"),
        ("robocentric+scene50+rays", "cartesian", "known", "delayed initialisation"),
        ("robocentric+rays+scene50", "cartesian", "known", "delayed initialisation"),
        ("scale_gauge+particles", "cartesian", "known", "delayed initialisation"),
        ("scale_gauge+rays", "cartesian", "known", "delayed initialisation"),
        ("scale_gauge+scene50+rays", "cartesian", "known", "delayed initialisation"),
        ("robocentric+lag5+lag5", "inverse_scaling", "known", "not around a FixedLag"),
        ("robocentric+lag5+scene50", "inverse_scaling", "known", "must stand before"),
        ("robocentric+oc+lag5", "inverse_scaling", "known", "covariance form"),
        ("robocentric+lagg5", "inverse_scaling", "known", "lagg"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_makes_no_sense_is_refused(name, landmarks, calibration, message):
    with pytest.raises(ValueError, match=message):
        case("matched").filter(name, landmarks, calibration)


def test_a_gauge_needs_a_camera_with_a_velocity():
    with pytest.raises(ValueError, match="measure metres"):
        make_filter("scale_gauge", **{**case("matched").pieces(), "sensor": Position(0.1)})
