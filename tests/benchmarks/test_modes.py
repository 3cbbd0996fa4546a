"""Tests of the modes of a start from rest: what is told of them, which is which, their figure."""

from dataclasses import replace
from functools import cache, partial

import jax.numpy as jnp
import modes as told
import numpy as np
import pytest
from cases import Case, close, quick_jit
from modes import Modes, Worlds, followed, given_scale, modes_of_run, plot_modes

pytestmark = pytest.mark.laboratory

STEPS, WINDOW = 6, 4
LEFT, RIGHT = np.array([-0.1, 0.0]), np.array([0.1, 0.01])


@cache
def standstill():
    return Case("standstill", 1, landmarks=6, steps=STEPS)


@cache
def through():
    """The modes of one run, compiled quickly."""
    slam, of = standstill().filter("scale_gauge+mixture3+rest4"), standstill()
    quick = quick_jit(lambda slam, run: told._through(slam, of.room, run))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(told, "_compiled", lambda slam, room, run: quick(slam, run))
        return modes_of_run(slam, of.room, of.run(0))


def modes_with(*frames):
    """Modes of frames, each a dictionary of weights by the velocity of a straight path."""
    count, window = max(map(len, frames)), len(frames) + 1
    weights = np.zeros((len(frames), count))
    paths = np.zeros((len(frames), count, window, 2))
    for k, frame in enumerate(frames):
        for i, (velocity, weight) in enumerate(frame.items()):
            weights[k, i] = weight
            steps = np.minimum(np.arange(window), k + 1)
            paths[k, i] = steps[:, None] * np.array(velocity)
    landmarks = np.tile([0.1, 0.2], (len(frames), count, 3, 1))
    covariances = np.tile(1e-4 * np.eye(2), (len(frames), count, 3, 1, 1))
    return Modes(weights, paths, landmarks, covariances, weights, np.full(len(frames), 3.0))


def test_a_mode_keeps_its_number_when_others_overtake_it_and_when_its_scale_changes():
    left, right = tuple(LEFT), tuple(RIGHT)
    modes = modes_with(
        {left: 0.6, right: 0.4},
        {right: 0.7, tuple(1.5 * LEFT): 0.3},
        {tuple(0.5 * RIGHT): 1.0},
        {left: 0.5, (0.0, 0.1): 0.3, right: 0.2},
    )
    assert followed(modes).tolist() == [[0, 1, -1], [1, 0, -1], [1, -1, -1], [0, 2, 1]]
    modes = modes_with({left: 0.6, tuple(2 * LEFT): 0.4})
    assert followed(modes).tolist() == [[0, 0]]


def test_the_modes_of_a_run_explain_its_pixels_until_frames_are_merged():
    """The window of four frames after frame 0 is full in the fourth."""
    modes, points = through(), np.asarray(standstill().run(0).points)
    assert modes.weights.shape == (WINDOW - 1, 3)
    assert np.isfinite(modes.nees).all()
    assert modes.nees.shape == (STEPS,)
    np.testing.assert_allclose(modes.weights.sum(axis=1), 1.0, rtol=1e-9)
    assert (np.diff(modes.weights, axis=1) <= 0).all()
    azimuths = np.arctan2(points[:, 0], points[:, 1])
    for k, i in np.argwhere(modes.weights > 0.01):
        path = modes.paths[k, i]
        assert not path[0].any()
        assert np.abs(path[k + 1]).max() > 0
        np.testing.assert_array_equal(path[k + 1 :], np.tile(path[k + 1], (len(path) - k - 1, 1)))
        # A landmark stays on its ray, but for what the camera has moved.
        np.testing.assert_allclose(modes.landmarks[k, i, :, 0], azimuths, atol=0.1)
        assert 0 < modes.misfits[k, i] < 1.5


def test_the_scale_given_is_conditioned_on():
    """The inverse of the information's other rows and columns."""
    slam, of = standstill().filter("scale_gauge"), standstill()
    state = quick_jit(partial(slam.init, of.capacity))(of.frames(0)[0])
    n = len(state.covariance)
    root = np.random.default_rng(0).standard_normal((n, n))
    P = root @ root.T + np.eye(n)
    left = np.asarray(given_scale(replace(state, covariance=jnp.asarray(P))).covariance)
    at = state.core.part("log_scale").start
    others = np.ix_(*2 * [np.delete(np.arange(n), at)])
    close(left[others], np.linalg.inv(np.linalg.inv(P)[others]), 1e-9)
    assert np.abs(left[at]).max() < 1e-9 * np.abs(P).max()


def test_a_filter_without_a_start_from_rest_is_refused():
    of = standstill()
    with pytest.raises(ValueError, match=r"start from rest \(\+rest\), and this filter has none"):
        modes_of_run(of.filter("scale_gauge"), of.room, of.run(0))


def worlds():
    """Left dies after the second of four frames; the filter is in it."""
    left, right = tuple(LEFT), tuple(RIGHT)
    modes = modes_with({right: 0.6, left: 0.4}, {left: 0.75, right: 0.25}, {right: 1.0}, {right: 1})
    steps = np.arange(5)[:, None]
    return Worlds(
        modes,
        followed(modes),
        truth=steps * RIGHT,
        points=np.array([[-1.0, 4.0], [0.5, 6.0], [1.0, 9.0]]),
        filtered=1.1 * (steps * LEFT)[1:],
        filter_name="mine",
        rate=30.0,
    )


def test_the_figure_shows_who_lives_when_and_who_is_still_with_the_dead():
    data = worlds()
    figure = plot_modes(data, (1, 2, 4))
    said = [[x.get_text() for axes in row.axes for x in axes.texts] for row in figure.subfigs]
    assert said == [
        ["60%", "25%", "100%"],
        ["dead since frame 3;\nmine is still here", "40%", "75%"],
        ["goes right", "goes left"],
    ]
    titles = [axes.get_title() for axes in figure.subfigs[0].axes[:3]]
    assert titles == ["frame 1, 0.03 s", "frame 2, 0.07 s", "frame 4, 0.13 s"]
    above, below = (
        [np.asarray(line.get_xydata()) for line in figure.subfigs[0].axes[i].lines] for i in (1, 4)
    )
    way = data.modes.paths[1, 1, :3]
    assert any(line.shape == way.shape and np.allclose(line, way) for line in below)
    camera, (azimuth, inverse) = data.modes.paths[1, 1, 2], data.modes.landmarks[1, 1, 0]
    point = camera + np.array([np.sin(azimuth), np.cos(azimuth)]) / inverse
    assert any(line.shape == (1, 2) and np.allclose(line, point) for line in above)
    with pytest.raises(ValueError, match="known in frames 1 to 4"):
        plot_modes(data, (5, 9))
