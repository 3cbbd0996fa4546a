"""A map has one unit of length, whatever its filter makes of the scale meanwhile."""

import csv
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

pytest.importorskip("cv2")

from cases import Around
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.geometry import jacobian, scaled
from jaxslam.io.tum import poses
from jaxslam.tracking import search as searching
from jaxslam.tracking.estimator import CameraReport
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance, adjoint
from jaxslam.tracking.report import frames_text
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.unit import MapInWorld, lengthened, nearness

FRAMES, FIXED = 12, 5
WANDER = 0.3 + 0.4 * np.sin(np.arange(FRAMES + 1))
SETTINGS = TrackerSettings(
    filter="world", wanted=12, spare=4, patience=2, least_success=0.6, lost_for=2
)


class Wandering(Around):
    """`world` in a unit of its own, another with every frame until that is fixed: `opening[k]`, the
    log of it in metres, on top of which comes the `wander[k]` of what it believes of the metre."""

    wander: jnp.ndarray
    opening: jnp.ndarray
    fixed_at: jnp.ndarray

    def predict_features(self, state, control, slots):
        seen = super().predict_features(state, control, slots)
        larger = jnp.exp(self.wander[state["frame"]])
        return seen._replace(pose=scaled(seen.pose, larger), omegas=seen.omegas / larger)

    def marginal(self, state, function):
        return super().marginal(state, lambda view: function(self.larger(state, view)))

    def landmark_marginal(self, state, function, slots):
        def believed(view):
            view = self.larger(state, view)
            return function(replace(view, omega=view.omega / jnp.exp(view.log_scale[0])))

        return super().landmark_marginal(state, believed, slots)

    def larger(self, state, view):
        """In metres of which the truth says how long they are, and logs that say so."""
        frame = state["frame"]
        logs = jnp.stack([self.wander[frame], self.opening[jnp.minimum(frame, self.fixed_at)]])
        pose = scaled(view.pose, jnp.exp(self.wander[frame]))
        return replace(view, pose=pose, log_scale=logs)

    def unit_fixed(self, state):
        return state["frame"] >= self.fixed_at


@dataclass
class Run:
    """A video, and what a tracker made of it."""

    tracker: Tracker
    results: list
    predicted: list


@pytest.fixture(scope="module")
def video():
    source = synthetic_source(frames=FRAMES, width=320, height=240)
    return source.calibration, list(source)


def half_hidden(frame):
    """After the first frame the left of the picture is black: what was there is given up."""
    image = frame.image.copy()
    image[:, :160] *= frame.index == 0
    return replace(frame, image=image)


def wandering(calibration, opening, fixed_at):
    world = SETTINGS.make_filter(calibration)
    assert isinstance(world, jaxslam.Slam)
    opening = np.pad(opening, (0, FRAMES + 1 - len(opening)), "edge")  # one program for all
    return Wandering(world, *map(jnp.asarray, (WANDER, opening, fixed_at)))


def run(calibration, frames, slam=None):
    """Every frame through a tracker; and where it predicts the landmarks, in the world."""
    tracker, predicted, whole = Tracker(calibration, SETTINGS, slam), [], searching.to_search

    def noted(landmarks, prediction, *rest):
        points = prediction.points / prediction.omegas[:, None]
        T = prediction.T_wc
        slots = sorted(landmarks)
        predicted.append((T, points[slots] @ T[:3, :3].T + T[:3, 3]))
        return whole(landmarks, prediction, *rest)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(searching, "to_search", noted)
        results = [tracker.track(half_hidden(frame)) for frame in frames]
    return Run(tracker, results, predicted)


@pytest.fixture(scope="module")
def plain(video):
    return run(*video)


@pytest.fixture(scope="module")
def wanders(video):
    return run(*video, wandering(video[0], [0.2], 0))


@pytest.fixture(scope="module")
def started(video):
    opening = np.random.default_rng(1).normal(0, 0.5, FIXED + 1)
    return run(*video, wandering(video[0], opening, FIXED))


def same(found, expected, ratio, within=1e-6):
    """All lengths of one are so many times those of the other; expected is in metres."""
    lengths = np.array([ratio] * 3 + [1.0] * 3)
    assert found.status == expected.status
    T = expected.T_wc.copy()
    T[:3, 3] *= ratio
    np.testing.assert_allclose(found.T_wc, T, rtol=0, atol=within)
    P = lengths[:, None] * expected.covariance * lengths
    np.testing.assert_allclose(found.covariance, P, rtol=0, atol=10 * within * P.max())


