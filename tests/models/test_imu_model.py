"""Tests of jaxslam.models.imu: readings integrated once, and what they make of a pose."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from cases import quick_jit
from logs import FALSE_ALARM
from scipy import stats
from scipy.spatial.transform import Rotation

from jaxslam.geometry import difference, exp, jacobian, log
from jaxslam.io.imu import InertialLog
from jaxslam.models.imu import Imu, increments
from jaxslam.models.motion import check_control
from jaxslam.simulation import scenario, simulate

RATES = np.array([0.4, -0.7, 0.3])
FORCE = np.array([0.5, -9.0, 1.5])
NOISE = jnp.asarray(np.random.default_rng(2).normal(size=18))


def readings(count, seconds=0.1, rng=None):
    """Of a turn and a force that change, in pieces of unequal length."""
    rng = rng or np.random.default_rng(0)
    share = rng.uniform(0.5, 1.5, count)
    t = np.linspace(0, 1, count)[:, None]
    turn = RATES + 0.5 * np.sin(5 * t + np.arange(3))
    force = FORCE + np.cos(4 * t + np.arange(3))
    return seconds * share / share.sum(), turn, force


@cache
def compiled():
    return quick_jit(increments)


def an_imu(**fields):
    turned = Rotation.from_euler("xyz", [0.3, -0.2, 1.4]).as_matrix()
    mounted = np.eye(4)
    mounted[:3] = np.column_stack([turned, [0.1, -0.05, 0.02]])
    given: dict[str, Any] = {
        "density": (2e-3, 3e-2),
        "walk": (1e-3, 2e-3),
        "camera_from_imu": mounted,
    }
    return Imu(**{**given, **fields})


def variables(imu):
    start = imu.start()[0]
    return replace(
        start,
        velocity=jnp.array([0.3, -0.2, 1.0]),
        gyroscope_bias=jnp.array([0.02, 0.01, -0.03]),
        accelerometer_bias=jnp.array([0.1, -0.2, 0.05]),
        down=jnp.array([0.2, 0.9, -0.3]),
    )


def test_a_constant_turn_and_force_are_integrated_to_what_is_known():
    """`ΔR = Exp(ω T)`, and Δv, Δp by the integrals of `Exp(ω t) f` as SciPy has them."""
    T, count = 0.8, 4000
    rates, forces = np.tile(RATES, (count, 1)), np.tile(FORCE, (count, 1))
    found = compiled()(np.full(count, T / count), rates, forces)
    np.testing.assert_allclose(
        found.turned.as_matrix(), Rotation.from_rotvec(RATES * T).as_matrix(), atol=1e-9
    )
    t = (np.arange(20000) + 0.5) * T / 20000
    forces = Rotation.from_rotvec(np.outer(t, RATES)).apply(FORCE)
    np.testing.assert_allclose(found.sped, forces.mean(axis=0) * T, rtol=1e-6)
    moved = ((T - t)[:, None] * forces).mean(axis=0) * T
    np.testing.assert_allclose(found.moved, moved, rtol=1e-6)
    np.testing.assert_allclose(found.seconds, T)


def test_readings_of_no_seconds_are_none():
    seconds, turn, force = readings(12)
    more = ((0, 2), (0, 0))
    padded = compiled()(np.append(seconds, [0, 0]), np.pad(turn, more), np.pad(force, more))
    plain = compiled()(seconds, turn, force)
    for x, y in zip(jax.tree.leaves(plain), jax.tree.leaves(padded), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-15)


def test_another_bias_changes_increments_as_they_say_to_second_order():
    seconds, turn, force = readings(20)
    off = np.array([0.01, -0.02, 0.015, 0.1, -0.3, 0.2])
    errors = []
    for size in (1.0, 0.5):
        there = compiled()(seconds, turn - size * off[:3], force - size * off[3:])
        here = compiled()(seconds, turn, force)
        by = here.by_bias @ (size * off)
        errors.append(
            np.concatenate([
                log(here.turned.inverse() @ there.turned) - by[:3],
                there.sped - here.sped - by[3:6],
                there.moved - here.moved - by[6:],
            ])
        )  # fmt: skip
        assert np.abs(errors[-1]).max() < 0.01 * np.abs(by).max()
    np.testing.assert_allclose(np.linalg.norm(errors[0]) / np.linalg.norm(errors[1]), 4, rtol=0.05)


@pytest.mark.parametrize("more", [0, 3])
def test_a_clock_that_is_ahead_shifts_the_step(more):
    """As the log's own readings between the shifted ends do, to second order; readings of no
    seconds behind the others change nothing."""
    t = np.linspace(0.0, 1.0, 1001)[:, None]
    turn, force = RATES + np.sin(9 * t + np.arange(3)), FORCE + np.cos(7 * t + np.arange(3))
    log_of = InertialLog(t[:, 0], turn, force, "imu.csv")

    def between(later):
        read = log_of.between(0.312 + later, 0.447 + later)
        return compiled()(*(np.pad(x, ((0, more), (0, 0))[: x.ndim]) for x in read))

    def change(h):
        ends = between(-h), between(h)
        of_turn = log(ends[0].turned.inverse() @ ends[1].turned)
        both = ((x.sped, x.moved) for x in ends)
        return np.concatenate([of_turn, *(b - a for a, b in zip(*both, strict=True))]) / (2 * h)

    np.testing.assert_allclose(between(0.0).by_clock, change(1e-4), atol=2e-2, rtol=2e-2)
    imu = an_imu(clock_sigma=[5e-3])
    for shift in (1e-3, -1e-3):
        now = replace(variables(imu), clock=jnp.array([shift]))
        told = imu.displacement(now, 0 * NOISE, between(0.0))
        true = imu.displacement(variables(imu), 0 * NOISE, between(shift))
        without = imu.displacement(variables(imu), 0 * NOISE, between(0.0))
        off = [np.linalg.norm(log(true.inverse() @ x)) for x in (told, without)]
        assert off[0] < 0.02 * off[1]


def test_the_noise_of_a_step_has_the_covariance_of_white_noise_in_every_reading():
    """Mean and slope, 12 numbers, are enough: the covariance of (ΔR, Δv, Δp) by the Jacobian of
    each reading, whose noise has σ²/h."""
    seconds, turn, force = readings(40)
    here = compiled()(seconds, turn, force)

    @quick_jit
    def by_readings(errors):
        there = increments(seconds, turn - errors[:, :3], force - errors[:, 3:])
        off = log(here.turned.inverse() @ there.turned)
        return jnp.concatenate([off, there.sped, there.moved])

    J = np.asarray(jax.jacfwd(by_readings)(jnp.zeros((40, 6))))
    density = np.array([2e-3] * 3 + [3e-2] * 3)
    exact = np.einsum("imk,jmk,m,k->ij", J, J, 1 / seconds, density**2)
    B = np.asarray(here.by_noise) * np.tile(density, 2)
    size = np.sqrt(np.diag(exact))
    np.testing.assert_allclose((B @ B.T - exact) / np.outer(size, size), 0, atol=2e-3)


def test_two_steps_are_the_step_of_all_readings():
    imu, (seconds, turn, force) = an_imu(), readings(24)
    state, still = variables(imu), jnp.zeros(18)
    at_bias = quick_jit(lambda *x: increments(*x, bias=state.bias))
    parts = [at_bias(seconds[i], turn[i], force[i]) for i in (slice(0, 12), slice(12, 24))]

    @quick_jit
    def after(state, control):
        return imu.displacement(state, still, control), imu.next(state, still, control)

    first, middle = after(state, parts[0])
    second, end = after(middle, parts[1])
    at_once, last = after(state, at_bias(seconds, turn, force))
    np.testing.assert_allclose((first @ second).as_matrix(), at_once.as_matrix(), atol=1e-13)
    np.testing.assert_allclose(difference(end, last), 0, atol=1e-12)


def test_a_unit_at_rest_reads_the_opposite_of_gravity_and_stays():
    """As it does of the control that is still."""
    imu, none = an_imu(), jnp.zeros(18)
    down = np.array([0.6, 0.0, -0.8])
    state = replace(imu.start()[0], down=jnp.asarray(down))
    resting = compiled()(np.full(10, 0.01), np.zeros((10, 3)), np.tile(-9.81 * down, (10, 1)))
    after = quick_jit(lambda of: (imu.displacement(state, none, of), imu.next(state, none, of)))
    for control in (resting, imu.still()):
        check_control(imu, control)
        step, later = after(control)
        np.testing.assert_allclose(step.as_matrix(), np.eye(4), atol=1e-14)
        np.testing.assert_allclose(difference(later, state), 0, atol=1e-13)
    with pytest.raises(ValueError, match="the control of Imu is Increments"):
        check_control(imu, jnp.asarray(0.1))


def test_the_camera_moves_as_it_is_mounted_on_the_unit():
    """And `T_CI ← T_CI Exp(δ)` where that is estimated; the length of `down` means nothing."""
    off = jnp.array([0.02, -0.01, 0.03, 0.1, -0.05, 0.08])
    estimated = an_imu(mount_sigma=(0.01,) * 3 + (0.02,) * 3)
    T_CI = np.asarray(estimated.camera_from_imu) @ exp(jaxlie.SE3, off).as_matrix()
    known, alone = an_imu(camera_from_imu=T_CI), an_imu(camera_from_imu=np.eye(4))
    control, state = compiled()(*readings(8)), variables(known)
    off_by = replace(state, mount=off)
    longer = replace(state, down=1.7 * state.down)

    @quick_jit
    def made():
        given = (alone, state), (known, state), (known, longer), (estimated, off_by)
        return [(i.displacement(x, NOISE, control), i.next(x, NOISE, control)) for i, x in given]

    (of_unit, _), (expected, plain), *others = made()
    by_hand = T_CI @ of_unit.as_matrix() @ np.linalg.inv(T_CI)
    for step, after in ((expected, plain), *others):
        np.testing.assert_allclose(step.as_matrix(), by_hand, atol=1e-13)
        np.testing.assert_allclose(after.velocity, plain.velocity, atol=1e-13)
    np.testing.assert_array_equal(others[1][1].mount, off)
    assert estimated.start()[1].shape == (18, 18)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("seconds", "gyroscope", "told"),
    [
        ([0.1, -0.1], np.zeros((2, 3)), "seconds must not be negative, not -0.1"),
        ([[0.1], [0.1]], np.zeros((2, 3)), r"seconds has shape \(2, 1\); it needs \(2,\)"),
        ([0.1, 0.1], np.zeros((3, 3)), r"gyroscope has shape \(3, 3\); it needs \(2, 3\)"),
    ],
)
def test_readings_that_make_no_sense_are_refused(seconds, gyroscope, told):
    with pytest.raises(ValueError, match=told):
        increments(seconds, gyroscope, np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"density": 0.1}, r"density of an Imu has shape \(\); it needs \(2,\)"),
        ({"bias": (0.0,) * 3}, r"bias of an Imu has shape \(3,\)"),
        ({"camera_from_imu": np.eye(3)}, r"camera_from_imu of an Imu has shape \(3, 3\)"),
    ],
)
def test_other_shapes_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        an_imu(**fields)


@pytest.mark.statistics
def test_what_is_told_of_the_start_is_off_by_its_sigma_and_readings_by_theirs():
    """In 300 runs: the start's errors, and those of the second step, whitened, are χ²."""
    world = scenario("imu", steps=2, readings=8, landmarks=2)
    imu = world.motion

    @quick_jit
    @jax.vmap
    def squared(key):
        run = simulate(world, key)
        assert run.motion is not None
        (state, root), none = run.motion.start(), jnp.zeros(18)
        first = jax.tree.map(lambda x: x[0], run.controls)

        def moved(state, noise):
            return imu.displacement(state, noise, first)

        J = jacobian(lambda x: moved(x, none), state) @ root
        G = jacobian(lambda noise: moved(state, noise), none) * imu.noise_sigma
        truth = jax.tree.map(lambda x: x[1], run.poses)
        e = difference(truth, moved(state, none))
        return e @ jnp.linalg.solve(J @ J.T + G @ G.T, e)

    found = np.asarray(squared(jax.random.split(jax.random.key(3), 300)))
    p = stats.chi2(6 * 300).cdf(found.sum())
    assert FALSE_ALARM / 2 < p < 1 - FALSE_ALARM / 2
