"""Tests of benchmarks/mutants.py: what is mutated, and what is left alone."""

import ast

import mutants
import pytest

SOURCE = '''
"""A docstring of 3 - 1."""
def f(P: Float[Array, "n n"], k: int | None, limit=0.25) -> float | None:
    if k < 2 and limit:
        raise ValueError(f"{k - 1} of 7")
    return -(P @ P.T)[k + 1] * jnp.minimum(k, 3.5)
'''


def test_a_mutant_is_the_source_with_one_line_changed():
    found = list(mutants.sites(SOURCE, "jaxslam/x.py"))
    assert {(site.kind, site.text) for site in found} == {
        ("constant", "0.5"), ("constant", "3"), ("constant", "7.0"), ("comparison", "(k <= 2)"),
        ("logic", "(k < 2 or limit)"), ("sign", "(P @ P.T)[k + 1]"), ("transpose", "P"),
        ("operator", "(k - 1)"), ("dropped term", "k"), ("bound", "(jnp.maximum)"),
        ("operator", "(-(P @ P.T)[k + 1] / jnp.minimum(k, 3.5))"),
    }  # fmt: skip
    for site in found:
        ast.parse(changed := mutants.applied(site, SOURCE))
        lines = zip(SOURCE.splitlines(), changed.splitlines(), strict=True)
        assert [i for i, (a, b) in enumerate(lines, 1) if a != b] == [site.line]


@pytest.mark.slow
def test_they_are_drawn_of_every_room_by_a_seed():
    """A room that is left out; the whole package is read twice."""
    chosen = mutants.drawn(60, 1)
    assert chosen == mutants.drawn(60, 1)
    assert len(set(chosen)) == 60
    assert {"filters", "tracking", "evaluation"} <= {mutants._room(site.path) for site in chosen}


@pytest.mark.parametrize(
    ("body", "told"),
    [pytest.param("assert x > 0", "survived", marks=pytest.mark.slow), ("assert x == 3", "FAILED")],
)
def test_a_mutant_is_caught_by_a_test_that_fails(tmp_path, body, told):
    path = tmp_path / "jaxslam" / "linalg.py"
    path.parent.mkdir()
    path.write_text("x = 2 + 1\n")
    (path.parent / "__init__.py").touch()
    (tmp_path / "tests").mkdir()
    test = f"from jaxslam.linalg import x\ndef test_it():\n    {body}\n"
    (tmp_path / "tests" / "test_linalg.py").write_text(test)
    (site, *_) = mutants.sites(path.read_text(), "jaxslam/linalg.py")
    assert mutants.outcome(site, tmp_path, [], 1).startswith(told)
    assert path.read_text() == "x = 2 + 1\n"
