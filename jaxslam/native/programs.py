"""The programs of one function, compiled once for each structure of what it is given, and kept."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial

import equinox as eqx
import jax
import numpy as np
from jaxtyping import ArrayLike, Bool, PyTree

from jaxslam._numerics.arrays import is_number
from jaxslam._numerics.tracing import free_gathers
from jaxslam._runtime.programs import Made
from jaxslam.native import batch


class NativePrograms:
    """`jax.vmap(partial(function, fixed, given))(runs)` for any `fixed`, `given` and runs.

    Of what is given arrays and floating-point numbers are data, and everything else, as all that is
    fixed, is part of the program, and is the same only by type and bits (`exactly`).
    """

    def __init__(self, function: Callable[[PyTree, PyTree, PyTree], PyTree]) -> None:
        self._function = function
        self._made: Made[Callable[..., PyTree]] = Made()
        self._traced: Made[Callable[..., PyTree]] = Made()
        self._tracing = threading.Lock()

    def __call__(self, fixed: object, given: PyTree, runs: PyTree) -> Callable[[int], PyTree]:
        """Return what computes so many first runs, compiled by the first thread that asks.

        Raises ValueError, which says why, where the native backend cannot.
        """
        key, numbers = self._key(fixed, given, runs)
        program = self._made.of(key, partial(self._compiled, key))
        return lambda count: program(numbers, jax.tree.map(lambda x: np.asarray(x)[:count], runs))

    def one(self, fixed: object, given: PyTree, run: PyTree) -> PyTree:
        """The function of one run, for a program of XLA's too: traced once for both."""
        numbers, rest = eqx.partition(given, is_number)

        def one(numbers, run):
            return self._function(fixed, eqx.combine(numbers, rest), run)

        traced = self._traced.of((fixed, *_hashable(rest)), lambda: jax.jit(one))
        with self._tracing, free_gathers():
            return traced(numbers, run)

    def is_there(self, fixed: object, given: PyTree, runs: PyTree) -> bool:
        """Whether a program need not be compiled any more."""
        key, _ = self._key(fixed, given, runs)
        return key in self._made or batch.is_kept(key)

    @staticmethod
    def _key(fixed, given, runs) -> tuple[tuple, PyTree]:
        """Return all that decides a program, and the numbers that it is given."""
        numbers, rest = eqx.partition(given, is_number)
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct((1, *x.shape[1:]), x.dtype), runs)
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), x.dtype), numbers)
        return (fixed, *_hashable(rest), *_hashable((shapes, one))), numbers

    def _compiled(self, key: tuple) -> PyTree:
        fixed, leaves, structure, shapes, of_data = key
        rest = jax.tree.unflatten(structure, leaves)
        numbers, runs = jax.tree.unflatten(of_data, shapes)

        def one(numbers, run):
            return self.one(fixed, eqx.combine(numbers, rest), run)

        return batch.batched(one, numbers, runs, key)


def _hashable(tree: PyTree) -> tuple[tuple[PyTree, ...], jax.tree_util.PyTreeDef]:
    leaves, structure = jax.tree.flatten(tree)
    return tuple(leaves), structure


def difference(
    found: Mapping[str, ArrayLike],
    wanted: Mapping[str, ArrayLike],
    which: Bool[np.ndarray, "runs steps"],
    near: float,
) -> str | None:
    """Say in which record two computations of the same runs differ by more than so much of its
    largest number, in those steps; None where they do not."""
    for key in wanted:
        x, y = np.asarray(wanted[key])[which], np.asarray(found[key])[which]
        tiny = np.finfo(float).tiny
        size = np.max(np.abs(x.astype(float)), where=np.isfinite(x), initial=tiny)
        if not np.allclose(y, x, rtol=near, atol=near * size, equal_nan=True):
            both = np.isfinite(x) & np.isfinite(y)
            apart = np.abs(1.0 * y[both] - x[both]).max(initial=0) / size
            return f"{key} differs from XLA's by {apart:.1g} of its largest value"
    return None
