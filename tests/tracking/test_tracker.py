"""Tests of the tracker: a synthetic video is followed, and its files say so."""

import csv
import itertools
import json
from collections.abc import Callable
from dataclasses import replace

import cv2
import equinox as eqx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_info, threadpool_limits

pytest.importorskip("cv2")

from additions import BiasedVelocity, DriftingFocal, Huber, PlainHomogeneous
from cases import Around

import jaxslam
from jaxslam._runtime.programs import Program
from jaxslam._runtime.watchdog import lapack_calls
from jaxslam.evaluation import read_covariances
from jaxslam.io.opening import open_source
from jaxslam.io.tum import read_tum
from jaxslam.models.observations import Status
from jaxslam.tracking import estimator as programs
from jaxslam.tracking import tracker as trackers
from jaxslam.tracking.observations import Observations
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance, adjoint
from jaxslam.tracking.report import Tracked
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.summary import describe
from jaxslam.tracking.synthetic import add_noise, synthetic_source
from jaxslam.tracking.tracker import MOST_REPEATS, Tracker
from jaxslam.tracking.trajectory import absolute_trajectory_error
from jaxslam.tracking.video import track

FRAMES = 8
SMALL = TrackerSettings(filter="world", wanted=12, spare=4)
"""Most tests' settings: of one size the programs are the same."""


def small(frames, seed=0):
    return synthetic_source(frames=frames, seed=seed, width=320, height=240)