def test_a_path_and_its_map_are_in_one_unit_whatever_the_filter_takes_it_for(plain, wanders):
    ratio = np.exp(0.3)  # what frame 0 took for metres
    for found, expected in zip(wanders.results, plain.results, strict=True):
        same(found, expected, ratio)
        assert found.unit_fixed
    assert wanders.tracker.map.place.log_scale == pytest.approx(WANDER[FRAMES - 1] - 0.3, rel=1e-9)
    # The landmarks too, with those that have left the map; where they were seen first, and are
    # sought.
    assert plain.tracker.deleted > 0
    found, expected = wanders.tracker.points(), plain.tracker.points()
    np.testing.assert_array_equal(found.numbers, expected.numbers)
    np.testing.assert_allclose(found.points, ratio * expected.points, rtol=1e-5, atol=1e-8)
    for name in ("covariances", "in_map"):
        some, other = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(some, ratio**2 * other, rtol=1e-4, atol=1e-6 * other.max())
    for slot, one in plain.tracker.landmarks.items():
        T = one.first_camera.copy()
        T[:3, 3] *= ratio
        first = wanders.tracker.landmarks[slot].first_camera
        np.testing.assert_allclose(first, T, rtol=0, atol=1e-8)
    for (T, points), (T_plain, others) in zip(wanders.predicted, plain.predicted, strict=True):
        np.testing.assert_allclose(T[:3, 3], ratio * T_plain[:3, 3], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(points, ratio * others, rtol=1e-5, atol=1e-8)


def test_a_start_that_is_found_out_ends_in_one_unit(plain, started):
    results = started.results
    assert [result.unit_fixed for result in results] == [k >= FIXED for k in range(FRAMES)]
    places = [np.linalg.norm(result.T_wc[:3, 3]) for result in results]
    truth = [np.linalg.norm(result.T_wc[:3, 3]) for result in plain.results]
    ratio = places[FIXED] / truth[FIXED]
    for found, expected in list(zip(results, plain.results, strict=True))[FIXED:]:
        # What changes the look of patches by 1e-4 moves matches by as little.
        same(found, expected, ratio, within=1e-4)
    # What this filter makes of the depths meanwhile changes by less than its units do.
    shares = np.array(places[1:FIXED]) / truth[1:FIXED] / ratio
    units = np.asarray(started.tracker.estimator.slam.opening)
    assert np.abs(np.log(shares)).max() < 0.3 < np.abs(np.diff(units)).max()
    # The log of the map's unit: what the filter takes for metres, by what is written.
    expected = WANDER[FRAMES - 1] - np.log(ratio)
    assert started.tracker.map.place.log_scale == pytest.approx(expected, abs=1e-3)


def test_a_map_begun_within_a_start_has_a_start_of_its_own(video):
    calibration, frames = video
    slam = wandering(calibration, np.linspace(0, 0.5, FRAMES + 1), FRAMES)
    tracker, rng = Tracker(calibration, SETTINGS, slam), np.random.default_rng(0)
    results = []
    for frame in frames[:9]:
        noise = rng.integers(0, 256, frame.image.shape, dtype=np.uint8)
        results.append(tracker.track(replace(frame, image=noise) if frame.index >= 3 else frame))
        if results[-1].map:
            break
    assert results[-1].starts
    assert not results[-1].unit_fixed
    # A metre, as the filter takes it at the start of that map.
    assert tracker.map.place.log_unit == pytest.approx(WANDER[0], rel=1e-12)
    assert set(tracker.map.place.near) == {one.number for one in tracker.landmarks.values()}


def test_the_unit_is_that_in_which_the_mean_nearness_stays():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(6, 3))
    points[4] = np.inf
    points[5] = 0.0
    numbers = dict(enumerate((7, 3, 9, 1, 2, 5)))
    before, now = nearness(numbers, points), nearness(numbers, points / 1.7)
    assert lengthened(before, now, numbers.values()) == pytest.approx(np.log(1.7), rel=1e-12)
    # Products t ω with ω all alike at first, and known later: t is then as long as it was.
    omegas = np.array([0.1, 0.2, 0.6])
    flat = dict.fromkeys(range(3), 0.5)
    known = dict(enumerate(omegas))
    assert np.exp(-lengthened(flat, known, range(3))) * omegas.mean() == pytest.approx(0.5)
    assert lengthened(before, now, []) == lengthened({}, now, [7]) == 0.0
    assert lengthened({2: 0.0}, {2: 0.1}, [2]) == 0.0


def test_the_unit_is_told_by_landmarks_that_were_found_again_until_it_is_fixed():
    """Landmark 8 was seen once: its depth is what the prior says, and says nothing."""
    place = MapInWorld(log_unit=0.3, unit_fixed=False, near={7: 1.0, 8: 1.0})
    for fixed, units in ((False, 1), (True, 2), (True, 2)):
        flags = *np.array([fixed, False]), np.ones(9, bool)
        report = CameraReport(np.eye(4), np.zeros((6, 6)), *np.array([1.0, 0.0]), *flags)
        place = place.followed(report, {7: 2.0, 8: 50.0}, [7])
        assert place.log_unit == pytest.approx(0.3 + units * np.log(2.0), rel=1e-12)
        assert place.unit_fixed is fixed


