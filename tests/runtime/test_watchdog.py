"""Nothing waits for ever: a dead-lock is cured where it was, and named where it still can be."""

import time
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import jaxslam
from jaxslam._numerics.arrays import is_number
from jaxslam._runtime import watchdog
from jaxslam._runtime.watchdog import lapack_calls
from jaxslam.consistency.backends import _filter_batch
from jaxslam.filters.linear.kalman import AbstractCorrection, kalman_update
from jaxslam.simulation import Room, simulate


def test_the_watchdog_barks_where_nothing_works_and_not_at_what_works(monkeypatch):
    """Slowly, but for longer than the patience; on a busy machine a process may get no time."""
    at_exit = []
    monkeypatch.setattr("time.process_time", time.monotonic)
    monkeypatch.setattr(watchdog, "LOOK_SECONDS", 0.02)
    monkeypatch.setattr("atexit.register", at_exit.append)
    slow = jax.jit(lambda x: jax.lax.fori_loop(0, 400, lambda _, x: jnp.sin(x @ x), x))
    array, began = slow(jnp.ones((400, 400))), time.monotonic()
    assert watchdog.finished({"a": array, "b": 1.0}, "sines", patience=0.2)["a"] is array
    assert time.monotonic() - began > 0.2
    monkeypatch.setattr("time.process_time", lambda: 0.0)
    with pytest.raises(watchdog.DeadlockError, match="sines stands still: no thread has worked"):
        watchdog.finished(slow(array), "sines", patience=0.1)
    assert at_exit == [watchdog._leave]


FILTERS = [
    "robocentric", "keyframe", "invariant", "recommended", "robocentric+iterated3",
    "world+particles", "world+rays", "robocentric+scene50", "scale_gauge+directions3",
    "scale_gauge+mixture3", "robocentric+oc", "world+fej",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "scenario"),
    [*((name, "circle") for name in FILTERS), ("scale_gauge+mixture3", "matched-6dof")],
)
def test_no_study_of_a_filter_calls_lapack(name, scenario):
    chosen = jaxslam.scenario(scenario, steps=2, landmarks=4)
    cartesian = "+particles" in name or "+rays" in name
    (slam,) = jaxslam.make_filters(
        chosen, [name], ["cartesian" if cartesian else "inverse_scaling"], "known"
    ).values()
    numbers, structure = eqx.partition(slam, is_number)
    runs = jax.vmap(partial(simulate, chosen))(jax.random.split(jax.random.key(0), 2))

    def batch(numbers, *args):
        return _filter_batch.function(eqx.combine(numbers, structure), Room(4, 4, 4, 4), *args)

    traced = jax.make_jaxpr(batch)(numbers, chosen.sensor, runs, 2)
    assert lapack_calls(traced.jaxpr) == set()


@pytest.mark.parametrize("function", [jnp.linalg.cholesky, jnp.linalg.inv, jnp.linalg.pinv])
def test_calls_of_lapack_are_found_however_deep(function):
    def sometimes(x, _):
        return jax.lax.cond(x[0, 0] > 0, function, lambda x: x, x), None

    def deep(x):
        return jax.lax.scan(sometimes, x, length=2)[0]

    traced = jax.make_jaxpr(jax.vmap(jax.jit(deep)))(jnp.ones((2, 3, 3)))
    assert lapack_calls(traced.jaxpr)


class ByLapack(AbstractCorrection):
    """A correction of a user's own."""

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        jnp.linalg.cholesky(state.covariance)
        return kalman_update(model, state, None, features, noise, context, considered)


@pytest.mark.slow
def test_a_filter_that_calls_lapack_is_warned_of():
    chosen = jaxslam.scenario("matched", steps=2, landmarks=4)
    made = jaxslam.make_filters(chosen, ["robocentric"], ["inverse_scaling"], "known")
    (base,) = made.values()
    with pytest.warns(UserWarning, match="calls LAPACK in a batch \\(cholesky"):
        jaxslam.monte_carlo(chosen, {"mine": replace(base, correction=ByLapack())}, runs=2)