def frames_of(out):
    with (out / "frames.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    out = tmp_path_factory.mktemp("tracked")
    source = small(FRAMES)
    return out, source, track(source, out, SMALL)


def test_a_frame_takes_one_thread_of_blas(monkeypatch):
    """Else they wait for one another, for longer than they compute."""

    def threads():
        return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

    def taken(*data):
        found.append(threads())
        return really(*data)

    found, really, source = [], trackers._taken, small(1)
    monkeypatch.setattr(trackers, "_taken", taken)
    with threadpool_limits(2, user_api="blas"):
        Tracker(source.calibration, SMALL).track(next(iter(source)))
        assert threads() == {2}
    assert found == [{1}]


def test_the_files_hold_every_frame_and_agree_with_the_summary(tracked):
    out, source, summary = tracked
    times, T_wc = read_tum(out / "trajectory.txt")
    # Nine decimals.
    np.testing.assert_allclose(times, source.times, rtol=0, atol=1e-9)
    np.testing.assert_allclose(T_wc[0], np.eye(4), rtol=0, atol=1e-9)
    covariance_times, covariances, _ = read_covariances(out / "covariance.txt")
    # Exact: the same decimals of the same numbers; half of each matrix is read twice.
    np.testing.assert_array_equal(covariance_times, times)
    np.testing.assert_array_equal(covariances, np.swapaxes(covariances, 1, 2))
    # Nine decimals of the largest entry; all but the first are positive far beyond that.
    eigenvalues = np.linalg.eigvalsh(covariances)
    assert np.all(eigenvalues[1:, 0] > 1e-8 * eigenvalues[1:, -1])
    assert not covariances[0].any()
    header = (out / "covariance.txt").read_text().splitlines()[0]
    for words in (
        "error=split axes=body", "scale=marginal", "length=map",
        "which the filter takes as exactly known)",
    ):  # fmt: skip
        assert words in header
    assert "in the unit of each map" in (out / "trajectory.txt").read_text().splitlines()[0]
    ate = absolute_trajectory_error(times, T_wc, *source.reference)
    assert ate["rmse"] == pytest.approx(summary["ate"]["rmse"], rel=1e-3)
    assert json.loads((out / "summary.json").read_text())["frames"] == FRAMES
    assert (out / "map.ply").read_text().startswith("ply")
    assert {path.name for path in out.iterdir()} == {
        "trajectory.txt", "covariance.txt", "frames.csv", "map.ply", "map.npz", "map.png",
        "overlay.mp4", "summary.json",
    }  # fmt: skip


def test_frames_csv_says_what_became_of_every_frame(tracked):
    out, _, summary = tracked
    rows = frames_of(out)
    assert ",".join(rows[0]) == (
        "frame,time,state,map,matches,nis,nis_dof,sigma_position,sigma_orientation,"
        "sigma_log_scale,log_scale,unit_fixed,reason,relocalised,submap,loop,repeated"
    )
    assert [row["state"] for row in rows] == ["start"] + ["tracked"] * (FRAMES - 1)
    # This filter has no scale apart from the map.
    for column, value in {
        "reason": "", "relocalised": "0", "map": "0", "unit_fixed": "1", "log_scale": "",
        "sigma_log_scale": "",
    }.items():  # fmt: skip
        assert {row[column] for row in rows} == {value}
    unit = {"map": 0, "fixed_at": 0, "log_scale": None, "sigma_log_scale": None}
    assert summary["units"] == [unit]
    assert (summary["relocalised"], summary["lost_reasons"], summary["maps"]) == (0, {}, 1)
    assert "log_scale_sigma_between_maps" not in summary
    matches = [int(row["matches"]) for row in rows[1:]]
    assert np.mean(matches) == pytest.approx(summary["matches_per_frame"], rel=1e-12)
    assert [int(row["nis_dof"]) for row in rows[1:]] == [2 * count for count in matches]
    nis = sum(float(row["nis"]) for row in rows) / (FRAMES - 1)
    assert nis == pytest.approx(summary["nis"]["mean"], rel=1e-5)
    variances = np.diagonal(read_covariances(out / "covariance.txt").covariances, 0, 1, 2)
    for column, part in (("sigma_position", slice(3)), ("sigma_orientation", slice(3, 6))):
        found = [float(row[column]) for row in rows]
        np.testing.assert_allclose(found, np.sqrt(variances[:, part].sum(axis=1)), rtol=1e-5)


def test_innovations_are_of_all_that_was_found_believed_or_not(tracked):
    places = np.array([[10.0, 20.0], [5.0, 5.0], [0.0, 0.0]])
    S = np.stack([np.diag([4.0, 1.0]), np.eye(2), np.array([[2.0, 1.0], [1.0, 2.0]])])
    found = np.array([[12.0, 21.0], [np.nan, np.nan], [1.0, 1.0]])
    labels = np.array(["matched", "unmatched", "outlier"])
    seen = Observations(np.arange(3), places, S, found, np.zeros(3), labels)
    innovations = Tracked(0, 0.0, PoseWithCovariance(), seen).innovations
    np.testing.assert_allclose(innovations, [2, 2 / 3], rtol=1e-12)
    ungated = tracked[2]["nis_ungated"]
    assert ungated["matches"] >= tracked[2]["matches_per_frame"] * (FRAMES - 1)
    # The settings' accelerations are larger than this camera's, its pixels as good as they say.
    assert 0 < ungated["median"] < 1.2
    assert 0 <= ungated["beyond95"] < 0.1


# --- lost and begun anew --------------------------------------------------------------------------

DARK, LIGHT, END = 4, 8, 12
"""Frames from which nothing is seen, from which another room is, and the end."""


@pytest.fixture(scope="module")
def restarted(tmp_path_factory):
    """A video that goes dark and goes on elsewhere."""
    out = tmp_path_factory.mktemp("restarted")
    source, elsewhere = small(END), small(END, seed=7)

    def images():
        both = zip(source.images(), elsewhere.images(), strict=True)
        for index, (here, there) in enumerate(both):
            yield here if index < DARK else there if index >= LIGHT else np.zeros_like(here)

    settings = replace(SMALL, lost_for=LIGHT - DARK - 1)
    return out, track(replace(source, images=images), out, settings)


def test_a_camera_that_was_lost_for_long_begins_a_new_map(restarted):
    out, summary = restarted
    rows = frames_of(out)
    states = ["start", *["tracked"] * 3, *["lost"] * 4, "start", *["tracked"] * 3]
    assert [row["state"] for row in rows] == states
    assert [int(row["map"]) for row in rows] == [0] * LIGHT + [1] * (END - LIGHT)
    lost = [DARK <= index <= LIGHT for index in range(END)]
    assert summary["maps"] == 2
    assert [(unit["map"], unit["fixed_at"]) for unit in summary["units"]] == [(0, 0), (1, LIGHT)]
    assert (summary["tracked"], summary["lost"]) == (END - 5, 5)
    assert [row["reason"] for row in rows] == ["few agree" if state else "" for state in lost]
    assert "lost frames: 5 (5 few agree)" in describe(summary)
    # σ/ρ of the prior on an inverse depth is ½, in each of the two maps.
    assert summary["log_scale_sigma_between_maps"] == pytest.approx(np.sqrt(0.5), rel=1e-12)
    assert "2 maps, each with its own unit" in describe(summary)
    rows = (out / "map.ply").read_text().split("end_header\n")[1].splitlines()
    assert {row.split()[-1] for row in rows} == {"0", "1"}


def test_after_a_restart_the_camera_is_known_no_better_than_before(restarted):
    out, _ = restarted
    _, T_wc = read_tum(out / "trajectory.txt")
    covariances = read_covariances(out / "covariance.txt").covariances

    def at(frame, other):
        """The covariance of a frame, in the axes of another, the step between them known."""
        A = adjoint(np.linalg.inv(T_wc[other]) @ T_wc[frame])
        return A @ covariances[frame] @ A.T

    # Without a measurement all that is known of the camera fades, frame by frame …
    for frame in range(DARK, LIGHT + 1):
        turned = np.kron(np.eye(2), T_wc[frame, :3, :3])
        before = np.kron(np.eye(2), T_wc[DARK - 1, :3, :3])
        grown = turned @ covariances[frame] @ turned.T
        grown -= before @ covariances[DARK - 1] @ before.T
        assert np.linalg.eigvalsh(grown[:3, :3])[0] > 0
        assert np.linalg.eigvalsh(grown[3:, 3:])[0] > 0
    # … and no measurement in another map brings it back: each adds to where its map begins.
    for frame in range(LIGHT + 1, END):
        gained = np.linalg.eigvalsh(at(frame, LIGHT) - covariances[LIGHT])
        # Ten digits are written of each number, and the poses have nine decimals.
        assert gained[0] > -1e-8 * np.trace(covariances[LIGHT])
        assert gained[-1] > 0


def fail_when(monkeypatch, fails):
    """Let the filter's covariance not be positive after an update where this is so."""
    whole = programs._correct

    def failing(*arguments):
        state, (*result, status) = whole(*arguments)
        return state, (*result, Status.NOT_POSITIVE if fails() else status)

    monkeypatch.setattr(programs, "_correct", failing)


@pytest.mark.parametrize("broken", ["update", "prediction"])
def test_a_filter_that_fails_is_begun_anew_from_what_prediction_says(broken, monkeypatch):
    """Its covariance is not positive after a frame's update, or even without one."""
    source = small(5)
    tracker, results = Tracker(source.calibration, SMALL), []
    failures = itertools.count()
    most = 1 if broken == "update" else 2
    fail_when(monkeypatch, lambda: frame.index == 3 and next(failures) < most)
    for frame in source:
        results.append(tracker.track(frame))
    assert [result.state for result in results] == ["start", *["tracked"] * 2, "start", "tracked"]
    assert [result.map for result in results] == [0, 0, 0, 1, 1]
    assert [result.lost for result in results] == [False, False, False, True, False]
    assert tracker.failed == {"not_positive": 1}
    before, start = results[2].camera, results[3].camera
    assert start.sigma_orientation > before.sigma_orientation
    if broken == "prediction":
        # Where it was, give or take the prior on a start's velocity.
        np.testing.assert_allclose(start.T_wc, before.T_wc, rtol=0, atol=1e-12)
        moved = np.sqrt(3) * tracker.settings.velocity_sigma / 30
        expected = np.hypot(before.sigma_position, moved)
        assert start.sigma_position == pytest.approx(expected, rel=0.01)
    landmarks = tracker.points()
    assert len(set(landmarks.numbers)) == len(landmarks.numbers) == tracker.created
    # Where its map begins is no surer for a landmark than for the camera.
    added = np.linalg.eigvalsh(landmarks.covariances - landmarks.in_map)
    usual = np.linalg.norm(landmarks.points, axis=1) < 100
    first, second = usual & (landmarks.maps == 0), usual & (landmarks.maps == 1)
    assert min(first.sum(), second.sum()) > 5
    np.testing.assert_allclose(added[first], 0, rtol=0, atol=1e-12)
    assert np.all(added[second, -1] > start.covariance[:3, :3].diagonal().min())


def test_a_filter_that_fails_in_the_dark_begins_anew_when_there_is_light(monkeypatch):
    """Until then the filter has no landmarks that the map has given up."""
    source, results = small(5), []
    tracker = Tracker(source.calibration, SMALL)
    fail_when(monkeypatch, lambda: frame.index == 2 and not tracker.failed)
    for frame in source:
        results.append(
            tracker.track(replace(frame, image=frame.image * (frame.index not in (2, 3))))
        )
    assert [result.state for result in results] == ["start", "tracked", "lost", "lost", "start"]
    assert len(results[3].observations.slots) == 0
    assert tracker.created == len(tracker.points().numbers)


@pytest.fixture
def under_way():
    """A tracker after two frames, and the frame that comes next."""
    source = small(3)
    tracker, (first, second, third) = Tracker(source.calibration, SMALL), source
    tracker.track(first)
    assert tracker.track(second).state == "tracked"
    return tracker, third


def changed(tracker, **fields):
    """Give the map's filter another state."""
    state = replace(tracker.map.state, **fields)
    tracker.state = tracker.state.with_map(state=state)


def test_a_world_behind_the_camera_is_given_up(under_way):
    tracker, frame = under_way
    state = tracker.map.state
    behind = state.landmarks.at[:, 3].multiply(-1)
    changed(tracker, landmarks=behind, covariance=1e-6 * state.covariance)
    result = tracker.track(frame)
    assert (result.state, result.map, tracker.reversed) == ("start", 1, 1)
    assert tracker.state.left == ()  # nobody is to come back to it


def test_a_camera_whose_direction_is_unknown_is_found_again(under_way):
    """The matches that agree say where the others are to be searched, within a few pixels."""
    tracker, frame = under_way
    kept, poses = tracker.state, []
    for unsure in (0.0, 0.3):
        tracker.state, angles = kept, np.arange(3, 6)
        changed(tracker, covariance=tracker.map.state.covariance.at[angles, angles].add(unsure**2))
        found = tracker.track(frame)
        assert found.state == "tracked"
        poses.append(found.T_wc)
    apart = np.linalg.inv(poses[0]) @ poses[1]
    assert np.arccos((np.trace(apart[:3, :3]) - 1) / 2) < 0.002
    assert np.linalg.norm(apart[:3, 3]) < 0.02


def test_a_jerk_that_all_matches_tell_of_is_believed(monkeypatch):
    """An angular acceleration of nine σ."""
    source = small(18, seed=1)
    tracker, (*frames, last) = Tracker(source.calibration, SMALL), source
    for frame in frames:
        tracker.track(frame)
    turn = [0, 9 * SMALL.angular_acceleration_sigma * source.times[1] ** 2 / 2, 0]
    R = Rotation.from_rotvec(turn).as_matrix()
    K, size = source.calibration.matrix, last.image.shape[::-1]
    last = replace(last, image=cv2.warpPerspective(last.image, K @ R.T @ np.linalg.inv(K), size))
    kept = tracker.state
    found = tracker.track(last)
    assert not found.lost
    assert source.reference is not None
    error = Rotation.from_matrix((source.reference.T_wc[-1, :3, :3] @ R).T @ found.T_wc[:3, :3])
    assert error.magnitude() < 4 * np.sqrt(np.trace(found.covariance[3:, 3:]))
    monkeypatch.setattr(trackers, "JERK", 1.0)
    tracker.state = kept
    assert tracker.track(last).lost


# --- pictures that say nothing ------------------------------------------------------------------


def as_compressed(image, index):
    """A copy in which some pixels are a grey level off."""
    off = np.random.default_rng(index).random(image.shape) < 0.2
    return np.where(off & (image < 255), image + 1, image).astype(np.uint8)


@pytest.fixture(scope="module")
def once():
    """Frames, a tracker's results of them, and a new one."""
    source = small(6)
    tracker, frames = Tracker(source.calibration, SMALL), list(source)
    return frames, [tracker.track(frame) for frame in frames], source.calibration


def noisy(image, seed):
    return add_noise(image, np.random.default_rng(seed))


@pytest.mark.parametrize("copied", [lambda image, _: image, as_compressed])
def test_a_picture_that_comes_twice_is_used_once(once, copied):
    frames, expected, calibration = once
    tracker, results = Tracker(calibration, SMALL), []
    for frame in frames:
        results.append(tracker.track(replace(frame, index=2 * frame.index)))
        results.append(tracker.step(copied(frame.image, frame.index), frame.time + 1 / 60))
    assert [one.repeated for one in results] == [False, True] * 6
    assert tracker.steps == 12
    for used, copy, one in zip(results[::2], results[1::2], expected, strict=True):
        assert not copy.lost
        assert copy.nis_dof == 0
        np.testing.assert_array_equal(copy.T_wc, used.T_wc)
        np.testing.assert_array_equal(copy.covariance, used.covariance)
        np.testing.assert_allclose(used.T_wc, one.T_wc, atol=1e-9)
        np.testing.assert_allclose(used.covariance, one.covariance, atol=1e-9)


def test_a_camera_that_stands_still_goes_on_from_there_at_once(once):
    """After a long standstill the time that it took says nothing of how far it can be."""
    (first, second, third, *_), (_, _, expected, *_), calibration = once
    tracker = Tracker(calibration, SMALL)
    for frame in (first, second):
        tracker.track(frame)
    for k in range(40):
        assert tracker.step(second.image, second.time + (k + 1) / 30).repeated
    assert tracker.state.repeats == 40 > MOST_REPEATS
    found = tracker.step(third.image, second.time + 41 / 30)
    assert found.state == "tracked"
    assert found.status.count("matched") > 8
    sizes = [np.median(np.trace(x.observations.covariances, 0, 1, 2)) for x in (found, expected)]
    assert sizes[0] < 2 * sizes[1]


@pytest.mark.parametrize("flash", [False, True])
def test_noise_alone_makes_another_picture(once, flash):
    """After a flash, too: a tenth of what changed between darkness and a picture is more than a
    slow camera changes."""
    (first, *_), _, calibration = once
    tracker = Tracker(calibration, SMALL)
    for k in range(4):
        image = noisy(first.image, k) * (not flash or k != 1)
        assert not tracker.step(image.astype(np.uint8), k / 30).repeated


def test_seconds_of_darkness_make_no_maps(once):
    """Its noise has corners, none of which is found again; and the map before is still known."""
    frames, _, calibration = once
    tracker = Tracker(calibration, replace(SMALL, lost_for=2))
    for frame in frames:
        tracker.track(frame)
    known, dark = tracker.map.landmarks.keys(), np.zeros_like(frames[0].image)
    results = [tracker.step(noisy(dark, k), 1 + k / 30) for k in range(20)]
    assert all(one.lost for one in results)
    assert {one.map for one in results} == {0, 1}
    assert sum(one.starts for one in results) == 1
    assert not any(len(one.created) for one in results if one.map == 0)
    assert tracker.restarts == 0
    (before,) = tracker.state.left
    assert (before.number, before.landmarks.keys()) == (0, known)


def test_darkness_before_the_first_map_is_no_repeated_picture(once):
    tracker = Tracker(once[2], SMALL)
    results = [tracker.step(np.zeros((240, 320), np.uint8), k / 30) for k in range(3)]
    assert [one.state for one in results] == ["start", "lost", "lost"]


# --- slow: what only longer videos, other filters and real pictures show --------------------------


@pytest.mark.slow
def test_a_real_sequence_is_tracked(shared_data, tmp_path):
    """Noise, blur and a lens that no synthetic picture has."""
    source = open_source(shared_data / "costado", frames=60)
    summary = track(source, tmp_path, TrackerSettings(filter="world", wanted=30))
    assert summary["tracked"] == 60
    # Measured on all 720 frames: 0.2 %.
    assert summary["ate"]["rmse"] < 0.03 * summary["ate"]["path_length"]


@pytest.mark.slow
@pytest.mark.parametrize("name_of_filter", ["world", "robocentric+mixture3"])
def test_the_tracker_calls_no_lapack(name_of_filter, monkeypatch):
    """In none of its programs; unbatched calls are slow where OpenBLAS has threads of its own."""
    source, calls, traced = synthetic_source(frames=3), {}, eqx.filter_make_jaxpr

    class LookedInto(Program):
        def __call__(self, *data):
            name = next(name for name, one in used.items() if one is self)
            if name not in calls:
                calls[name] = lapack_calls(traced(self.function)(*data)[0].jaxpr)
            return super().__call__(*data)

    jitted = {n: f for n, f in vars(programs).items() if isinstance(f, Program)}
    used = {name: LookedInto(program.function) for name, program in jitted.items()}
    for name, program in used.items():
        monkeypatch.setattr(programs, name, program)
    tracker = Tracker(source.calibration, TrackerSettings(wanted=8, filter=name_of_filter))
    for frame in source:
        tracker.track(frame)
    tracker.points()
    tracker.camera()
    # No ellipse is curved in three frames, no camera is lost, and none has an inertial unit.
    unused = {"_remove", "_curved", "_moving", "_at_rest", "_biases"}
    assert calls.keys() | unused == jitted.keys()
    assert len(calls) >= 6
    assert set().union(*calls.values()) == set()


def track_a_lorry(seed, picture):
    """Track 60 frames and 24 in which the left half is of `picture(frame)`, pulled aside. Returns
    how far, at most, the tracked poses of the first map are off, m, before and in these, at the
    scale of those before; and the tracker."""
    source, results = synthetic_source(frames=84, seed=seed), []
    tracker = Tracker(source.calibration, TrackerSettings(filter="world"))
    pan = np.cumsum(np.random.default_rng(seed).normal(1.5, 1, 120))
    for frame in source:
        image, aside = frame.image.copy(), int(pan[frame.index] - pan[60])
        if frame.index >= 60:
            image[:, :320] = np.roll(picture(frame), aside, axis=1)[:, :320]
        results.append(tracker.track(replace(frame, image=image)))
    assert source.reference is not None
    known = np.array([one.index for one in results if not one.lost and one.map == 0])
    positions = np.stack([results[k].T_wc for k in known])[:, :3, 3]
    truth, before = source.reference.T_wc[known, :3, 3], known < 60
    a, b = positions[before].ravel(), truth[before].ravel()
    off = np.linalg.norm(a @ b / (a @ a) * positions - truth, axis=1)
    return off[before].max(), off[~before].max(initial=0.0), tracker


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "stands"), [(2, True), (4, True), (2, False)])
def test_half_a_picture_that_moves_otherwise_is_not_believed(seed, stands):
    """Its corners become landmarks, each of which fits somehow; together they do not. Where both
    halves are of the room, nobody can tell which is the world's."""
    still = next(iter(synthetic_source(frames=1, seed=seed))).image
    before, meanwhile, tracker = track_a_lorry(seed, lambda frame: still if stands else frame.image)
    assert meanwhile < before
    assert tracker.restarts == (not stands)


