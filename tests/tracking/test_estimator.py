"""What the tracker makes of a prediction's joint covariance, against the filter's own update."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from additions import BiasedVelocity
from cases import quick_jit

pytest.importorskip("cv2")

from jaxslam.filters.association import candidates
from jaxslam.models.observations import Features
from jaxslam.tracking import estimator as programs
from jaxslam.tracking.matching import Matches
from jaxslam.tracking.observations import Observations
from jaxslam.tracking.settings import FIT, TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.tracker import Tracker

SMALL = TrackerSettings(filter="world", wanted=12, spare=4)


@pytest.fixture(scope="module")
def estimated():
    """Of a tracker, and its state after four frames."""
    source = synthetic_source(frames=4)
    tracker = Tracker(source.calibration, SMALL)
    for frame in source:
        tracker.track(frame)
    return tracker.estimator, tracker.map.state


def found(predicted, slots, aside, variances):
    """Matches of these slots, so many pixels from where they are expected."""
    count = len(slots)
    pixels = predicted.view.pixels[slots] + aside
    return Matches(np.arange(count), pixels, np.ones(count, np.float32), np.array(variances))


def test_matches_are_tested_as_innovations_of_the_filter_with_their_own_noise(estimated):
    estimator, state_before = estimated
    slots = np.array([0, 3, 3, 5])  # one landmark was found twice
    variances = np.array([0.0, 1.0, 2.0, 3.0]) * SMALL.pixel_sigma**2 / FIT
    aside = np.array([[0.1, 0.0], [0.2, -0.1], [2.0, 1.0], [0.0, 0.3]])
    with jax.enable_x64(True):
        predicted = estimator.predict(state_before, 1 / 30)
        matches = found(predicted, slots, aside, variances)
        residual, S, valid, _ = estimator.candidates(predicted, slots, matches, curved=False)
        factors = jnp.array([1.0, 1.0, 2.0, 3.0])
        features = Features(jnp.array(slots), jnp.array(matches.pixels), jnp.ones(4, bool), factors)
        tolerance = SMALL.tolerance * SMALL.pixel_sigma
        direct = quick_jit(
            lambda state, dt: candidates(estimator.slam, state, dt, features, tolerance)
        )(predicted.gaussian, predicted.control)
    np.testing.assert_allclose(residual, direct.residual, atol=1e-9)
    np.testing.assert_allclose(S, direct.covariance, rtol=1e-9, atol=1e-9)
    assert valid.all()


def test_what_is_expected_given_a_match_is_what_the_filter_expects_after_it(estimated):
    """To first order: of a match a hundredth of a pixel aside, as exactly as may be."""
    estimator, state_before = estimated
    slots, aside = np.array([1, 4]), np.array([[0.01, 0.0], [-0.005, 0.01]])
    variances = np.array([0.0, 4.0]) * SMALL.pixel_sigma**2 / FIT
    with jax.enable_x64(True):
        predicted = estimator.predict(state_before, 1 / 30)
        matches = found(predicted, slots, aside, variances)
        seen = Observations(
            slots,
            predicted.view.pixels[slots],
            predicted.view.covariances[slots],
            matches.pixels,
            variances,
            np.full(2, "matched"),
        )
        given = estimator.given(predicted, seen)
        features = Features(
            jnp.array(slots), jnp.array(matches.pixels), jnp.ones(2, bool), jnp.array([1.0, 4.0])
        )

        @quick_jit
        def expected_after(state, dt):
            state, _ = estimator.slam.update(state, dt, features)
            return estimator.slam.predict_features(state, dt, jnp.arange(SMALL.capacity))

        after = expected_after(predicted.gaussian, predicted.control)
    others = np.setdiff1d(np.flatnonzero(predicted.view.usable), slots)
    moved = given.pixels - predicted.view.pixels
    assert np.abs(moved[others]).max() > 1e-3
    np.testing.assert_allclose(
        moved[others], (after.measured - predicted.view.pixels)[others], atol=1e-5
    )
    np.testing.assert_allclose(
        given.covariances[others], after.covariance[others], rtol=1e-3, atol=1e-4
    )


def test_each_innovation_given_all_others_is_what_they_leave_of_it(estimated):
    """By the conditional Gaussian, one after the other."""
    estimator, state_before = estimated
    slots, aside = np.array([1, 4, 6]), np.array([[1.0, 0.0], [-0.5, 1.0], [0.3, -0.2]])
    variances = np.array([0.0, 4.0, 0.0]) * SMALL.pixel_sigma**2 / FIT
    with jax.enable_x64(True):
        predicted = estimator.predict(state_before, 1 / 30)
        pixels = predicted.view.pixels[slots] + aside
        prior = predicted.view.pixels[slots], predicted.view.covariances[slots]
        seen = Observations(slots, *prior, pixels, variances, np.full(3, "matched"))
        whitened = estimator.each_given_others(predicted, seen)
        S, r = estimator._innovations(predicted, seen)
    for k, one in enumerate(whitened):
        own, rest = np.arange(2 * k, 2 * k + 2), np.delete(np.arange(6), [2 * k, 2 * k + 1])
        gain = S[np.ix_(own, rest)] @ np.linalg.inv(S[np.ix_(rest, rest)])
        left, P = r[own] - gain @ r[rest], S[np.ix_(own, own)] - gain @ S[np.ix_(rest, own)]
        np.testing.assert_allclose(one @ one, left @ np.linalg.solve(P, left), rtol=1e-8)


def test_a_motion_that_computes_its_noise_is_predicted_as_it_is(estimated, monkeypatch):
    """One of one's own, which has no σ to make larger."""
    estimator, state = estimated
    motion = BiasedVelocity([1.0] * 6, [0.0] * 6, [0.5] * 6, [0.1] * 6)
    own, asked = replace(estimator.slam, motion=motion), []
    noted = lambda slam, *_: asked.append(slam.motion.noise_sigma)  # noqa: E731
    monkeypatch.setattr(programs, "_predict", noted)
    for slam, times in ((own, 1.0), (estimator.slam, 4.0)):
        with pytest.raises(TypeError):  # nothing is predicted here
            replace(estimator, slam=slam).predict(state, 1 / 30, 4.0)
        np.testing.assert_allclose(asked[-1], times * slam.motion.noise_sigma)
