"""Tests of jaxslam.filters.association: what each lets through and keeps, where matches err."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, close, quick_jit
from scipy.stats import chi2

from jaxslam.filters import association
from jaxslam.filters.association import ASSOCIATIONS, GATE, Candidates, candidates
from jaxslam.filters.gaussian import context_of
from jaxslam.filters.linear.covariance import curvature, local_covariance
from jaxslam.filters.mixture.split_merge import _root_of_cost
from jaxslam.filters.model import COMPOSED
from jaxslam.models.observations import Features
from jaxslam.models.sensors import Pinhole

SIGMA = 0.3
M = 20
compiled = {name: jax.jit(function) for name, function in ASSOCIATIONS.items()}


def covariance(rng, turn=15.0):
    """S of M landmarks seen by a camera that may have turned by so many pixels."""
    motion = rng.normal(size=(2 * M, 3)) * [turn, turn, 2.0]
    depth = np.zeros((2 * M, M))
    for i in range(M):
        depth[2 * i : 2 * i + 2, i] = 0.7 * rng.normal(size=2)
    return motion @ motion.T + depth @ depth.T + SIGMA**2 * np.eye(2 * M)


def found(rng, wrong=0.0, S=None):
    """Matches drawn from S, of which a share is anywhere in its ellipse; and which these are."""
    S = covariance(rng) if S is None else S
    r = (np.linalg.cholesky(S) @ rng.normal(size=2 * M)).reshape(M, 2)
    bad = rng.permutation(M) < wrong * M
    for i in np.flatnonzero(bad):
        own = S[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
        angle, radius = rng.uniform(0, 2 * np.pi), 3 * np.sqrt(rng.uniform())
        r[i] = np.linalg.cholesky(own) @ [radius * np.cos(angle), radius * np.sin(angle)]
    S = jnp.asarray(S.reshape(M, 2, M, 2))
    return Candidates(jnp.asarray(r), S, jnp.ones(M, bool), jnp.arange(M)), bad


def rates(name, wrong, runs=20):
    """Mean shares of right matches kept and of wrong ones let through."""
    rng = np.random.default_rng(0)
    kept, let = [], []
    for _ in range(runs):
        matches, bad = found(rng, wrong)
        believed = np.asarray(compiled[name](matches))
        kept.append(believed[~bad].mean())
        let.append(believed[bad].mean() if bad.any() else 0.0)
    return np.mean(kept), np.mean(let)


@pytest.mark.parametrize("name", ASSOCIATIONS)
def test_what_is_true_is_kept_and_what_is_not_valid_is_never_believed(name):
    assert rates(name, 0.0)[0] > 0.97
    matches, _ = found(np.random.default_rng(3))
    for valid in (jnp.arange(M) % 3 > 0, jnp.zeros(M, bool)):
        assert not np.any(compiled[name](matches._replace(valid=valid)) & ~valid)


@pytest.mark.parametrize(
    ("name", "kept", "let"),
    [("sequential", 0.95, (0, 0.05)), ("jcbb", 0.7, (0, 0.1)), ("individual", 0.9, (0.9, 1))],
)
def test_of_as_many_wrong_as_right_matches_the_wrong_ones_are_put_out(name, kept, let):
    """But not by their ellipses alone."""
    found_kept, found_let = rates(name, 0.5)
    assert found_kept > kept
    assert let[0] <= found_let <= let[1]


def jointly_compatible(matches, kept):
    index = np.flatnonzero(np.repeat(kept, 2))
    S = np.asarray(matches.covariance).reshape(2 * M, 2 * M)[np.ix_(index, index)]
    r = np.asarray(matches.residual).ravel()[index]
    return r @ np.linalg.solve(S, r) < chi2.ppf(GATE, len(index))


def test_joint_compatibility_finds_the_largest_set_there_is():
    """By trying all sets of eight matches."""
    rng = np.random.default_rng(6)
    for _ in range(5):
        matches, _ = found(rng, 0.4)
        valid = np.arange(M) < 8
        matches = matches._replace(valid=jnp.asarray(valid))
        alone = np.asarray(compiled["individual"](matches))
        sets = (np.array([k >> i & 1 for i in range(M)], bool) for k in range(1, 2**8))
        largest = max(
            s.sum() for s in sets if not (s & ~alone).any() and jointly_compatible(matches, s)
        )
        believed = np.asarray(compiled["jcbb"](matches))
        assert believed.sum() == largest
        assert jointly_compatible(matches, believed)


def test_ransac_rescues_what_only_all_of_low_innovation_together_explain():
    """Residuals are θ + d φ, φ at four of its σ. Eighteen matches of small d hardly feel φ and
    agree with one another. That of d = 10 fits none of them alone, but it fits them together, as
    they tell φ; and a match that is off by itself fits neither (Civera et al. 2010)."""
    d = np.append(np.tile([0.5, -0.5], 9), [10.0, 0.0])
    S = np.zeros((M, 2, M, 2))
    S[:, 0, :, 0] = 100.0**2 + np.outer(d, d) + np.eye(M)
    S[:, 1, :, 1] = np.eye(M)
    r = np.zeros((M, 2))
    r[:, 0] = 7.0 + 4.0 * d
    r[-1, 0] += 10.0
    matches = Candidates(jnp.asarray(r), jnp.asarray(S), jnp.ones(M, bool), jnp.arange(M))
    apart = np.asarray(association._distances_given_one(matches))
    assert (apart[:18, 18] > matches.gate).all()
    assert compiled["ransac"](matches).tolist() == [True] * 19 + [False]


def test_sequential_ends_with_matches_that_all_fit_the_others():
    """Each given all the others, by conditioning S itself."""
    matches, _ = found(np.random.default_rng(7), 0.4)
    believed = np.asarray(compiled["sequential"](matches))
    assert believed.sum() > 8
    S = np.asarray(matches.covariance).reshape(2 * M, 2 * M)
    r = np.asarray(matches.residual).ravel()
    for i in np.flatnonzero(believed):
        own = [2 * i, 2 * i + 1]
        others = np.setdiff1d(np.flatnonzero(np.repeat(believed, 2)), own)
        gain = np.linalg.solve(S[np.ix_(others, others)], S[np.ix_(others, own)]).T
        left = r[own] - gain @ r[others]
        C = S[np.ix_(own, own)] - gain @ S[np.ix_(others, own)]
        assert left @ np.linalg.solve(C, left) < chi2.ppf(GATE, 2)


def test_snooping_puts_out_the_one_that_does_not_fit_all_the_others():
    """By five of its σ given them, whether or not it fits its own ellipse."""
    matches, _ = found(np.random.default_rng(8))
    information = np.linalg.inv(np.asarray(matches.covariance).reshape(2 * M, 2 * M))
    given_others = np.linalg.inv(information[8:10, 8:10])
    residual = np.zeros((M, 2))
    residual[4] = np.linalg.cholesky(given_others) @ [5.0, 0.0]
    off = matches._replace(residual=jnp.asarray(residual))
    left = quick_jit(association._snooped)(off, jnp.ones(M, bool))
    assert np.flatnonzero(~left).tolist() == [4]


@cache
def matched():
    """A filter, the predicted state of its second frame, and the pixels of six landmarks there."""
    case = Case("matched-6dof", steps=1, landmarks=6)
    slam, control = case.filter("robocentric"), case.controls()[0]
    sigma = slam.motion.velocity_sigma.copy()
    sigma[4] = 0.5  # a turn to the side by 17 mrad, 11 pixels
    slam = replace(slam, motion=replace(slam.motion, velocity_sigma=sigma))

    def predicted(first):
        state = slam.predict(slam.init(case.capacity, first), control)
        return state, slam.predict_features(state, control, jnp.arange(6)).measured

    state, pixels = quick_jit(predicted)(case.frames(0)[0])
    return slam, state, control, pixels


def test_a_tolerance_is_noise_of_each_match_by_itself():
    slam, state, control, pixels = matched()
    seen = Features(jnp.arange(6), pixels + 1.0, jnp.ones(6, bool))
    seek = quick_jit(partial(candidates, slam))
    some, none = (seek(state, control, seen, tolerance) for tolerance in (0.7, 0.0))
    added = (some.covariance - none.covariance).reshape(12, 12)
    np.testing.assert_allclose(added, 0.49 * np.eye(12), atol=1e-9)
    np.testing.assert_array_equal(some.residual, none.residual)
    tolerances = jnp.arange(12.0).reshape(6, 2)
    each = seek(state, control, seen, tolerances)
    added = (each.covariance - none.covariance).reshape(12, 12)
    np.testing.assert_allclose(added, np.diag(np.arange(12.0) ** 2), atol=1e-9)


class Share(Pinhole):
    """A pixel whose σ is its first coordinate, of which the constant σ is the unit."""

    def noise_at(self, measured):
        return measured[0] ** 2 * self.noise


def test_a_split_counts_what_it_costs_in_the_noise_that_is_predicted():
    """Of the one landmark that is seen; the others' measurements are of no account."""
    slam, state, control, pixels = matched()
    state = quick_jit(lambda state: slam.compose(state, control))(state)
    seen = Features(jnp.arange(6), jnp.full_like(pixels, jnp.nan), jnp.arange(6) == 2)
    other = replace(slam, sensor=Share(slam.sensor.camera, slam.sensor.sigma))

    def run(state):
        return [_root_of_cost(one, state, seen) for one in (slam, other)]

    (constant, own), view = quick_jit(run)(state), slam.model.view(state.core, COMPOSED)
    there = slam.sensor.measure(*slam.model.camera_point(view, state.landmarks[2]))
    np.testing.assert_allclose(constant, own * there[0], rtol=1e-9)


