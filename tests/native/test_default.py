"""The backend of a study for which none is asked: which, when, and what is done where it fails."""

import logging
import warnings
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import jaxslam
from jaxslam import native
from jaxslam._runtime import programs
from jaxslam.consistency import MemoryStore, backends, draw
from jaxslam.native import NativePrograms, batch, batched, build
from jaxslam.native.build import compiler

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C++ compiler")
SCENARIO = jaxslam.scenario("matched", steps=6, landmarks=4)
NAME = "robocentric/inverse_scaling"
RUNS = np.random.default_rng(0).normal(size=(3, 4))
SHARED = np.ones(2)


def study(runs=12, filters=("robocentric",), **options):
    made = jaxslam.make_filters(SCENARIO, filters, ["inverse_scaling"])
    return jaxslam.monte_carlo(SCENARIO, made, runs=runs, chunk=10, **options)


@pytest.fixture
def pretended(monkeypatch):
    """A native backend that is XLA's program, with NEES times `factor`; and what it was asked."""
    pretended = SimpleNamespace(factor=1.0, asked=0, there=False)

    def by_native(*pieces):
        pretended.asked += 1
        program = backends.by_xla(*pieces)

        def computed(wanted):
            records, sample = program(wanted)
            return {**records, "nees": pretended.factor * records["nees"]}, sample

        return computed

    monkeypatch.setattr(native, "compiler", lambda: ["c++"])
    monkeypatch.setattr(backends, "by_native", by_native)
    monkeypatch.setitem(backends.BACKENDS, "native", by_native)
    monkeypatch.setattr(NativePrograms, "is_there", lambda *_: pretended.there)
    return pretended


@pytest.mark.slow
def test_a_long_study_of_a_plain_filter_takes_the_native_backend(pretended, monkeypatch, caplog):
    monkeypatch.setattr(backends, "WORTH", 12 * 6)
    with caplog.at_level(logging.INFO, "jaxslam"):
        assert study().backends == {NAME: "native"}
    (record,) = caplog.records
    assert record.getMessage() == f"{NAME} is computed by a program in C++ (--backend xla: by XLA)"
    assert jaxslam.summarise(study())["filters"][NAME]["backend"] == "native"
    assert study(runs=11).backends == {NAME: "xla"}
    with monkeypatch.context() as larger:
        larger.setattr(backends, "LARGEST", 2 * 3 + 4 * 3 - 1)
        assert study().backends == {NAME: "xla"}
    pretended.there = True  # what is compiled costs nothing
    assert study(runs=11).backends == {NAME: "native"}
    assert study(backend="xla").backends == {NAME: "xla"}


@pytest.mark.parametrize(
    ("name", "backend"),
    [
        ("scale_gauge+mixture3+rest4", "xla"),
        ("robocentric+checked", "xla"),
        pytest.param("scale_gauge+mixture3", "native", marks=pytest.mark.slow),
    ],
)
def test_a_filter_with_more_around_than_a_sum_stays_with_xla(name, backend, pretended):
    (slam,) = jaxslam.make_filters(SCENARIO, name, "inverse_scaling").values()
    room, runs = draw(SCENARIO, 2)
    for there in (False, True):
        pretended.there = there
        assert backends.chosen("auto", NAME, 10**6, slam, room, SCENARIO.sensor, runs) == backend
    assert (pretended.asked > 0) == (backend == "native")


def test_a_program_whose_first_runs_are_others_is_not_believed(pretended, monkeypatch):
    pretended.factor = 1 + 1e-5
    # Not pytest.warns: threads that draw runs catch warnings of their own at the same time.
    told = []
    monkeypatch.setattr(backends.warnings, "warn", lambda text, **_: told.append(text))
    found = study(backend="native")
    assert told[0].startswith(f"{NAME} is computed by XLA, since nees differs from XLA")
    assert found.backends == {NAME: "xla"}
    wanted = study(backend="xla")
    for chunk in found.chunks:
        one, other = (s.store.load(NAME, chunk)["nees"] for s in (found, wanted))
        np.testing.assert_array_equal(one, other)


def test_what_xla_said_of_the_first_runs_is_asked_once(pretended, tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "_kept_in", tmp_path)
    pretended.there = True
    (slam,) = jaxslam.make_filters(SCENARIO, "robocentric", "inverse_scaling").values()

    def chosen(seed):
        room, runs = draw(SCENARIO, 12, seed=seed)
        return backends.chosen("native", NAME, 12, slam, room, SCENARIO.sensor, runs)

    assert chosen(0) == "native"
    monkeypatch.setattr(backends, "_first_runs", lambda *_: pytest.fail("asked again"))
    assert chosen(0) == "native"
    pretended.factor = 1 + 1e-5
    with pytest.warns(UserWarning, match="since nees differs from XLA"):
        assert chosen(0) == "xla"
    with pytest.raises(pytest.fail.Exception, match="asked again"):
        chosen(1)


