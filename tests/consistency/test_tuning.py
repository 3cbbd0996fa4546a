"""Noise and other numbers of a filter, found by the likelihood of its innovations."""

import json
from dataclasses import replace
from operator import itemgetter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxslam
from jaxslam.consistency import draw, fit_of, log_likelihood, of_simulation
from jaxslam.consistency.tuning import (
    NOISE,
    TuningSettings,
    _outliers,
    _records,
    _Search,
    _whiteness,
)
from jaxslam.models.observations import Features, Innovation

MOTION = jaxslam.Odometry([0.02, 0.03, 0.01])
SENSOR = jaxslam.RangeBearing([0.1, 0.02])
LOGS, STEPS = 4, 40


@pytest.fixture(scope="module")
def simulated():
    posts = jaxslam.Ring(landmarks=4, radius=8.0)
    return draw(jaxslam.World(MOTION, SENSOR, posts, steps=STEPS, rate=10.0), LOGS + 1)


@pytest.fixture(scope="module")
def logs(simulated):
    room, runs = simulated
    each = (jax.tree.map(itemgetter(i), runs) for i in range(LOGS + 1))
    return [of_simulation(room, one) for one in each]


def slam(motion=MOTION, sensor=SENSOR, **pieces):
    return jaxslam.Slam(motion, sensor, jaxslam.Cartesian(), **pieces)


@pytest.fixture(scope="module")
def tuned(logs):
    """Of a filter of which every σ is wrong by factors of 2 to 2.5."""
    wrong = slam(jaxslam.Odometry([0.04, 0.015, 0.02]), jaxslam.RangeBearing([0.25, 0.01]))
    return jaxslam.tune(wrong, logs[:LOGS], held_out=logs[LOGS:])


def test_every_wrong_noise_is_found_within_its_sigma(tuned):
    assert tuned.converged
    truth = {"motion.noise_sigma": MOTION.noise_sigma, "sensor.sigma": SENSOR.sigma}
    for name, values in truth.items():
        off = (tuned.found[name] - values) / tuned.sigma[name]
        assert np.all(np.abs(off) < 3.5), name
        assert np.all(tuned.sigma[name] < 0.25 * np.array(values)), name
    assert tuned.word == "noise"
    told = str(tuned)
    assert told.startswith("The noise below explains the innovations")
    assert "motion.noise_sigma[2]" in told
    assert json.loads(json.dumps(tuned.to_dict()))["word"] == "noise"


def test_the_tuned_filter_is_right_where_the_given_one_was_not(tuned):
    before, after = tuned.held_out
    assert before.nis > 1.5
    assert after.nis == pytest.approx(1, abs=0.2)
    assert tuned.before.nees > 2 * tuned.after.nees
    assert tuned.after.log_likelihood > tuned.before.log_likelihood + 100
    np.testing.assert_array_equal(tuned.slam.sensor.sigma, tuned.found["sensor.sigma"])


def test_a_bias_that_no_noise_explains_is_a_wrong_model(tuned, logs):
    """The odometry turns by 0.05 rad too little in every step; its σ is as large."""

    def turned(log):
        control = log.frames.control - jnp.array([0, 0, 0.05])
        return replace(log, frames=log.frames._replace(control=control))

    noisy = jaxslam.cast(slam(jaxslam.Odometry([0.02, 0.03, 0.05])), jnp.float64)
    found = replace(tuned, after=fit_of(noisy, [turned(log) for log in logs[:LOGS]]))
    assert found.word == "model"
    assert "No noise explains" in str(found)


def test_a_sigma_of_zero_stays_bounds_hold_and_a_prior_costs():
    start = slam(jaxslam.Odometry([0.02, 0.0, 0.01]))
    bounds, priors = {"sensor.sigma": (0.01, 0.5)}, {"motion.noise_sigma": (0.02, 2)}
    search = _Search.of(start, NOISE, bounds, priors, TuningSettings())
    np.testing.assert_allclose(search.values(search.first)["motion.noise_sigma"], [0.02, 0, 0.01])
    np.testing.assert_allclose(search.values(search.first)["sensor.sigma"], [0.1, 0.02])
    far = search.values(search.first + np.array([0, 9, 0, 99, -99]))
    assert far["motion.noise_sigma"][1] == 0
    np.testing.assert_allclose(far["sensor.sigma"], [0.5, 0.01], rtol=1e-6)
    # In the middle between bounds a σ is that of its logarithm; near one there is none.
    sigma = search.sigmas(search.first + np.array([0, 0, 0, 99, 0]), 100 * np.eye(5))
    assert sigma["motion.noise_sigma"] == pytest.approx([0.002, 0, 0.001], rel=0.01)
    assert np.isnan(sigma["sensor.sigma"]).tolist() == [True, False]
    # Half of a factor of two is one σ of the prior.
    cost = search.prior_cost(search.first)
    assert cost == pytest.approx(0.5 + (np.log(0.02) / np.log(2)) ** 2 / 2, rel=1e-3)


@pytest.mark.usefixtures("unchecked")
def test_a_number_that_is_left_out_costs_as_one_of_so_many_sigma():
    """`½ (outlier² + log det S / dof)`: two of three landmarks are used, of two numbers each."""
    used, numbers = jnp.array([True, True, False]), jnp.zeros((3, 2))
    nis, status, log_det = jnp.asarray(5.0), jnp.asarray(0), jnp.asarray(-8.0)
    innovation = Innovation(numbers, numbers, None, used, nis, status, log_det)
    seen = Features(jnp.arange(3), numbers, jnp.ones(3, bool))
    found = _records(innovation, jaxslam.Frames(None, seen, seen))
    assert (found.cost, found.log_det, found.nis, found.dof, found.left_out) == (-1.5, -8, 5, 4, 2)
    assert _outliers(found, TuningSettings(outlier=3.0)) == ((9 - 8 / 4) / 2, 6.0)


