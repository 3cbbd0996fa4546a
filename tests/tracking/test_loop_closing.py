"""A camera that is back at the start knows it, and where it has been is corrected by that."""

import itertools
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import cv2
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.io.source import Source, Trajectory
from jaxslam.models.frame import Submaps
from jaxslam.tracking import map as maps
from jaxslam.tracking import start
from jaxslam.tracking.places import closing, smoothing
from jaxslam.tracking.places.closing import close_loop
from jaxslam.tracking.places.submaps import loop_of
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import add_noise, render, room, synthetic_source
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.trajectory import absolute_trajectory_error, alignment

SETTINGS = TrackerSettings(filter="scale_gauge+oc", wanted=24, spare=2)
FRAMES = 110


def to_and_fro(frames=FRAMES, length=4.0, **size):
    """A camera that slides along the room's wall, and back."""
    like, seed = synthetic_source(frames=frames, seed=2, **size), 2
    T_wc = np.tile(np.eye(4), (frames, 1, 1))
    T_wc[:, 0, 3] = -length / 2 * np.cos(2 * np.pi * np.arange(frames) / (frames - 1))
    T_wc[:, 2, 3] = -1.5
    calibration, quads = like.calibration, room(seed, like.calibration.fx)

    def images():
        for index, pose in enumerate(T_wc):
            yield add_noise(render(quads, pose, calibration), np.random.default_rng([seed, index]))

    return Source("to and fro", calibration, like.times, images, Trajectory(like.times, T_wc))


