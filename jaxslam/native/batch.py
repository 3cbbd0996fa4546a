"""A batch of runs by a program in C++: compiled, and called with arrays."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from types import FunctionType
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from jaxslam._runtime.programs import keep, place_of, read
from jaxslam.native.build import built, described, trusted, vector_bytes
from jaxslam.native.emit import source
from jaxslam.native.plan import plan
from jaxslam.native.trace import NotSupportedError, program

__all__ = ["Batch", "NotSupportedError", "batched"]


_LINE = 64
"""Bytes of a line of the cache, at which memory begins."""
Kinds = tuple[jax.tree_util.PyTreeDef, tuple[tuple[tuple[int, ...], np.dtype], ...]]
"""The structure of a pytree, and the shapes and types of its leaves."""


class Batch:
    """`jax.vmap(function, (None, 0))(shared, runs)`, to rounding; of NumPy's arrays.

    Runs in which it is not certain, because something was not finite that met a zero, or an integer
    was too large for its type, are computed by XLA.
    """

    def __init__(
        self,
        function: Callable[[PyTree, PyTree], PyTree],
        shared: PyTree,
        runs: PyTree,
        key: object = None,
    ) -> None:
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), runs)
        self._given, self._function = _kinds((shared, one)), function
        self._shapes, self._width, library = _kept(key) or self._made(shared, one, key)
        self._run, library.arena.restype = library.run, ctypes.c_long
        self._arena = library.arena()

    def _made(self, shared: PyTree, one: PyTree, key: object) -> tuple[PyTree, int, ctypes.CDLL]:
        """Trace, translate and compile, and keep what was made."""
        traced, shapes = program(self._function, *jax.tree.map(_kind, (shared, one)))
        inputs = [(x.dtype, own) for x, own in zip(*self._leaves(shared, one), strict=True)]
        outputs = [x.dtype for x in jax.tree.leaves(shapes)]
        path = built(source(plan(traced), (inputs, outputs), vector_bytes()))
        width = vector_bytes() // traced.elements.dtype.itemsize
        if place := _place(key):
            keep(place[0], lambda: (shapes, width, path.name))
        return shapes, width, ctypes.CDLL(str(path))

    def __call__(self, shared: PyTree, runs: PyTree, *, threads: int = 1) -> PyTree:
        """The results of all runs; the same whatever the number of threads."""
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), runs)
        if _kinds((shared, one)) != self._given:
            raise ValueError("other shapes or types than the program is for")
        given = [np.ascontiguousarray(x) for x in jax.tree.leaves((shared, runs))]
        count = len(jax.tree.leaves(runs)[0])
        leaves, structure = jax.tree.flatten(self._shapes)
        made = [np.empty((count, *x.shape), x.dtype) for x in leaves]
        doubted = np.zeros(count, bool)
        doubts = ctypes.c_void_p(doubted.ctypes.data)
        pointers = [(ctypes.c_void_p * len(x))(*(y.ctypes.data for y in x)) for x in (given, made)]

        def part(firsts) -> None:
            arena = np.empty(self._arena + _LINE, np.uint8)
            begin = ctypes.c_void_p(arena.ctypes.data + -arena.ctypes.data % _LINE)
            for first in firsts:
                some = min(self._width, count - first)
                self._run(begin, *pointers, doubts, ctypes.c_long(first), ctypes.c_long(some))

        groups = range(0, count, self._width)
        parts = [groups[k::threads] for k in range(threads)]
        if threads == 1:
            part(groups)
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(part, parts))
        if doubted.any():
            self._by_xla(shared, runs, np.flatnonzero(doubted), made)
        return jax.tree.unflatten(structure, made)

    def _by_xla(
        self, shared: PyTree, runs: PyTree, doubted: np.ndarray, made: list[np.ndarray]
    ) -> None:
        """These runs; as many more as few sizes of a batch take."""
        again = np.resize(doubted, 1 << (len(doubted) - 1).bit_length())
        results = self._vmapped(shared, jax.tree.map(lambda x: np.asarray(x)[again], runs))
        for x, result in zip(made, jax.tree.leaves(results), strict=True):
            x[doubted] = np.asarray(result)[: len(doubted)]

    @cached_property
    def _vmapped(self) -> Callable[[PyTree, PyTree], PyTree]:
        return jax.jit(jax.vmap(self._function, (None, 0)))

    @staticmethod
    def _leaves(shared, one):
        return (
            jax.tree.leaves((shared, one)),
            [False] * len(jax.tree.leaves(shared)) + [True] * len(jax.tree.leaves(one)),
        )


def _kind(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(np.shape(x), x.dtype)


def _kinds(tree: PyTree) -> Kinds:
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple((np.shape(x), np.dtype(x.dtype)) for x in leaves)


def _place(key: object) -> tuple[Path, dict[str, FunctionType]] | None:
    told = described()
    return None if key is None or told is None else place_of("native", (key, told))


def _kept(key: object) -> tuple[PyTree, int, ctypes.CDLL] | None:
    """Shapes, width and library of the program for which a key stands; None where it is not there,
    or not to be trusted."""
    place = _place(key)
    if place is None:
        return None
    return read(*place, lambda shapes, width, name: (shapes, width, ctypes.CDLL(trusted(name))))


def is_kept(key: object) -> bool:
    """Whether the program for which this key stands is there."""
    return _kept(key) is not None


def batched(
    function: Callable[[PyTree, PyTree], PyTree], shared: PyTree, runs: PyTree, key: object = None
) -> Batch:
    """A program for arguments of these shapes and types.

    Where programs are kept (`jaxslam._runtime.programs`), one whose `key` stands for the function
    and these shapes is not traced again.

    Raises `NotSupportedError` for a function that has something for which there is no rule, and
    ValueError without a C++ compiler, or where anything else goes wrong.
    """
    try:
        return Batch(function, shared, runs, key)
    except ValueError:
        raise
    except Exception as error:  # of this backend, or the function's own, which XLA will tell
        what = f"{type(error).__name__}: {error}"
        raise ValueError(f"the native backend has failed ({what})") from error
