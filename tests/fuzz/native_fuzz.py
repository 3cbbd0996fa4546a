"""Random programs, by the native backend and by XLA: the same numbers, to the bit.

`python tests/fuzz/native_fuzz.py --cases 500`; `--first N --cases 1` repeats case N. Case i draws
from (seed, i) alone. Real numbers are multiples of 1/8, of which sums and products are exact in any
order, and what transcendental functions return is rounded to them. Zeros of either sign are equal.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import lax

from jaxslam.native import NotSupportedError
from jaxslam.native.batch import Batch
from jaxslam.native.trace import TURNS

RUNS = 19
"""Two whole groups of eight and some of a third; one of sixteen and some of a second."""
OPERATIONS = 14
"""Of a program."""
SHAPES = ((), (1,), (3,), (4,), (0,), (2, 3), (3, 3), (1, 4), (3, 1), (2, 0))
UNARY = (
    *(lax.neg, lax.abs, lax.sign, lax.floor, lax.ceil, lax.square, lax.is_finite, jnp.round),
    *(lambda x: lax.round(x), lambda x: lax.integer_pow(x, 3), lax.stop_gradient),
)
CURVES = (
    *(lax.sin, lax.cos, lax.tan, lax.asin, lax.acos, lax.atan, lax.sinh, lax.cosh, lax.tanh),
    *(lax.exp, lax.expm1, lax.log, lax.log1p, lax.sqrt),
)
"""Whose last bits are not told."""
MODES = ("clip", "fill", "promise_in_bounds")


class Program:
    """Draws operations, and applies them to values that are there."""

    def __init__(self, rng: np.random.Generator, values: list[Any]) -> None:
        self.rng, self.values = rng, values

    def one_of(self, things):
        return things[self.rng.integers(len(things))]

    def shape(self):
        return self.one_of(SHAPES)

    def value(self, kind: str = "f", shape: Any = None):
        """One that is there, of this kind and shape."""
        found = [x for x in self.values if x.dtype.kind == kind]
        x = found[-1 - int(min(self.rng.exponential(3), len(found) - 1))]
        return x if shape is None else self.fitted(x, shape)

    def fitted(self, x, shape):
        count = int(np.prod(shape))
        if not x.size:
            return jnp.ones(shape, x.dtype)
        return x.ravel()[np.arange(count) % x.size].reshape(shape)

    def run(self, operations: int):
        rules = [getattr(self, name) for name in sorted(dir(Program)) if name.startswith("of_")]
        for _ in range(operations):
            made = self.one_of(rules)()
            for x in made if isinstance(made, tuple | list) else [made]:
                self.values.append(tame(x))

    def of_unary(self):
        return self.one_of(UNARY)(self.value())

    def of_curve(self):
        return snapped(self.one_of(CURVES)(plus_zero(self.value())))

    def of_quotient(self):
        a, b = (plus_zero(self.value(shape=s)) for s in [self.shape()] * 2)
        return snapped(self.one_of((lax.div, lax.atan2, lax.pow, lax.rem))(a, b))

    def of_root(self):
        x = plus_zero(self.value())
        return snapped(self.one_of((lax.rsqrt, lambda x: lax.integer_pow(x, -2)))(x))

    def of_sum(self):
        a, b = (self.value(shape=s) for s in [self.shape()] * 2)
        return self.one_of((lax.add, lax.sub, lax.mul, lax.max, lax.min))(a, b)

    def of_sparse(self):
        shape = self.shape()
        mask = self.rng.integers(-1, 2, shape)
        a, b = self.value(shape=shape), jnp.asarray(mask, self.value().dtype)
        return [self.one_of((lax.mul, lax.add, lax.sub))(a, b), mask[..., None] * a[..., None]]

    def of_whole(self):
        kind = self.one_of("iu")
        a, b = (self.value(kind, s) for s in [self.shape()] * 2)
        b = b.astype(a.dtype)
        two = (lax.add, lax.sub, lax.mul, lax.div, lax.rem, lax.max, lax.min)
        return self.one_of(two)(a, b), lax.integer_pow(a, 2), lax.sign(a)

    def of_comparison(self):
        kind, shape = self.one_of("fiub"), self.shape()
        signs = (lax.eq, lax.ne, lax.lt, lax.le, lax.gt, lax.ge)
        a = self.value(kind, shape)
        return self.one_of(signs)(a, self.value(kind, shape).astype(a.dtype))

    def of_truth(self):
        a, b = (self.value("b", s) for s in [self.shape()] * 2)
        return a & b, a | b, ~a

    def of_select(self):
        shape, kind = self.shape(), self.one_of("fiub")
        a = self.value(kind, shape)
        b = self.value(kind, shape).astype(a.dtype)
        which = jnp.clip(self.value("i", shape).astype(jnp.int32), 0, 2)
        return lax.select_n(self.value("b", shape), a, b), lax.select_n(which, a, b, a)

    def of_clamp(self):
        shape = self.shape()
        return lax.clamp(*(self.value(shape=shape) for _ in range(3)))

    def of_conversion(self):
        x = self.value(self.one_of("fiub"))
        new = self.one_of((self.value().dtype, jnp.int32, jnp.uint8, bool, jnp.int16))
        return x.astype(new)

    def of_move(self):
        x = self.value(self.one_of("fib"), self.one_of(((2, 3), (3, 3), (1, 4), (2, 0))))
        return [
            lax.transpose(x, (1, 0)),
            lax.rev(x, (int(self.rng.integers(2)),)),
            x[self.rng.integers(2) :, ::2],
            lax.pad(x, x.dtype.type(1), ((1, -1, 1), (-1, 2, 0))),
            jnp.concatenate([x, x[:1]], 0),
            jnp.broadcast_to(x[:, :1], (2, *x[:, :1].shape)).reshape(-1),
        ][self.rng.integers(6)]

    def of_reduction(self):
        x = self.value(self.one_of("ffi"), self.one_of(((3,), (2, 3), (3, 3), (2, 0), (0,))))
        names = (jnp.sum, jnp.prod, lambda x, axis: jnp.max(x, axis, initial=-9))
        axis = int(self.rng.integers(x.ndim))
        truth = self.value("b", (2, 3))
        return self.one_of(names)(x, axis=axis), truth.any(0), truth.all(1)

    def of_best(self):
        x = self.value(self.one_of("ffi"), self.one_of(((3,), (2, 3), (1, 4))))
        axis = int(self.rng.integers(x.ndim))
        return [f(x, axis, jnp.int32) for f in (lax.argmax, lax.argmin)]

    def of_running(self):
        x = self.value(self.one_of("ffi"), self.one_of(((3,), (2, 3), (0,), (1, 4))))
        axis, reverse = int(self.rng.integers(x.ndim)), bool(self.rng.integers(2))
        names = (lax.cumprod, lax.cumsum, lax.cummax, lax.cummin)
        long = jnp.concatenate([x] * TURNS, axis)  # a loop
        return self.one_of(names)(x, axis, reverse), self.one_of(names[1:])(long, axis, reverse)

    def of_order(self):
        shape = self.one_of(((4,), (3, 3), (2, 3), (1,)))
        keys = [jnp.floor(self.value(shape=shape)), self.value(self.one_of("fiub"), shape)]
        places = lax.broadcasted_iota(jnp.int32, shape, len(shape) - 1)
        return lax.sort((*keys, places), num_keys=int(self.rng.integers(1, 3)))

    def of_product(self):
        kind = self.one_of("fffi")
        a, b = self.value(kind, (3, 4)), self.value(kind, (4, 3))
        mask = self.rng.integers(0, 2, (3, 4)).astype(a.dtype)
        large = jnp.concatenate([self.value(shape=(8, 9)), jnp.eye(8, 9) * self.value(shape=())])
        batch = jnp.einsum("bij,bkj->bik", *(self.value(shape=(2, 2, 3)) for _ in "ab"))
        return [a @ b, (mask * a) @ b, jnp.where(mask > 0, a, 0) @ b, large @ large.T, batch][
            self.rng.integers(5)
        ]

    def of_window(self):
        x, at = self.value(shape=(3, 4)), [self.value("i", ()) for _ in "ab"]
        at = [y.astype(jnp.int32) for y in at]
        put = self.value(shape=(2, 1))
        return [lax.dynamic_slice(x, at, (2, 3)), lax.dynamic_update_slice(x, put, at)]

    def of_gather(self):
        x = self.value(self.one_of("fiub"), self.one_of(((4,), (3, 3), (1, 4))))
        at = self.value(self.one_of("iu"), self.one_of(((3,), (), (2, 2), (0,))))
        if self.one_of(MODES) == "clip":
            return x.at[at].get(mode="clip")
        return x.at[at].get(mode="fill"), x[jnp.clip(at, 0, len(x) - 1)]

    def of_scatter(self):
        kind = self.one_of("ffi")
        x, at = self.value(kind, self.one_of(((4,), (3, 2)))), self.value("i", (5,))
        values = self.value(kind, (5, *x.shape[1:])).astype(x.dtype)
        mode = self.one_of(("drop", "clip"))
        best = x.at[at].min(values, mode=mode), x.at[at].max(values, mode=mode)
        return x.at[at].add(values, mode=mode), x.at[at].set(values, mode=mode), *best

    def of_constant_places(self):
        x, at = self.value(shape=(4,)), self.rng.integers(0, 4, 5)
        values = self.value(shape=(5,))
        return x.at[at].add(values), x.at[at].min(values), x.at[at[:1]].set(values[:1]), x[at]

    def of_loop(self):
        length = int(self.one_of((0, 1, 3, 700)))
        start, more = self.value(shape=(3,)), self.value(shape=(3,))
        xs = jnp.arange(length, dtype=jnp.int32)

        def turn(carry, t):
            a, b = carry
            a = tame(jnp.where(t % 2 == 0, a - b, lax.rem(a, 5 * jnp.ones_like(a)) + more))
            return (b[::-1], a), (a, jnp.argmax(a), t)

        end, (rows, best, _) = lax.scan(turn, (start, more), xs, reverse=bool(self.rng.integers(2)))
        return [*end, *([rows[-1], rows[0], best[-1]] if length else [rows])]

    def of_while(self):
        most, start = self.value("i", ()).astype(jnp.int32), self.value(shape=(3,))

        def turn(carry):
            n, x = carry
            return n + 1, tame(jnp.where(x > 2, x - 3, 2 * x + 1))

        return lax.while_loop(lambda c: c[0] < jnp.minimum(most, 6), turn, (jnp.int32(0), start))

    def of_branch(self):
        x, which = self.value(shape=(3,)), self.value("i", ()).astype(jnp.int32)
        cases = [lambda x: x + 1, lambda x: tame(x * x), lambda x: x[::-1]]
        truth = self.value("b", ())
        return lax.switch(which, cases, x), lax.cond(truth, cases[1], cases[0], x)

    def of_derivative(self):
        x, y = (self.value(shape=(3,)) for _ in "ab")
        return jax.jacfwd(lambda x: jnp.where(x > 1, x * y, x * x[::-1]) + x[0])(x)


def tame(x):
    """What grows is small again, and exact."""
    if x.dtype.kind == "f":
        small = lax.clamp(x.dtype.type(-64), jnp.round(8 * x) / 8, x.dtype.type(64))
        return jnp.where(jnp.isfinite(x), small, x)
    return jnp.clip(x, 0, 200) if x.dtype.kind == "u" else x


def snapped(x):
    """Without the last bits; what is half of something exactly is not divided there."""
    return jnp.where(jnp.isfinite(x), jnp.floor(8 * x + 0.317) / 8, x)


def plus_zero(x):
    """With every zero positive."""
    return jnp.where(x == 0, 0.0, x)


def inputs(rng: np.random.Generator, dtype: Any) -> tuple[Any, Any]:
    """Numbers shared by all runs, and of the runs; some of these are special."""
    x = rng.integers(-24, 25, (RUNS, 12)) / 8
    special = np.array([np.nan, np.inf, -np.inf, -0.0, 0.0, 64, 1e-3])
    where = (rng.random(x.shape) < 0.3) & (np.arange(RUNS)[:, None] < 6)
    x = np.where(where, rng.choice(special, x.shape), x).astype(dtype)
    n = rng.integers(-3, 7, (RUNS, 4)).astype(np.int32)
    n[5, 0], n[6, 1], n[7] = 2**31 - 1, -(2**31), 0
    u = rng.integers(0, 5, (RUNS, 3)).astype(np.uint8)
    u[6] = 255
    return np.array([1.5, -2.0], dtype), (x, n, u, rng.random((RUNS, 3)) < 0.5)


class Outcome(NamedTuple):
    """Of a case."""

    kind: str
    """right, refused, wrong or failed."""
    certain: int = 0
    """Runs that the native program computed itself."""
    text: str = ""


def check(case: int, seed: int = 0, operations: int = OPERATIONS) -> Outcome:
    """Compare a program of so many operations."""
    kind = np.float32 if case % 4 == 3 else np.float64
    shared, runs = inputs(np.random.default_rng((seed, case, 0)), kind)

    def function(shared, run):
        program = Program(np.random.default_rng((seed, case, 1)), [shared, *run])
        program.run(operations)
        return program.values[5:]

    with jax.enable_x64(kind == np.float64):
        try:
            return compared(function, shared, runs)
        except NotSupportedError as error:
            return Outcome("refused", text=str(error))
        except Exception:
            return Outcome("failed", text=traceback.format_exc(-3))


def compared(function: Callable[..., Any], shared: Any, runs: Any) -> Outcome:
    """Run by run, number by number."""
    batch, certain = Batch(function, shared, runs), np.ones(RUNS, bool)
    by_xla = batch._by_xla

    def noted(shared, runs, doubted, made):
        certain[doubted] = False
        by_xla(shared, runs, doubted, made)

    batch._by_xla = noted
    found = batch(shared, runs)
    wanted = jax.jit(jax.vmap(function, (None, 0)))(shared, runs)
    for k, (x, y) in enumerate(zip(found, wanted, strict=True)):
        y = np.asarray(y)
        equal = (x == y) | ((x != x) & (y != y))
        if x.dtype != y.dtype or not equal.all():
            run = int(np.argmin(equal.reshape(RUNS, -1).all(1)))
            text = f"value {k}, run {run}: {x[run].tolist()} instead of {y[run].tolist()}"
            return Outcome("wrong", int(certain.sum()), text)
    return Outcome("right", int(certain.sum()))


def main(cases: int = 500, first: int = 0, seed: int = 0, operations: int = OPERATIONS) -> None:
    """Compare so many programs, and say what is not right; exits with 1 where something is not."""
    counts, certain, start = Counter(), 0, time.perf_counter()
    for case in range(first, first + cases):
        outcome = check(case, seed, operations)
        counts[outcome.kind] += 1
        certain += outcome.certain
        if outcome.kind != "right":
            print(f"case {case} {outcome.kind}: {outcome.text}", flush=True)
        jax.clear_caches()
    share = certain / max(1, RUNS * counts["right"])
    seconds = time.perf_counter() - start
    print(f"{dict(counts)}; {share:.0%} of the runs computed natively; {seconds:.0f} s")
    sys.exit(int(counts["wrong"] + counts["failed"] > 0))


if __name__ == "__main__":
    tyro.cli(main)