# --- a pose and its covariance --------------------------------------------------------------------


def located(seed, sigma):
    """A pose some metres and some tenths of a radian away, with a full covariance."""
    rng = np.random.default_rng(seed)
    pose = poses(rng.normal(0, 2, 3), Rotation.from_rotvec(rng.normal(0, 0.7, 3)).as_quat())[0]
    root = sigma * rng.normal(size=(6, 6))
    return PoseWithCovariance(pose, root @ root.T)


def as_pose(matrix):
    return jaxlie.SE3.from_matrix(jax.numpy.asarray(matrix))


def test_the_composed_covariance_is_that_of_the_derivatives():
    first, step = located(0, 0.1), located(1, 0.05)
    both = first.then(step)
    np.testing.assert_allclose(both.T_wc, first.T_wc @ step.T_wc, rtol=0, atol=1e-13)
    J = jacobian(lambda pair: pair[0] @ pair[1], (as_pose(first.T_wc), as_pose(step.T_wc)))
    P = np.block([[first.covariance, np.zeros((6, 6))], [np.zeros((6, 6)), step.covariance]])
    # Float64, a few operations on numbers of order 1.
    np.testing.assert_allclose(both.covariance, J @ P @ J.T, rtol=0, atol=1e-13)


def test_points_carry_the_cameras_covariance():
    camera = located(8, 0.1)
    rng = np.random.default_rng(9)
    points, roots = rng.normal(0, 3, (5, 3)), rng.normal(0, 0.2, (5, 3, 3))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    placed, total = camera.points(points, covariances)
    for point, covariance, found, P in zip(points, covariances, placed, total, strict=True):
        tree = (as_pose(camera.T_wc), jax.numpy.asarray(point))
        J = np.asarray(jacobian(lambda both: both[0] @ both[1], tree))
        expected = J[:, :6] @ camera.covariance @ J[:, :6].T + J[:, 6:] @ covariance @ J[:, 6:].T
        np.testing.assert_allclose(found, tree[0] @ tree[1], rtol=0, atol=1e-12)
        np.testing.assert_allclose(P, expected, rtol=0, atol=1e-12)


def test_frames_csv_says_what_the_unit_is_taken_for(started):
    history = [replace(x, log_scale=0.1 * x.index, sigma_log_scale=0.5) for x in started.results]
    rows = list(csv.DictReader(frames_text(history).splitlines()))
    assert [int(row["unit_fixed"]) for row in rows] == [int(x.unit_fixed) for x in history]
    assert [row["log_scale"] for row in rows] == [f"{0.1 * k:.6g}" for k in range(FRAMES)]
    assert {row["sigma_log_scale"] for row in rows} == {"0.5"}


def test_what_a_loop_says_of_the_camera_is_kept_and_grows_with_what_is_not_known_since():
    """Frozen errors of odometry, T_bc = E S with S since: what is left is the posterior of E and
    all of S."""
    rng = np.random.default_rng(4)

    def pose(size):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(size * rng.normal(size=3)).as_matrix()
        T[:3, 3] = size * rng.normal(size=3)
        return T

    unit, (T_then, T_since, T_moved) = 1.3, (pose(s) for s in (1.0, 0.5, 0.05))
    then, since, known = (np.diag(rng.uniform(a, 2 * a, 6)) for a in (0.1, 0.01, 0.001))

    def report(T, P):
        return CameraReport(T, P, *np.zeros(2), *np.array([True, False]), np.ones(9, bool))

    place = MapInWorld(log_unit=np.log(unit))
    place = place.followed(report(T_then, then), {}, [])
    before = place.camera.T_wc
    place = place.corrected(T_moved @ T_then, known)
    moved = place.camera.T_wc @ np.linalg.inv(before)
    there = PoseWithCovariance(T_moved @ T_then, known).scaled(unit)
    assert place.camera.T_wc == pytest.approx(there.T_wc, abs=1e-12)
    assert place.camera.covariance == pytest.approx(there.covariance, abs=1e-12)
    A = adjoint(np.linalg.inv(T_since))
    place = place.followed(report(T_then @ T_since, A @ then @ A.T + since), {}, [])
    expected = PoseWithCovariance(T_moved @ T_then @ T_since, A @ known @ A.T + since).scaled(unit)
    assert place.camera.T_wc == pytest.approx(expected.T_wc, abs=1e-12)
    assert place.camera.covariance == pytest.approx(expected.covariance, abs=1e-12)
    # What the filter expects and its landmarks are moved alike.
    points, covariances = rng.normal(size=(3, 3)), np.tile(0.01 * np.eye(3), (3, 1, 1))
    there, spread, _ = place.points(points, covariances)
    assert there == pytest.approx(unit * points @ moved[:3, :3].T + moved[:3, 3], abs=1e-9)
    assert np.linalg.eigvalsh(spread) == pytest.approx(np.full((3, 3), 0.01 * unit**2))
