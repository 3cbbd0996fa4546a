"""Tests of jaxslam.filters.window: what is remembered, and least squares against dense algebra."""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import close, quick_jit, whole_record
from scipy.special import gammaln
from scipy.stats import chi2, norm

from jaxslam.filters.slam import Slam
from jaxslam.filters.window import minimise, modes, scale
from jaxslam.filters.window.minimise import minimised, started
from jaxslam.filters.window.problem import PathLayout, left_out, path, reduced, residuals
from jaxslam.filters.window.record import Record, begun, empty, removed, stepped
from jaxslam.filters.window.scale import rescaled, scaling, shift_of_scale, variances
from jaxslam.filters.window.to_filter import _with_metre, gauge_state
from jaxslam.filters.words import scenario_pieces
from jaxslam.geometry import jacobian
from jaxslam.landmarks import InverseScaling
from jaxslam.linalg import cholesky
from jaxslam.models.calibration import Estimated, Known, White
from jaxslam.models.depth import InverseDepth
from jaxslam.models.observations import Features
from jaxslam.models.scale import ScaleGauge
from jaxslam.simulation import scenario

FRAMES, FIRST = 5, jnp.array([0, 0, 0, 1, 0, 2])
"""Landmarks begin in three frames."""


class Case(NamedTuple):
    """A filter, measurements that it could have made, and the unknowns that made them."""

    slam: Any
    record: Record
    x: Any
    y: Any


def pieces(name, **fields):
    return scenario_pieces(scenario(name, fields), "known")


def filter_of(name, treatment, common):
    """Everything is measured well, or the posterior would have many minima."""
    made = pieces(name)
    p = made["sensor"].size
    sigma = np.array([3.0] * p + [2.0] * p)
    depth = InverseDepth(0.25, 0.04, common)
    calibration = Known() if treatment is Known else treatment(sigma)
    slam = Slam(scale=ScaleGauge(), **made, landmark=InverseScaling())
    return replace(slam, depth=depth, calibration=calibration)


@cache
def case(name="standstill", treatment=Known, common=None, last=FRAMES - 1):
    """Pixels by the model itself at unknowns drawn from the prior, and noise on them."""
    slam = filter_of(name, treatment, common)
    draw = np.random.default_rng(5)
    m, p, N = FIRST.size, slam.sensor.size, PathLayout.of(slam).size(FRAMES)
    x = jnp.asarray(0.5 * draw.standard_normal(N)).at[0].set(1.5)
    y = jnp.asarray(0.5 * draw.standard_normal((m, p + 1)))
    seen = (jnp.arange(FRAMES)[:, None] >= FIRST) & (jnp.arange(FRAMES)[:, None] <= last)
    first = jnp.asarray(draw.uniform(150, 450, (m, p)))
    seen = seen.at[2, 1].set(False)
    record = whole_record(jnp.full(FRAMES - 1, 1 / 5), jnp.tile(first, (FRAMES, 1, 1)), seen, FIRST)
    factor = jnp.asarray(np.exp(np.random.default_rng(8).uniform(-1, 1, seen.shape)))
    record = replace(record, last=jnp.asarray(last), noise_factor=factor)
    wrong = quick_jit(residuals)(slam, record, quick_jit(path)(slam, record, x), y)
    noise = jnp.where(record.compared[..., None], draw.standard_normal(wrong.shape), 0.0)
    sigma = slam.sensor.sigma * jnp.sqrt(factor)[..., None]
    measured = record.measured - sigma * (wrong - noise)
    return Case(slam, replace(record, measured=measured), x, y)


PLANE, SPACE = ("standstill", Estimated, 0.5, 3), ("standstill-6dof", White)


def all_residuals(slam, record, u, shape):
    """`[x; y; r]`, as one function of both."""
    x, y = u[: -shape[0] * shape[1]], u[-shape[0] * shape[1] :].reshape(shape)
    return jnp.append(u, residuals(slam, record, path(slam, record, x), y).ravel())


