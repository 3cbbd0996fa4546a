"""Tests of jaxslam/native: a program in C++ computes what the function says, run by run.

Of any function that is tried in `tests/fuzz/native_fuzz.py`; here is what chance seldom reaches.
"""

import platform

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import quick_jit, quick_rows
from jax.extend.core import jaxprs_in_params

import jaxslam
from jaxslam import linalg
from jaxslam._numerics.arrays import cast
from jaxslam._numerics.tracing import free_gathers
from jaxslam._runtime import programs
from jaxslam.consistency import backends, draw
from jaxslam.consistency.store import NATIVE
from jaxslam.landmarks import LANDMARKS
from jaxslam.native import NativePrograms, batch, batched, build
from jaxslam.native.batch import Batch
from jaxslam.native.build import compiler
from jaxslam.native.elements import OPERATIONS, Elements
from jaxslam.native.trace import INNER, MOVES, RULES

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C++ compiler")
RUNS = 11
"""A whole group of eight, and some of another."""
DRAWN = np.random.default_rng(0).normal(size=(RUNS, 12, 12))
SHARED = np.array([1.5, -2.0])


def products(shared, A):
    B, picked = A @ A.T + jnp.eye(12), jnp.arange(12) % 5 == jnp.arange(12)[:, None] % 5
    sparse = jnp.where(picked, A, 0.0)
    batches = jnp.einsum("mij,mjk->mik", A.reshape(3, 8, 6), A.reshape(3, 6, 8))
    return B - sparse @ B @ sparse.T, jnp.tril(A) @ A, batches, linalg.symmetric_part(B)


def assert_as_vmap_makes_it(function):
    found = batched(function, SHARED, DRAWN)(SHARED, DRAWN, threads=2)
    wanted = quick_jit(jax.vmap(function, (None, 0)))(SHARED, DRAWN)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(
    "move",
    [
        lambda A: jax.lax.pad(A, 9.0, ((1, -1, 0), (0, 2, 2))),
        lambda A: jax.lax.pad(A, 9.0, ((-1, 3, 1), (2, -2, 0))),
        lambda A: jax.lax.broadcast_in_dim(A, (3, 2, 4), (0, 2)),
        lambda A: jax.lax.slice(A, (1, 0), (3, 4), (1, 3)),
        lambda A: jax.lax.rev(A, (1,)),
        lambda A: jax.lax.split(A, (1, 3), 1),
        lambda A: jax.lax.concatenate([A, A], 1),
        lambda A: jax.lax.transpose(A, (1, 0)),
        lambda A: jax.lax.expand_dims(A, (1,)),
        lambda A: jax.lax.reshape(A, (2, 6)),
    ],
)
def test_numbers_are_moved_as_jax_moves_them(move):
    A = np.arange(12.0).reshape(3, 4)
    (equation,) = jax.make_jaxpr(move)(A).eqns
    given = [getattr(variable, "val", A) for variable in equation.invars]
    found = MOVES[equation.primitive.name](equation.params, *given)
    wanted = move(A)
    for x, y in zip(*map(jax.tree.leaves, (found, wanted)), strict=True):
        np.testing.assert_array_equal(x, y)


@needs_compiler
@pytest.mark.parametrize("length", [16, 32, 64])
def test_vectors_of_any_length_give_the_same(length, monkeypatch):
    monkeypatch.setattr(batch, "vector_bytes", lambda: length)
    assert_as_vmap_makes_it(lambda shared, A: (products(shared, A)[0], jnp.exp(jnp.sin(A))))


@needs_compiler
@pytest.mark.skipif(platform.machine() != "x86_64", reason="another processor")
def test_vectors_are_no_longer_than_the_processors():
    features = programs.processor()[-1].split()
    longest = 64 if "avx512f" in features else 32 if "avx2" in features else 16
    assert build.vector_bytes() == longest


@jax.jit
def symmetric_part(A):
    """Anybody's, under the name of a function of the package."""
    return jnp.tril(A)


@needs_compiler
def test_functions_are_not_known_by_their_names():
    found = batched(lambda shared, A: symmetric_part(A), SHARED, DRAWN)(SHARED, DRAWN)
    np.testing.assert_array_equal(found, np.tril(DRAWN))