@pytest.mark.usefixtures("unchecked")
def test_a_mean_of_one_landmark_alone_is_seen():
    """Where neighbours hardly correlate: of 0.3 σ in one of six slots."""
    white = np.random.default_rng(0).normal(size=(300, 6, 2))
    (_, _, right), found = _whiteness([white]), _whiteness([white + 0.3 * np.eye(6)[0, :, None]])
    correlation, mean, p = np.abs(np.array(found, float))
    assert float(right or 0) > 0.01
    assert correlation < 0.05
    assert p < 1e-3
    assert mean < 0.12


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (["sensor.sgima"], {}, "number of the filter 'sensor.sgima' (did you mean sensor.sigma"),
        (["depth.mean"], {}, "depth.mean is no σ: it needs bounds, or a prior"),
        (["sensor.sigma"], {"bounds": {"motion.noise_sigma": (1, 2)}}, "bounds of what is not"),
        (["sensor.sigma"], {"bounds": {"sensor.sigma": (2, 1)}}, "a least and a greatest"),
        (["sensor.sigma"], {"bounds": {"sensor.sigma": (1, 2)}}, "outside its bounds"),
        (["sensor.sigma"], {"logs": []}, "logs as `measured_run` makes them, at least one"),
        (["sensor.sigma"], {"logs": ["log"]}, "logs as `measured_run` makes them, at least one"),
        (["sensor.sigma"], {"logs": TuningSettings()}, "logs as `measured_run` makes them, at"),
    ],
)  # fmt: skip
def test_what_cannot_be_tuned_is_refused(logs, names, options, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        jaxslam.tune(slam(), **({"logs": logs[:1], "names": names} | options))


def test_a_log_in_frames_gives_the_likelihood_of_its_simulation(simulated):
    room, runs = simulated
    simulated_run = jax.tree.map(lambda x: x[0], runs)
    frame, landmark = np.nonzero(np.asarray(simulated_run.visible))
    measured = np.asarray(simulated_run.measured)[frame, landmark]
    # Landmarks may have any numbers, and measurements any order.
    order = np.random.default_rng(0).permutation(len(frame))
    log = jaxslam.measured_run(
        simulated_run.controls, frame[order], 100 - landmark[order], measured[order]
    )
    found = fit_of(slam(), [log]).log_likelihood
    np.testing.assert_allclose(found, log_likelihood(slam(), room, simulated_run), rtol=1e-9)


def test_known_landmarks_are_seen_in_frame_0_already_and_never_new():
    points = np.array([[1.0, 5.0], [-1.0, 6.0]])
    known = jaxslam.PriorMap(np.array([7, 3]), points, 0.01 * np.eye(4))
    at = np.array([[5.1, 0.2], [6.1, -0.17], [4.0, 0.0], [4.1, 0.01]])
    log = jaxslam.measured_run(np.zeros((2, 3)), np.ones(4, int), np.array([3, 7, 5, 5]), at, known)
    assert log.capacity == jaxslam.Capacity(3, 2, 1)
    assert log.known is not None
    np.testing.assert_array_equal(log.known.slots, [2, 0])
    np.testing.assert_array_equal(log.frames.seen.slots[0], [0, 2])
    np.testing.assert_array_equal(log.frames.new.measured[0], at[2:3])
    assert log.frames.seen.valid.sum() == 2


@pytest.mark.usefixtures("unchecked")
def test_measurements_that_do_not_go_together_are_refused():
    with pytest.raises(ValueError, match="one entry of each measurement, not 2, 1 and 2"):
        jaxslam.measured_run(np.zeros((2, 3)), [0, 1], [1], np.zeros((2, 2)))
    with pytest.raises(ValueError, match="frames are those before and after 2 controls, 0 to 2"):
        jaxslam.measured_run(np.zeros((2, 3)), [0, 3], [1, 1], np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"frame holds whole numbers, not \[0.0, 0.5\]"):
        jaxslam.measured_run([[0, 0, 0], [0, 0, 0]], [0, 0.5], [1, 1], np.zeros((2, 2)))
    with pytest.raises(ValueError, match="measured holds nan"):
        jaxslam.measured_run([[0, 0, 0], [0, 0, 0]], [0, 1], [1, 1], np.full((2, 2), np.nan))
    with pytest.raises(ValueError, match="control holds nan"):
        jaxslam.measured_run([[0, 0, 0], [0, 0, np.nan]], [0, 1], [1, 1], np.zeros((2, 2)))


@pytest.mark.slow  # a gate that shrinks σ to leave out more
def test_what_a_gate_leaves_out_costs_so_that_noise_does_not_shrink(logs):
    """One measurement in ten is of another landmark: with its cost the σ of the rest is found."""
    draw_ = np.random.default_rng(3)
    spoilt = []
    for log in logs[:LOGS]:
        seen = log.frames.seen
        bad = draw_.random(seen.valid.shape) < 0.1
        measured = np.where(bad[..., None], np.add(seen.measured, [3.0, 1.0]), seen.measured)
        seen = replace(seen, measured=jnp.asarray(measured))
        spoilt.append(replace(log, frames=log.frames._replace(seen=seen)))
    gated = slam(sensor=jaxslam.RangeBearing([0.2, 0.04]), gate=jaxslam.Gate(tolerance=0.5))
    found = jaxslam.tune(gated, spoilt, ["sensor.sigma"])
    assert found.found["sensor.sigma"] == pytest.approx([0.1, 0.02], rel=0.25)
    assert 0.05 < found.after.left_out < 0.2
