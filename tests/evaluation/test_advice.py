"""What to turn, of linear Kalman filters of which one number is wrong and known to us."""

import re

import numpy as np
import pytest

import jaxslam
from jaxslam.evaluation import advice, evaluate_log
from jaxslam.evaluation.result import neighbours_correlate

RUNS, STEPS = 200, 60
F, H = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[1.0, 0.0]])
Q, R, START = 0.05 * np.array([[1e-4 / 3, 5e-4], [5e-4, 1e-2]]) * 10, 0.04, np.diag([1.0, 1.0])


def filtered(q=1.0, r=1.0, p=1.0, bias=0.0):
    """NIS and NEES of position and speed, of which the position is measured; the filter takes the
    noises for so many times as large as they are. A bias of the measurement is unknown to it."""
    rng = np.random.default_rng(1)
    x = rng.multivariate_normal(np.zeros(2), START, RUNS)
    mean, P = np.zeros((RUNS, 2)), p * START
    errors, covariances, innovations, S_all = [], [], [], []
    for _ in range(STEPS):
        x = x @ F.T + rng.multivariate_normal(np.zeros(2), Q, RUNS)
        z = x @ H.T + bias + np.sqrt(R) * rng.normal(size=(RUNS, 1))
        mean, P = mean @ F.T, F @ P @ F.T + q * Q
        S = H @ P @ H.T + r * R
        K = P @ H.T / S
        innovation = z - mean @ H.T
        mean, P = mean + innovation @ K.T, P - K @ S @ K.T
        errors.append(x - mean)
        innovations.append(innovation)
        covariances.append(np.broadcast_to(P, (RUNS, 2, 2)))
        S_all.append(np.broadcast_to(S, (RUNS, 1, 1)))
    e, P, z, S = (np.stack(x, axis=1) for x in (errors, covariances, innovations, S_all))
    return jaxslam.evaluate(z, S, quantity="NIS"), jaxslam.evaluate(e, P)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"q": 1 / 16}, "S is too small, and the gain too small .* most likely Q too small"),
        ({"q": 16}, "S is too large, and the gain too large .* most likely Q too large"),
        ({"r": 1 / 4}, "S is too small, and the gain too large .* most likely R too small"),
        ({"r": 4}, "S is too large, and the gain too small .* most likely R too large"),
        ({"q": 0.25, "r": 0.25, "p": 0.25}, "S is too small: most likely Q and R, and P with them"),
        ({}, "NIS is right and innovations are white: Q and R fit each other; NEES is right too"),
    ],
)
def test_the_noise_that_is_wrong_is_named(wrong, told):
    nis, nees = filtered(**wrong)
    assert re.search(told, advice(nis, nees))


def test_what_innovations_cannot_see_is_no_noise():
    """A bias of all measurements is in every error and, once the filter follows it, in none of
    the innovations."""
    nis, nees = filtered()
    biased = filtered(bias=0.3)[1]
    assert biased.verdict["word"] == "over-confident"
    assert "NEES is too large all the same: look at the model" in advice(nis, biased)
    P = np.tile(START, (RUNS, STEPS, 1, 1))
    shy = jaxslam.evaluate(0.5 * nees.errors, P)
    assert "NEES is too small all the same" in advice(nis, shy)
    after = jaxslam.evaluate(0.5 * nis.errors, nis.sigmas[..., None] ** 2, quantity="NIS")
    assert "these are no innovations of it; log z − h(x) before the update" in advice(after, nees)


def test_white_innovations_of_few_steps_are_not_called_correlated():
    rng, one = np.random.default_rng(0), np.ones((1, 50, 1, 1))
    for _ in range(100):
        found = jaxslam.evaluate(rng.normal(size=(1, 50, 1)), one, quantity="NIS")
        rho = neighbours_correlate(found)
        assert rho is None or abs(rho) > 0.42


def test_a_log_beside_its_innovations_is_told_what_to_turn(tmp_path):
    """The sentence of docs/evaluate.md."""
    nis, nees = filtered(q=1 / 16)
    np.savez(tmp_path / "errors.npz", errors=nees.errors, sigmas=nees.sigmas)
    np.savez(tmp_path / "nis.npz", innovations=nis.errors, sigmas=nis.sigmas)
    found = evaluate_log(tmp_path / "errors.npz", innovations=tmp_path / "nis.npz")
    assert found.remarks[-1] == (
        "NIS 1.22, σ too small by 1.10 [1.07, 1.14] (of innovations); NIS says that S is too "
        "small, and the gain too small (innovations of neighbouring steps correlate by 0.20): most "
        "likely Q too small"
    )
    alone = evaluate_log(tmp_path / "nis.npz")
    assert alone.remarks[-1].endswith("most likely Q too small")