@needs_compiler
def test_single_precision_is_single():
    given = DRAWN.astype(np.float32), SHARED.astype(np.float32)
    with jax.enable_x64(False):
        (found, *_) = batched(products, given[1], given[0])(given[1], given[0])
    wanted, *_ = jax.vmap(products, (None, 0))(SHARED, DRAWN)
    error = np.max(np.abs(found - wanted)) / np.max(np.abs(wanted))
    assert found.dtype == np.float32
    assert 1e-9 < error < 1e-5


def called_with_another_shape():
    batched(products, SHARED, DRAWN)(SHARED, DRAWN[:, :5])


@needs_compiler
@pytest.mark.parametrize(
    ("call", "told"),
    [
        (called_with_another_shape, "other shapes or types"),
        (lambda: batched(lambda _, x: jnp.fft.rfft(x).real, SHARED, DRAWN), "backend: fft"),
        (lambda: batched(lambda _, x: x.astype("f4").astype(float), SHARED, DRAWN), "beside flo"),
        (lambda: batched(lambda _, x: jnp.uint8(3) * jnp.uint8(90) * x, SHARED, DRAWN), "integers"),
        (lambda: jaxslam.monte_carlo("matched", {}, runs=1, backend="tpu"), "known: xla, native"),
    ],
)
def test_what_does_not_fit_is_refused(call, told):
    with pytest.raises(ValueError, match=told):
        call()


@pytest.mark.parametrize("kind", ["is not there", "does not end"])
def test_without_a_compiler_that_works_it_says_so(kind, monkeypatch):
    told = "did not end within" if kind == "does not end" else r"needs a C\+\+ compiler"
    if kind == "does not end":
        monkeypatch.setattr(build, "LIMIT_SECONDS", 1e-3)
    else:
        monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ValueError, match=told):
        batched(lambda shared, A: A * 12345.0, SHARED, DRAWN)


SPECIAL = np.round(4 * DRAWN[:, 0, :6]) / 4
SPECIAL[1, 2], SPECIAL[2, :2], SPECIAL[3, 3] = np.nan, [np.inf, -np.inf], -0.0
SPECIAL[4], SPECIAL[5, 1::3], SPECIAL[6] = 0.0, np.nan, [0.5, 1.5, 2.5, -0.5, -1.5, 0.25]


def special_numbers(shared, x):
    """Of ties the first, of NaN the first; halves away or to the even; remainders of ∞."""
    return (
        (jnp.argmax(x), jnp.argmin(x), jnp.argmax(x == x), jnp.max(x), jnp.min(x)),
        (jax.lax.round(x), jnp.round(x), jnp.sign(x), jnp.isfinite(x), jnp.floor(x)),
        (jnp.fmod(x, jnp.inf), jnp.fmod(x, 0.75), jnp.fmod(1e17, x), jnp.mod(x, -0.75)),
    )


