"""Tests of jaxslam.filters.window.subsample: a full window goes on with every other frame."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import quick_jit, whole_record

from jaxslam.filters.slam import Slam
from jaxslam.filters.window.minimise import started
from jaxslam.filters.window.problem import PathLayout, path
from jaxslam.filters.window.subsample import Coarse, every, thinned, tied
from jaxslam.filters.words import scenario_pieces
from jaxslam.landmarks import InverseScaling
from jaxslam.models.calibration import Known, White
from jaxslam.models.scale import ScaleGauge
from jaxslam.simulation import scenario

FRAMES = 7


def filter_of(treatment=Known):
    made = scenario_pieces(scenario("standstill-6dof"), "known")
    calibration = treatment() if treatment is Known else treatment(np.array([3.0] * 2 + [2.0] * 2))
    slam = Slam(scale=ScaleGauge(), **made, landmark=InverseScaling())
    return replace(slam, calibration=calibration)


def full(frames=FRAMES):
    """Landmark 0 is always seen, 1 from frame 1 on, 2 in frame 3 alone, 3 never."""
    k = jnp.arange(frames)[:, None]
    seen = jnp.concatenate([k >= 0, k >= 1, k == 3, k < 0], axis=1)
    measured = jnp.where(seen[..., None], 100.0 * k[..., None] + jnp.arange(2.0), 0.0)
    return whole_record(jnp.full(frames - 1, 0.1), measured, seen, jnp.array([0, 1, 3, 0]))


fewer_of = quick_jit(thinned)
"""A window that goes on with every other frame."""


def unknowns(slam, record, count=2):
    draw = np.random.default_rng(3)
    size, m = PathLayout.of(slam).size(record.frames), record.first.size
    x, y = draw.standard_normal((count, size)), draw.standard_normal((count, m, 3))
    return jax.vmap(started)(jnp.asarray(x), jnp.asarray(y))


def kept(frames, stride=2):
    """The frames of a full window that stay."""
    stay = quick_jit(lambda: every(full(frames), stride, frames))()
    return np.asarray(stay.frames[: int(stay.count)])


@pytest.mark.parametrize(
    ("frames", "stride", "stay"),
    [
        (3, 2, [0, 2]),
        (4, 2, [0, 2, 3]),
        (7, 2, [0, 2, 4, 6]),
        (8, 2, [0, 2, 4, 6, 7]),
        (8, 3, [0, 3, 6, 7]),
        (7, 1, range(7)),
    ],
)
def test_the_first_and_the_newest_frame_stay(frames, stride, stay):
    assert kept(frames, stride).tolist() == list(stay)


@pytest.mark.parametrize(("frames", "treatment"), [(FRAMES, Known), (FRAMES + 1, White)])
def test_velocities_and_calibrations_of_the_frames_that_stay_are_the_same(frames, treatment):
    """Twice over, so that steps of different lengths are merged too."""
    slam, record = filter_of(treatment), full(frames)
    minima = unknowns(slam, record)
    fewer, starts = fewer_of(slam, record, minima)
    before, after = (
        quick_jit(path)(slam, of, of_minima.x[1])
        for of, of_minima in ((record, minima), (fewer, starts))
    )
    stay = kept(frames)
    np.testing.assert_allclose(after.motion[: len(stay)], before.motion[stay], atol=1e-12)
    np.testing.assert_allclose(
        after.frames.calibration[: len(stay)], before.frames.calibration[stay], atol=1e-12
    )
    np.testing.assert_allclose(fewer.controls.sum(), record.controls.sum(), rtol=1e-12)
    assert fewer.merged[: len(stay) - 1].tolist() == np.diff(stay).tolist()
    assert (fewer.merged[len(stay) - 1 :] == 1).all()
    again, last = fewer_of(slam, replace(fewer, last=jnp.asarray(frames - 1)), starts)
    there = quick_jit(path)(slam, again, last.x[1]).motion
    count = len(stay)
    ends = [k for k in stay if k < count]
    np.testing.assert_allclose(there[: len(ends)], after.motion[np.array(ends)], atol=1e-12)


@pytest.mark.parametrize("restart", [1, 2])
def test_a_velocity_drawn_anew_stays_drawn_anew(restart):
    """From there on: what stood before takes no time."""
    slam, record = filter_of(), full()
    record = replace(record, restarted=record.restarted.at[restart].set(True))
    minima = unknowns(slam, record)
    fewer, starts = fewer_of(slam, record, minima)
    step = restart // 2
    assert fewer.restarted.tolist() == [k == step for k in range(FRAMES - 1)]
    length = 0.1 if restart == 1 else 0.2
    np.testing.assert_allclose(fewer.controls[step], length)
    layout = PathLayout.of(slam)
    was = minima.x[:, layout.whole + restart * layout.step :][:, : layout.step]
    now = starts.x[:, layout.whole + step * layout.step :][:, : layout.step]
    np.testing.assert_array_equal(now, was)


def test_landmarks_begin_in_the_first_frame_that_stays():
    """One that only a dropped frame saw is forgotten."""
    slam, record = filter_of(), full()
    minima = unknowns(slam, record)
    fewer, starts = fewer_of(slam, record, minima)
    assert fewer.last == 3
    assert fewer.first.tolist() == [0, 1, 0, 0]
    assert fewer.seen[:4, 0].all()
    assert fewer.seen[:, 1].tolist() == [False, True, True, True, False, False, False]
    assert not fewer.seen[:, 2:].any()
    np.testing.assert_array_equal(fewer.measured[:4, 0, 0], [0, 200, 400, 600])
    np.testing.assert_array_equal(starts.y[:, 0], minima.y[:, 0])
    np.testing.assert_array_equal(starts.y[:, 1, 2], minima.y[:, 1, 2])
    assert (starts.y[:, 1:3, :2] == 0).all()


@pytest.mark.parametrize(("lives", "holds"), [(FRAMES, True), (4, True), (3, False), (1, False)])
def test_a_window_is_tied_while_frames_that_stay_share_half_of_their_landmarks(lives, holds):
    """One landmark enters in each frame, and is seen in so many: a frame sees them all."""
    k, j = jnp.arange(FRAMES)[:, None], jnp.arange(2 * FRAMES) - FRAMES
    seen = (j <= k) & (k < j + lives)
    measured, first = jnp.zeros((*seen.shape, 2)), jnp.maximum(j, 0)
    record = whole_record(jnp.full(FRAMES - 1, 0.1), measured, seen, first)
    are_tied = quick_jit(tied)
    assert bool(are_tied(record)) == holds
    record = full()  # and a frame without light unties nothing
    assert are_tied(replace(record, seen=record.seen.at[4].set(False)))


@pytest.mark.parametrize(
    ("last", "stride", "treatment"), [(6, 1, Known), (6, 2, White), (5, 3, Known), (4, 3, White)]
)
def test_what_a_coarse_window_says_comes_back_as_the_likeliest_of_the_whole_one(
    last, stride, treatment
):
    """It is coarse what it was, and of all such unknowns the shortest."""
    slam, record = filter_of(treatment), replace(full(), last=jnp.asarray(last))
    frames = FRAMES - 2 if stride > 1 else FRAMES
    sizes = (PathLayout.of(slam).size(count) for count in (frames, FRAMES))
    draw, y = np.random.default_rng(5), jnp.zeros((4, 3))

    @quick_jit
    def there_and_back(some, other):
        coarse = Coarse(slam, record, stride, frames)
        x = coarse.of(*coarse.back(some, y))[0]
        fine, _ = coarse.back(x, y)
        return x, fine, coarse.of(fine, y)[0], other - coarse.back(*coarse.of(other, y))[0]

    x, fine, again, off = there_and_back(*map(draw.standard_normal, sizes))
    np.testing.assert_allclose(again, x, atol=1e-12)
    np.testing.assert_allclose(fine @ off, 0.0, atol=1e-10)
