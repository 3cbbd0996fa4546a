"""Bad input, a thousand times: one clear line or a correct result, never anything else."""

import fuzz
import mutations
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import jaxslam
from jaxslam._runtime.files import read_arrays
from jaxslam.simulation.scenario import parse_override

pytestmark = pytest.mark.usefixtures("unchecked")

OFTEN = settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
ANY_ARRAY = arrays.arrays(
    dtype=st.one_of(
        arrays.floating_dtypes(), arrays.integer_dtypes(), arrays.boolean_dtypes(),
        arrays.complex_number_dtypes(), arrays.unicode_string_dtypes(max_len=3),
    ),
    shape=arrays.array_shapes(min_dims=0, max_dims=5, min_side=0, max_side=4),
)  # fmt: skip


@pytest.mark.parametrize(
    ("only", "cases"),
    [
        ("evaluate_log", 50),
        ("evaluate_poses", 30),
        ("open_source", 50),
        pytest.param("", 800, marks=pytest.mark.slow),  # more, of every reader
    ],
)
def test_broken_files_end_in_one_line_or_in_a_result(only, cases, tmp_path):
    cases_of = fuzz.Fuzz(tmp_path, only=only)
    findings = [finding for i in range(cases) if (finding := cases_of.case(i))]
    assert not findings, "\n".join(f"case {f.case}, {f.target}: {f.what}" for f in findings)


COMPILES = {"resume", "Tracker.load"}
"""Targets that run a tracker on what they read; tests of its files do so too."""
WRITTEN = [
    name
    for name, target in fuzz.TARGETS.items()
    if target.write is not fuzz.nothing and not name.startswith(("evaluate_log ", "open_source "))
]
"""That logs and videos are read whole is a law of theirs."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=pytest.mark.slow if x in COMPILES else ()) for x in WRITTEN],
)
def test_every_target_reads_its_whole_files(name, tmp_path, monkeypatch):
    """Else the fuzz would only see how files that were never whole are refused."""
    monkeypatch.setattr("warnings.warn", lambda *_, **__: None)
    fuzz.TARGETS[name].write(tmp_path)
    fuzz.TARGETS[name].read(tmp_path, np.random.default_rng(0))


def one_line_or_result(call, *given_to_it):
    """What a call ends in; anything but a result or a ValueError of one line goes through."""
    try:
        return call(*given_to_it)
    except ValueError as error:
        said = str(error)
    assert said
    assert "\n" not in said
    return None


@OFTEN
@given(errors=ANY_ARRAY, covariances=ANY_ARRAY)
def test_any_two_arrays_are_evaluated_or_refused(errors, covariances):
    with np.errstate(all="ignore"):
        found = one_line_or_result(jaxslam.evaluate, errors, covariances)
    assert found is None or not np.isnan(found.nees).any()


@OFTEN
@given(text=st.text(max_size=30))
def test_any_text_is_an_override_a_name_or_refused(text):
    found = one_line_or_result(parse_override, text)
    if found is not None:
        one_line_or_result(jaxslam.scenario, "circle", dict([found]))
    one_line_or_result(jaxslam.make_filters, "matched", text, "inverse_scaling")
    one_line_or_result(jaxslam.scenario, text)


def problem_of(read, tmp_path):
    trap = tmp_path / "trap"
    target = fuzz.Target(fuzz.nothing, read)
    return fuzz.problem(target, tmp_path, trap, np.random.default_rng(0))


def refuse(message):
    def read(folder, draw):
        raise ValueError(message)

    return read


@pytest.mark.parametrize(
    ("read", "found"),
    [
        (lambda folder, draw: {}["missing"], "KeyError"),
        (lambda folder, draw: {"x": [1.0, np.nan]}, "result['x'][1] is not finite"),
        (lambda folder, draw: (np.zeros(2), np.array([np.inf])), "result[1] is not finite"),
        (lambda folder, draw: (folder / f".{fuzz.os.getpid()}.x").touch(), "left behind"),
        (lambda folder, draw: (folder / "trap").write_text(mutations.MARK), "a pickle"),
        (refuse(""), "not one clear line"),
        (refuse("two\nlines"), "not one clear line"),
        (refuse("x" * 5000), "not one clear line"),
    ],
)
def test_the_fuzz_finds(read, found, tmp_path):
    assert found in problem_of(read, tmp_path)


@pytest.mark.parametrize("read", [refuse("one line"), lambda folder, draw: (1.0, "words", None)])
def test_the_fuzz_is_content(read, tmp_path):
    assert problem_of(read, tmp_path) == ""


def test_a_pickle_in_a_file_is_not_run(tmp_path):
    trap = tmp_path / "trap"
    held = {"errors": np.array([mutations.Trap(trap)], object)}
    np.savez(tmp_path / "x.npz", allow_pickle=True, **held)
    with pytest.raises(ValueError, match=r"x\.npz: not an npz file of numbers"):
        read_arrays(tmp_path / "x.npz")
    assert not trap.exists()
    with np.load(tmp_path / "x.npz", allow_pickle=True) as file:  # it would have been
        assert file["errors"] is not None
    assert trap.read_text() == mutations.MARK