def test_the_spread_of_a_curved_measurement_is_by_second_derivatives():
    """By a landmark's own numbers, of whose covariance `½ tr(H P H P)` is added."""
    slam, state, control, pixels = matched()
    at, k = context_of(slam, control), 2

    @quick_jit
    def run(state):
        context = slam.model.given(state.core, at)
        view = slam.model.view(state.core, context)
        by_own = jax.hessian(lambda landmark: slam.model.observe(view, landmark, context)[0])
        seen = Features(jnp.arange(6), pixels, jnp.ones(6, bool))
        more, less = (candidates(slam, state, control, seen, curved=x) for x in (True, False))
        added = more.covariance - less.covariance
        hessian, local = curvature(slam.model, state, jnp.arange(6), at)
        Q = local_covariance(state, local, jnp.arange(6))
        return hessian, Q, by_own(state.landmarks[k]), added

    hessian, Q, expected, added = run(state)
    c, d = state.core_dim, state.landmarks.shape[1]
    close(hessian[k][:, -d:, -d:], expected, 1e-9)
    own = slice(c + k * d, c + (k + 1) * d)
    np.testing.assert_allclose(Q[k][-d:, -d:], state.covariance[own, own], rtol=1e-9, atol=1e-15)
    spread = np.einsum("mpij,mjk,mqkl,mli->mpq", hessian, Q, hessian, Q) / 2
    expected = np.einsum("mn,mpq->mpnq", np.eye(6), spread)
    np.testing.assert_allclose(added, expected, rtol=1e-6, atol=1e-9 * spread.max())
