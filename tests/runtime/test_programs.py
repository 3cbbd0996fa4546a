"""Programs are made once for each structure, kept whole, and taken back only where they fit."""

import dataclasses
import operator
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxslam
from jaxslam._runtime import programs
from jaxslam._runtime.programs import Program, forget, in_background, keep_in, wide
from jaxslam.models.depth import InverseDepth

traced = []
KNOWN = programs._known


def scaled(depth, values, factor=2.0):
    """A pytree with a module in it; `factor` is part of the program."""
    traced.append(wide())
    return {"depth": depth, "values": factor * depth.sigma * values}


def arguments(size=3):
    depth = InverseDepth.beyond(2.0)
    return jax.tree.map(jnp.asarray, depth), jnp.arange(float(size))


@pytest.fixture(autouse=True)
def none_traced_and_none_kept(monkeypatch):
    """Whatever commands have told before."""
    traced.clear()
    monkeypatch.setattr(programs, "_kept_in", None)
    monkeypatch.setattr(programs, "_known", lambda obj: True)


@pytest.fixture
def folder(tmp_path):
    """Where programs are kept."""
    keep_in(tmp_path / "programs")
    return tmp_path / "programs"


def check(program, size=3):
    depth, values = arguments(size)
    found, expected = program(depth, values), scaled(depth, values)
    traced.pop()
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    np.testing.assert_allclose(found["values"], expected["values"], rtol=1e-6)
    assert np.any(np.asarray(found["values"]) > 0)


def test_a_program_is_made_once_for_each_structure():
    program = Program(scaled)
    for size in (3, 3, 4, 3, 4):
        check(program, size)
    assert len(traced) == 2
    depth, values = arguments()
    threefold, twofold = program(depth, values, 3.0), program(depth, values)
    np.testing.assert_allclose(threefold["values"], 1.5 * twofold["values"])
    assert len(traced) == 3


def test_who_needs_it_waits_for_who_makes_it():
    def slow(x):
        traced.append(1)
        time.sleep(0.3)
        return x + 1

    program = Program(slow)
    with ThreadPoolExecutor() as threads:
        found = list(threads.map(program, [1 + jnp.zeros(())] * 2))
    assert found == [2.0, 2.0]
    assert len(traced) == 1


def test_a_failure_is_told_and_tried_again():
    def failing(x):
        traced.append(1)
        raise ValueError("no")

    program = Program(failing)
    for count in (1, 2):
        with pytest.raises(ValueError, match="no"):
            program(jnp.zeros(()))
        assert len(traced) == count


def test_steps_are_taken_aside_in_the_callers_precision():
    def failing():
        raise ValueError("not the last word")

    program, caller = Program(scaled), wide()
    with jax.enable_x64(not caller):
        (thread,) = in_background(failing, lambda: program.compile(*arguments()))
        thread.join()
        assert traced == [not caller]
        check(program)
    assert traced == [not caller]
    check(program)
    assert traced == [not caller, caller]


def test_a_kept_program_is_neither_traced_nor_compiled(folder):
    for _ in range(3):
        check(Program(scaled))
    assert len(traced) == 1
    assert len(list(folder.iterdir())) == 1
    check(Program(scaled), 4)
    assert len(list(folder.iterdir())) == len(traced) == 2
    (folder / "file").write_text("")
    keep_in(folder / "file")
    check(Program(scaled), 5)  # a folder that cannot be written is done without


def test_shapes_of_a_kept_program_are_those_of_a_new_one(folder):
    """What is called with another's result is found again, whoever made that."""
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), arguments())
    new, kept = (Program(scaled).compile(*shapes) for _ in "ab")
    assert len(traced) == 1
    assert (new["values"].shape, new["values"].dtype) == ((3,), arguments()[1].dtype)
    assert isinstance(new["depth"], InverseDepth)
    check(Program(scaled))
    assert len(traced) == 1
    keys = [programs._Call.of((x,)).key for x in (new, kept)]
    assert keys[0] == keys[1]
    assert programs._Pickled.of(keys[0]).data == programs._Pickled.of(keys[1]).data