@pytest.fixture(scope="module")
def short_submaps():
    """Several submaps in a short video."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start, "Submaps", partial(Submaps, parallax=0.15))
        patch.setattr(closing, "APART", 1)
        yield


@pytest.fixture(scope="module")
def walk(tmp_path_factory, short_submaps):
    """A tracker that has been there and back, its frames, and its file before the last ten."""
    source, path = to_and_fro(), tmp_path_factory.mktemp("walk") / "map.npz"
    tracker, frames = Tracker(source.calibration, SETTINGS), list(source)
    history = [tracker.track(frame) for frame in frames[:-10]]
    tracker.save(path)
    history += [tracker.track(frame) for frame in frames[-10:]]
    return tracker, history, source, path


@pytest.fixture(scope="module")
def way_out(short_submaps):
    """A tracker that has not come back, and its frames."""
    source = to_and_fro(80, 3.2, width=480, height=360)
    tracker = Tracker(source.calibration, replace(SETTINGS, filter="robocentric", wanted=36))
    frames = list(itertools.islice(source, 36))
    for frame in frames:
        tracker.track(frame)
    return tracker, frames


def error(source, history):
    T_wc = np.stack([one.T_wc for one in history])
    return absolute_trajectory_error(source.times, T_wc, source.times, source.reference.T_wc)


@pytest.mark.slow
def test_a_camera_that_returns_closes_loops_which_correct_its_way(walk):
    """What is found and learnt of real loops, which only a long video has."""
    tracker, history, source, _ = walk
    closed = [one for one in history if one.loop is not None]
    assert len(closed) == len(tracker.map.loops) >= 2
    assert tracker.refused == 0
    # Only on the way back, and in places of the way out.
    x = source.reference.T_wc[:, 0, 3]
    for one in closed:
        assert one.index > FRAMES / 2
        before = [x[old.index] for old in history if old.submap == one.loop + 1]
        assert abs(x[one.index] - before[0]) < 1.0
    corrected, points = tracker.smoothed(history)
    assert error(source, corrected)["rmse"] < 0.8 * error(source, history)["rmse"]
    assert [one.index for one in corrected] == [one.index for one in history]
    # No camera jumps where none did, and all covariances are positive.
    steps, raw = (
        np.linalg.norm(np.diff([one.T_wc[:3, 3] for one in some], axis=0), axis=1)
        for some in (corrected, history)
    )
    others = [one.loop is None for one in history[1:]]
    assert np.abs(steps - raw)[others].max() < 0.2 * raw[others].max()
    assert min(np.linalg.eigvalsh(one.covariance)[0] for one in corrected[1:]) > 0
    # The end is known better than without, and the landmarks are where they were, nearly.
    assert corrected[-1].camera.sigma_position < history[closed[0].index - 1].camera.sigma_position
    raw = tracker.points()
    assert points.numbers.tolist() == raw.numbers.tolist()
    near = np.linalg.norm(points.points, axis=1) < 20
    moved = np.linalg.norm(points.points - raw.points, axis=1)[near]
    assert 0 < np.median(moved) < 0.1


@pytest.mark.slow
def test_another_video_may_begin_anywhere_in_a_saved_map(walk):
    """Near the far end of the walk, which the latest submap does not show."""
    *_, source, path = walk
    later = Tracker.localising(path, source.calibration)
    frames = list(source)[60:70]
    found = [later.step(frame.image, frame.time) for frame in frames]
    assert found[0].relocalised
    assert not any(one.lost for one in found)
    assert {one.map for one in found} == {0}
    smooth, _ = later.smoothed(found)
    way = np.diff([one.T_wc[:3, 3] for one in smooth], axis=0)
    assert np.linalg.norm(way, axis=1).max() < 0.05  # it goes on and does not jump


def test_a_loop_is_closed_where_the_chain_says_that_it_can_be(way_out, monkeypatch):
    """A picture from the way out, far from which the camera is; and one of noise."""
    tracker, frames = way_out
    noise = np.random.default_rng(0).integers(0, 255, (360, 480), dtype=np.uint8)
    with jax.enable_x64(True):
        assert close_loop(noise, tracker.state) == (tracker.state, None)
        with monkeypatch.context() as patched:  # all that are looked for must be found
            patched.setattr(closing, "MOST_OF", 1.01)
            assert close_loop(frames[6].image, tracker.state) == (tracker.state, None)
        state, loop = close_loop(frames[6].image, tracker.state)
        assert (state.refused, loop) == (1, None)
        monkeypatch.setattr(closing, "GATE", np.inf)
        state, loop = close_loop(frames[6].image, tracker.state)
    assert (state.refused, loop, len(state.map.loops)) == (0, 0, 1)
    # It would be where that picture was taken.
    before, after = (one.map.place.camera.T_wc[:3, 3] for one in (tracker.state, state))
    assert np.linalg.norm(after) < 0.3 * np.linalg.norm(before)


def test_a_loop_weighs_as_the_pixels_do(way_out):
    """`R (T_PQ ⊟ T) + Qᵀ B (X − X̄)`: moved landmarks move the camera as least squares do."""
    tracker, _ = way_out
    p, q, calibration = 0, len(tracker.map.submaps) - 1, tracker.calibration
    ended, rng = tracker.map.submaps[p], np.random.default_rng(1)
    slots = np.flatnonzero((ended.numbers >= 0) & np.isfinite(ended.points).all(axis=1))[:15]
    T = np.eye(4)
    T[:3, 3] = [0.1, -0.05, 0.02]
    slam, wanted = tracker.estimator.slam, tracker.settings.wanted
    with jax.enable_x64(True):
        loop = loop_of(slam, tracker.map.submaps, (p, q), slots, T, 0.5, wanted)
    X = np.asarray(ended.frozen.state.landmarks)[slots]
    pixels = seen_by(calibration, T, X[:, :3] / X[:, 3:])
    moved = X.copy()
    moved[:, :3] += 1e-4 * rng.normal(size=(len(X), 3))
    turn, shift = (x.copy() for x in camera_of(T))
    turn, shift = cv2.solvePnPRefineLM(
        moved[:, :3] / moved[:, 3:], pixels, calibration.matrix, np.zeros(4), turn, shift
    )
    T_cw = np.eye(4)
    T_cw[:3, :3], T_cw[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    step = np.linalg.inv(T) @ np.linalg.inv(T_cw)
    expected = np.concatenate([step[:3, 3], Rotation.from_matrix(step[:3, :3]).as_rotvec()])
    delta = np.zeros((wanted, 4))
    delta[: len(X)] = moved - X
    by = np.tensordot(np.asarray(loop.by_landmarks), delta, 2)
    found = -np.linalg.solve(np.asarray(loop.by_pose), by)
    assert np.abs(found - expected).max() < 0.02 * np.abs(expected).max()
    # R is the root of the pose's information, σ of a pixel being .5.
    J = np.stack(
        [
            (seen_by(calibration, T @ small(i, 1e-4), X[:, :3] / X[:, 3:]) - pixels).ravel() / 1e-4
            for i in range(6)
        ],
        axis=1,
    )
    R = np.asarray(loop.by_pose)
    assert np.allclose(R.T @ R, J.T @ J / 0.25, rtol=1e-3, atol=2e-3 * np.abs(J.T @ J).max())


def camera_of(T):
    T_cw = np.linalg.inv(T)
    return cv2.Rodrigues(T_cw[:3, :3])[0], T_cw[:3, 3:].copy()


def seen_by(calibration, T, points):
    turn, shift = camera_of(T)
    flat = np.ascontiguousarray(points)
    return cv2.projectPoints(flat, turn, shift, calibration.matrix, np.zeros(4))[0][:, 0]


def small(i, size):
    """A step along one of the six directions."""
    T = np.eye(4)
    if i < 3:
        T[i, 3] = size
    else:
        T[:3, :3] = Rotation.from_rotvec(size * np.eye(3)[i - 3]).as_matrix()
    return T


@pytest.mark.slow
def test_a_map_has_so_many_submaps_and_goes_on_in_the_last(walk, monkeypatch):
    """A limit that no short video reaches."""
    *_, source, path = walk
    frames = list(source)[-12:-60:-1]
    for most in (maps.MOST, None):
        again = Tracker.load(path)
        before = len(again.map.submaps)
        monkeypatch.setattr(maps, "MOST", most or before)
        for i, frame in enumerate(frames, 1):
            again.step(frame.image, FRAMES / 30 + i / 30)
        assert not again.unmeasured
        assert (len(again.map.submaps) > before) == (most is not None)


@pytest.mark.slow
@pytest.mark.usefixtures("short_submaps")
def test_a_lost_camera_is_back_in_an_earlier_submap(tmp_path):
    """At the far end of its walk the camera is covered, and uncovered where it began."""
    source = to_and_fro()
    frames, tracker = list(source), Tracker(source.calibration, SETTINGS)
    out, black = frames[: FRAMES // 2], np.zeros((480, 640), np.uint8)
    shown = [
        *(frame.image for frame in out),
        *[black] * 3,
        *(frames[k].image for k in range(6, 36)),
    ]
    true = [*range(len(out)), *[-1] * 3, *range(6, 36)]
    history = []
    for k, image in enumerate(shown):
        history.append(tracker.step(image, k / 30))
        if k == 70:
            tracker.save(tmp_path / "map.npz")
    ended = {one.submap for one in history[: len(out)]}
    assert len(ended) >= 4
    (back,) = [k for k, one in enumerate(history) if one.relocalised]
    assert back <= len(out) + 4
    assert not any(one.lost for one in history[back:])
    assert {one.map for one in history} == {0}
    assert tracker.restarts == 0
    # It is a submap of its own, behind the one that was known again, and goes on from there.
    assert history[back].submap not in ended
    assert len(tracker.map.submaps) < len(ended)
    assert [len(one.submaps) for one in tracker.state.left] == [len(ended) - 1]
    seen = [k for k, one in enumerate(history) if not one.lost]
    smooth, points = tracker.smoothed(history)
    T_wc = source.reference.T_wc[[true[k] for k in seen]]
    each = np.arange(len(seen), dtype=float)
    for some in (history, smooth):
        T = np.stack([some[k].T_wc for k in seen])
        assert absolute_trajectory_error(each, T, each, T_wc)["rmse"] < 0.05
        assert min(np.linalg.eigvalsh(some[k].covariance)[0] for k in seen[1:]) > 0
    assert len(set(points.numbers.tolist())) == len(points.numbers) == tracker.created
    again = Tracker.load(tmp_path / "map.npz")
    assert [len(one.submaps) for one in again.state.left] == [len(ended) - 1]
    assert all(
        a is b for a, b in zip(again.map.earlier[0].submaps, again.map.submaps, strict=False)
    )
    rest = [again.step(image, k / 30) for k, image in enumerate(shown) if k > 70]
    assert np.array_equal([one.T_wc for one in rest], [one.T_wc for one in history[71:]])
    later = again.smoothed(history)[0]
    assert np.array_equal([one.T_wc for one in later], [one.T_wc for one in smooth])


@pytest.mark.slow
@pytest.mark.usefixtures("short_submaps")
def test_two_maps_are_joined_where_the_second_sees_the_first(tmp_path):
    """The camera is covered, uncovered at the far end, and comes back from there."""
    source = to_and_fro()
    frames, black = list(source), np.zeros((480, 640), np.uint8)
    tracker = Tracker(source.calibration, replace(SETTINGS, lost_for=5))
    true, history = [*range(22), *[-1] * 8, *range(55, 100)], []
    for k, which in enumerate(true):
        image = black if which < 0 else frames[which].image
        history.append(tracker.step(image, k / 30))
    (back,) = [k for k, one in enumerate(history) if one.relocalised]
    assert [one.map for one in history if not one.lost] == [0] * 22 + [1] * (back - 31) + [0] * (
        len(history) - back
    )
    (join,) = tracker.joins
    assert (join.map, join.to, join.step) == (1, 0, back)
    # The units are those of truth by each map's own scale.
    T_wc = source.reference.T_wc[true]
    tracked = np.array([not one.lost for one in history])
    scales = []
    for number in (0, 1):
        own = np.flatnonzero(tracked & (np.array([one.map for one in history]) == number))
        T = np.stack([history[k].T_wc for k in own])
        scales.append(alignment(own / 30, T, own / 30, T_wc[own]).scale)
    assert abs(np.log(scales[1] / scales[0]) - join.log_ratio) < 3 * join.sigma < 0.6
    smooth, points = tracker.smoothed(history)
    assert {one.map for one in smooth} == {0}
    assert set(points.maps.tolist()) == {0}
    own = np.flatnonzero(tracked)
    T = np.stack([smooth[k].T_wc for k in own])
    assert absolute_trajectory_error(own / 30, T, own / 30, T_wc[own])["rmse"] < 0.05
    assert min(np.linalg.eigvalsh(smooth[k].covariance)[0] for k in own[1:]) > 0
    # Farther from where they were joined it is known less.
    sigma = np.array([smooth[k].camera.sigma_position for k in range(31, back)])
    assert sigma[0] > 2 * sigma[-1]
    tracker.save(tmp_path / "map.npz")
    again = Tracker.load(tmp_path / "map.npz")
    assert np.array_equal(
        [one.T_wc for one in again.smoothed(history)[0]], [one.T_wc for one in smooth]
    )


def test_a_part_of_a_motion_is_as_much_of_its_turn_and_of_its_way():
    T = small(0, 0.8) @ small(4, 1.2)
    third, rest = smoothing._part_of(T, 1 / 3), smoothing._part_of(T, 2 / 3)
    np.testing.assert_allclose(third[:3, :3] @ rest[:3, :3], T[:3, :3], atol=1e-12)
    np.testing.assert_allclose(third[:3, 3] + rest[:3, 3], T[:3, 3], atol=1e-12)
    np.testing.assert_allclose(smoothing._part_of(T, 1.0), T, atol=1e-12)


@pytest.mark.usefixtures("unchecked")
def test_what_a_loop_corrects_grows_along_each_submap():
    """Up to its last camera, which is the first of the submap after it."""

    def share(T_wc, share, *, elsewhere):
        return share

    parts: Any = [SimpleNamespace(number=number, at=share) for number in (4, 5)]
    like = {"relocalised": False, "T_wc": None}
    history: Any = [SimpleNamespace(submap=number, **like) for number in (4, 4, 4, 5, 5, 5)]
    shares = smoothing._cameras(parts, history)
    np.testing.assert_allclose([shares[i] for i in range(6)], [0, 1 / 3, 2 / 3, 0, 0.5, 1])