class Outside(Around):
    """One that says whenever it is compiled."""

    compiles: Callable[[], None] = eqx.field(static=True)

    def predict(self, state, control):
        self.compiles()
        return super().predict(state, control)


@pytest.mark.slow
def test_a_filter_of_ones_own_is_compiled_once_before_the_first_frame():
    """A program compiled twice, as where the intervals between frames were part of it."""
    source, compiled = synthetic_source(frames=4), []
    world = SMALL.make_filter(source.calibration)
    assert isinstance(world, jaxslam.Slam)
    own = Tracker(source.calibration, SMALL, Outside(world, lambda: compiled.append(1)))
    own.compile()
    assert own.steps == own.created == len(own.landmarks) == 0
    found = [own.track(frame) for frame in source]
    assert found[-1].status.count("matched") >= 8
    assert own.map.state["frame"] == 3
    assert len(compiled) == 1 < len(set(np.diff(source.times)))


@pytest.mark.slow
def test_pieces_of_ones_own_track():
    """Whatever the tracker takes for granted of the package's own pieces."""
    source = synthetic_source(frames=8)
    lens, linear, angular = source.calibration, [1.0] * 3, [2.0] * 3
    camera = jaxslam.Camera((lens.fx, lens.fy), (lens.cx, lens.cy))
    slam = jaxslam.Slam(
        motion=BiasedVelocity(linear + angular, [0.0] * 6, [0.5] * 6, [0.1] * 6),
        sensor=jaxslam.Pinhole(camera, 0.3),
        calibration=DriftingFocal([0.01], [0.001]),
        landmark=PlainHomogeneous(),
        correction=Huber(3.0),
        depth=jaxslam.InverseDepth.beyond(1.0),
        frame=jaxslam.WorldCentric(),
    )
    tracker = Tracker(source.calibration, TrackerSettings(filter="world", wanted=20, spare=4), slam)
    tracked = [tracker.track(frame) for frame in source]
    assert [t.state for t in tracked] == ["start"] + ["tracked"] * 7
    assert not tracker.failed
    assert source.reference is not None
    # The camera turns by several degrees.
    step = np.linalg.inv(source.reference.T_wc[0]) @ source.reference.T_wc[7]
    error = np.linalg.inv(step) @ tracked[-1].T_wc
    assert np.degrees(np.linalg.norm(error[:3, :3] - np.eye(3))) < 2.0
