"""Work is done where it is wanted and nowhere else, alone and in a batch, with the same result."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam._numerics import conditional as lazy
from jaxslam._numerics.conditional import at_places, cond, map_or_zero, map_where

BATCH, PLACES = 20, 5


def counted(found):
    """Doubles a value, and counts how often that is done."""

    def doubled(value, *given):
        jax.debug.callback(lambda _: found.append(1), value)
        return 2 * value + sum(given)

    return doubled


def done(value):
    jax.block_until_ready(value)
    jax.effects_barrier()
    return value


def drawn():
    """Values of a batch, which are alive, and a number for each of the batch."""
    keys = jax.random.split(jax.random.key(3), 3)
    values = {
        "x": jax.random.normal(keys[0], (BATCH, PLACES, 3)),
        "count": jnp.zeros((BATCH, PLACES), int),
    }
    alive = jax.random.bernoulli(keys[1], 0.3, (BATCH, PLACES))
    return values, alive, jax.random.normal(keys[2], (BATCH,))


def moved(value, by):
    return {"x": by * value["x"] + 1, "count": value["count"] + 1}


def check(after, values, alive, by):
    expected = jnp.where(alive[..., None], by[:, None, None] * values["x"] + 1, values["x"])
    np.testing.assert_allclose(after["x"], expected, rtol=1e-12)
    np.testing.assert_array_equal(after["count"], alive)


@pytest.mark.parametrize("wanted", [[False] * 3, [True, False, True]])
def test_what_nobody_in_a_batch_wants_is_not_done(wanted):
    found, values = [], jnp.arange(1.0, 4.0)
    after = jax.jit(jax.vmap(lambda w, v: cond(w, counted(found), v, jnp.asarray(0.5))))(
        jnp.array(wanted), values
    )
    done(after)
    np.testing.assert_array_equal(after, np.where(wanted, 2 * values + 0.5, values))
    assert bool(found) == any(wanted)


def test_only_the_living_are_worked_on():
    found, alive = [], jnp.array([True, False, False, True])
    values = jnp.arange(4.0)
    after = done(jax.jit(lambda alive: map_where(counted(found), values, alive))(alive))
    np.testing.assert_array_equal(after, jnp.where(alive, 2 * values, values))
    assert len(found) == 2


def test_a_batch_is_worked_on_in_blocks_of_those_alive_wherever_they_are():
    found, alive = (
        [],
        jnp.zeros((16, 4), bool).at[jnp.array([2, 7, 7]), jnp.array([0, 1, 3])].set(True),
    )
    values = jnp.arange(64.0).reshape(16, 4)
    after = done(jax.jit(jax.vmap(lambda v, a: map_where(counted(found), v, a)))(values, alive))
    np.testing.assert_array_equal(after, jnp.where(alive, 2 * values, values))
    assert len(found) == 16  # one block, and not 64


def test_a_batch_and_a_batch_of_batches_give_what_each_gives_alone(monkeypatch):
    """Also of a function that is closed over something of the batch."""

    def given(*of):
        return map_where(moved, *of)

    def closed(values, alive, by):
        return map_where(lambda value: moved(value, by), values, alive)

    def parts(*batch):
        split = jax.tree.map(lambda x: x.reshape(4, -1, *x.shape[1:]), batch)
        after = jax.vmap(jax.vmap(given))(*split)
        return jax.tree.map(lambda x: x.reshape(BATCH, *x.shape[2:]), after)

    values, alive, by = drawn()
    for least, function in (
        *((least, jax.vmap(given)) for least in (1, 8, 1000)),
        (8, lambda *batch: jax.lax.map(lambda of: given(*of), batch)),
        (8, jax.vmap(closed)),
        (8, parts),
    ):
        monkeypatch.setattr(lazy, "LEAST", least)
        check(jax.jit(function)(values, alive, by), values, alive, by)


@pytest.mark.parametrize("in_batch", [False, True])
def test_what_is_not_alive_is_zero(in_batch):
    """And read by nobody: what is there may be anything."""
    values, alive, by = drawn()
    sources = jnp.where(alive[..., None], values["x"], jnp.nan)

    def work(*given):
        return map_or_zero(lambda x, by: {"sum": by * jnp.sum(x), "x": x}, *given)

    each = jax.vmap(work) if in_batch else lambda *batch: jax.lax.map(lambda x: work(*x), batch)
    after = jax.jit(each)(sources, alive, by)
    x = jnp.where(alive[..., None], values["x"], 0)
    np.testing.assert_array_equal(after["x"], x)
    np.testing.assert_allclose(after["sum"], by[:, None] * x.sum(-1), rtol=1e-12)


@pytest.mark.parametrize("in_batch", [False, True])
def test_a_work_may_be_of_several_places(in_batch):
    """Two values change places, and what is added is read there."""
    values = jnp.arange(24.0).reshape(4, 6)
    places = jnp.array([[[0, 5], [1, 2]], [[3, 1], [4, 5]], [[0, 1], [2, 3]], [[5, 4], [3, 2]]])
    wanted = jnp.array([[True, False], [True, True], [False, False], [False, True]])

    def swapped(two, added, factor):
        return two[::-1] + factor * added

    def work(values, places, wanted):
        added = jnp.arange(6.0)
        return at_places(swapped, values, added, places, wanted, jnp.asarray(-100.0))

    each = jax.vmap(work) if in_batch else lambda *x: jnp.stack(list(map(work, *x)))
    after = np.asarray(each(values, places, wanted))
    expected = np.array(values)
    for run in range(4):
        for place, due in zip(np.asarray(places[run]), wanted[run], strict=True):
            if due:
                expected[run, place] = expected[run, place[::-1]] - 100 * place
    np.testing.assert_array_equal(after, expected)


def slope_in_both_modes(function, x, *given):
    """The derivative by a number, which is the same in both modes and by central differences."""
    forward, reverse = (jax.jit(by(function))(x, *given) for by in (jax.jacfwd, jax.grad))
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    h, value = 1e-6, jax.jit(function)
    central = (value(x + h, *given) - value(x - h, *given)) / (2 * h)
    np.testing.assert_allclose(reverse, central, rtol=1e-6)
    return reverse


def of_works(t, value, alive):
    """Of the logarithm, which has no derivative where nobody is alive."""
    value = jnp.where(alive, value, -1.0)
    return jnp.sum(map_where(lambda x, t: t * jnp.log(x * t), t * value, alive, t))


def test_both_modes_of_derivatives_alone_and_in_a_batch():
    values = jnp.arange(1.0, 13.0).reshape(3, 4)
    alive = values % 3 == 1

    def in_batch(t):
        return jnp.sum(jax.vmap(of_works, (None, 0, 0))(t, values, alive))

    each = [slope_in_both_modes(of_works, 2.0, *one) for one in zip(values, alive, strict=True)]
    np.testing.assert_allclose(slope_in_both_modes(in_batch, 2.0), sum(each), rtol=1e-9)
    by_one = jax.vmap(jax.grad(of_works), (None, 0, 0))
    np.testing.assert_allclose(jax.jit(by_one)(2.0, values, alive), jnp.stack(each), rtol=1e-9)


def test_what_has_only_a_forward_mode_says_so():
    def of(x):
        return lazy.forward_only(
            {"y": x**2, "count": jnp.arange(3)}, "this search has no reverse mode"
        )["y"]

    assert jax.jacfwd(of)(3.0) == 6
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.jacfwd(of)))(jnp.arange(2.0)), [0, 2])
    with pytest.raises(NotImplementedError, match="this search"):
        jax.grad(of)(3.0)