DAMAGE = {
    "empty": lambda whole: b"",
    "nonsense": lambda whole: b"nonsense",
    "cut": lambda whole: whole[: len(whole) // 2],
    "changed": lambda whole: whole[: len(whole) // 2] + b"?" + whole[len(whole) // 2 + 1 :],
}


@pytest.mark.parametrize("why", [*DAMAGE, "another user", "sources", "processor", "flags"])
def test_a_program_that_is_damaged_or_was_made_elsewhere_is_made_anew(folder, monkeypatch, why):
    check(Program(scaled))
    (path,) = folder.iterdir()
    if why in DAMAGE:
        path.write_bytes(DAMAGE[why](path.read_bytes()))
    elif why == "another user":
        monkeypatch.setattr(programs.os, "getuid", lambda: 12345)
    elif why == "flags":
        monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    else:
        name = {"sources": "_sources"}.get(why, why)
        monkeypatch.setattr(programs, name, lambda: ("other",))
        unwrapped = getattr(programs._sources, "__wrapped__", programs._sources)
        monkeypatch.setattr(programs, "_sources", unwrapped)
    check(Program(scaled))
    assert len(traced) == 2
    if why in DAMAGE:  # and was kept again
        check(Program(scaled))
        assert len(traced) == 2


def test_every_file_of_the_package_is_among_its_sources():
    whole = Path(jaxslam.__file__).parent
    assert programs.source_files() == sorted(whole.rglob("*.py"))
    assert whole / "filters" / "slam.py" in programs.source_files()


@pytest.fixture
def optimised():
    """As for users: tests ask JAX for few optimisations."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.mark.usefixtures("optimised")
def test_only_the_option_that_is_not_known_is_left_out(monkeypatch):
    asked, given = [], {"xla_new": 1, "xla_old": 2}
    compiled = jax.stages.Lowered.compile

    def compile(self, compiler_options=None):
        asked.append(compiler_options)
        if "xla_old" in (compiler_options or {}):
            raise RuntimeError("INVALID_ARGUMENT: No such compile option: 'xla_old'")
        return compiled(self)

    monkeypatch.setattr(jax.stages.Lowered, "compile", compile)
    check(Program(scaled, {"cpu": given}))
    assert asked == [given, {"xla_new": 1}]
    asked.clear()
    jax.config.update("jax_disable_most_optimizations", True)
    check(Program(scaled, {"cpu": given}))
    assert asked == [programs.QUICK["cpu"]]


@pytest.mark.parametrize(
    ("platform", "precision"), [("cpu", None), ("gpu", (jax.lax.Precision.HIGHEST,) * 2)]
)
def test_an_accelerator_rounds_no_factors(monkeypatch, platform, precision):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    seen = []
    program = Program(
        lambda a, b: jax.lax.dot(a, b), {}, lambda jaxpr, args: seen.extend(jaxpr.eqns)
    )
    program.compile(*[jax.ShapeDtypeStruct((2, 2), np.float32)] * 2)
    assert [x.params["precision"] for x in seen if x.primitive.name == "dot_general"] == [precision]


@pytest.mark.parametrize("options", [programs.ALONE, programs.BATCHED])
def test_the_compiler_knows_the_options(options):
    jax.jit(jnp.sin).lower(0.0).compile(compiler_options=options["cpu"])


class Static(eqx.Module):
    """A module with a part that is no data."""

    values: jax.Array
    power: object = eqx.field(static=True)


@dataclasses.dataclass(frozen=True)
class Choice:
    """A part that compares by value."""

    power: object


NAN = float("nan")
UNEQUAL = ((2, 2.0), (True, 1), (-0.0, 0.0))
PLACES = (
    lambda x: (x,),
    lambda x: (partial(max, x),),
    lambda x: (Static(jnp.ones(2), x),),
    lambda x: (Static(jnp.ones(2), Choice((x,))),),
)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("two", UNEQUAL, ids=repr)
def test_parts_are_the_same_only_by_type_and_bits(place, two):
    def told(*args):
        traced.append(1)
        return jnp.ones(())

    program = Program(told)
    for x in (*two, *two):
        program(*place(x))
    assert len(traced) == 2
    program(*place(NAN))
    program(*place(float("nan")))
    assert len(traced) == 3


@pytest.mark.parametrize("two", UNEQUAL, ids=repr)
def test_kept_programs_are_the_same_only_by_type_and_bits(folder, two):
    for x in (*two, *two):
        Program(written)(Static(jnp.ones(2), x))
    assert len(traced) == len(list(folder.iterdir())) == 2


def written(module):
    traced.append(1)
    return module.values * module.power


class Own(eqx.Module):
    """A piece of one's own."""

    factor: jax.Array

    def __mul__(self, x):
        return self.factor * x


def test_what_may_change_without_notice_is_not_kept(folder, monkeypatch):
    """Nobody tells when a function or a piece of one's own has become another."""
    for value in (2.0, 3.0):
        around = Program(lambda function, x: function(x))(lambda x: value * x, jnp.ones(()))  # noqa: B023
        assert around == value
    monkeypatch.setattr(programs, "_known", KNOWN)
    check(Program(scaled))
    assert Program(operator.mul)(Own(jnp.ones(())), jnp.ones(())) == 1.0
    assert not folder.exists()
    assert Program(operator.mul)(jnp.ones(()), jnp.ones(())) == 1.0
    assert len(list(folder.iterdir())) == 1


def test_those_that_were_not_used_for_long_are_freed_and_all_may_be_forgotten(monkeypatch):
    monkeypatch.setattr(programs, "MOST", 2)
    program = Program(scaled)
    for size in (3, 4, 3, 5, 3, 4):  # 4 was freed for 5
        check(program, size)
    assert len(traced) == 4
    assert program._made
    forget()
    assert not program._made
    check(program)
