"""Work that is done only where it is wanted, in a batch too.

In a batch `lax.cond` computes both sides for every member, and a `lax.while_loop` goes on for all
until the last has ended. Here those that want it are gathered from the whole batch and computed in
blocks, so that the work is that of those who want it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Int, PyTree

Value = TypeVar("Value")

PARTS = 4
"""Of a batch, in a block, where each of the batch has one work at the most. Where it has many,
a block has as many places as the batch: in small ones the compiler's products of matrices are
slow."""
LEAST = 8
"""Works in a block."""


def cond(
    wanted: Bool[Array, ""], function: Callable[..., Value], value: Value, *given: PyTree
) -> Value:
    """`function(value, *given)` if it is wanted, else the value."""
    one = jax.tree.map(lambda x: jnp.asarray(x)[None], value)
    after = map_where(function, one, wanted[None], *given)
    return jax.tree.map(lambda x: x[0], after)


def map_where(
    function: Callable[..., Value], values: Value, alive: Bool[Array, " k"], *given: PyTree
) -> Value:
    """`function(value, *given)` of every value that is alive; the others stay as they are.

    `values` is a pytree of arrays whose first axis is k; the function returns what it is given.
    """

    def alone(values, _, given):
        one = jax.tree.map(lambda x: x[0], values)
        return jax.tree.map(lambda x: x[None], function(one, *given))

    return at_places(alone, values, None, jnp.arange(alive.size)[:, None], alive, given)


def map_or_zero(
    function: Callable[..., Value], sources: PyTree, alive: Bool[Array, " k"], *given: PyTree
) -> Value:
    """`function(source, *given)` of every source that is alive, and zeros for the others."""

    def alone(_, sources, given):
        one = jax.tree.map(lambda x: x[0], sources)
        return jax.tree.map(lambda x: x[None], function(one, *given))

    one = jax.tree.map(lambda x: x[0], sources)
    none = zeros(jax.eval_shape(function, one, *given), alive.size)
    return at_places(alone, none, sources, jnp.arange(alive.size)[:, None], alive, given)


def zeros(shapes: PyTree, k: int) -> PyTree:
    """So many of what has these shapes."""
    return jax.tree.map(lambda x: jnp.zeros((k, *x.shape), x.dtype), shapes)


def at_places(
    function: Callable[[Value, PyTree, PyTree], Value],
    values: Value,
    sources: PyTree,
    places: Int[Array, "w r"],
    wanted: Bool[Array, " w"],
    given: PyTree,
) -> Value:
    """The values after each of w works that is wanted.

    `values` and `sources` are pytrees of arrays of one first axis. A work takes the r values in its
    places to what is there afterwards, `function(those, the sources there, given)`. No two works
    have one place.
    """
    r = places.shape[1]
    both = values, sources
    rows = jax.tree.map(lambda x: jax.ShapeDtypeStruct((r, *x.shape[1:]), x.dtype), both)
    closed = eqx.filter_closure_convert(function, *rows, given)
    arrays, static = eqx.partition(closed, eqx.is_array)

    def call(rows, shared):
        arrays, given = shared
        return eqx.combine(arrays, static)(*rows, given)

    @custom_vmap
    def work(values, sources, places, wanted, shared):
        first = jnp.argsort(~wanted) if wanted.size > 1 else jnp.zeros(1, int)

        def one(k, values):
            place = places[first[k]]
            rows = jax.tree.map(partial(_rows, place), (values, sources))
            return jax.tree.map(partial(_with_rows, place), values, call(rows, shared))

        return jax.lax.fori_loop(0, jnp.sum(wanted), one, values)

    @work.def_vmap
    def in_batch(size, batched, *data):
        spread = _spread(size, tuple(batched[:-1]), data[:-1])
        after = _in_blocks(call, *spread, data[-1], batched[-1])
        return after, jax.tree.map(lambda _: True, after)

    return work(values, sources, places, wanted, (arrays, given))


def _rows(place: Int[Array, " r"], x: Array) -> Array:
    """Rows of an array; a single one as a slice, a much smaller program than a gather."""
    if place.size == 1:
        return jax.lax.dynamic_slice_in_dim(x, place[0], 1, allow_negative_indices=False)
    return x[place]


def _with_rows(place: Int[Array, " r"], x: Array, rows: Array) -> Array:
    """The array with other rows."""
    if place.size == 1:
        return jax.lax.dynamic_update_slice_in_dim(
            x, rows, place[0], 0, allow_negative_indices=False
        )
    return x.at[place].set(rows)


def _spread(size: int, batched: PyTree, values: PyTree) -> PyTree:
    """A batch of so many of all of them."""

    def one(is_batched, x):
        return x if is_batched else jnp.broadcast_to(x, (size, *jnp.shape(x)))

    return jax.tree.map(one, batched, values)


def _in_blocks(
    call: Callable[..., PyTree],
    values: PyTree,
    sources: PyTree,
    places: Int[Array, "b w r"],
    wanted: Bool[Array, "b w"],
    shared: PyTree,
    batched: PyTree,
) -> PyTree:
    """Compute what is wanted of a batch b, wherever it is, block by block."""
    b, w = wanted.shape
    k = jax.tree.leaves(values)[0].shape[1]
    size = min(b * w, max(LEAST, b * min(w, PARTS) // (PARTS * places.shape[-1])))
    count = jnp.sum(wanted)
    works = jnp.flatnonzero(wanted, size=b * w + size, fill_value=b * w)
    places = (places + k * jnp.arange(b)[:, None, None]).reshape(b * w, -1)
    flat, read = jax.tree.map(lambda x: x.reshape(b * k, *x.shape[2:]), (values, sources))
    axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)

    def block(carry):
        done, flat = carry
        work = jax.lax.dynamic_slice(works, (done,), (size,))
        place = places[work]
        rows = jax.tree.map(lambda x: x[place], (flat, read))
        own = jax.tree.map(lambda each, x: x[work // w] if each else x, batched, shared)
        after = jax.vmap(call, in_axes=(0, axes))(rows, own)
        place = jnp.where((work < b * w)[:, None], place, b * k)
        flat = jax.tree.map(lambda x, new: x.at[place].set(new, mode="drop"), flat, after)
        return done + size, flat

    start = jnp.zeros((), works.dtype), flat
    flat = jax.lax.while_loop(lambda carry: carry[0] < count, block, start)[1]
    return jax.tree.map(lambda x, old: x.reshape(old.shape), flat, values)
