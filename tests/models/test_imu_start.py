"""Starts by the first readings of a unit: consistent, at rest and moving; what is no rest."""

import re
from dataclasses import replace

import jaxlie
import numpy as np
import pytest

from jaxslam.models.imu import Imu
from jaxslam.models.imu_start import STILL, at_rest, moving

UNIT = Imu((2e-3, 2e-2), walk=(1e-4, 1e-3), bias_sigma=(0.05, 0.2), bias=[0.01, 0, 0, 0, 0.1, 0])
COUNT, STEP = 200, 1 / 200
SECONDS = np.full(COUNT, STEP)
T = COUNT * STEP


def normal(draw, *shape):
    return draw.standard_normal(shape)


def read(draw, rates, forces, bias, unit=UNIT):
    """Readings with biases that walk, and the biases at the end."""
    walk = np.repeat(unit.walk, 3) * normal(draw, COUNT, 6) * np.sqrt(STEP)
    biases = bias + np.cumsum(walk, axis=0)
    white = np.repeat(unit.density, 3) * normal(draw, COUNT, 6) / np.sqrt(STEP)
    both = np.hstack([np.broadcast_to(x, (COUNT, 3)) for x in (rates, forces)])
    both = both + biases - walk / 2 + white
    return (SECONDS, both[:, :3], both[:, 3:]), biases[-1]


def squared(found, velocity, bias, down):
    """NEES, of which the length of `down` is no part."""
    error = np.concatenate([velocity - found.velocity, bias - found.bias, down - found.down])
    P = np.asarray(found.root) @ np.asarray(found.root).T
    sigma = np.sqrt(np.diag(P))
    values, vectors = np.linalg.eigh(P / np.outer(sigma, sigma))
    assert (values > 1e-9).sum() == 11
    return ((vectors.T @ (error / sigma))[1:] ** 2 / values[1:]).sum()


def drawn(draw):
    bias = np.asarray(UNIT.bias) + np.repeat(UNIT.bias_sigma, 3) * normal(draw, 6)
    down = normal(draw, 3)
    return bias, down / np.linalg.norm(down)


def resting(draw):
    bias, down = drawn(draw)
    readings, bias = read(draw, 0.0, -9.81 * down, bias)
    return squared(at_rest(UNIT, *readings), STILL * normal(draw, 3), bias, down)


def in_motion(draw):
    bias, down = drawn(draw)
    start, end = normal(draw, 2, 3)
    rate = 0.4 * normal(draw, 3)
    turned = [jaxlie.SO3.exp(rate * (k + 0.5) * STEP).inverse().as_matrix() for k in range(COUNT)]
    forces = np.stack(turned) @ ((end - start) / T - 9.81 * down)
    readings, _ = read(draw, rate, forces, bias)
    return squared(moving(UNIT, *readings), start, bias, down)


@pytest.mark.parametrize(("one", "runs"), [(resting, 100), (in_motion, 30)])
def test_a_start_is_consistent(one, runs):
    draw = np.random.default_rng(1)
    nees = [one(draw) for _ in range(runs)]
    assert abs(np.mean(nees) - 11) < 3.3 * np.sqrt(2 * 11 / runs)


def test_at_rest_the_direction_of_gravity_and_the_bias_are_one_unknown():
    """`b_a − g d` is known to its noise, each of the two a hundred times worse."""
    down = np.array([0.0, 0.6, 0.8])
    readings, _ = read(np.random.default_rng(2), 0.0, -9.81 * down, np.zeros(6))
    R = np.asarray(at_rest(UNIT, *readings).root)
    both = R[6:9] - 9.81 * R[9:]
    np.testing.assert_allclose(np.linalg.norm(both, axis=1), 2e-2, rtol=0.05)
    assert np.linalg.norm(R[6], axis=0) > 0.19  # across gravity
    assert np.linalg.norm(down @ R[6:9]) < 0.021  # along it


DOWN = np.array([0.0, 1.0, 0.0])
SHAKEN = 9.81 * (0.3 * np.sin(np.arange(COUNT))[:, None] * DOWN - DOWN)


@pytest.mark.parametrize(
    ("rates", "forces", "told"),
    [
        (0.3 * np.sin(np.arange(COUNT) / 20)[:, None] * DOWN, -9.81 * DOWN, "rates scatter as of"),
        (0.0, SHAKEN, "specific forces scatter as of a density of"),
        (0.4 * DOWN, -9.81 * DOWN, "its mean rate is off by 0.4 rad/s"),
        (0.0, -11.0 * DOWN, r"its mean force by 1\.[12]"),
    ],
)
def test_what_is_no_rest_is_refused(rates, forces, told):
    unit = replace(UNIT, bias=np.zeros(6))
    readings, _ = read(np.random.default_rng(3), rates, forces, np.zeros(6), unit)
    with pytest.raises(ValueError, match=f"the unit is not at rest: .*{told}") as refused:
        at_rest(unit, *readings)
    assert re.search(r"\d", str(refused.value))
