"""Bad input, a thousand times: one clear line or a correct result, never anything else."""

import fuzz
import mutations
import numpy as np
import pytest

from jaxslam._runtime.files import read_arrays

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.mark.parametrize(
    ("only", "cases"),
    [
        ("evaluate_log", 50),
        ("evaluate_poses", 30),
        ("open_source", 50),
        ("override", 60),
        ("make_filters", 60),
        pytest.param("", 800, marks=pytest.mark.slow),  # more, of every reader
    ],
)
def test_broken_files_end_in_one_line_or_in_a_result(only, cases, tmp_path):
    cases_of = fuzz.Fuzz(tmp_path, only=only)
    findings = [finding for i in range(cases) if (finding := cases_of.case(i))]
    assert not findings, "\n".join(findings)


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
        (refuse("two\nlines"), "not one clear line"),
        (refuse("x" * 5000), "not one clear line"),
        (refuse("one line"), ""),
        (lambda folder, draw: (1.0, "words", None), ""),
    ],
)
def test_the_fuzz_finds_what_is_wrong_alone(read, found, tmp_path):
    target, draw = fuzz.Target(fuzz.nothing, read), np.random.default_rng(0)
    said = fuzz.problem(target, tmp_path, tmp_path / "trap", draw)
    assert found in said
    assert bool(said) == bool(found)


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