def order_of_equals(shared, x):
    """Equal keys, NaN and both zeros among them, keep the order that they had."""
    tied = jnp.floor(x)
    by_one = jax.lax.sort((tied, jnp.arange(6.0)), num_keys=1, is_stable=True)
    rows = jnp.stack([tied, jnp.arange(6.0)[::-1] // 2, jnp.arange(6.0)])
    return by_one, jax.lax.sort(tuple(rows), num_keys=2, is_stable=True), jnp.argsort(-tied)


def last_row_of_a_long_loop(shared, x):
    def turn(carry, t):
        return carry * 0.5 + t, (carry[0] * t, carry)

    _, (first, rows) = jax.lax.scan(turn, x, jnp.arange(4000.0))
    return first[-1], rows[-1], rows[7, :2]


def nothing_at_all(shared, x):
    none = x[:0]
    end, turns = jax.lax.scan(lambda c, t: (c + t, 2 * c), x[0], none)
    sums = jnp.sum(none), jnp.sum(x[None, :0], 0), none @ none
    return end, turns, jnp.cumsum(none), jnp.max(none, initial=-jnp.inf), *sums


def computed_again(monkeypatch):
    """The runs that XLA has to compute, as they are."""
    told, by_xla = [], Batch._by_xla

    def noted(batch, shared, runs, doubted, made):
        told.extend(doubted.tolist())
        by_xla(batch, shared, runs, doubted, made)

    monkeypatch.setattr(Batch, "_by_xla", noted)
    return told


def assert_equal(function, given):
    found = batched(function, SHARED, given)(SHARED, given)
    wanted = jax.vmap(function, (None, 0))(SHARED, given)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


@needs_compiler
def test_special_numbers_are_the_same_to_the_bit(monkeypatch):
    told = computed_again(monkeypatch)
    parts = special_numbers, order_of_equals, last_row_of_a_long_loop, nothing_at_all
    assert_equal(lambda shared, x: [part(shared, x) for part in parts], SPECIAL)
    assert not told


def products_with_zero(shared, x):
    sparse = jnp.where(jnp.eye(6) > 0, 2.0, 0.0)
    return sparse @ x, 0.0 * x[:2], jnp.outer(x, x)[:, :, None] * jnp.zeros(2)


def loop_with_products(shared, x):
    """Of a run that has left the loop nothing is asked."""

    def turn(carry):
        n, y = carry
        return n + 1, jnp.where(n > 2, jnp.inf, y) * jnp.array([1.0, 0.0, 1.0, 1.0, 0.0, 1.0])

    return jax.lax.while_loop(lambda carry: carry[0] < jnp.where(x[0] > 0, 3, 5), turn, (0, x))


def whole_numbers(shared, x):
    n = (jnp.clip(jnp.nan_to_num(x), -2, 2) * 2**16).astype(jnp.int32)
    return n * n, n - jnp.int32(2**31 - 1), jnp.sum(n * jnp.int32(2**14))


def truncated(shared, x):
    return x.astype(jnp.int32), (100 * x).astype(jnp.uint8), (x < 0) + jnp.int8(0)


def quotients_of_whole_numbers(shared, x):
    n = jnp.clip(2 * jnp.nan_to_num(x[0]), -2, 2).astype(jnp.int32)
    return jax.lax.div(jnp.int32(7), n), jax.lax.rem(jnp.int32(7), n)


DOUBTED = (
    products_with_zero, loop_with_products, whole_numbers, truncated, quotients_of_whole_numbers,
)  # fmt: skip


@needs_compiler
@pytest.mark.parametrize("function", DOUBTED, ids=lambda f: f.__name__)
def test_runs_of_which_it_cannot_be_certain_are_computed_by_xla(function, monkeypatch):
    told = computed_again(monkeypatch)
    assert_equal(function, SPECIAL)
    assert 0 < len(told) < RUNS


@needs_compiler
def test_integers_of_single_precision_are_whole(monkeypatch):
    """Above 2²⁴ no float32 is odd."""
    told = computed_again(monkeypatch)
    given = np.array(
        [[3, 5, 0], [2**24, 1, 0], [2**24 + 1, 0, 0], [2**23, 2**23 + 1, -(2**23)]], np.int32
    )
    shared = np.ones(2, np.float32)

    def sums(shared, n):
        return jnp.sum(n), n + 1, shared * n[0]

    with jax.enable_x64(False):
        found = batched(sums, shared, given)(shared, given)
        wanted = jax.vmap(sums, (None, 0))(shared, given)
    for x, y in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(x, y)
    assert told == [1, 2, 3]


@needs_compiler
@pytest.mark.parametrize("damage", ["empty", "cut", "changed"])
def test_a_damaged_library_is_built_anew(damage, tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "_kept_in", tmp_path)
    built, compiled = [], build._compile
    monkeypatch.setattr(build, "_compile", lambda *x: (built.append(1), compiled(*x)))

    def function(shared, x):
        return x[:2] + shared

    for _ in range(2):
        assert_equal(function, SPECIAL)
    assert len(built) == 1
    (path,) = tmp_path.glob("*.so")
    whole = path.read_bytes()
    middle = len(whole) // 2
    changed = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
    path.unlink()  # it is loaded
    path.write_bytes({"empty": b"", "cut": whole[:middle], "changed": changed}[damage])
    for _ in range(2):
        assert_equal(function, SPECIAL)
    assert len(built) == 2


@needs_compiler
def test_what_goes_wrong_within_is_a_value_error(monkeypatch):
    def failing(*args):
        raise KeyError(3)

    monkeypatch.setattr(batch, "plan", failing)
    with pytest.raises(ValueError, match=r"native backend has failed .KeyError"):
        batched(special_numbers, SHARED, SPECIAL)


def test_zeros_cost_nothing_and_nothing_is_computed_twice():
    elements = Elements(np.float64)
    x = elements.variables((3,))
    zero = elements.constant(np.zeros(3))
    assert np.all(elements.is_zero(elements.apply("mul", x, zero)[0]))
    np.testing.assert_array_equal(elements.apply("add", x, zero)[0], x)
    one_way, made = elements.apply("add", x, x[::-1])
    assert made.size == 2
    np.testing.assert_array_equal(elements.apply("add", x[::-1], x)[0], one_way)


def test_longer_sums_and_loops_are_no_longer_programs(monkeypatch):
    def lines(rows):
        x = np.zeros((1, rows))
        with pytest.raises(ValueError, match="not built") as told:
            batched(lambda _, x: (jnp.cumsum(x), jax.lax.map(jnp.exp, x)), SHARED, x)
        return str(told.value)

    def built(source):
        raise ValueError(f"{source.text.count(chr(10))} lines, not built")

    monkeypatch.setattr(batch, "built", built)
    assert lines(3000) == lines(100)


WORDS = (
    "scale_gauge+oc", "recommended+mixture3", "robocentric", "world", "keyframe", "scale_gauge",
    "invariant", "recommended", "world+fej", "robocentric+iterated3+mean", "robocentric+drift",
    "robocentric+scene50",
    "scale_gauge+scene50+walk3", "scale_gauge+directions3", "recommended+submaps",
    "robocentric+checked", "recommended+rest4", "robocentric+particles3", "robocentric+rays3",
)  # fmt: skip
"""Every filter, and every word that may stand behind one."""


def primitives(jaxpr):
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for inner in jaxprs_in_params(equation.params):
            yield from primitives(inner)


@pytest.mark.parametrize("landmark", quick_rows(1, list(LANDMARKS)))
@pytest.mark.parametrize("word", quick_rows(2, WORDS))
def test_every_filter_has_a_native_program(word, landmark):
    """So far as every primitive of it has a rule."""
    world = jaxslam.scenario("matched", steps=3, landmarks=3)
    try:
        (slam,) = jaxslam.make_filters(world, [word], [landmark]).values()
    except ValueError as error:
        pytest.skip(str(error))
    room, runs = draw(world, 1)
    pieces = cast(slam, "float64"), cast(world.sensor, "float64")
    with jax.enable_x64(True), free_gathers():
        one = jax.tree.map(lambda x: x[0], runs)
        traced = jax.make_jaxpr(lambda run: backends._records_and_map(room, pieces, run))(one)
    known = {*INNER, *MOVES, *RULES, *OPERATIONS}
    assert set(primitives(traced.jaxpr)) <= known


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("name", "landmark"),
    [
        ("recommended+mixture3", "inverse_scaling"),
        ("robocentric", "inverse_scaling"),
        ("world", "inverse_depth"),
    ],
)
def test_a_study_has_the_same_records(name, landmark):
    scenario = jaxslam.scenario("matched", steps=6, landmarks=4)
    filters = jaxslam.make_filters(scenario, [name], [landmark])
    studies = [
        jaxslam.monte_carlo(scenario, filters, runs=12, chunk=10, backend=backend)
        for backend in ("native", "xla")
    ]
    for chunk in studies[0].chunks:
        found, wanted = (study.store.load(f"{name}/{landmark}", chunk) for study in studies)
        assert found.keys() == wanted.keys()
        assert found.pop(NATIVE)
        assert not wanted.pop(NATIVE)
        for key, value in wanted.items():
            scale = np.nanmax(np.abs(value), initial=1e-30)
            np.testing.assert_allclose(found[key], value, rtol=1e-9, atol=1e-9 * scale)


class Powered(eqx.Module):
    """A filter, as far as its key goes."""

    numbers: jax.Array | None
    power: object = eqx.field(static=True)


def test_a_program_is_made_once_for_runs_of_a_shape_and_a_filter_of_fixed_parts(monkeypatch):
    """Which are the same by type and bits: `x ** 2.0` is not the program of `x ** 2`."""
    made = []
    monkeypatch.setattr(batch, "batched", lambda *given: made.append(1) or (lambda *_: given[1]))
    kept = NativePrograms(lambda *given: None)
    for power in (2, 2.0, True, 1, 0.0, -0.0, float("nan"), float("nan"), 2, 2.0):
        kept(None, Powered(None, power), DRAWN)
    assert len(made) == 7
    kept(None, Powered(None, 2), DRAWN[:2])  # whatever the number of runs
    kept(None, Powered(None, 2), DRAWN[:, :2])
    assert len(made) == 8
