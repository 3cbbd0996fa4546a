"""Work that is done only where it is wanted, in a batch too.

In a batch `lax.cond` computes both sides for every member, and a `lax.while_loop` goes on for all
until the last has ended. Here those that want it are gathered from the whole batch and computed in
blocks, so that the work is that of those who want it.

A loop whose end is known only when it runs has no reverse mode. Where one differentiates, in either
mode, all works are therefore done, and those that are not wanted are of no effect.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NoReturn, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, Int, PyTree

Value = TypeVar("Value")

PARTS = 4
"""The number of blocks that a batch would fill, where each of it has at most one work. Where it
has many, a block has as many places as the batch: in small ones the compiler's products of matrices
are slow."""
LEAST = 8
"""Works in a block."""
# A slice: a gather is a larger program, and slower.
_row = partial(jax.lax.dynamic_index_in_dim, keepdims=False, allow_negative_indices=False)


def cond(
    wanted: Bool[Array, ""], function: Callable[..., Value], value: Value, *given: PyTree
) -> Value:
    """`function(value, *given)` if it is wanted, else the value."""
    one = jax.tree.map(lambda x: jnp.asarray(x)[None], value)
    return jax.tree.map(lambda x: x[0], map_where(function, one, wanted[None], *given))


def map_where(
    function: Callable[..., Value], values: Value, alive: Bool[Array, " k"], *given: PyTree
) -> Value:
    """`function(value, *given)` of every value that is alive; the others stay as they are.

    `values` is a pytree of arrays whose first axis is k; the function returns what it is given.
    """
    return _at_each(function, 0, values, None, alive, given)


def map_or_zero(
    function: Callable[..., Value], sources: PyTree, alive: Bool[Array, " k"], *given: PyTree
) -> Value:
    """`function(source, *given)` of every source that is alive, and zeros for the others."""
    one = jax.tree.map(lambda x: x[0], sources)
    none = zeros(jax.eval_shape(function, one, *given), alive.size)
    return _at_each(function, 1, none, sources, alive, given)


def _at_each(function, which: int, values, sources, alive, given):
    """The works of single places, each of its value (0) or of its source (1)."""

    def alone(*data):
        one = jax.tree.map(lambda x: x[0], data[which])
        return jax.tree.map(lambda x: x[None], function(one, *data[2]))

    return at_places(alone, values, sources, jnp.arange(alive.size)[:, None], alive, given)


def zeros(shapes: PyTree, k: int) -> PyTree:
    """A batch of k zeros of these shapes."""
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

    def each(values, sources, places, wanted, shared):
        @jax.checkpoint
        def one(work):
            place, wanted = work
            rows = jax.tree.map(lambda x: x[place], (values, sources))
            return _where(wanted, call, rows[0], rows, shared)

        after = jax.lax.map(one, (places, wanted))
        due = jnp.where(wanted[:, None], places, jnp.iinfo(places.dtype).max)
        return jax.tree.map(lambda x, new: x.at[due].set(new, mode="drop"), values, after)

    @custom_vmap
    def work(values, sources, places, wanted, shared):
        def one(k, values):
            place = tuple(_row(places, k))
            rows = jax.tree.map(lambda x: jnp.stack([_row(x, i) for i in place]), (values, sources))
            after = jax.lax.cond(_row(wanted, k), call, lambda rows, _: rows[0], rows, shared)
            return jax.tree.map(partial(_with_rows, place), values, after)

        last = jnp.max(jnp.where(wanted, jnp.arange(1, wanted.size + 1), 0))
        return jax.lax.fori_loop(0, last, one, values)

    @work.def_vmap
    def in_batch(size, batched, *data):
        def one(is_batched, x):
            return x if is_batched else jnp.broadcast_to(x, (size, *jnp.shape(x)))

        spread = jax.tree.map(one, tuple(batched[:-1]), data[:-1])
        after = _in_blocks(call, *spread, data[-1], batched[-1])
        return after, jax.tree.map(lambda _: True, after)

    done = jax.custom_jvp(lambda *data: work(*data))
    done.defjvp(partial(jax.jvp, each))
    return done(values, sources, places, wanted, (arrays, given))


def forward_only(value: Value, why: str) -> Value:
    """The value itself, of which reverse mode raises NotImplementedError with this reason."""

    def one(x):
        return forward_only_p.bind(x, why=why) if jnp.issubdtype(x.dtype, jnp.inexact) else x

    return jax.tree.map(one, value)


def _refused(_, __, why: str) -> NoReturn:
    raise NotImplementedError(why)


forward_only_p = Primitive("forward_only")
forward_only_p.def_impl(lambda x, why: x)
forward_only_p.def_abstract_eval(lambda x, why: x)
mlir.register_lowering(forward_only_p, lambda ctx, x, why: [x])
batching.defvectorized(forward_only_p)
ad.deflinear2(forward_only_p, _refused)


def _where(wanted: Bool[Array, ""], function: Callable[..., Value], value: Value, *given) -> Value:
    """`function(*given)` if it is wanted, else the value: both are computed, as in a batch.

    The function's derivative may be NaN where it is not wanted: there it is of nothing.
    """

    def chosen(x, other):
        return jnp.where(wanted, x, other)

    held = jax.tree.map(lambda x: chosen(x, jnp.zeros_like(x)), given)
    return jax.tree.map(chosen, function(*held), value)


def _with_rows(places: tuple[Int[Array, ""], ...], x: Array, rows: Array) -> Array:
    for i, row in zip(places, rows, strict=True):
        x = jax.lax.dynamic_update_index_in_dim(x, row, i, 0, allow_negative_indices=False)
    return x


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
