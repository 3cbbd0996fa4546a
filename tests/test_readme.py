"""The examples of the README and of the documents run."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def examples(document: str) -> list[str]:
    """The document's marked snippets."""
    text = (ROOT / document).read_text()
    return re.findall(r"<!-- runs as a test -->\n```python\n(.*?)```", text, re.DOTALL)


def run_example(document: str) -> str:
    """Execute the document's marked snippets, each by itself, and return the first."""
    for snippet in examples(document):
        exec(compile(snippet, document, "exec"), {"__name__": __name__})
    return examples(document)[0]


def test_the_library_example_runs_and_prints_a_table(capsys):
    snippet = run_example("README.md")
    assert len(snippet.strip().splitlines()) <= 13
    assert "robocentric/inverse_scaling" in capsys.readouterr().out


def test_a_filter_of_ones_own_takes_part_in_a_study(capsys):
    run_example("docs/own-filter.md")
    lines = capsys.readouterr().out.splitlines()
    assert ": consistent (p = " in lines[lines.index("mine:") + 1]


def test_a_log_of_ones_own_goes_through_the_filter(capsys):
    """And a sensor and a motion of one's own, with consistent numbers."""
    assert len(examples("docs/own-data.md")) == 3
    run_example("docs/own-data.md")
    out = capsys.readouterr().out
    printed = re.search(r"\[([^]]*)\] ±", out)
    assert printed is not None
    position = [float(x) for x in printed[1].split()]
    assert abs(position[0] - 1.5) < 0.2
    assert abs(position[1]) < 0.2
    for name in ("bearings:", "biased:"):
        assert "over-confident" not in out[out.index(name) :].splitlines()[1]


def test_a_filter_has_gradients(capsys):
    run_example("docs/gradients.md")
    assert "by the pixel's σ" in capsys.readouterr().out