@quick_jit
def _dense(slam, record, x, y):
    def of(u):
        return all_residuals(slam, record, u, y.shape)

    u = jnp.append(x, y.ravel())
    return of(u), jax.jacfwd(of)(u)


def dense(slam, record, x, y):
    """Residuals of everything, information and gradient, in NumPy."""
    r, J = (np.asarray(value) for value in _dense(slam, record, x, y))
    return r, J.T @ J, J.T @ r


@quick_jit
def _precisely(slam, record, x, y):
    return minimised(slam, record, started(x, y), 60)[0]


def mean(slam, record, at, shift=0.0):
    """The mode with all lengths so much longer, and the quadratic there."""
    return minimised(slam, record, started(*rescaled(slam, record, at, jnp.asarray(shift))), 1)


def precisely(slam, record, x, y):
    """The minimum as well as numbers can say it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(minimise, "TOLERANCE", 1e-14)
        return _precisely(slam, record, x, y)


@cache
def minimum(*of):
    """Of a case, from the truth."""
    return precisely(*case(*of))


def features(slots, measured, valid=None, factor=None):
    valid = np.ones(len(slots), bool) if valid is None else valid
    factor = None if factor is None else jnp.array(factor)
    return Features(jnp.array(slots), jnp.array(measured)[:, None], jnp.array(valid), factor)


@quick_jit
def some_record():
    """Three frames, three slots: 0 and 1 begin in frame 0, slot 2 in frame 1."""
    record = empty(pieces("standstill")["motion"], 3, 3, 1, jnp.float64)
    record = begun(record, features([1, 0, 2], [11.0, 10.0, 99.0], [True, True, False]))
    record = stepped(record, jnp.asarray(0.1), features([0, 1], [20.0, 21.0]), jnp.eye(1))
    record = begun(record, features([2], [22.0]))
    seen = features([2, 0], [32.0, 30.0], [True, False], [4.0, 9.0])
    return stepped(record, jnp.asarray(0.2), seen, jnp.eye(1))


def test_a_record_has_every_measurement_by_frame_and_slot():
    record = some_record()
    assert record.last == 2
    assert not record.standing  # as it moved at once
    np.testing.assert_array_equal(record.controls, [0.1, 0.2])
    np.testing.assert_array_equal(record.first, [0, 0, 1])
    seen = [[True, True, False], [True, True, True], [False, False, True]]
    np.testing.assert_array_equal(record.seen, seen)
    expected = [[10, 11, 0], [20, 21, 22], [0, 0, 32]]
    np.testing.assert_array_equal(record.measured[..., 0], expected)
    factors = [[1, 1, 1], [1, 1, 1], [1, 1, 4]]
    np.testing.assert_array_equal(record.noise_factor, factors)
    compared = [[False] * 3, [True, True, False], [False, False, True]]
    np.testing.assert_array_equal(record.compared, compared)


def test_a_slot_of_a_record_is_used_again_removed_and_kept_where_all_is_full():
    record = some_record()
    assert record.full

    @quick_jit
    def later(record):
        after = stepped(record, jnp.asarray(9.0), features([0, 1], [90.0, 91.0]), jnp.eye(1))
        again = removed(begun(record, features([0], [50.0])), jnp.array([False, True, False]))
        return after, again, record.cut(2)

    after, again, less = later(record)
    jax.tree.map(np.testing.assert_array_equal, after, record)
    assert again.first[0] == 2
    np.testing.assert_array_equal(again.seen[:, 0], [False, False, True])
    assert again.measured[2, 0, 0] == 50
    assert not again.seen[:, 1].any()
    np.testing.assert_array_equal(again.seen[:, 2], record.seen[:, 2])
    assert (less.frames, int(less.last), less.controls.shape) == (2, 1, (1,))
    np.testing.assert_array_equal(less.seen, record.seen[:2])
    np.testing.assert_array_equal(less.measured, record.measured[:2])


@quick_jit
def standing_then_moving():
    """Slots 0 and 1 since frame 0, slot 2 since the second frame in which nothing moved."""
    record = empty(pieces("standstill")["motion"], 4, 3, 1, jnp.float64)
    record = begun(record, features([0, 1], [10.0, 20.0]))
    records = []
    for there, new in [
        (features([0, 1], [11.0, 19.0]), features([2], [33.0], [False])),
        (features([0, 1], [9.0, 21.0]), features([2], [30.0])),
        (features([0, 2], [10.5, 30.5]), features([1], [0.0], [False])),
        (features([0, 2], [40.0, 60.0]), features([1], [0.0], [False])),
        (features([0, 2], [40.0, 60.0]), features([1], [0.0], [False])),
    ]:
        record = begun(stepped(record, jnp.asarray(0.1), there, jnp.eye(1)), new)
        records.append(record)
    unseen = features([0, 1], [11.0, 19.0], [False, False])
    return records, stepped(records[0], jnp.asarray(0.1), unseen, jnp.eye(1))


def test_while_nothing_moves_the_newest_frame_takes_the_place_of_the_one_before():
    """With the first motion the velocity is drawn anew; nothing seen is no rest."""
    (first, second, third, moved, after), unseen = standing_then_moving()
    for record in (first, second, third):
        assert record.standing
        assert record.last == 1
        assert not record.restarted.any()
    np.testing.assert_array_equal(second.measured[1, :2, 0], [9, 21])
    np.testing.assert_array_equal(third.seen[1], [True, False, True])
    np.testing.assert_array_equal(third.measured[1, [0, 2], 0], [10.5, 30.5])
    np.testing.assert_array_equal(third.first, [0, 0, 1])
    assert not moved.standing
    assert (moved.last, after.last) == (2, 3)
    for record in (moved, after):
        np.testing.assert_array_equal(record.restarted, [False, True, False])
    assert not unseen.standing


def test_a_measurement_has_its_own_noise():
    """Its residual is so much smaller; so is what its landmark's own numbers do, where it is the
    first; and pixels that are as uncertain as they have moved may stand."""
    slam, record, x, y = case(*SPACE)
    other = replace(record, noise_factor=record.noise_factor.at[3, 0].multiply(4.0))
    other = replace(other, noise_factor=other.noise_factor.at[FIRST[2], 2].multiply(4.0))

    @quick_jit
    def both(record, y):
        return residuals(slam, record, path(slam, record, x), y)

    p = slam.sensor.size
    expected = both(record, y.at[2, :p].multiply(2.0)).at[3, 0].divide(2.0)
    np.testing.assert_allclose(both(other, y), expected, rtol=1e-9, atol=1e-9)
    (first, *_), _ = standing_then_moving()
    moved = [19.0, 21.0]
    for factor, stands in (None, False), ([100.0, 1.0], True):
        seen = features([0, 1], moved, factor=factor)
        assert stepped(first, jnp.asarray(0.1), seen, jnp.eye(1)).standing == stands


def test_a_velocity_drawn_anew_does_not_depend_on_the_one_before():
    slam, record, x, _ = case(*SPACE)
    record = replace(record, restarted=record.restarted.at[1].set(True))
    layout = PathLayout.of(slam)
    own = slice(layout.whole + layout.step + layout.each, None)
    there = quick_jit(path)(slam, record, x)
    mean, root = slam.motion.start()
    drawn = mean + root @ x[own][: layout.start]
    np.testing.assert_allclose(there.motion[2], drawn, rtol=1e-12)
    step = there.frames.pose
    moved = jax.tree.map(lambda leaf: leaf[1], step).inverse() @ jax.tree.map(
        lambda leaf: leaf[2], step
    )
    np.testing.assert_allclose(moved.log(), drawn / 5, rtol=1e-9)
    other = quick_jit(path)(slam, record, x.at[: layout.start].add(1.0))
    np.testing.assert_array_equal(other.motion[2], there.motion[2])


def test_what_is_reduced_is_the_schur_complement_of_the_dense_problem():
    slam, record, x, y = case(*PLANE)
    x, y = x + 0.1, y - 0.1
    got = quick_jit(reduced)(slam, record, x, y)
    _, A, g = dense(slam, record, x, y)
    N = x.size
    coupling = np.linalg.solve(A[N:, N:], A[N:, :N])
    assert np.abs(A[:N, :N] - np.eye(N)).max() > 1
    close(got.information, A[:N, :N] - A[:N, N:] @ coupling, 1e-8)
    close(got.gradient, g[:N] - coupling.T @ g[N:], 1e-8)
    close(got.coupling.reshape(y.size, N), coupling, 1e-8)
    m, q = y.shape
    own = A[N:, N:].reshape(m, q, m, q)[np.arange(m), :, np.arange(m)]
    roots = np.asarray(got.landmarks.root)
    close(roots @ roots.transpose(0, 2, 1), own, 1e-8)


def test_a_reversed_start_goes_the_other_way_among_points_that_are_off_the_other_way():
    slam, record, x, y = case(*SPACE)
    back_x, back_y = modes.reversed_(slam, started(x, y))
    there, back = (quick_jit(path)(slam, record, of).frames.pose for of in (x, back_x))
    assert np.abs(there.translation()).max() > 0.1
    np.testing.assert_allclose(back.translation(), -there.translation(), atol=1e-12)
    np.testing.assert_allclose(back.rotation().as_matrix(), there.rotation().as_matrix())
    np.testing.assert_array_equal(back_y, y * np.array([1, 1, -1]))


def test_a_minimum_is_found_within_the_tolerance():
    """Of half the sum of squares, and in far fewer steps than are allowed."""
    slam, record, x, y = case(*PLANE)
    start = started(0.9 * x, y)
    found, _ = quick_jit(lambda record, start: minimised(slam, record, start, 60))(record, start)
    assert found.converged
    assert found.damping < 1
    assert found.cost - minimum(*PLANE).cost < 10 * minimise.TOLERANCE


def test_a_minimum_is_one_only_if_the_step_also_promised_little(monkeypatch):
    """In tolerances. A step that gained little of the much that it promised was too long."""
    slam, record, x, y = case()
    x, unit = 0 * x, jnp.eye(x.size)

    @quick_jit
    def taken(promised, gained):
        step = -jnp.sqrt(2 * promised * minimise.TOLERANCE) * unit[0]
        told = reduced(slam, record, x, y)._replace(information=unit, gradient=-step)
        now = replace(started(x, y), cost=jnp.ones(()), damping=jnp.zeros(()))
        cost = now.cost - 2 * gained * minimise.TOLERANCE - step @ step
        monkeypatch.setattr(minimise, "reduced", lambda *_: told)
        monkeypatch.setattr(minimise, "landmarks", lambda *_: (y, cost))
        return minimise._step(slam, record, now, told)[0], step

    for promised, gained, settled in (
        (4.0, 0.5, True), (6.0, 0.5, False), (4.0, 1.5, False), (4.0, -0.5, False),
    ):  # fmt: skip
        after, step = taken(promised, gained)
        assert after.converged == settled
        np.testing.assert_allclose(after.x, step if gained > 0 else x, rtol=1e-12)


def test_a_landmark_does_not_take_a_step_that_costs_more(monkeypatch):
    """Of `|y|²`: one whose information is told rightly, and one whose steps are ten times as long
    as they should be, until they are damped."""
    slam, record, x, _ = case()
    told, start = jnp.array([1.0, 0.1])[:, None, None], jnp.array([[3.0], [2.0]])
    monkeypatch.setattr(
        minimise, "landmark_slopes", lambda *of: (told, of[-1], jnp.sum(of[-1] ** 2, axis=1))
    )
    at = quick_jit(path)(slam, record, x)
    y, cost = minimise.landmarks(slam, record, at, start, 1)
    np.testing.assert_allclose(y, [[0.0], [2.0]], atol=1e-12)
    np.testing.assert_allclose(cost, 4.0)
    assert minimise.landmarks(slam, record, at, start, 9)[1] < 1


@pytest.mark.parametrize("of", [PLANE, SPACE], ids=["plane", "space"])
def test_scaling_changes_no_pixel_and_is_an_eigenvector_of_the_information_with_value_1(of):
    """And orthogonal to the gradient wherever that is zero. Without common errors it is the
    derivative of what is rescaled; with them the shortest of those that change no pixel."""
    slam, record, *_ = case(*of)
    at = minimum(*of)

    @quick_jit
    def enlarged(log_scale):
        x, y = rescaled(slam, record, at, log_scale)
        there = path(slam, record, x)
        return (x, y), residuals(slam, record, there, y), there.frames.pose.translation()

    (_, same, near), (_, other, far) = enlarged(0.0), enlarged(0.3)
    np.testing.assert_allclose(other, same, atol=1e-9)
    np.testing.assert_allclose(far, np.exp(0.3) * near, rtol=1e-9, atol=1e-12)
    s = quick_jit(scaling)(slam, record, at)
    both = np.append(s.x, s.y.ravel())
    np.testing.assert_allclose(s.squared, both @ both, rtol=1e-12)
    _, A, g = dense(slam, record, at.x, at.y)
    np.testing.assert_allclose(A @ both, both, atol=1e-6 * float(np.linalg.norm(both)))
    assert abs(g @ both) < 1e-5 * np.linalg.norm(both)
    assert g @ np.linalg.solve(A, g) < 1e-9  # what a Newton step would still gain
    if of is SPACE:
        for one, more, less in zip(s, enlarged(1e-5)[0], enlarged(-1e-5)[0], strict=False):
            np.testing.assert_allclose(one, (more - less) / 2e-5, atol=1e-7)
    else:  # what changes no depth: the common error up, and every own one down
        p, start = slam.sensor.size, PathLayout.of(slam).start
        free = s.x[start] - jnp.sum(s.y[:, p:]) * slam.depth.common
        assert abs(free) < 1e-9 < 1e-3 < abs(s.x[start])


def test_the_mean_is_shifted_by_the_volume_of_the_rest():
    """`½ d log det A/dλ`, against differences of it; the prior balances that at the shift."""
    slam, record, *_ = case(*PLANE)
    at = minimum(*PLANE)
    local, s = quick_jit(reduced)(slam, record, at.x, at.y), quick_jit(scaling)(slam, record, at)
    longer = quick_jit(partial(rescaled, slam, record, at))

    def half_log_det(log_scale):
        _, A, _ = dense(slam, record, *longer(log_scale))
        return np.linalg.slogdet(A)[1] / 2

    expected = (half_log_det(-1e-4) - half_log_det(1e-4)) / 2e-4
    factor = quick_jit(cholesky)(local.information)
    slope = quick_jit(partial(scale._slope_of_volume, slam))(local, s, factor)
    assert abs(expected) > 1e-2
    np.testing.assert_allclose(slope, expected, rtol=1e-4)
    by_x, by_y = quick_jit(variances)(local, factor.whitening)
    _, A, _ = dense(slam, record, at.x, at.y)
    inverse = np.diagonal(np.linalg.inv(A))
    np.testing.assert_allclose(np.append(by_x, by_y.ravel()), inverse, rtol=1e-7)
    shift = quick_jit(shift_of_scale)(slam, record, at, local, factor)
    assert 1e-3 < abs(shift) < scale.MOST_SHIFT

    def prior(log_scale):
        return sum(np.sum(np.square(u)) for u in longer(log_scale)) / 2

    np.testing.assert_allclose((prior(shift + 1e-4) - prior(shift - 1e-4)) / 2e-4, slope, rtol=1e-4)


def test_the_filters_state_is_the_gaussian_of_the_mode(monkeypatch):
    """Marginals in metres are those of the dense inverse; λ has the variance 1/|s|²."""
    monkeypatch.setattr(scale, "MOST_SHIFT", 0.0)
    slam, record, *_ = case(*PLANE)
    at = minimum(*PLANE)
    m, p = FIRST.size, slam.sensor.size

    @quick_jit
    def handed(at):
        first = Features(jnp.arange(m), record.measured[0], jnp.zeros(m, bool))
        state = gauge_state(slam, record, *mean(slam, record, at), slam.init(m, first))
        told = slam.marginal(state, lambda view: view.pose)
        points = slam.landmark_marginal(
            state, lambda view: jnp.append(view.point, view.omega) / view.point[-1], jnp.arange(m)
        )
        return state, told, points

    def of_window(u):
        x, y = u[: -m * (p + 1)], u[-m * (p + 1) :].reshape(m, p + 1)
        there = path(slam, record, x)
        return jax.tree.map(lambda leaf: leaf[record.last], there.frames.pose), bearings(there, y)

    def bearings(there, y):
        """Of the landmarks in the newest camera: bearing and inverse depth."""
        newest = jax.tree.map(lambda leaf: leaf[record.last], there.frames.pose)

        def one(first, measured, factor, y):
            begun = jax.tree.map(lambda leaf: leaf[first], there.frames)
            T = newest.inverse() @ begun.pose
            sensor = slam.calibration.sensor(slam.sensor, begun.calibration)
            depth = slam.depth
            common = 0.0 if depth.common is None else depth.common * there.common[0]
            omega = depth.mean + depth.sigma * (y[p:] + common)
            X, omega = sensor.locate(measured + jnp.sqrt(factor) * sensor.sigma * y[:p], omega)
            X = T.rotation() @ X + T.translation() * omega
            return jnp.append(X, omega) / X[-1]

        firsts = FIRST, jnp.arange(m)
        return jax.vmap(one)(FIRST, record.measured[firsts], record.noise_factor[firsts], y)

    state, (pose, covariance), (points, spread) = handed(at)
    u = jnp.append(at.x, at.y.ravel())
    J_pose, J_points = quick_jit(
        lambda u: (jacobian(lambda u: of_window(u)[0], u), jax.jacfwd(lambda u: of_window(u)[1])(u))
    )(u)
    expected_pose, expected_points = quick_jit(of_window)(u)
    _, A, _ = dense(slam, record, at.x, at.y)
    Sigma = np.linalg.inv(A)
    assert state.active.all()
    close(pose.inverse().log(), expected_pose.inverse().log(), 1e-6)
    close(covariance, J_pose @ Sigma @ J_pose.T, 1e-6)
    close(points, expected_points, 1e-6)
    close(spread, np.einsum("min,no,mjo->mij", J_points, Sigma, J_points), 1e-6)
    part = state.core.part("log_scale").start
    s = quick_jit(scaling)(slam, record, at)
    np.testing.assert_allclose(state.covariance[part, part], 1 / s.squared, rtol=1e-9)
    assert np.linalg.eigvalsh(state.covariance).min() > -1e-12


def test_the_evidence_of_a_mode_is_laplaces_with_every_unknown():
    """And of residuals whose variance is known up to a factor, of which none is left."""
    slam, record, *_ = case(*PLANE)
    at = minimum(*PLANE)
    start = jax.tree.map(lambda leaf: leaf[None], started(at.x, at.y))
    given = jax.tree.map(lambda leaf: leaf[0], modes._candidates(start, jnp.ones(1, int)))
    found = quick_jit(lambda *of: modes._minimum(slam, *of))(given, record)
    r, A, _ = dense(slam, record, at.x, at.y)
    pixels = np.asarray(residuals(slam, record, path(slam, record, at.x), at.y))
    w, n, a = (pixels**2).sum(), int(record.compared.sum()), modes.WORTH / 2
    variances = np.exp(np.linspace(-4, 4, 4001))  # by the claimed one
    of_each = -(n / 2 + a + 1) * np.log(variances) - (w / 2 + a) / variances
    most = of_each.max()
    marginal = most + np.log(np.trapezoid(np.exp(of_each - most), variances))
    certain = -(a + n / 2) * np.log(a) + gammaln(a + n / 2)  # where no residual is left
    expected = marginal - certain - (r @ r - w + np.linalg.slogdet(A)[1]) / 2
    np.testing.assert_allclose(found.evidence, expected, rtol=1e-6)


def test_what_a_minimum_gains_without_a_landmark_is_foretold():
    """By the least squares of all rows of the Jacobian but the landmark's."""
    slam, record, *_ = case(*PLANE)
    at = minimum(*PLANE)

    @quick_jit
    def foretold(record, at):
        local = reduced(slam, record, at.x, at.y)
        gains = left_out(slam, record, local, at.y, cholesky(local.information))
        return gains, modes._doubts(record, gains)

    gains, doubts = foretold(record, at)
    r, J = map(np.asarray, _dense(slam, record, at.x, at.y))
    (m, q), N = at.y.shape, at.x.size
    shape = FRAMES, m, slam.sensor.size
    for k in range(m):
        measured = np.broadcast_to(np.arange(m)[:, None] == k, shape).ravel()
        own = np.concatenate([np.zeros(N, bool), np.arange(m * q) // q == k])
        J_rest, r_rest = J[~np.append(own, measured)], r[~np.append(own, measured)]
        step, *_ = np.linalg.lstsq(J_rest, r_rest, rcond=None)
        left = r_rest - J_rest @ step
        np.testing.assert_allclose(gains[k], r @ r - left @ left, rtol=1e-5, atol=1e-6)
    dof = slam.sensor.size * np.asarray(record.compared).sum(axis=0)
    some = dof > 0
    exact = norm.isf(chi2.sf(np.asarray(gains)[some], dof[some]))
    np.testing.assert_allclose(np.asarray(doubts)[some], exact, atol=0.1)


def test_a_mode_that_is_next_to_impossible_is_none():
    """Of distinct minima those remain, as modes, whose evidence is not too far below the best."""
    costs = 2 * jnp.array([7.0, 0.0, 2 * modes.NEGLIGIBLE, 0.9 * modes.NEGLIGIBLE])
    at = jax.vmap(started)(10.0 * jnp.eye(4), jnp.zeros((4, 1, 3)))

    def weighed(now, record):
        return now._replace(evidence=-now.minimum.cost / 2, information=jnp.eye(4))

    @quick_jit
    def likeliest(record):
        candidates = modes._candidates(replace(at, cost=costs), jnp.ones(4, int))
        return modes._likeliest(weighed, record, candidates, jnp.ones(4, bool), 4)[0]

    found = likeliest(case()[1])
    weights = jax.nn.log_softmax(-costs / 2)[jnp.array([1, 0, 3])]
    np.testing.assert_allclose(found.log_weights, jnp.append(weights, -jnp.inf), rtol=1e-12)
    np.testing.assert_array_equal(found.minima.x[:3], at.x[jnp.array([1, 0, 3])])


@pytest.mark.parametrize(("better", "worse", "count"), [(0.25, 4.0, 1), (4.0, 0.25, 2)])
def test_minima_are_one_by_the_information_of_the_better(better, worse, count):
    """Two at the distance 1: less than one σ of the better, or two."""

    def weighed(now, record):
        told = jnp.where(now.minimum.cost == 0, better, worse) * jnp.eye(2)
        return now._replace(evidence=-now.minimum.cost / 2, information=told)

    @quick_jit
    def likeliest(record):
        at = jax.vmap(started)(jnp.array([[0.0, 0.0], [1.0, 0.0]]), jnp.zeros((2, 1, 3)))
        at = modes._candidates(replace(at, cost=jnp.array([2.0, 0.0])), jnp.ones(2, int))
        return modes._likeliest(weighed, record, at, jnp.ones(2, bool), 2)[0]

    assert np.isfinite(likeliest(case()[1]).log_weights).sum() == count


@pytest.mark.usefixtures("unchecked")
def test_the_covariance_of_the_metre_is_as_it_was():
    """It is behind that of λ, the first number of its part."""
    after, before = np.random.default_rng(0).normal(size=(2, 7, 7))
    like: Any = SimpleNamespace(
        core=SimpleNamespace(part=lambda name: {"log_scale": slice(3, 5)}[name]), covariance=before
    )
    expected = after.copy()
    expected[4, 4] = before[4, 4]
    np.testing.assert_array_equal(_with_metre(jnp.asarray(after), like), expected)