def test_a_study_is_resumed_by_its_own_backend(pretended, monkeypatch):
    store = MemoryStore()
    assert study(runs=10, store=store, backend="native").backends == {NAME: "native"}
    assert study(runs=20, store=store).backends == {NAME: "native"}
    with pytest.raises(ValueError, match=r"another backend \('native', now 'xla'\)"):
        study(runs=30, store=store, backend="xla")
    pretended.factor = 2.0
    with (
        pytest.warns(UserWarning, match="since nees differs"),
        pytest.raises(ValueError, match=r"cannot resume .* the native backend has begun"),
    ):
        study(runs=30, store=store)
    assert not store.has(NAME, range(20, 30))
    other = MemoryStore()
    study(runs=10, store=other)
    pretended.there = True
    assert study(runs=20, store=other).backends == {NAME: "xla"}


def failing_compiler(tmp_path):
    path = tmp_path / "cc"
    path.write_text("#!/bin/sh\necho 'no space in which to compile' >&2\nexit 1\n")
    path.chmod(0o755)
    return str(path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["none", "fails"])
def test_without_a_compiler_that_works_it_is_xla_and_nothing_is_said(kind, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler" if kind == "none" else failing_compiler(tmp_path))
    monkeypatch.setattr(backends, "WORTH", 1)
    programs.forget()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert study().backends == {NAME: "xla"}
    said = "needs a C" if kind == "none" else "compiler failed: no space in which to compile"
    with pytest.warns(UserWarning, match=f"{said}.*; {NAME} is computed by XLA") as told:
        assert study(backend="native").backends == {NAME: "xla"}
    assert "\n" not in str(told[0].message)
    programs.forget()


def scaled(shared, run):
    return {"sum": run * shared[0] + shared[1]}


@needs_compiler
def test_what_was_compiled_is_not_traced_again(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "_kept_in", tmp_path)
    key = "scaled", RUNS.shape
    wanted = batched(scaled, SHARED, RUNS, key)(SHARED, RUNS)["sum"]
    assert batch.is_kept(key)
    assert not batch.is_kept(("scaled", (4, 4)))
    with monkeypatch.context() as patch:
        patch.setattr(batch, "program", lambda *_: pytest.fail("traced again"))
        np.testing.assert_array_equal(
            batched(scaled, SHARED, RUNS, key)(SHARED, RUNS)["sum"], wanted
        )
    (library,) = tmp_path.glob("*.so")
    library.unlink()
    assert not batch.is_kept(key)
    np.testing.assert_array_equal(batched(scaled, SHARED, RUNS, key)(SHARED, RUNS)["sum"], wanted)


@needs_compiler
def test_a_function_is_traced_once_for_both_backends():
    traced = []

    def function(fixed, given, run):
        traced.append(fixed)
        return {"sum": scaled(given, run)["sum"] / fixed}

    made = NativePrograms(function)
    for fixed in (1.0, 1, True):  # equal, and others
        by_xla = jax.vmap(lambda run, fixed=fixed: made.one(fixed, SHARED, run))(RUNS)
        np.testing.assert_array_equal(made(fixed, SHARED, RUNS)(3)["sum"], by_xla["sum"])
    assert list(map(str, traced)) == ["1.0", "1", "True"]


@needs_compiler
@pytest.mark.parametrize("kind", ["no folder", "full"])
def test_a_cache_that_cannot_be_written_is_done_without(kind, tmp_path, monkeypatch):
    """Permissions do not hold root back: a folder below a file, and a disk that is full."""
    (tmp_path / "file").write_text("")
    folder = tmp_path / ("file" if kind == "no folder" else "full") / "cache"
    monkeypatch.setattr(programs, "_kept_in", folder)
    whole = build.write_atomically

    def written(path):
        if kind == "full" and folder in path.parents:
            raise OSError(28, "No space left on device")
        return whole(path)

    monkeypatch.setattr(build, "write_atomically", written)
    function = {"no folder": lambda s, x: x - s[0], "full": lambda s, x: x - s[1]}[kind]
    found = batched(function, SHARED, RUNS, ("of", kind))(SHARED, RUNS)
    np.testing.assert_array_equal(found, RUNS - 1)
    assert not list(tmp_path.rglob("*.so"))


def test_differences_are_of_a_record_and_of_steps_that_are_looked_at():
    wanted = {"nees": np.array([[1.0, 100.0], [np.nan, np.inf]]), "status": np.zeros((2, 2), int)}
    all_of_them = np.ones((2, 2), bool)
    same = {**wanted, "nees": wanted["nees"] * (1 + 1e-9)}
    assert native.difference(same, wanted, all_of_them, 1e-6) is None
    other = {**wanted, "nees": wanted["nees"] + np.array([[0.0, 1.0], [0.0, 0.0]])}
    told = "nees differs from XLA's by 0.01 of its largest value"
    assert native.difference(other, wanted, all_of_them, 1e-6) == told
    assert native.difference(other, wanted, all_of_them * [True, False], 1e-6) is None
    other = {**wanted, "status": np.eye(2, dtype=int)}
    assert "status differs" in str(native.difference(other, wanted, all_of_them, 1e-6))
    other = {**wanted, "nees": np.where(np.isnan(wanted["nees"]), 0.0, wanted["nees"])}
    assert "nees differs" in str(native.difference(other, wanted, all_of_them, 1e-6))
